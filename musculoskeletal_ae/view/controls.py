# SPDX-License-Identifier: Apache-2.0
"""The controls of the page: buttons and sliders in its panel, and handles in its scene.

Requests of visitors call `act` in viser's threads, with the name of the request and its value:

    targets {joint: rad} · hand xyz [m] · reset · push xyz [N] · rupture name · repair name
    payload kg · position s · end exploring · or the name of a service without a value
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import viser

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.view.body import Kind
from musculoskeletal_ae.view.scene import Scene

EXPLORE, END_EXPLORING = 'Explore', 'End exploring'
RESET, RESTORE = 'Reset after a stop', 'Restore isolated muscles'
RUPTURE, REPAIR = 'Rupture', 'Repair'
CALIBRATE = 'Find the length offsets'
#: phrases in remedies of stops, and the button for each; longer phrases first
BUTTONS = {
    'call estimator/reset; call controller/reset': RESET,
    'call estimator/reset': RESET,
    'call controller/reset': RESET,
    'call estimator/restore': RESTORE,
    'call estimator/zero': CALIBRATE,
    'call controller/explore to explore again': EXPLORE,
}
PUSH_STIFFNESS = 200.0  # force on the hand per distance by which the mouse drags it [N/m]
MOST_PUSH = 60.0  # largest force of a push with the mouse [N]
MOST_PAYLOAD = 5.0  # largest payload that a visitor can choose [kg]


def with_buttons(text: str) -> str:
    """Return a text in which buttons of the page replace the calls of their services."""
    for calls, button in BUTTONS.items():
        text = text.replace(calls, f'press "{button}"')
    return text


class Controls:
    """Lets visitors command the arm, the emulator and a replay.

    Attributes:
        sliders: Handle of each joint's slider.
    """

    def __init__(
        self, server: viser.ViserServer, robot: Robot, scene: Scene, act: Callable[..., None]
    ) -> None:
        """Build the controls; `act` is called with the requests of visitors."""
        self._gui, self._robot, self._scene, self._act = server.gui, robot, scene, act
        self._is_targeted = False  # whether the sliders show a visitor's target
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
                if what in ('targets', 'hand'):
                    self._is_targeted = True
                self._act(what, *[value(event)] if value else [])

        register(on_event)

    def _button(self, label: str, what: str, value: Any = None, color: Any = None) -> Any:
        made = self._gui.add_button(label, color=color)
        self._connect(made.on_click, what, value)
        return made

    def _slider(
        self, label: str, low: float, high: float, step: float, what: str, value: Any
    ) -> Any:
        made = self._gui.add_slider(label, low, high, step, min(max(0.0, low), high))
        self._connect(made.on_update, what, value)
        return made

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
            spans = np.minimum(robot.upper - robot.lower, 100.0)
            places = np.ceil(2.0 - np.log10(spans)).astype(int).tolist()
            steps = np.array([float(f'1e-{n}') for n in places])
            limits = np.ceil(robot.lower / steps) * steps, np.floor(robot.upper / steps) * steps
            self.sliders = [
                self._slider(joint, low, high, step, 'targets', lambda e, j=joint: {j: _chosen(e)})
                for joint, low, high, step in zip(robot.joints, *limits, steps)
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
            self._payload = self._slider('payload [kg]', 0.0, MOST_PAYLOAD, 0.1, 'payload', _chosen)
        return folder

    def _build_replay(self) -> Any:
        with self._gui.add_folder('Recording') as folder:
            self._timeline = self._slider('at [s]', 0.0, 1.0, 0.1, 'position', _chosen)
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
        self._restore.visible = bool((self._scene.kinds == Kind.ISOLATED).any())
        self._explore.visible, self._end_exploring.visible = not explores, explores
        self._is_targeted = self._is_targeted and not explores

    def draw(self, theta: Array) -> None:
        """Draw the handle of the hand at the posture θ [rad] (D,), unless a visitor drags it."""
        if not self._is_pushing:
            self._ball.position = self._robot.kinematics.end_effector_pose(theta).translation

    def follow(self, theta: Array | None, payload: float, played: Sequence[float] | None) -> None:
        """Update the controls.

        Args:
            theta: The estimated θ [rad] (D,), which the sliders show until a visitor sets a target.
            payload: Payload of the emulated arm [kg].
            played: Position and length of the replay [s]; None without a replay.
        """
        if theta is not None and not self._is_targeted:
            for angle, slider in zip(theta, self.sliders):
                near = round(np.clip(angle, slider.min, slider.max) / slider.step) * slider.step
                slider.value = float(np.clip(near, slider.min, slider.max))
            self._gizmo.position = self._robot.kinematics.end_effector_pose(theta).translation
        self._payload.value = round(min(max(payload, 0.0), MOST_PAYLOAD), 1)
        if played is not None:
            self._timeline.max = round(max(played[1], 0.1), 1)
            self._timeline.value = round(min(played), 1)

    def end_push(self) -> None:
        """End a push, because its visitor may have left; the next event of a drag resumes it."""
        if self._is_pushing:
            self._is_pushing = self._force.visible = False
            self._act('push', np.zeros(3))

    def _pick(self, muscle: str) -> None:
        self._muscle.value = muscle
        self._scene.pick(muscle)

    def push(self, event: Any) -> Array:
        """Draw the force of a drag, and return the force [N], (3,)."""
        ends = np.array([event.start_position, event.end_position])
        force = PUSH_STIFFNESS * (ends[1] - ends[0])
        self._is_pushing = self._force.visible = event.phase != 'end'
        self._force.points = ends[None].astype(np.float32)
        size = float(np.linalg.norm(force))
        return force * min(1.0, MOST_PUSH / max(size, 1e-9)) * self._is_pushing


def _chosen(event: Any) -> Any:
    return event.target.value
