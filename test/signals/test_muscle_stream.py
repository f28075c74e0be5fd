# SPDX-License-Identifier: Apache-2.0
"""Processing of a message of the muscle modules."""

from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from readings import reading

from musculoskeletal_ae.messages.arrival import Arrival
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals import muscle_states
from musculoskeletal_ae.signals.body_state import BodyState, LengthOffsets
from musculoskeletal_ae.signals.friction import Transmission
from musculoskeletal_ae.signals.muscle_states import (
    QUANTITIES,
    MuscleReadings,
    Presence,
    Quantity,
)
from musculoskeletal_ae.signals.muscle_stream import MuscleStream, RejectionError
from musculoskeletal_ae.signals.reading_limits import LIMITS, longest_lengths

ROBOT = Robot.load('arm26')
M = ROBOT.muscle_count
HEALTHY = BodyState.healthy(M)
PERIOD = 0.01  # period of the messages [s]


def message(states):
    layout = SimpleNamespace(dim=[], data_offset=0)
    return SimpleNamespace(data=np.ravel(states).tolist(), layout=layout)


def resting(**changes):
    """Return plausible lengths, tensions and temperatures of resting muscles, (3, M).

    Each argument changes one value, such as length=(muscle, value).
    """
    states = np.stack([np.zeros(M), ROBOT.tension.bias, np.full(M, 30.0)])
    for row, quantity in enumerate(('length', 'tension', 'temperature')):
        if quantity in changes:
            muscle, value = changes[quantity]
            states[row, muscle] = value
    return states


def test_a_sound_message_becomes_a_sample_with_the_length_offset_removed():
    offset = np.linspace(-0.08, 0.08, M)
    body = HEALTHY.with_offsets(LengthOffsets.of(offset, np.zeros(M)))
    stream, states = MuscleStream(ROBOT, body), resting()
    states[0] += offset
    sample = stream.take(message(states), 1.5)
    np.testing.assert_allclose(sample.length, 0.0, atol=1e-15)
    np.testing.assert_allclose(sample.length_read, offset)
    np.testing.assert_allclose(sample.motor_tension, ROBOT.tension.bias)
    assert sample.time == 1.5 and sample.usable.all()


@pytest.mark.parametrize('isolated', [(), (1,)])
def test_an_optional_quantity_is_one_entry_of_the_table(monkeypatch, isolated):
    humidity = Quantity('%', 'impossible humidity', lambda _: (0.0, 100.0), Presence.OPTIONAL)
    monkeypatch.setattr(MuscleReadings, 'humidity', humidity, raising=False)
    humidity.__set_name__(MuscleReadings, 'humidity')
    monkeypatch.setattr(muscle_states, 'QUANTITIES', (*QUANTITIES, humidity))
    stream = MuscleStream(ROBOT, HEALTHY.with_isolated(isolated))
    percent = np.full(M, 24.0)
    read = reading(resting()).replace(humidity=percent)
    sample = stream.take(message(read.rows), 0.0)
    np.testing.assert_array_equal(sample.newest.humidity, percent)
    for lacking in (resting(), reading(resting()).rows):
        assert np.isnan(stream.take(message(lacking), 0.1).newest.humidity).all()
    with pytest.raises(RejectionError, match=r'impossible humidity: .* 190 %, legal: 0 to 100 %'):
        stream.take(message(read.replace(humidity=190.0).rows), 0.2)
    with pytest.raises(RejectionError, match='wrong length'):
        stream.take(message(resting()[:2]), 0.3)


@pytest.mark.parametrize('quantity', QUANTITIES, ids=lambda quantity: quantity.name)
def test_what_no_sound_sensor_reads_is_rejected_with_the_reason(quantity):
    lowest, highest = (np.broadcast_to(bound, M)[0] for bound in quantity.possible(ROBOT))
    beyond = highest + 0.01 * (highest - lowest)
    sound = reading(resting(tension=(0, 100.0)))
    reasons = {beyond: quantity.reason, np.inf: 'not finite'}
    if quantity.presence is Presence.REQUIRED:
        reasons[np.nan] = 'not finite'
    for value, reason in reasons.items():
        values = quantity.of(sound).copy()
        values[0] = value
        with pytest.raises(RejectionError) as rejection:
            MuscleStream(ROBOT).take(message(sound.replace(**{quantity.name: values}).rows), 0.0)
        assert rejection.value.reason == reason
    if quantity.presence is not Presence.REQUIRED:
        unknown = sound.replace(**{quantity.name: np.full(M, np.nan)})
        sample = MuscleStream(ROBOT).take(message(unknown.rows), 0.0)
        assert np.isnan(quantity.of(sample.newest)).all()


