# SPDX-License-Identifier: Apache-2.0
"""Shipped recordings: a demonstrated motion, a ruptured muscle, and another body."""

from pathlib import Path

import numpy as np

from musculoskeletal_ae.bags.reader import Bag

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
    at, names = series(bag, '/isolated_muscles')
    assert [message.data for message in names] == ['', 'deltoid_middle', '']
    noticed, detected = series(bag, '/anomaly_detected')
    assert [message.data for message in detected] == [False, True, False]
    times, states = series(bag, '/muscle_states')
    tension = np.array([message.data[10] for message in states])  # T of the first muscle [N]
    assert (tension[(times > at[1]) & (times < noticed[2])] < 3.0).all()
    assert tension[times > at[2]].max() > 100.0
    (sent,), (target,) = series(bag, '/target_joint_states')
    assert noticed[2] < sent < at[2]
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
