# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from bags import bag_samples as samples
from bags.arm_bag import JOINTS, Arm, joints
from musculoskeletal_ae.bags.playback import (
    TAUGHT_TOPIC,
    Timeline,
    lap,
    taught_motion,
    window,
)
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.timed_messages import TimedMessages
from musculoskeletal_ae.bags.topics import latched_topics
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.robot.robot import Robot

SECOND = 1_000_000_000


@pytest.mark.parametrize('rate', [0.25, 1.0, 8.0])
def test_recorded_time_passes_at_the_rate(rate):
    timeline = Timeline(5 * SECOND, rate, now=100.0)
    assert timeline.recorded(100.0) == 5 * SECOND
    assert timeline.recorded(102.0) == 5 * SECOND + 2 * rate * SECOND
    assert timeline.wait(6 * SECOND, 100.0) == pytest.approx(1 / rate)
    assert timeline.wait(6 * SECOND, 100.0 + 2 / rate) == pytest.approx(-1 / rate)


def test_paused_time_stands_still_and_goes_on_where_it_stood():
    timeline = Timeline(0, 1.0, now=10.0)
    timeline.hold(True, 12.0)
    assert timeline.recorded(50.0) == 2 * SECOND
    assert timeline.wait(2 * SECOND + 1, 50.0) == math.inf
    timeline.hold(False, 60.0)
    assert timeline.recorded(61.0) == 3 * SECOND
    timeline.hold(False, 61.0)
    assert timeline.recorded(61.0) == 3 * SECOND


def test_a_step_makes_everything_up_to_its_time_due():
    timeline = Timeline(0, 1.0, now=0.0)
    timeline.hold(True, 0.0)
    timeline.jump(7, 1.0)
    assert timeline.wait(7, 2.0) == 0.0
    assert timeline.wait(8, 2.0) == math.inf


def test_after_a_long_stop_of_the_process_it_goes_on_instead_of_catching_up():
    timeline = Timeline(0, 1.0, now=0.0)
    timeline.catch_up(SECOND, 1.9, longest=1.0)
    assert timeline.wait(2 * SECOND, 2.0) == 0.0
    timeline.catch_up(SECOND, 100.0, longest=1.0)
    assert timeline.wait(2 * SECOND, 100.0) == 1.0


@pytest.mark.parametrize('paused', [False, True])
def test_a_pause_of_the_recording_can_be_skipped(paused):
    timeline = Timeline(0, 1.0, now=0.0)
    timeline.hold(paused, 0.0)
    timeline.skip_pause(SECOND, 6 * SECOND, now=1.0)  # this is no pause
    assert timeline.recorded(1.0) == (0 if paused else SECOND)
    timeline.skip_pause(SECOND, 3601 * SECOND, now=1.0)
    assert timeline.wait(3601 * SECOND, 1.0) == (np.inf if paused else 0.5)


def test_pauses_are_found_in_the_messages_to_play(tmp_path, content):
    late = [each._replace(log_time=each.log_time + 3600 * SECOND) for each in content[40:]]
    samples.write_ours(tmp_path / 'paused', [*content[:40], *late])
    bag = Bag.open(tmp_path / 'paused')
    (pause,) = TimedMessages(bag, bag.topics).pauses
    assert (pause.begin, pause.end) == (content[39].log_time, late[0].log_time)
    assert 'jump forward by 60.0 min, 0.390 s after the start' in pause.text(bag.start)


def test_a_lap_is_everything_from_start_to_stop_in_order(bag, content):
    opened = Bag.open(bag)
    played = list(lap(TimedMessages(opened, opened.topics), opened.start, opened.end))
    assert [message.data for message in played] == [sample.data for sample in content]


def test_messages_that_a_recorder_wrote_in_bunches_are_played_as_they_were_published(
    tmp_path, content
):
    first = next(sample for sample in content if sample.topic.endswith('/muscle_states'))
    count, blocked = 120, 20
    recorded = []
    for n in range(count):
        sent = samples.START + n * samples.PERIOD
        # Of 40 messages, the recorder writes the second half late and together.
        late = blocked * samples.PERIOD - (n % 40 - blocked) * samples.PERIOD if n % 40 > 19 else 0
        log = sent + late + 3600 * SECOND  # the clock of the recorder is an hour ahead
        recorded.append(first._replace(log_time=log, publish_time=sent))
    samples.write_ours(tmp_path / 'bunched', recorded, 'none', finish=True)
    bag = Bag.open(tmp_path / 'bunched')
    timed = TimedMessages(bag, bag.topics)
    times = [message.log_time for message in lap(timed, bag.start, bag.end)]
    assert len(times) == count
    assert_array_equal(np.diff(times), samples.PERIOD)
    # A part that begins and ends among late messages is played completely.
    part = lap(timed, times[30], times[75])
    assert [message.log_time for message in part] == times[30:76]


