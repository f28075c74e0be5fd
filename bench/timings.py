# SPDX-License-Identifier: Apache-2.0
"""Times each step of the core, and the same step in plain torch.

    python -m bench timings [--robot NAME|DIR] [--preset NAME]

The torch side runs the same algorithm on the same input. Its network runs in torch, and autograd
computes the gradients. The column "bound" estimates a lower bound: the time that this machine needs
for the multiply-adds of the network alone, as matrix products. The products have one row for a
single call, and a batch of rows for many arms.
"""

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from mujoco import rollout
from torch import Tensor

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.modules import STEP
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN, make_arm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.exporting.exported_mjcf import export
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae, read_groups
from musculoskeletal_ae.mae.network import Network, from_mae
from musculoskeletal_ae.mae.training import random_states
from musculoskeletal_ae.mae.units import LENGTH_SCALE, TENSION_SCALE, Mask, scale_vector, visible
from musculoskeletal_ae.motion.activities import Command, msc_compensation
from musculoskeletal_ae.motion.methods import SOLVES, first_command, stiffness_command
from musculoskeletal_ae.motion.tension_plan import plan_at_rest
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.paper import control as paper
from musculoskeletal_ae.paper.constants import CONTROL_WEIGHTS, TORQUE_UNITS
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.simulation.simulation import Simulation

#: time a batch of this many arms; end a round of calls after about this time [s]
MANY, LONGEST = 4096, 0.05
SIMULATED = 0.01  # simulate this much time in each timed call [s]
ROLLED = 256  # simulate this many arms in `mujoco.rollout`; the time per arm does not depend on it
#: send messages at this rate [Hz], and time the cores of the nodes on this many
RATE, MESSAGES = 500.0, 2000


class Row(NamedTuple):
    """One row of the table; the implementation in torch is optional.

    A call that processes a batch counts as several calls.
    """

    name: str
    ours: Callable[[], object]
    torch_eager: Callable[[], object] | None = None
    several: int = 1
    products: int = 0  # multiply-adds of the network in a call; 0 if no bound is computed


class Timed(NamedTuple):
    """Times of one call [µs]; 0 if there is no implementation in torch, or no bound."""

    name: str
    ours: float
    torch_eager: float
    bound: float


def products(mae: Mae, mask: Mask | None, lengths: bool = False) -> int:
    """Return the number of multiply-adds of a pass through encoder and decoder.

    Without a mask, the encoder is not used. With `lengths`, the decoder computes only l.
    """
    groups_read = read_groups(mae.groups, mae.bases)
    depth, total = len(mae.encoder) // len(mae.groups), sum(w.size for w, _ in mae.decoder)
    for g, group in enumerate(mae.groups):
        muscles = len(group.muscles)
        last = mae.decoder[(g + 1) * depth - 1][0]
        total -= last.shape[1] * (len(last) - muscles) if lengths else 0
        if mask is not None:
            first, *rest = (weight for weight, _ in mae.encoder[g * depth : (g + 1) * depth])
            visible_count = int(visible(mask, *map(len, groups_read[g])).sum())
            total += len(first) * visible_count + sum(weight.size for weight in rest)
    return total


def gemm_rate(rows: int) -> float:
    """Return how many multiply-adds this machine computes per µs in a matrix product.

    The product is that of a (rows, 200) and a (200, 100) matrix in single precision.
    """
    left, right = np.ones((rows, 200), np.float32), np.ones((200, 100), np.float32)
    return rows * right.size / microseconds(lambda: left @ right)


def microseconds(function: Callable[[], object], calls: int = 100, rounds: int = 20) -> float:
    """Return the CPU time of one call [µs], as the median over `rounds` rounds of `calls` calls.

    If a function is slow, a round has fewer than `calls` calls, so that it takes about LONGEST
    seconds.
    """
    function()
    start = time.process_time()
    function()
    calls = max(1, min(calls, round(LONGEST / (time.process_time() - start + 1e-9))))
    times = []
    for _ in range(rounds):
        start = time.process_time()
        for _ in range(calls):
            function()
        times.append((time.process_time() - start) / calls)
    return 1e6 * float(np.median(times))


def row_time(row: Row, function: Callable[[], object]) -> float:
    """Return the CPU time [µs] of `function`, which is one of the two implementations of a row."""
    return microseconds(function) / row.several


