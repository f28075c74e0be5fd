# SPDX-License-Identifier: Apache-2.0
"""Both simulations (§III-F): one descent for each of N simulated arms.

    z = f_encode,2(T_sim, l_sim)
    L_sim,1 = w₄‖T‖₂ + w₅‖l − l_sim‖₂ + w₆‖τ_target + Gᵀ(θ_sim, T_sim) T‖₂                   (13)

and, where joints are forced to θ_fix,

    z = f_encode,3(θ_sim, l_sim)
    L_sim,2 = w₄‖T‖₂ + w₅‖l − l_sim‖₂ + w₇‖θ − θ_fix‖₂                                       (14)

    (θ_sim, T_sim) ← f_decode(z) after the descent (`latent_descent`)

The paper does not state the following, which we chose. l_sim is the commanded length l_target, as
the Japanese text says ("the muscle length sent to the robot"). The English text says "the current
muscle length in the current simulation", which can also be read as l_target − l_comp(T_sim), the
length at which muscle stiffness control carries T_sim. τ is in N·mm, as in (9). Only θ_sim and
T_sim are updated. τ_target = g(θ_sim) − JᵀF, plus the torque of the joints' springs. For a muscle
without a command, l_sim is its present length. θ_sim and T_sim are kept within the limits of joints
and modules, which bounds the iteration for any network. doc/results/paper.md compares the readings.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import LENGTH_SCALE, Mask
from musculoskeletal_ae.paper.constants import (
    LENGTH_WEIGHT,
    POSTURE_WEIGHT,
    SIMULATION_CANDIDATES,
    SIMULATION_EPOCHS,
    SIMULATION_LARGEST_STEP,
    TENSION_WEIGHT,
    TORQUE_WEIGHT,
)
from musculoskeletal_ae.paper.control import muscle_jacobian, torque_term
from musculoskeletal_ae.paper.latent_descent import Term, descend
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.equilibrium import PAID_OUT, ArmState
from musculoskeletal_ae.simulation.load import LoadTree

#: search for step sizes in the descent of both simulations with these constants
SEARCH = SIMULATION_LARGEST_STEP, SIMULATION_CANDIDATES, SIMULATION_EPOCHS  # of `descend`


class LatentSimulation:
    """Simulator of preset `paper`, which moves each arm by a descent in the latent space."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def use(self, mae: Mae, robot: Robot) -> None:
        """Use another network, and a robot that states which muscles are isolated now."""
        self._mae, self._robot = mae, robot.with_elasticity(mae.elasticity)
        self._load = LoadTree.of(self._robot.kinematics).load

    def step(
        self,
        state: ArmState,
        command: Array,
        h: float,  # noqa: ARG002 (in the paper one step is one descent, of no duration)
        wrench: Array,
        fixed: Array,
    ) -> ArmState:
        """Return the state of all arms after one descent for each of them.

        `SimulatedBody.step` describes the arguments. A descent has no duration, so `h` is not used.
        """
        load, _ = self._load(state.theta, wrench)
        length = np.where(command == PAID_OUT, state.length, command)
        # Limit commands to the whole length of the muscle, which exceeds every reasonable command.
        whole_length = self._robot.routes.length_at_zero
        length = np.clip(length, -whole_length, whole_length)
        arms = zip(state.theta, state.tension, length, load, fixed, strict=True)
        theta, tension, reached = map(np.stack, zip(*(self._descend(*arm) for arm in arms)))
        return ArmState(theta, tension, reached, length, np.zeros_like(theta), state.slid)

    def _descend(
        self, theta: Array, tension: Array, length: Array, torque: Array, fixed: Array
    ) -> tuple[Array, Array, Array]:
        """Return θ [rad] (D,), T [N] (M,) and l [m] (M,) of one arm after a descent.

        The arguments are the present θ and T, the length l_sim [m] (M,), τ_target [N·m] (D,), and
        the angles that joints are forced to [rad] (D,), NaN for a free joint.
        """
        robot, mae = self._robot, self._mae
        joints, muscles = robot.joint_count, robot.muscle_count
        row = np.eye(joints + 2 * muscles)
        tension_rows, length_rows = row[joints : joints + muscles], row[joints + muscles :]
        terms = [
            Term(TENSION_WEIGHT, tension_rows, np.zeros(muscles)),
            Term(LENGTH_WEIGHT, length_rows, LENGTH_SCALE * length),
        ]
        forced = np.flatnonzero(np.isfinite(fixed))
        if not len(forced):
            jacobian = muscle_jacobian(mae, theta, tension)
            terms.append(torque_term(TORQUE_WEIGHT, jacobian, tension_rows, torque))
            z = mae.encode(Mask.TENSION_LENGTH, tension=tension, length=length)
        else:
            terms.append(Term(POSTURE_WEIGHT, row[forced], fixed[forced]))
            z = mae.encode(Mask.THETA_LENGTH, theta=theta, length=length)
        state = mae.decode(descend(mae, z, terms, *SEARCH))
        least = robot.actuation.kept_tension
        return (
            np.clip(state.theta, robot.lower, robot.upper),
            np.clip(state.tension, least, robot.tension.max),
            state.length,
        )
