# SPDX-License-Identifier: Apache-2.0
"""Pauses of this process do not count as silence of other nodes."""

import pytest

from musculoskeletal_ae.awake_clock import AwakeClock


def test_time_passes_as_usual_while_the_process_runs():
    clock = AwakeClock(0.3)
    for tick in range(100):
        clock.tick(0.1 * tick)
    assert clock.at(9.95) == pytest.approx(9.95)


@pytest.mark.parametrize('pause', [1.0, 60.0])
def test_a_pause_counts_like_the_longest_step_whether_it_is_ticked_or_read_first(pause):
    clock = AwakeClock(0.3)
    clock.tick(10.0)
    before_tick = clock.at(10.0 + pause)
    clock.tick(10.0 + pause)
    assert before_tick == clock.at(10.0 + pause) == pytest.approx(10.3)


def test_before_the_first_tick_all_time_counts():
    clock = AwakeClock(0.3)
    assert clock.at(50.0) - clock.at(0.0) == 50.0
