# SPDX-License-Identifier: Apache-2.0
"""The part of the estimator that selects the network that all nodes use.

    mae_checkpoint (learner) ─► validation ─► accepted_checkpoint ─► controller, sim, learner
                                          └─► rejected_checkpoint ─► learner

Each candidate of the learner is validated here and nowhere else (`estimation/network_validation/`).
The decision is published: the network if it is accepted, its version and the reason if it is
rejected.

Candidates arrive on the topic `mae_checkpoint`, or from the file that the parameter `checkpoint`
names. The estimator uses an accepted network and publishes it on a latched topic. As soon as there
is an accepted network, controller and simulator use only accepted networks.

An anomaly that is detected soon after a network was accepted may be due to this network. The
estimator then returns to the newest network that was in use long enough without an anomaly. It
publishes this network again, and the version of the doubtful one as rejected.
"""

import time
from collections.abc import Iterator
from contextlib import suppress

from diagnostic_msgs.msg import KeyValue
from std_msgs.msg import UInt8MultiArray

from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import CheckpointError, printable
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.nodes.checkpoint_queue import ACCEPTED, CANDIDATES, REJECTED
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.ros.latched_values import LatchedPublisher
from musculoskeletal_ae.ros.message_building import LATCHED, bytes_message


class Candidates:
    """Passes candidate networks to the validation, and publishes its decisions.

    Attributes:
        queue: Candidate networks that were received and are validated in small steps.
    """

    def __init__(self, node: Shell, networks: CheckpointValidator) -> None:
        """Start without a network.

        Args:
            node: The estimator.
            networks: Decides which network the estimator uses.
        """
        self._node, self._networks = node, networks
        networks.rejected = self._reject
        self._accepted = LatchedPublisher(node, UInt8MultiArray, ACCEPTED)
        self._rejected = LatchedPublisher(node, KeyValue, REJECTED)
        self.queue = node.checkpoint_queue(CANDIDATES, self._validate)

    def subscribe(self) -> None:
        """Subscribe to candidates, and follow the parameter `checkpoint`."""
        node = self._node
        node.needed.add(CANDIDATES)
        node.parameters.follow('checkpoint', self._use_file, self._read)
        node.listen(UInt8MultiArray, CANDIDATES, self.queue.propose, LATCHED)

    def give_up(self) -> None:
        """Reject the waiting candidates, because an anomaly begins, unless no network is in use."""
        waiting = None if self._networks.mae is None else self.queue.give_up()
        if waiting is not None:
            with suppress(CheckpointError):  # an unfit checkpoint has no version
                mae = checkpoint.from_bytes(bytes(waiting.data), self._node.robot)
                self._reject(mae, 'an anomaly was detected before it was validated')

    def _validate(self, message: UInt8MultiArray) -> Iterator[None]:
        mae = checkpoint.from_bytes(bytes(message.data), self._node.robot)
        yield
        yield from self._networks.propose(mae, time.monotonic)

    def _reject(self, mae: Mae, reason: str) -> None:
        self._rejected.publish(KeyValue(key=str(mae.version), value=printable(reason)))

    def _read(self, path: str) -> Mae | None:
        return checkpoint.load(path, self._node.robot) if path else None

    def _use_file(self, mae: Mae) -> None:
        self._networks.choose(mae, time.monotonic())
        self._node.needed.remove(CANDIDATES)

    def publish(self, mae: Mae) -> None:
        """Publish a network that was accepted, so that all nodes use it."""
        self._accepted.publish(bytes_message(checkpoint.to_bytes(mae)))
