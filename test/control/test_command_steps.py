# SPDX-License-Identifier: Apache-2.0
"""Random sequences of requests, faults and restarts never cause a step of the command.

Every command is compared with the last one that was published, in every mode and across every
change of mode. Commands of lengths and of tensions are compared by the tension that they demand of
the modules. After controller/stop nothing is wound in until controller/reset.
"""

from contextlib import suppress
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from control_bench import ROBOT
from exact_mae import ExactMae
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, rule

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import METHODS
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.motion import holdable_paths
from musculoskeletal_ae.motion.activities import LENGTH, TENSION
from musculoskeletal_ae.signals.body_state import Anomaly, LengthOffsets

DT, SMALL = 0.01, 1e-9
COUNT, LIMIT = ROBOT.muscle_count, ROBOT.tension.limit
MUSCLES = st.integers(0, COUNT - 1)
POSTURES = st.tuples(*(st.floats(*pair) for pair in zip(ROBOT.lower, ROBOT.upper)))
FAULTS = ('freeze', 'spike:length', 'spike:tension', 'nan_sensor', 'dead_sensor', 'stuck_motor')
MAE = ExactMae(ROBOT)


@pytest.fixture(autouse=True)
def short_search(monkeypatch):
    """Search briefly for paths without the isolated muscles, because any path will do here."""
    monkeypatch.setattr(holdable_paths, 'POSTURES', 30)
    monkeypatch.setattr(holdable_paths, 'LOOKS', 5)


class Arm(RuleBasedStateMachine):
    """A controlled emulated arm under random events; each command of the controller is checked."""

    def __init__(self):
        super().__init__()
        self.arm, self.now, self.blind = EmulatedArm(ROBOT, 1), 100.0, set()
        self.offsets = LengthOffsets.of(np.zeros(COUNT), np.zeros(COUNT))
        self.restart(False)

    @rule(explores=st.booleans())
    def restart(self, explores):
        """Replace the controller by a new one, which receives the network and the body state."""
        self.core = Controller(ROBOT)
        self.core.use(MAE)
        self.core.use_body(self.core.stream.body.with_offsets(self.offsets))
        self.core.target(dict(zip(ROBOT.joints, ((0.0, 0.0),) * ROBOT.joint_count)))
        if explores:
            self.core.explore(True)
        #: last command, and last length command: kind, published value and time of each
        self.last = self.last_length = None
        self.has_stopped = False

    @rule(steps=st.integers(1, 40))
    def time_passes(self, steps):
        for _ in range(steps):
            self.arm.step(DT)
            self.now += DT
            self.messages()
            command = self.core.step(self.now)
            if command is not None:
                self.judge(command)

    def messages(self):
        for read in self.arm.faults.deliver(self.arm.sense(), self.now):
            if 'muscles' not in self.blind:
                with suppress(MessageError):
                    self.core.take(read.muscles, self.now)
            if 'estimate' not in self.blind:
                self.core.estimated(self.arm.theta, self.now)

    def judge(self, command):
        rate, stiffness = self.core.settings.rate_limit, ROBOT.stiffness
        value, length = command.value, self.core.sample.length
        if command.kind == LENGTH:
            value = value + self.offsets.offset
            length = length + self.offsets.offset
        is_eased = self.core.sample.motor_tension > LIMIT
        if self.last is not None:
            kind, before, at = self.last
            change = rate * (self.now - at) * (stiffness if command.kind == TENSION else 1.0)
            if kind != command.kind:
                before, change = self.demand(kind, before, length), stiffness * rate * DT
            demanded = self.demand(command.kind, value, length) if kind != command.kind else value
            rise = (
                demanded - before if command.kind == TENSION or kind != LENGTH else before - value
            )
            assert (rise <= change + SMALL).all(), 'wound in, or pulled harder'
            if kind == command.kind == LENGTH:
                assert (value - before <= change + SMALL)[~is_eased].all(), 'paid out'
            if self.has_stopped:
                assert (rise <= SMALL).all(), 'motion after a stop'
        elif command.kind == LENGTH:
            pull = np.maximum(self.core.sample.motor_tension, ROBOT.tension.bias)
            demanded = ROBOT.actuation.demanded(length, value)
            assert (demanded <= pull + stiffness * rate * 0.1 + SMALL)[self.core.robot.used].all()
        if command.kind == LENGTH:
            if self.last_length is not None:
                before, at = self.last_length
                assert (before - value <= rate * (self.now - at) + SMALL).all(), 'length'
            self.last_length = value, self.now
            self.arm.command_length(value)
        else:
            self.arm.command_tension(value)
        self.last = command.kind, value, self.now

    @staticmethod
    def demand(kind, value, length):
        return value if kind == TENSION else ROBOT.actuation.demanded(length, value)

    # -- events ---------------------------------------------------------------------------------

    @rule(theta=POSTURES)
    def target(self, theta):
        with suppress(MessageError):
            self.core.target(dict(zip(ROBOT.joints, ((angle, 0.0) for angle in theta))))

    @rule(wanted=st.booleans())
    def explore(self, wanted):
        self.core.explore(wanted)

    @rule()
    def stop(self):
        self.core.stop(ConditionKind.OPERATOR)
        self.has_stopped = True

    @rule()
    def reset(self):
        if self.core.reset(self.now) is None:
            self.has_stopped = False

    @rule(method=st.sampled_from(list(METHODS)), preset=st.sampled_from(['default', 'paper']))
    def configure(self, method, preset):
        self.core.configure(replace(self.core.settings, method=method, preset=preset))

    @rule(muscles=st.sets(MUSCLES, max_size=2))
    def isolate(self, muscles):
        self.core.use_body(self.core.stream.body.with_isolated(tuple(sorted(muscles))))

    @rule(anomaly=st.sampled_from(Anomaly), suspect=MUSCLES)
    def anomaly(self, anomaly, suspect):
        self.core.use_body(self.core.stream.body.with_anomaly(anomaly, suspect))

    @rule(muscle=MUSCLES, by=st.floats(-0.02, 0.02), known=st.booleans())
    def find_offsets(self, muscle, by, known):
        """Use other length offsets, as after a length calibration."""
        offset = self.offsets.offset.copy()
        offset[muscle] += by
        self.offsets = LengthOffsets.of(offset, np.zeros(COUNT))
        if not known:
            self.offsets = LengthOffsets.unknown(COUNT)
        self.core.use_body(self.core.stream.body.with_offsets(self.offsets))

    @rule(kind=st.sampled_from(FAULTS), muscle=MUSCLES)
    def breaks(self, kind, muscle):
        self.arm.set_faults([f'{kind}:{ROBOT.muscles[muscle]}'])

    @rule()
    def is_mended(self):
        self.arm.set_faults([])

    @rule(what=st.sets(st.sampled_from(['muscles', 'estimate'])))
    def goes_blind(self, what):
        self.blind = what

    @rule(seconds=st.floats(0.01, 2.0))
    def sleeps(self, seconds):
        """Suspend the controller for a time [s], during which the arm continues to move."""
        self.arm.step(seconds)
        self.now += seconds


TestArm = Arm.TestCase
TestArm.settings = settings(max_examples=20, stateful_step_count=30, deadline=None)
