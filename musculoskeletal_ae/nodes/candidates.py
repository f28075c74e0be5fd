# SPDX-License-Identifier: Apache-2.0
"""The part of the estimator that selects the network that all nodes use.

    mae_checkpoint (learner) ─► validation ─► accepted_checkpoint ─► controller, sim, learner
                                          └─► rejected_checkpoint ─► learner

Each candidate of the learner is validated here and nowhere else. The decision is published: the
network if it is accepted, its version and the reason if it is rejected.

Candidates arrive on the topic `mae_checkpoint`, or from the file that the parameter `checkpoint`
names. The estimator uses an accepted network and publishes it on a latched topic. As soon as there
is an accepted network, controller and simulator use only accepted networks.

An anomaly that is detected soon after a network was accepted may be due to this network. The
estimator then returns to the newest network that was in use long enough without an anomaly. It
publishes this network again, and the version of the doubtful one as rejected.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
from diagnostic_msgs.msg import KeyValue
from std_msgs.msg import UInt8MultiArray

from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import CheckpointError, printable
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.nodes.checkpoint_queue import ACCEPTED, CANDIDATES, REJECTED
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.ros.messages import LATCHED, bytes_message


class Candidates:
    """Validates candidates, and publishes the accepted networks.

    Attributes:
        validator: Validation rules, and the recent messages that networks are validated on.
        queue: Queue in which the candidates from the topic wait; it validates them in small steps.
    """

    def __init__(self, node: Shell, use: Callable[[Mae, str], Mae]) -> None:
        """Start without a network.

        Args:
            node: The estimator.
            use: Called with each network that the estimator is to use from now on, and with the
                reason why it fits this arm worse than the one before, or '' if it does not. Returns
                the network with what the estimator has measured for it.
        """
        self._node, self._use = node, use
        self.validator = CheckpointValidator(node.robot)
        self._accepted = node.create_publisher(UInt8MultiArray, ACCEPTED, LATCHED)
        self._rejected = node.create_publisher(KeyValue, REJECTED, LATCHED)
        self.queue = node.checkpoint_queue(CANDIDATES, self._validate)

    def follow(self) -> None:
        """Subscribe to candidates, and follow the parameter `checkpoint`."""
        node = self._node
        node.needed.add(CANDIDATES)
        node.follow_parameter('checkpoint', self._use_file, self._read)
        node.listen(UInt8MultiArray, CANDIDATES, self.queue.propose, LATCHED)

    def on_anomaly(self, detected: bool) -> None:
        """Discard waiting candidates when an anomaly begins, and replace a doubtful network.

        A network that was accepted shortly before the anomaly may be its cause. It is replaced by
        the newest network that was in use long enough without an anomaly.

        Args:
            detected: Whether an anomaly has begun; False if one has ended.
        """
        in_use, waiting = self.validator.mae, None
        if detected and in_use is not None:
            waiting = self.queue.give_up()
        before = self.validator.anomaly(detected, time.monotonic())
        if before is not None and in_use is not None:
            reason = 'an anomaly was detected soon after it was accepted'
            self._node.get_logger().warning(
                f'checkpoint version {in_use.version}: {reason}; returned to checkpoint version '
                f'{before.version}'
            )
            self._publish(self._use(before, ''))
            self._reject(in_use, reason)
        if waiting is not None:
            with suppress(CheckpointError):  # an unfit checkpoint has no version
                mae = checkpoint.from_bytes(bytes(waiting.data), self._node.robot)
                self._reject(mae, 'an anomaly was detected before it was validated')

    def _validate(self, message: UInt8MultiArray) -> Iterator[None]:
        mae = checkpoint.from_bytes(bytes(message.data), self._node.robot)
        yield
        if self.validator.is_in_use(mae):
            return
        try:
            yield from self.validator.trial(mae)
            self._accept(self.validator.with_detector(mae, time.monotonic()))
        except CheckpointError as error:
            self._reject(mae, str(error))
            raise

    def _reject(self, mae: Mae, reason: str) -> None:
        self._rejected.publish(KeyValue(key=str(mae.version), value=printable(reason)))

    def _read(self, path: str) -> Mae | None:
        return checkpoint.load(path, self._node.robot) if path else None

    def _use_file(self, mae: Mae) -> None:
        self.validator.check(mae, is_chosen=True)
        self._accept(mae, unsuitable_because=self.validator.weakness(mae))
        self._node.needed.remove(CANDIDATES)

    def _accept(self, mae: Mae, unsuitable_because: str = '') -> None:
        try:
            mae = self._use(mae, unsuitable_because)
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            raise CheckpointError(f'the network cannot be evaluated ({error})') from error
        self.validator.take(mae, time.monotonic())
        self._publish(mae)

    def _publish(self, mae: Mae) -> None:
        self._node.checkpoint_version = mae.version
        self._accepted.publish(bytes_message(checkpoint.to_bytes(mae)))
