# SPDX-License-Identifier: Apache-2.0
"""The controls of the page: buttons and sliders in its panel, and handles in its scene.

Requests of visitors call `act` in viser's threads, with the name of the request and its value:

    targets          target positions by joint [rad or m]
    hand             target position of the hand [m]
    push             force on the hand [N]
    rupture, repair  name of the muscle
    payload          mass in the hand [kg]
    position         position in the replay [s]
    refused          text for the visitor
    reset            no value
    end exploring    no value

Any other name is that of a service, which is called without a value. `ros_tools/view.py` carries
the requests out.
"""

from collections.abc import Callable, Iterable, Sequence
from time import monotonic
from typing import Any

import numpy as np
import viser

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.view.body import DrawnState
from musculoskeletal_ae.view.entries import Entries, Key
from musculoskeletal_ae.view.scene import Scene

EXPLORE, END_EXPLORING = 'Explore', 'End exploring'
RESET, RESTORE = 'Reset after a stop', 'Restore isolated muscles'
RUPTURE, REPAIR = 'Rupture', 'Repair'
CALIBRATE = 'Find the length offsets'
PAYLOAD, POSITION = 'payload [kg]', 'at [s]'  # labels of sliders
#: phrases in remedies and in answers of services, and the button for each; longer phrases first
BUTTONS = {
    'call estimator/reset; call controller/reset': RESET,
    'call estimator/reset': RESET,
    'call controller/reset': RESET,
    'call estimator/restore': RESTORE,
    'call estimator/zero': CALIBRATE,
    'call controller/explore true to explore again': EXPLORE,
    'call controller/explore true': EXPLORE,
    'call controller/explore': EXPLORE,
}
#: exert this force on the hand per distance by which the mouse drags it [N/m]
PUSH_STIFFNESS = 200.0
MOST_PUSH = 60.0  # limit the force of a push with the mouse to this [N]
MOST_PAYLOAD = 5.0  # let visitors choose payloads of up to this mass [kg]
#: requests after which values that are still being entered are not sent
COMMANDS = (
    'controller/stop', 'controller/explore', 'end exploring', 'reset', 'hand', 'estimator/zero',
    'estimator/restore',
)  # fmt: skip
#: The sliders follow the arm only when it rests. Otherwise, they would replace a number while
#: somebody types it. An arm rests if no joint has moved by more than REST_SHARE of its range for
#: REST_TIME [s]. The noise of an estimate is smaller than that.
REST_SHARE, REST_TIME = 0.02, 1.0


def with_buttons(text: str) -> str:
    """Return a text in which buttons of the page replace the services that users should call."""
    for calls, button in BUTTONS.items():
        text = text.replace(calls, f'press "{button}"')
    return text


