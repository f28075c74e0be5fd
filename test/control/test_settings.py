# SPDX-License-Identifier: Apache-2.0
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.parameters import parameters_of
from musculoskeletal_ae.robot.kinematics import RACK


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(FrozenInstanceError):
        Settings().method = 'first'


@pytest.mark.parametrize('given', [(), (0.0,)])
def test_no_joint_stiffness_is_as_it_comes_for_every_joint(given):
    assert Settings(joint_stiffness=given).desired_stiffness((1.0, 1.0, 1.0)) == (0.0, 0.0, 0.0)
    assert Settings(joint_stiffness=(5.0, 0.0)).desired_stiffness((1.0, 1.0)) == (5.0, 0.0)


@pytest.mark.parametrize('given', [(1.0,), (1.0, 2.0, 3.0), (1.0, -1), (np.nan, 1), (np.inf, 1)])
def test_joint_stiffness_that_is_not_one_number_a_joint_is_refused(given):
    with pytest.raises(MusculoskeletalError, match='legal: 2 numbers of at least 0'):
        Settings(joint_stiffness=given).desired_stiffness((1.0, 1.0))


def test_a_joint_that_slides_may_be_as_stiff_as_one_that_a_pinion_turns():
    """At most 1000 N·m/rad, over the square of the pinion's radius."""
    parameter, radian = parameters_of(Settings)['joint_stiffness'], (1.0, RACK)
    given = parameter.checked([1000.0, 1000.0 / RACK**2])
    assert Settings(joint_stiffness=given).desired_stiffness(radian) == given
    for beyond in ((1001.0, 0.0), (0.0, 1001.0 / RACK**2)):
        with pytest.raises(MusculoskeletalError, match='at most 1000, 277778 '):
            Settings(joint_stiffness=beyond).desired_stiffness(radian)
