# SPDX-License-Identifier: Apache-2.0
"""Columns in a wrong place or with a wrong sign are named, and healthy ones never are."""

from itertools import combinations

import numpy as np
import pytest

from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.wiring import Wiring, decide, judge

ROBOTS = {name: Robot.load(name) for name in ('arm26', 'musashi_left_arm')}


def readings(name, seed, count=200):
    """Return θ, l and T of an emulated individual in random postures, with length offsets."""
    robot, rng = ROBOTS[name], np.random.default_rng(seed)
    theta = robot.random_postures(count, rng)
    individual = Individual(robot, seed)
    tension = rng.uniform(20.0, 60.0, (count, robot.muscle_count))
    stretched = robot.muscle_lengths(theta, tension) - robot.routes.relative_lengths(theta)
    length = individual.absolute_lengths(theta) - individual.length_at_zero + stretched
    return theta, length + rng.uniform(-0.1, 0.1, robot.muscle_count), tension


def judged(name, wiring, theta, length, tension, **options):
    """Judge readings whose columns are wired in this way."""
    into = list(wiring.order)
    columns = np.array(wiring.sign) * length[:, into]
    return judge(ROBOTS[name].muscle_lengths, theta, columns, tension[:, into], **options)


@pytest.mark.parametrize('name', ROBOTS)
@pytest.mark.parametrize(
    'seed', [0, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2))]
)
def test_every_exchange_and_every_reversed_sign_is_named(name, seed):
    straight, data = Wiring.straight(ROBOTS[name].muscle_count), readings(name, seed)
    assert not judged(name, straight, *data).is_faulty
    for j, k in combinations(range(ROBOTS[name].muscle_count), 2):
        found = judged(name, straight.exchanged(j, k), *data)
        assert found.wiring == straight.exchanged(j, k)
        assert not {j, k} & set(found.right)
    for j in range(ROBOTS[name].muscle_count):
        assert judged(name, straight.reversed(j), *data).wiring == straight.reversed(j)


def test_several_faults_are_named_together():
    straight = Wiring.straight(10)
    wiring = straight.exchanged(0, 4).exchanged(2, 7).reversed(9)
    found = judged('musashi_left_arm', wiring, *readings('musashi_left_arm', 0))
    assert found.wiring == wiring
    assert found.text('abcdefghij') == (
        'the readings of a and e are exchanged, and the readings of c and h are exchanged, and the '
        'length of j has the wrong sign'
    )


def test_an_arm_at_rest_shows_no_fault():
    theta, length, tension = (rows[:1].repeat(30, axis=0) for rows in readings('arm26', 0))
    assert not judged('arm26', Wiring.straight(6).exchanged(0, 3), theta, length, tension).is_faulty


def test_muscles_of_equal_moment_arms_are_called_undetermined():
    theta, _, tension = readings('arm26', 0)
    robot = ROBOTS['arm26']

    def lengths(theta, tension):  # muscle 1 equals muscle 2
        modelled = robot.muscle_lengths(theta, tension)
        modelled[:, 1] = modelled[:, 2]
        return modelled

    exact, into = lengths(theta, tension), [2, 1, 0, 3, 4, 5]
    found = judge(lengths, theta, exact[:, into], tension[:, into], signs=False)
    texts = {wiring.text('abcdef') for wiring in found.alternatives}
    expected = {f'the readings of a and {other} are exchanged' for other in 'bc'}
    assert texts <= expected and found.is_faulty
    # If the readings of muscle 0 are in both columns 1 and 2, either of the two may be exchanged.
    into = [2, 0, 0, 3, 4, 5]
    found = judge(lengths, theta, exact[:, into], tension[:, into], signs=False)
    assert {wiring.text('abcdef') for wiring in found.alternatives} == expected
    assert found.text('abcdef').endswith('(undetermined)')
    # Exchanging the equal muscles themselves changes nothing, so no fault is reported.
    assert not judge(lengths, theta, exact[:, [0, 2, 1, 3, 4, 5]], tension).is_faulty


def test_a_wiring_puts_columns_into_the_order_of_the_muscles():
    wiring = Wiring((1, 2, 0), (1, -1, 1))  # column 0 shows muscle 1, and so on
    muscles = np.array([10.0, 20.0, 30.0])
    columns = np.array(wiring.sign) * muscles[list(wiring.order)]
    np.testing.assert_array_equal(wiring.signed(columns), muscles)


def test_wirings_of_similar_cost_are_alternatives():
    straight = Wiring.straight(4)
    first, second, bad = straight.exchanged(0, 1), straight.exchanged(0, 2), straight.reversed(3)
    found = decide(straight, 4.0, [(second, 1.05), (first, 1.0), (bad, 3.9)])
    assert found.alternatives == (first, second) and found.faulty == (0, 1, 2)
    assert 'undetermined' in found.text('abcd')
    assert not decide(straight, 1.05, [(first, 1.0)]).is_faulty
