# SPDX-License-Identifier: Apache-2.0
"""Online learning from messages to checkpoints, shared by the node and the experiments.

    θ, (T, l) ─► SampleCollector ─ samples ─► UpdateScheduler ─ job ─► Trainer
                                                                          │ update
                            candidates for the estimator ◄─ CheckpointKeeper ◄
                            decisions of the estimator ─────►    │
                                                                 └─► disk

The estimator validates the candidates (`estimation/network_validation/`). Whatever it decides,
training continues from the newest samples and weights.

Muscles that the estimator has isolated are not learned: samples do not describe them. A network
states without which muscles it was learned; this alone isolates no muscle.

The caller supplies the time: the ROS clock, recorded time or simulated time. All rules for
collecting samples and starting updates use this time. A recording is therefore learned in the same
way as the messages of a robot, except that training takes no time.
"""

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.body_model.sensor_offsets import LARGEST_OFFSET
from musculoskeletal_ae.conditions import Condition
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning.checkpoint_keeper import CheckpointKeeper
from musculoskeletal_ae.learning.collector import MARKER, NONE, SENSOR, SampleCollector
from musculoskeletal_ae.learning.detector_calibration import Reservoir, uncalibrated
from musculoskeletal_ae.learning.learner_status import learner_conditions, learner_report
from musculoskeletal_ae.learning.samples import HELD_TIME, SampleStore
from musculoskeletal_ae.learning.scheduler import LEAST_BLIND, STEPS, Update, UpdateScheduler
from musculoskeletal_ae.learning.training_process import Trainer
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.arrival import Arrival
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.joint_trust_message import JointTrust
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import MuscleSample, RejectionError
from musculoskeletal_ae.signals.pairing import Paired


