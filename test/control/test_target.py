# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a target is stated with the advice to command another one, which helps."""

import pinocchio as pin
import pytest
from control_bench import OTHER, ROBOT, settled

from musculoskeletal_ae.conditions import ConditionKind as Kind


def beyond_the_limits(bench):
    bench.target([10.0, -0.5])


def with_a_great_effort(bench):
    bench.target(OTHER, [500.0, 500.0])


def out_of_reach(bench):
    bench.configure(unreachable='nearest')
    pose = ROBOT.kinematics.end_effector_pose(OTHER)
    bench.core.pose(pin.SE3(pose.rotation, 3.0 * pose.translation), False, bench.now)


def stated(bench):
    return {condition.kind for condition in bench.report().conditions}


@pytest.mark.parametrize(
    ('give', 'kind'),
    [
        (beyond_the_limits, Kind.TARGET_CLAMPED),
        (with_a_great_effort, Kind.TORQUE_MISSING),
        (out_of_reach, Kind.OUT_OF_REACH),
    ],
    ids=['limits', 'torque', 'reach'],
)
def test_another_target_ends_what_is_wrong_with_a_target(give, kind):
    bench = settled()
    give(bench)
    bench.step(20)
    assert kind in stated(bench)
    assert 'change_target' in bench.steps()
    bench.target(OTHER)
    bench.step(100)
    assert kind not in stated(bench)
    assert 'change_target' not in bench.steps()
