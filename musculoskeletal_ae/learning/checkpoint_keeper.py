# SPDX-License-Identifier: Apache-2.0
"""Numbers, stores and publishes the networks of one learner, and follows the estimator's decisions.

    network of an update ─► numbered ─► published as a candidate ─► estimator
                                                                        │
    saved and published again ◄─ the accepted network ◄─ accepted or rejected

The learner does not judge its networks. It saves a candidate when the estimator has accepted it. If
the estimator rejects the newest one, the learner returns to the network that the estimator uses.
The estimator adds what it has measured to a network that it accepts: the damping of the joints and
their residual torque. The learner saves both, and copies them into the next candidate. Without an
estimator nobody rejects a network, and each one is saved at once.

A network is saved before it is published. A failed save is retried, and does not prevent the
publication. At most one update a second begins (`scheduler`), so candidates are no more frequent.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.state_directory import StateStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


class Packed(NamedTuple):
    """A network, and the bytes of the checkpoint that contains it."""

    mae: Mae
    data: bytes

    @classmethod
    def of(cls, mae: Mae) -> Packed:
        """Serialize a network."""
        return cls(mae, checkpoint.to_bytes(mae))


class CheckpointKeeper:
    """Stores and publishes the networks of one learner.

    Attributes:
        published: Number of checkpoints published so far.
        rejected: Number of networks that the estimator has rejected.
        last_rejected: Reason of the last rejection.
    """

    def __init__(self, robot: Robot, samples: SampleStore, directory: Path | None = None) -> None:
        """Start without a network.

        Args:
            robot: The nominal body.
            samples: The samples, which are saved together with the network.
            directory: State directory; None to save nothing.

        Raises:
            StateError: If the directory cannot be used.
        """
        self.published = 0
        self._newest: Packed | None = None  # the newest network, accepted or not
        self._is_published = True  # whether `_newest` was published
        self.rejected, self.last_rejected = 0, ''
        self._saved: Packed | None = None  # the network to save: the last accepted one
        self._in_use: Mae | None = None  # network of the estimator; None without an estimator
        self._rejected_version = -1  # version of the network that was rejected last
        self._highest_version = 0  # highest version so far, also of the estimator's decisions
        self._samples = samples
        self._state = None if directory is None else StateStore(directory, robot)

    # -- networks -------------------------------------------------------------------------------

    @property
    def mae(self) -> Mae | None:
        """The newest network, accepted by the estimator or not; None before the first."""
        return None if self._newest is None else self._newest.mae

    @property
    def checkpoint(self) -> bytes | None:
        """The network to save, as the content of a checkpoint; None before the first."""
        return None if self._saved is None else self._saved.data

    def numbered(self, mae: Mae) -> Mae:
        """Return the network with a version above its own and all versions so far."""
        return replace(mae, version=1 + max(mae.version, self._highest_version))

    def use(self, mae: Mae) -> None:
        """Use a new network: number it, publish it as a candidate; save it if no estimator runs."""
        self._publish(self.numbered(mae))
        if self._in_use is None:
            self._save_newest()

    def restore(self, mae: Mae) -> None:
        """Save and publish a network that needs no decision, and keep its version.

        It comes from a user, from the disk or from the estimator.
        """
        self._publish(mae)
        self._save_newest()

    def _publish(self, mae: Mae) -> None:
        if mae.touch is not None and not mae.touch.time:
            # Updates do not measure damping and residual torque: copy those of the last network.
            mae = _with_measurements_of(self.mae, mae)
        self._highest_version = max(self._highest_version, mae.version)
        self._newest, self._is_published = Packed.of(mae), False

    def take_unpublished(self) -> bytes | None:
        """Return the newest checkpoint to publish it; None if it was published before."""
        if self._newest is None or self._is_published:
            return None
        self._is_published = True
        self.published += 1
        return self._newest.data

    def _save_newest(self) -> None:
        self._saved = self._newest
        self.store()

    def clear(self) -> None:
        """Clear all networks of the learner, and withdraw the one to be published."""
        self._saved = self._newest = None
        self._is_published = True

    # -- decisions of the estimator -------------------------------------------------------------

    def note_accepted(self, mae: Mae) -> None:
        """Note that the estimator uses this network, and save the newest one if it is the same.

        The newest network differs from it while a decision is pending, after a rejection, and if a
        user has chosen a network for the estimator.
        """
        self._in_use = mae
        self._highest_version = max(self._highest_version, mae.version)
        newest = self.mae
        if newest is None:
            return
        if mae.version == newest.version:
            measured = _with_measurements_of(mae, newest)
            if measured is not newest:
                self._newest = Packed.of(measured)
            if self._saved is not self._newest:
                self._save_newest()
        else:
            self._return_if_rejected()

    def note_rejected(self, version: int, reason: str) -> None:
        """Note that the estimator has rejected the network of this version, and why.

        A network may be rejected after it was accepted, if an anomaly follows soon.
        """
        self.rejected, self.last_rejected = self.rejected + 1, reason
        self._rejected_version = version
        # The version may be that of an earlier learner; give no network the same one.
        self._highest_version = max(self._highest_version, version)
        self._return_if_rejected()

    def _return_if_rejected(self) -> None:
        """Return to the network of the estimator if the newest one is rejected.

        The estimator's messages on rejected and accepted networks may arrive in either order.
        """
        mae, in_use, saved = self.mae, self._in_use, self._saved
        if mae is None or saved is None or in_use is None:
            return
        if mae.version != self._rejected_version or mae.version == in_use.version:
            return
        if saved.mae.version == in_use.version:
            in_use = saved.mae
        elif self._state is not None:
            # The saved network is rejected, or a user has chosen another one for the estimator.
            try:
                self._state.back_up(self._samples, self.checkpoint, self.last_rejected)
            except StateError:  # no space on the disk; the next decision repeats this
                return
        self.restore(in_use)

    # -- the disk -------------------------------------------------------------------------------

    def load(self) -> Mae | None:
        """Load the saved samples into the store; return the saved network, or None."""
        return None if self._state is None else self._state.load(self._samples)

    def store(self, changed: bool = True) -> None:
        """Store samples and network on disk if they have `changed`; retry a failed save."""
        if self._state is not None:
            self._state.keep(self._samples, self.checkpoint, changed)

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
        self._state.save(self._samples, self.checkpoint)
        return self._state.directory

    def back_up(self) -> None:
        """Save the present samples and network as a backup.

        Raises:
            StateError: If the backup cannot be made.
        """
        data = self.checkpoint
        if self._state is not None and (self._samples or data):
            self._state.back_up(self._samples, data)

    def close(self) -> None:
        """Release the state directory."""
        if self._state is not None:
            self._state.close()

    @property
    def trouble(self) -> str:
        """Why the newest samples and network are not on disk, for users; '' if they are."""
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


def _with_measurements_of(measured: Mae | None, mae: Mae) -> Mae:
    """Return `mae` with the damping and the residual torque that another network contains.

    The network is returned unchanged if one of both contains no residual torque, or if they agree.
    """
    if measured is None or measured.touch is None or mae.touch is None:
        return mae
    known = measured.touch
    if known.time == mae.touch.time and np.array_equal(known.spread, mae.touch.spread):
        return mae
    mae = replace(mae, touch=mae.touch.with_measurements_of(known))
    if (damped := measured.elasticity) is None:
        return mae
    return replace(mae, elasticity=replace(mae.elasticity or damped, damping=damped.damping))