class Learner:
    """Learns the body of one arm online: collects samples from messages, and updates the network.

    Attributes:
        robot: The nominal body.
        collector: Turns messages into samples.
        scheduler: Decides when an update begins.
        trainer: Computes updates.
        keeper: Stores and publishes networks.
        refused: Number of finished updates that were refused (`impossible_offsets`).
        enabled: Whether the learner learns, see `enable`.
    """

    def __init__(
        self,
        robot: Robot,
        mae: Mae | None = None,
        preset: str = 'default',
        seed: int = 0,
        *,
        steps: int = STEPS,
        period: float = 0.01,
        joint_source: str = SENSOR,
        from_motion: bool = False,
        trainer: Callable[[Robot, str, int], Trainer] = Trainer,
        directory: Path | None = None,
    ) -> None:
        """Continue from the saved state if it fits the robot, otherwise from a network.

        Args:
            robot: The nominal body.
            mae: A network that fits the robot; None to wait for one (`begin`).
            preset: Name of the learning preset.
            seed: Random seed.
            steps: Training steps per update, for preset `default`.
            period: Period of the muscle modules' messages [s].
            joint_source: Source of θ, one of the constants `SENSOR`, `MARKER` and `NONE` of the
                module `collector`.
            from_motion: Whether to learn from slow moments of an arm that never rests
                (`slow_moments`), instead of rests. This needs joint sensors.
            trainer: Creates the trainer.
            directory: State directory for samples and network; None to save nothing.

        Raises:
            MusculoskeletalError: If the preset does not exist, or if there are neither joint
                angles nor tensions.
            StateError: If the directory cannot be used.
        """
        if joint_source == NONE and not robot.tension_source.is_known:
            raise MusculoskeletalError(
                f'joint_source {NONE!r}: without joint angles the learner needs tensions, and '
                f'tension_source of muscles.yaml is none; legal: {SENSOR}, {MARKER}'
            )
        self.robot = robot
        self.enabled, self.refused = True, 0
        self._steps = steps
        self._polled_at = math.inf  # time of the last poll [s]
        self.trainer = trainer(robot, preset, seed)
        samples, of_currents = SampleStore(), robot.tension_source.is_current
        healthy = Reservoir(robot.muscle_count, seed, of_currents=of_currents)
        self.collector = SampleCollector(
            robot, samples, healthy, period, joint_source, from_motion=from_motion
        )
        least = self.trainer.preset.least_samples
        self.scheduler = UpdateScheduler(
            least if joint_source == SENSOR else max(least, LEAST_BLIND)
        )
        self.keeper = CheckpointKeeper(robot, samples, directory)
        saved = self.keeper.load()
        if not samples.held:  # otherwise, the offsets of the held samples were loaded with them
            samples.offset = self.body.offsets.offset
        self._time = -math.inf  # time of the last message [s]
        if saved is not None:
            self._start(saved)
            return
        # Without a usable saved network, repeat as many updates as the saved samples caused when
        # they were collected.
        self.scheduler.restart(updates=len(self.samples))
        if mae is not None:
            self.begin(mae)

    # -- messages → samples ---------------------------------------------------------------------

    def step(self, time: float, theta: Array | None, tension: Array, length: Array) -> bytes | None:
        """Learn from the measurements at `time` [s], and then call `poll`.

        Args:
            time: Time of the measurements [s].
            theta: Joint angles θ [rad], (D,), or None if it was not measured.
            tension: Tensions T [N], (M,).
            length: Muscle lengths l [m], (M,).

        Returns:
            A checkpoint if one is due for publication, else None.
        """
        if theta is not None:
            self.joints(time, theta)
        with suppress(RejectionError):  # it is counted in `rejected`
            self.take(MuscleReadings(length=length, tension=tension), time)
        return self.poll(time)

    def joints(self, time: float, theta: Array) -> None:
        """Record joint angles θ [rad] (D,) received at `time` [s]; NaN marks unmeasured ones."""
        self.collector.joints(time, theta)

    def imu(self, time: float, link: str, acceleration: Array) -> None:
        """Record an accelerometer reading [m/s²] (3,) in the axes of a link at `time` [s]."""
        self.collector.imu(time, link, acceleration)

    def take(self, message: Any, time: float, delay: float = 0.0) -> None:
        """Take a message of muscle_states, and learn from it.

        Args:
            message: The message of `muscle_states`, or `MuscleReadings`.
            time: Time of reception [s].
            delay: How late the message is (`Arrival.delay`) [s].

        Raises:
            RejectionError: If the message cannot be used.
        """
        self._learn_from(self.collector.take(time, message, delay), time)

    def _learn_from(self, paired: Paired[MuscleSample] | None, time: float) -> None:
        self._time = time
        if paired is None or not (self.enabled and self.body.offsets.known):
            return
        for _ in self.collector.collect(paired, time):
            self._note_new_samples()

    def accept(self, sample: Sample) -> None:
        """Store and save a new sample, and schedule an update."""
        self.collector.accept(sample)
        self._note_new_samples()

    def _note_new_samples(self) -> None:
        self.keeper.store()
        self.scheduler.note_news()

    # -- body state, anomalies and enabling -----------------------------------------------------

    @property
    def samples(self) -> SampleStore:
        """The store of the samples from which the learner learns."""
        return self.collector.samples

    @property
    def body(self) -> BodyState:
        """The body state, of which the learner uses offsets, isolated muscles and anomaly."""
        return self.collector.body

    @property
    def joint_trust(self) -> JointTrust:
        """Which joint sensors the estimator trusts."""
        return self.collector.joint_trust

    @property
    def isolated(self) -> tuple[int, ...]:
        """Indices of the isolated muscles."""
        return self.body.isolated

    def use_body(self, body: BodyState) -> None:
        """Use another body state from now on.

        Isolated muscles are not learned. While the length offsets are unknown, or an anomaly is
        present, learning pauses. Samples that may have been taken under wrong length offsets are
        held back, and later dropped or used again (`samples`); all others are kept.
        """
        before, offsets = self.body, body.offsets
        self.collector.use_body(body)
        if offsets != before.offsets:
            if offsets.revoked:
                self.samples.hold(self._time)
                self.collector.healthy.forget_newest(HELD_TIME)
                self.keeper.store()  # also saves which samples are held back
            elif offsets.known:
                if dropped := self.samples.use_offset(offsets.offset):
                    self.collector.rejected['wrong length offsets'] += dropped
                self.keeper.store()
        if body.isolated != before.isolated:
            self.scheduler.note_news()

    def use_joint_trust(self, trust: JointTrust) -> None:
        """Use another trust in the joint sensors: learn nothing from sensors in doubt.

        Their angles since the beginning of the doubt are removed from the samples, and are put back
        if the user confirms the sensors (`samples`).

        Args:
            trust: The trust, with times on the clock of the messages.
        """
        before = self.joint_trust
        self.collector.use_joint_trust(trust)
        unused = self.samples.use_trust(before, trust)
        for joint in unused:
            self.collector.healthy.remove_angles(joint, self._time - trust.since[joint])
        if unused:
            self.reset()
        self._note_new_samples()

    def relearn(self, muscles: Iterable[int]) -> None:
        """Relearn muscles (indices) from samples that will be collected from now on.

        The detector is uncalibrated until there are enough messages of the changed arm.
        """
        for muscle in muscles:
            self._forget(muscle)
            self.collector.reset()
        mae = self.keeper.mae
        if not self.scheduler.statistics_hold and mae is not None and mae.is_calibrated:
            self.keeper.use(uncalibrated(mae))
        self.keeper.store()

    def enable(self, enabled: bool) -> None:
        """Enable or disable learning; samples and network are kept.

        If an update finishes while learning is stopped, its result is discarded.
        """
        if enabled and not self.enabled:
            self.reset()
        self.enabled = enabled

    def reset(self) -> None:
        """Reset the collector: discard incomplete samples, for example after a clock jump."""
        self.collector.reset()

    # -- samples → checkpoints ------------------------------------------------------------------

    def poll(self, now: float, steps: int | None = None) -> bytes | None:
        """Start the next update if it is due, and use the network of an update that has finished.

        Args:
            now: The present time on the clock of the messages [s].
            steps: Training steps of an update that begins now; None for those of the learner.

        Returns:
            A checkpoint if one is due for publication, else None.
        """
        if now < self._polled_at:  # this is the first poll, or the clock was set back
            self.collector.usable = Arrival(since=now)
        self._polled_at = now
        is_learning = self.enabled and not self.body.has_anomaly
        if is_learning and self.trainer.ready and self.scheduler.is_due(now, len(self.samples)):
            data = self.samples, self.collector.healthy, self.isolated
            self.trainer.submit(self.scheduler.begin(now, *data, steps or self._steps))
        update = self.trainer.poll()
        if update is not None:
            self._finish(update, is_learning)
        self.keeper.store(changed=False)
        return self.keeper.take_unpublished()

    def _finish(self, update: Update, is_learning: bool) -> None:
        if not is_learning:  # the user has stopped learning, or the samples may show a faulty arm
            self.scheduler.note_news()
            return
        mae = self.scheduler.finish(update)
        if self.impossible_offsets:
            self.refused += 1
            return
        for muscle, first in update.changed:
            self._forget(muscle, first)
        self.keeper.use(mae)

    def note_accepted(self, mae: Mae) -> None:
        """Note that the estimator uses this network, and save it."""
        # The detector of this network may have been calibrated before a muscle was changed.
        self.keeper.note_accepted(mae if self.scheduler.statistics_hold else uncalibrated(mae))

    def note_rejected(self, version: int, reason: str) -> None:
        """Note that the estimator has rejected the network of this version, and why."""
        self.keeper.note_rejected(version, reason)

    def _forget(self, muscle: int, before: float = math.inf) -> None:
        """Forget a muscle in the samples with numbers below `before`, and schedule an update.

        All messages of the healthy arm are discarded.
        """
        self.samples.forget(muscle, before)
        self.collector.healthy.clear()
        self.scheduler.note_change()

    # -- beginning and end ----------------------------------------------------------------------

    def begin(self, mae: Mae) -> None:
        """Begin with the network `mae`, because no saved one could be loaded; samples are kept."""
        self._start(self.keeper.numbered(mae))

    def replace(self, mae: Mae | None) -> None:
        """Replace samples and network by another network, or by nothing.

        The previous samples and network are saved as a backup first.

        Raises:
            StateError: If the backup cannot be made; nothing is changed then.
        """
        successor = None if mae is None else self.keeper.numbered(mae)
        self.keeper.back_up()
        self.trainer.close()
        self.samples.clear()
        self.collector.healthy.clear()
        self.scheduler.restart()
        self.reset()
        self.keeper.clear()
        if successor is None:
            self.keeper.store()
        else:
            self._start(successor)

    def _start(self, mae: Mae) -> None:
        self.scheduler.statistics_hold = True
        self.trainer.begin(mae)
        self.keeper.restore(mae)

    def save(self) -> Path:
        """Save samples and network now; return the state directory.

        Raises:
            StateError: If there is no directory, or it cannot be written.
        """
        return self.keeper.save()

    def close(self) -> None:
        """End the training process and release the state directory."""
        self.trainer.close()
        self.keeper.close()

    # -- status ---------------------------------------------------------------------------------

    @property
    def mae(self) -> Mae:
        """The newest network; only valid if `checkpoint` is not None."""
        assert self.keeper.mae is not None
        return self.keeper.mae

    @property
    def checkpoint(self) -> bytes | None:
        """The last accepted network, as the content of a checkpoint; None before the first one."""
        return self.keeper.checkpoint

    @property
    def updates(self) -> int:
        """Number of finished updates."""
        return self.scheduler.updates

    @property
    def last_update(self) -> Update | None:
        """The last finished update; None before the first."""
        return self.scheduler.last_update

    @property
    def impossible_offsets(self) -> dict[str, str]:
        """Joints of which the last update estimated an impossibly large sensor offset.

        The texts give the offset and the largest possible one, by the name of the joint. Such an
        update is refused: it has learned from wrong angles, or from lengths with wrong offsets.
        """
        if self.last_update is None or self.last_update.sensor_offset.size == 0:
            return {}
        offset, units = self.last_update.sensor_offset, self.robot.units
        return {
            self.robot.joints[j]: (
                f'{units[j].position_text(offset[j])}, largest '
                f'{LARGEST_OFFSET * units[j].radian:.2f}'
            )
            for j in np.flatnonzero(np.abs(offset) > LARGEST_OFFSET)
        }

    @property
    def idle_time(self) -> float:
        """Time since the last message that was suitable for learning [s].

        It is 0 before the first call of `poll`.
        """
        return 0.0 if math.isinf(self._polled_at) else self.collector.usable.age(self._polled_at)

    def report(self, _: float = 0.0) -> Report:
        """Report the learner's status for /diagnostics."""
        return learner_report(self)

    def conditions(self, _: float) -> tuple[Condition, ...]:
        """Return the conditions for users: why nothing is learned, or what is not on disk."""
        return learner_conditions(self)
