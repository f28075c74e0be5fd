# SPDX-License-Identifier: Apache-2.0
"""The topics of INTERFACE.md, and the namespace a recording has them under."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from musculoskeletal_ae.exceptions import MusculoskeletalError


class Topic(NamedTuple):
    """One row of INTERFACE.md's table.

    Attributes:
        type: ROS message type.
        latched: The last message reaches late joiners.
        sent: By hardware, vision, user or controller: what nodes do not compute from the rest.
    """

    type: str
    latched: bool = False
    sent: bool = False


_ARRAY = 'std_msgs/msg/Float64MultiArray'
_JOINTS = 'sensor_msgs/msg/JointState'
_WRENCH = 'geometry_msgs/msg/WrenchStamped'
_MARKERS = 'visualization_msgs/msg/MarkerArray'

DIAGNOSTICS = '/diagnostics'  # the one absolute name

TOPICS = {
    'joint_states': Topic(_JOINTS, sent=True),
    'muscle_states': Topic(_ARRAY, sent=True),
    'muscle_length_command': Topic(_ARRAY, sent=True),
    'muscle_tension_command': Topic(_ARRAY, sent=True),
    'target_joint_states': Topic(_JOINTS, sent=True),
    'estimated_joint_states': Topic(_JOINTS),
    'estimated_muscle_states': Topic(_ARRAY),
    'anomaly': Topic('std_msgs/msg/Float64'),
    'anomaly_detected': Topic('std_msgs/msg/Bool', latched=True),
    'mae_checkpoint': Topic('std_msgs/msg/UInt8MultiArray', latched=True),
    'marker_pose': Topic('geometry_msgs/msg/PoseStamped', sent=True),
    'vision_joint_states': Topic(_JOINTS),
    'sim/joint_states': Topic(_JOINTS),
    'sim/muscle_states': Topic(_ARRAY),
    'sim/external_wrench': Topic(_WRENCH, sent=True),
    'hardware_emulator/external_wrench': Topic(_WRENCH),
    'sim/fixed_joint_states': Topic(_JOINTS, sent=True),
    'sim/markers': Topic(_MARKERS),
    'hardware_emulator/markers': Topic(_MARKERS),
    'robot_description': Topic('std_msgs/msg/String', latched=True, sent=True),
    DIAGNOSTICS: Topic('diagnostic_msgs/msg/DiagnosticArray'),
}

SENT = [name for name, topic in TOPICS.items() if topic.sent]


def _namespaces(name: str) -> set[str]:
    return {name[: -len(topic) - 1] for topic in TOPICS if name.endswith(f'/{topic}')}


def recorded_namespace(names: Iterable[str], wanted: str | None = None) -> str:
    """Return the namespace ('' or '/left_arm') under which the topics were recorded.

    `/sim/joint_states` alone may be the joint_states of a namespace `/sim`: of the namespaces that
    explain all topics of the interface, the shortest is meant.

    Args:
        names: The recorded absolute names; foreign ones are of no account.
        wanted: The namespace to take when there are several.

    Raises:
        MusculoskeletalError: If there are several and none is wanted.
    """
    if wanted is not None:
        return f'/{wanted.strip("/")}'.rstrip('/')
    readings = [found for name in names if (found := _namespaces(name))]
    if not readings:
        return ''
    common = set.intersection(*readings)
    if common:
        return min(common, key=len)
    several = sorted({min(found, key=len) or '/' for found in readings})
    raise MusculoskeletalError(
        f'topics of the interface lie under several namespaces: {", ".join(several)}; '
        'choose one with --from-namespace, or keep the recorded names with --keep-names'
    )


def relative_name(name: str, namespace: str) -> str:
    """Return a recorded name without its namespace; a name outside it stays absolute."""
    if name == DIAGNOSTICS or not name.startswith(f'{namespace}/'):
        return name
    return name[len(namespace) + 1 :]


def interface_name(name: str) -> str:
    """Return the longest name of the interface that a recorded name ends in, or the name."""
    endings = [topic for topic in TOPICS if name.endswith(f'/{topic.lstrip("/")}')]
    return max(endings, key=len, default=name)
