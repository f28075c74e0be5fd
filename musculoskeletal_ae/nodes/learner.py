# SPDX-License-Identifier: Apache-2.0
"""The node `learner`: learns the body online and hands the network to the other nodes.

joint_states or vision_joint_states, muscle_states, anomaly_detected → mae_checkpoint.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

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
from musculoskeletal_ae.nodes.parameters import declare_preset, number, text, whole
from musculoskeletal_ae.nodes.qos import LATCHED, SENSOR
from musculoskeletal_ae.nodes.running import run
from musculoskeletal_ae.nodes.shell import ERROR, OK, STEADY, WARN, Shell
from musculoskeletal_ae.validity import QUANTITIES, read_array, read_posture

POLL = 0.05  # [s] between looks at the training process
JOINT_TOPICS = {'sensor': 'joint_states', 'marker': 'vision_joint_states'}
AUTO = 'auto'


class Learner(Shell):
    """Node shell of online learning."""

    def __init__(self) -> None:
        """Declare parameters and topics, and start the training process."""
        super().__init__('learner')
        joint_topic = self._declare_joint_topic()
        self.core = self._declare_core()
        self.publisher = self.create_publisher(UInt8MultiArray, 'mae_checkpoint', LATCHED)
        self.running = False
        self.settable(
            'fresh', False, text('true: drop the saved state for `checkpoint`'), self._start_fresh
        )
        self.settable(
            'checkpoint',
            '',
            text('MAE checkpoint to start from where no state is saved; set later: replaces it'),
            self._take_checkpoint,
        )
        self.settable(
            'relearn_muscles',
            [''],
            text('names of replaced or re-wired muscles, learned anew from now on'),
            self._relearn,
        )
        self.running = True
        self.listen(JointState, joint_topic, self._joints, SENSOR)
        self.listen(Float64MultiArray, 'muscle_states', self._muscles, SENSOR)
        self.listen(Bool, 'anomaly_detected', self._anomaly, LATCHED)
        self.create_service(SetBool, 'learner/enable', self._enable)
        self.create_service(Trigger, 'learner/save', self._save)
        self.create_timer(POLL, self._poll, clock=STEADY)

    # -- parameters -----------------------------------------------------------------------------

    def _declare_joint_topic(self) -> str:
        meaning = f'where θ comes from: {tuple(JOINT_TOPICS)}'
        source = self.declare_parameter('joint_source', 'sensor', text(meaning, True)).value
        if source not in JOINT_TOPICS:
            legal = ', '.join(JOINT_TOPICS)
            raise MusculoskeletalError(f'parameter joint_source: {source!r}; legal: {legal}')
        return JOINT_TOPICS[source]

    def _declare_core(self) -> learner.Learner:
        def positive(name: str, default: float, meaning: str, most: float) -> float:
            value = self.declare_parameter(name, default, number(meaning, 0.0, most, True)).value
            return float(value)

        rest, novelty = RestSettings(), Novelty()
        return learner.Learner(
            self.robot,
            preset=declare_preset(self, 'how to learn'),
            seed=self.declare_parameter('seed', 0, whole('random seed')).value,
            steps=self.declare_parameter(
                'update_steps',
                learner.STEPS,
                text('steps of training per update, preset default', True),
            ).value,
            period=1.0 / self.rate,
            rest=RestSettings(
                positive('rest_time', rest.window, 'how long the arm has to be still [s]', 10.0),
                positive('rest_joint_rate', rest.joint_rate, 'fastest joint at rest [rad/s]', 1.0),
                positive('rest_length_rate', rest.length_rate, 'fastest l at rest [m/s]', 1.0),
            ),
            novelty=Novelty(
                positive('new_joint_distance', novelty.joint, 'to stored samples [rad]', 3.0),
                positive('new_tension_distance', novelty.tension, 'to stored ones [N]', 500.0),
            ),
            training=TrainingProcess,
            directory=self._declare_directory(),
        )

    def _declare_directory(self) -> Path | None:
        meaning = "for samples and network; 'auto': below XDG_STATE_HOME; '': nothing kept"
        value = self.declare_parameter('state_directory', AUTO, text(meaning, True)).value
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
        path = self.get_parameter('checkpoint').value
        if not path:
            raise MusculoskeletalError('no `checkpoint` to start from; set that parameter first')
        self._take_checkpoint(path)

    def _take_checkpoint(self, path: str) -> None:
        if path and self.running:
            self.core.replace(checkpoint.load(path, self.robot))
        elif path and self.core.checkpoint is None:
            self.core.begin(checkpoint.load(path, self.robot))

    def _relearn(self, names: Sequence[str]) -> None:
        self.core.relearn(self.robot.muscle_indices(name for name in names if name))

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

    def clock_jumped_back(self) -> None:
        """Forget what is not a sample yet."""
        self.core.reset()

    # -- diagnostics ----------------------------------------------------------------------------

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return what /diagnostics shows."""
        level, message = OK, 'learning'
        if self.core.trouble:
            level, message = ERROR, self.core.trouble
        elif self.core.checkpoint is None:
            level, message = WARN, 'waiting for a checkpoint: set the parameter `checkpoint`'
        elif not self.core.enabled:
            level, message = WARN, 'stopped by learner/enable'
        elif self.core.stopped_by_anomaly:
            level, message = WARN, 'stopped by an anomaly until estimator/reset'
        return level, message, {**self.core.values(), 'state': message}

    def destroy_node(self) -> None:
        """End the training process with the node."""
        if hasattr(self, 'core'):
            self.core.close()
        super().destroy_node()


def main() -> None:
    """Run the node."""
    run(Learner)
