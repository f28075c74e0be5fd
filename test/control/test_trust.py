# SPDX-License-Identifier: Apache-2.0
"""Distorted, false or late messages never make the controller move the arm dangerously."""

from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from control_bench import COLD, DT, OTHER, REST, ROBOT, Bench, settled, values
from exact_mae import rest_readings
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from readings import reading

from musculoskeletal_ae.awake_clock import PAUSE
from musculoskeletal_ae.control.controller import WINDOW
from musculoskeletal_ae.control.supervisor import RESUME
from musculoskeletal_ae.control.watchdog import OVERHEATED, OVERLOAD_TIME, Overload
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.motion.activities import LENGTH
from musculoskeletal_ae.signals.body_state import Trust
from musculoskeletal_ae.signals.muscle_states import QUANTITIES
from musculoskeletal_ae.signals.reading_limits import LIMITS

TICK = 0.1 * DT  # largest change of a length command in one step under the rate limit [m]
MUSCLE = ROBOT.muscles[0]


class DistortingBench(Bench):
    """A bench that can falsify its messages."""

    def __init__(self, **chosen):
        super().__init__(first_duration=0.5, **chosen)
        self.lie = lambda read: read

    def send(self, read):
        with suppress(MessageError):
            super().send(self.lie(read))

    def pull(self, tension):
        """Raise or lower the tensions from their bias to `tension` [N] as fast as motors can."""
        before = np.full(ROBOT.muscle_count, ROBOT.tension.bias)
        for share in np.linspace(0.0, 1.0, 20):
            self.tension = before + share * (tension - before)
            self.step()

    def lies(self, count=1, **rows):
        """Run `count` steps with falsified messages; return the commands.

        `rows` has a function by the name of a quantity, which falsifies the values of that
        quantity.
        """

        def lie(read):
            names = [quantity.name for quantity in QUANTITIES]
            return np.array([rows.get(name, np.array)(row) for name, row in zip(names, read)])

        self.lie = lie
        sent = self.step(count)
        self.lie = lambda read: read
        return sent


def distorting(**chosen):
    """Return a bench whose arm rests at REST, with healthy messages so far."""
    return settled(kind=DistortingBench, **chosen)


def largest_step(before, sent):
    return np.abs(np.diff(values([before, *sent]), axis=0)).max()


ROWS = st.sampled_from(['length', 'tension', 'temperature'])
LIES = st.one_of(
    st.floats(-1e308, 1e308).map(lambda v: lambda row: np.full_like(row, v)),
    st.sampled_from([0.1, -0.1, 50.0, 400.0]).map(lambda v: lambda row: row + v),
    st.sampled_from([84.0, 90.0, 499.0]).map(lambda v: lambda row: np.full_like(row, v)),
)


@hypothesis_settings(max_examples=30)
@given(st.lists(st.tuples(ROWS, LIES, st.integers(1, 30)), min_size=1, max_size=4))
def test_no_bad_message_changes_a_command_by_more_than_the_rate_limit_allows(lies):
    bench = distorting()
    for row, lie, pause in lies:
        before = bench.core.limiter.command
        sent = bench.lies(1, **{row: lie}) + bench.step(pause)
        assert largest_step(before, sent) <= TICK + 1e-9
    assert bench.cause == ''


@pytest.mark.parametrize(
    ('row', 'lie', 'cause'),
    [
        ('length', lambda v: v + 0.1, 'length jumped'),
        ('length', lambda v: v * 0.0 + 1e308, 'length beyond what the joints allow'),
        ('tension', lambda v: v * 0.0 + 600.0, 'tension beyond the maximum'),
        ('tension', lambda v: v * 0.0 + 450.0, 'above 220 N for 0.2 s'),
        ('temperature', lambda v: v * 0.0 + 1e308, 'impossible temperature'),
        ('temperature', lambda v: v * 0.0 + 110.0, f'overheated: {MUSCLE}'),
    ],
)
def test_implausible_data_that_last_stop_the_arm_with_their_cause_and_no_jump(row, lie, cause):
    bench = distorting()
    before = bench.core.limiter.command
    sent = bench.lies(200 if 'overheated' in cause else 70, **{row: lie})
    assert cause in bench.condition
    assert bench.core.supervisor.mode != 'paused'
    assert cause in str(bench.core.reset(bench.now))
    steps = np.diff(values([before, *sent]), axis=0)
    assert steps.min() >= -TICK - 1e-9
    # A muscle above its tension limit may be paid out faster than the rate limit allows.
    assert 'above 220 N' in cause or steps.max() <= TICK + 1e-9
    bench.step(500 if 'overheated' in cause else 100)
    assert bench.core.reset(bench.now) is None
    bench.step(100)
    assert bench.report().message == 'holding'


