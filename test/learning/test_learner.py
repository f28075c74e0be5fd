# SPDX-License-Identifier: Apache-2.0
"""The life cycle of the learner, and its rules that depend on time. The tests provide the time."""

from dataclasses import replace

import numpy as np
import pytest
from robots import write_robot

from musculoskeletal_ae.estimation.finding import DETECTION_DELAY
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.scheduler import Update
from musculoskeletal_ae.learning.training_process import Trainer
from musculoskeletal_ae.mae.residuals import AnomalyStatistics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import Anomaly, LengthOffsets

DT = 0.02  # time between two messages [s]


class IdleTrainer(Trainer):
    """A trainer that does not train: it returns its initial network once `released` is true."""

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self.jobs, self.released, self.calibrated, self.changed = [], True, False, ()
        self._job = None

    def begin(self, mae):
        self._mae, self._job = mae, None

    @property
    def ready(self):
        return self._job is None

    def submit(self, job):
        self.jobs.append(job)
        self._job = job

    def poll(self):
        if self._job is None or not self.released:
            return None
        self._job = None
        statistics = AnomalyStatistics(np.zeros(12), np.eye(12), self.calibrated, 100)
        mae = replace(self._mae, anomaly=statistics)
        return Update(mae, 0.0, changed=self.changed)

    def close(self):
        self._job = None


@pytest.fixture
def learner(arm26, initial):
    return Learner(arm26, initial, trainer=IdleTrainer)


def accept(learner, stage, count):
    for _ in range(count):
        learner.accept(stage.sample())


def between(start, end, count):
    """Yield `count` samples at equal distances on the way from rest `start` to rest `end`."""
    for share in np.linspace(0.0, 1.0, count + 2)[1:-1]:
        yield end._replace(length=(1.0 - share) * start.length + share * end.length)


class Arm:
    """An arm that rests in one posture after another, on a simulated clock."""

    MOVES = 10  # number of messages on the way between two postures

    def __init__(self, learner, stage, time=0.0):
        self.learner, self.stage, self.time, self.published = learner, stage, time, []
        self.last = None

    def rest(self, seconds, sample=None):
        sample = sample or self.stage.sample()
        if self.last is not None:
            for moving in between(self.last, sample, self.MOVES):
                self.send(moving)
        self.last = sample
        for _ in range(round(seconds / DT)):
            self.send(sample)
        return sample

    def send(self, sample):
        self.time += DT
        data = self.learner.step(self.time, sample.theta, sample.tension, sample.length)
        if data is not None:
            self.published.append(self.time)


def test_the_same_stream_gives_the_same_network(arm26, initial, stage):
    rests = [stage.sample() for _ in range(4)]
    networks = []
    for _ in range(2):
        learner = Learner(arm26, initial, steps=3)
        arm = Arm(learner, stage)
        for rest in rests:
            arm.rest(1.1, rest)
        arm.rest(3.0, rests[0])
        networks.append(learner.mae)
        assert learner.updates >= 3
    np.testing.assert_array_equal(networks[0].encoder[0][0], networks[1].encoder[0][0])


def test_a_rest_becomes_one_sample_and_the_same_posture_no_second_one(learner, stage):
    arm = Arm(learner, stage)
    posture = arm.rest(1.0 + DETECTION_DELAY + 0.5)
    assert len(learner.samples) == 1
    arm.rest(5.0, posture)
    assert len(learner.samples) == 1
    assert learner.collector.rejected['like a stored one'] > 0
    arm.rest(1.0 + DETECTION_DELAY + 0.5)
    assert len(learner.samples) == 2