def test_an_isolated_muscle_may_read_anything():
    states = resting(length=(1, np.inf), tension=(1, 1e80), temperature=(1, 500.0))
    sample = MuscleStream(ROBOT, HEALTHY.with_isolated([1])).take(message(states), 0.0)
    assert not sample.usable[1] and np.isfinite(sample.motor_tension).all()


def test_a_ruptured_muscle_may_be_wound_in_beyond_any_posture_but_not_without_end():
    stream, shortest = MuscleStream(ROBOT), -longest_lengths(ROBOT)[0]
    end = shortest - LIMITS.slack_length_margin
    for n, length in enumerate(np.arange(0.0, end, -0.01)):
        stream.take(reading(resting(length=(0, length), tension=(0, 0.0))), n * PERIOD)
    with pytest.raises(RejectionError, match='length beyond what the joints allow'):
        stream.take(reading(resting(length=(0, end - 0.01), tension=(0, 0.0))), (n + 1) * PERIOD)


def test_lengths_are_not_judged_while_the_offsets_are_unknown():
    body = HEALTHY.with_offsets(LengthOffsets.unknown(M))
    stream = MuscleStream(ROBOT, body)
    for n, length in enumerate((0.0, 5.0)):
        stream.take(reading(resting(length=(0, length))), n * PERIOD)


def test_a_jump_of_one_length_is_rejected_until_it_has_lasted_and_names_its_muscle():
    stream, jumped, rejected = MuscleStream(ROBOT), [], 0
    for n in range(200):
        try:
            sample = stream.take(reading(resting(length=(1, 0.08 * (n >= 20)))), n * PERIOD)
        except RejectionError as rejection:
            rejected += rejection.reason == 'length jumped'
        else:
            jumped += sample.jumped
    assert jumped == [1]
    assert rejected * PERIOD == pytest.approx(LIMITS.settled, abs=0.05)


def test_a_jump_is_named_even_if_the_module_winds_the_length_back():
    stream, jumped = MuscleStream(ROBOT), []
    for n in range(300):
        length = max(0.08 - 0.25 * PERIOD * (n - 20), 0.0) if n >= 20 else 0.0
        with suppress(RejectionError):
            jumped += stream.take(reading(resting(length=(1, length))), n * PERIOD).jumped
    assert jumped == [1]


def test_a_length_that_jumps_back_is_accepted_at_once_although_the_arm_has_moved():
    stream, rejected = MuscleStream(ROBOT), []
    for n in range(150):
        states = resting(length=(1, 0.08 * (20 <= n < 60)))
        states[0, 2:] += 0.001 * n
        try:
            assert stream.take(reading(states), n * PERIOD).jumped == ()
        except RejectionError:
            rejected.append(n)
    assert rejected == [*range(20, 60)]


def test_a_rejected_message_contains_the_tensions_that_last():
    stream = MuscleStream(ROBOT, window=3)
    for n in range(30):
        states = resting(length=(1, 0.1 * (n >= 20)), tension=(1, 300.0))
        states[1, 2] = 400.0 * (n == 25)  # a glitch of a single message
        try:
            stream.take(reading(states), n * PERIOD)
        except RejectionError as rejection:
            plausible = rejection.plausible
    assert plausible.tension[1] == 300.0 and plausible.length[1] == 0.1
    assert plausible.tension[2] == 0.0


def jump_together(stream, size=0.05):
    """Make three lengths jump at once; return the muscles that the samples report as jumping."""
    jumped, stream_time = [], 0.0
    for n in range(200):
        stream_time += PERIOD
        states = resting()
        states[0, :3] += size * (n >= 20) * np.array([1.0, -1.0, 0.8])
        with suppress(RejectionError):
            jumped += stream.take(reading(states), stream_time).jumped
    return jumped


def test_lengths_that_jump_together_are_all_named():
    assert jump_together(MuscleStream(ROBOT)) == [0, 1, 2]


