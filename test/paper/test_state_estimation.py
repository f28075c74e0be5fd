# SPDX-License-Identifier: Apache-2.0

import numpy as np

from musculoskeletal_ae.mae.training import random_states
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.robot.robot import Robot


def test_the_estimate_of_all_presets_is_the_printed_one_while_no_muscle_is_isolated(trained):
    _, tension, length = random_states(Robot.load('arm26'), 5, np.random.default_rng(0), 200.0)
    mae = trained['paper']
    printed = mae.decode(mae.encode(Mask.TENSION_LENGTH, tension=tension, length=length))
    for ours, theirs in zip(mae.estimate(tension, length), printed, strict=True):
        np.testing.assert_array_equal(ours, theirs)
