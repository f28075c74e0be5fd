# SPDX-License-Identifier: Apache-2.0
"""Trajectories and hand poses on a real graph, with the emulated arm."""

import numpy as np
import pytest
from controlled_arm import ControlledArm
from geometry_msgs.msg import PoseStamped, TwistStamped
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

HERE, THERE = np.array([-0.5, -1.2]), np.array([0.1, -0.5])


@pytest.fixture
def arm(graph, arm26, trained_file):
    return ControlledArm(graph, arm26, trained_file)


def trajectory(arm, goal, seconds=1, names=None):
    still = [0.0] * len(goal)
    point = JointTrajectoryPoint(positions=list(goal), velocities=still, accelerations=still)
    point.time_from_start.sec = seconds
    return JointTrajectory(joint_names=names or arm.robot.joints, points=[point])


def test_a_trajectory_is_followed_and_its_state_published_and_a_wrong_one_moves_nothing(arm):
    graph, robot = arm.graph, arm.robot
    graph.listen(JointTrajectory, 'controller_state', 1000)
    publisher = graph.publisher(JointTrajectory, 'joint_trajectory')
    publisher.publish(trajectory(arm, robot.upper + 0.5))
    rejected = arm.controller.rejected
    reason = 'joint_trajectory: beyond the joint limits'
    graph.wait(lambda: rejected[reason] == 1, 'the rejection')
    assert arm.count() == 0
    for goal in (HERE, THERE):
        publisher.publish(trajectory(arm, goal))
        arm.says('following a trajectory')
        arm.says('holding')
        arm.goes_to(goal, within=0.3)

    def arrived():
        state = graph.next('controller_state')
        return state if np.allclose(state.points[0].positions, THERE) else None

    state = graph.wait(arrived, 'the last desired posture')
    assert tuple(state.joint_names) == robot.joints
    desired, feedback, error = (np.array(point.positions) for point in state.points)
    np.testing.assert_allclose(desired - feedback, error, atol=1e-12)
    since = state.points[0].time_from_start
    assert since.sec + 1e-9 * since.nanosec > 0.9
    arm.never_jumped()
    # Move one joint only. Then end the motion by a message without points.
    publisher.publish(trajectory(arm, HERE[1:], 20, [robot.joints[1]]))
    arm.says('following a trajectory')
    publisher.publish(JointTrajectory())
    arm.says('holding')
    stopped = arm.controller.core.activities.follower.progress.desired.theta
    assert stopped[0] == pytest.approx(THERE[0])
    assert stopped[1] - HERE[1] > 0.2


def test_a_hand_pose_is_reached_and_one_in_another_frame_refused(arm):
    graph, robot, rejected = arm.graph, arm.robot, arm.controller.rejected
    publisher = graph.publisher(PoseStamped, 'target_pose')
    message = PoseStamped()
    wanted = robot.kinematics.end_effector_pose(HERE).translation
    place = message.pose.position
    place.x, place.y, place.z = wanted.tolist()
    message.pose.orientation.w = 0.0  # a target without an orientation
    message.header.frame_id = 'elsewhere'
    publisher.publish(message)
    graph.wait(lambda: rejected['target_pose: wrong frame'] == 1, 'the rejection')
    message.header.frame_id = robot.root_link
    publisher.publish(message)

    def away():
        return np.linalg.norm(
            robot.kinematics.end_effector_pose(arm.posture()).translation - wanted
        )

    graph.wait(lambda: away() < 0.06, 'the hand at its place')
    place.x = 9.0
    publisher.publish(message)
    graph.wait(lambda: rejected['target_pose: out of reach'] == 1, 'the rejection')
    twists = graph.publisher(TwistStamped, 'target_twist')
    twist = TwistStamped()
    twist.header.frame_id, twist.twist.linear.x = robot.root_link, 0.05
    progress = arm.controller.core.activities.follower.progress
    before = progress.trajectory
    twists.publish(twist)
    graph.wait(lambda: progress.trajectory is not before, 'the motion')
    arm.says('holding')  # the twist has timed out