class Controls:
    """Lets visitors command the arm, the emulator and a replay.

    Attributes:
        sliders: Handle of each joint's slider.
        payload: Handle of the payload's slider.
    """

    def __init__(
        self, server: viser.ViserServer, robot: Robot, scene: Scene, act: Callable[..., None]
    ) -> None:
        """Build the controls; `act` is called with the requests of visitors."""
        self._gui, self._robot, self._scene, self._act = server.gui, robot, scene, act
        self._is_targeted = False  # whether the sliders show a visitor's target
        self._entries = Entries()  # values that visitors are entering at sliders
        self._sliders: dict[Key, Any] = {}  # handles of all sliders
        self._settled: dict[Key, float] = {}  # last value that the arm had, or that was sent
        self._entered: dict[Key, float] = {}  # last value that the arm had, or that was entered
        #: posture [rad] (D,) near which the estimate has stayed, and since when [s]
        self._rest = np.full(robot.joint_count, np.nan), 0.0
        self._is_pushing = False
        #: controls of each node, which are shown while the node runs
        self._of_node: dict[str, Any] = {
            'controller': self._build_arm(),
            'hardware_emulator': self._build_faults(),
            'replay': self._build_replay(),
        }
        self._build_handles(server.scene)
        self._of_node['pushed'] = self._ball
        scene.tubes.on_click(lambda event: self._pick(scene.muscle_of(event.instance_index)))

    def _connect(self, register: Any, what: str, value: Any = None) -> None:
        def on_event(event: Any) -> None:
            if event.client is not None:  # without a client, `follow` has set the control
                self.request(what, *[value(event)] if value else [])

        register(on_event)

    def request(self, what: str, *value: Any) -> None:
        """Call `act` with a request that does not come from a slider.

        A command to the arm discards the values that a visitor has not finished entering.
        """
        if what in COMMANDS:
            self._entries.discard()
        if what == 'hand':
            self._is_targeted = True
        self._act(what, *value)

    def _button(self, label: str, what: str, value: Any = None, color: Any = None) -> Any:
        made = self._gui.add_button(label, color=color)
        self._connect(made.on_click, what, value)
        return made

    def _slider(self, label: str, low: float, high: float, step: float, what: str) -> Any:
        made = self._gui.add_slider(label, low, high, step, min(max(0.0, low), high))
        key = what, label
        self._sliders[key], self._settled[key], self._entered[key] = made, made.value, made.value

        async def on_update(event: Any) -> None:  # viser calls coroutines in order
            if event.client is None:  # `follow` or `send_entries` has set the slider
                return
            self._is_targeted = self._is_targeted or what == 'targets'
            value, before = float(made.value), self._entered[key]
            # When a visitor leaves the box, the browser replaces a number beyond a limit by the
            # limit. Keep the number, so that it is refused: the arm must not go to the limit.
            if value == min(max(before, made.min), made.max):
                value = before
            self._entered[key] = value
            self._entries.change(key, value, monotonic())

        made.on_update(on_update)
        return made

    def _set(self, key: Key, value: float) -> None:
        self._settled[key] = self._entered[key] = self._sliders[key].value = value

    def _build_arm(self) -> Any:
        robot, button = self._robot, self._button
        with self._gui.add_folder('Arm') as folder:
            button('Stop', 'controller/stop', color='red')
            self._explore = button(EXPLORE, 'controller/explore')
            self._end_exploring = button(END_EXPLORING, 'end exploring')
            button(RESET, 'reset', color='gray')
            button(CALIBRATE, 'estimator/zero', color='gray')
            self._restore = button(RESTORE, 'estimator/restore')
            gizmo = self._gui.add_checkbox(
                'drag the hand', False, hint='shows arrows at the hand that you can drag'
            )
            gizmo.on_update(lambda event: setattr(self._gizmo, 'visible', _chosen(event)))
            # A slider can end only at multiples of its step. Steps of at most a hundredth of the
            # range let it cover almost the whole range.
            low, high = map(robot.units.to_position, (robot.lower, robot.upper))
            spans = np.minimum(high - low, 100.0)
            places = np.ceil(2.0 - np.log10(spans)).astype(int).tolist()
            steps = np.array([float(f'1e-{n}') for n in places])
            limits = np.ceil(low / steps) * steps, np.floor(high / steps) * steps
            self.sliders = [
                self._slider(*each, 'targets') for each in zip(robot.joints, *limits, steps)
            ]
        return folder

    def _build_faults(self) -> Any:
        button = self._button
        with self._gui.add_folder('Faults of the emulated arm') as folder:
            muscles = self._robot.muscles
            self._muscle = self._gui.add_dropdown(
                'muscle', muscles, hint='choose a muscle here, or click on it'
            )
            self._muscle.on_update(lambda event: self._pick(_chosen(event)))
            button(RUPTURE, 'rupture', lambda _: self._muscle.value, 'orange')
            button(REPAIR, 'repair', lambda _: self._muscle.value, 'gray')
            self.payload = self._slider(PAYLOAD, 0.0, MOST_PAYLOAD, 0.1, 'payload')
        return folder

    def _build_replay(self) -> Any:
        with self._gui.add_folder('Recording') as folder:
            self._timeline = self._slider(POSITION, 0.0, 1.0, 0.1, 'position')
            self._button('Pause', 'replay/pause')
            self._button('Play', 'replay/resume')
        return folder

    def _build_handles(self, scene: Any) -> None:
        look: dict[str, Any] = {'disable_rotations': True, 'depth_test': False, 'visible': False}
        self._gizmo = scene.add_transform_controls('/target', 0.35 * self._scene.size, **look)
        self._connect(self._gizmo.on_update, 'hand', lambda e: np.array(e.target.position))
        self._ball = scene.add_icosphere('/push', 0.03, (255, 200, 0), opacity=0.55, visible=False)
        self._connect(self._ball.on_drag('left'), 'push', self.push)
        look = {'shaft_radius': 0.006, 'head_radius': 0.014, 'head_length': 0.04, 'visible': False}
        self._force = scene.add_arrows('/force', np.zeros((1, 2, 3)), (200, 0, 0), **look)

    def offer(self, nodes: Iterable[str], explores: bool) -> None:
        """Show the controls of the running nodes only.

        Args:
            nodes: Names of the running nodes.
            explores: Whether the controller explores.
        """
        nodes = set(nodes)
        for node, handle in self._of_node.items():
            handle.visible = node in nodes
        if 'controller' not in nodes:
            self._gizmo.visible = False
        self._restore.visible = bool((self._scene.kinds == DrawnState.ISOLATED).any())
        self._explore.visible, self._end_exploring.visible = not explores, explores
        is_free = explores and not self._entries.are_recent('targets', monotonic())
        self._is_targeted = self._is_targeted and not is_free

    def draw(self, theta: Array) -> None:
        """Draw the handle of the hand at the posture θ [rad] (D,), unless a visitor drags it."""
        if not self._is_pushing:
            self._ball.position = self._robot.kinematics.end_effector_pose(theta).translation

    def send_entries(self) -> None:
        """Send the requests for the values that visitors have finished entering at sliders."""
        for key, value in self._entries.take(monotonic()).items():
            (what, label), slider = key, self._sliders[key]
            if slider.min <= value <= slider.max:
                self._settled[key] = value
                self._act(what, {label: value} if what == 'targets' else value)
            else:
                legal = f'{slider.min:g} to {slider.max:g}'
                self._act('refused', f'{label}: expected {legal}, got {value:g}')
                self._set(key, self._settled[key])

    def follow(self, theta: Array | None, payload: float, played: Sequence[float] | None) -> None:
        """Follow the arm, the emulator and the replay: update the controls to their state.

        Args:
            theta: The estimated θ [rad] (D,). The sliders show it when the arm rests, until a
                visitor changes one.
            payload: Payload of the emulated arm [kg].
            played: Position and length of the replay [s]; None without a replay.
        """
        now = monotonic()
        if theta is not None and not self._is_targeted:
            if self._is_at_rest(theta, now):
                self._show(self._rest[0])
            self._gizmo.position = self._robot.kinematics.end_effector_pose(theta).translation
        if not self._entries.are_recent('payload', now):
            self._set(('payload', PAYLOAD), round(min(max(payload, 0.0), MOST_PAYLOAD), 1))
        if played is not None and not self._entries.are_recent('position', now):
            self._timeline.max = round(max(played[1], 0.1), 1)
            self._set(('position', POSITION), round(min(played), 1))

    def _is_at_rest(self, theta: Array, now: float) -> bool:
        """Return whether the estimate θ [rad] (D,) has hardly changed for REST_TIME [s]."""
        span = self._robot.upper - self._robot.lower
        posture, since = self._rest
        if (np.abs(theta - posture) <= REST_SHARE * span).all():
            return now - since >= REST_TIME
        self._rest = theta.copy(), now
        return False

    def _show(self, theta: Array) -> None:
        """Show a posture θ [rad] (D,) on the sliders."""
        positions = self._robot.units.to_position(theta)
        for joint, position, slider in zip(self._robot.joints, positions, self.sliders):
            near = round(np.clip(position, slider.min, slider.max) / slider.step) * slider.step
            value = float(np.clip(near, slider.min, slider.max))
            if value != slider.value:
                self._set(('targets', joint), value)

    def end_visit(self) -> None:
        """Discard the values that are being entered, and end a push: a visitor may have left.

        If the visitor is still there, the next event of the drag resumes the push.
        """
        self._entries.discard()
        if self._is_pushing:
            self._is_pushing = self._force.visible = False
            self._act('push', np.zeros(3))

    def _pick(self, muscle: str) -> None:
        self._muscle.value = muscle
        self._scene.pick(muscle)

    def push(self, event: Any) -> Array:
        """Draw the force that a visitor exerts by dragging; return the force [N], (3,).

        `event` is viser's event of the drag. The force is proportional to the length of the drag,
        up to MOST_PUSH; it is 0 when the drag ends.
        """
        ends = np.array([event.start_position, event.end_position])
        force = PUSH_STIFFNESS * (ends[1] - ends[0])
        self._is_pushing = self._force.visible = event.phase != 'end'
        self._force.points = ends[None].astype(np.float32)
        size = float(np.linalg.norm(force))
        return force * min(1.0, MOST_PUSH / max(size, 1e-9)) * self._is_pushing


def _chosen(event: Any) -> Any:
    return event.target.value
