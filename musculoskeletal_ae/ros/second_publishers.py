# SPDX-License-Identifier: Apache-2.0
"""Detects several publishers of a topic that should have exactly one publisher.

A message does not name its sender, so this module looks at the ROS graph. While several nodes
publish a topic of `AUTHORS`, the nodes that use the topic reject its messages and report an ERROR,
and the controller stops. Afterwards nodes request the values of latched topics again
(`latched_values`).
Only a node that replaces a real arm obeys the commands of several publishers (`ArmNode`).

Two publishers with the same node name do not prove that two nodes run. A killed node stays in the
graph for up to 20 s beside its successor, but sends no more messages. Any of these signs proves
that a second node runs:

- Sequence numbers that decrease repeatedly, because messages of two nodes alternate.
- A report on /diagnostics under our own name with another identity, which is a random number of
  the reporting node. A node reads reports only while the graph has two nodes of its name.
- Two publishers that have both been in the graph for longer than the graph keeps a killed one.
"""

from __future__ import annotations

import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

from rclpy.node import Node

from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.arrival import Arrival
from musculoskeletal_ae.ros.diagnostics import NODE_SILENCE

_ESTIMATOR, _CONTROLLER, _DRIVER = 'the estimator', 'the controller', 'the driver'
MOTOR_COMMAND = 'motor_command'  # stands for the topic of motor commands that motors.yaml names
CLOCK = '/clock'
#: topics that must have one publisher, with the node that publishes them. A ros2_control robot has
#: other topics for some of these, which `Shell.full_name` returns. Messages on /clock go to rclpy,
#: so they cannot be rejected, but the controller stops.
AUTHORS = {
    'muscle_states': _DRIVER,
    'joint_states': _DRIVER,
    'muscle_length_command': _CONTROLLER,
    'muscle_tension_command': _CONTROLLER,
    MOTOR_COMMAND: _CONTROLLER,
    'estimated_joint_states': _ESTIMATOR,
    'body_state': _ESTIMATOR,
    'joint_sensor_trust': _ESTIMATOR,
    'accepted_checkpoint': _ESTIMATOR,
    'rejected_checkpoint': _ESTIMATOR,
    'mae_checkpoint': 'the learner',
    CLOCK: 'the source of time',
}
COMMANDS = frozenset(topic for topic, author in AUTHORS.items() if author == _CONTROLLER)
SEVERAL = 'several publishers'  # reason under which rejected messages are counted

LOOK_PERIOD = 0.1  # check the graph at this interval [s]
LOOKS = 20  # search this many recent checks for decreases of the sequence number
TURNS = 3  # conclude from this many decreases within LOOKS checks that two nodes share one name
#: conclude that two nodes share one name if two publishers have been in the graph for this time
#: [s]; the graph keeps a killed node for only 20 s
LEASE = 30.0
NAMING = 1.0  # wait at most this long until the graph knows the node of a publisher [s]
#: name that the graph returns for a node of which it knows only a publisher
UNNAMED = '_NODE_NAME_UNKNOWN_'
#: name of such a node in messages to users
NAMELESS = 'a node that has not announced its name yet'


class Publisher(NamedTuple):
    """One publisher of a topic, as the ROS graph shows it."""

    node: str  # full name of the publisher's node, or NAMELESS
    identity: bytes

    @property
    def is_named(self) -> bool:
        """Whether the graph knows the publisher's node."""
        return self.node != NAMELESS


class Authorship:
    """Decides from checks of the graph whether a topic has more than one publisher.

    Attributes:
        intruders: The publishing nodes if there are several, as `/a and /b`; else ''.
        is_certain: False while the topic has several publishers, and one of them was discovered
            less than NAMING seconds ago without the name of its node. Until the name is known,
            latched messages are rejected, and are requested again later.
    """

    def __init__(self) -> None:
        self.intruders, self.is_certain = '', True
        self._first_seen: dict[bytes, float] = {}  # time of discovery [s], by publisher
        self._turns: deque[int] = deque([0], maxlen=LOOKS)

    def look(self, publishers: Iterable[Publisher], turns: int, now: float) -> None:
        """Update `intruders` and `is_certain` from the publishers that the ROS graph shows.

        Args:
            publishers: Publishers of the topic.
            turns: Number of times so far that the sequence number of the topic has decreased.
            now: Time of the check [s].
        """
        present = list(publishers)
        self._first_seen = {
            each.identity: self._first_seen.get(each.identity, now) for each in present
        }
        before = self._turns[0]
        self._turns.append(turns)
        self.intruders, self.is_certain = '', True
        if len(present) < 2:
            return
        fresh = [
            each
            for each in present
            if not each.is_named and now - self._first_seen[each.identity] < NAMING
        ]
        nodes = Counter(each.node for each in present if each not in fresh)
        old = [each for each in present if now - self._first_seen[each.identity] >= LEASE]
        if len(nodes) > 1 or turns - before >= TURNS or len(old) > 1:
            names = (
                f'{count} nodes {node}' if count > 1 and node != NAMELESS else node
                for node, count in nodes.items()
            )
            self.intruders = ' and '.join(sorted(names))
        self.is_certain = not fresh


