# SPDX-License-Identifier: Apache-2.0
"""The page itself: three arms, curves, bars and controls, served by viser.

What a visitor asks for goes to `act`, called in viser's threads with a name and its values:

    explore · stop · reset · targets {joint: rad} · hand xyz [m] · follow
    cut name · mend name · payload kg · push xyz [N] · pause · resume · seek s
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import io
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import trimesh
import viser

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.view.body import (
    DASHES,
    ENDS,
    MARKS,
    JointChain,
    Kind,
    colours,
    link_solids,
    muscle_tubes,
    tension_share,
)

ARMS = {'measured': (176, 180, 186), 'estimated': (0, 158, 115), 'simulated': (148, 103, 189)}
OPACITIES = {'measured': None, 'estimated': 0.4, 'simulated': 0.4}
HISTORY, SAMPLING = 60.0, 0.1  # [s] that curves show, and between two of their points
PUSH_STIFFNESS, MOST_PUSH = 200.0, 60.0  # [N/m] of the mouse's pull, [N]
MOST_PAYLOAD = 5.0  # [kg]
HOT = 80.0  # [°C] at the right end of a bar
ERROR, ANOMALY, DISTANCE, LIMIT = range(4)  # columns of the curves


SPOT = '<span style="color:rgb{}">●</span> {} &nbsp; '
GRADIENT = 'linear-gradient(90deg,rgb{},rgb{})'.format(*(tuple(map(int, c)) for c in ENDS))
LEGEND = (
    '<div style="font-size:11px;padding:6px 10px">'
    + ''.join(SPOT.format(colour, arm) for arm, colour in ARMS.items())
    + '<br>T_bias <span style="display:inline-block;width:90px;height:8px;border-radius:3px;'
    f'background:{GRADIENT}"></span> T_limit<br>✂ cut &nbsp; ? suspect &nbsp; ⊘ isolated</div>'
)


def _is_local(host: str) -> bool:
    try:
        return host == 'localhost' or ip_address(host).is_loopback
    except ValueError:
        return False


class Page:
    """One page for any number of visitors."""

    def __init__(
        self, robot: Robot, host: str, port: int, read_only: bool, act: Callable[..., None]
    ) -> None:
        """Serve the page on an address; without `read_only`, `act` hears what visitors ask for.

        Raises:
            MusculoskeletalError: If the port is in use.
        """
        self._robot, self._act, self._host = robot, act, host
        self._visitors: set[int] = set()
        self.looked_at = threading.Event()
        # A browser opens connections that it never uses; no traceback of each.
        logging.getLogger('websockets.server').setLevel(logging.CRITICAL)
        with contextlib.redirect_stdout(io.StringIO()):  # viser announces itself
            self._server = viser.ViserServer(host, port, verbose=False)
        if self._server.get_port() != port:
            self._server.stop()
            raise MusculoskeletalError(f'port {port} of {host} is in use; choose another --port')
        # A tunnel to the world is nothing that a visitor may ask for.
        self._server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
        sockets = self._server._websock_server
        sockets.on_client_connect(self._check_origin)
        for early in [*sockets._live_connections.values()]:  # a browser comes again by itself
            asyncio.run_coroutine_threadsafe(early.close(), self._server.get_event_loop())
        self._server.on_client_connect(lambda client: self._count(client.client_id, True))
        self._server.on_client_disconnect(lambda client: self._count(client.client_id, False))
        self._curves: deque[tuple[float, ...]] = deque(maxlen=int(HISTORY / SAMPLING))
        self._sampled = -HISTORY
        self._kinds: Ints = np.full(robot.muscle_count, -1)
        self._posture: dict[str, Array] = {}
        self._targeted = self._pushing = False
        self._build_scene()
        self._build_panels()
        self._controls: dict[str, list[Any]] = {}  # shown while a node is there
        if not read_only:
            self._build_controls()
        self.offer(())

    async def _check_origin(self, connection: Any) -> None:
        """Turn away pages of other sites, which a browser lets connect to localhost."""
        socket = self._server._websock_server._live_connections[connection.client_id]
        asked, origin = (socket.request.headers.get(key, '') for key in ('Host', 'Origin'))
        came = urlsplit(origin)
        if origin and (
            came.netloc != asked or (_is_local(self._host) and not _is_local(came.hostname or ''))
        ):
            await socket.close(1008, 'another site')
            raise ConnectionError(f'a page of {origin} was turned away')

    def _count(self, visitor: int, here: bool) -> None:
        (self._visitors.add if here else self._visitors.discard)(visitor)
        (self.looked_at.set if self._visitors else self.looked_at.clear)()

    def close(self) -> None:
        """End the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    # -- what is shown --------------------------------------------------------------------------

    def _build_scene(self) -> None:
        robot, scene = self._robot, self._server.scene
        kin = robot.kinematics
        solids, self.notes = link_solids(robot)
        middle = 0.5 * (robot.lower + robot.upper)
        points = robot.routes.points(middle[None])[0]
        points = np.vstack([points, kin.end_effector_pose(middle).translation])
        centre, reach = 0.5 * (points.min(axis=0) + points.max(axis=0)), float(np.ptp(points))
        self._chain, self._placed = JointChain(kin), set[str]()
        self._joints: dict[str, list[viser.FrameHandle]] = {}
        for arm, colour in ARMS.items():
            scene.add_frame(f'/{arm}', show_axes=False, visible=False)
            names = [f'/{arm}']
            self._joints[arm] = []
            for i in range(1, len(kin.parent)):
                names.append(f'{names[kin.parent[i]]}/{kin.model.names[i]}')
                self._joints[arm].append(scene.add_frame(names[i], show_axes=False))
            for number, (joint, mesh) in enumerate(solids):
                scene.add_mesh_simple(
                    f'{names[joint]}/solid_{number}',
                    mesh.vertices,
                    mesh.faces,
                    color=colour,
                    opacity=OPACITIES[arm],
                    cast_shadow=False,
                )
        self._arms = {arm: scene.get_handle_by_name(f'/{arm}') for arm in ARMS}
        tube = trimesh.creation.cylinder(1.0, 1.0, sections=12)
        tube.update_faces(np.abs(tube.face_normals[:, 2]) < 0.5)  # open ends leave no seams
        kinds = np.zeros(robot.muscle_count, dtype=int)
        tubes = muscle_tubes(robot, middle, np.zeros(robot.muscle_count), kinds)
        self._tubes = scene.add_batched_meshes_simple(
            '/muscles',
            tube.vertices,
            tube.faces,
            tubes.turns,
            tubes.positions,
            batched_scales=tubes.scales,
            batched_colors=tubes.colours.astype(np.uint8),
            lod='off',
            side='double',
            cast_shadow=False,
            visible=False,
        )
        self._labels = [
            scene.add_label(f'/names/{name}', name, visible=False, anchor='center-left')
            for name in robot.muscles
        ]
        low = points[:, 2].min() - 0.15 * reach
        scene.add_grid(
            '/floor', 4.0 * reach, 4.0 * reach, plane='xy', position=(*centre[:2], low),
            cell_size=0.1, section_size=0.5, cell_color=(225,) * 3, section_color=(200,) * 3,
        )  # fmt: skip
        # Lights that leave colours what they are.
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_ambient('/light', intensity=1.5)
        scene.add_light_directional('/lamp', intensity=1.0, position=(2.0, -1.0, 3.0))
        camera = self._server.initial_camera
        camera.look_at = centre
        camera.position = centre + reach * np.array([1.25, 1.15, 0.35])
        camera.fov = 0.8
        self._reach = reach

    def _build_panels(self) -> None:
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        gui.set_panel_label('musculoskeletal_ae')
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        panel = gui.add_panel()
        with panel.add_tab(self._robot.description.directory.name):
            self._status = gui.add_html('')
            self._plots = [
                self._plot('error [rad]', ['#009e73']),
                self._plot('A', ['#0072b2']),
                self._plot('d (dashed: what is an anomaly)', ['#c80082', '#0072b2']),
            ]
            self._bars = gui.add_html('')
            gui.add_html(LEGEND)
        panel.dock_left()
        panel.set_width(350)
        with gui.add_folder('Show'):
            self._names = gui.add_checkbox('names of muscles', False)
            self._names.on_update(lambda _: self._mark_all())
            for arm in ARMS:
                box = gui.add_checkbox(f'{arm} arm', True)
                box.on_update(lambda event, arm=arm: self._show(arm, event.target.value))
        self._wanted = dict.fromkeys(ARMS, True)

    def _plot(self, title: str, strokes: list[str]) -> viser.GuiUplotHandle:
        series: list[Any] = [{'label': 's'}]
        for i, stroke in enumerate(strokes):
            series.append(
                {'label': title, 'stroke': stroke, 'width': 2, 'dash': [6, 4] if i else []}
            )
        empty = np.zeros(2)
        return self._server.gui.add_uplot(
            (np.array([-HISTORY, 0.0]), *[empty] * len(strokes)),
            tuple(series),
            title=title,
            height=96,
            scales={'x': {'time': False, 'auto': False, 'range': (-HISTORY, 0.0)}},
            legend={'show': False},
            cursor={'show': False},
        )

    def _show(self, arm: str, wanted: bool) -> None:
        self._wanted[arm] = wanted

    def draw(self, posture: dict[str, Array], tension: Array | None, kinds: Ints) -> None:
        """Draw arms at θ [rad] (D,), those that are known, and muscles at T [N] (M,)."""
        kin = self._robot.kinematics
        self._posture = posture
        with self._server.atomic():
            for arm, handle in self._arms.items():
                visible = self._wanted[arm] and arm in posture
                if handle.visible != visible:
                    handle.visible = visible
                if not visible:
                    continue
                positions, turns = self._chain.poses(posture[arm])
                for i, joint in enumerate(self._joints[arm], 1):
                    joint.wxyz = turns[i]
                    if arm not in self._placed or kin.prismatic[i]:
                        joint.position = positions[i]
                self._placed.add(arm)
            body = posture.get('measured', posture.get('estimated'))
            self._tubes.visible = body is not None and tension is not None
            if body is None or tension is None:
                return
            tubes = muscle_tubes(self._robot, body, tension, kinds)
            self._tubes.batched_positions = tubes.positions
            self._tubes.batched_wxyzs = tubes.turns
            self._tubes.batched_scales = tubes.scales
            self._tubes.batched_colors = tubes.colours.astype(np.uint8)
            if (kinds != self._kinds).any():
                self._kinds = kinds.copy()
                self._mark_all()
            for label, middle in zip(self._labels, tubes.middles):
                if label.visible:
                    label.position = middle
        if not self._pushing and hasattr(self, '_ball'):
            self._ball.position = kin.end_effector_pose(body).translation

    def _mark_all(self) -> None:
        """Write names where they are asked for, and always of muscles that are not sound."""
        chosen = self._muscle.value if hasattr(self, '_muscle') and self._picked else None
        for name, kind, label in zip(self._robot.muscles, self._kinds.tolist(), self._labels):
            label.visible = self._names.value or kind > Kind.SOUND or name == chosen
            word = '' if kind <= Kind.SOUND else f' {Kind(kind).name.lower()}'
            label.text = f'{MARKS.get(Kind(max(kind, 0)), "")}{name}{word}'

    def sample(
        self, now: float, error: float, anomaly: float, distance: float, limit: float
    ) -> None:
        """Remember what the curves show at a time [s]; NaN where it is not known."""
        if now - self._sampled >= SAMPLING:
            self._sampled = now
            self._curves.append((now, error, anomaly, distance, limit))

    def tell(self, lines: list[str], alarm: str, tension: Array, temperature: Array) -> None:
        """Show what is going on, the curves, T [N] (M,) and temperatures [°C] (M,) as bars."""
        told = ''.join(f'<div>{html.escape(line)}</div>' for line in lines)
        if alarm:
            told = (
                '<div style="background:#b00020;color:#fff;font-weight:700;padding:6px 8px;'
                f'border-radius:6px;margin-bottom:4px" id="alarm">{html.escape(alarm)}</div>' + told
            )
        self._status.content = f'<div style="font-size:13px;padding:0 10px">{told}</div>'
        self._bars.content = self._bar_chart(tension, temperature)
        if len(self._curves) > 1:
            table = np.array(self._curves)
            # No curve that has a NaN in it is drawn: an unknown limit hides below d.
            table[:, 1 + LIMIT] = np.where(np.isnan(table[:, 1 + LIMIT]), *table[:, 3:].T)
            table = np.nan_to_num(table)
            x = table[:, 0] - table[-1, 0]
            for plot, columns in zip(self._plots, ([ERROR], [ANOMALY], [LIMIT, DISTANCE])):
                plot.data = (x, *(table[:, 1 + column] for column in columns))

    def _bar_chart(self, tension: Array, temperature: Array) -> str:
        robot = self._robot
        share = tension_share(robot, tension)
        rgb = colours(share, np.maximum(self._kinds, 0))
        cell = 'style="padding:1px 4px;{}"'
        track = 'position:relative;height:9px;background:#e8e8e8;border-radius:3px;min-width:{}px'
        rows = []
        for m, name in enumerate(robot.muscles):
            kind = Kind(max(int(self._kinds[m]), 0))
            colour = 'rgb({:.0f},{:.0f},{:.0f})'.format(*rgb[m])
            width = float(np.clip(100.0 * tension[m] / robot.tension.limit, 0.0, 100.0))
            known = np.isfinite(temperature[m])
            hot = float(np.clip(100.0 * temperature[m] / HOT, 0.0, 100.0)) if known else 0.0
            warmth = f'{temperature[m]:.0f} °C' if known else 'not measured'
            word = f', {kind.name.lower()}' if kind else ''
            title = f'{name}: {tension[m]:.0f} N, {warmth}{word}'
            weight = 'white-space:nowrap;' + 'font-weight:700;' * bool(kind)
            rows.append(
                f'<tr title="{html.escape(title)}"><td {cell.format(weight)}>'
                f'{MARKS[kind]}{html.escape(name)}</td>'
                f'<td {cell.format("width:42%")}><div style="{track.format(70)}"><div style="width:'
                f'{width:.0f}%;height:9px;border-radius:3px;background:{colour}"></div></div></td>'
                f'<td {cell.format("text-align:right;white-space:nowrap")}>{tension[m]:.0f} N</td>'
                f'<td {cell.format("width:16%")}><div style="{track.format(26)}"><div style="width:'
                f'{hot:.0f}%;height:9px;border-radius:3px;background:#8c6d1f"></div></div></td>'
                f'<td {cell.format("text-align:right;white-space:nowrap")}>'
                f'{warmth if known else "–"}</td></tr>'
            )
        return (
            '<table style="font-size:11px;line-height:1.15;width:100%;border-collapse:collapse;'
            f'padding:0 6px">{"".join(rows)}</table>'
        )

    def notify(self, text: str, good: bool) -> None:
        """Show every visitor what became of a request."""
        title = 'done' if good else 'refused'
        for client in self._server.get_clients().values():
            client.add_notification(
                title, text, color='teal' if good else 'red', auto_close_seconds=6
            )

    # -- what visitors ask for ------------------------------------------------------------------

    def _build_controls(self) -> None:
        gui, robot, act = self._server.gui, self._robot, self._act

        def button(label: str, what: str, *values: Any, color: Any = None) -> Any:
            made = gui.add_button(label, color=color)
            made.on_click(lambda _: act(what, *[v() if callable(v) else v for v in values]))
            return made

        with gui.add_folder('Arm') as arm:
            button('Stop', 'stop', color='red')
            follow = [button('Explore', 'explore'), button('Reset after a stop', 'reset')]
            for made in follow:
                made.on_click(lambda _: setattr(self, '_targeted', False))
            self._gizmo_shown = gui.add_checkbox('move the hand with the mouse', False)
            self._gizmo_shown.on_update(self._show_gizmo)
            self._sliders = {}
            for joint, low, high in zip(robot.joints, robot.lower, robot.upper):
                low, high = np.ceil(100.0 * low) / 100.0, np.floor(100.0 * high) / 100.0
                slider = gui.add_slider(joint, low, high, 0.01, min(max(0.0, low), high))
                slider.on_update(lambda event, joint=joint: self._slide(event, joint))
                self._sliders[joint] = slider
        with gui.add_folder('Faults of the emulated arm') as faults:
            self._muscle = gui.add_dropdown('muscle', robot.muscles, hint='or click on one')
            self._picked = False
            self._muscle.on_update(self._pick)
            button('Cut', 'cut', lambda: self._muscle.value, color='orange')
            button('Mend', 'mend', lambda: self._muscle.value)
            self._payload = gui.add_slider('payload [kg]', 0.0, MOST_PAYLOAD, 0.1, 0.0)
            self._payload.on_update(lambda e: e.client and act('payload', e.target.value))
        with gui.add_folder('Recording') as recording:
            self._timeline = gui.add_slider('at [s]', 0.0, 1.0, 0.1, 0.0)
            self._timeline.on_update(lambda e: e.client and act('seek', e.target.value))
            button('Pause', 'pause')
            button('Play', 'resume')
        self._gizmo = self._server.scene.add_transform_controls(
            '/target', 0.35 * self._reach, disable_rotations=True, depth_test=False, visible=False
        )
        self._gizmo.on_update(self._move_hand)
        self._ball = self._server.scene.add_icosphere(
            '/push', 0.03, color=(255, 200, 0), opacity=0.55, cast_shadow=False, visible=False
        )
        self._ball.on_drag('left')(self._push)
        self._force = self._server.scene.add_arrows(
            '/force', np.zeros((1, 2, 3)), (200, 0, 0), shaft_radius=0.006, head_radius=0.014,
            head_length=0.04, visible=False,
        )  # fmt: skip
        self._tubes.on_click(self._click)
        self._controls = {
            'controller': [arm],
            'hardware_emulator': [faults],
            'replay': [recording],
            'sim': [self._ball],  # it may be pushed without the emulator
        }

    def offer(self, nodes: Iterable[str]) -> None:
        """Show the controls of those nodes that are there."""
        there = set(nodes)
        for node, handles in self._controls.items():
            for handle in handles:
                if handle.visible != (node in there):
                    handle.visible = node in there
        if self._controls and 'controller' not in there:
            self._gizmo.visible = False

    def follow(self, payload: float, played: tuple[float, float] | None) -> None:
        """Let the controls show what is: sliders the estimate, until a target was given."""
        if not self._controls:
            return
        theta = self._posture.get('estimated')
        if theta is not None and not self._targeted:
            for angle, slider in zip(theta, self._sliders.values()):
                slider.value = float(np.clip(np.round(angle, 2), slider.min, slider.max))
            self._gizmo.position = self._robot.kinematics.end_effector_pose(theta).translation
        self._payload.value = round(min(max(payload, 0.0), MOST_PAYLOAD), 1)
        if played is not None:
            self._timeline.max = round(max(played[1], 0.1), 1)
            self._timeline.value = round(min(played), 1)

    def _slide(self, event: Any, joint: str) -> None:
        if event.client is not None:  # not by `follow`
            self._targeted = True
            self._act('targets', {joint: float(event.target.value)})

    def _show_gizmo(self, event: Any) -> None:
        self._gizmo.visible = event.target.value

    def _move_hand(self, event: Any) -> None:
        if event.client is not None:
            self._targeted = True
            self._act('hand', np.array(event.target.position))

    def _click(self, event: Any) -> None:
        muscle = self._robot.routes.muscle[event.instance_index // DASHES]
        self._muscle.value = self._robot.muscles[muscle]
        self._pick(event)

    def _pick(self, _: Any) -> None:
        self._picked = True
        self._mark_all()

    def _push(self, event: Any) -> None:
        start, end = np.array(event.start_position), np.array(event.end_position)
        force = PUSH_STIFFNESS * (end - start)
        size = float(np.linalg.norm(force))
        force *= min(1.0, MOST_PUSH / max(size, 1e-9))
        self._pushing = event.phase != 'end'
        self._force.points = np.stack([start, end])[None].astype(np.float32)
        self._force.visible = self._pushing
        self._act('push', force if self._pushing else np.zeros(3))
