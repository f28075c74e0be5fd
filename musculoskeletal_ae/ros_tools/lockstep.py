# SPDX-License-Identifier: Apache-2.0
"""Lets a replay wait for nodes, so that they miss no message however slow the computer is.

Nodes subscribe best-effort with short queues, because old measurements are useless to a live arm. A
recording that is played in real time would therefore lose messages whenever a node has to wait for
a processor for 0.1 s. The messages that remain would arrive in bunches, so that their times are
wrong.

A replay in lockstep asks the nodes after every STEP of recorded time, and goes on only after all of
them have answered. A node runs its callbacks one after another, so its answer shows that it has
used all messages that were sent before the question. The question is the standard service
`get_parameters` with an empty list of names, which every node of rclpy and rclcpp offers. Recorded
time stands still while the replay waits, so nodes that use /clock do not notice the wait.
"""

import time
from collections.abc import Callable, Sequence

from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.ros_tools.ros_tool import Spinner

STEP = 5_000_000  # ask the nodes after at most this recorded time [ns]
MOST_MESSAGES = 8  # ask the nodes after at most this many messages; the queues of nodes hold 10
#: wait at most this long until all nodes have started and answered [s]
START_TIME = 300.0
REPEAT_TIME = 2.0  # repeat an unanswered question after this time while nodes start [s]
#: wait at most this long for an answer during playback [s]; a node that hangs has ended itself by
#: then
LONGEST_WAIT = 15.0


class Lockstep:
    """Asks nodes whether they have used all messages so far.

    Attributes:
        lost: Names of nodes that did not answer, and that playback no longer waits for.
    """

    def __init__(self, node: Node, names: Sequence[str], warn: Callable[[str], object]) -> None:
        """Prepare to wait for nodes.

        Args:
            node: The node that asks.
            names: Names of the nodes, relative to the namespace of `node`.
            warn: Called with a text if playback goes on without a node.
        """
        self.lost: list[str] = []
        self._node, self._warn = node, warn
        self._clients: dict[str, Client] = {
            name: node.create_client(GetParameters, f'{name}/get_parameters') for name in names
        }
        self._answers: dict[str, Future] = {}  # answer to the last question, by node
        self._next_step = 0  # recorded time of the next question [ns]
        self._messages = 0  # number of messages since the last question

    def missing(self) -> list[str]:
        """Return the nodes that have not answered the last question."""
        return [
            name
            for name in self._clients
            if name not in self._answers or not self._answers[name].done()
        ]

    def start(self, spinner: Spinner, on_wait: Callable[[], object]) -> None:
        """Start the lockstep: wait until all nodes run and answer.

        Args:
            spinner: Runs the callbacks of the asking node.
            on_wait: Called again and again while nodes are missing.

        Raises:
            MusculoskeletalError: If a node does not answer within START_TIME.
        """
        end, repeat = time.monotonic() + START_TIME, 0.0
        while missing := self.missing():
            if (now := time.monotonic()) > end:
                raise MusculoskeletalError(
                    f'no answer from {", ".join(missing)} within {START_TIME:g} s; start these '
                    f'nodes in namespace {self._node.get_namespace()}, or change --wait-for'
                )
            if now >= repeat:
                repeat = now + REPEAT_TIME
                self._ask(missing)
            on_wait()
            spinner.spin_once(0.05)
        self._answers.clear()

    def is_due(self, recorded: int) -> bool:
        """Return whether a message with a recorded time [ns] begins a new step."""
        is_in_step = self._next_step - STEP <= recorded < self._next_step
        return not is_in_step or self._messages >= MOST_MESSAGES

    def count(self) -> None:
        """Count a published message; a question is due after MOST_MESSAGES of them."""
        self._messages += 1

    def ask(self) -> None:
        """Ask all nodes, unless they have been asked since the last step."""
        if not self._answers:
            self._ask(self._clients)

    def step(self, recorded: int, spinner: Spinner) -> None:
        """Wait until all nodes have used the messages so far, then begin the next step.

        A node that does not answer within LONGEST_WAIT is added to `lost`.

        Args:
            recorded: Recorded time at which the step begins [ns].
            spinner: Runs the callbacks of the asking node.
        """
        self._next_step, self._messages = recorded + STEP, 0
        self.ask()
        spinner.spin_until(lambda: not self.missing(), LONGEST_WAIT)
        for name in self.missing():
            self.lost.append(name)
            del self._clients[name]  # not destroyed, for the reason in `ros/latched_values.py`
            self._warn(
                f'{name} has not answered for {LONGEST_WAIT:g} s; playing on without waiting for it'
            )
        self._answers.clear()

    def _ask(self, names: Sequence[str] | dict[str, Client]) -> None:
        for name in names:
            if (client := self._clients[name]).service_is_ready():
                self._answers[name] = client.call_async(GetParameters.Request())
