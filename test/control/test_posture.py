# SPDX-License-Identifier: Apache-2.0
"""The ramp to a target posture; `test_controller.py` tests the targets themselves."""

import numpy as np
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from musculoskeletal_ae.motion.ramps import Ramp

values = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@hypothesis_settings(max_examples=40)
@given(values, values, st.floats(0.0, 3.0), st.floats(0.01, 1.0))
def test_a_ramp_ends_at_the_goal_and_is_never_faster_than_the_limit(start, goal, duration, limit):
    ramp, before, steps = Ramp(start, goal, duration, limit), start, 0
    while not ramp.done:
        after = ramp.step(0.02)
        assert np.abs(after - before).max() <= limit * 0.02 + 1e-9
        before, steps = after, steps + 1
    np.testing.assert_allclose(before if steps else goal, goal, atol=1e-12)


def test_a_ramp_starts_and_ends_at_rest():
    ramp = Ramp(np.zeros(1), np.ones(1), 1.0, 100.0)
    sent = np.array([ramp.step(0.01)[0] for _ in range(100)])
    speed = np.diff(sent, prepend=0.0) / 0.01
    assert speed[0] < 0.05
    assert speed[-1] < 0.05
    np.testing.assert_allclose(speed.max(), 1.5, rtol=0.01)
