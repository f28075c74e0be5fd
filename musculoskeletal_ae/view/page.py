# SPDX-License-Identifier: Apache-2.0
"""The web page: three arms, curves, bars and controls, served by viser.

Requests of visitors call `act` in viser's threads, with the name of the request and its value:

    targets {joint: rad} · hand xyz [m] · reset · push xyz [N] · rupture name · repair name
    payload kg · position s · end exploring · or the name of a service without a value
"""

import contextlib
import io
import logging
import math
import socket
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.report import whole
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.view import body
from musculoskeletal_ae.view.body import MARKS, Kind
from musculoskeletal_ae.view.readings import ARMS, HTML, LEFT_PANEL, History, Readings
from musculoskeletal_ae.view.visits import checked_visits

NARROW = 900  # width below which two panels would hide the arm [pixels]
CAMERA_FOV = 0.8  # vertical field of view [rad]
FILLED = 0.95  # share of the visible width and height that the arm may fill
VIEW_DIRECTION = np.array([1.25, 1.15, 0.35]) / np.linalg.norm([1.25, 1.15, 0.35])
RIGHT_PANEL = 330  # width of the right panel [pixels]
#: width and height for which the initial camera is placed [pixels]
WINDOW = 1280, 800
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
PUSH_STIFFNESS = 200.0  # force per distance that the mouse drags [N/m]
MOST_PUSH = 60.0  # [N]
MOST_PAYLOAD = 5.0  # [kg]
HOT = 80.0  # temperature at the right end of a bar [°C]


