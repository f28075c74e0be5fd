# SPDX-License-Identifier: Apache-2.0
"""The part of the estimator that selects the network that all nodes use.

    mae_checkpoint (learner) ─► validation ─► accepted_checkpoint (estimator) ─► controller, sim

Candidates arrive on the topic `mae_checkpoint`, or from the file that the parameter `checkpoint`
names. The estimator uses an accepted network and publishes it on a latched topic. As soon as there
is an accepted network, controller and simulator use only accepted networks.

An anomaly that is detected soon after a network was accepted may be due to this network. The
estimator then returns to the newest network that was in use long enough without an anomaly, and
publishes it again.
"""

import time
from collections.abc import Callable, Iterator

import numpy as np
from std_msgs.msg import UInt8MultiArray

from musculoskeletal_ae.estimation.checkpoint_validation import CheckpointValidator
from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.nodes.checkpoint_queue import ACCEPTED, CANDIDATES
from musculoskeletal_ae.nodes.messages import LATCHED, bytes_message
from musculoskeletal_ae.nodes.shell import Shell


class Candidates:
    """Validates candidates, and publishes the accepted networks.

    Attributes:
        validator: Validation rules, and the recent messages that networks are validated on.
        queue: Queue in which the candidates from the topic wait; it validates them in small steps.
    """

    def __init__(
        self, node: Shell, use: Callable[[Mae], None], on_candidate: Callable[[], None]
    ) -> None:
        """Start without a network.

        Args:
            node: The estimator.
            use: Called with each network that the estimator is to use from now on.
            on_candidate: Called when a candidate from the topic was accepted.
        """
        self._node, self._use, self._on_candidate = node, use, on_candidate
        self.validator = CheckpointValidator(node.robot)
        self._publisher = node.create_publisher(UInt8MultiArray, ACCEPTED, LATCHED)
        self.queue = node.checkpoint_queue(CANDIDATES, self._validate)

    def follow(self) -> None:
        """Subscribe to candidates, and follow the parameter `checkpoint`."""
        node = self._node
        node.needed.add(CANDIDATES)
        node.follow_parameter('checkpoint', self._use_file, node.load_checkpoint)
        node.listen(UInt8MultiArray, CANDIDATES, self.queue.propose, LATCHED)

    def on_anomaly(self, detected: bool) -> None:
        """Discard waiting candidates when an anomaly begins, and replace a doubtful network.

        A network that was accepted shortly before the anomaly may be its cause. It is replaced by
        the newest network that was in use long enough without an anomaly.

        Args:
            detected: Whether an anomaly has begun; False if one has ended.
        """
        if detected and self.validator.mae is not None:
            self.queue.give_up()
        before = self.validator.anomaly(detected, time.monotonic())
        if before is not None:
            self._node.get_logger().warning(
                'an anomaly was detected soon after a new network was accepted; returned to '
                f'checkpoint version {before.version}'
            )
            self._use(before)
            self._publish(before)

    def _validate(self, message: UInt8MultiArray) -> Iterator[None]:
        mae = checkpoint.from_bytes(bytes(message.data), self._node.robot)
        yield
        yield from self.validator.trial(mae)
        complete = self.validator.with_detector(mae, time.monotonic())
        self._accept(complete, message if complete is mae else None)
        self._on_candidate()

    def _use_file(self, mae: Mae) -> None:
        self.validator.check(mae, is_chosen=True)
        self._accept(mae)
        self.queue.give_up()
        self._node.needed.remove(CANDIDATES)

    def _accept(self, mae: Mae, message: UInt8MultiArray | None = None) -> None:
        try:
            self._use(mae)
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            raise CheckpointError(f'the network cannot be evaluated ({error})') from error
        self.validator.take(mae, time.monotonic())
        self._publish(mae, message)

    def _publish(self, mae: Mae, message: UInt8MultiArray | None = None) -> None:
        self._node.checkpoint_version = mae.version
        if message is None:
            message = bytes_message(checkpoint.to_bytes(mae))
        self._publisher.publish(message)
