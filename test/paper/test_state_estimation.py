# SPDX-License-Identifier: Apache-2.0

import numpy as np

from musculoskeletal_ae.mae.training import random_states
from musculoskeletal_ae.paper.state_estimation import estimate
from musculoskeletal_ae.robot.robot import Robot


def test_the_estimate_of_all_presets_is_the_printed_one_while_no_muscle_is_isolated(trained):
    _, tension, length = random_states(Robot.load('arm26'), 5, np.random.default_rng(0), 200.0)
    for ours, printed in zip(
        trained['paper'].estimate(tension, length), estimate(trained['paper'], tension, length)
    ):
        np.testing.assert_array_equal(ours, printed)