def mae_rows(robot: Robot, preset: str) -> list[Row]:
    """Return rows for the steps of the network; their times do not depend on its weights."""
    mae = initial_mae(robot, preset, steps=1)
    eager = from_mae(mae)
    states = random_states(robot, 1, np.random.default_rng(0), robot.tension.limit)
    theta, tension, length = (part[0] for part in states)
    z = mae.encode(Mask.THETA_TENSION, theta, tension)
    scaled = torch.as_tensor(mae.decode_scaled(z), dtype=torch.float32)[None]
    latent = torch.as_tensor(z, dtype=torch.float32)
    gradient = np.ones(len(mae.mean))
    masks = {mask: torch.tensor([i]) for i, mask in enumerate(Mask)}
    return [
        Row(
            'estimate: θ, T, l from ②',
            lambda: mae.estimate(tension, length),
            torch.no_grad()(lambda: eager(scaled, masks[Mask.TENSION_LENGTH])),
            products=products(mae, Mask.TENSION_LENGTH),
        ),
        Row(
            'lengths from ①',
            lambda: mae.lengths(theta, tension),
            torch.no_grad()(lambda: eager(scaled, masks[Mask.THETA_TENSION])),
            products=products(mae, Mask.THETA_TENSION),
        ),
        Row(
            'decode, and gradient with respect to z',
            lambda: mae.decode_scaled.with_pullback(z)[1](gradient),
            lambda: _eager_gradient(eager, latent),
            products=2 * products(mae, None),
        ),
        Row('muscle Jacobian G from ①', lambda: mae.muscle_jacobian(theta, tension)),
        Row(
            'muscle Jacobian G by forward difference',
            lambda: paper.muscle_jacobian(mae, theta, tension),
        ),
        *control_rows(robot, mae, eager),
    ]


def control_rows(robot: Robot, mae: Mae, eager: Network) -> list[Row]:
    """Return rows for the control methods at one posture.

    Their times do not depend on the weights of the network.
    """
    theta = 0.5 * (robot.lower + robot.upper)
    torque = robot.kinematics.holding_torque(theta)
    tension = np.full(robot.muscle_count, robot.tension.bias)
    limit, joints = robot.tension.limit, robot.joint_count
    return [
        Row(
            'plan of a held posture, method proposed, preset default',
            lambda: plan_at_rest(robot, mae, theta).length(mae, theta),
            lambda: eager_proposed(robot, eager, theta, torque),
        ),
        Row(
            'plan of a held posture, method proposed, preset paper',
            lambda: paper.proposed(robot, mae, theta, torque, tension),
            lambda: eager_proposed_paper(robot, eager, theta, torque, tension),
        ),
        Row(
            'one step of the control method `stiffness`',
            lambda: stiffness_command(robot, mae, theta, torque, np.full(joints, 20.0), limit),
        ),
    ]


def _enter(network: Network, theta: Tensor, tension: Tensor) -> Tensor:
    """Return the latent state z that the encoder computes from joint angles and tensions.

    The inputs and z have one row for each state; the inputs are scaled as the network expects.
    """
    length = torch.zeros(*theta.shape[:-1], network.muscles)
    values = torch.cat([theta, tension, length], dim=-1)
    mask = torch.full((len(values),), list(Mask).index(Mask.THETA_TENSION))
    return network.encode(values, mask)


def _tensor(values: Array) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


def eager_proposed(robot: Robot, network: Network, theta: Array, torque: Array) -> Array:
    """Return the command of `plan_at_rest` [m], computed in plain torch.

    θ [rad], (D,), is the posture, and `torque` holds it [N·m], (D,).
    """
    muscles = network.muscles
    tension = bias = robot.tension.bias
    posture = _tensor(theta)

    def lengths(pull: Tensor, at: Tensor) -> Tensor:
        return network.decode(_enter(network, at[None], pull[None]))[0, -muscles:]

    for _ in range(SOLVES):
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
    """Return the target lengths l_target [m] of preset `paper`, computed in plain torch.

    The arguments are those of `paper.control.proposed`.
    """
    joints, muscles, step = network.joints, network.muscles, 0.01
    with torch.no_grad():
        postures = _tensor(theta) + torch.cat([torch.zeros(1, joints), step * torch.eye(joints)])
        pulls = _tensor(TENSION_SCALE * tension).expand(joints + 1, -1)
        latent = _enter(network, postures, pulls)
        lengths = network.decode(latent)[:, -muscles:] / LENGTH_SCALE
        # Gᵀ (D, M), for tensions that are scaled by TENSION_SCALE
        jacobian = (lengths[1:] - lengths[0]) / step / TENSION_SCALE
        z, aim, load = latent[0], _tensor(theta), _tensor(torque)
        largest, count, epochs = paper.SEARCH
        steps = largest * torch.arange(count) / count

    def loss(y: Tensor) -> Tensor:
        pull = y[..., joints : joints + muscles]
        tension_weight, posture_weight, torque_weight = CONTROL_WEIGHTS
        return (
            tension_weight * pull.norm(dim=-1)
            + posture_weight * (y[..., :joints] - aim).norm(dim=-1)
            + torque_weight * TORQUE_UNITS * (load + pull @ jacobian.T).norm(dim=-1)
        )

    for _ in range(epochs):
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