def taken(stream, deliveries):
    """Return for each message of muscle 1 whether a stream accepts it.

    Args:
        stream: The stream.
        deliveries: Time of reception [s], time of sending [s] and length of muscle 1 [m] of each
            message. The clock of the publisher is 50 s ahead.
    """
    arrival, accepted = Arrival(), []
    for received, sent, length in deliveries:
        arrival.receive(received, round(1e9 * (sent + 50.0)), arrival.number + 1)
        accepted.append(False)
        with suppress(RejectionError):
            stream.take(reading(resting(length=(1, length))), received, delay=arrival.delay)
            accepted[-1] = True
    return accepted


def steady(count=20):
    return [(n * PERIOD, n * PERIOD, 0.0) for n in range(count)]


def test_a_change_during_lost_messages_is_no_jump_even_if_the_message_before_was_late():
    # One message waits for 0.2 s, and the messages sent in the next 0.2 s are lost.
    bunch = [(0.4, 0.2, 0.0), (0.401, 0.4, 0.046), (0.41, 0.41, 0.047)]
    assert all(taken(MuscleStream(ROBOT), steady() + bunch))
    late = steady() + [(0.4, 0.4, 0.0), (0.401, 0.401, 0.046)]
    assert taken(MuscleStream(ROBOT), late)[-2:] == [True, False]


def test_the_clock_of_the_publisher_hides_no_jump():
    for step in (100.0, 0.3, -0.004, -100.0):
        jump = [(n * PERIOD, n * PERIOD + step, 0.03 + 0.02) for n in range(20, 30)]
        assert not any(taken(MuscleStream(ROBOT), steady() + jump)[20:])


def test_no_pause_of_the_sender_explains_a_change_beyond_that_of_the_longest_step():
    most = LIMITS.step + LIMITS.speed * LIMITS.longest_step
    for length, is_accepted in ((0.99 * most, True), (1.01 * most, False)):
        bunch = [(5.0, 0.2, 0.0), (5.001, 5.0, length)]
        assert taken(MuscleStream(ROBOT), steady() + bunch)[-1] == is_accepted


def test_hot_readings_that_arrive_apart_but_were_sent_together_are_not_believed():
    stream, arrival = MuscleStream(ROBOT), Arrival()
    for received, sent, degrees in ((0.0, 0.0, 199.0), (0.5, 0.01, 199.0), (0.51, 0.51, 30.0)):
        arrival.receive(received, round(1e9 * (sent + 1.0)), arrival.number + 1)
        states = resting(temperature=(0, degrees))
        sample = stream.take(reading(states), received, delay=arrival.delay)
        assert not sample.temperature[0] > 100.0


def test_a_hot_glitch_is_not_believed_however_long_the_arm_has_operated():
    stream = MuscleStream(ROBOT)
    for n, degrees in enumerate((*np.full(100, 30.0), 199.0)):
        sample = stream.take(reading(resting(temperature=(0, degrees))), 0.1 * n)
    assert sample.temperature[0] == 30.0


def jumps_of_a_restarting_module(pause, boots=0.5):
    """Return the muscles reported as jumping if module 1 restarts and then reads l = 0.

    Args:
        pause: Time without messages [s].
        boots: Time after the restart until the module pulls again; until then T = 0 [s].
    """
    stream, jumped = MuscleStream(ROBOT), []
    for n in range(700):
        time = n * PERIOD
        states = resting(length=(1, 0.09))
        if time >= 1.0:
            states[0, 1] = 0.0
            states[1, 1] *= time > 1.0 + pause + boots
        if not 1.0 <= time < 1.0 + pause:
            with suppress(RejectionError):
                jumped += stream.take(reading(states), time).jumped
    return jumped


@pytest.mark.parametrize('pause', [0.0, 0.2, 1.0])
@pytest.mark.parametrize('boots', [0.0, 0.5, 3.0])
def test_one_module_that_restarts_alone_is_reported_as_a_jump(pause, boots):
    assert jumps_of_a_restarting_module(pause, boots) == [1]


def test_a_jump_of_an_isolated_muscle_is_not_named():
    stream = MuscleStream(ROBOT, HEALTHY.with_isolated([1]))
    assert jump_together(stream) == [0, 2]


