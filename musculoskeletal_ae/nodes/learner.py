# SPDX-License-Identifier: Apache-2.0
"""The node `learner`: learns the body online and hands the network to the other nodes.

joint_states or vision_joint_states, muscle_states, anomaly_detected → mae_checkpoint.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning import learner
from musculoskeletal_ae.learning.rest import RestSettings
from musculoskeletal_ae.learning.samples import Novelty
from musculoskeletal_ae.learning.training import TrainingProcess
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.messages import bytes_message
from musculoskeletal_ae.nodes.qos import LATCHED, SENSOR
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.validity import QUANTITIES, read_array, read_posture

POLL = 0.05  # [s] between looks at the training process
JOINT_TOPICS = {'sensor': 'joint_states', 'marker': 'vision_joint_states'}
AUTO = 'auto'


class Learner(Shell):
    """Node shell of online learning."""

    def __init__(self, **options: Any) -> None:
        """Declare topics and start the training process; options are those of Node."""
        super().__init__('learner', **options)
        value = self.parameter
        self.core = learner.Learner(
            self.robot,
            preset=value('preset'),
            seed=value('seed'),
            steps=value('update_steps'),
            period=1.0 / self.rate,
            rest=RestSettings(
                value('rest_time'), value('rest_joint_rate'), value('rest_length_rate')
            ),
            novelty=Novelty(value('new_joint_distance'), value('new_tension_distance')),
            training=TrainingProcess,
            directory=self._directory(value('state_directory')),
        )
        self.publisher = self.create_publisher(UInt8MultiArray, 'mae_checkpoint', LATCHED)
        self.running = self.troubled = False
        self.follow_parameter('fresh', self._start_fresh)
        self.follow_parameter('checkpoint', self._take_checkpoint)
        self.follow_parameter('relearn_muscles', self._relearn)
        self.running = True
        self.listen(JointState, JOINT_TOPICS[value('joint_source')], self._joints, SENSOR)
        self.listen(Float64MultiArray, 'muscle_states', self._muscles, SENSOR)
        self.listen(Bool, 'anomaly_detected', self._anomaly, LATCHED)
        self.create_service(SetBool, 'learner/enable', self._enable)
        self.create_service(Trigger, 'learner/save', self._save)
        self.create_timer(POLL, self._poll, clock=STEADY)

    # -- parameters -----------------------------------------------------------------------------

    def _directory(self, value: str) -> Path | None:
        if value != AUTO:
            return Path(value) if value else None
        home = os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state'
        place = Path(home) / 'musculoskeletal_ae' / self.robot.description.directory.name
        return place.joinpath(*self.get_namespace().strip('/').split('/'))

    def _start_fresh(self, value: bool) -> None:
        if not value:
            return
        if not self.running:
            self.core.replace(None)
            return
        path = self.parameter('checkpoint')
        if not path:
            raise MusculoskeletalError('no `checkpoint` to start from; set that parameter first')
        self._take_checkpoint(path)

    def _take_checkpoint(self, path: str) -> None:
        if path and self.running:
            self.core.replace(checkpoint.load(path, self.robot))
        elif path and self.core.checkpoint is None:
            self.core.begin(checkpoint.load(path, self.robot))

    def _relearn(self, names: tuple[str, ...]) -> None:
        self.core.relearn(self.robot.muscle_indices(names))

    # -- messages -------------------------------------------------------------------------------

    def _now(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _joints(self, message: JointState) -> None:
        self.core.joints(self._now(), read_posture(message, self.robot.joints))

    def _muscles(self, message: Float64MultiArray) -> None:
        length, tension, _ = read_array(message, len(QUANTITIES), self.robot.muscle_count)
        self.core.muscles(self._now(), tension, length)

    def _anomaly(self, message: Bool) -> None:
        self.core.anomaly(message.data)

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.core.enable(request.data)
        response.success = True
        response.message = 'learning' if request.data else 'stopped; samples and network stay'
        return response

    def _save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.success, response.message = True, f'saved in {self.core.save()}'
        except MusculoskeletalError as error:
            response.success, response.message = False, str(error)
        return response

    def _poll(self) -> None:
        data = self.core.poll(self._now())
        if data is not None:
            self.publisher.publish(bytes_message(data))
        if bool(self.core.trouble) != self.troubled:  # is told at once, not with the next report
            self.troubled = not self.troubled
            self._report()

    def clock_jumped_back(self) -> None:
        """Forget what is not a sample yet."""
        self.core.reset()

    def report(self) -> Report:
        """Return what /diagnostics shows."""
        return self.core.report()

    def destroy_node(self) -> None:
        """End the training process with the node."""
        if hasattr(self, 'core'):
            self.core.close()
        super().destroy_node()