class TorchLengths:
    """Computes a network's muscle lengths and their gradients in torch, for the simulator."""

    def __init__(self, mae: Mae) -> None:
        self._network = from_mae(mae)
        self.lengths, self.friction = mae.lengths, mae.friction
        self.elasticity = mae.elasticity
        self._scale = torch.tensor(scale_vector(len(mae.joints), len(mae.muscles)))
        self._muscles = len(mae.muscles)

    def lengths_with_pullback(
        self, theta: Array, tension: Array
    ) -> tuple[Array, Callable[[Array], Array]]:
        """Return the lengths at (θ, T) and their pullback, as `Mae.lengths_with_pullback` does."""
        angles, tensions = torch.tensor(theta, requires_grad=True), torch.tensor(tension)
        values = torch.cat((angles, tensions, torch.zeros_like(tensions)), dim=1)
        mask = torch.zeros(len(theta), dtype=torch.long)
        reconstructed = self._network((values * self._scale).float(), mask) / self._scale
        length = reconstructed[:, -self._muscles :]

        def pullback(gradient: Array) -> Array:
            by_angles = torch.autograd.grad(length, angles, torch.tensor(gradient))[0]
            return by_angles.numpy(force=True)

        return length.numpy(force=True).astype(float), pullback


def simulation_rows(robot: Robot, preset: str) -> list[Row]:
    """Return rows for a simulator step of one arm and of many, and for loading a network."""
    mae = initial_mae(robot, preset, steps=200)
    rng = np.random.default_rng(0)

    def arms(count: int, body: Any = mae) -> Simulation:
        simulated = Simulation(robot, body, arms=count)
        theta = robot.random_postures(count, rng)
        tension = rng.uniform(robot.tension.bias, robot.tension.limit, (count, robot.muscle_count))
        simulated.command = first_command(robot, mae, theta, tension)
        simulated.wrench[:, 2] = -10.0
        return simulated

    def step(simulated: Any) -> Callable[[], object]:
        return lambda: simulated.step(SIMULATED)

    network, work = TorchLengths(mae), 2 * products(mae, Mask.THETA_TENSION, lengths=True)
    one, per_arm = 'simulation step', 'simulation step, time per arm in a batch of'
    many = f'{per_arm} {MANY}'
    return [
        Row(one, step(arms(1)), step(arms(1, network)), 1, work),
        Row(many, step(arms(MANY)), step(arms(MANY, network)), MANY, work),
        *rollout_rows(robot, mae, arms(ROLLED).state.theta),
        Row('loading a new network into the simulator', partial(Simulation(robot, mae).use, mae)),
    ]


def rollout_rows(robot: Robot, mae: Mae, theta: Array) -> list[Row]:
    """Return rows for the time of a simulation step in `mujoco.rollout` of the exported model.

    The model is that of `export_mjcf`. Each of its muscles has a constant control. MuJoCo simulates
    the inertia of the links, which our simulator neglects.

    Args:
        robot: The robot whose learned body is exported.
        mae: The network to export.
        theta: Postures in which the arms begin [rad], (N, D).
    """
    with tempfile.TemporaryDirectory() as folder:
        export(robot, mae, Path(folder) / 'model')
        model = mujoco.MjModel.from_xml_path(str(Path(folder) / 'model' / 'model.xml'))
    data, state = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    starts = np.empty((len(theta), mujoco.mj_stateSize(model, state)))
    tension = np.tile(robot.tension.bias, (len(theta), 1))
    command = first_command(robot, mae, theta, tension)
    for posture, start in zip(theta, starts):
        data.qpos[:] = robot.kinematics.tree.angles(posture)
        mujoco.mj_getState(model, data, start, state)

    def simulating(timestep: float) -> Callable[[], object]:
        steps = round(SIMULATED / timestep)
        control = np.repeat(command[:, None], steps, axis=1)

        def simulate() -> object:
            model.opt.timestep = timestep
            return rollout.rollout(model, data, starts, control)

        return simulate

    return [
        Row(
            f'the same {1e3 * SIMULATED:.0f} ms in mujoco.rollout, steps of {1e3 * step:.0f} ms',
            simulating(step),
            several=len(theta),
        )
        for step in (model.opt.timestep, SIMULATED)
    ]


