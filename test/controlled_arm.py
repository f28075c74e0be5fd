# SPDX-License-Identifier: Apache-2.0
"""Emulator, estimator and controller on one graph, and what tests ask of them."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.validity import read_array

RATE_LIMIT = 0.2  # [m/s]


class ControlledArm:
    """The whole loop of arm26 in a test's graph."""

    def __init__(self, graph, robot, checkpoint, **hardware):
        self.graph, self.robot, self.checkpoint = graph, robot, checkpoint
        for kind, topic in (
            (Float64MultiArray, 'muscle_states'),
            (Float64MultiArray, 'muscle_length_command'),
            (Float64MultiArray, 'muscle_tension_command'),
            (JointState, 'joint_states'),
            (JointState, 'estimated_joint_states'),
            (DiagnosticArray, '/diagnostics'),
        ):
            graph.listen(kind, topic, 1000)
        self.hardware = self.start_hardware(**hardware)
        self.estimator = self.start_estimator()
        self.controller = self.start_controller()
        graph.next('estimated_joint_states')
        self.targets = graph.publisher(JointState, 'target_joint_states')

    def start_hardware(self, **chosen):
        return self.graph.start('hardware_emulator', robot='arm26', seed=1, **chosen)

    def start_estimator(self):
        return self.graph.start('estimator', robot='arm26', checkpoint=self.checkpoint)

    def start_controller(self):
        return self.graph.start(
            'controller',
            robot='arm26',
            checkpoint=self.checkpoint,
            first_duration=1.0,
            second_duration=0.5,
            rate_limit=RATE_LIMIT,
        )

    def kill(self, process, number):
        """End a node without the graph taking it for an accident."""
        self.graph.processes.remove(process)
        process.end(number)

    def target(self, theta, effort=()):
        self.targets.publish(
            JointState(name=self.robot.joints, position=list(theta), effort=list(effort))
        )

    def sent(self, kind='length'):
        """Return all commands of a kind so far."""
        messages = self.graph.received[f'muscle_{kind}_command']
        return np.array([read_array(m, 1, self.robot.muscle_count) for m in messages])

    def posture(self):
        return np.array(self.graph.next('joint_states').position)

    def tension(self):
        return read_array(self.graph.next('muscle_states'), 3, self.robot.muscle_count)[1]

    def goes_to(self, theta, within=0.3):
        theta = np.asarray(theta)
        self.graph.wait(
            lambda: np.linalg.norm(self.posture() - theta) < within, f'the posture {theta}'
        )

    def pays_out(self):
        bias = self.robot.tension.bias
        self.graph.wait(lambda: self.tension().max() < bias + 8.0, 'tensions near the bias')

    def state(self, node='controller'):
        """Return the node's last diagnostic status."""
        name = f'{self.graph.namespace}/{node}: state'
        for message in reversed(self.graph.received['/diagnostics']):
            for status in message.status:
                if status.name == name:
                    return status
        return DiagnosticStatus()

    def reachable(self, joint):
        """Return the range of a joint's stiffness that the controller reports."""
        key = f'joint stiffness {joint}'
        self.says(key)
        said = {pair.key: pair.value for pair in self.state().values}[key]
        low, high = said.split('reachable ')[1].split(',')[0].split(' to ')
        return float(low), float(high)

    def says(self, words, node='controller'):
        """Wait until the node's diagnostics contain words."""
        self.graph.wait(
            lambda: words in f'{self.state(node).message} {self.state(node).values}', repr(words)
        )
