# SPDX-License-Identifier: Apache-2.0
"""Validates, numbers, stores, publishes and rolls back networks.

    candidate ─► validated on the arm's messages ─► numbered ─► on disk ─► published
                                                       ▲
    anomaly ─► the last network that was in use long enough without an anomaly

If there is a state directory, every network is saved before it is published. A failed save is
retried, and does not prevent the publication.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.checkpoint_validation import CheckpointValidator
from musculoskeletal_ae.estimation.healthy_torque import HealthyTorque
from musculoskeletal_ae.exceptions import GateError, StateError
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.scheduler import is_recent
from musculoskeletal_ae.learning.state import StateStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample


class Publication:
    """Releases each new checkpoint once, and at most one per second.

    Attributes:
        checkpoint: The newest checkpoint; None before the first.
        count: Number of checkpoints released.
    """

    def __init__(self) -> None:
        self.checkpoint: bytes | None = None
        self.count = 0
        self._is_pending = False
        self._published_at = -math.inf

    def offer(self, data: bytes | None) -> None:
        """Replace the checkpoint and mark it for publication; None withdraws it."""
        self.checkpoint, self._is_pending = data, data is not None

    def hurry(self) -> None:
        """Release the next checkpoint without waiting."""
        self._published_at = -math.inf

    def take(self, now: float) -> bytes | None:
        """Return the checkpoint if it is due for publication at `now` [s], else None."""
        if not self._is_pending or is_recent(self._published_at, now):
            return None
        self._is_pending, self._published_at = False, now
        self.count += 1
        return self.checkpoint


class CheckpointKeeper:
    """Validates, stores and publishes the networks of one learner.

    Attributes:
        mae: The network in use; None before the first.
        validation: Validates candidates on the messages of the arm.
        publication: Releases checkpoints for publication.
        rejected: Number of rejected candidates.
        last_rejected: Reason of the last rejection.
    """

    def __init__(
        self,
        robot: Robot,
        samples: SampleStore,
        directory: Path | None = None,
        is_validating: bool = True,
    ) -> None:
        """Start without a network.

        Args:
            robot: The nominal body.
            samples: The samples, which are saved together with the network.
            directory: State directory; None to save nothing.
            is_validating: Whether learned networks have to pass the validation.

        Raises:
            StateError: If the directory cannot be used.
        """
        self.mae: Mae | None = None
        self.validation = CheckpointValidator(robot)
        self.publication = Publication()
        self.rejected, self.last_rejected = 0, ''
        self._torque, self._has_torque = HealthyTorque(robot), robot.tension_source.is_known
        self._samples = samples
        self._is_validating = is_validating
        self._time = 0.0  # time of the last message, as the sum of all `dt` [s]
        self._state = None if directory is None else StateStore(directory, robot)

    # -- messages and events --------------------------------------------------------------------

    def observe(
        self, message: MuscleSample, dt: float, is_anomaly: bool, theta: Array | None = None
    ) -> None:
        """Record a plausible message for the validation of networks and for contact detection.

        Contact detection needs the usual residual torque of the healthy arm. Messages during an
        anomaly do not contribute to this torque.

        Args:
            message: The message.
            dt: Time since the previous message [s].
            is_anomaly: Whether an anomaly is present.
            theta: Measured θ [rad], (D,), or None.
        """
        self._time += dt
        self.validation.message(message.learned_tension, message.length, self._time, theta)
        # The healthy torque, which contact detection uses, cannot be computed without tensions.
        if self.mae is not None and not is_anomaly and self._has_torque:
            self._torque.step(message.tension_read, message.length, dt)

    def forget_messages(self) -> None:
        """Discard the messages used for validation, for example after the body state changed."""
        self.validation.forget()

    def reset(self) -> None:
        """Restart the filter of the torque, for example after a backward jump of the clock."""
        self._torque.reset()

    def set_anomaly(self, is_anomaly: bool, adapt: Callable[[Mae], Mae]) -> None:
        """Set whether an anomaly is present.

        When an anomaly begins, the last network that was in use long enough without an anomaly is
        published again, unless it is still in use. Before that, `adapt` converts this network.
        """
        earlier = self.validation.anomaly(is_anomaly, self._time)
        if earlier is not None:
            self.use(adapt(earlier))

    def isolate(self, muscles: Iterable[int]) -> None:
        """Set the isolated muscles of the networks that are published from now on."""
        self.validation.isolated = tuple(muscles)

    # -- networks -------------------------------------------------------------------------------

    def check(self, mae: Mae) -> None:
        """Validate a network, which a user has chosen, on recent messages of the arm.

        Raises:
            GateError: If the validation rejects the network.
        """
        self.validation.check(mae, is_chosen=True)

    def is_accepted(self, mae: Mae) -> bool:
        """Return whether a learned network passes the validation, and count rejections."""
        if not self._is_validating:
            return True
        try:
            self.validation.check(mae)
        except GateError as error:
            self.rejected, self.last_rejected = self.rejected + 1, str(error)
            return False
        return True

    def numbered(self, mae: Mae) -> Mae:
        """Return the network with a version higher than its own and that of the network in use."""
        before = 0 if self.mae is None else self.mae.version
        return replace(mae, version=1 + max(mae.version, before))

    def use(self, mae: Mae) -> None:
        """Number, save and publish a network that replaces the one in use."""
        self.restore(self.numbered(mae))

    def restore(self, mae: Mae) -> None:
        """Save and publish a network like `use`, but keep its version."""
        self.mae = mae = self._torque.use(mae.without(self.validation.isolated))
        self.publication.offer(checkpoint.to_bytes(mae))
        self.validation.take(mae, self._time)
        self.store()

    def clear(self) -> None:
        """Forget the network and all messages."""
        self.validation.start()
        self._torque.start()
        self.mae = None
        self.publication.offer(None)

    # -- the disk -------------------------------------------------------------------------------

    def load(self) -> Mae | None:
        """Load the saved samples into the store; return the saved network, or None.

        A network that the validation rejects is kept as a backup and not returned.
        """
        if self._state is None:
            return None
        saved = self._state.load(self._samples)
        if saved is None or self.is_accepted(saved):
            return saved
        self._state.back_up(self._samples, checkpoint.to_bytes(saved), self.last_rejected)
        self.store()  # save without the network; otherwise each start would make another backup
        return None

    def store(self, changed: bool = True) -> None:
        """Save samples and network if they have `changed`.

        If they have not, check that the files still exist. In both cases, a failed save is retried.
        """
        if self._state is not None:
            self._state.keep(self._samples, self.publication.checkpoint, changed)

    def save(self) -> Path:
        """Save samples and network now, and the network also as a checkpoint file.

        Returns:
            The state directory.

        Raises:
            StateError: If there is no directory, or it cannot be written.
        """
        if self._state is None:
            raise StateError(
                "nothing can be saved because state_directory is ''; restart the learner with the "
                'path of a directory'
            )
        self._state.save(self._samples, self.publication.checkpoint)
        return self._state.directory

    def back_up(self) -> None:
        """Save the present samples and network as a backup.

        Raises:
            StateError: If the backup cannot be made.
        """
        data = self.publication.checkpoint
        if self._state is not None and (self._samples or data):
            self._state.back_up(self._samples, data)

    def close(self) -> None:
        """Release the state directory."""
        if self._state is not None:
            self._state.close()

    @property
    def trouble(self) -> str:
        """Why samples and network are not on disk, or ''."""
        return '' if self._state is None else self._state.trouble(self._samples)

    def values(self) -> dict[str, str]:
        """Return the values for /diagnostics by name."""
        values = {}
        if self.rejected:
            values['rejected networks'] = str(self.rejected)
            values['last rejected network'] = self.last_rejected
        if self._state is not None:
            values['state directory'] = str(self._state.directory)
            if self._state.not_used:
                values['saved state not used'] = self._state.not_used
        return values
