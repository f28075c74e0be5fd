# SPDX-License-Identifier: Apache-2.0
"""The result of an action's goal: reached, off the path, late at the end, replaced or stopped."""

from types import SimpleNamespace

import numpy as np
import pytest
from control_bench import DT, OTHER, REST, ROBOT, Bench
from robots import write_robot

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.followed_goal import (
    BEYOND_GOAL,
    BEYOND_PATH,
    INVALID,
    SUCCESSFUL,
    FollowedGoal,
    read_tolerances,
)
from musculoskeletal_ae.control.settings import METHODS
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.robot.robot import Robot

FREE = np.full(2, np.inf)
TIGHT = np.array([0.05, np.inf])


class FollowingBench:
    """A controller that follows a trajectory of 1 s, and the goal that requested the trajectory."""

    def __init__(self, path=FREE, goal=FREE, patience=0.0, delay=0.0, method='proposed'):
        self.bench = Bench(method=method)
        self.bench.target(REST)
        self.bench.step(5)
        self.start(delay)
        self.goal = FollowedGoal(self.bench.core, ROBOT.joints, path, goal, patience)

    def start(self, delay=0.0):
        still = np.zeros((1, 2))
        points = TrajectoryPoints(np.arange(2), np.array([1.0]), OTHER[None], still, still)
        self.bench.core.trajectory(points, delay)

    def run(self, steps=1000, moves=True):
        """Step until the goal has a result, at most `steps` times.

        Returns:
            The result (None if there was none) and the number of steps.
        """
        for step in range(steps):
            if outcome := self.goal.outcome(self.bench.now):
                return outcome, step
            self.bench.step()
            if moves and self.bench.core.is_following:
                self.bench.theta = self.bench.follower.progress.desired.theta.copy()
        return None, steps


def test_a_goal_that_is_reached_succeeds_at_the_end_of_its_trajectory():
    followed = FollowingBench(path=TIGHT, goal=TIGHT)
    (code, reported), steps = followed.run()
    assert (code, reported) == (SUCCESSFUL, '')
    duration = followed.bench.follower.progress.trajectory.duration
    assert 100.0 * duration - 1.5 <= steps <= 100.0 * duration + 5.0


def test_a_goal_in_the_future_is_waited_for():
    followed = FollowingBench(path=TIGHT, delay=0.5)
    (code, _), steps = followed.run()
    assert code == SUCCESSFUL
    assert steps >= 150


def test_an_arm_that_does_not_follow_violates_the_path_tolerance_and_the_joint_is_named():
    (code, reported), steps = FollowingBench(path=TIGHT).run(moves=False)
    assert code == BEYOND_PATH
    assert ROBOT.joints[0] in reported
    assert steps < 100


def test_an_arm_that_does_not_arrive_fails_after_the_goal_time_tolerance():
    assert FollowingBench(goal=TIGHT).run(200, moves=False) == (None, 200)
    followed = FollowingBench(goal=TIGHT, patience=0.5)
    (code, _), steps = followed.run(moves=False)
    assert code == BEYOND_GOAL
    assert steps > 100.0 * (followed.bench.follower.progress.trajectory.duration + 0.5) - 2.0


def test_new_networks_do_not_extend_the_goal_time_tolerance(monkeypatch):
    followed = FollowingBench(goal=TIGHT, patience=1.0)
    step, bench = followed.bench.step, followed.bench

    def learning():
        if round(bench.now / DT) % 60 == 0:
            bench.core.use(bench.mae)
        step()

    monkeypatch.setattr(bench, 'step', learning)
    (code, _), steps = followed.run(moves=False)
    assert code == BEYOND_GOAL
    assert steps < 100.0 * (bench.follower.progress.trajectory.duration + 1.5)


@pytest.mark.parametrize('method', sorted(set(METHODS) - {'float'}))
def test_a_goal_is_followed_and_its_end_is_awaited_with_every_method(method):
    followed = FollowingBench(path=TIGHT, goal=TIGHT, method=method)
    (code, reported), steps = followed.run()
    assert (code, reported) == (SUCCESSFUL, '') and steps >= 98
    followed = FollowingBench(goal=TIGHT, patience=0.5, method=method)
    (code, reported), steps = followed.run(moves=False)
    assert code == BEYOND_GOAL and ROBOT.joints[0] in reported
    assert steps >= 148
    followed = FollowingBench(goal=TIGHT, method=method)
    assert followed.run(150, moves=False)[0] is None
    followed.bench.target(REST)
    assert followed.run()[0] == (INVALID, 'the trajectory was replaced by another target')


@pytest.mark.parametrize('event', ['trajectory', 'target', 'stop', 'method'])
def test_what_ends_the_trajectory_ends_the_goal(event):
    followed = FollowingBench()
    assert followed.run(20)[0] is None
    core = followed.bench.core
    if event == 'trajectory':
        followed.start()
    elif event == 'target':
        followed.bench.target(REST)
    elif event == 'stop':
        core.stop(ConditionKind.OPERATOR)
    else:
        followed.bench.configure(method='tension')
    (code, reported), steps = followed.run()
    assert (code, steps) == (INVALID, 0)
    reasons = {
        'trajectory': 'replaced',
        'target': 'replaced',
        'stop': 'stopped: controller/stop',
        'method': 'the mode changed to holding',
    }
    assert reasons[event] in reported


def test_tolerances_of_unknown_joints_or_not_finite_are_refused_and_zero_means_no_bound():
    def one(position, name=ROBOT.joints[1]):
        return SimpleNamespace(name=name, position=position, velocity=0.0, acceleration=0.0)

    assert read_tolerances([], ROBOT.units).tolist() == [np.inf, np.inf]
    assert read_tolerances([one(0.1)], ROBOT.units).tolist() == [np.inf, 0.1]
    for none in (0.0, -1.0):
        assert read_tolerances([one(none)], ROBOT.units).tolist() == [np.inf, np.inf]
    with pytest.raises(MessageError, match='unknown joint'):
        read_tolerances([one(0.1, 'no_joint')], ROBOT.units)
    with pytest.raises(MessageError, match='not finite'):
        read_tolerances([one(np.nan)], ROBOT.units)


def test_the_tolerance_of_a_prismatic_joint_is_in_metres(tmp_path):
    units = Robot.load(write_robot(tmp_path, slider=True)).units
    tolerance = SimpleNamespace(name=units.names[-1], position=0.002, velocity=0.0)
    bounds = read_tolerances([tolerance], units)
    slider = np.eye(len(units))[-1]
    at, within, beyond = (units.to_theta((0.03 + off) * slider) for off in (0.0, 0.0019, 0.0021))
    assert (np.abs(within - at) <= bounds).all()
    assert not (np.abs(beyond - at) <= bounds).all()
