# SPDX-License-Identifier: Apache-2.0
"""The node `learner`: learns the body online, and publishes the network for the estimator.

muscle_states, joint_states or vision_joint_states (or neither), imu, body_state, joint_sensor_trust
→ mae_checkpoint.
accepted_checkpoint and rejected_checkpoint are the estimator's answers.
"""

import math
from collections.abc import Iterator
from typing import Any

from diagnostic_msgs.msg import KeyValue
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.training_process import TrainerProcess
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.messages.arrival import SPACING
from musculoskeletal_ae.messages.message_reading import read_imu
from musculoskeletal_ae.nodes.checkpoint_queue import ACCEPTED, REJECTED
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.parameters import naming_parameter
from musculoskeletal_ae.robot.kinematics import body_frames
from musculoskeletal_ae.ros.latched_values import LatchedPublisher
from musculoskeletal_ae.ros.message_building import LATCHED, SENSOR, bytes_message, serve

MOST_DIGITS = 15  # reject a version of a network with more digits
POLL_PERIOD = 0.05  # look at this interval whether the training process has finished an update [s]
#: assume at least this period of muscle_states when pairing them with joint angles [s]
LEAST_PERIOD = 0.01
JOINT_TOPICS = {'sensor': 'joint_states', 'marker': 'vision_joint_states'}


class LearnerNode(Shell):
    """Passes messages, parameters and services to the core learner; publishes its networks."""

    is_time_critical = False

    def __init__(self, **options: Any) -> None:
        super().__init__('learner', **options)
        value = self.parameter
        self.taken_at = -math.inf  # time of the last muscle message that the core received [s]
        self.core = Learner(
            self.robot,
            preset=value('preset'),
            seed=value('seed'),
            period=max(1.0 / self.rate, LEAST_PERIOD),
            joint_source=value('joint_source'),
            trainer=TrainerProcess,
            directory=self.state_directory(),
        )
        core = self.core
        self._begin()
        self.parameters.follow('relearn_muscles', self.robot.muscle_indices)
        # `replace` replaces what was learned, which cannot be undone. Therefore `load_checkpoint`
        # checks the value before any parameter of a request is set.
        self.parameters.on_change('checkpoint', core.replace, self.load_checkpoint)
        if topic := JOINT_TOPICS.get(value('joint_source')):
            self.needed.add(topic)
            self.follow_posture(topic, lambda theta: core.joints(self.now(), theta), some=True)
        if value('joint_source') == 'sensor':  # the estimator does not judge a camera
            self.follow_joint_trust(core.use_joint_trust)
        self.links = [frame.name for frame in body_frames(self.robot.kinematics.model)]
        self.listen(Imu, 'imu', self._take_imu, SENSOR)
        self.needed.add('muscle_states')
        self.follow_body(lambda: core.use_body(self.body))
        self.follow_muscle_messages(self._take_muscle_states)
        serve(self, SetBool, 'learner/enable', self._enable)
        serve(self, Trigger, 'learner/save', lambda _: f'saved in {self.core.save()}')
        serve(self, Trigger, 'learner/relearn', self._relearn)
        self._decisions = self.checkpoint_queue(ACCEPTED, self._use_accepted)
        self.listen(UInt8MultiArray, ACCEPTED, self._decisions.propose, LATCHED)
        self.listen(KeyValue, REJECTED, self._use_rejected, LATCHED)
        # The graph shows this publisher when the node is ready to report.
        self.publisher = LatchedPublisher(self, UInt8MultiArray, 'mae_checkpoint')
        self.sources.watch('mae_checkpoint')
        self.create_timer(POLL_PERIOD, self._poll, clock=STEADY)

    # -- parameters -----------------------------------------------------------------------------

    def _begin(self) -> None:
        """Continue from the saved state, or begin with the network that `checkpoint` names.

        With `fresh`, the saved state is first discarded; a backup of it is kept.
        """
        if self.parameter('fresh'):
            self.core.replace(None)
        with naming_parameter('checkpoint'):
            mae = None
            if self.core.checkpoint is None:
                mae = self.load_checkpoint(self.parameter('checkpoint'))
            if mae is not None:
                self.core.begin(mae)

    # -- messages -------------------------------------------------------------------------------

    def _take_imu(self, message: Imu) -> None:
        prefix = self.parameter('frame_prefix')
        link, acceleration = read_imu(message, self.links, prefix)
        self.core.imu(self.now(), link, acceleration)

    def _take_muscle_states(self, message: Float64MultiArray, _: float, delay: float) -> None:
        now = self.now()
        if 0.0 < now - self.taken_at < SPACING:  # more messages would not improve the samples
            return
        self.taken_at = now
        self.core.take(message, now, delay)

    def _use_accepted(self, message: UInt8MultiArray) -> Iterator[None]:
        mae = checkpoint.from_bytes(bytes(message.data), self.robot)
        yield
        self.core.note_accepted(mae)

    def _use_rejected(self, message: KeyValue) -> None:
        if not (message.key.isdecimal() and len(message.key) <= MOST_DIGITS):
            raise MessageError(
                'no version',
                f'{message.key[:MOST_DIGITS]!r} is no version of a network; legal: at most '
                f'{MOST_DIGITS} digits',
            )
        self.core.note_rejected(int(message.key), message.value)

    def _enable(self, request: SetBool.Request) -> str:
        self.core.enable(request.data)
        return 'learning' if request.data else 'stopped; samples and network are kept'

    def _relearn(self, _: Trigger.Request) -> str:
        muscles = tuple(self.robot.muscle_indices(self.parameter('relearn_muscles')))
        if not muscles:
            raise MusculoskeletalError(
                '`relearn_muscles` names no muscle; set that parameter first'
            )
        self.core.relearn(muscles)
        return f'relearning: {self.robot.names(muscles)}; other muscles are unchanged'

    def _poll(self) -> None:
        data = self.core.poll(self.now())
        if data is not None:
            self.publisher.publish(bytes_message(data))

    def clock_jumped_back(self) -> None:
        """Discard messages that have not become part of a sample yet."""
        self.core.reset()

    def destroy_node(self) -> None:
        """End the training process, then destroy the node."""
        if self.core:
            self.core.close()
        super().destroy_node()
