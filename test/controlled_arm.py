# SPDX-License-Identifier: Apache-2.0
"""Emulator, estimator and controller on one graph, with helpers for tests."""

import signal

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.awake_clock import PAUSE
from musculoskeletal_ae.messages.arrival import LONGEST_STEP
from musculoskeletal_ae.messages.message_reading import read_array
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.nodes.learner import LearnerNode
from musculoskeletal_ae.signals.muscle_states import read_muscle_states

RATE = 50.0  # rate of the arm's messages [Hz]; 100 Hz would take twice the processor time
RATE_LIMIT = 0.2  # rate limit of length commands [m/s]
#: the longest legal max_age [s], so that a loaded machine does not stop the arm
PATIENT = 10.0
IMPATIENT = 1.0  # max_age while a test waits for a stop because of missing data [s]
NODES = {
    'hardware_emulator': HardwareEmulatorNode,
    'estimator': EstimatorNode,
    'controller': ControllerNode,
    'learner': LearnerNode,
}


class ControlledArm:
    """The control loop of arm26 in the graph of a test.

    The nodes run in the test's process, except those that a test kills.
    """

    def __init__(self, graph, robot, checkpoint, processes=(), **hardware):
        self.graph, self.robot, self.checkpoint = graph, robot, checkpoint
        self.processes = processes
        for kind, topic in (
            (Float64MultiArray, 'muscle_states'),
            (Float64MultiArray, 'muscle_length_command'),
            (Float64MultiArray, 'muscle_tension_command'),
            (JointState, 'joint_states'),
            (JointState, 'estimated_joint_states'),
            (DiagnosticArray, '/diagnostics'),
        ):
            graph.listen(kind, topic, 1000)
        self.sendings = []  # sequence number and time of sending [s] of each length command
        graph.node.create_subscription(
            Float64MultiArray, 'muscle_length_command', self._note_sending, 1000
        )
        self.hardware = self.start('hardware_emulator', seed=1, **hardware)
        self.estimator = self.start('estimator', checkpoint=checkpoint)
        self.controller = self.start_controller()
        self.targets = graph.publisher(JointState, 'target_joint_states')
        self.says('no target')  # the controller reports this once it has a posture and a network

    def start(self, name, **parameters):
        if name in self.processes:
            return self.graph.start(name, robot='arm26', rate=RATE, **parameters)
        return self.graph.host(NODES[name], robot='arm26', rate=RATE, **parameters)

    def start_controller(self, **parameters):
        return self.start(
            'controller',
            checkpoint=self.checkpoint,
            first_duration=1.0,
            rate_limit=RATE_LIMIT,
            max_age=PATIENT,
            **parameters,
        )

    def kill(self, process, number=signal.SIGKILL):
        """Kill a node on purpose, while the others continue."""
        self.graph.processes.remove(process)
        process.process.send_signal(number)
        self.graph.wait(lambda: not process.alive(), f'the end of {process.name}')

    def set_max_age(self, seconds):
        assert self.graph.set_parameter('controller', 'max_age', seconds)[0]

    def target(self, theta, effort=()):
        self.targets.publish(
            JointState(name=self.robot.joints, position=list(theta), effort=list(effort))
        )

    def count(self, kind='length'):
        """Return the number of commands of a kind so far."""
        return len(self.graph.received[f'muscle_{kind}_command'])

    def sent(self, kind='length'):
        """Return all commands of a kind so far."""
        messages = self.graph.received[f'muscle_{kind}_command']
        return np.array([read_array(m, 1, self.robot.muscle_count) for m in messages])

    def never_jumped(self, since=0, relieved=False):
        """Check that no length command exceeded the rate limit.

        Muscles whose tension is above the limit may be paid out faster, if `relieved` is true.
        After a pause of this process, commands begin anew from the present lengths. A command that
        did not arrive leaves a gap in the sequence numbers; the next one may differ by two steps.
        """
        sent = self.sent()[since:]
        numbers, times = np.array(self.sendings[since : since + len(sent)]).T
        steps = np.diff(sent[: len(numbers)], axis=0) / np.maximum(np.diff(numbers), 1)[:, None]
        steps = steps[np.diff(times) <= 0.5 * PAUSE]
        largest = -steps if relieved else np.abs(steps)
        assert largest.max() <= RATE_LIMIT * LONGEST_STEP + 1e-9

    def _note_sending(self, _, info):
        self.sendings.append((info['publication_sequence_number'], 1e-9 * info['source_timestamp']))

    def posture(self):
        return np.array(self.graph.next('joint_states').position)

    def tension(self):
        return read_muscle_states(self.graph.next('muscle_states'), self.robot).tension

    def goes_to(self, theta, within=0.3):
        theta = np.asarray(theta)
        self.graph.wait(
            lambda: np.linalg.norm(self.posture() - theta) < within, f'the posture {theta}'
        )

    def pays_out(self):
        bias = self.robot.tension.bias[0]
        self.graph.wait(lambda: self.tension().max() < bias + 8.0, 'tensions near the bias')

    def state(self, node='controller'):
        """Return the status of a node.

        The report of a controller in this process is read at once. For other nodes, the function
        waits for the next report on /diagnostics.
        """
        if node == 'controller' and node not in self.processes:
            return self.controller.report()
        return self.graph.report(node)

    def value_of(self, key):
        """Wait for a value of the controller's diagnostics, and return it."""
        self.says(key)
        return self.state().values[key]

    def says(self, words, node='controller'):
        """Wait until the node's diagnostics contain certain words."""

        def is_reported():
            state = self.state(node)
            return words in f'{state.message} {state.values}'

        self.graph.wait(is_reported, repr(words))
