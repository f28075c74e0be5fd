# SPDX-License-Identifier: Apache-2.0
"""An arm without tension sensors: its tensions are assumed, and some methods are excluded."""

from dataclasses import replace

import numpy as np
import pytest
from exact_mae import ExactMae
from readings import reading
from robots import with_modules, write_robot
from sensor_loop import WithJointSensors

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import METHODS, Settings
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.exceptions import MusculoskeletalError, RobotDescriptionError
from musculoskeletal_ae.learning.collector import NONE
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.motion.activities import LENGTH
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import LengthOffsets
from musculoskeletal_ae.signals.muscle_stream import MuscleStream, RejectionError

KNOWN = Robot.load('arm26')
ROBOT = Robot(with_modules(KNOWN.description, actuation='position', tension_source='none'))
COUNT, THETA = ROBOT.muscle_count, np.array([-0.3, -1.0])


@pytest.fixture(scope='module')
def loop():
    loop = WithJointSensors(make_arm(ROBOT, 0), ExactMae(ROBOT))
    loop.wait(0.1)
    loop.target(THETA)
    loop.wait(4.0)
    return loop


def test_the_emulator_measures_no_tension_and_the_stream_assumes_one():
    arm = make_arm(ROBOT, 0)
    read = arm.sense().muscles
    assert np.isnan(read.tension).all()
    # Without a tension source, the stream ignores whatever tension a message contains.
    for tension in (read.tension, np.zeros(COUNT), np.full(COUNT, 77.0)):
        sample = MuscleStream(ROBOT, window=3).take(read.replace(tension=tension), 0.0)
        np.testing.assert_array_equal(sample.motor_tension, ROBOT.actuation.assumed_tension)
        np.testing.assert_array_equal(sample.bone_tension, ROBOT.actuation.assumed_tension)
    with pytest.raises(RejectionError):  # lengths are still checked
        MuscleStream(ROBOT).take(read.replace(length=read.length + 5.0), 0.0)


def test_muscle_stiffness_control_without_a_tension_is_refused(tmp_path):
    with pytest.raises(RobotDescriptionError, match='needs actuation: position'):
        Robot.load(write_robot(tmp_path, tension_source='none'))
    legal = 'expected one of current, none, sensor'
    with pytest.raises(RobotDescriptionError, match=f"{legal}, got 'weight'"):
        Robot.load(write_robot(tmp_path, tension_source='weight', actuation='position'))
    robot = Robot.load(write_robot(tmp_path, tension_source='none', actuation='position'))
    assert any('contact estimation' in line for line in robot.description.notes)


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('preset', ['default', 'paper'])
def test_methods_that_need_a_tension_are_refused_with_the_reason(method, preset):
    settings = Settings(method=method, preset=preset)
    is_legal = method in ('geometric', 'first') or (method, preset) == ('proposed', 'default')
    if is_legal:
        Controller(ROBOT, settings)
        return
    with pytest.raises(
        MusculoskeletalError, match=r'tension_source in muscles.yaml is `none`; legal'
    ):
        Controller(ROBOT, settings)
    core = Controller(ROBOT)
    before = core.settings
    with pytest.raises(MusculoskeletalError):
        core.configure(settings)
    assert core.settings is before


def test_the_arm_reaches_a_target_by_lengths_alone_and_reports_missing_tensions(loop):
    assert loop.core.supervisor.is_running
    assert np.abs(loop.arm.theta - THETA).max() < 0.15
    assert loop.core.limiter.command.kind == LENGTH
    values = loop.core.report(loop.time).values
    assert 'heat limit' in values['tension'] and 'contact' in values['tension']


def test_no_command_runs_further_ahead_of_a_module_than_its_release(loop):
    limiter, sample = loop.core.limiter, loop.core.sample
    assert limiter.command is not None
    lead = sample.length - limiter.command.value
    assert (lead <= ROBOT.actuation.release + 1e-9).all()
    stuck = replace(sample, length=limiter.command.value + 0.5 * ROBOT.actuation.release)
    far = limiter.command._replace(value=limiter.command.value - 1.0)
    before = limiter.command.value.copy()
    for _ in range(100):
        sent = limiter.limit(far, stuck, ROBOT.tension.limit, 0.01).value
    assert (stuck.length - sent <= ROBOT.actuation.release + 1e-9).all()
    assert (sent < before).all()


def test_a_stop_pays_out_the_stated_length(loop):
    core = loop.core
    before = core.limiter.command.value.copy()
    core.stop(ConditionKind.OPERATOR)
    loop.wait(3.0)
    paid_out = core.limiter.command.value - before
    most = np.minimum(ROBOT.actuation.release, core.limiter.longest - before)
    assert (paid_out > 0.5 * most).all()


def test_lengths_are_calibrated_in_a_stated_posture_only_and_nothing_explores_before(trained):
    core = Estimator(ROBOT)
    core.use(trained['default'])
    with pytest.raises(MusculoskeletalError, match='zero_posture'):
        core.calibrate_lengths()
    assert core.calibration is None
    control = Controller(ROBOT)
    control.use_body(control.stream.body.with_offsets(LengthOffsets.unknown(COUNT)))
    assert 'zero_posture' in control.explore(True)


def test_the_estimator_estimates_from_lengths_and_names_what_is_unknown(trained):
    core, mae = Estimator(ROBOT), trained['default']
    core.use(mae)
    length = mae.lengths(THETA, ROBOT.actuation.assumed_tension)
    shake = np.random.default_rng(0)
    for n in range(100):
        noisy = length + 1e-4 * shake.normal(size=COUNT)
        states = np.array([noisy, np.full(COUNT, np.nan), np.full(COUNT, 25.0)])
        output = core.take(reading(states), 0.01 * n, 0.01 * n)
    assert core.cause == ''
    assert np.abs(output.state.theta - THETA).max() < 0.05
    assert output.contact is None
    values = core.report(1.0).values
    assert values['contact'].startswith('unknown') and values['tension'].startswith('unknown')


def test_the_learner_needs_joint_angles_or_tensions():
    with pytest.raises(MusculoskeletalError, match=r'joint_source .* legal: sensor, marker'):
        Learner(ROBOT, None, 'default', joint_source=NONE)
