# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from musculoskeletal_ae.pairing import Pairing


def test_the_nearest_angle_within_half_a_period_is_paired():
    pairing = Pairing(0.01)
    pairing.joints(0.0, np.array([0.0]))
    assert pairing.muscles(0.001, np.ones(1), np.ones(1)) is None
    pairing.joints(0.0115, np.array([1.0]))
    first = pairing.muscles(0.012, np.ones(1), np.ones(1))
    second = pairing.muscles(0.022, np.ones(1), np.ones(1))
    third = pairing.muscles(0.032, np.ones(1), np.ones(1))
    assert first.theta == [0.0]
    assert second.theta == [1.0]
    assert second.dt == pytest.approx(0.011)
    assert third.theta is None


def test_a_clock_that_goes_back_starts_pairing_anew():
    pairing = Pairing(0.01)
    pairing.muscles(1.7e9, np.ones(1), np.ones(1))
    assert pairing.muscles(0.0, np.ones(1), np.ones(1)) is None
    pairing.joints(0.0, np.array([2.0]))
    after = pairing.muscles(0.01, np.ones(1), np.ones(1))
    assert after.dt == 0.0
    assert after.theta == [2.0]
