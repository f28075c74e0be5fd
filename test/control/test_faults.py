# SPDX-License-Identifier: Apache-2.0
"""Emulator, estimator and controller in one loop: the consequences of each fault of the arm."""

import copy
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import FIRST_ESTIMATE, Controller
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.faults import KINDS
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import read_muscle_states

ROBOT = Robot.load('arm26')
MUSCLE = ROBOT.muscles[3]
DT = 0.01


class Loop:
    """Emulated arm, estimator and controller, on a simulated clock."""

    def __init__(self, mae):
        self.arm, self.estimator = EmulatedArm(ROBOT, 1), Estimator(ROBOT)
        self.controller = Controller(ROBOT, Settings(first_duration=2.0))
        self.estimator.use(mae)
        self.controller.use(mae)
        self.now, self.commands, self.pulls, self.has_joint_sensors = 0.0, [], [], True
        self.run(0.5)
        self.approach()
        self.run(4.0)
        self.commands.clear()
        self.pulls.clear()

    @property
    def cause(self):
        return (
            ''
            if self.controller.supervisor.condition is None
            else self.controller.supervisor.condition.text
        )

    def run(self, seconds):
        """Step all parts every 10 ms, and exchange messages as their nodes do."""
        for _ in range(round(seconds / DT)):
            self.now += DT
            self.arm.step(DT)
            for read in self.arm.faults.deliver(self.arm.sense(), self.now):
                self.read(read)
            command = self.controller.step(self.now)
            if command is not None:
                self.commands.append(command.value + self.estimator.body.offsets.offset)
                self.arm.command_length(self.commands[-1])
                self.pulls.append(self.arm.tension)

    def read(self, reading):
        data = reading.muscles.rows.ravel()
        message = SimpleNamespace(data=data, layout=SimpleNamespace(dim=[], data_offset=0))
        with suppress(MessageError):
            states = read_muscle_states(message, ROBOT)
            if self.has_joint_sensors:
                self.estimator.joints(reading.theta, self.now)
            # Controller and estimator each check the message. One may reject it, the other not.
            for take in (self.control, self.estimate):
                with suppress(MessageError):
                    take(states)

    def control(self, states):
        self.controller.take(states, self.now)

    def estimate(self, states):
        estimate = self.estimator.take(states, self.now, self.now)
        self.controller.use_body(self.estimator.body)
        if estimate is not None:
            self.controller.estimated(estimate.state.theta, self.now)

    def approach(self):
        """Request the middle of the joint ranges."""
        middle = 0.5 * (ROBOT.lower + ROBOT.upper)
        self.controller.target({n: (a, 0.0) for n, a in zip(ROBOT.joints, middle)})

    def calibrate(self):
        """Calibrate the revoked length offsets, as the advice says, and return to the target."""
        self.estimator.calibrate_lengths()
        self.controller.use_body(self.estimator.body)
        assert self.controller.reset(self.now) is None
        self.controller.explore(True)
        for _ in range(40):
            self.run(1.0)
            if self.estimator.body.offsets.known:
                break
        assert self.estimator.body.offsets.known
        self.approach()
        self.run(4.0)

    def mend(self):
        """Repair the arm, and call the services that a user would call.

        Returns:
            The stop cause that made the controller refuse the reset; None if the reset succeeded.
        """
        self.arm.set_faults([])
        self.arm.reset(self.arm.theta)
        self.run(3.0)
        if self.estimator.body.offsets.revoked:
            self.calibrate()
        self.estimator.reset()
        self.controller.use_body(self.estimator.body)
        refused = self.controller.reset(self.now)
        self.run(2.0)
        return refused


@pytest.fixture(scope='module')
def settled(trained):
    return Loop(trained['default'])


@pytest.fixture
def loop(settled):
    return copy.deepcopy(settled)