def test_a_window_lies_within_the_bag(bag, content):
    opened = Bag.open(bag)
    first, last = content[0].log_time, content[-1].log_time
    assert window(opened, 0.0, None) == (first, last)
    assert window(opened, 0.1, 0.2) == (first + SECOND // 10, first + 3 * SECOND // 10)
    assert window(opened, 0.5, 100.0) == (first + SECOND // 2, last)
    with pytest.raises(BagError, match=r'is only 0.620 s long; choose a smaller --start'):
        window(opened, 1.0, None)


def test_what_was_latched_before_the_start_comes_first(bag, content):
    opened = Bag.open(bag)
    names = (
        'accepted_checkpoint', 'body_state', 'controller_mode', 'joint_sensor_trust',
        'mae_checkpoint', 'rejected_checkpoint', 'robot_description',
    )  # fmt: skip
    assert latched_topics(opened) == {f'/left_arm/{name}' for name in names}
    last = [next(s for s in content[39::-1] if s.topic.endswith(name)) for name in names]
    played = list(lap(TimedMessages(opened, opened.topics), content[40].log_time, opened.end))
    assert sorted(m.data for m in played[: len(names)]) == sorted(sample.data for sample in last)
    # These messages are due at the start, so that the recorded time does not run backwards.
    assert {m.log_time for m in played[: len(names)]} == {content[40].log_time - 1}
    assert [m.data for m in played[len(names) :]] == [sample.data for sample in content[40:]]


def motion(tmp_path, times, first=(), bunch=0):
    """Return the motion that a recorded demonstration contains.

    Args:
        tmp_path: Folder of the bag.
        times: Times at which the bag contains positions of the robot's joints [s].
        first: Times of messages that contain only an unknown joint [s].
        bunch: The recorder writes all messages of this time at its end [ns]; 0: at once.
    """
    arm = Arm(Robot.load('arm26'), count=1)
    for at in first:
        arm.add(f'/{TAUGHT_TOPIC}', JOINTS, at, joints(['other'], [0.1]))
    for at in times:
        arm.add(
            f'/{TAUGHT_TOPIC}', JOINTS, at, joints(['shoulder', 'elbow'], [0.5 + 0.1 * at, 1.0])
        )
    if bunch:
        arm.content = [
            sample._replace(log_time=-(-sample.log_time // bunch) * bunch) for sample in arm.content
        ]
    bag = Bag.open(arm.write(tmp_path / 'bag'))
    return taught_motion(bag, f'/{TAUGHT_TOPIC}', bag.start, bag.end)


def test_a_demonstration_contains_the_joints_that_most_messages_name(tmp_path):
    taught = motion(tmp_path, [0.02 * k for k in range(1, 101)], first=(0.005, 0.01))
    assert taught.joints == ('elbow', 'shoulder')
    assert taught.position[:, 0] == pytest.approx(1.0)
    assert taught.position[-1, 1] == pytest.approx(0.7, abs=0.02)


def test_a_demonstration_that_was_recorded_in_bunches_is_the_same_motion(tmp_path):
    times = [0.02 * k for k in range(1, 101)]
    regular = motion(tmp_path / 'regular', times)
    bunched = motion(tmp_path / 'bunched', times, bunch=SECOND // 2)
    assert bunched.time == pytest.approx(regular.time)
    assert bunched.position == pytest.approx(regular.position)


@pytest.mark.parametrize(
    ('times', 'problem'),
    [
        (
            [0.1 * k for k in range(20)] + [14.0, 14.1],
            'has a gap of 12.1 s, which begins 1.9 s after',
        ),
        ([0.9 * k for k in range(600)], 'lasts 539 s; legal: at most 500 s'),
        ([0.1, 0.2], 'no motion of at least'),
    ],
)
def test_a_motion_that_no_controller_could_follow_is_refused(tmp_path, times, problem):
    with pytest.raises(BagError, match=problem):
        motion(tmp_path, times)


def test_a_steady_motion_is_smoothed_to_itself(tmp_path):
    times = [0.01 * k for k in range(1, 1001)]
    taught = motion(tmp_path, times)
    middle = slice(10, -10)  # near the ends, the running mean has samples on one side only
    expected = 0.5 + 0.1 * (taught.time - taught.time[0] + times[0])
    np.testing.assert_allclose(taught.position[middle, 1], expected[middle], atol=1e-6)
