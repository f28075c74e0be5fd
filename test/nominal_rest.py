# SPDX-License-Identifier: Apache-2.0
"""Compares the rest of the simulator, and its response to pushes, with the nominal body.

The simulator (paper, section "Simulation") uses a network trained on the geometric model. The
nominal body is that model: either the emulated arm without individual differences and friction, or
a solution of the equations of its rest,

    T = T_bias + max(0, K_stiff (l(θ, T) − l_target)),   g(θ) − JᵀF + Gᵀ T = τ_stop

g is the torque that holds the weight, F a wrench on the end effector, J the Jacobian of the end
effector, G = ∂l/∂θ, and τ_stop the torque of the joint stops. The equations are needed to hold
joints at an angle, which the emulated arm cannot.
"""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.kin.arm import STOP_STIFFNESS, EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension
from musculoskeletal_ae.simulation.simulation import Simulation

STEP = 0.01  # time step of the simulator [s]
STILL = 1e-4  # joint speed below which the arm counts as still [rad/s]
LONGEST_WAIT = 20.0  # longest time until the arm is still [s]
TENSION_UNIT = 100.0  # unit in which the unknown tensions are about as large as the angles [N]
FLEXED, FLEXION = 'elbow_pitch', np.radians(-90.0)
FORCED, FORCED_TO = 'shoulder_pitch', np.radians(30.0)
#: smallest motion of a joint of the nominal body that is compared with that of the simulator [rad]
NOTICEABLE = 0.05


def random_commands(robot: Robot, count: int, seed: int) -> Array:
    """Return l_target [m] (count, M) of random holdable postures with random tensions."""
    rng = np.random.default_rng(seed)
    commands: list[Array] = []
    while len(commands) < count:
        theta = robot.random_postures(1, rng)[0]
        least, most = robot.tension.bias, 0.6 * robot.tension.limit
        desired = least + rng.uniform() * (most - least)
        try:
            tension = holding_tension(robot, theta, desired)
        except InfeasibleError:
            continue
        commands.append(robot.muscle_lengths(theta, tension) + msc_compensation(robot, tension))
    return np.array(commands)


def settle_arm(arm: EmulatedArm, command: Array) -> tuple[Array, Array]:
    """Hold a command until the emulated arm is still; return true θ [rad] and T [N]."""
    for _ in range(round(LONGEST_WAIT / 0.1)):
        arm.command_length(command)
        arm.step(0.1)
        if np.abs(arm.velocity).max() < STILL:
            break
    return arm.theta.copy(), arm.tension


def rest_errors(
    robot: Robot, mae: Mae, preset: str, commands: Array
) -> tuple[Array, Array, Array, Array]:
    """Return how far the simulator's rest is from that of the nominal body, and how it drifts.

    Returns:
        The differences of θ [rad] (N, D) and of T [N] (N, M) at rest, as absolute values, and the
        largest later departures of θ [rad] and T [N] from the simulator's own rest, each (N,).
    """
    body = Individual(robot, 0, NOMINAL)
    simulated = Simulation(robot, mae, preset, len(commands))
    true = []
    for command in commands:
        arm = EmulatedArm(robot, 0, body)
        true.append(settle_arm(arm, command))
    theta, tension = (np.stack(part) for part in zip(*true, strict=True))
    # Simulated and emulated arms start hanging, and follow the same command.
    simulated.command = commands
    rest = simulated.settle()
    drift, tension_drift = np.zeros((2, len(commands)))
    for _ in range(1000):
        state = simulated.step(STEP)
        drift = np.maximum(drift, np.abs(state.theta - rest.theta).max(axis=1))
        moved = np.abs(state.tension - rest.tension).max(axis=1)
        tension_drift = np.maximum(tension_drift, moved)
    return np.abs(rest.theta - theta), np.abs(rest.tension - tension), drift, tension_drift


class Rest(NamedTuple):
    """A solution of the equations of rest: θ [rad] (D,), T [N] (M,), and the largest residual."""

    theta: Array
    tension: Array
    residual: float