#: faults that must not stop the arm, and the duration of each [s]
TOLERATED = {
    'drop:0.5': 1.0,
    'delay': 1.0,
    'duplicate': 1.0,
    'reorder': 1.0,
    f'spike:length:{MUSCLE}': 1.0,
    f'spike:tension:{MUSCLE}:400': 1.0,
    'spike:temperature': 1.0,
    'mount_x:0.5': 1.0,
    'drift:theta:elbow:0.05': 1.0,
    'burst:theta:elbow': 1.0,
    'exchange': 1.0,
    'mount_y:0.5': 1.0,
    f'overheat:{MUSCLE}': 2.5,  # 90 °C: the controller only limits the tension of this muscle
}
thorough = pytest.mark.thorough
#: other faults, the duration of each [s], and a part of the stop cause that it must have. None: the
#: arm may stop for any cause, or go on.
OTHERS = [
    pytest.param('drop:1', 1.0, 'no usable', marks=thorough),
    pytest.param(f'bias:length:{MUSCLE}:0.3', 1.0, 'muscle_states', marks=thorough),
    (f'bias:tension:{MUSCLE}:400', 1.0, 'paid out: tension of'),
    pytest.param(f'bias:temperature:{MUSCLE}:90', 2.5, 'overheated', marks=thorough),
    (f'overheat:{MUSCLE}:120', 2.5, 'overheated'),
    pytest.param(f'freeze:{MUSCLE}', 2.5, None, marks=thorough),
    pytest.param('freeze', 1.5, None, marks=thorough),
    (f'dead_sensor:{MUSCLE}', 1.5, None),
    (f'nan_sensor:{MUSCLE}', 1.0, 'no usable'),
    pytest.param(f'dead_sensor:tension:{MUSCLE}', 2.5, None, marks=thorough),
    (f'stuck_motor:{MUSCLE}', 1.5, None),
    (f'slack:{MUSCLE}', 1.5, None),
    pytest.param(f'rupture:{MUSCLE}', 1.5, None, marks=thorough),
    pytest.param(f'offset:{MUSCLE}:0.1', 1.0, 'length', marks=thorough),
    pytest.param(f'saturate:{MUSCLE}:60', 1.5, None, marks=thorough),
    (f'winch_speed:{MUSCLE}:0.009', 1.5, None),
    # The cause is either an implausible length or a jump.
    (f'unzeroed:{MUSCLE}:0.1', 1.0, 'length'),
]


def check_that_no_command_jumped(loop):
    steps = np.diff(loop.commands, axis=0)
    tick = loop.controller.settings.rate_limit * DT * (1.0 + 1e-9)
    eased = np.array(loop.pulls)[1:] > ROBOT.tension.limit
    assert np.isfinite(steps).all()
    assert steps.min() >= -tick
    assert steps[~eased].max(initial=0.0) <= tick


def test_under_tolerable_faults_the_arm_goes_on_and_no_command_jumps(loop):
    held = loop.arm.theta
    for fault, seconds in TOLERATED.items():
        loop.arm.set_faults([fault])
        loop.run(seconds)
        assert loop.cause == '', fault
    check_that_no_command_jumped(loop)
    assert np.linalg.norm(loop.arm.theta - held) < 0.35


@pytest.mark.parametrize(('fault', 'seconds', 'cause'), OTHERS)
def test_under_other_faults_no_command_jumps_and_the_arm_resumes_after_the_repair(
    loop, fault, seconds, cause
):
    held = loop.arm.theta
    loop.arm.set_faults([fault])
    loop.run(seconds)
    assert cause is None or cause in loop.cause
    check_that_no_command_jumped(loop)
    assert loop.mend() is None
    assert loop.cause == ''
    assert np.linalg.norm(loop.arm.theta - held) < 0.35


def longest_overload(loop):
    """Return the longest time [s] for which a tension exceeded 1.1 times its limit."""
    longest, time = 0.0, np.zeros(ROBOT.muscle_count)
    for tension in loop.pulls:
        time = np.where(tension > 1.1 * ROBOT.tension.limit, time + DT, 0.0)
        longest = max(longest, time.max())
    return longest


@pytest.mark.parametrize(
    ('offset', 'muscles'),
    [
        (0.05, [3]),
        (0.1, range(6)),
        *(pytest.param(offset, [3], marks=thorough) for offset in (0.1, 0.3, -0.1)),
        *(pytest.param(offset, range(6), marks=thorough) for offset in (0.05, 0.3, -0.1)),
    ],
)
def test_modules_that_lose_their_length_offsets_do_not_overload_the_arm(loop, offset, muscles):
    lost = np.where(np.isin(range(6), muscles), offset, 0.0)
    loop.arm.set_length_offset(lost * np.where(np.arange(6) % 2, 1.0, -1.0))
    loop.run(2.0)
    assert loop.cause
    assert longest_overload(loop) <= 0.1


@pytest.mark.parametrize('moves', [True, False])
def test_the_services_of_a_length_calibration_may_follow_each_other_at_once(loop, moves):
    loop.has_joint_sensors = False
    if moves:
        loop.controller.explore(True)
    else:
        loop.controller.stop(ConditionKind.LENGTH_OFFSETS_REVOKED)
    loop.run(1.0)
    loop.estimator.calibrate_lengths()
    loop.controller.use_body(loop.estimator.body)
    assert loop.controller.reset(loop.now) is None
    assert loop.controller.explore(True) == ''
    loop.run(2.0)
    assert loop.cause == ''
    assert np.ptp(loop.commands[-200:], axis=0).max() > 0.005
    loop.estimator.calibrate_lengths()
    loop.controller.use_body(loop.estimator.body)
    loop.estimate = lambda _: None  # from now on, the estimator does not respond
    loop.run(FIRST_ESTIMATE + 0.5)
    assert 'no usable estimated_joint_states' in loop.cause


def test_every_kind_of_fault_has_a_promise():
    others = [case.values[0] if hasattr(case, 'values') else case[0] for case in OTHERS]
    assert {fault.split(':')[0] for fault in [*TOLERATED, *others]} == set(KINDS)
