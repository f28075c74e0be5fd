# SPDX-License-Identifier: Apache-2.0
"""The closed loop of the experiment `resilience`, which isolates faulty muscles."""

import numpy as np
from nominal_body import nominal_arm

from musculoskeletal_ae.experiments.resilience import IsolatingLoop

JUMP = 0.035  # a length sensor that reads 0 from one message to the next has jumped by this [m]


def test_a_length_sensor_that_fails_with_a_jump_isolates_its_muscle(arm26, trained):
    arm = nominal_arm(arm26)
    loop = IsolatingLoop(arm, trained['default'])
    loop.run(1.0)
    loop.core.explore(True)
    while np.abs(arm.sense().muscles.length).max() < JUMP and loop.time < 60.0:
        loop.run(0.1)
    muscle = int(np.abs(arm.sense().muscles.length).argmax())
    arm.set_faults([f'dead_sensor:length:{arm26.muscles[muscle]}'])
    for _ in range(10):
        if not loop.verdicts:
            loop.run(1.0)
    assert [isolated for isolated, _ in loop.verdicts] == [(muscle,)]
