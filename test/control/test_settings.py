# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.parameters import parameters_of
from musculoskeletal_ae.robot.joint_units import RACK, JointUnits

TURNING = JointUnits('ab', [False, False])


@pytest.mark.parametrize('stiffness', [(), (0.0,)])
def test_joint_stiffness_left_empty_demands_nothing_of_any_joint(stiffness):
    assert not Settings(joint_stiffness=stiffness).desired_stiffness(TURNING).any()
    assert Settings(joint_stiffness=(5.0, 0.0)).desired_stiffness(TURNING).tolist() == [5.0, 0.0]


def test_joint_stiffness_needs_one_number_for_each_joint():
    with pytest.raises(MusculoskeletalError, match='legal: 2 numbers of at least 0'):
        Settings(joint_stiffness=(1.0, 2.0, 3.0)).desired_stiffness(TURNING)


@pytest.mark.parametrize(
    ('wrong', 'legal'),
    [
        ({'joint_stiffness': (1.0, -1.0)}, 'a list of finite numbers, 0 to '),
        ({'joint_stiffness': (np.nan, 1.0)}, 'a list of finite numbers'),
        ({'method': 'magic'}, 'legal: geometric, first'),
        ({'max_age': 60.0}, 'a finite number, 0.01 to 10 s'),
        ({'rate_limit': '0.1'}, 'a finite number, 0.001 to 1 m/s'),
    ],
)
def test_settings_are_checked_wherever_they_are_made(wrong, legal):
    (name,) = wrong
    for make in (partial(Settings, **wrong), partial(replace, Settings(), **wrong)):
        with pytest.raises(MusculoskeletalError, match=f'^parameter {name}: .*{legal}'):
            make()


def test_the_limit_of_joint_stiffness_of_a_prismatic_joint_is_that_of_a_pinion():
    """A pinion moves a rack: the limit of 1000 N·m/rad is divided by the square of its radius."""
    parameter, units = parameters_of(Settings)['joint_stiffness'], JointUnits('ab', [False, True])
    stiffness = parameter.checked([1000.0, 1000.0 / RACK**2])
    desired = Settings(joint_stiffness=stiffness).desired_stiffness(units)
    assert desired == pytest.approx([1000.0, 1000.0])
    for beyond in ((1001.0, 0.0), (0.0, 1001.0 / RACK**2)):
        with pytest.raises(MusculoskeletalError, match=r'at most 1000, 277778 |0 to 277778 '):
            Settings(joint_stiffness=beyond).desired_stiffness(units)
