# SPDX-License-Identifier: Apache-2.0
"""`replay --as-trajectory`: sends the hand-guided motion of a bag as one trajectory.

The nodes that subscribe to the topic report on /diagnostics whether they use the trajectory.
"""

import sys
from argparse import Namespace

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from musculoskeletal_ae.bags.playback import LEAD_TIME, TAUGHT_TOPIC, taught_motion, window
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import select
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError
from musculoskeletal_ae.ros.diagnostics import LAST_REJECTED, PERIOD, rejected_counts, values_of
from musculoskeletal_ae.ros.message_building import RELIABLE
from musculoskeletal_ae.ros_tools.ros_tool import Spinner, start_ros

#: wait at most this long for reliable subscribers to acknowledge the messages [s]
ACKNOWLEDGE_TIME = 2.0
TRAJECTORY = 'joint_trajectory'
#: rate that /diagnostics states if no message of a topic was used since the previous report
NO_RATE = '0.0 Hz'
FIRST_REPORT_TIME = 2.0 * PERIOD  # wait at most this long for a first report of the subscribers [s]
REPORT_TIME = 5.0 * PERIOD  # wait at most this long for two reports after sending a trajectory [s]
SENDINGS = 3  # send a trajectory at most this many times, until a node uses it


def send_taught_motion(bag: Bag, options: Namespace, arguments: list[str]) -> int:
    """Send a hand-guided motion as one trajectory, and return the exit status 0.

    Raises:
        MusculoskeletalError: If the bag has no hand-guided motion, or the trajectory is not
            received or is refused.
    """
    names = select(bag, [TAUGHT_TOPIC], options.from_namespace, options.keep_names)
    if len(names) > 1:  # with --keep-names, the bag's arms stay separate
        problem = f'has the motion of several arms: {", ".join(names)}'
        raise BagError(bag.path, problem, 'choose one with --from-namespace')
    ((recorded, name),) = names.items()
    motion = taught_motion(bag, recorded, *window(bag, options.start, options.duration))
    message = JointTrajectory(joint_names=motion.joints)
    for seconds, theta, velocity in zip(*motion[1:]):
        point = JointTrajectoryPoint(positions=theta.tolist(), velocities=velocity.tolist())
        point.time_from_start = Duration(seconds=float(seconds)).to_msg()
        message.points.append(point)
    start_ros(arguments)
    node = Node('replay')
    topic, spinner = name.removesuffix(TAUGHT_TOPIC) + TRAJECTORY, Spinner(node)
    _send(node, spinner, message, topic, options.wait)
    length = f'{len(message.points)} points, {motion.time[-1]:.1f} s'
    print(
        f'{topic}: {length}; the first {LEAD_TIME:g} s move the arm to the beginning of the motion'
    )
    return 0


class _Answers:
    """Reports on /diagnostics of the nodes that subscribe to a topic."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node, self._topic = node, topic
        self._refused_before = 0
        self.reports: list[dict[str, str]] = []
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, RELIABLE)

    @property
    def listeners(self) -> set[str]:
        """Full names of the nodes that subscribe to the topic."""
        infos = self._node.get_subscriptions_info_by_topic(self._topic)
        return {f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in infos}

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.removesuffix(': state') in self.listeners:
                self.reports.append(values_of(status))

    def begin(self) -> None:
        """Discard the reports so far; `refusal` then ignores the refusals that they counted."""
        self._refused_before = self._refused
        self.reports.clear()

    @property
    def _refused(self) -> int:
        counts = rejected_counts(self.reports[-1]) if self.reports else {}
        return sum(count for why, count in counts.items() if why.startswith(f'{TRAJECTORY}: '))

    @property
    def is_taken(self) -> bool:
        """Whether a node has reported using a message since `begin`."""
        key = f'{TRAJECTORY} rate'
        return any(values.get(key, NO_RATE) != NO_RATE for values in self.reports)

    @property
    def refusal(self) -> str:
        """Why a node has refused a message since `begin`; '' if none has reported a refusal."""
        if not self.reports or self._refused <= self._refused_before:
            return ''
        last = self.reports[-1].get(LAST_REJECTED, '')
        return last if last.startswith(TRAJECTORY) else '/diagnostics shows the reason'


def _send(node: Node, spinner: Spinner, message: JointTrajectory, topic: str, wait: float) -> None:
    """Send a trajectory to the connected nodes, and wait until one has used it.

    Raises:
        MusculoskeletalError: If there is no subscriber, or the trajectory was lost or refused.
    """
    publisher = node.create_publisher(JointTrajectory, topic, RELIABLE)
    answers = _Answers(node, publisher.topic_name)
    # Wait for both, because discovery may list a subscriber before or after it is connected.
    spinner.spin_until(lambda: publisher.get_subscription_count() and answers.listeners, wait)
    if not publisher.get_subscription_count():
        listeners = ', '.join(sorted(answers.listeners))
        raise MusculoskeletalError(
            f'no connection to {listeners} within {wait:g} s; try again with a longer --wait'
            if listeners
            else f'{topic} has no subscriber: start the controller first'
        )
    spinner.spin_until(lambda: answers.reports, FIRST_REPORT_TIME)
    has_reported = bool(answers.reports)
    for _ in range(SENDINGS):
        answers.begin()
        publisher.publish(message)
        is_acknowledged = publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_TIME))
        # Wait for two reports: the first may have been sent before the trajectory arrived.
        spinner.spin_until(
            lambda: answers.is_taken or answers.refusal or len(answers.reports) > 1,
            REPORT_TIME if has_reported else 0.0,
        )
        if answers.refusal:
            raise MusculoskeletalError(f'the controller refused the trajectory: {answers.refusal}')
        if answers.is_taken:
            return
        if is_acknowledged and not answers.reports:
            print(
                f'{topic} was received, but no node has reported whether it follows the trajectory',
                file=sys.stderr,
            )
            return
    raise MusculoskeletalError(
        f'the trajectory was sent {SENDINGS} times on {topic}, but no node has used it; try again '
        'when this machine is less busy'
    )
