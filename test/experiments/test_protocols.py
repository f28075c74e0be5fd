# SPDX-License-Identifier: Apache-2.0
"""What has to hold for the comparison to be fair: same motion, same stream, same seeds."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from musculoskeletal_ae.experiments.suite.detection import alarms_begun, auroc
from musculoskeletal_ae.experiments.suite.learning import (
    EXPLORING,
    HELD_OUT,
    learn_individual,
    train_initial,
)
from musculoskeletal_ae.experiments.suite.results import combined
from musculoskeletal_ae.experiments.suite.scenario import (
    CARRYING,
    CUT_TIME,
    PAYLOAD,
    SLOT,
    GraspAndCut,
    ScriptedArm,
)
from musculoskeletal_ae.experiments.suite.study import Study

from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.robot import Robot


def ignored(_):
    """Neither a progress bar nor a script."""


@pytest.fixture(scope='module')
def studies(tmp_path_factory):
    """The same individual twice, in different folders, and another one."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    found = []
    for seed in (0, 0, 1):
        study = Study('arm26', 'default', (seed,), 0.25, True, tmp_path_factory.mktemp('study'))
        for preset in PRESETS:
            if found:
                shutil.copy(found[0][0].network_file(preset, None), study.folder)
            else:
                train_initial(study, preset)
        found.append((study, learn_individual(study, seed, ignored)))
    torch.set_num_threads(threads)
    return found


def test_the_same_seed_gives_the_same_numbers_and_networks(studies):
    (one, first), (two, second), _ = studies
    assert first.numbers == second.numbers
    robot = one.body()
    for preset in PRESETS:
        networks = [study.learnt(robot, 0, preset) for study in (one, two)]
        for layer in range(len(networks[0].decoder)):
            weights = [network.decoder[layer][0] for network in networks]
            np.testing.assert_array_equal(*weights)


def test_another_individual_gives_other_numbers(studies):
    (_, first), _, (_, other) = studies
    assert first.numbers['before_rad'] != other.numbers['before_rad']


def test_the_held_out_motion_has_the_same_commands_for_every_individual(studies):
    (one, _), _, (other, _) = studies
    command = one.stream(0, HELD_OUT).command
    # The first ramp starts where each arm hangs; from the second goal on they are one list.
    start = 500
    np.testing.assert_array_equal(command[start:], other.stream(1, HELD_OUT).command[start:])


def test_the_held_out_motion_is_not_the_one_learnt_from(studies):
    (one, _), *_ = studies
    learnt, held_out = (one.stream(0, name).command for name in (EXPLORING, HELD_OUT))
    assert np.abs(learnt[499] - held_out[499]).max() > 1e-3


def test_both_presets_learn_from_the_same_stream(studies):
    (_, measured), *_ = studies
    assert measured.numbers['samples'] == measured.numbers['paper_samples']


def test_grasp_comes_midway_and_every_muscle_is_cut_once_and_mended():
    robot = Robot.load('arm26')
    plan = GraspAndCut(robot, 4.0, seed=0)

    class Fake:
        """Records what the script does to an arm whose muscles all carry tension."""

        def __init__(self):
            self.time, self.done = 0.0, []
            self.tension = np.full(robot.muscle_count, robot.tension.bias + 2.0 * CARRYING)

        def set_payload(self, mass):
            self.done.append((self.time, mass))

        def set_ruptured(self, names):
            self.done.append((self.time, tuple(names)))

    arm = Fake()
    while arm.time < plan.duration:
        plan(arm)
        arm.time += 0.01
    grasp = [what for what in arm.done if what[1] == PAYLOAD]
    assert grasp
    assert grasp[0][0] == pytest.approx(2.0, abs=0.02)
    cuts = [what for what in arm.done if isinstance(what[1], tuple)]
    assert sorted(names[0] for _, names in cuts if names) == sorted(robot.muscles)
    assert plan.carried.all()
    for (cut, names), (mended, none) in zip(cuts[::2], cuts[1::2], strict=True):
        assert names and not none
        assert mended - cut == pytest.approx(CUT_TIME, abs=0.02)
        assert (cut - 4.0) // SLOT == (mended - 4.0) // SLOT


def test_a_scripted_arm_moves_as_an_arm_without_a_script():
    robot = Robot.load('arm26')
    arm = ScriptedArm(robot, 3, ignored)
    plain = ScriptedArm(robot, 3, lambda arm: arm.set_payload(0.0))
    for each in (arm, plain):
        each.command_length(np.zeros(robot.muscle_count))
        each.step(0.5)
    np.testing.assert_array_equal(arm.theta, plain.theta)
    assert arm.time == 0.5


def test_auroc_is_the_share_of_pairs_in_the_right_order():
    assert auroc(np.array([0.0, 1.0]), np.array([2.0, 3.0])) == 1.0
    assert auroc(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 0.0
    assert auroc(np.array([1.0, 3.0]), np.array([2.0])) == 0.5
    assert auroc(np.array([1.0]), np.array([1.0])) == 0.5


def test_alarms_are_counted_when_they_begin():
    assert alarms_begun(np.array([True, True, False, True, False, False, True, True])) == 3
    assert alarms_begun(np.zeros(5, dtype=bool)) == 0
    assert alarms_begun(np.zeros(0, dtype=bool)) == 0


def test_result_json_has_means_over_seeds_but_counts_alarms_in_all(tmp_path):
    study = Study('arm26', 'default', (0, 1), 1.0, True, tmp_path)
    rows = {
        0: {'after_rad': 0.1, 'false_alarms': 1, 'first': {'error_rad': 0.2}, 'joint': 'elbow'},
        1: {'after_rad': 0.3, 'false_alarms': 2, 'first': {'error_rad': 0.4}, 'joint': 'elbow'},
    }
    found = combined(study, rows)
    assert found['after_rad'] == 0.2
    assert found['false_alarms'] == 3
    assert found['first']['error_rad'] == pytest.approx(0.3)
    assert found['joint'] == 'elbow'
    assert found['seeds']['1']['after_rad'] == 0.3
