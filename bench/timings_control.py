# SPDX-License-Identifier: Apache-2.0
"""The control solve in plain torch, as the paper describes it: what `benchmark` compares ours with.

Same algorithm, same numbers in: G, then QP or descent, then lengths. Only the network runs in torch
and its gradients come from autograd.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control import methods as control
from musculoskeletal_ae.control.methods import msc_compensation
from musculoskeletal_ae.control.stiffness import stiffness_command
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import Network
from musculoskeletal_ae.mae.units import LENGTH_SCALE, TENSION_SCALE, Mask
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

#: name, ours, and the same in torch eager where there is one
ControlRow = tuple[str, Callable[[], object], Callable[[], object] | None]


def control_rows(robot: Robot, mae: Mae, eager: Network) -> list[ControlRow]:
    """Return the solves of the methods at one posture; weights do not matter for time."""
    theta = 0.5 * (robot.lower + robot.upper)
    torque = robot.kinematics.holding_torque(theta)
    tension = np.full(robot.muscle_count, robot.tension.bias)
    limit, joints = robot.tension.limit, robot.joint_count
    return [
        (
            'control solve: proposed, default',
            lambda: control.proposed(robot, mae, theta, torque, tension, limit),
            lambda: eager_proposed(robot, eager, theta, torque, tension),
        ),
        (
            'control solve: proposed, paper',
            lambda: control.proposed_paper(robot, mae, theta, torque, tension),
            lambda: eager_proposed_paper(robot, eager, theta, torque, tension),
        ),
        (
            'control solve: stiffness',
            lambda: stiffness_command(robot, mae, theta, torque, np.full(joints, 20.0), limit),
            None,
        ),
    ]


def _enter(network: Network, theta: Tensor, tension: Tensor) -> Tensor:
    """Return z = ①(θ, T) of scaled rows."""
    length = torch.zeros(*theta.shape[:-1], network.muscles)
    values = torch.cat([theta, tension, length], dim=-1)
    mask = torch.full((len(values),), list(Mask).index(Mask.THETA_TENSION))
    return network.encode(values, mask)


def _tensor(values: Array) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


def eager_proposed(
    robot: Robot, network: Network, theta: Array, torque: Array, tension: Array
) -> Array:
    """Return l_target [m] of preset `default`; arguments as for `control.proposed`."""
    muscles = network.muscles
    posture, bias = _tensor(theta), robot.tension.bias

    def lengths(pull: Tensor, at: Tensor) -> Tensor:
        return network.decode(_enter(network, at[None], pull[None]))[0, -muscles:]

    for _ in range(control.SOLVES):
        at_posture = partial(lengths, _tensor(TENSION_SCALE * tension))
        slope = torch.autograd.functional.jacobian(at_posture, posture)
        jacobian = slope.numpy().astype(float) / LENGTH_SCALE
        tension = least_tension(jacobian, torque, bias, robot.tension.limit).tension
    with torch.no_grad():
        length = lengths(_tensor(TENSION_SCALE * tension), posture).numpy() / LENGTH_SCALE
    command: Array = length + msc_compensation(robot, tension)
    return command


def eager_proposed_paper(
    robot: Robot, network: Network, theta: Array, torque: Array, tension: Array
) -> Array:
    """Return l_target [m] of preset `paper`; arguments as for `control.proposed_paper`."""
    joints, muscles, step = network.joints, network.muscles, 0.01
    with torch.no_grad():
        postures = _tensor(theta) + torch.cat([torch.zeros(1, joints), step * torch.eye(joints)])
        pulls = _tensor(TENSION_SCALE * tension).expand(joints + 1, -1)
        latent = _enter(network, postures, pulls)
        lengths = network.decode(latent)[:, -muscles:] / LENGTH_SCALE
        jacobian = (lengths[1:] - lengths[0]) / step / TENSION_SCALE  # (D, M), acts on scaled T
        z, aim, load = latent[0], _tensor(theta), _tensor(torque)
        steps = torch.linspace(0.0, control.SEARCH.largest_step, control.SEARCH.candidates + 1)

    def loss(y: Tensor) -> Tensor:
        pull = y[..., joints : joints + muscles]
        return (
            control.TENSION_WEIGHT * pull.norm(dim=-1)
            + control.POSTURE_WEIGHT * (y[..., :joints] - aim).norm(dim=-1)
            + control.TORQUE_WEIGHT * (load + pull @ jacobian.T).norm(dim=-1)
        )

    for _ in range(control.SEARCH.epochs):
        leaf = z.clone().requires_grad_()
        gradient = torch.autograd.grad(loss(network.decode(leaf)), leaf)[0]
        with torch.no_grad():
            candidates = z - steps[:, None] * gradient / gradient.norm()
            z = candidates[loss(network.decode(candidates)).argmin()]
    with torch.no_grad():
        state = network.decode(z).numpy().astype(float)
    pulled = state[joints : joints + muscles] / TENSION_SCALE
    command: Array = state[-muscles:] / LENGTH_SCALE + msc_compensation(robot, pulled)
    return command
