# SPDX-License-Identifier: Apache-2.0
"""The simulator's step of preset `default` in plain eager torch, for comparison.

It solves the equations of `simulation.equilibrium`, which explains them, for N arms under muscle
stiffness control, in single precision. Autograd computes the gradient of the network; the mechanics
are batched tensors.
"""

from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.signals.friction import REVERSAL
from musculoskeletal_ae.simulation.equilibrium import (
    JOINT_SPEED,
    MODULE_SPEED,
    ROUNDS,
    ArmState,
    QuasiStatics,
)
from musculoskeletal_ae.simulation.simulation import Simulation


def _single(array: NDArray[Any]) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)


class EagerSimulation:
    """N simulated arms in torch; `state` holds tensors."""

    def __init__(self, ours: Simulation) -> None:
        """Copy state, commands, wrenches and fixed joints of `ours` (preset `default`)."""
        robot, own = ours.robot, QuasiStatics(ours.robot)
        own.use(ours.mae, robot)
        self.network = from_mae(ours.mae)
        self.scale = _single(scale_vector(robot.joint_count, robot.muscle_count))
        self.body = type(own.body)(*map(_single, own.body))
        self.state = ArmState(*map(_single, ours.state))
        self.command, self.wrench, self.fixed = map(
            _single, (ours.command, ours.wrench, ours.fixed)
        )
        tree, limbs = own.tree, own.slopes.limbs
        self.tree = tree
        count, ways = len(tree.parent), np.eye(len(tree.parent), dtype=bool)
        for i in range(1, count):
            ways[i] |= ways[tree.parent[i]]
        # mask (k, j): joint j is revolute, and is joint k or lies between the root and joint k
        turning = ways[:, 1:] & ~tree.slides[1:]
        self.before = _single(turning[1:])
        onto = np.zeros((count - 1, robot.joint_count))
        if tree.terms.shape[1] > 2:
            raise MusculoskeletalError(
                'the eager simulation supports linear joint couplings only; use another robot'
            )
        onto[np.arange(count - 1), tree.master[1:]] = tree.terms[1:, 1]
        self.onto = _single(onto)
        self.lever = _single(tree.axis), _single(tree.centre), _single(tree.mass)
        self.poses = tuple(map(_single, (tree.placement, tree.first, tree.second)))
        self.carried, self.carries = _single(tree.carried[1:]), _single(tree.carries[1:])
        self.hangs = _single(ways[1:, 1:].T)  # 1 where the joint (row) carries the body (column)
        self.down, self.tip = _single(tree.gravity), _single(tree.effector)
        self.springs, self.preload = _single(tree.springs), _single(tree.preload)
        self.sliding = torch.as_tensor(tree.slides[1:])[:, None]
        self.limbs = []
        parts: tuple[NDArray[Any], ...]
        parts = limbs.joints, limbs.muscles, limbs.first, limbs.second
        for d, m in limbs.counts:
            pairs = np.array([*combinations_with_replacement(range(d), 2)]).T
            sizes = d, m, (1 + d + len(pairs[0])) * m * d, m * (1 + d) * len(pairs[0])
            joints, muscles, first, second = (p[:n] for p, n in zip(parts, sizes, strict=True))
            parts = tuple(p[n:] for p, n in zip(parts, sizes, strict=True))
            rows, columns = np.tril_indices(d)
            bends = np.zeros((m, 1 + d, d, d))
            bends[..., rows, columns] = bends[..., columns, rows] = second.reshape(m, 1 + d, -1)
            tables = _single(first.reshape(-1, m * d)), _single(bends.reshape(m, -1))
            self.limbs.append((*map(torch.as_tensor, (joints, muscles, pairs)), *tables))

    def step(self, h: float) -> ArmState:
        """Simulate the time `h` [s], at most `simulation.LONGEST_STEP`; return the new state."""
        body, (theta, tension, length, followed, _, slid) = self.body, self.state
        passed = torch.exp(-body.friction * slid)
        end = passed * tension
        length, pulled = self._lengths(theta, end)
        with torch.no_grad():
            load, slope = self._hold(theta)
            jacobian, bend = self._slopes(theta, end)
            slope = slope + bend
            most, span = MODULE_SPEED * h, (body.most - body.bias) / body.stiffness
            followed = followed + (self.command - followed).clamp(-most, most)
            followed = torch.minimum(torch.maximum(followed, length - span), length + most)
            stretch = body.wire_stretch * (body.length_at_zero + length)
            compliance = 1.0 / (body.rate * (body.force + end.clamp(min=0.0))) + stretch
            turning, viscous = slid, torch.diag_embed(body.viscosity / h)
            for _ in range(ROUNDS):
                sliding = torch.abs(turning) < 1.0
                rub = torch.where(sliding, body.friction * end / REVERSAL, 0.0)
                lost = torch.where(sliding, 0.0, body.friction * end * (turning - slid))
                by_motor = passed * compliance
                aim = body.bias + body.stiffness * (length - followed)
                give = 1.0 + compliance * rub
                soft = body.stiffness / (give + body.stiffness * by_motor)
                wanted = aim + soft * (compliance * lost - by_motor * (aim - tension))
                settled = torch.minimum(torch.maximum(wanted, body.bias), body.most)
                rise = settled - tension
                moved = (compliance * lost - by_motor * rise) / give
                change = passed * rise + rub * moved - lost
                free = (passed + rub / body.stiffness) * soft
                spring = torch.where(settled == wanted, free, rub / give)
                push = -(load + pulled) - torch.einsum('nm,nmd->nd', change, jacobian)
                stiff = jacobian.transpose(1, 2) @ (spring[..., None] * jacobian)
                arrived, held = self._turn(theta, push, slope + viscous + stiff, h)
                way = torch.einsum('nmd,nd->nm', jacobian, arrived - theta)
                pull = torch.minimum(torch.maximum(wanted + soft * way, body.bias), body.most)
                moved = (way + compliance * lost - by_motor * (pull - tension)) / give
                before, turning = turning, (slid - moved / REVERSAL).clamp(-1.0, 1.0)
                rough = (body.friction * end != 0.0).any()
                if not rough or ((torch.abs(before) < 1.0) == (torch.abs(turning) < 1.0)).all():
                    break
            holding = torch.where(held, -push, 0.0)
            self.state = ArmState(arrived, pull, length + moved, followed, holding, turning)
        return self.state

    def _lengths(self, theta: Tensor, tension: Tensor) -> tuple[Tensor, Tensor]:
        """Return the network's muscle lengths l [m] (N, M), and the products Gᵀ T [N·m] (N, D).

        G = ∂l/∂θ is the muscle Jacobian.
        """
        angles, muscles = theta.detach().requires_grad_(), tension.shape[1]
        inputs = torch.cat((angles, tension, torch.zeros_like(tension)), dim=1)
        mask = torch.zeros(len(theta), dtype=torch.long)
        restored = self.network(inputs * self.scale, mask) / self.scale
        length = restored[:, -muscles:]
        return length.detach(), torch.autograd.grad(length, angles, tension)[0]

    def _hold(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the torque that holds the arm [N·m] (N, D), and its derivative by θ (N, D, D).

        `load.hold` computes the same.
        """
        tree, (placement, first, second) = self.tree, self.poses
        poses = [placement.new_tensor(np.eye(4)).expand(len(theta), 4, 4)]
        for i in range(1, len(tree.parent)):
            angle = float(tree.terms[i, 1]) * theta[:, tree.master[i]] + float(tree.terms[i, 0])
            angle = angle[:, None, None]
            turned = angle if tree.slides[i] else torch.sin(angle)
            rest = torch.zeros_like(angle) if tree.slides[i] else 1.0 - torch.cos(angle)
            own = placement[i] + turned * first[i] + rest * second[i]
            poses.append(poses[tree.parent[i]] @ own)
        pose = torch.stack(poses[1:], dim=1)  # (N, J, 4, 4)
        turn, at = pose[..., :3, :3], pose[..., :3, 3]
        axis, centre, mass = (part[1:] for part in self.lever)
        axis = (turn @ axis[..., None])[..., 0]
        moments = mass[:, None] * ((turn @ centre[..., None])[..., 0] + at)
        weight = torch.einsum('kj,njc->nkc', self.hangs, moments) - self.carried[:, None] * at
        hand = pose[:, tree.effector_joint - 1]
        arm = (hand[:, :3, :3] @ self.tip + hand[:, :3, 3])[:, None] - at
        push = self.wrench[:, None, :3] * self.carries[:, None]
        twist = self.wrench[:, None, 3:] * self.carries[:, None]
        down, cross = self.down.expand_as(weight), torch.linalg.cross
        force = push + self.carried[:, None] * down
        turning = cross(weight, down) + cross(arm, push) + twist
        bending = cross(down, cross(weight, axis)) + cross(push, cross(arm, axis))
        torque = (axis * torch.where(self.sliding, force, turning)).sum(dim=-1)
        bend = torch.where(self.sliding, cross(axis, force), bending)
        lower = self.before * (bend @ axis.transpose(1, 2))  # ∂τ_k/∂θ_j for joints j at or before k
        both = lower + lower.transpose(1, 2) - torch.diag_embed(lower.diagonal(dim1=1, dim2=2))
        load = theta @ self.springs - self.preload - torque @ self.onto
        return load, self.springs - self.onto.T @ both @ self.onto

    def _slopes(self, theta: Tensor, tension: Tensor) -> tuple[Tensor, Tensor]:
        """Return the derivatives of the muscle lengths l with respect to the joint angles θ.

        `add_slopes` computes the same.

        Returns:
            The muscle Jacobian G = ∂l/∂θ [m/rad] (N, M, D), and Σ T_i ∂²l_i/∂θ² [N·m/rad] (N, D,
            D).
        """
        count, joints = theta.shape
        jacobian = theta.new_zeros(count, tension.shape[1], joints)
        curvature = theta.new_zeros(count, joints, joints)
        for own, muscles, (left, right), first, second in self.limbs:
            x, d = theta[:, own], len(own)
            basis = torch.cat((torch.ones_like(x[:, :1]), x, x[:, left] * x[:, right]), dim=1)
            slope = (basis @ first).view(count, len(muscles), d)
            bend = (tension[:, muscles] @ second).view(count, 1 + d, d * d)
            linear = torch.cat((torch.ones_like(x[:, :1]), x), dim=1)
            jacobian[:, muscles[:, None], own] = slope
            curvature[:, own[:, None], own] = (linear[:, None] @ bend).view(count, d, d)
        return jacobian, curvature

    def _turn(self, theta: Tensor, push: Tensor, matrix: Tensor, h: float) -> tuple[Tensor, Tensor]:
        """Solve the linear system of a time step for the motion of the joints, within their limits.

        Args:
            theta: Joint angles before the step [rad], (N, D).
            push: Right side of the system for each joint, (N, D).
            matrix: Matrix of the system, (N, D, D).
            h: Duration of the step [s].

        Returns:
            The joint angles after the step [rad] (N, D), and a mask (N, D) of the joints that a
            limit stops or that are fixed to an angle.
        """
        low, high, most, fixed = self.body.lower, self.body.upper, JOINT_SPEED * h, self.fixed
        forced = torch.isfinite(fixed)
        held = forced | ((theta <= low) & (push < 0.0)) | ((theta >= high) & (push > 0.0))
        aim = torch.minimum(torch.maximum(fixed, low), high) - theta
        way = torch.where(forced, aim.clamp(-most, most), 0.0)
        right = torch.where(held, 0.0, push - (matrix @ way[..., None])[..., 0])
        both = held[:, :, None] | held[:, None, :]
        matrix = torch.where(both, torch.diag_embed(held.float()), matrix)
        turned = torch.linalg.solve(matrix, right)
        largest = turned.abs().amax(dim=1, keepdim=True).clamp(min=most)
        arrived = torch.minimum(torch.maximum(theta + turned * (most / largest) + way, low), high)
        stopped = ((arrived == low) & (push < 0.0)) | ((arrived == high) & (push > 0.0))
        return arrived, forced | stopped
