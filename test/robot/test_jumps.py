# SPDX-License-Identifier: Apache-2.0
"""Tendons that may slip over an object, so that their length jumps.

`check_robot` reports them, and no emulated individual has one.
"""

import numpy as np
import pytest
from robots import DRUM_ENDS, behind_a_drum

from musculoskeletal_ae.design import route_jumps as robot_jumps
from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.design.route_jumps import JUMP, jumping, second_differences
from musculoskeletal_ae.emulator.foreign import arm as foreign
from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
from musculoskeletal_ae.emulator.kin import individual
from musculoskeletal_ae.emulator.kin.individual import Individual


def test_a_jump_of_length_is_located():
    def lengths(theta):
        return np.stack([theta[:, 0] ** 2, np.where(theta[:, 1] > 0.4, 0.01, 0.0)], axis=1)

    bends, theta = second_differences(lengths, -np.ones(2), np.ones(2))
    assert bends[:, 0].max() < JUMP
    assert bends[:, 1].max() == pytest.approx(0.01)
    assert theta[bends[:, 1].argmax(), 1] == pytest.approx(0.4, abs=0.02)


def test_check_robot_warns_of_a_muscle_whose_length_jumps(tmp_path):
    (warning,) = check_robot(behind_a_drum(tmp_path, DRUM_ENDS['jumps'])).warnings
    assert warning.kind == 'jumping_muscle'
    assert "'straightener' jumps by up to 173 mm" in warning.text
    assert 'for bend from -1.57 to -1.57 rad; no network can represent this' in warning.text


@pytest.mark.parametrize(
    ('module', 'body', 'seed'),
    [
        (individual, Individual, 7),
        (foreign, lambda robot, seed: ForeignArm(robot, seed).individual, 0),
    ],
    ids=['kin', 'foreign'],
)
def test_lengths_of_emulated_individuals_jump_only_where_the_models_do(
    tmp_path, monkeypatch, module, body, seed
):
    monkeypatch.setattr(robot_jumps, 'LINES', 15)
    robot, odd = (behind_a_drum(tmp_path / name, end) for name, end in DRUM_ENDS.items())
    m = robot.muscles.index('straightener')
    with monkeypatch.context() as patch:
        patch.setattr(module, 'MOST_DRAWS', 0)
        assert jumping(body(robot, seed).absolute_lengths, robot)[m]  # premise: this length jumps
    assert not jumping(body(robot, seed).absolute_lengths, robot).any()
    np.testing.assert_array_equal(
        jumping(body(odd, seed).absolute_lengths, odd), np.arange(odd.muscle_count) == m
    )
