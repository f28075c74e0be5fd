# SPDX-License-Identifier: Apache-2.0
"""Processes the checkpoints of a topic in small steps, so that they do not block the node."""

import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray

from musculoskeletal_ae.exceptions import CheckpointError, GateError, MusculoskeletalError
from musculoskeletal_ae.messages.reception import Reception

CANDIDATES = 'mae_checkpoint'  # topic of the networks that the learner proposes
ACCEPTED = 'accepted_checkpoint'  # topic of the networks that the estimator has accepted
REJECTED = 'rejected_checkpoint'  # topic of the versions that the estimator has rejected
#: process one step of a checkpoint at this interval [s]; a step takes a few milliseconds, at most a
#: quarter of this time, so that the node keeps up with its messages
STEP_PERIOD = 0.02
LARGEST = 64 << 20  # refuse a larger checkpoint [bytes]; a typical one has half a MB


class CheckpointQueue:
    """Processes one checkpoint after the other, in small steps.

    Of the checkpoints that arrive while one is processed, only the newest is processed next.
    """

    def __init__(
        self,
        node: Node,
        reception: Reception,
        topic: str,
        handle: Callable[[UInt8MultiArray], Iterator[None]],
        unfit: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Create an empty queue.

        Args:
            node: Node whose timer runs the steps.
            reception: Counts the checkpoints that were used and rejected.
            topic: Topic of the checkpoints.
            handle: Returns an iterator over the steps of processing one checkpoint. A step raises a
                MusculoskeletalError to reject the checkpoint; the last step puts it to use.
            unfit: Called with the reason if a checkpoint is rejected because it cannot be used at
                all (CheckpointError). It is not called for a usable network that has failed the
                validation (GateError).
        """
        self._reception, self._topic = reception, topic
        self._handle, self._unfit = handle, unfit
        self._next: UInt8MultiArray | None = None  # the checkpoint that waits
        self._present: UInt8MultiArray | None = None  # the checkpoint that is being processed
        self._steps: Iterator[None] | None = None
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer: Any = node.create_timer(STEP_PERIOD, self._step, clock=clock)
        self._timer.cancel()

    def propose(self, message: UInt8MultiArray) -> None:
        """Process a checkpoint as soon as the present one has been processed.

        An earlier checkpoint that was still waiting is discarded.

        Raises:
            CheckpointError: If the message is too large to be a network.
        """
        if len(message.data) > LARGEST:
            size = len(message.data)
            raise CheckpointError(f'the checkpoint has {size} bytes; legal: at most {LARGEST}')
        self._next = message
        if self._timer.is_canceled():
            self._timer.reset()

    def give_up(self) -> UInt8MultiArray | None:
        """Discard the checkpoint that is being processed, and the one that waits.

        Returns:
            The newest discarded checkpoint; None if there was none.
        """
        newest = self._present if self._next is None else self._next
        self._steps = self._next = self._present = None
        self._timer.cancel()
        return newest

    def _step(self) -> None:
        if self._steps is None:
            if self._next is None:
                self._timer.cancel()
                return
            self._present, self._next = self._next, None
            self._steps = self._handle(self._present)
        steps = self._steps
        try:
            next(steps)
            return
        except StopIteration:
            self._reception.arrivals[self._topic].use(time.monotonic())
        except MusculoskeletalError as error:
            if isinstance(error, CheckpointError) and not isinstance(error, GateError):
                self._unfit(str(error))
            self._reception.reject(self._topic, error.reason, str(error))
        except Exception as error:  # noqa: BLE001 - a received checkpoint may cause any exception
            self._reception.reject_error(self._topic, error)
        if self._steps is steps:  # false if the step has called `give_up`
            self._steps = self._present = None