def emulation_rows(robot: Robot) -> list[Row]:
    """Return rows for one millisecond of emulation by each emulator model."""
    steps = 10
    return [
        Row(
            f'emulated millisecond, model {reality}',
            partial(make_arm(robot, 0, reality).step, steps * STEP),
            several=steps,
        )
        for reality in (KIN, FOREIGN)
    ]


def message_times(robot: Robot, mae: Mae, preset: str) -> list[Timed]:
    """Return the mean times of the nodes' cores for one message of an exploring emulated arm."""
    estimator, learner = Estimator(robot, preset), Learner(robot, preset=preset)
    controller = Controller(robot, Settings(preset=preset))
    estimator.use(mae)
    controller.use(mae)
    controller.explore(True)
    arm, spent = make_arm(robot, 0), defaultdict[str, list[float]](list)

    def timed(name: str, function: Callable[[], Any]) -> Any:
        begun = time.process_time()
        result = function()
        spent[name].append(time.process_time() - begun)
        return result

    def command(theta: Array, now: float) -> Command | None:
        controller.estimated(theta, now)
        return controller.step(now)

    for n in range(MESSAGES):
        now = 100.0 + n / RATE
        arm.step(1.0 / RATE)
        reading = timed('emulated arm: readings', arm.sense)
        theta, message = reading
        timed('estimator: joint angles', partial(estimator.joints, theta, now))
        output = timed('estimator: muscle states', partial(estimator.take, message, now, now))
        timed('controller: muscle states', partial(controller.take, message, now))
        wanted = timed('controller: command', partial(command, output.state.theta, now))
        timed('learner: joint angles', partial(learner.joints, now, theta))
        timed('learner: muscle states', partial(learner.take, message, now))
        if wanted is not None:
            arm.command_length(wanted.value)
            estimator.commanded(now, length=wanted.value)
    settled = {name: each[MESSAGES // 4 :] for name, each in spent.items()}
    return [
        Timed(f'{name}, {RATE:.0f} Hz', 1e6 * sum(each) / len(each), 0.0, 0.0)
        for name, each in settled.items()
    ]


def _eager_gradient(network: Network, latent: torch.Tensor) -> object:
    leaf = latent.clone().requires_grad_()
    return torch.autograd.grad(network.decode(leaf).sum(), leaf)


def measure(robot: Robot, preset: str) -> list[Timed]:
    """Measure the times of all rows, on one thread."""
    torch.set_num_threads(1)
    one, many = gemm_rate(1), gemm_rate(256)
    every = mae_rows(robot, preset) + simulation_rows(robot, preset)
    every += emulation_rows(robot)
    return [
        Timed(
            row.name,
            row_time(row, row.ours),
            row_time(row, row.torch_eager) if row.torch_eager else 0.0,
            row.products / (one if row.several == 1 else many),
        )
        for row in every
    ] + message_times(robot, initial_mae(robot, preset, steps=200), preset)


def show(robot: Robot, preset: str) -> None:
    """Measure all steps, and print the table of their times."""
    name = robot.description.directory.name
    print(f'{name}, preset {preset}: median time of one call [µs]; torch uses one thread')
    print(f'{"":<64}{"ours":>10}{"torch eager":>14}{"bound":>10}')
    for row in measure(robot, preset):
        numbers = zip((row.ours, row.torch_eager, row.bound), (10, 14, 10))
        cells = (f'{f"{value:.1f}" if value else "":>{width}}' for value, width in numbers)
        print(f'{row.name:<64}{"".join(cells)}')


def main(argv: list[str]) -> None:
    """Measure the steps for one robot and one preset, and print the table."""
    parser = Parser('timings', 'Times each step of the core, and the same step in plain torch.')
    parser.add_robot()
    parser.add_preset()
    args = parser.parse_args(argv)
    show(Robot.load(args.robot), args.preset)
