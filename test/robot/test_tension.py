# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.robot.tension import TensionProgramme, least_tension

LOW, HIGH = 30.0, 200.0


@given(st.integers(0, 10_000), st.sampled_from([0.0, 60.0]))
def test_the_programme_finds_the_nearest_feasible_tension(seed, desired):
    rng = np.random.default_rng(seed)
    jacobian = rng.uniform(-0.06, 0.06, (8, 3))
    # Compute the torque from legal tensions, so that a solution exists.
    inside = rng.uniform(LOW, HIGH, 8)
    torque = -jacobian.T @ inside
    programme = TensionProgramme(jacobian, torque, LOW, HIGH)
    tension = programme.nearest(desired)
    np.testing.assert_allclose(-jacobian.T @ tension, torque, atol=1e-8)
    assert (tension >= LOW - 1e-8).all()
    assert (tension <= HIGH + 1e-8).all()
    # At the optimum of a convex problem, the cost does not decrease towards any other feasible
    # point.
    for other in [inside, programme.nearest(0.0), programme.nearest(150.0)]:
        assert (tension - desired) @ (other - tension) >= -1e-6


def test_a_torque_out_of_reach_is_refused():
    jacobian = np.array([[0.05], [-0.05]])
    with pytest.raises(InfeasibleError, match='within their limits'):
        TensionProgramme(jacobian, np.array([0.05 * 171.0]), LOW, HIGH).nearest(60.0)


def test_a_joint_without_muscles_and_without_load_is_held():
    jacobian = np.array([[0.05, 0.0], [-0.05, 0.0]])
    tension = TensionProgramme(jacobian, np.zeros(2), LOW, HIGH).nearest(60.0)
    np.testing.assert_allclose(tension, [60.0, 60.0])


def test_limits_may_differ_between_muscles():
    jacobian = np.array([[0.05], [-0.05], [0.05]])
    high = np.array([200.0, 200.0, 0.0])  # the third muscle is ruptured
    programme = TensionProgramme(jacobian, np.array([-1.0]), np.array([30.0, 30.0, 0.0]), high)
    np.testing.assert_allclose(programme.nearest(60.0), [70.0, 50.0, 0.0], atol=1e-6)


def test_torque_beyond_the_muscles_gives_the_nearest_tension_and_the_missing_torque():
    jacobian = np.array([[0.05, 0.0], [-0.05, 0.01], [0.0, -0.04]])
    torque = np.array([40.0, 0.5])
    nearest = least_tension(jacobian, torque, LOW, HIGH)
    np.testing.assert_allclose(nearest.missing_torque, torque + jacobian.T @ nearest.tension)
    for other in np.random.default_rng(0).uniform(LOW, HIGH, (200, 3)):
        assert (
            np.linalg.norm(nearest.missing_torque)
            <= np.linalg.norm(torque + jacobian.T @ other) + 1e-6
        )


@given(st.integers(0, 10_000), st.floats(0.0, 3.0))
def test_the_programme_is_solved_with_muscles_of_equal_bounds(seed, share):
    rng = np.random.default_rng(seed)
    jacobian = rng.uniform(-0.06, 0.06, (8, 3))
    torque = -share * jacobian.T @ rng.uniform(LOW, HIGH, 8)
    high = np.where(rng.random(8) < 0.5, LOW, HIGH)  # heat limits about half of them to T_bias
    tension, missing = least_tension(jacobian, torque, LOW, high)
    assert (tension >= LOW - 1e-6).all()
    assert (tension <= high + 1e-6).all()
    np.testing.assert_allclose(missing, torque + jacobian.T @ tension, atol=1e-6)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(bad):
    jacobian = np.array([[0.05], [-0.05]])
    with pytest.raises(InfeasibleError, match='finite'):
        least_tension(jacobian, np.array([bad]), LOW, HIGH)
    with pytest.raises(InfeasibleError, match='finite'):
        least_tension(jacobian, np.array([0.0]), LOW, np.array([HIGH, bad]))
    programme = TensionProgramme(jacobian, np.array([0.0]), LOW, HIGH)
    with pytest.raises(InfeasibleError, match='finite'):
        programme.minimum(np.full((2, 2), bad), np.zeros(2))
    with pytest.raises(InfeasibleError, match='finite'):
        programme.nearest(bad)
    jacobian[0, 0] = bad
    with pytest.raises(InfeasibleError, match='finite'):
        least_tension(jacobian, np.array([0.0]), LOW, HIGH)
