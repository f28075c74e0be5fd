# SPDX-License-Identifier: Apache-2.0
"""What happens to a network: it is validated, numbered, stored and published, or rolled back.

    candidate ─► validated on own messages ─► numbered ─► on disk ─► published
                                                 ▲
    anomaly ─► the last network that was in use long enough without one

What is published is on disk before it leaves.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

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
    """Hands out the newest checkpoint once, at most one a second.

    Attributes:
        checkpoint: The newest one; None before the first.
        count: How many were handed out.
    """

    def __init__(self) -> None:
        self.checkpoint: bytes | None = None
        self.count = 0
        self._is_pending = False
        self._published_at = -math.inf

    def offer(self, data: bytes | None) -> None:
        """Replace the checkpoint; it is to be published soon."""
        self.checkpoint, self._is_pending = data, data is not None

    def hurry(self) -> None:
        """Publish the next one at once."""
        self._published_at = -math.inf

    def take(self, now: float) -> bytes | None:
        """Return the checkpoint if it is to be published at `now` [s]."""
        if not self._is_pending or is_recent(self._published_at, now):
            return None
        self._is_pending, self._published_at = False, now
        self.count += 1
        return self.checkpoint


class CheckpointKeeper:
    """Keeps the network of one learner.

    Attributes:
        mae: The network in use; None before the first.
        validation: Tries candidates on the messages of the arm.
        publication: Hands out checkpoints.
        rejected: How many candidates were rejected.
        last_rejected: Why the last one was.
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
            samples: Stored together with the network.
            directory: Where they are stored; None for nowhere.
            is_validating: Whether networks that were learned have to pass the validation.

        Raises:
            StateError: If the directory cannot be used.
        """
        self.mae: Mae | None = None
        self.validation = CheckpointValidator(robot)
        self.publication = Publication()
        self.rejected, self.last_rejected = 0, ''
        self._torque = HealthyTorque(robot)
        self._samples = samples
        self._is_validating = is_validating
        self._time = 0.0  # of the messages [s]
        self._state = None if directory is None else StateStore(directory, robot)

    # -- what comes from the arm ----------------------------------------------------------------

    def observe(self, message: MuscleSample, dt: float, is_anomaly: bool) -> None:
        """Note a plausible message, `dt` [s] after the one before."""
        self._time += dt
        self.validation.message(message.motor_tension, message.length, self._time)
        if self.mae is not None and not is_anomaly:
            self._torque.step(message.motor_tension, message.length, dt)

    def forget_messages(self) -> None:
        """Forget the messages, as when the body state has changed."""
        self.validation.forget()

    def reset(self) -> None:
        """Forget the motion so far, as after a backward jump of the clock."""
        self._torque.reset()

    def set_anomaly(self, is_anomaly: bool, adapt: Callable[[Mae], Mae]) -> None:
        """Note whether an anomaly is present.

        The last network that explained the arm is published again, if that is another one, as
        `adapt` returns it.
        """
        earlier = self.validation.anomaly(is_anomaly, self._time)
        if earlier is not None:
            self.use(adapt(earlier))

    def isolate(self, muscles: Iterable[int]) -> None:
        """Note which muscles are isolated; what is published from now on knows it."""
        self.validation.isolated = tuple(muscles)

    # -- networks -------------------------------------------------------------------------------

    def check(self, mae: Mae) -> None:
        """Check that a network explains the arm.

        Raises:
            GateError: If it does not.
        """
        self.validation.check(mae)

    def is_accepted(self, mae: Mae) -> bool:
        """Whether a learned network passes the validation; count it if it does not."""
        if not self._is_validating:
            return True
        try:
            self.check(mae)
        except GateError as error:
            self.rejected, self.last_rejected = self.rejected + 1, str(error)
            return False
        return True

    def numbered(self, mae: Mae) -> Mae:
        """Return a network with the number that follows on the one in use, and on its own."""
        before = 0 if self.mae is None else self.mae.version
        return replace(mae, version=1 + max(mae.version, before))

    def use(self, mae: Mae) -> None:
        """Number, store and publish a network in the place of the one before."""
        self.restore(self.numbered(mae))

    def restore(self, mae: Mae) -> None:
        """Do as `use`, under the number that the network has."""
        self.mae = mae = self._torque.use(mae.without(self.validation.isolated))
        self.publication.offer(checkpoint.to_bytes(mae))
        self.validation.take(mae, self._time)
        self.store()

    def clear(self) -> None:
        """Forget the network, and all that was observed."""
        self.validation.start()
        self._torque.start()
        self.mae = None
        self.publication.offer(None)

    # -- the disk -------------------------------------------------------------------------------

    def load(self) -> Mae | None:
        """Fill the store with the saved samples; return the saved network if it is usable."""
        if self._state is None:
            return None
        saved = self._state.load(self._samples)
        if saved is None or self.is_accepted(saved):
            return saved
        self._state.back_up(self._samples, checkpoint.to_bytes(saved), self.last_rejected)
        self.store()  # without the network, or each start would make another backup
        return None

    def store(self, changed: bool = True) -> None:
        """Store samples and network; unless something `changed`, only check that they are there."""
        if self._state is not None:
            self._state.keep(self._samples, self.publication.checkpoint, changed)

    def save(self) -> Path:
        """Store samples and network at once; return where.

        Raises:
            StateError: If there is no directory, or it cannot be written.
        """
        if self._state is None:
            raise StateError("state_directory is '': nothing is kept; start with a directory")
        self._state.save(self._samples, self.publication.checkpoint)
        return self._state.directory

    def back_up(self) -> None:
        """Keep what was learned so far as a backup.

        Raises:
            StateError: If the backup cannot be made.
        """
        data = self.publication.checkpoint
        if self._state is not None and (self._samples or data):
            self._state.back_up(self._samples, data)

    def close(self) -> None:
        """Release the directory."""
        if self._state is not None:
            self._state.close()

    @property
    def trouble(self) -> str:
        """Why what was learned is not on disk; or ''."""
        return '' if self._state is None else self._state.trouble(self._samples)

    def values(self) -> dict[str, str]:
        """Return what people want to know, for /diagnostics."""
        values = {}
        if self.rejected:
            values['refused networks'] = str(self.rejected)
            values['last refused'] = self.last_rejected
        if self._state is not None:
            values['state directory'] = str(self._state.directory)
            if self._state.not_used:
                values['saved state not used'] = self._state.not_used
        return values
