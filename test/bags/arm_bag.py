# SPDX-License-Identifier: Apache-2.0
"""A recording of an arm that behaves exactly like its nominal model."""

import numpy as np

from bags import bag_samples as samples
from bags.bag_samples import encode, message_class

ARRAY = 'std_msgs/msg/Float64MultiArray'
JOINTS = 'sensor_msgs/msg/JointState'
STRING = 'std_msgs/msg/String'
PERIOD = 0.01  # time between two messages [s]


def array(values):
    layout = message_class('std_msgs/msg/MultiArrayLayout')([], 0)
    return encode(message_class(ARRAY)(layout, np.asarray(values, dtype=float).ravel()), ARRAY)


def string(text):
    return encode(message_class(STRING)(text), STRING)


def joints(names, theta):
    stamp = message_class('builtin_interfaces/msg/Time')(0, 0)
    header = message_class('std_msgs/msg/Header')(stamp, '')
    none = np.zeros(0)
    return encode(message_class(JOINTS)(header, list(names), np.array(theta), none, none), JOINTS)


class Arm:
    """Smooth random motion of a robot, as messages."""

    def __init__(self, robot, count=200, order=None, late=0.002):
        rng = np.random.default_rng(0)
        swing = rng.uniform(0.5, 2.0, robot.joint_count)
        t = PERIOD * np.arange(count)[:, None]
        middle, half = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 2
        self.time = t[:, 0]
        self.theta = middle + 0.8 * half * np.sin(2 * np.pi * swing * t)
        self.tension = rng.uniform(30.0, 100.0, (count, robot.muscle_count))
        self.length = robot.muscle_lengths(self.theta, self.tension)
        columns = list(range(robot.muscle_count)) if order is None else order
        self.content = []
        for i in range(count):
            rows = [self.length[i, columns], self.tension[i, columns], np.full(len(columns), 30.0)]
            self.add('/muscle_states', ARRAY, i * PERIOD, array(rows))
            self.add(
                '/joint_states', JOINTS, i * PERIOD + late, joints(robot.joints, self.theta[i])
            )

    def add(self, topic, kind, time, data):
        now = samples.START + round(time * 1e9)
        self.content.append(samples.Sample(topic, kind, now, now, data))

    def write(self, path):
        samples.write_ours(path, sorted(self.content, key=lambda s: s.log_time), 'zstd', True)
        return path
