# SPDX-License-Identifier: Apache-2.0
"""The node `learner`: learns the body online and hands the network to the other nodes.

joint_states or vision_joint_states, muscle_states, anomaly_detected → mae_checkpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning.collector import Collector
from musculoskeletal_ae.learning.session import Session
from musculoskeletal_ae.nodes.learner_settings import read_settings
from musculoskeletal_ae.nodes.messages import bytes_message
from musculoskeletal_ae.nodes.qos import LATCHED, SENSOR
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.pairing import Pairing
from musculoskeletal_ae.report import Level, Report
from musculoskeletal_ae.validity import QUANTITIES, read_array, read_posture

POLL = 0.05  # [s] between looks at the training process


class Learner(Shell):
    """Node shell of online learning."""

    def __init__(self, **options: Any) -> None:
        """Declare topics and start the training process; options are those of Node."""
        super().__init__('learner', **options)
        settings = read_settings(self)
        self.collector = Collector(self.robot, settings.rest, settings.novelty, settings.seed)
        self.pairing = Pairing(1.0 / self.rate)
        self.enabled, self.anomaly, self.running = True, False, False
        self.publisher = self.create_publisher(UInt8MultiArray, 'mae_checkpoint', LATCHED)
        self.session = Session(
            self.robot,
            self.collector,
            settings.preset,
            settings.seed,
            settings.steps,
            settings.directory,
            lambda data: self.publisher.publish(bytes_message(data)),
        )
        self.follow_parameter('fresh', self._start_fresh)
        self.follow_parameter('checkpoint', self._take_checkpoint)
        self.follow_parameter('relearn_muscles', self._relearn)
        self.running = True
        self.listen(JointState, settings.joint_topic, self._joints, SENSOR)
        self.listen(Float64MultiArray, 'muscle_states', self._muscles, SENSOR)
        self.listen(Bool, 'anomaly_detected', self._anomaly, LATCHED)
        self.create_service(SetBool, 'learner/enable', self._enable)
        self.create_service(Trigger, 'learner/save', self._save)
        self.create_timer(POLL, self._poll, clock=STEADY)

    # -- parameters -----------------------------------------------------------------------------

    def _start_fresh(self, value: bool) -> None:
        if not value:
            return
        if not self.running:
            self.session.set_aside()
            return
        path = self.parameter('checkpoint')
        if not path:
            raise MusculoskeletalError('no `checkpoint` to start from; set that parameter first')
        self._take_checkpoint(path)

    def _take_checkpoint(self, path: str) -> None:
        if path and self.running:
            self.session.replace(path)
        elif path and self.session.data is None:
            self.session.begin(path)

    def _relearn(self, names: Sequence[str]) -> None:
        for muscle in self.robot.muscle_indices(names):
            self.session.relearn(muscle)

    # -- messages -------------------------------------------------------------------------------

    def _now(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _joints(self, message: JointState) -> None:
        self.pairing.joints(self._now(), read_posture(message, self.robot.joints))

    def _muscles(self, message: Float64MultiArray) -> None:
        length, tension, _ = read_array(message, len(QUANTITIES), self.robot.muscle_count)
        paired = self.pairing.muscles(self._now(), tension, length)
        if paired is None or not self.enabled:
            return
        sample = self.collector.step(paired.tension, paired.length, paired.dt, paired.theta)
        if sample is not None:
            self.session.accept(sample)

    def _anomaly(self, message: Bool) -> None:
        self.anomaly = message.data
        self.collector.set_anomaly(message.data)

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data and not self.enabled:
            self._forget_the_moment()
        self.enabled = request.data
        response.success = True
        response.message = 'learning' if request.data else 'stopped; samples and network stay'
        return response

    def _save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message = f'saved in {self.session.save()}'
            response.success = True
        except (MusculoskeletalError, OSError) as error:
            response.success, response.message = False, str(error)
        return response

    def _poll(self) -> None:
        self.session.poll(self.enabled and not self.anomaly)

    def _forget_the_moment(self) -> None:
        self.collector.reset()
        self.pairing.reset()

    def clock_jumped_back(self) -> None:
        """Forget what is not a sample yet."""
        self._forget_the_moment()

    # -- diagnostics ----------------------------------------------------------------------------

    def report(self) -> Report:
        """Return what /diagnostics shows."""
        values = self.session.values()
        values |= {f'not learned: {why}': str(n) for why, n in self.collector.rejected.items()}
        level: Level = 'ok'
        message = 'learning'
        if self.session.trouble:
            level, message = 'error', self.session.trouble
        elif self.session.data is None:
            level, message = 'warn', 'waiting for a checkpoint: set the parameter `checkpoint`'
        elif not self.enabled:
            level, message = 'warn', 'stopped by learner/enable'
        elif self.anomaly:
            level, message = 'warn', 'stopped by an anomaly until estimator/reset'
        values['state'] = message
        return Report(level, message, values)

    def destroy_node(self) -> None:
        """End the training process with the node."""
        if hasattr(self, 'session'):
            self.session.close()
        super().destroy_node()