@pytest.mark.parametrize('known', [[], [2]])
def test_modules_without_thermometers_do_not_stop_the_arm_and_a_hot_one_among_them_does(known):
    bench = distorting()
    bench.dt = 0.05
    bench.temperature = np.full(ROBOT.muscle_count, np.nan)
    bench.temperature[known] = 110.0
    bench.step(100)
    assert bench.condition[:10] == ('overheated' if known else '')
    warm = np.isin(np.arange(ROBOT.muscle_count), known)
    tension = ROBOT.tension
    np.testing.assert_array_equal(
        bench.core.watchdog.heat.planned, np.where(warm, tension.bias, tension.max)
    )


def test_an_estimate_far_outside_the_joints_is_not_used_and_stops_the_arm_if_it_lasts():
    bench = distorting()
    before = bench.core.limiter.command
    bench.blind = {'estimate'}
    for k in range(15):
        with pytest.raises(MessageError, match='outside the joint limits'):
            bench.core.estimated(REST + 22.0, bench.now)
        sent = bench.step()
        assert largest_step(before, sent) <= TICK + 1e-9
        before = sent[-1]
        assert not (bench.condition and k < 9)
    assert 'the estimate is implausible: θ far outside' in bench.condition


def test_a_glitch_of_temperature_changes_nothing_and_real_heat_pays_out_within_the_rate_limit():
    bench = distorting()
    bench.pull(np.full(ROBOT.muscle_count, 150.0))
    bench.step(300)
    limit, before = bench.core.watchdog.heat.planned.copy(), bench.core.limiter.command
    for hot in (84.0, 90.0, 200.0):
        sent = bench.lies(2, temperature=lambda t, hot=hot: t * 0.0 + hot) + bench.step(10)
        np.testing.assert_array_equal(bench.core.watchdog.heat.planned, limit)
        assert largest_step(before, sent) <= TICK + 1e-9
    bench.temperature = COLD + np.array([60.0, *[0.0] * (ROBOT.muscle_count - 1)])
    assert largest_step(before, bench.step(500)) <= TICK + 1e-9
    assert bench.core.watchdog.heat.planned[0] == ROBOT.tension.bias[0]


def test_temperatures_are_believed_only_as_fast_as_a_housing_can_warm():
    bench = distorting()
    bench.lies(3, temperature=lambda t: t * 0.0 + 199.0)
    bench.step(50)
    assert bench.cause == ''
    assert bench.core.watchdog.heat.heat.core.max() < COLD[0] + 1.0


def test_a_stop_by_overheating_can_be_reset_once_the_module_is_cool():
    bench = distorting()
    limit = bench.core.settings.temperature_limit
    bench.temperature = COLD.copy()
    bench.temperature[2] = limit + OVERHEATED + 1.0
    bench.step(500)
    assert bench.condition.startswith(f'overheated: {ROBOT.muscles[2]} 10')
    bench.temperature[2] = limit + 1.0
    bench.step(100)
    assert 'overheated' in str(bench.core.reset(bench.now))
    bench.temperature[2] = limit - 6.0
    bench.step(100)
    assert bench.core.reset(bench.now) is None
    bench.step(20)
    assert bench.cause == ''


