# SPDX-License-Identifier: Apache-2.0
"""Every topic that has one rightful publisher is checked for exactly one.

A message does not say who sent it, so the graph has to. While several nodes publish a topic of
`AUTHORS`, nobody uses its messages, every node that has to do with it reports an ERROR, and the
controller stops. A latched topic is subscribed to anew afterwards: its rightful value comes again.

Two publishers of one node name are no proof. A node that was killed stays in the graph for up to
20 s beside its successor, but sends nothing more. Three things tell it from a second node:

- Messages whose numbers go back again and again come from two nodes that take turns.
- Reports on /diagnostics carry a random identity of the node that sent them. A node that hears
  its own name with another identity, after its own first report, has a twin.
- Two publishers that have both been known for longer than the graph keeps a dead one are two.
"""

from __future__ import annotations

import math
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

from builtin_interfaces.msg import Time
from rclpy.node import Node

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.reception import REORDERING

_ESTIMATOR, _CONTROLLER, _DRIVER = 'the estimator', 'the controller', 'the driver'
#: the topics that have one rightful publisher, and which node that is
AUTHORS = {
    'muscle_states': _DRIVER,
    'joint_states': _DRIVER,
    'muscle_length_command': _CONTROLLER,
    'muscle_tension_command': _CONTROLLER,
    'estimated_joint_states': _ESTIMATOR,
    'muscle_length_zeros': _ESTIMATOR,
    'anomaly_detected': _ESTIMATOR,
    'isolated_muscles': _ESTIMATOR,
    'accepted_checkpoint': _ESTIMATOR,
    'mae_checkpoint': 'the learner',
}
COMMANDS = frozenset(topic for topic, author in AUTHORS.items() if author == _CONTROLLER)
SEVERAL = 'several publishers'  # why a message was rejected

LOOK_PERIOD = 0.1  # [s] between looks at the graph
LOOKS, TURNS = 20, 3  # looks within which so many turns tell two publishers of one name
#: [s] for which the graph keeps a node that was killed, and some more
LEASE = 30.0
#: [s] for which the graph may know a publisher, but not its node yet
NAMING = 1.0
TWIN_SILENCE = 3.0  # [s] without a report after which a second node has ended
UNNAMED = '_NODE_NAME_UNKNOWN_'


class Publisher(NamedTuple):
    """One publisher, as the graph knows it."""

    node: str  # full name
    identity: bytes

    @property
    def is_named(self) -> bool:
        """Whether the graph knows its node."""
        return not self.node.endswith(UNNAMED)


class Authorship:
    """Decides from looks at the graph whether one topic has more than one publisher.

    Attributes:
        intruders: Which nodes publish it, if they are several: `/a and /b`; else ''.
        is_certain: Whether the graph is clear; while it is not, latched messages can wait.
    """

    def __init__(self) -> None:
        self.intruders, self.is_certain = '', True
        self._first_seen: dict[bytes, float] = {}  # by publisher [s]
        self._turns: deque[int] = deque([0], maxlen=LOOKS)

    def look(self, publishers: Iterable[Publisher], turns: int, now: float) -> None:
        """Take who publishes the topic at `now` [s], and how often its messages took turns."""
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
                f'{count} nodes {node}' if count > 1 else node for node, count in nodes.items()
            )
            self.intruders = ' and '.join(sorted(names))
        self.is_certain = not fresh


class Twins:
    """Notices a second node of the same name, by its reports on /diagnostics.

    Reports are searched as bytes: reading all reports of all nodes would take 1 % of a core.
    """

    def __init__(self, name: str, identity: str) -> None:
        """Watch reports under a status `name`; ours contain `identity`."""
        # As CDR has texts: `/controller` is not found in `/left/controller`.
        text = name.encode() + b'\0'
        self._name, self._identity = struct.pack('<I', len(text)) + text, identity.encode()
        self._has_reported = False
        self._heard_at = -math.inf  # of another node [s]

    def take(self, report: bytes, now: float) -> None:
        """Take a report that came at `now` [s], in CDR.

        What comes before our own first report may be the last that a killed node has sent.
        """
        if self._name not in report:
            return
        if self._identity in report:
            self._has_reported = True
        elif self._has_reported:
            self._heard_at = now

    def is_alone(self, now: float) -> bool:
        """Whether no other node has reported under this name for some time."""
        return now - self._heard_at > TWIN_SILENCE


class Sources:
    """Watches the authors of all topics that a node has to do with."""

    def __init__(self, node: Node, turns: Counter[str], renew: Callable[[str], object]) -> None:
        """Watch nothing yet.

        Args:
            node: Looks at the graph.
            turns: How often the messages of each topic took turns.
            renew: Subscribes to a topic anew, once it has one publisher again.
        """
        self._node, self._turns, self._renew = node, turns, renew
        self._authorships: dict[str, Authorship] = {}
        self._to_renew: set[str] = set()

    def watch(self, *topics: str) -> None:
        """Watch these topics as well, as far as they have one rightful publisher."""
        for topic in topics:
            if topic in AUTHORS and topic not in self._authorships:
                self._authorships[topic] = Authorship()

    def check(self, topic: str, is_latched: bool) -> None:
        """Check a message that comes now.

        Raises:
            MessageError: If it may be from another node than the rightful publisher.
        """
        authorship = self._authorships[topic]
        if is_latched:  # it is rare, and may move the arm at once
            self._look(topic)
        if authorship.intruders or (is_latched and not authorship.is_certain):
            if is_latched:
                self._to_renew.add(topic)
            raise MessageError(SEVERAL, authorship.intruders or 'one is not known yet')

    def look(self) -> None:
        """Look at the graph; read anew what could not be used."""
        for topic in self._authorships:
            self._look(topic)
        for topic in sorted(self._to_renew):
            authorship = self._authorships[topic]
            if authorship.is_certain and not authorship.intruders:
                self._to_renew.discard(topic)
                self._renew(topic)

    @property
    def intruders(self) -> str:
        """Which topics come from several nodes, and from which; or ''."""
        topics: dict[str, list[str]] = {}
        for topic, each in self._authorships.items():
            if each.intruders:
                topics.setdefault(each.intruders, []).append(topic)
        return '; '.join(
            f'{", ".join(sorted(names))} come from {nodes}' for nodes, names in topics.items()
        )

    def remedy(self) -> str:
        """Return what to do about the intruders."""
        authors = {AUTHORS[topic] for topic, each in self._authorships.items() if each.intruders}
        if not authors:
            return 'end one of them'
        return f'end all publishers but {" and ".join(sorted(authors))} of this arm'

    def _look(self, topic: str) -> None:
        full, publishers = self._node.resolve_topic_name(topic), list[Publisher]()
        if self._node.count_publishers(full) > 1:
            for each in self._node.get_publishers_info_by_topic(full):
                name = f'{each.node_namespace.rstrip("/")}/{each.node_name}'
                publishers.append(Publisher(name, bytes(each.endpoint_gid)))
        now = time.monotonic()
        self._authorships[topic].look(publishers, self._turns[topic], now)


class Stamps:
    """Tells newer messages of one publisher from repeated ones, by their stamps."""

    def __init__(self) -> None:
        self._last: int | None = None  # [ns]

    def is_new(self, stamp: Time) -> bool:
        """Whether a stamp is later than the one before, or the clock was set back meanwhile."""
        time, last = stamp.sec * 1_000_000_000 + stamp.nanosec, self._last
        if last is not None and last - REORDERING < time <= last:
            return False
        self._last = time
        return True