def test_implausible_messages_are_a_fault_once_they_outlast_a_glitch():
    stream = MuscleStream(ROBOT)
    hot = resting(temperature=(0, 500.0))
    for n in range(20):
        with pytest.raises(RejectionError):
            stream.take(reading(hot), n * PERIOD)
        lasts = n * PERIOD > LIMITS.glitch
        assert bool(stream.implausible(n * PERIOD)) == lasts
    stream.take(reading(resting()), 20 * PERIOD)
    assert stream.implausible(20 * PERIOD) == ''


def test_a_glitch_is_no_lasting_fault_because_the_next_message_is_late():
    stream = MuscleStream(ROBOT)
    for received, delay in ((0.0, 0.0), (0.3, 0.29)):
        with pytest.raises(RejectionError):
            stream.take(reading(resting(temperature=(0, 500.0))), received, delay=delay)
        assert stream.implausible(received) == ''
        assert stream.implausible(received + 0.25) == ''


def test_the_median_of_three_hides_a_glitch_that_the_newest_values_show():
    stream = MuscleStream(ROBOT, window=3)
    tension = ROBOT.tension.bias[0]
    for n, spike in enumerate((0.0, 0.0, 60.0, 0.0)):
        sample = stream.take(reading(resting(tension=(0, tension + spike))), n * PERIOD)
        assert sample.motor_tension[0] == pytest.approx(tension)
        assert sample.newest.tension[0] == pytest.approx(tension + spike)


def test_tendon_friction_is_removed_by_the_direction_of_sliding():
    stream = MuscleStream(ROBOT)
    stream.use_transmission(Transmission(np.full(M, 0.1)))
    for n in range(100):  # every tendon is wound in, so the motor-side tension exceeds T_end
        states = resting()
        states[0] -= 1e-4 * n
        sample = stream.take(reading(states), n * PERIOD)
    np.testing.assert_allclose(sample.sliding, 1.0, atol=1e-3)
    np.testing.assert_allclose(sample.bone_tension, np.exp(-0.1) * ROBOT.tension.bias, rtol=1e-3)


def test_samples_and_body_states_cannot_be_changed():
    sample = MuscleStream(ROBOT).take(reading(resting()), 0.0)
    for value, name in ((sample, 'length'), (HEALTHY, 'isolated')):
        with pytest.raises(AttributeError):
            setattr(value, name, None)


@given(st.sets(st.integers(0, M - 1)), st.sets(st.integers(0, M - 1)))
def test_a_body_state_isolates_exactly_the_stated_muscles(first, second):
    after = HEALTHY.with_isolated(first).with_isolated(second)
    assert np.flatnonzero(~after.used).tolist() == sorted(second)


@pytest.mark.parametrize('count', [1, 5])
@pytest.mark.parametrize('failed', [0.0, 0.0314, 0.05])
def test_failed_reads_of_all_motors_of_a_moving_arm_do_not_reject_what_follows(failed, count):
    """The value of a failed read may be so close to some lengths that only the way back jumps."""
    stream, used = MuscleStream(ROBOT), []
    time = PERIOD * np.arange(600)
    middle, half = 0.5 * (ROBOT.lower + ROBOT.upper), 0.5 * (ROBOT.upper - ROBOT.lower)
    theta = middle + 0.8 * half * np.sin(3.0 * time[:, None] + np.arange(ROBOT.joint_count))
    lengths = ROBOT.muscle_lengths(theta, np.tile(ROBOT.tension.bias, (len(time), 1)))
    for n, (now, length) in enumerate(zip(time, lengths)):
        states = resting()
        states[0] = failed if n % 90 in range(50, 50 + count) else length
        with suppress(RejectionError):
            stream.take(message(states), now)
            used.append(n)
    right = [n for n in range(len(time)) if n % 90 not in range(50, 50 + count)]
    assert set(right) <= set(used)


@pytest.mark.parametrize('wrong', [{'length': (0, np.nan)}, {'tension': (0, 9e3)}])
def test_an_arm_that_moves_while_one_sensor_fails_has_no_jump_afterwards(wrong):
    stream, reasons = MuscleStream(ROBOT), []
    for n in range(600):
        states = resting(**(wrong if 20 <= n < 520 else {}))
        states[0, 1:] += 0.1 * np.clip((n - 20) / 500, 0.0, 1.0)  # the arm sinks
        try:
            assert stream.take(reading(states), n * PERIOD).jumped == ()
        except RejectionError as rejection:
            reasons.append(rejection.reason)
    assert len(reasons) == 500 and 'length jumped' not in reasons