class Twins:
    """Detects a second node of the same name from its reports on /diagnostics.

    Serialized reports are searched for the name, because deserializing the reports of all nodes
    would take 1 % of a processor core.
    """

    def __init__(self, name: str, identity: str, clock: AwakeClock | None = None) -> None:
        """Watch the reports under one status name.

        Args:
            name: The status name.
            identity: Text that the reports of our own node contain.
            clock: Measures the ages of reports; None for the steady clock.
        """
        # Include CDR's length prefix, so that `/controller` does not match in `/left/controller`.
        text = name.encode() + b'\0'
        self._name, self._identity = struct.pack('<I', len(text)) + text, identity.encode()
        self._others = Arrival(clock)  # reports that other nodes of this name have sent

    def take(self, report: bytes, now: float) -> None:
        """Process a serialized report (CDR) that arrived at `now` [s]."""
        if self._name in report and self._identity not in report:
            self._others.use(now)

    def is_alone(self, now: float) -> bool:
        """Return whether no other node has reported under this name for NODE_SILENCE seconds."""
        return self._others.age(now) > NODE_SILENCE


def full_name(namespace: str, name: str) -> str:
    """Return the full name of a node, or NAMELESS while the graph does not know its name."""
    return NAMELESS if name == UNNAMED else f'{namespace.rstrip("/")}/{name}'


def publishers_of(node: Node, topic: str) -> list[Publisher]:
    """Return the publishers of a topic if there are at least two, otherwise [].

    Args:
        node: Node whose view of the graph is used.
        topic: Full name of the topic; '' stands for a topic that does not exist.
    """
    if not topic or node.count_publishers(topic) < 2:
        return []
    return [
        Publisher(full_name(each.node_namespace, each.node_name), bytes(each.endpoint_gid))
        for each in node.get_publishers_info_by_topic(topic)
    ]


class Sources:
    """Watches the publishers of the topics of `AUTHORS` that a node uses or publishes."""

    def __init__(
        self,
        node: Node,
        resolve: Callable[[str], str],
        turns: Callable[[str], int],
        renew: Callable[[str], object],
    ) -> None:
        """Start without topics to watch.

        Args:
            node: Node whose view of the graph is used.
            resolve: Returns the full name of a topic of `AUTHORS`; '' if there is none.
            turns: Returns how often the sequence number of a topic has decreased.
            renew: Requests the last value of a topic; called when the topic has one publisher
                again.
        """
        self._node, self._resolve = node, resolve
        self._turns, self._renew = turns, renew
        self._authorships: dict[str, Authorship] = {}
        self._to_renew: set[str] = set()

    def watch(self, *topics: str) -> None:
        """Watch these topics as well; topics that are not in `AUTHORS` are skipped."""
        for topic in topics:
            if topic in AUTHORS and topic not in self._authorships and self._resolve(topic):
                self._authorships[topic] = Authorship()

    def check(self, topic: str, is_latched: bool) -> None:
        """Check the publishers of a topic on which a message has just arrived.

        On a latched topic, the node of each of several publishers must be known.

        Raises:
            MessageError: If the message may come from another node than the intended publisher.
        """
        authorship = self._authorships[topic]
        if is_latched:  # look now, because latched messages are rare and may move the arm at once
            self._look(topic)
        if authorship.intruders or (is_latched and not authorship.is_certain):
            if is_latched:
                self._to_renew.add(topic)
            raise MessageError(
                SEVERAL, authorship.intruders or 'the node of one publisher is not known yet'
            )

    def look(self) -> None:
        """Look for second publishers on the ROS graph.

        Once a latched topic has no second publisher any more, request its last value again, because
        its messages were rejected before.
        """
        for topic in self._authorships:
            self._look(topic)
        for topic in sorted(self._to_renew):
            authorship = self._authorships[topic]
            if authorship.is_certain and not authorship.intruders:
                self._to_renew.discard(topic)
                self._renew(topic)

    @property
    def intruders(self) -> str:
        """Topics that several nodes publish, with the names of the nodes; '' if there are none."""
        topics: dict[str, set[str]] = {}  # motors and joints may share a topic
        for topic, each in self._authorships.items():
            if each.intruders:
                topics.setdefault(each.intruders, set()).add(self._shown(topic))
        return '; '.join(
            f'{", ".join(sorted(names))} come from {nodes}' for nodes, names in topics.items()
        )

    def remedy(self) -> str:
        """Return the remedy for topics with several publishers, as text."""
        authors = {AUTHORS[topic] for topic, each in self._authorships.items() if each.intruders}
        if not authors:
            return 'stop one of them'
        return f'stop all of them except {" and ".join(sorted(authors))} of this arm'

    def _shown(self, topic: str) -> str:
        """Return the name of a topic in the graph, without the namespace of this node."""
        return self._resolve(topic).removeprefix(f'{self._node.get_namespace().rstrip("/")}/')

    def _look(self, topic: str) -> None:
        publishers = publishers_of(self._node, self._resolve(topic))
        self._authorships[topic].look(publishers, self._turns(topic), time.monotonic())