def nominal_rest(
    robot: Robot,
    command: Array,
    theta: Array,
    tension: Array,
    wrench: Array,
    fixed: Array,
) -> Rest:
    """Return the solution of the equations of rest that the search finds from θ and T.

    Args:
        robot: The geometric model.
        command: l_target [m], shape (M,).
        theta: θ at which the search starts [rad], shape (D,).
        tension: T at which the search starts [N], shape (M,).
        wrench: F on the end effector [N, N·m], axes of the root link, shape (6,).
        fixed: Angles of joints that are held [rad], shape (D,); nan for a free joint.
    """
    from scipy.optimize import least_squares

    free = np.isnan(fixed)
    posture = np.where(free, theta, fixed)
    bias, most = robot.tension.bias, robot.tension.max
    kin = robot.kinematics

    def unpack(unknown: Array) -> tuple[Array, Array]:
        full = posture.copy()
        full[free] = unknown[: free.sum()]
        return full, TENSION_UNIT * unknown[free.sum() :]

    def residual(unknown: Array) -> Array:
        angles, pull = unpack(unknown)
        wound = robot.stiffness * (robot.muscle_lengths(angles, pull) - command)
        msc = pull - np.clip(bias + wound, bias, most)
        torque = kin.holding_torque(angles) - kin.end_effector_jacobian(angles).T @ wrench
        torque = torque + robot.routes.muscle_jacobian(angles).T @ pull
        beyond = angles - np.clip(angles, robot.lower, robot.upper)
        torque = torque + STOP_STIFFNESS * beyond
        return np.concatenate([torque[free], msc / TENSION_UNIT])

    start = np.concatenate([posture[free], tension / TENSION_UNIT])
    solved = least_squares(residual, start, x_scale='jac', max_nfev=500)
    return Rest(*unpack(solved.x), float(np.abs(solved.fun).max()))


class Response(NamedTuple):
    """Responses of body and simulator to a push or a forced joint, from the same rest.

    Attributes:
        name: Name of the push or the forced joint.
        body: Δθ of the body [rad], shape (D,).
        simulated: Δθ of the simulator [rad], shape (D,).
        body_tension: ΔT of the body [N], shape (M,).
        simulated_tension: ΔT of the simulator [N], shape (M,).
    """

    name: str
    body: Array
    simulated: Array
    body_tension: Array
    simulated_tension: Array


def responses(robot: Robot, mae: Mae, preset: str) -> list[Response]:
    """Return how the geometric model and the simulator respond to pushes and a forced joint."""
    theta = np.clip(np.zeros(robot.joint_count), robot.lower, robot.upper)
    theta[robot.joints.index(FLEXED)] = FLEXION
    tension = holding_tension(robot, theta, 2.0 * robot.tension.bias)
    command = robot.muscle_lengths(theta, tension) + msc_compensation(robot, tension)
    simulated = Simulation(robot, mae, preset)
    simulated.start_from(theta[None])
    simulated.command = command[None]
    start = simulated.settle()
    result = []
    forced = np.full(robot.joint_count, np.nan)
    forced[robot.joints.index(FORCED)] = FORCED_TO
    free, none = np.full(robot.joint_count, np.nan), np.zeros(6)
    for name, wrench, fixed in (
        ('-50 N in z', np.array([0.0, 0.0, -50.0, 0.0, 0.0, 0.0]), free),
        ('50 N in y', np.array([0.0, 50.0, 0.0, 0.0, 0.0, 0.0]), free),
        (f'{FORCED} forced to 30°', none, forced),
    ):
        simulated.state = start
        simulated.wrench, simulated.fixed = wrench[None], fixed[None]
        after = simulated.settle()
        body = nominal_rest(robot, command, theta, tension, wrench, fixed)
        result.append(
            Response(
                name,
                body.theta - theta,
                (after.theta - start.theta)[0],
                body.tension - tension,
                (after.tension - start.tension)[0],
            )
        )
    return result
