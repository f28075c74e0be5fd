# SPDX-License-Identifier: Apache-2.0
"""Shipped recordings: a demonstrated motion, a ruptured muscle, and another body."""

from pathlib import Path

import numpy as np

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import ROWS, Anomaly, BodyState

BAGS = Path(__file__).parents[2] / 'bags'


def series(bag, topic):
    """Return times [s] and messages of a topic."""
    messages = [(m.log_time * 1e-9, bag.decode(m)) for m in bag.messages([topic])]
    return np.array([time for time, _ in messages]), [message for _, message in messages]


def test_the_recorded_arm_was_moved_by_hand_and_repeated_the_motion():
    bag = Bag.open(BAGS / 'teaching')
    pushed, wrenches = series(bag, '/hardware_emulator/external_wrench')
    assert np.linalg.norm([wrenches[0].wrench.force.x, wrenches[0].wrench.force.z]) > 15.0
    times, states = series(bag, '/joint_states')
    theta = np.array([state.position for state in states])
    (sent,), (trajectory,) = series(bag, '/joint_trajectory')
    assert sent > pushed[-1]
    assert tuple(trajectory.joint_names) == tuple(states[0].name)

    def truly(at):
        return np.array([np.interp(at, times, joint) for joint in theta.T]).T

    spans = [point.time_from_start for point in trajectory.points]
    after = np.array([span.sec + 1e-9 * span.nanosec for span in spans])
    desired = np.array([point.positions for point in trajectory.points])
    assert np.ptp(desired, axis=0).max() > 0.3  # a hand moved the arm
    # Compare joint sensors: the arm's network knows the geometric model only, so its estimate is
    # inaccurate.
    shown = truly(pushed[0] - 1.0), truly(pushed[-1] + 1.0)
    begun, ended = truly(sent + after[0]), truly(sent + after[-1])
    moved = np.linalg.norm(shown[1] - shown[0])
    assert np.linalg.norm(begun - shown[0]) < 0.5 * moved
    assert np.linalg.norm(ended - shown[1]) < 0.5 * moved


def test_the_recorded_arm_lost_a_muscle_moved_on_and_used_it_again():
    bag = Bag.open(BAGS / 'isolation')
    at, messages = series(bag, '/body_state')
    rows = [np.reshape(message.data, (ROWS, -1)) for message in messages]
    bodies = [BodyState.of_rows(each) for each in rows]
    muscle = Robot.load('musashi_left_arm').muscles.index('deltoid_middle')
    isolated = [body.isolated for body in bodies]
    assert set(isolated) == {(), (muscle,)}
    lost = at[isolated.index((muscle,))]
    used_again = at[next(n for n in range(len(at)) if at[n] > lost and not isolated[n])]
    ended = at[next(n for n, body in enumerate(bodies) if body.anomaly is Anomaly.ENDED)]
    assert lost < ended < used_again
    times, states = series(bag, '/muscle_states')
    # The ten tensions [N] follow the ten lengths.
    tension = np.array([message.data[10 + muscle] for message in states])
    assert (tension[(times > lost) & (times < ended)] < 3.0).all()
    assert tension[times > used_again].max() > 100.0
    (sent,), (target,) = series(bag, '/target_joint_states')
    assert ended < sent < used_again
    times, states = series(bag, '/joint_states')
    where = np.array([state.position for state in states])[np.searchsorted(times, sent + 8.0)]
    # The arm misses the target a little, because its network knows the geometric model only.
    assert np.linalg.norm(where - target.position) < 0.3


def test_the_recorded_second_body_was_explored_until_a_muscle_pulled_too_much():
    bag = Bag.open(BAGS / 'foreign')
    times, states = series(bag, '/muscle_states')
    tension = np.array([message.data[10:20] for message in states])
    stopped = times[tension[:, 7] > 350.0][-1]  # muscle 7 is triceps_brachii
    _, states = series(bag, '/joint_states')
    moved = np.ptp([state.position for state in states], axis=0)
    assert moved.min() > 0.3 and stopped - times[0] > 150.0
    assert (tension[times > stopped + 10.0] < 50.0).all()  # all muscles are paid out to T_bias