class Page:
    """One page, for any number of visitors."""

    def __init__(
        self, robot: Robot, host: str, port: int, read_only: bool, act: Callable[..., None]
    ) -> None:
        """Serve the page.

        Args:
            robot: The robot to show.
            host: Address to listen on.
            port: Port to listen on.
            read_only: Whether to leave the controls out.
            act: Called with the requests of visitors.

        Raises:
            MusculoskeletalError: If the port cannot be used.
        """
        self._robot, self._act = robot, act
        self._visitors: set[int] = set()
        self.looked_at = threading.Event()
        # Browsers open connections that they never use; do not log a traceback for each.
        logging.getLogger('websockets.server').setLevel(logging.CRITICAL)
        try:  # viser would wait for ever, or use another port
            family = socket.getaddrinfo(host, port)[0][0]
            socket.create_server((host, port), family=family).close()
        except (OSError, UnicodeError) as error:
            reason = getattr(error, 'strerror', error)
            raise MusculoskeletalError(
                f'no page at port {port} of {host}: {reason}; choose another --port or --host'
            ) from error
        # Discard what viser prints.
        with (
            contextlib.redirect_stdout(io.StringIO()),
            checked_visits(host, f'{robot.description.directory.name} – musculoskeletal_ae'),
        ):
            server = self._server = viser.ViserServer(host, port, verbose=False)
        if server.get_port() != port:  # another process took it first
            server.stop()
            raise MusculoskeletalError(f'port {port} of {host} is in use; choose another --port')
        # Visitors must not open a tunnel to the internet.
        server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
        self._history = History()
        self._readings: dict[int, Readings] = {}  # by visitor
        self._kinds: Ints = np.zeros(robot.muscle_count, dtype=int)
        self._posture: dict[str, Array] = {}
        self._picked, self._targeted, self._pushing = '', False, False
        self._build_scene()
        self._build_panels()
        self._controls: dict[str, Any] = {}  # by node; shown while it runs
        if not read_only:
            self._build_controls()
        self.offer(())
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def _on_connect(self, client: viser.ClientHandle) -> None:
        camera = client.camera
        is_narrow = camera.image_width < NARROW
        window = camera.image_width, camera.image_height
        look_at, position = self._viewpoint(*window, is_narrow)
        # In this order, because the position moves the target along.
        camera.position, camera.look_at = position, look_at
        self._readings[client.client_id] = Readings(client.gui, self._robot, is_narrow)
        self._count(client.client_id, True)

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        self._readings.pop(client.client_id, None)
        self._count(client.client_id, False)

    def _count(self, visitor: int, here: bool) -> None:
        (self._visitors.add if here else self._visitors.discard)(visitor)
        if not here and self._pushing:  # whoever left; a continuing drag pushes again
            self._pushing = self._force.visible = False
            self._act('push', np.zeros(3))
        (self.looked_at.set if self._visitors else self.looked_at.clear)()

    def close(self) -> None:
        """Stop serving the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    # -- display --------------------------------------------------------------------------------

    def _build_scene(self) -> None:
        robot, scene, kin = self._robot, self._server.scene, self._robot.kinematics
        solids, self.notes = body.link_solids(robot)
        middle = 0.5 * (robot.lower + robot.upper)
        self._space = body.space(robot, solids)
        size = self._space.max(axis=0) - self._space.min(axis=0)
        reach = 0.5 * float(np.linalg.norm(size))
        self._arms: dict[str, list[Any]] = {}  # root frame, then joint frames
        for arm, colour in ARMS.items():
            frames = self._arms[arm] = [scene.add_frame(f'/{arm}', show_axes=False, visible=False)]
            for i, parent in enumerate(kin.tree.parent[1:], 1):
                name = f'{frames[parent].name}/{kin.model.names[i]}'
                at = kin.tree.placement_translation[i]
                frames.append(scene.add_frame(name, show_axes=False, position=at))
            opacity = None if arm == 'measured' else 0.4
            for number, (joint, mesh) in enumerate(solids):
                name = f'{frames[joint].name}/solid_{number}'
                look: dict[str, Any] = {'color': colour, 'opacity': opacity, 'cast_shadow': False}
                scene.add_mesh_simple(name, mesh.vertices, mesh.faces, **look)
        tube = trimesh.creation.cylinder(1.0, 1.0, sections=12)
        tube.update_faces(
            np.abs(tube.face_normals[:, 2]) < 0.5
        )  # without end caps there are no seams
        tubes: Any = body.muscle_tubes(robot, middle, np.zeros(robot.muscle_count), self._kinds)
        look = {'lod': 'off', 'side': 'double', 'cast_shadow': False, 'visible': False}
        self._tubes: Any = scene.add_batched_meshes_simple(
            '/muscles', tube.vertices, tube.faces, **tubes, **look
        )
        self._labels = [
            scene.add_label(f'/names/{name}', name, visible=False, anchor='center-left')
            for name in robot.muscles
        ]
        self._owner = body.pieces(robot).repeat(body.DASHES)
        own = [np.flatnonzero(self._owner == m) for m in range(robot.muscle_count)]
        self._middles = [each[len(each) // 2] for each in own]
        look_at, position = self._viewpoint(*WINDOW, False)
        floor, width = (*look_at[:2], self._space[:, 2].min() - 0.1 * reach), 8.0 * reach
        scene.add_grid('/floor', width, width, position=floor, cell_size=body.grid_cell(reach))
        # Lights that do not tint colours.
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_ambient('/light', intensity=1.5)
        scene.add_light_directional('/lamp', intensity=1.0, position=(2.0, -1.0, 3.0))
        camera = self._server.initial_camera
        camera.look_at, camera.position, camera.fov = look_at, position, CAMERA_FOV
        distance = float(np.linalg.norm(position - look_at))
        camera.near, camera.far = 0.01 * distance, 100.0 * distance
        self._reach = reach

    def _viewpoint(self, width: int, height: int, is_narrow: bool) -> tuple[Array, Array]:
        """Return the target and the position [m] of a camera that sees the whole arm.

        Args:
            width: Width of the visitor's window [pixels].
            height: Its height [pixels].
            is_narrow: Whether there is no panel on the left.
        """
        free = width - RIGHT_PANEL - (0 if is_narrow else LEFT_PANEL)
        up = math.tan(0.5 * CAMERA_FOV)
        side = up * max(free, 1) / max(height, 1)
        return body.viewpoint(self._space, VIEW_DIRECTION, (FILLED * side, FILLED * up))

    def _build_panels(self) -> None:
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        gui.set_panel_label('musculoskeletal_ae')
        gui.main_panel.dock_right()
        gui.main_panel.set_width(RIGHT_PANEL)
        with gui.add_folder('Show', order=50.0):
            self._names = gui.add_checkbox('muscle names', False)
            self._names.on_update(lambda _: self._mark())
            self._wanted = {arm: gui.add_checkbox(f'{arm} arm', True) for arm in ARMS}

    def draw(self, posture: dict[str, Array], tension: Array | None, kinds: Ints) -> None:
        """Draw the arms at their θ [rad] (D,) if known, and muscles at T [N] (M,)."""
        kin, self._posture = self._robot.kinematics, posture
        with self._server.atomic():
            for arm, (root, *joints) in self._arms.items():
                root.visible = arm in posture and self._wanted[arm].value
                if not root.visible:
                    continue
                poses = kin.tree.in_parents(posture[arm][None])[0]
                turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
                for i, joint in enumerate(joints, 1):
                    joint.wxyz = turns[i]
                    if kin.tree.prismatic[i]:
                        joint.position = poses[i, :3, 3]
            theta = posture.get('measured', posture.get('estimated'))
            self._tubes.visible = theta is not None and tension is not None
            if theta is None or tension is None:
                return
            tubes = body.muscle_tubes(self._robot, theta, tension, kinds)
            for name, value in tubes.items():
                setattr(self._tubes, name, value)
            if (kinds != self._kinds).any():
                self._kinds = kinds.copy()
                self._mark()
            for m, label in enumerate(self._labels):
                if label.visible:
                    label.position = tubes['batched_positions'][self._middles[m]]
        if self._controls and not self._pushing:
            self._ball.position = kin.end_effector_pose(theta).translation

    def _mark(self) -> None:
        """Label muscles: all if requested, else those that are picked or faulty."""
        for name, kind, label in zip(self._robot.muscles, self._kinds.tolist(), self._labels):
            label.visible = self._names.value or kind > Kind.SOUND or name == self._picked
            label.text = MARKS[kind] + name + (f' {Kind(kind).name.lower()}' if kind else '')

    def tell(
        self,
        lines: list[str],
        alarm: str,
        states: Array,
        now: float,
        values: Sequence[float],
        is_urgent: bool = True,
    ) -> None:
        """Show texts, bars and curves.

        Args:
            lines: Lines of status text.
            alarm: Text of the alarm box; '': no box.
            states: T [N] and temperatures [°C], (2, M), for the bars; NaN where unknown.
            now: Time of `values` [s].
            values: Error [rad], A, d and its limit, for the curves; NaN where unknown.
            is_urgent: Whether the alarm box is red.
        """
        self._history.add(now, values)
        status, bars = (
            str(HTML.status(alarm, lines, is_urgent)),
            str(HTML.bars(self._muscles(*states))),
        )
        for readings in list(self._readings.values()):
            readings.show(status, bars, self._history)

    def _muscles(self, tension: Array, temperature: Array) -> list[dict[str, Any]]:
        """Return the template variables of each muscle's bar."""
        columns = {
            'rgb': map(
                tuple, body.colours(self._robot, np.nan_to_num(tension), self._kinds).tolist()
            ),
            'share': 100.0 * np.clip(np.nan_to_num(tension) / self._robot.tension.limit, 0.0, 1.0),
            'heat': 100.0 * np.clip(np.nan_to_num(temperature) / HOT, 0.0, 1.0),
            'name': self._robot.muscles,
            'mark': [MARKS[kind] for kind in self._kinds],
            'kind': [Kind(kind).name.lower() for kind in self._kinds],
            'pull': [whole(each, 'N') for each in tension],
            'warm': [whole(each, '°C') for each in temperature],
        }
        return [dict(zip(columns, row)) for row in zip(*columns.values())]

    def with_buttons(self, text: str) -> str:
        """Return a text in which buttons of the page replace the calls of their services."""
        for calls, button in BUTTONS.items() if self._controls else ():
            text = text.replace(calls, f'press "{button}"')
        return text

    def notify(self, text: str, good: bool) -> None:
        """Notify all visitors of the outcome of a request."""
        title, color = ('done', 'teal') if good else ('refused', 'red')
        for client in self._server.get_clients().values():
            client.add_notification(title, text, color=color, auto_close_seconds=6)

    # -- controls -------------------------------------------------------------------------------

    def _build_controls(self) -> None:
        gui, robot, scene = self._server.gui, self._robot, self._server.scene

        def connect(register: Any, what: str, value: Any = None) -> None:
            def on_event(event: Any) -> None:
                if event.client is not None:  # None: `follow` has set the control
                    if what in ('targets', 'hand'):
                        self._targeted = True
                    self._act(what, *[value(event)] if value else [])

            register(on_event)

        def button(label: str, what: str, value: Any = None, color: Any = None) -> Any:
            made = gui.add_button(label, color=color)
            connect(made.on_click, what, value)
            return made

        def slider(label: str, low: float, high: float, step: float, what: str, value: Any) -> Any:
            made = gui.add_slider(label, low, high, step, min(max(0.0, low), high))
            connect(made.on_update, what, value)
            return made

        def chosen(event: Any) -> Any:
            return event.target.value

        with gui.add_folder('Arm') as arm:
            button('Stop', 'controller/stop', color='red')
            self._explore = button(EXPLORE, 'controller/explore')
            self._end_exploring = button(END_EXPLORING, 'end exploring')
            button(RESET, 'reset', color='gray')
            button(CALIBRATE, 'estimator/zero', color='gray')
            self._restore = button(RESTORE, 'estimator/restore')
            gizmo = gui.add_checkbox(
                'drag the hand', False, hint='shows arrows at the hand that you can drag'
            )
            gizmo.on_update(lambda event: setattr(self._gizmo, 'visible', chosen(event)))
            # Steps of at most a hundredth of the range keep the ends near the limits.
            spans = np.minimum(robot.upper - robot.lower, 100.0)
            places = np.ceil(2.0 - np.log10(spans)).astype(int).tolist()
            steps = np.array([float(f'1e-{n}') for n in places])
            limits = np.ceil(robot.lower / steps) * steps, np.floor(robot.upper / steps) * steps
            self._sliders = [
                slider(joint, low, high, step, 'targets', lambda e, j=joint: {j: chosen(e)})
                for joint, low, high, step in zip(robot.joints, *limits, steps)
            ]
        with gui.add_folder('Faults of the emulated arm') as faults:
            self._muscle = gui.add_dropdown(
                'muscle', robot.muscles, hint='choose a muscle here, or click on it'
            )
            self._muscle.on_update(lambda event: self._pick(chosen(event)))
            button(RUPTURE, 'rupture', lambda _: self._muscle.value, 'orange')
            button(REPAIR, 'repair', lambda _: self._muscle.value, 'gray')
            self._payload = slider('payload [kg]', 0.0, MOST_PAYLOAD, 0.1, 'payload', chosen)
        with gui.add_folder('Recording') as recording:
            self._timeline = slider('at [s]', 0.0, 1.0, 0.1, 'position', chosen)
            button('Pause', 'replay/pause')
            button('Play', 'replay/resume')
        look: dict[str, Any] = {'disable_rotations': True, 'depth_test': False, 'visible': False}
        self._gizmo: Any = scene.add_transform_controls('/target', 0.35 * self._reach, **look)
        connect(self._gizmo.on_update, 'hand', lambda event: np.array(event.target.position))
        self._ball = scene.add_icosphere('/push', 0.03, (255, 200, 0), opacity=0.55, visible=False)
        connect(self._ball.on_drag('left'), 'push', self._push)
        look = {'shaft_radius': 0.006, 'head_radius': 0.014, 'head_length': 0.04, 'visible': False}
        self._force = scene.add_arrows('/force', np.zeros((1, 2, 3)), (200, 0, 0), **look)
        self._tubes.on_click(
            lambda event: self._pick(robot.muscles[self._owner[event.instance_index]])
        )
        self._controls = {'controller': arm, 'hardware_emulator': faults, 'replay': recording}
        self._controls['pushed'] = self._ball

    def offer(self, nodes: Iterable[str], explores: bool = False) -> None:
        """Show the controls of the running nodes only.

        Args:
            nodes: Names of the running nodes.
            explores: Whether the controller explores.
        """
        for node, handle in self._controls.items():
            handle.visible = node in nodes
        if self._controls and 'controller' not in nodes:
            self._gizmo.visible = False
        if self._controls:
            self._restore.visible = bool((self._kinds == Kind.ISOLATED).any())
            self._explore.visible, self._end_exploring.visible = not explores, explores
            self._targeted = self._targeted and not explores

    def follow(self, payload: float, played: Sequence[float] | None) -> None:
        """Update the controls; sliders show the estimate until a visitor sets a target."""
        if not self._controls:
            return
        theta = self._posture.get('estimated')
        if theta is not None and not self._targeted:
            for angle, slider in zip(theta, self._sliders):
                near = round(np.clip(angle, slider.min, slider.max) / slider.step) * slider.step
                slider.value = float(np.clip(near, slider.min, slider.max))
            self._gizmo.position = self._robot.kinematics.end_effector_pose(theta).translation
        self._payload.value = round(min(max(payload, 0.0), MOST_PAYLOAD), 1)
        if played is not None:
            self._timeline.max = round(max(played[1], 0.1), 1)
            self._timeline.value = round(min(played), 1)

    def _pick(self, muscle: str) -> None:
        self._picked = self._muscle.value = muscle
        self._mark()

    def _push(self, event: Any) -> Array:
        """Draw and return the force of a drag [N] (3,)."""
        ends = np.array([event.start_position, event.end_position])
        force = PUSH_STIFFNESS * (ends[1] - ends[0])
        self._pushing = self._force.visible = event.phase != 'end'
        self._force.points = ends[None].astype(np.float32)
        size = float(np.linalg.norm(force))
        return force * min(1.0, MOST_PUSH / max(size, 1e-9)) * self._pushing
