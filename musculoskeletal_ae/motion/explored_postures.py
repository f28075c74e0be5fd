# SPDX-License-Identifier: Apache-2.0
"""Draws the postures and tensions of the exploration.

A preset composes its steps from these parts (`Preset.exploration`).
"""

from collections.abc import Callable, Iterable
from contextlib import suppress

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.equilibrium_states import has_followers
from musculoskeletal_ae.robot.joint_stops import AT_STOP, supporting_stops
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension, least_tension

TRIES = 1000  # search at most this many random postures for holdable ones
AT_LIMITS = 0.25  # place this fraction of each joint's random angles at one of its limits
#: look for postures that joint stops support after this many random postures without success
TRIES_WITHOUT_STOPS = 200
TRIES_WITH_STOPS = 5  # look for postures that joint stops support near this many random ones
#: refuse supported postures whose mean spread is less than this share of the joint ranges, because
#: an arm that hardly moves provides no data
LEAST_SPREAD = 0.1
#: refuse supported postures in which less than this share of the joints is away from its limits
LEAST_FREE = 0.3
SETTLING_STEPS = 40  # give up the search for a supported posture after this many steps
LARGEST_STEP = 0.2  # turn a joint by at most this in one step of the search [rad]
#: raise small stiffnesses in a step of the search to this share of the largest one, so that the
#: step stays short
LEAST_STIFFNESS = 0.05
BALANCED = 1e-3  # count a posture as held if it lacks at most this share of the largest torque
SMALL = 1e-9  # divide torques by at least this, to avoid a division by zero [N·m]
PRESSES = 10  # draw this many random T_const, and use the one that presses most strongly


def posture_at_limits(robot: Robot, rng: np.random.Generator, share: float = AT_LIMITS) -> Array:
    """Return a random posture [rad], (D,); `share` is the probability of a joint limit."""
    theta = robot.random_postures(1, rng)[0]
    chosen, upper = rng.uniform(size=(2, robot.joint_count))
    limit = np.where(upper < 0.5, robot.upper, robot.lower)
    return np.where(chosen < share, limit, theta)


def pressing_tension(robot: Robot, theta: Array, rng: np.random.Generator) -> Array:
    """Return random tensions that press the joints at their limits strongly against the stops.

    PRESSES random sets of tensions are compared, and the one that presses most strongly is
    returned. If no joint is at a limit, only one set is drawn.

    Args:
        robot: The robot.
        theta: Joint angles θ [rad], (D,).
        rng: Generator of the random tensions.

    Returns:
        T [N], (M,).
    """
    limits = robot.tension
    side = (theta == robot.upper).astype(float) - (theta == robot.lower)
    count = PRESSES if side.any() else 1
    tension = rng.uniform(limits.bias, limits.limit, (count, robot.muscle_count))
    torque = -tension @ robot.routes.muscle_jacobian(theta)
    pressure = torque / np.maximum(np.abs(torque).max(axis=0), SMALL) @ side
    most_pressing: Array = tension[np.argmax(pressure)]
    return most_pressing


def explored_posture(robot: Robot, draw: Callable[[], Array]) -> tuple[Array, Array]:
    """Return a random posture that the arm can hold, with tensions that hold it.

    If hardly any random posture is holdable, as in a hand with many joints, it is one near a random
    posture in which springs and joint stops support the joints that the muscles cannot hold. A hand
    with fewer muscles than joints can rest in such postures only.

    Args:
        robot: The robot.
        draw: Draws a random posture θ [rad], (D,).

    Returns:
        The posture θ [rad], (D,), and the tensions T [N], (M,).

    Raises:
        RobotDescriptionError: If no posture is found.
    """
    if has_followers(robot):
        settling = (settled(robot, draw()) for _ in range(TRIES_WITHOUT_STOPS))
        if (first := next((each for each in settling if each is not None), None)) is not None:
            return first
    try:
        postures = (draw() for _ in range(TRIES_WITHOUT_STOPS))
        return holdable_postures(robot, postures, 1)[0]
    except RobotDescriptionError:
        if found := supported_postures(robot, [draw() for _ in range(TRIES_WITH_STOPS)]):
            return found[0]
        raise


def supported_postures(robot: Robot, postures: Iterable[Array]) -> list[tuple[Array, Array]]:
    """Return postures near given ones that muscles and joint stops hold, with the tensions.

    The list is empty if the postures are nearly the same, or if nearly all joints lie at their
    stops: the muscles of such an arm do not move it. Joints with springs and too few muscles often
    lie at their stops, and are moved all the same.
    """
    found = [each for theta in postures if (each := settled(robot, theta)) is not None]
    if not found:
        return []
    theta = np.array([at for at, _ in found])
    spread = theta.std(axis=0) / (robot.upper - robot.lower)
    is_free = (theta > robot.lower + AT_STOP) & (theta < robot.upper - AT_STOP)
    is_moved = has_followers(robot) or is_free.mean() > LEAST_FREE
    return found if spread.mean() > LEAST_SPREAD and is_moved else []


def settled(robot: Robot, theta: Array) -> tuple[Array, Array] | None:
    """Return a posture near θ (D,) that muscles and joint stops hold, with the tensions (M,).

    The muscles exert the tensions that come nearest to holding the present posture, and the joints
    move as the missing torque moves them. A joint that reaches its limit is supported there.

    Returns:
        The posture and the tensions; None if no such posture is found.
    """
    limits, theta = robot.tension, theta.copy()
    for _ in range(SETTLING_STEPS):
        torque = robot.kinematics.holding_torque(theta)
        jacobian = robot.routes.muscle_jacobian(theta)
        stops = supporting_stops(robot, theta)
        exertion = least_tension(jacobian, torque, limits.bias, limits.limit, stops=stops)
        if np.abs(exertion.missing_torque).max() <= BALANCED * np.abs(torque).max():
            return theta, exertion.tension
        falling = -exertion.missing_torque
        gradient = robot.kinematics.holding_gradient(theta)
        values, vectors = np.linalg.eigh(0.5 * (gradient + gradient.T))
        values = np.maximum(np.abs(values), LEAST_STIFFNESS * np.abs(values).max() + SMALL)
        step = vectors @ (vectors.T @ falling / values)
        step *= min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), SMALL))
        theta = np.clip(theta + step, robot.lower, robot.upper)
    return None


def holdable_postures(
    robot: Robot, postures: Iterable[Array], count: int, *others: Callable[[Array], Array]
) -> list[tuple[Array, Array]]:
    """Return the first `count` holdable postures, each with the least tensions that hold it.

    A posture has the shape (D,), and its tensions [N] have the shape (M,).

    Args:
        robot: The robot.
        postures: Random postures.
        count: Number of postures to return.
        others: Further functions that return G (N, M, D) for postures (N, D). A posture has to be
            holdable with the nominal G and with the G of each of these functions. T is computed
            with the G of the last function, or with the nominal G if there is none.

    Raises:
        RobotDescriptionError: If fewer than `count` of the postures are holdable.
    """
    held: list[tuple[Array, Array]] = []
    for theta in postures:
        with suppress(InfeasibleError):
            for muscle_jacobian in (robot.routes.muscle_jacobian, *others):
                tension = holding_tension(robot, theta, jacobian=muscle_jacobian(theta[None])[0])
            held.append((theta, tension))
        if len(held) == count:
            return held
    raise RobotDescriptionError(
        f'{robot.description.directory}: only {len(held)} of {TRIES} random postures are holdable '
        f'with tensions from {shown(robot.tension.bias)} to {shown(robot.tension.limit)} N; '
        'run check_robot, which suggests changes'
    )
