# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.parameters import parameters_of
from musculoskeletal_ae.robot.kinematics import RACK


@pytest.mark.parametrize('stiffness', [(), (0.0,)])
def test_joint_stiffness_left_empty_demands_nothing_of_any_joint(stiffness):
    assert Settings(joint_stiffness=stiffness).desired_stiffness((1.0, 1.0, 1.0)) == (0.0, 0.0, 0.0)
    assert Settings(joint_stiffness=(5.0, 0.0)).desired_stiffness((1.0, 1.0)) == (5.0, 0.0)


@pytest.mark.parametrize('stiffness', [(1.0, 2.0, 3.0), (1.0, -1.0), (np.nan, 1.0)])
def test_joint_stiffness_needs_one_number_of_at_least_0_for_each_joint(stiffness):
    with pytest.raises(MusculoskeletalError, match='legal: 2 numbers of at least 0'):
        Settings(joint_stiffness=stiffness).desired_stiffness((1.0, 1.0))


def test_the_limit_of_joint_stiffness_of_a_prismatic_joint_is_that_of_a_pinion():
    """A pinion moves a rack: the limit of 1000 N·m/rad is divided by the square of its radius."""
    parameter, radian = parameters_of(Settings)['joint_stiffness'], (1.0, RACK)
    stiffness = parameter.checked([1000.0, 1000.0 / RACK**2])
    assert Settings(joint_stiffness=stiffness).desired_stiffness(radian) == stiffness
    for beyond in ((1001.0, 0.0), (0.0, 1001.0 / RACK**2)):
        with pytest.raises(MusculoskeletalError, match='at most 1000, 277778 '):
            Settings(joint_stiffness=beyond).desired_stiffness(radian)