def test_a_tension_that_stays_above_its_limit_releases_the_arm():
    bench = distorting(hold_time=5.0)
    tension = np.full(ROBOT.muscle_count, 60.0)
    bench.pull(tension)
    tension[[1, 3]] = 230.0
    bench.tension = tension
    before = bench.step(round(OVERLOAD_TIME / DT))[-1]
    assert bench.cause == ''
    after = bench.step(10)
    first, second = ROBOT.muscles[1], ROBOT.muscles[3]
    overload = f'tension of {first} above 220 N and {second} above 220 N for 0.2 s'
    assert bench.condition == f'overload, although the muscle is paid out: {overload}'
    assert (after[-1].value > before.value).any()  # paying out does not wait for hold_time
    bench.tension = None
    bench.step(120)
    assert bench.core.reset(bench.now) is None


def test_an_overload_lasts_although_some_messages_contain_impossible_tensions():
    bench = distorting()
    bench.pull(250.0)
    for _ in range(4):
        bench.step(5)
        bench.lies(3, tension=lambda row: row + 600.0)
    assert bench.cause == 'overload'


@pytest.mark.parametrize(
    ('peak', 'is_overload'),
    [
        ([(0.00, 0.00), (0.01, 0.01), (0.02, 0.02), (0.03, 0.03)], False),  # then a pause
        ([(0.00, 0.00), (0.25, 0.01), (0.25, 0.02), (0.25, 0.03)], False),  # a pause in the middle
        ([(0.10 * n, 0.10 * n) for n in range(4)], True),
        ([(0.00, 0.00), (0.29, 0.28), (0.29, 0.29)], True),
    ],
)
def test_a_peak_of_tension_is_no_overload_because_the_controller_pauses(peak, is_overload):
    overload, tension = Overload(ROBOT), np.full(ROBOT.muscle_count, 60.0)
    tension[3] = 230.0
    for received, sent in peak:
        overload.take(tension, 100.0 + received, received - sent)
    assert bool(overload.conditions(100.29)) == is_overload
    overload.take(np.full(ROBOT.muscle_count, 60.0), 100.3, 0.0)
    assert not overload.conditions(100.3)


# -- late messages, and no messages ---------------------------------------------------------------


@pytest.mark.parametrize('what', ['muscles', 'estimate'])
def test_data_that_are_late_briefly_stop_the_arm_and_it_resumes_by_itself(what):
    bench = distorting(max_age=0.2, hold_time=0.5)
    bench.core.explore(True)
    bench.step(50)
    bench.blind = {what}
    held = bench.step(60)  # data are stale after 0.2 s; the arm would be released after 0.7 s
    assert 'no usable' in bench.condition
    assert bench.report().level == 'warn'
    assert len({tuple(command.value) for command in held[25:]}) == 1
    bench.blind = set()
    back = bench.step(round(RESUME / DT) + 3)
    assert bench.cause == ''
    assert bench.core.supervisor.explores
    assert largest_step(held[-1], back + bench.step(100)) <= TICK + 1e-9


def test_data_that_stay_away_latch_the_stop_and_end_exploration():
    bench = distorting(max_age=0.2, hold_time=0.5)
    bench.core.explore(True)
    bench.step(50)
    bench.blind = {'muscles'}
    bench.step(80)
    bench.blind = set()
    bench.step(200)
    assert bench.cause == 'stale_muscle_states'
    assert bench.core.reset(bench.now) is None
    assert not bench.core.supervisor.explores


@pytest.mark.parametrize('pause', [0.6, 3600.0])
def test_after_a_pause_of_its_own_the_controller_goes_on_from_the_present_tensions(pause):
    """Its data is not stale, but the modules may have gone to T_bias, and the arm may sag."""
    bench = settled(max_age=0.2, hold_time=0.5)
    bench.target(OTHER)
    bench.step(100)
    assert pause > PAUSE
    bench.now += pause
    bench.tension = COLD
    length, tension = rest_readings(ROBOT, bench.theta, bench.tension)
    sent = bench.step(100)
    assert bench.cause == ''
    # The controller is silent until the filtered muscle states are certainly newer than the pause.
    assert sent[0] is None and None not in sent[WINDOW:]
    commands = values(sent[WINDOW:])
    demanded = ROBOT.actuation.demanded(length, commands[0])
    np.testing.assert_allclose(demanded, tension, atol=1e4 * TICK + 1e-6)
    assert np.abs(np.diff(commands, axis=0)).max() <= TICK + 1e-9


