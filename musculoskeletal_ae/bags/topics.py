# SPDX-License-Identifier: Apache-2.0
"""The topics of doc/reference/topics_and_services.md, and their names in a bag."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import CONVERT_ROS1, EMPTY
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.files import read_table
from musculoskeletal_ae.robot.motors import ARRAY, FILE, JOINT_STATE, NO_MOTORS, MotorTopics


class Topic(NamedTuple):
    """A topic of the interface: one row of the table in doc/reference/topics_and_services.md."""

    type: str  # message type, such as 'sensor_msgs/msg/JointState'
    latched: bool = False  # whether late joiners receive the last message
    #: whether it is an input from hardware, vision or user, or a command to the muscle modules; all
    #: other topics follow from these
    sent: bool = False


DIAGNOSTICS = '/diagnostics'  # the only topic of the interface with an absolute name
DEFAULT, ALL = 'default', 'all'  # values of `--topics` that select several topics (`select`)

TOPICS = read_table(__file__, 'topics.yaml', dict[str, Topic])  # the interface, by relative name
SENT = [name for name, topic in TOPICS.items() if topic.sent]  # replay these topics by default


def topics_with(motors: MotorTopics) -> dict[str, Topic]:
    """Return all topics of the interface, and the motor topics of a ros2_control robot, by name."""
    topics = dict(TOPICS)
    if motors.states:
        topics.setdefault(motors.states, Topic(JOINT_STATE, sent=True))
    if motors.commands:
        # Not `sent`, so that a replay does not move the motors of a connected robot by default.
        topics.setdefault(motors.commands, Topic(ARRAY))
    return topics


def interface_topics(
    bag: Bag, namespace: str | None = None, motors: MotorTopics = NO_MOTORS
) -> dict[str, str]:
    """Return the recorded name of each topic of the interface, by its relative name.

    If a ros2_control robot has a topic for its motor states, this topic is returned as
    `muscle_states`.

    Args:
        bag: The recording.
        namespace: The namespace of the arm; required only if the bag has several.
        motors: Topics of the motors of a ros2_control robot.

    Raises:
        BagError: If the namespace is ambiguous or not in the bag, if the topic of the motors is
            missing, or if a topic has another type than in the interface.
    """
    names = _relative_names(bag, namespace, motors)
    topics = topics_with(motors)
    ours = {relative: name for name, relative in names.items() if relative in topics}
    for relative, name in ours.items():
        _compare_type(bag, name, topics[relative].type)
    if state_topic := motors.states:
        if state_topic not in ours:
            problem = f'topic {state_topic}, which {FILE} names, is not in the bag'
            raise BagError(bag.path, problem, _topics_of(bag))
        recorded = ours['muscle_states'] = ours[state_topic]
        if interface_name(recorded) == 'joint_states':
            ours.setdefault('joint_states', recorded)
    return {name: recorded for name, recorded in ours.items() if name in TOPICS}


def select(
    bag: Bag,
    wanted: Sequence[str],
    namespace: str | None,
    keep_names: bool,
    motors: MotorTopics = NO_MOTORS,
) -> dict[str, str]:
    """Select the topics to replay.

    Args:
        bag: The recording.
        wanted: ['default'] for measurements, requests of users, and commands to the muscle
            modules, ['all'] for every topic of the interface, or names of any topics, relative or
            as recorded.
        namespace: The namespace of the arm; required only if the bag has several and `keep_names`
            is False.
        keep_names: Whether to publish on the recorded names.
        motors: Topics of the motors of a ros2_control robot.

    Returns:
        For each selected topic, by its recorded name, the name to publish on.

    Raises:
        BagError: If the namespace is ambiguous or not in the bag, or if a topic is missing or
            cannot be replayed.
    """
    topics = topics_with(motors)
    if keep_names and namespace is None:
        # With the recorded names, several namespaces are not ambiguous.
        names = {name: interface_name(name) for name in bag.topics} | _motor_topics(bag, motors)
    else:
        names = _relative_names(bag, namespace, motors)
    topics_of_bag, leave_out = _topics_of(bag), ''
    if list(wanted) in ([DEFAULT], [ALL]):
        leave_out = ', or select the other topics with --topics NAME,…'
        sent = [*SENT, motors.states]
        relevant = sent if wanted[0] == DEFAULT else [*topics]
        chosen = [name for name, relative in names.items() if relative in relevant]
        if not chosen:
            kind = 'of the interface' if wanted[0] == ALL else 'to replay by default'
            legal = '--topics NAME,…' if wanted[0] == ALL else f'--topics {ALL} or --topics NAME,…'
            problem = f'has no topic {kind}; {topics_of_bag}'
            raise BagError(bag.path, problem, f'choose topics with {legal}')
    else:
        chosen = [name for one in wanted for name in names if one in (name, names[name])]
        for one in wanted:
            if one not in {*names, *names.values()}:
                raise BagError(bag.path, f'topic {one} is not in the bag', topics_of_bag)
    for name in chosen:
        topic = topics.get(names[name])
        _compare_type(bag, name, topic.type if topic else bag.topics[name].type, leave_out)
    return {name: name if keep_names else names[name] for name in chosen}


def latched_topics(bag: Bag) -> set[str]:
    """Return the recorded names of latched topics.

    Latched topics of the interface are included even if the recorder did not store their QoS.
    """
    ours = {name for name, topic in TOPICS.items() if topic.latched}
    return {
        name
        for name, topic in bag.topics.items()
        if topic.is_latched or interface_name(name) in ours
    }


def namespaces(names: Iterable[str]) -> list[str]:
    """Return the namespaces of the interface's topics in a recording, such as '/left_arm'.

    The root namespace is ''. Recorded names can be ambiguous: `/sim/joint_states` is a topic of the
    interface in the root, but also `joint_states` in the namespace `/sim`. If all topics can belong
    to one namespace, only this namespace is returned; of several such namespaces, the shortest is.

    Args:
        names: Recorded names of topics.
    """
    readings = [
        {name[: -len(topic) - 1] for topic in TOPICS if name.endswith(f'/{topic}')}
        for name in names
    ]
    readings = [reading for reading in readings if reading]
    common = set.intersection(*readings) if readings else {''}
    return [min(common, key=len)] if common else sorted({min(r, key=len) for r in readings})


def interface_name(name: str) -> str:
    """Return the longest name of the interface with which `name` ends, or `name` if none does."""
    endings = [topic for topic in TOPICS if name.endswith(f'/{topic.lstrip("/")}')]
    return max(endings, key=len, default=name)


def _motor_topics(bag: Bag, motors: MotorTopics) -> dict[str, str]:
    """Return the name in motors.yaml of each recorded motor topic, by recorded name.

    The file may use a relative name that the interface uses too, such as `joint_states`. Such a
    topic counts as one of the interface and is left out.
    """
    stated = [motors.states, motors.commands]
    return {
        name: topic
        for name in bag.topics
        for topic in stated
        if topic == name or (topic and topic not in TOPICS and name.endswith(f'/{topic}'))
    }


def _topics_of(bag: Bag) -> str:
    return f'it has: {", ".join(sorted(bag.topics))[:500] or "no topics"}'


def _relative_names(
    bag: Bag, namespace: str | None, motors: MotorTopics = NO_MOTORS
) -> dict[str, str]:
    """Return the name of each recorded topic relative to a namespace, by recorded name.

    Names outside the namespace stay absolute, and so do motor topics that motors.yaml states with
    their absolute names. A topic of the interface that the namespace lacks may be taken from an
    enclosing namespace.

    Args:
        bag: The recording.
        namespace: The namespace, or None for the one that the bag has.
        motors: Topics of the motors of a ros2_control robot.

    Raises:
        BagError: If the bag is empty, if the namespace is not in the bag, or if it is None and the
            bag has several.
    """
    if not bag.message_count:
        raise BagError(bag.path, *EMPTY)
    motor_topics = _motor_topics(bag, motors)
    placed = [name for name in bag.topics if name not in motor_topics]
    if namespace is None:
        namespace, *others = namespaces(placed)
        if others and (nested := _innermost(placed, [namespace, *others])) is not None:
            namespace = nested
        elif others:
            several = ', '.join(name or '/' for name in (namespace, *others))
            problem = f'topics of the interface are in several namespaces: {several}'
            raise BagError(bag.path, problem, 'choose one with --from-namespace')
    prefix = f'/{namespace.strip("/")}/'.replace('//', '/')
    if not any(name.startswith(prefix) for name in bag.topics):
        there = ', '.join(name or '/' for name in namespaces(placed)) or 'none'
        remedy = f'choose one of its namespaces with --from-namespace: {there}'
        raise BagError(bag.path, f'has no topic under {prefix!r}', remedy)
    names = {
        name: name if name == DIAGNOSTICS else name.removeprefix(prefix) for name in bag.topics
    }
    # Missing topics may be in an enclosing namespace, such as a driver's joint_states in the root.
    for outer in _around(namespace):
        for name in bag.topics:
            relative = name.removeprefix(f'{outer}/')
            if names[name] == name and relative in TOPICS and relative not in names.values():
                names[name] = relative
    return names | {name: topic for name, topic in motor_topics.items() if topic == name}


def _around(namespace: str) -> list[str]:
    """Return the namespaces that enclose a namespace, the innermost first; '' is the root."""
    parts = [part for part in namespace.split('/') if part]
    return [''.join(f'/{part}' for part in parts[:n]) for n in reversed(range(len(parts)))]


def _innermost(topics: Iterable[str], nested: Sequence[str]) -> str | None:
    """Return the namespace that all other namespaces enclose.

    Args:
        topics: Recorded names of topics.
        nested: The namespaces of these topics.

    Returns:
        The namespace, or None if there is no such namespace, or if two namespaces contain the
        same topic of the interface (other than /diagnostics).
    """
    innermost = max(nested, key=len)
    if not set(nested) <= {innermost, *_around(innermost)}:
        return None
    relative = [interface_name(name) for name in topics if interface_name(name) in TOPICS]
    ours = [name for name in relative if name != DIAGNOSTICS]
    return innermost if len(ours) == len(set(ours)) else None


def _compare_type(bag: Bag, name: str, expected: str, leave_out: str = '') -> None:
    """Compare the type of a topic with the expected one, and check that it can be decoded.

    Args:
        bag: The recording.
        name: Recorded name of the topic.
        expected: The message type that it must have.
        leave_out: Text that is appended to the remedy in the error message.

    Raises:
        BagError: If the topic has another type, or cannot be decoded.
    """
    topic = bag.topics[name]
    if topic.is_of_ros1:
        raise BagError(bag.path, f'topic {name} has messages of ROS 1', CONVERT_ROS1)
    if topic.type != expected:
        problem = (
            f'topic {name} has the type {topic.type[:80]!r}; legal for this name: {expected!r}'
        )
        remedy = f'record the topic under another name{leave_out}'
        raise BagError(bag.path, problem, remedy)
    if topic.problem:
        remedy = f'record the topic with ROS 2 Jazzy{leave_out}'
        raise BagError(bag.path, f'topic {name} {topic.problem}', remedy)
