# SPDX-License-Identifier: Apache-2.0
"""The web page: a scene with three arms, readings and controls, served by viser."""

import contextlib
import io
import logging
import socket
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import viser

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.report import whole
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import QUANTITIES, MuscleReadings
from musculoskeletal_ae.view import body
from musculoskeletal_ae.view.body import MARKS, DrawnState
from musculoskeletal_ae.view.controls import Controls, with_buttons
from musculoskeletal_ae.view.readings import HTML, History, ReadingsPanel
from musculoskeletal_ae.view.scene import RIGHT_PANEL, Scene
from musculoskeletal_ae.view.visits import checked_visits

#: show one panel in a window narrower than this [pixels], because two would hide the arm
NARROW = 900
HOT = 80.0  # temperature at the right end of a muscle's temperature bar [°C]


class Page:
    """The web page of one arm, which any number of visitors may open at once.

    Attributes:
        looked_at: Event that is set while the page has visitors.
        scene: The arms and muscles.
        controls: Buttons, sliders and handles; None on a page that is read only.
    """

    def __init__(
        self,
        robot: Robot,
        host: str,
        port: int,
        read_only: bool,
        act: Callable[..., None],
        title: str = '',
    ) -> None:
        """Serve the page.

        Args:
            robot: The robot to show.
            host: Address to listen on.
            port: Port to listen on.
            read_only: Whether to leave the controls out.
            act: Called with the requests of visitors (`controls`).
            title: Name of the arm in the title of the page; '': that of its robot.

        Raises:
            MusculoskeletalError: If the port cannot be used.
        """
        self._robot = robot
        self.looked_at = threading.Event()
        # Browsers open connections that they never use; do not log a traceback for each.
        logging.getLogger('websockets.server').setLevel(logging.CRITICAL)
        try:  # if the port is in use, viser would wait for ever or use another port
            family = socket.getaddrinfo(host, port)[0][0]
            socket.create_server((host, port), family=family).close()
        except (OSError, UnicodeError) as error:
            reason = getattr(error, 'strerror', error)
            raise MusculoskeletalError(
                f'cannot serve the page at port {port} of {host}: {reason}; '
                'choose another --port or --host'
            ) from error
        # Discard what viser prints.
        with (
            contextlib.redirect_stdout(io.StringIO()),
            checked_visits(
                host, f'{title or robot.description.directory.name} – musculoskeletal_ae'
            ),
        ):
            server = self._server = viser.ViserServer(host, port, verbose=False)
        if server.get_port() != port:  # another process took the port first
            server.stop()
            raise MusculoskeletalError(f'port {port} of {host} is in use; choose another --port')
        # Visitors must not open a tunnel to the internet.
        server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
        self._history = History()
        self._arms = ''  # HTML of the list of arms; '' for a single arm
        self._readings: dict[int, ReadingsPanel] = {}  # by the client id of the visitor
        self._configure_panel()
        self.scene = Scene(server, robot)
        self.controls = None if read_only else Controls(server, robot, self.scene, act)
        self.offer(())
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    # viser runs asynchronous callbacks in its event loop, in the order of the events, as long as
    # they await nothing. It would run other callbacks in a pool of threads, in any order: of a
    # visitor who leaves at once, the departure could be handled before the arrival, and the visitor
    # would count as present for ever.

    async def _on_connect(self, client: viser.ClientHandle) -> None:
        camera = client.camera
        is_narrow = camera.image_width < NARROW
        window = camera.image_width, camera.image_height
        look_at, position = self.scene.viewpoint(*window, is_narrow)
        # Set the position first, because the target of the camera moves with it.
        camera.position, camera.look_at = position, look_at
        self._readings[client.client_id] = ReadingsPanel(client.gui, self._robot, is_narrow)
        self.looked_at.set()

    async def _on_disconnect(self, client: viser.ClientHandle) -> None:
        self._readings.pop(client.client_id, None)
        if self.controls is not None:
            self.controls.end_visit()
        if not self._readings:
            self.looked_at.clear()

    def close(self) -> None:
        """Stop serving the page, which ends all visits."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _configure_panel(self) -> None:
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        gui.set_panel_label('musculoskeletal_ae')
        gui.main_panel.dock_right()
        gui.main_panel.set_width(RIGHT_PANEL)

    def draw(self, posture: dict[str, Array], tension: Array | None, kinds: Ints) -> None:
        """Draw the arms and the muscles; see `Scene.draw`."""
        theta = self.scene.draw(posture, tension, kinds)
        if self.controls is not None and theta is not None:
            self.controls.draw(theta)

    def tell(
        self,
        lines: list[str],
        alarm: str,
        muscles: MuscleReadings,
        now: float,
        values: Sequence[float],
        is_urgent: bool = True,
    ) -> None:
        """Tell visitors the state of the arm by texts, bars and curves.

        Args:
            lines: Lines of status text.
            alarm: Text of the alarm box; '': no box.
            muscles: Readings of the muscle modules, for the bars.
            now: Time of `values` [s].
            values: Values of the curves: estimation error [rad], the measures A and d that detect
                an anomaly, and the threshold of d; NaN where unknown.
            is_urgent: Whether the alarm box is red.
        """
        self._history.add(now, values)
        status, bars = (
            str(HTML.status(alarm, lines, is_urgent)) + self._arms,
            str(HTML.bars(self._muscles(muscles))),
        )
        for readings in list(self._readings.values()):
            readings.show(status, bars, self._history)

    def _muscles(self, readings: MuscleReadings) -> list[dict[str, Any]]:
        """Return the template variables of each muscle's bar."""
        tension, temperature = readings.tension, readings.temperature
        texts = [_texts(each.name, each.of(readings), each.unit) for each in QUANTITIES]
        columns = {
            'rgb': map(
                tuple, body.colours(self._robot, np.nan_to_num(tension), self.scene.kinds).tolist()
            ),
            'share': 100.0 * np.clip(np.nan_to_num(tension) / self._robot.tension.limit, 0.0, 1.0),
            'heat': 100.0 * np.clip(np.nan_to_num(temperature) / HOT, 0.0, 1.0),
            'name': self._robot.muscles,
            'mark': [MARKS[kind] for kind in self.scene.kinds],
            'kind': [DrawnState(kind).name.lower() for kind in self.scene.kinds],
            'readings': map(', '.join, zip(*texts, strict=True)),
            'pull': [whole(each, 'N') for each in tension],
            'warm': [whole(each, '°C') for each in temperature],
        }
        return [dict(zip(columns, row)) for row in zip(*columns.values())]

    def with_buttons(self, text: str) -> str:
        """Replace services that a text advises to call by the buttons of the page."""
        return text if self.controls is None else with_buttons(text)

    def notify(self, text: str, good: bool) -> None:
        """Notify all visitors that a request is done (`good`) or refused, with the text.

        The text names buttons of the page instead of services.
        """
        title, color = ('done', 'teal') if good else ('refused', 'red')
        for client in self._server.get_clients().values():
            client.add_notification(
                title, self.with_buttons(text), color=color, auto_close_seconds=6
            )

    def offer(self, nodes: Iterable[str], explores: bool = False) -> None:
        """Show the controls of the running nodes only.

        Args:
            nodes: Names of the running nodes.
            explores: Whether the controller explores.
        """
        if self.controls is not None:
            self.controls.offer(nodes, explores)

    def list_arms(self, arms: Sequence[Any], shown: str) -> None:
        """List the arms of the ROS graph, unless there is only the one that the page shows.

        Args:
            arms: One line about each (`nodes.reported_conditions.ArmSummary`).
            shown: Namespace of the arm that the page shows.
        """
        is_single = all(arm.namespace == shown for arm in arms)
        self._arms = '' if is_single else str(HTML.arms(arms, shown))

    def follow(self, payload: float, played: Sequence[float] | None) -> None:
        """Update the sliders from the payload [kg] and the replay; see `Controls.follow`."""
        if self.controls is not None:
            self.controls.follow(self.scene.posture.get('estimated'), payload, played)

    def send_entries(self) -> None:
        """Send the requests for the values that visitors have finished entering; see `Controls`."""
        if self.controls is not None:
            self.controls.send_entries()


def _texts(name: str, values: Array, unit: str) -> list[str]:
    """Return a text for each value of a quantity; a value that is not measured is a dash."""
    return [f'{name} –' if np.isnan(each) else f'{name} {each:.3g} {unit}' for each in values]
