# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.signals.pairing import Pairing


def test_the_nearest_angle_within_half_a_period_is_paired():
    pairing = Pairing(0.01)
    pairing.joints(0.0, np.array([0.0]))
    assert pairing.muscles(0.001, 'message') is None
    pairing.joints(0.0115, np.array([1.0]))
    first = pairing.muscles(0.012, 'message')
    second = pairing.muscles(0.022, 'message')
    third = pairing.muscles(0.032, 'message')
    assert first.theta == [0.0]
    assert second.theta == [1.0]
    assert second.dt == pytest.approx(0.011)
    assert third.theta is None


def test_a_clock_that_jumps_back_restarts_the_pairing():
    pairing = Pairing(0.01)
    pairing.muscles(1.7e9, 'message')
    assert pairing.muscles(0.0, 'message') is None
    pairing.joints(0.0, np.array([2.0]))
    after = pairing.muscles(0.01, 'message')
    assert after.dt == 0.0
    assert after.theta == [2.0]


def test_an_angle_that_shows_first_that_the_clock_jumped_back_is_paired():
    pairing = Pairing(0.01)
    pairing.joints(1.7e9, np.array([1.0]))
    pairing.joints(0.0, np.array([2.0]))
    assert pairing.muscles(0.001, 'message') is None
    assert pairing.muscles(0.011, 'message').theta == [2.0]


def paired_live(joints, muscles, period):
    """Return the index of the joint message that is paired with each muscle message, or None.

    The messages are paired in the order in which they arrive.

    Args:
        joints: Times of the joint messages [s].
        muscles: Times of the muscle messages [s].
        period: Period of the muscle messages [s].
    """
    pairing = Pairing(period)
    given_out = []
    for time, kind, number in sorted(
        [(time, 0, n) for n, time in enumerate(joints)]
        + [(time, 1, n) for n, time in enumerate([*muscles, math.inf])]
    ):
        if kind == 0:
            pairing.joints(time, np.array([number]))
        elif paired := pairing.muscles(time, 'message'):
            given_out.append(None if paired.theta is None else int(paired.theta[0]))
    return given_out


def paired_by_definition(joints, muscles, period):
    """Return what `paired_live` should return, computed by the definition of pairing.

    A joint message belongs to the muscle message nearest to it in time. A muscle message is paired
    with the nearest of its joint messages that is at most half a period away; None if there is
    none.
    """
    owners = [min(muscles, key=lambda m: abs(m - time), default=None) for time in joints]
    return [
        min(
            (n for n, time in enumerate(joints) if owners[n] == m and abs(time - m) <= period / 2),
            key=lambda n: abs(joints[n] - m),
            default=None,
        )
        for m in muscles
    ]


times = st.lists(st.integers(0, 200), unique=True, max_size=30).map(sorted)


@given(times, times, st.integers(2, 40))
def test_each_angle_is_paired_once_with_the_message_it_is_nearest_to(joints, muscles, period):
    assert paired_live(joints, muscles, period) == paired_by_definition(joints, muscles, period)


@given(st.lists(st.tuples(times, st.integers(1, 7)), max_size=3), times, st.integers(2, 40))
def test_each_joint_is_paired_as_if_it_were_alone(publishers, muscles, period):
    """Several nodes publish different subsets of three joints."""
    sent = {}  # mask of the published joints, by time; no two messages have the same time
    for moments, joints in publishers:
        for time in moments:
            sent.setdefault(time, np.array([joints >> j & 1 for j in range(3)], dtype=bool))
    pairing, paired_theta = Pairing(period), []
    for time, kind in sorted([(time, 0) for time in sent] + [(m, 1) for m in [*muscles, math.inf]]):
        if kind == 0:
            pairing.joints(time, np.where(sent[time], float(time), np.nan))
        elif paired := pairing.muscles(time, 'message'):
            paired_theta.append(np.full(3, np.nan) if paired.theta is None else paired.theta)
    for j in range(3):
        own = sorted(time for time, which in sent.items() if which[j])
        alone = paired_by_definition(own, muscles, period)
        alone = [np.nan if n is None else own[n] for n in alone]
        np.testing.assert_array_equal([theta[j] for theta in paired_theta], alone)
