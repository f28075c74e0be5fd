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
from musculoskeletal_ae.learning.collector import Collector
from musculoskeletal_ae.learning.online import PRESETS, STEPS
from musculoskeletal_ae.learning.pairing import Pairing
from musculoskeletal_ae.learning.rest import RestSettings
from musculoskeletal_ae.learning.session import Session
from musculoskeletal_ae.learning.store import Novelty
from musculoskeletal_ae.nodes.messages import QUANTITIES, read_array, read_posture
from musculoskeletal_ae.nodes.shell import (
    ERROR,
    LATCHED,
    OK,
    SENSOR,
    STEADY,
    WARN,
    Shell,
    bytes_message,
    number,
    run,
    text,
)

SOURCES = {'sensor': 'joint_states', 'marker': 'vision_joint_states'}
POLL = 0.05  # [s] between looks at the training process
AUTO = 'auto'


class Learner(Shell):
    """Node shell of online learning."""

    def __init__(self) -> None:
        """Declare parameters and topics, and start the training process."""
        super().__init__('learner')
        self.declare_parameter('preset', 'default', text(f'how to learn: {PRESETS}', True))
        self.declare_parameter('seed', 0, text('of everything random', True))
        self.declare_parameter(
            'joint_source', 'sensor', text(f'where θ comes from: {tuple(SOURCES)}', True)
        )
        self.declare_parameter(
            'state_directory',
            AUTO,
            text("for samples and network; 'auto': below XDG_STATE_HOME; '': nothing kept", True),
        )
        self.declare_parameter(
            'update_steps', STEPS, text('steps of training per update, preset default', True)
        )
        self.collector = self._collector()
        self.pairing = Pairing(1.0 / self.rate)
        self.arrival = 0.0
        self.enabled, self.anomaly, self.running = True, False, False
        self.publisher = self.create_publisher(UInt8MultiArray, 'mae_checkpoint', LATCHED)
        value = self.get_parameter
        self.session = Session(
            self.robot,
            self.collector,
            value('preset').value,
            value('seed').value,
            value('update_steps').value,
            self._directory(value('state_directory').value),
            self._publish,
        )
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
        source = value('joint_source').value
        if source not in SOURCES:
            legal = ', '.join(SOURCES)
            raise MusculoskeletalError(f'parameter joint_source: {source!r}; legal: {legal}')
        self.listen(JointState, SOURCES[source], self._joints, SENSOR)
        self.listen(Float64MultiArray, 'muscle_states', self._muscles, SENSOR)
        self.listen(Bool, 'anomaly_detected', self._anomaly, LATCHED)
        self.create_service(SetBool, 'learner/enable', self._enable)
        self.create_service(Trigger, 'learner/save', self._save)
        self.create_timer(POLL, self._poll, clock=STEADY)

    # -- parameters -----------------------------------------------------------------------------

    def _collector(self) -> Collector:
        def positive(name: str, default: float, meaning: str, most: float) -> float:
            self.declare_parameter(name, default, number(meaning, 0.0, most, True))
            return float(self.get_parameter(name).value)

        rest, novelty = RestSettings(), Novelty()
        return Collector(
            self.robot,
            RestSettings(
                positive('rest_time', rest.window, 'how long the arm has to be still [s]', 10.0),
                positive('rest_joint_rate', rest.joint_rate, 'fastest joint at rest [rad/s]', 1.0),
                positive('rest_length_rate', rest.length_rate, 'fastest l at rest [m/s]', 1.0),
            ),
            Novelty(
                positive('new_joint_distance', novelty.joint, 'to stored samples [rad]', 3.0),
                positive('new_tension_distance', novelty.tension, 'to stored ones [N]', 500.0),
            ),
            self.get_parameter('seed').value,
        )

    def _directory(self, value: str) -> Path | None:
        if value != AUTO:
            return Path(value) if value else None
        home = os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state'
        name = self.robot.description.directory.name
        place = Path(home) / 'musculoskeletal_ae' / name
        return place.joinpath(*self.get_namespace().strip('/').split('/'))

    def _start_fresh(self, value: bool) -> str | None:
        if not value:
            return None
        if not self.running:
            self.session.set_aside()
            return None
        path = self.get_parameter('checkpoint').value
        if not path:
            return 'there is no `checkpoint` to start from; set that parameter first'
        return self._take_checkpoint(path)

    def _take_checkpoint(self, path: str) -> str | None:
        if not path:
            return None
        try:
            if self.running:
                self.session.replace(path)
            elif self.session.data is None:
                self.session.begin(path)
        except (MusculoskeletalError, OSError) as error:
            return str(error)
        return None

    def _relearn(self, names: Sequence[str]) -> str | None:
        muscles = [name for name in names if name]
        for name in muscles:
            if name not in self.robot.muscles:
                return f'unknown muscle {name!r}; legal: {", ".join(self.robot.muscles)}'
        try:
            for name in muscles:
                self.session.relearn(self.robot.muscles.index(name))
        except (MusculoskeletalError, OSError) as error:
            return str(error)
        return None

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

    def _publish(self, data: bytes) -> None:
        self.publisher.publish(bytes_message(data))

    def _forget_the_moment(self) -> None:
        self.collector.reset()
        self.pairing.reset()

    def clock_jumped_back(self) -> None:
        """Forget what is not a sample yet."""
        self._forget_the_moment()

    # -- diagnostics ----------------------------------------------------------------------------

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return what /diagnostics shows."""
        values = self.session.values()
        values |= {f'not learned: {why}': str(n) for why, n in self.collector.rejected.items()}
        level, message = OK, 'learning'
        if self.session.trouble:
            level, message = ERROR, self.session.trouble
        elif self.session.data is None:
            level, message = WARN, 'waiting for a checkpoint: set the parameter `checkpoint`'
        elif not self.enabled:
            level, message = WARN, 'stopped by learner/enable'
        elif self.anomaly:
            level, message = WARN, 'stopped by an anomaly until estimator/reset'
        values['state'] = message
        return level, message, values

    def destroy_node(self) -> None:
        """End the training process with the node."""
        if hasattr(self, 'session'):
            self.session.close()
        super().destroy_node()


def main() -> None:
    """Run the node."""
    run(Learner)