def test_two_centimetres_of_a_prismatic_joint_are_another_posture(tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    learner, pull = Learner(robot), np.full(robot.muscle_count, 60.0)
    theta = 0.5 * (robot.lower + robot.upper)
    theta[-1], length = 0.01 / 0.06, robot.muscle_lengths(theta, pull)
    # The arm rests for 4 s, moves at 5 mm/s for 4 s while no length changes, and rests again.
    for time in np.arange(0.0, 12.0, DT):
        moved = np.array([0.0, 0.0, 0.0, 0.005 * DT * (4.0 <= time < 8.0)])
        theta = theta + robot.units.to_theta(moved)
        learner.step(time, theta, pull, length)
    positions = [robot.units.to_position(each.theta)[-1] for each in learner.samples.samples]
    np.testing.assert_allclose(positions, [0.01, 0.03], atol=1e-4)


def test_a_new_sample_brings_one_update_at_least_a_second_after_the_last(learner, stage):
    learner.accept(stage.sample())
    for now in np.arange(0.0, 5.0, 0.25):
        learner.poll(now)
    assert learner.trainer.jobs == []  # an update requires at least two samples
    times = []
    for now in np.arange(5.0, 10.0, 0.25):
        if now < 6.0:
            learner.accept(stage.sample())
        before = len(learner.trainer.jobs)
        learner.poll(now)
        times += [now] * (len(learner.trainer.jobs) - before)
    assert times == [5.0, 6.0]
    assert [len(job.observed) for job in learner.trainer.jobs] == [2, 5]


def test_preset_paper_makes_one_update_of_a_sample_from_the_twenty_first_on(arm26, initial, stage):
    learner = Learner(arm26, initial, 'paper', trainer=IdleTrainer)
    for count in range(1, 23):
        learner.accept(stage.sample())
        for now in (3.0 * count, 3.0 * count + 1.5):
            learner.poll(now)
    assert [len(job.observed) for job in learner.trainer.jobs] == [21, 22]


def test_a_sample_received_during_an_update_is_learned_in_the_next(learner, stage):
    accept(learner, stage, 2)
    learner.trainer.released = False
    learner.poll(0.0)
    learner.accept(stage.sample())
    learner.poll(2.0)
    assert len(learner.trainer.jobs) == 1
    learner.trainer.released = True
    for now in (3.0, 4.0, 5.0, 6.0):
        learner.poll(now)
    assert [len(job.observed) for job in learner.trainer.jobs] == [2, 3]


def test_each_checkpoint_is_published_once_unless_a_newer_one_replaces_it(learner, initial):
    assert learner.poll(100.0) is not None
    learner.keeper.use(initial)
    learner.keeper.use(initial)
    assert learner.poll(100.5) == learner.checkpoint
    assert learner.poll(102.0) is None
    assert learner.keeper.published == 2


def test_a_clock_that_goes_back_stops_neither_updates_nor_checkpoints(learner, stage):
    arm = Arm(learner, stage, 1e9)
    arm.rest(1.5)
    for _ in range(2):
        learner.accept(stage.sample())
        learner.poll(arm.time)
    learner.accept(stage.sample())
    jobs, published = len(learner.trainer.jobs), learner.keeper.published
    arm.time = 0.0
    arm.rest(0.1)
    assert len(learner.trainer.jobs) == jobs + 1
    assert learner.keeper.published == published + 1


def test_an_anomaly_stops_learning_until_its_reset(learner, stage):
    accept(learner, stage, 2)
    learner.use_body(learner.body.with_anomaly(Anomaly.FOUND, 0))
    arm = Arm(learner, stage)
    arm.rest(10.0)
    assert learner.trainer.jobs == []
    assert len(learner.samples) == 2
    learner.use_body(learner.body.with_anomaly(Anomaly.ENDED, 0))
    arm.rest(2.0 * DETECTION_DELAY + 1.5)
    assert len(learner.samples) == 3
    assert learner.trainer.jobs


def test_a_disabled_learner_learns_nothing(learner, stage):
    accept(learner, stage, 2)
    learner.enable(False)
    arm = Arm(learner, stage)
    arm.rest(10.0)
    assert learner.trainer.jobs == []
    assert len(learner.samples) == 2
    learner.enable(True)
    arm.rest(DETECTION_DELAY + 1.5)
    assert len(learner.samples) == 3


def test_nothing_is_learned_while_the_length_offsets_are_unknown(learner, stage):
    learner.use_body(learner.body.with_offsets(LengthOffsets.unknown(6)))
    arm = Arm(learner, stage)
    arm.rest(2.0 * DETECTION_DELAY)
    assert len(learner.samples) == 0
    assert 'length offsets are unknown' in learner.report().message
    learner.use_body(learner.body.with_offsets(LengthOffsets.none(6)))
    # The learner first compares the new offsets with messages, so the first sample comes later.
    arm.rest(3.0 * DETECTION_DELAY)
    assert len(learner.samples) == 1


def calibrated(learner):
    return learner.mae.anomaly.calibrated


def test_a_muscle_relearned_during_an_update_leaves_no_calibrated_detector(learner, stage):
    accept(learner, stage, 3)
    learner.trainer.calibrated, learner.trainer.released = True, False
    learner.poll(0.0)
    learner.relearn([2])
    learner.trainer.released = True
    learner.poll(0.5)
    assert not calibrated(learner)
    assert not any(each.known[2] for each in learner.samples.stored)
    learner.poll(1.5)  # returns an update that began after the change, so its statistics are valid
    assert not learner.trainer.jobs[-1].statistics_hold
    assert calibrated(learner)


def test_a_changed_muscle_is_relearned_from_the_samples_since_its_change(learner, stage):
    accept(learner, stage, 6)
    learner.trainer.calibrated, learner.trainer.changed = True, ((1, 3),)
    learner.trainer.released = False
    learner.poll(0.0)
    accept(learner, stage, 2)  # during the update, which finds that sample 3 is of a changed muscle
    learner.trainer.released = True
    learner.poll(0.5)
    assert [bool(each.known[1]) for each in learner.samples.stored] == [False] * 2 + [True] * 6
    assert not calibrated(learner)


def test_distinct_rests_are_counted_since_the_arm_was_changed(learner, stage):
    arm = Arm(learner, stage)
    for _ in range(3):
        posture = arm.rest(1.5)
    arm.rest(DETECTION_DELAY, posture)
    for _ in range(2):
        learner.poll(arm.time)
        arm.rest(1.0, posture)
    assert learner.trainer.jobs[-1].healthy.rests == len(learner.samples) >= 3
    learner.relearn([0])
    arm.rest(2.0 + DETECTION_DELAY, posture)
    assert learner.trainer.jobs[-1].healthy.rests <= 1


def test_a_roll_back_does_not_restore_the_calibration_of_the_arm_before(learner, initial, stage):
    statistics = AnomalyStatistics(np.zeros(12), np.eye(12), True, 100)
    learner.replace(replace(initial, anomaly=statistics))
    arm = Arm(learner, stage)
    arm.rest(15.0)
    assert calibrated(learner)
    learner.relearn([2])
    arm.rest(3.0)
    learner.use_body(learner.body.with_anomaly(Anomaly.FOUND, 0))
    arm.rest(0.5)
    assert not calibrated(learner)


def test_a_replaced_network_does_not_change_the_isolated_muscles(learner, initial):
    learner.use_body(learner.body.with_isolated((3,)))
    learner.replace(initial)
    assert learner.isolated == (3,)
    assert learner.mae.isolated == ()


def test_a_replaced_network_drops_samples_and_continues_the_version_count(learner, initial, stage):
    accept(learner, stage, 3)
    version = learner.mae.version
    learner.replace(initial)
    assert len(learner.samples) == 0
    assert learner.mae.version == version + 1
    assert learner.poll(0.0) == learner.checkpoint  # the new network is published at once
    learner.replace(None)
    assert learner.checkpoint is None
    learner.accept(stage.sample())
    assert learner.poll(5.0) is None


class PartlySensedArm(Arm):
    """An arm of which only some joints have sensors."""

    read = ()

    def rest(self, seconds, sample=None):
        sample = sample or self.stage.sample()
        theta = np.full(2, np.nan)
        theta[list(self.read)] = sample.theta[list(self.read)]
        theta = theta if self.read else None
        return super().rest(seconds, sample._replace(theta=theta))

    def send(self, sample):
        super().send(sample if self.read else sample._replace(theta=None))


def test_without_joint_sensors_rest_is_detected_from_the_muscles(arm26, initial, stage):
    learner = Learner(arm26, initial, trainer=IdleTrainer, joint_source='none')
    arm = PartlySensedArm(learner, stage)
    for _ in range(25):
        arm.rest(1.1)
    assert len(learner.samples) >= 20
    assert np.isnan(learner.samples.observations().theta).all()
    # Without joint sensors, the first update requires 20 samples.
    assert len(learner.trainer.jobs[0].observed) == 20


def test_with_joint_sensors_a_rest_needs_at_least_one_joint_angle(arm26, initial, stage):
    for read, samples in (((), 0), ((1,), 3)):
        learner = Learner(arm26, initial, trainer=IdleTrainer)
        arm = PartlySensedArm(learner, stage)
        arm.read = read
        for _ in range(6):
            arm.rest(1.1)
        assert len(learner.samples) >= samples
        assert (len(learner.samples) > 0) == (samples > 0)
        for sample in learner.samples.samples:
            assert np.isfinite(sample.theta).tolist() == [False, True]


UP = np.array([0.0, 0.0, 9.8])  # accelerometer's reading at rest while its link hangs down [m/s²]


def test_an_accelerometer_adds_the_direction_of_gravity_to_the_rests_it_is_received_in(
    arm26, initial, stage
):
    learner = Learner(arm26, initial, trainer=IdleTrainer, joint_source='none')
    arm, last, rests = PartlySensedArm(learner, stage), stage.sample(), []
    for heard in (['upper_arm'], ['upper_arm', 'forearm'], []):
        last, before = stage.sample(), last
        rests.append((last, heard))
        for sample in between(before, last, 40):
            arm.send(sample)
        arm.last = last
        for _ in range(11):
            arm.rest(0.1, last)
            for link in heard:
                learner.imu(arm.time, link, UP)
    arm.rest(DETECTION_DELAY + 0.1)
    for sample, heard in rests:
        reported = min(
            learner.samples.samples, key=lambda s: np.abs(s.length - sample.length).max()
        )
        expected = np.full((len(arm26.kinematics.tree.parent) * bool(heard), 3), np.nan)
        for joint, placement in map(arm26.kinematics.placement, heard):
            expected[joint] = placement.rotation @ [0.0, 0.0, -1.0]
        np.testing.assert_allclose(reported.gravity, expected.ravel(), atol=1e-9)


def test_an_accelerometer_reading_in_motion_is_not_used_for_the_next_rest(arm26, initial, stage):
    learner = Learner(arm26, initial, trainer=IdleTrainer, joint_source='none')
    arm, start, end = PartlySensedArm(learner, stage), stage.sample(), stage.sample()
    arm.rest(1.0, start)
    for sample in between(start, end, 40):
        arm.send(sample)
        learner.imu(arm.time, 'forearm', UP)
    arm.rest(1.0 + DETECTION_DELAY + 0.1, end)
    assert len(learner.samples) >= 2
    assert not any(sample.gravity.size for sample in learner.samples.samples)


def find(learner, is_present):
    """Let the estimator find a fault of a muscle, or end the anomaly."""
    anomaly = Anomaly.FOUND if is_present else Anomaly.ENDED
    learner.use_body(learner.body.with_anomaly(anomaly, 0))


@pytest.mark.parametrize(
    ('stop', 'goes_back'),
    [(find, True), (lambda learner, stopped: learner.enable(not stopped), False)],
)
def test_an_update_that_ends_while_learning_is_stopped_is_not_used(learner, stage, stop, goes_back):
    accept(learner, stage, 3)
    learner.poll(0.0)
    learner.trainer.released = False
    learner.accept(stage.sample())
    learner.poll(2.0)
    checkpoint, updates = learner.checkpoint, learner.updates
    stop(learner, True)
    learner.trainer.released = True
    published = learner.poll(4.0)
    assert learner.trainer.ready and learner.updates == updates
    if not goes_back:  # after an anomaly, the learner publishes the previous network instead
        assert published is None and learner.checkpoint == checkpoint
    stop(learner, False)
    jobs = len(learner.trainer.jobs)
    learner.poll(6.0)
    # The update that was not used is repeated after the stop, so that its sample is learned.
    assert len(learner.trainer.jobs) == jobs + 1


NAN = np.nan


@pytest.mark.parametrize(
    ('angles', 'shift', 'obstacle'),
    [
        ([NAN, NAN], 0.0, 'without usable joint angles'),
        ([9.0, 9.0], 0.0, 'without usable joint angles'),
        ([9.0, 0.0], 0.0, ''),  # the estimator reports the impossible readings
        ([0.1, 0.2], 5.0, 'muscle_states are rejected'),
        (None, 0.0, 'without usable joint angles'),
        ([0.1, NAN], 0.0, ''),  # one joint sensor is enough for a sample
    ],
)
def test_a_learner_that_gets_nothing_to_learn_from_warns_and_names_why(
    learner, stage, angles, shift, obstacle
):
    sample = stage.sample()
    learner.poll(0.0)
    for time in np.arange(0.0, 8.0, DT):
        theta = None if angles is None else np.array(angles)
        learner.step(time, theta, sample.tension, sample.length + shift)
    report = learner.report()
    assert report.level == ('warn' if obstacle else 'ok')
    assert obstacle in report.message
    assert ('no usable data for' in report.message) == bool(obstacle)


@pytest.mark.parametrize(('value', 'count'), [(-np.pi, 1), (0.0, 1), (0.0, 40)])
def test_impossible_joint_readings_are_never_learned(learner, stage, value, count):
    arm, sample = Arm(learner, stage), stage.sample()
    arm.rest(1.5, sample)
    wrong = np.array([sample.theta[0], value])
    for _ in range(count):
        arm.send(sample._replace(theta=wrong))
    arm.rest(DETECTION_DELAY + 3.0, sample)
    assert len(learner.samples) == 1
    np.testing.assert_allclose(learner.samples.samples[0].theta, sample.theta, atol=1e-6)


def test_messages_after_the_last_poll_are_no_silence(learner, stage):
    sample = stage.sample()
    learner.poll(0.0)
    for time in np.arange(0.0, 8.0, DT):
        learner.step(time, sample.theta, sample.tension, sample.length)
    learner.poll(7.5)
    assert learner.report().level == 'ok'


def test_messages_stamped_in_the_future_are_no_silence(learner, stage):
    sample = stage.sample()
    learner.poll(0.0)
    for time in np.arange(0.0, 8.0, DT):
        learner.step(time + 30.0, sample.theta, sample.tension, sample.length)
        learner.poll(time)
    assert learner.report().level == 'ok'


def test_silence_is_reported_as_nothing_to_learn_from(learner):
    learner.poll(100.0)
    assert learner.report().level == 'ok'
    learner.poll(120.0)
    assert learner.report().message.endswith(
        ': no usable data for 20 s: no muscle_states are received'
    )
    learner.poll(3.0)  # the clock was set back
    assert learner.report().level == 'ok'