@pytest.mark.parametrize('pause', [0.6, 3600.0])
def test_data_that_ends_with_a_pause_of_the_controller_is_stale_soon_afterwards(pause):
    """Messages that are read between the pause and the next step must not count as newer."""
    bench = distorting(max_age=0.2, hold_time=0.5)
    bench.step()
    bench.now += pause
    bench.step()
    bench.blind = {'muscles'}
    bench.step(30)
    assert bench.cause == 'stale_muscle_states'


# -- clocks ---------------------------------------------------------------------------------------


@cache
def run(pace, gap=0.0, at=150, count=150):
    """Return commands and stop cause of a controller whose message clock runs at another pace.

    Args:
        pace: Seconds of the message clock per second of the controller's clock.
        gap: Time without messages [s].
        at: Number of the message before which the gap begins.
        count: Number of messages.
    """
    bench = Bench(first_duration=1.0, max_age=0.2)
    bench.target(OTHER)
    now, time, sent = 100.0, 5.0, []
    read = np.array([*rest_readings(ROBOT, REST), COLD])
    for k in range(count):
        # During the gap no message arrives, and only the watchdog's timer steps the controller.
        for _ in range(round(gap / DT) if k == at else 0):
            now, time = now + DT, time + pace * DT
            sent.append(bench.core.step(now, time))
        now, time = now + DT / pace, time + DT
        bench.core.take(reading(read), now)
        bench.core.estimated(REST, now)
        sent.append(bench.core.step(now, time))
    return values(sent), bench.condition


@pytest.mark.parametrize('pace', [0.3, 3.0])
def test_commands_follow_the_clock_of_the_messages_at_any_pace(pace):
    expected, _ = run(1.0)
    sent, cause = run(pace)
    assert cause == ''
    np.testing.assert_allclose(sent, expected, atol=1e-9)


@pytest.mark.parametrize(
    ('pace', 'gap', 'late'),
    [(3.0, 0.15, False), (0.3, 0.4, False), (0.3, 0.9, True)],
)
def test_the_age_limit_grows_with_a_slow_clock_and_never_shrinks(pace, gap, late):
    _, cause = run(pace, gap, at=200, count=201)
    assert ('no usable' in cause) is late


def causes(bench):
    return [each.identifier for each in bench.core.stop_conditions(bench.now)]


@pytest.mark.parametrize('is_confirmed', [True, False])
def test_during_an_anomaly_the_estimator_decides_whether_a_jump_is_due_to_a_repair(is_confirmed):
    bench = distorting()
    bench.find()
    bench.lies(round((LIMITS.settled + 0.5) / DT), length=with_a_jump)
    bench.lie = lambda read: np.array([with_a_jump(read[0]), *read[1:]])
    assert causes(bench) == ['anomaly_detected']
    body = bench.core.stream.body
    decided = (
        replace(body.offsets, deviation=body.offsets.deviation + 0.01)
        if is_confirmed
        else replace(body.offsets, trust=np.full(ROBOT.muscle_count, Trust.REVOKED))
    )
    bench.core.use_body(body.with_offsets(decided))
    bench.end_anomaly()
    bench.step(50)
    assert causes(bench) == ([] if is_confirmed else ['length_offsets_revoked'])
    assert (bench.core.reset(bench.now) is None) == is_confirmed


def with_a_jump(length):
    return length + 0.05 * (np.arange(len(length)) == 2)


@pytest.mark.parametrize('method', ['proposed', 'tension'])
def test_after_a_pause_of_a_stopped_controller_no_muscle_is_pulled_harder(method):
    bench = distorting(method=method)
    bench.stop()
    before = bench.step(20)[-1]
    bench.now += 2.0
    bench.tension = np.full(ROBOT.muscle_count, 150.0)  # somebody has moved the arm meanwhile
    sent = [command for command in bench.step(100) if command is not None]
    assert {command.kind for command in sent} == {before.kind}
    harder = before.value - values(sent)
    assert (harder if before.kind == LENGTH else -harder).max() <= 1e-9
