# SPDX-License-Identifier: Apache-2.0
"""`bench attack`: its evaluation, and a quick run."""

import random

import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from bench import attack
from bench.attack_graph import digest, filled
from bench.attack_kinds import KINDS, all_attacks

RATE = 0.1  # largest legal rate of length commands [m/s]
TIME = np.arange(50) * 0.01
NUMBER = np.arange(50)
NEVER = np.zeros((50, 2), dtype=bool)


def steps(value, number=NUMBER, eased=NEVER):
    return attack.changes(TIME, number, value, RATE, eased)


def test_commands_that_change_too_fast_are_found():
    ramp = np.stack([RATE * TIME, -RATE * TIME], axis=1)
    changes = steps(ramp)
    assert changes.too_fast == []
    assert changes.largest_in == pytest.approx(0.001) == changes.largest_out
    jump = ramp.copy()
    jump[20:, 1] -= 0.01
    (violation,) = steps(jump).too_fast
    assert 'muscle 1 changed by -11.0 mm' in violation
    assert steps(jump).largest_in == pytest.approx(0.011)
    # `largest_in` is the change in a single tick. Where a message is missing, only the change over
    # two ticks is known, so it does not count.
    assert steps(jump, NUMBER + (NUMBER >= 20)).largest_in == pytest.approx(0.001)
    assert steps(np.where(TIME[:, None] > 0.2, np.nan, ramp)).too_fast


def test_only_paying_out_a_muscle_that_pulls_too_much_may_be_faster():
    out, load = np.zeros((50, 2)), [(t, np.array([50.0, 300.0 * (t > 0.15)])) for t in TIME]
    out[20:] += 0.02
    eased = attack.relieved(TIME, load, 200.0, 2)
    (violation,) = steps(out, eased=eased).too_fast
    assert 'muscle 0' in violation
    assert len(steps(-out, eased=eased).too_fast) == 2


def test_the_longest_overload_and_the_winding_in_of_a_stopped_arm_are_measured():
    loads = [(t, np.array([300.0 * (0.1 < t < 0.35), 10.0])) for t in TIME]
    np.testing.assert_allclose(attack.overloads(loads, 220.0), [0.23, 0.0], atol=1e-9)
    out_and_in = np.stack([np.minimum(TIME, 0.2), 0.0 * TIME], axis=1)
    out_and_in[30:, 0] -= 0.01
    assert attack.wound_in(TIME, out_and_in, 0.0, 1.0) == pytest.approx(0.01)
    assert attack.wound_in(TIME, out_and_in, 0.0, 0.29) == 0.0
    assert attack.without(TIME, [(0.1, 0.4)]).sum() == np.sum((TIME < 0.1) | (TIME > 0.4))


def test_every_known_attack_is_tried_at_every_moment():
    attacks = all_attacks()
    assert len(set(attacks)) == len(attacks) == 2 * sum(map(len, KINDS.values()))


def test_hostile_messages_can_be_sent_and_recognised():
    rng = random.Random(0)
    for kind in (Float64MultiArray, UInt8MultiArray):
        messages = [filled(kind(), rng) for _ in range(50)]
        assert len({digest(message) for message in messages}) > 10
    assert digest(Float64MultiArray(data=[1.0])) == digest(Float64MultiArray(data=[1.0]))


@pytest.mark.thorough
@pytest.mark.usefixtures('both_cores')
def test_a_quick_attack_breaks_no_promise(trained_file, tmp_path, capsys):
    # The arm recovers from this kind of attack within seconds.
    options = ['--quick', '--kinds', 'false isolation', '--initial', trained_file]
    status = attack.main([*options, '--out', str(tmp_path)])
    assert status == 0, capsys.readouterr().out
