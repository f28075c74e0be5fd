# SPDX-License-Identifier: Apache-2.0
"""Checks checkpoint validation: margins of healthy networks, and rejection of bad ones.

    python -m bench gate [--robot NAME|DIR] [--reality kin|foreign] [--seeds 0,1,…] [--minutes 10]

For each individual and preset, a learner learns from an exploring arm that carries 3.6 kg every
second minute. Each published checkpoint is validated on the messages of the arm. The bench prints:

- each measure of the networks: its largest value over all of them, and its limit,
- each measure of the messages: its largest value, and its limit (`signals/reading_limits.py`),
- the networks that were refused (there should be none),
- how many initial and final networks are refused after each attack on them.

The exit status is 1 if a healthy network was refused, or an attacked one was not.
"""

from collections import defaultdict

import numpy as np
import torch
from network_attacks import ATTACKS

from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.estimation.network_validation.detector_check import LEAST_RUPTURED, measures
from musculoskeletal_ae.estimation.network_validation.message_errors import FLOOR, WORSE
from musculoskeletal_ae.estimation.network_validation.posture_check import LIMITS
from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import GateError
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    SAMPLE_TIME,
    Recording,
    end_tensions,
    record,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import directions
from musculoskeletal_ae.signals.reading_limits import LIMITS as SIGNAL_LIMITS
from musculoskeletal_ae.signals.reading_limits import share_outside

LOAD = 3.6  # let the arm carry this payload every second minute [kg]
MINUTE = 60.0  # add or remove the payload at this interval [s]

MESSAGES = {
    'change of l in 10 ms [m]': SIGNAL_LIMITS.step + SIGNAL_LIMITS.speed * SAMPLE_TIME,
    'T relative to tension.max': SIGNAL_LIMITS.highest_tension,
    'θ_est beyond the joint limits, in joint ranges': SIGNAL_LIMITS.estimate_outside,
}


def message_measures(robot: Robot, mae: Mae, stream: Recording) -> dict[str, float]:
    """Return the largest value over a recording of each measure in MESSAGES, by its name.

    The joint angles that the measures need are those that `mae` estimates.
    """
    theta = mae.estimate(end_tensions(mae, stream), stream.length).theta
    values = (
        np.abs(np.diff(stream.length, axis=0)).max(),
        (stream.tension / robot.tension.max).max(),
        max(0.0, share_outside(robot, theta).max()),
    )
    return dict(zip(MESSAGES, map(float, values), strict=True))


class Spread:
    """The largest value of each measure over networks, and the refused networks."""

    def __init__(self) -> None:
        """Start without a measured network."""
        self.most: defaultdict[str, float] = defaultdict(float)
        #: largest d among the ruptured muscles of a network, as a multiple of the detection
        #: threshold; the smallest of these values over all networks
        self.least_ruptured = np.inf
        self.refused, self.count = list[str](), 0

    def take(self, gate: CheckpointValidator, mae: Mae, name: str) -> None:
        """Include a network in the largest measures, and note if and why it is refused.

        Args:
            gate: The validation.
            mae: The network.
            name: Name of the network in the list of refusals.
        """
        self.count += 1
        values = {key: error.max() for key, error in filter(None, gate.postures.errors(mae))}
        errors = gate.message_errors(mae)
        values |= {f'{key} of messages': error.max() for key, error in errors.items()}
        if gate.mae is not None and errors:
            for key, in_use in gate.message_errors(gate.mae).items():
                is_large = errors[key] > FLOOR[key]
                ratio = errors[key][is_large] / in_use[is_large]
                values[f'{key} over that in use'] = ratio.max(initial=0.0)
        values['d on messages'], *ruptured = [*measures(mae, gate.messages, ())] or [0.0]
        self.least_ruptured = min(self.least_ruptured, max(ruptured, default=np.inf))
        for key, value in values.items():
            self.most[key] = max(self.most[key], float(value))
        try:
            gate.check(mae)
        except GateError as error:
            self.refused.append(f'{name}: {error}')


def learned(arm: Arm, mae: Mae, driver: Mae, seed: int, minutes: float, spread: Spread) -> Mae:
    """Let a network learn from one exploring individual, and validate each checkpoint.

    Args:
        arm: The emulated individual.
        mae: The network before learning.
        driver: The network that commands the exploration.
        seed: Seed of the individual and of the learner.
        minutes: Duration of the exploration.
        spread: Receives the measures of every checkpoint.

    Returns:
        The network after learning.
    """
    robot, gate = arm.robot, CheckpointValidator(arm.robot)

    def script(arm: Arm, time: float) -> None:
        arm.set_payload(LOAD * (time // MINUTE % 2))

    stream = record(arm, driver, EXPLORATION_STREAM + seed, MINUTE * minutes, script)
    for name, value in message_measures(robot, mae, stream).items():
        spread.most[name] = max(spread.most[name], value)
    learner = Learner(robot, mae, preset=mae.preset, seed=seed)
    gate.take(mae, 0.0)
    rows = zip(stream.theta_sensor, stream.tension, stream.length, strict=True)
    for n, (row, sliding) in enumerate(zip(rows, directions(stream.length), strict=True)):
        now = n * SAMPLE_TIME
        gate.message(*row[1:], sliding, now, row[0])
        if learner.step(now, *row) is not None:
            spread.take(gate, learner.mae, f'individual {seed}, {mae.preset}, {now:.0f} s')
            gate.take(learner.mae, now)
    return learner.mae


def limit(name: str) -> float:
    """Return the value above which checkpoint validation refuses a network, for a named measure."""
    if name in (limits := LIMITS | MESSAGES):
        return limits[name]
    return FLOOR.get(name.removesuffix(' of messages'), WORSE if 'in use' in name else 1.0)


def main(argv: list[str]) -> int:
    """Run the bench; return the exit status."""
    parser = Parser(
        'gate', 'Compares healthy and attacked networks with the limits of checkpoint validation.'
    )
    parser.add_robot()
    parser.add_reality()
    parser.add_seeds((0, 1, 2, 3, 4))
    parser.add_minutes('duration of learning', 10.0)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot, spread = Robot.load(args.robot), Spread()
    initial = {preset: initial_mae(robot, preset) for preset in PRESETS}
    networks = [(f'initial, {preset}', mae) for preset, mae in initial.items()]
    for _, mae in networks:
        spread.take(CheckpointValidator(robot), mae, 'initial')
    for seed in args.seeds:
        for preset, mae in initial.items():
            arm = make_arm(robot, seed, args.reality)
            last = learned(arm, mae, initial['default'], seed, args.minutes, spread)
            networks.append((f'individual {seed}, {preset}', last))
    print(f'{spread.count} healthy networks: largest value and limit of each measure')
    for name, value in spread.most.items():
        print(f'  {name:<45}{value:10.4g}{limit(name):10.4g}')
    title = 'd with a ruptured muscle (smallest)'
    print(f'  {title:<45}{spread.least_ruptured:10.4g}{LEAST_RUPTURED:10.4g}')
    print('\n'.join(['refused:', *(spread.refused or ['none'])]))
    failed = bool(spread.refused)
    for attack, change in ATTACKS.items():
        passed = []
        for name, mae in networks:
            try:
                CheckpointValidator(robot).check(change(mae))
                passed.append(name)
            except GateError:
                pass
        print(f'{attack:<30}refused {len(networks) - len(passed)} of {len(networks)}', *passed)
        failed |= bool(passed)
    return int(failed)
