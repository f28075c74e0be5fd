# SPDX-License-Identifier: Apache-2.0
"""Muscle tensions that produce a joint torque, by quadratic programming.

    hard:   min ‖T − T_desired‖²         subject to   −Gᵀ T = τ,   T_low ≤ T ≤ T_high
    soft:   min ‖τ + Gᵀ T‖² + ε ‖T‖²     subject to                T_low ≤ T ≤ T_high

(Kawamura 2016). T are the tensions, τ is the joint torque and G = ∂l/∂θ the muscle Jacobian. The
hard form produces exactly the torque τ. The soft form comes as near to τ as possible, with a small
weight ε on the tensions.

Where a joint is at a stop (`joint_stops`), the stop provides a part f of the torque, which the
programme chooses together with T:

    −Gᵀ T + f = τ,   0 ≤ f_j ≤ STOP_TORQUE at a lower stop,   −STOP_TORQUE ≤ f_j ≤ 0 at an upper one

f_j is 0 for all other joints. A newton metre of f costs no more than a newton of tension, so a
joint at its stop leans on it. The plan of a path and that of the tensions along it use these same
stops.

T_desired = 0 gives the least tension that holds τ; the control experiment reports it as the QP
bound. `check_robot` uses T_desired = 0.3 T_limit, the tension of a well-tensed arm.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import quadprog

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.robot.robot import Robot

#: leave at least this gap between the limits of a muscle [N]; without it, rounding would make the
#: problem infeasible for quadprog if a muscle is fixed at one tension (hot, ruptured)
LEAST_GAP = 1e-8
#: ε [(N·m/N)²]; with torques of some N·m and tensions of some hundred N, the second term is small
SOFT_WEIGHT = 1e-7
STOP_TORQUE = 100.0  # let a stop support a joint with at most this torque [N·m]


class Exertion(NamedTuple):
    """Tensions, and the part of the required torque that they do not produce."""

    tension: Array  # tensions T [N], (M,)
    missing_torque: Array  # part of τ that neither T nor the stops produce [N·m], (D,)


class TensionProgramme:
    """Quadratic programmes over the tensions that produce a torque within limits.

    All methods raise an `InfeasibleError` if no tension meets the constraints. The constructor and
    `minimum` also raise it if an entry is not finite, because quadprog would silently return zeros.
    """

    def __init__(
        self,
        muscle_jacobian: Array,
        torque: Array,
        low: Array | float,
        high: Array | float,
        stops: Array | None = None,
    ) -> None:
        """Set the constraints.

        Args:
            muscle_jacobian: Muscle Jacobian ∂l/∂θ [m/rad], (M, D).
            torque: Joint torque to produce [N·m], (D,).
            low: Lowest tensions [N], scalar or (M,).
            high: Highest tensions [N], scalar or (M,).
            stops: The joint stops that provide a part of the torque (`supporting_stops`), (S, D);
                None if the muscles have to provide all of it.
        """
        self._muscles, self._torque = len(muscle_jacobian), torque
        self._jacobian = muscle_jacobian
        if stops is not None:  # a stop is a further muscle, whose tension is the torque f
            self._jacobian = np.concatenate([muscle_jacobian, stops])
        self._eye, limits = _unit(len(self._jacobian))
        self._constraints = np.concatenate([-self._jacobian, limits], axis=1)
        least = self._with_stops(low, 0.0)
        most = np.maximum(self._with_stops(high, STOP_TORQUE), least + LEAST_GAP)
        self._bounds = np.concatenate([torque, least, -most])
        _require_finite(self._constraints, self._bounds)

    def _with_stops(self, of_muscles: Array | float, of_stops: float) -> Array:
        """Return values of the muscles, scalar or (M,), followed by one value for each stop."""
        values = np.full(len(self._jacobian), of_stops)
        values[: self._muscles] = of_muscles
        return values

    def minimum(self, quadratic: Array, linear: Array) -> Array:
        """Return the T [N] (M,) that minimises ½ Tᵀ Q T − aᵀ T and produces exactly the torque.

        The torque of a stop costs as little as the tension that costs least.

        Args:
            quadratic: Q, (M, M).
            linear: a, (M,).
        """
        _require_finite(quadratic, linear)
        whole = quadratic.diagonal().min() * self._eye
        whole[: self._muscles, : self._muscles] = quadratic
        return self._solution(whole, self._with_stops(linear, 0.0))[: self._muscles]

    def _solution(self, quadratic: Array, linear: Array, hard: bool = True) -> Array:
        """Return the minimum over the tensions and the torques of the stops, (M + S,).

        If `hard` is false, they need not produce the torque, and only their limits apply.
        """
        equalities = len(self._torque) if hard else 0
        first = len(self._torque) - equalities
        constraints, bounds = self._constraints[:, first:], self._bounds[first:]
        try:
            return quadprog.solve_qp(quadratic, linear, constraints, bounds, equalities)[0]
        except ValueError as error:
            torque = ', '.join(f'{value:.2f}' for value in self._torque.tolist())
            problem = f'no tensions within their limits produce the joint torques ({torque}) N·m'
            raise InfeasibleError(problem) from error

    def nearest(self, desired: Array | float) -> Array:
        """Return the tensions that produce exactly the torque [N], (M,).

        Of all such tensions, those nearest to `desired` [N], scalar or (M,), are returned.
        """
        _require_finite(desired)
        return self._solution(self._eye, self._with_stops(desired, 0.0))[: self._muscles]

    def compromise(self) -> Exertion:
        """Return the tensions within the limits that come nearest to producing the torque.

        If several tensions come equally near, the lowest of them are returned.
        """
        jacobian = self._jacobian
        quadratic = jacobian @ jacobian.T + SOFT_WEIGHT * self._eye
        exerted = self._solution(quadratic, -jacobian @ self._torque, hard=False)
        return Exertion(exerted[: self._muscles], self._torque + jacobian.T @ exerted)


def holding_tension(
    robot: Robot, theta: Array, desired: Array | float = 0.0, jacobian: Array | None = None
) -> Array:
    """Return tensions [N] (M,) within [T_bias, T_limit] that hold a posture.

    Args:
        robot: The robot, with the tension limits of its muscles.
        theta: Joint angles θ of the posture [rad], (D,).
        desired: Desired tension [N], scalar or (M,). Of all tensions that hold the posture, the one
            nearest to it is returned.
        jacobian: Muscle Jacobian G [m/rad], (M, D); by default computed by the geometric model.

    Raises:
        InfeasibleError: If no tension within the limits holds the posture, or if an entry is not
            finite.
    """
    jacobian = robot.routes.muscle_jacobian(theta) if jacobian is None else jacobian
    torque, limits = robot.kinematics.holding_torque(theta), robot.tension
    return TensionProgramme(jacobian, torque, limits.bias, limits.limit).nearest(desired)


def least_tension(
    muscle_jacobian: Array,
    torque: Array,
    low: Array | float,
    high: Array | float,
    desired: Array | float = 0.0,
    stops: Array | None = None,
) -> Exertion:
    """Return tensions that produce a joint torque or, if that is impossible, come nearest to it.

    Args:
        muscle_jacobian: Muscle Jacobian ∂l/∂θ [m/rad], (M, D).
        torque: Joint torque to produce [N·m], (D,).
        low: Lowest tensions [N], scalar or (M,).
        high: Highest tensions [N], scalar or (M,).
        desired: Desired tensions [N], scalar or (M,). Of all tensions that produce the torque,
            those nearest to the desired tensions are returned.
        stops: The joint stops that provide a part of the torque (`supporting_stops`), (S, D); None
            if the muscles have to provide all of it.

    Raises:
        InfeasibleError: If an entry is not finite.
    """
    programme = TensionProgramme(muscle_jacobian, torque, low, high, stops)
    try:
        return Exertion(programme.nearest(desired), np.zeros(len(torque)))
    except InfeasibleError:
        return programme.compromise()


@cache
def _unit(count: int) -> tuple[Array, Array]:
    """Return the unit matrix (M, M), and the constraint matrix of lower and upper limits (M, 2M).

    The arrays are cached, so the caller must not change them.
    """
    eye = np.eye(count)
    return eye, np.hstack([eye, -eye])


def _require_finite(*parts: Array | float) -> None:
    if not all(np.isfinite(part).all() for part in parts):
        raise InfeasibleError('a muscle Jacobian, torque or limit is not finite')
