# SPDX-License-Identifier: Apache-2.0
"""A controller without an arm: the test provides sensor data and time."""

import copy
from dataclasses import replace
from functools import cache, lru_cache

import numpy as np
from exact_mae import ExactMae, rest_readings
from readings import reading

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.motion.activities import LENGTH, Inputs, unchanging
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import Anomaly
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

ROBOT = Robot.load('arm26')
DT = 0.01
REST = np.array([-0.3, -1.0])
OTHER = np.array([0.1, -0.5])
COLD = np.full(ROBOT.muscle_count, 30.0)


def sample(length, tension, robot=ROBOT, temperature=30.0):
    """Return a sample of the muscle stream; a number applies to all muscles."""
    rows = [np.broadcast_to(row, robot.muscle_count) for row in (length, tension, temperature)]
    read = reading(rows)
    return MuscleSample(
        time=0.0,
        length=read.length,
        length_read=read.length,
        tension_read=read.tension,
        motor_tension=read.tension,
        bone_tension=read.tension,
        sliding=np.zeros(robot.muscle_count),
        temperature=read.temperature,
        usable=robot.used,
        newest=read,
    )


def inputs(mae, theta, limit, robot=ROBOT, dt=DT, tension=None):
    """Return the inputs of an activity of the controller for an arm at rest at θ.

    `limit` is the tension limit of the muscles, and `tension` their tension [N].
    """
    tension = robot.tension.bias if tension is None else tension
    now = sample(mae.lengths(theta, tension), tension, robot)
    return Inputs(
        mae=mae,
        sample=now,
        motor_tension=tension,
        bone_tension=tension,
        theta=theta,
        length=unchanging(robot, LENGTH, now).value,
        tension=tension,
        limit=limit,
        target=None,
        effort=np.zeros(robot.joint_count),
        dt=dt,
    )


@lru_cache(maxsize=8)
def _readings(theta, tension):
    """Return (l, T) of the arm at rest; the last ones are kept, because few benches move."""
    return rest_readings(ROBOT, np.array(theta), None if tension is None else np.array(tension))


class Bench:
    """A controller with healthy sensor data, unless a test changes them."""

    def __init__(self, mae=None, **chosen):
        # The arm of the bench stands still whatever is commanded. Unless a test states durations,
        # movements to a target take as long as the first one.
        settings = Settings(**chosen)
        if 'target_duration' not in chosen:
            settings = replace(settings, target_duration=settings.first_duration)
        self.core = Controller(ROBOT, settings)
        self.mae = mae or ExactMae(ROBOT)
        self.core.use(self.mae)
        self.now, self.dt = 100.0, DT
        self.theta, self.tension, self.temperature = REST, None, COLD
        self.blind = set()

    def step(self, count=1):
        """Run `count` steps of `dt` with the sensor data of the bench; return the commands."""
        sent = []
        for _ in range(count):
            self.now += self.dt
            if 'muscles' not in self.blind:
                pull = None if self.tension is None else tuple(self.tension)
                length, tension = _readings(tuple(self.theta), pull)
                self.send(np.array([length, tension, self.temperature]))
            if 'estimate' not in self.blind:
                self.core.estimated(self.theta, self.now)
            sent.append(self.core.step(self.now))
        return sent

    def send(self, read):
        """Give the controller a message of muscle states (3, M)."""
        self.core.take(reading(read), self.now)

    def configure(self, **chosen):
        self.core.configure(replace(self.core.settings, **chosen))

    def target(self, theta, effort=(0.0, 0.0)):
        self.core.target(dict(zip(ROBOT.joints, zip(theta, effort))))

    def isolate(self, muscles):
        self.core.use_body(self.core.stream.body.with_isolated(muscles))

    def find(self, muscle=0):
        """Let the estimator find a fault of a muscle."""
        self.core.use_body(self.core.stream.body.with_anomaly(Anomaly.FOUND, muscle))

    def verify(self, muscle):
        """Let the estimator find a fault of a muscle, isolate and verify it."""
        body = self.core.stream.body.with_anomaly(Anomaly.VERIFYING, muscle)
        self.core.use_body(body.with_isolated([*body.isolated, muscle]))

    def end_anomaly(self, isolated=None):
        """Let the estimator end the anomaly; `isolated` are the muscles isolated from then on."""
        body = self.core.stream.body
        isolated = body.isolated if isolated is None else isolated
        ended = body.with_anomaly(Anomaly.ENDED, body.suspect).with_isolated(isolated)
        self.core.use_body(ended)

    def stop(self):
        self.core.stop(ConditionKind.OPERATOR)

    @property
    def follower(self):
        return self.core.activities.follower

    @property
    def cause(self):
        """The identifier of the stop cause, or ''."""
        condition = self.core.supervisor.condition
        return '' if condition is None else condition.identifier

    @property
    def condition(self):
        """The stop cause with its details as a text, or ''."""
        condition = self.core.supervisor.condition
        return '' if condition is None else condition.text

    def report(self):
        return self.core.report(self.now)

    def steps(self):
        """The identifiers of the steps that the controller advises, in order."""
        return [step.identifier for step in self.report().steps]


@cache
def _settled(kind, steps, **chosen):
    bench = kind(**chosen)
    bench.target(REST)
    bench.step(steps)
    return bench


def settled(steps=100, kind=Bench, **chosen):
    """Return a copy of a bench that has commanded the posture REST for a number of steps."""
    return copy.deepcopy(_settled(kind, steps, **chosen))


def values(commands):
    return np.array([command.value for command in commands])
