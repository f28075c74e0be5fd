# SPDX-License-Identifier: Apache-2.0
"""Poses of all links on /tf, where ROS has tf2_msgs: a sourced Jazzy does, the wheels do not."""

from __future__ import annotations

import pinocchio as pin
from geometry_msgs.msg import TransformStamped

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.qos import RELIABLE
from musculoskeletal_ae.nodes.shell import Shell


class Frames:
    """Publishes where links are in the root link's frame."""

    def __init__(self, node: Shell) -> None:
        """Advertise /tf.

        Raises:
            MusculoskeletalError: If tf2_msgs is not installed.
        """
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError as error:
            raise MusculoskeletalError(
                'parameter publish_tf: tf2_msgs is not installed; source ROS 2 Jazzy, or leave it '
                '"none"'
            ) from error
        self._node, self._message = node, TFMessage
        self._prefix: str = node.parameter('frame_prefix')
        self._publisher = node.create_publisher(TFMessage, '/tf', RELIABLE)

    def publish(self, theta: Array) -> None:
        """Publish the poses at θ [rad] (D,)."""
        stamp, transforms = self._node.get_clock().now().to_msg(), []
        for link, pose in self._node.robot.kinematics.link_poses(theta).items():
            if link == self._node.robot.root_link:
                continue
            transform = TransformStamped(child_frame_id=self._prefix + link)
            transform.header.frame_id, transform.header.stamp = self._node.root_frame, stamp
            position, turn = transform.transform.translation, transform.transform.rotation
            position.x, position.y, position.z = pose.translation.tolist()
            turn.x, turn.y, turn.z, turn.w = pin.Quaternion(pose.rotation).coeffs().tolist()
            transforms.append(transform)
        self._publisher.publish(self._message(transforms=transforms))
