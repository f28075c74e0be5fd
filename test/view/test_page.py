# SPDX-License-Identifier: Apache-2.0
"""The page in a real Chromium, with real nodes. Screenshots stay in log/view."""

import gzip
import itertools
import math
import socket
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from types import SimpleNamespace
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from graph import DEADLINE, Process, executable, no_number_of, seldom
from nodes.test_bringup_status import diagnostics
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from robots import write_robot
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from musculoskeletal_ae.conditions import stop_causes
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.process_signals import STOP
from musculoskeletal_ae.remedy_steps import Step, sentence
from musculoskeletal_ae.ros.message_building import LATCHED

pytest.importorskip('viser', reason='./bringup.sh --view installs what the page needs')

import msgspec
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros_tools import view as ros_view
from musculoskeletal_ae.ros_tools.ros_tool import start_ros
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.view import controls
from musculoskeletal_ae.view.controls import REST_TIME
from musculoskeletal_ae.view.entries import SETTLE_TIME
from musculoskeletal_ae.view.page import Page
from musculoskeletal_ae.view.readings import History, scale_top
from view.browser import Browser, find_chromium

SCREENSHOTS = Path(__file__).parents[2] / 'log' / 'view'
#: content of the first message that a browser sends: the visitor's camera
CAMERA = {
    'wxyz': (1.0, 0.0, 0.0, 0.0), 'position': (1.0, 1.0, 1.0), 'fov': 0.8, 'near': 0.01,
    'far': 100.0, 'image_height': 100, 'image_width': 100, 'look_at': (0.0, 0.0, 0.0),
    'up_direction': (0.0, 0.0, 1.0),
}  # fmt: skip
chromium = pytest.mark.skipif(find_chromium() is None, reason='no chromium is installed')


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


@pytest.fixture
def view(graph):
    """Return a function that starts the page of arm26 with options, and returns its port.

    The function waits until the page has logged that it admits visitors, because the page rejects
    earlier connections.
    """

    def start(*options: str) -> int:
        port = free_port()
        command = [*executable('view'), '--robot', 'arm26', '--port', str(port), *options]
        process = Process('view', [*command, '--ros-args', '-r', f'__ns:={graph.namespace}'])
        graph.processes.append(process)
        process.wait_for_output(f'http://localhost:{port}')
        return port

    return start


@chromium
def test_readings_and_controls_leave_room_for_the_arm(arm26, tmp_path):
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    port, times = free_port(), itertools.count()
    muscles = MuscleReadings(tension=np.full(6, 30.0), temperature=np.full(6, 25.0))
    page = Page(arm26, '127.0.0.1', port, False, lambda *_: None)
    page.offer(['controller'])
    sizes = (1280, 800), (800, 600)
    browser = Browser(tmp_path / 'profile', f'http://127.0.0.1:{port}', sizes[0])

    def is_complete() -> bool:
        page.draw({'estimated': np.array([0.0, -1.0])}, muscles.tension, np.array([2, *[0] * 5]))
        page.offer(['controller'], explores=True)
        values = (0.1, np.nan, np.nan, np.nan)
        page.tell(['error 0.1'], 'STOPPED: why', muscles, next(times), values)
        texts = 'STOPPED: why', 'End exploring', 'Restore isolated muscles', '30 N', 'A: '
        return all(text in browser.text for text in texts)

    try:
        for size in sizes:
            browser.visit(size)
            browser._wait(is_complete, 'all readings and controls')
            canvas = 'document.querySelector("canvas").getBoundingClientRect()'
            assert browser.evaluate(f'{canvas}.width') > 0.45 * size[0]
            browser.close_notifications()
            browser.screenshot(SCREENSHOTS / f'page_{size[0]}.png')
    finally:
        browser.close()
        page.close()


@pytest.mark.parametrize('robot', ['arm26', 'musashi_left_arm', 'musashi_upper_body', 'slider'])
def test_the_camera_sees_the_whole_arm_in_every_posture(robot, tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True) if robot == 'slider' else robot)
    shares = np.random.default_rng(1).uniform(0.0, 1.0, (20, robot.joint_count))
    visible = []
    for theta in robot.lower + shares * (robot.upper - robot.lower):
        visible += [*robot.routes.points(theta[None])[0]]
        visible += [
            robot.kinematics.link_pose(theta, link).translation
            for link in robot.description.end_effectors
        ]
    page = Page(robot, '127.0.0.1', free_port(), True, lambda *_: None)
    try:
        for width, height in (1280, 800), (1920, 1080), (800, 800):
            is_narrow = width < 900
            target, eye = page.scene.viewpoint(width, height, is_narrow)
            ahead = (target - eye) / np.linalg.norm(target - eye)
            side = np.cross(ahead, [0.0, 0.0, 1.0])
            side /= np.linalg.norm(side)
            to = np.array(visible) - eye
            # The camera sees 0.4 rad above and below its axis. The panels cover 330 pixels of the
            # width on a narrow page, and 680 pixels otherwise.
            free = width - (330 if is_narrow else 680)
            up = np.abs(to @ np.cross(side, ahead)) / (to @ ahead)
            assert up.max() < math.tan(0.4)
            assert (np.abs(to @ side) / (to @ ahead)).max() < math.tan(0.4) * free / height
    finally:
        page.close()


def test_values_that_are_not_known_are_not_drawn():
    history = History()
    for time, known in enumerate([1, 1, 0, 0, 1, 1, 0]):
        history.add(0.5 * time, [0.2 if known else math.nan, math.nan])
    time, values = history.curve([0])
    # The curve begins after the last gap, and ends with the last known value.
    np.testing.assert_allclose(time, [-1.0, -0.5])
    np.testing.assert_allclose(values, 0.2)
    assert all(len(line) == 0 for line in history.curve([1]))


@pytest.mark.parametrize(('largest', 'top'), [(0.0, 1.0), (0.03, 0.05), (1.0, 1.0), (43.0, 50.0)])
def test_a_plot_has_a_scale_of_round_numbers(largest, top):
    assert scale_top(largest) == pytest.approx(top)


def test_remedies_name_the_buttons_of_the_page(arm26):
    page = Page(arm26, '127.0.0.1', free_port(), False, lambda *_: None)
    try:
        for cause in stop_causes():
            text = page.with_buttons(sentence((*cause.steps, Step.EXPLORE)))
            assert 'call ' not in text and 'press "Explore"' in text
            assert text.count('Reset after a stop') <= 1
    finally:
        page.close()


@pytest.mark.parametrize('read_only', [False, True])
def test_notifications_name_the_buttons_of_the_page(arm26, monkeypatch, read_only):
    page = Page(arm26, '127.0.0.1', free_port(), read_only, lambda *_: None)
    notified = []
    visitor = SimpleNamespace(add_notification=lambda *texts, **_: notified.extend(texts))
    monkeypatch.setattr(viser.ViserServer, 'get_clients', lambda _: {0: visitor})
    try:
        page.notify('it has jumped; then call estimator/reset again', False)
    finally:
        page.close()
    call = 'call estimator/reset' if read_only else f'press "{controls.RESET}"'
    assert notified == ['refused', f'it has jumped; then {call} again']


@pytest.mark.parametrize('request_name', ['controller/stop', 'reset'])
def test_a_request_that_no_node_answers_is_reported(graph, arm26, monkeypatch, request_name):
    notes = SimpleQueue()
    visitor = SimpleNamespace(add_notification=lambda *texts, **_: notes.put(texts))
    monkeypatch.setattr(viser.ViserServer, 'get_clients', lambda _: {0: visitor})
    monkeypatch.setattr(ros_view, 'PATIENCE', 0.5)
    start_ros(['view', '--ros-args', '-r', f'__ns:={graph.namespace}'])
    node = ros_view.View(arm26, Namespace(host='127.0.0.1', port=free_port(), read_only=True))
    thread = Thread(target=node.run)
    thread.start()
    try:
        node.requests.put((request_name,))
        assert notes.get(timeout=DEADLINE) == ('refused', notes_of_missing(request_name))
        # The service exists, but its node hangs: it does not run while the test waits.
        service = 'estimator/reset' if request_name == 'reset' else request_name
        graph.node.create_service(Trigger, service, lambda _, response: response)
        note = ''
        while 'no answer' not in note:  # until the page has discovered the service
            node.requests.put((request_name,))
            note = notes.get(timeout=DEADLINE)[1]
        assert note.startswith(f'{service}: no answer for 0.5 s')
    finally:
        monkeypatch.setattr(STOP, 'received', True)
        thread.join()
        rclpy.shutdown()
        node.page.close()


def notes_of_missing(request_name):
    service = 'controller/reset' if request_name == 'reset' else request_name
    return f'{service}: no running node has this service; start controller'


def test_the_tab_of_the_browser_names_the_arm(arm26):
    port = free_port()
    page = Page(arm26, '127.0.0.1', port, True, lambda *_: None)
    try:
        for coding in ('identity', 'gzip'):
            request = Request(f'http://127.0.0.1:{port}/', headers={'Accept-Encoding': coding})
            with urlopen(request, timeout=60) as answer:
                data = answer.read()
            data = gzip.decompress(data) if answer.headers['Content-Encoding'] == 'gzip' else data
            assert '<title>arm26 – musculoskeletal_ae</title>'.encode() in data
    finally:
        page.close()


def visit(port: int, origin: str):
    import viser

    protocol = f'viser-v{viser.__version__}'
    return connect(f'ws://localhost:{port}', origin=origin, subprotocols=[protocol], max_size=None)


def read(other) -> None:
    while True:
        other.recv(timeout=300)


@chromium
def test_a_visitor_sees_the_arm_move_ruptures_a_muscle_and_sees_the_anomaly(
    graph, view, trained_file, tmp_path
):
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    graph.start('hardware_emulator', robot='arm26')
    nodes = {'robot': 'arm26', 'checkpoint': trained_file, 'max_age': 10.0, 'first_duration': 2.0}
    graph.start('combined', **nodes)  # estimator and controller
    bodies = graph.follow_body()
    targets = graph.listen(JointState, 'target_joint_states')
    modes = graph.listen(String, 'controller_mode', LATCHED)
    graph.listen(JointState, 'estimated_joint_states')
    graph.wait(lambda: graph.received['estimated_joint_states'], 'the estimate')
    port = view()
    topic = f'{graph.namespace}/anomaly'
    assert graph.node.count_subscribers(topic) == 0  # without a visitor, the page does not listen
    page = Browser(tmp_path / 'profile', f'http://127.0.0.1:{port}')

    def see(text: str) -> None:
        graph.wait(seldom(lambda: text in page.text), f'{text!r} on the page')

    def is_at_rest() -> bool:
        latest = graph.received['estimated_joint_states'][-100:]
        return np.ptp([message.position for message in latest], axis=0).max() < 0.02

    try:
        # Controls and readings appear as their nodes are discovered, one after the other.
        for text in ('Faults of the', 'error 0.', 'triceps_long', 'Explore', 'Stop', 'payload'):
            see(text)
        assert 'Recording' not in page.text  # this panel appears only while a bag is replayed
        page.close_notifications()
        before = page.screenshot(SCREENSHOTS / 'loaded.png')
        page.press('Explore')
        see('exploring')
        start = np.array(graph.received['estimated_joint_states'][-1].position)
        graph.wait(
            lambda: (
                np.abs(graph.received['estimated_joint_states'][-1].position - start).max() > 0.3
            ),
            'the arm to move',
        )
        page.close_notifications()
        assert page.screenshot(SCREENSHOTS / 'moving.png') != before
        assert not targets and not any(body.has_anomaly for body in bodies)
        page.press('End exploring')
        graph.wait(lambda: modes[-1].data == 'idle', 'the end of the exploration')
        # When the arm comes to rest, the sliders show its posture, and would replace a number that
        # is being typed at this moment.
        graph.wait(is_at_rest, 'the arm to come to rest')
        graph.next('estimated_joint_states', 100)  # time for the page to show this posture
        page.type_at('elbow', '-1.2')
        graph.wait(lambda: targets and list(targets[-1].position) == [-1.2], 'the target')
        page.press('Explore')
        see('exploring')
        page.press('Rupture')
        see('ERROR: estimator: ')
        assert bodies[-1].has_anomaly
        # The page must refuse this as long as the muscle is ruptured, because the arm would stop
        # again.
        graph.wait(
            seldom(lambda: page.press('Reset after a stop') or 'press "Repair" first' in page.text),
            'the refusal, which the page shows for some seconds',
        )
        assert 'controller/reset' not in page.text
        page.close_notifications()
        page.screenshot(SCREENSHOTS / 'rupture.png')
    finally:
        page.close()


@pytest.mark.parametrize('limits', [(0.001, 0.009), (-1.5, 2.0)])
def test_sliders_reach_the_limits_of_a_prismatic_joint(tmp_path, limits):
    urdf = write_robot(tmp_path, slider=True) / 'robot.urdf'
    text, before = urdf.read_text(), 'lower="0.0" upper="0.05"'
    assert before in text
    urdf.write_text(text.replace(before, f'lower="{limits[0]}" upper="{limits[1]}"'))
    page = Page(Robot.load(tmp_path), '127.0.0.1', free_port(), False, lambda *_: None)
    try:
        slider = page.controls.sliders[-1]
        near = 0.011 * (limits[1] - limits[0])
        np.testing.assert_allclose((slider.min, slider.max), limits, atol=near)
        assert limits[0] - 1e-12 <= slider.min < slider.max <= limits[1] + 1e-12
        assert slider.step <= near
    finally:
        page.close()


@chromium
def test_nan_implausible_estimates_and_unknown_parameters_do_not_end_the_page(
    graph, view, arm26, tmp_path
):
    port, asked = view('--read-only'), []
    graph.listen(DiagnosticArray, '/diagnostics')
    graph.wait(
        lambda: graph.report('view').message == 'the page has no visitors', 'the report of the page'
    )

    def answer(request, response):  # answer as a node that does not have these parameters
        asked.append(request)
        response.values = [ParameterValue() for _ in request.names]
        return response

    graph.node.create_service(GetParameters, 'hardware_emulator/get_parameters', answer)
    page = Browser(tmp_path / 'profile', f'http://127.0.0.1:{port}')
    try:
        publish = no_number_of(graph, arm26, 'brachialis')
        joints = graph.publisher(JointState, 'estimated_joint_states')

        def shown():
            publish()
            joints.publish(JointState(name=arm26.joints, position=[1e308, -1e308]))
            # The page asks for parameters once a second, after drawing.
            return len(asked) > 2 and '61 N' in page.text

        graph.wait(shown, 'the page to go on, with the tensions of the other muscles')
        page.wait_for('isolated: brachialis')
        name = graph.namespace.strip('/')
        assert page.evaluate('document.title') == f'{name} arm26 – musculoskeletal_ae'
        assert 'brachialis' in page.text and 'nan' not in page.text
        assert 'Stop' not in page.text  # a page without controls
        rate = 'estimated_joint_states rate'
        graph.wait(
            lambda: rate in graph.report('view').values, 'the rate of the estimates in the report'
        )
    finally:
        page.close()
    assert graph.processes[-1].alive()


@chromium
def test_the_page_lists_all_arms_of_the_graph_with_links_to_their_pages(graph, view, tmp_path):
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    sides = [f'{graph.namespace}/{side}' for side in ('left', 'right')]
    page = Browser(tmp_path / 'profile', f'http://127.0.0.1:{view("--read-only")}')
    address, script = 'http://localhost:8082', '<script>alert(1)</script>'
    reports = graph.publisher(DiagnosticArray, '/diagnostics')

    def is_listed() -> bool:
        for side, doing in zip(sides, ('exploring', script), strict=True):
            reports.publish(diagnostics(f'{side}/controller', message=doing, identity='a'))
        reports.publish(diagnostics(f'{sides[0]}/view', identity='b', page=address))
        return all(text in page.text for text in (*sides, 'exploring', script))

    try:
        graph.wait(seldom(is_listed), 'both arms on the page')
        assert (
            page.evaluate(f'document.querySelector(\'a[href="{address}"]\').innerText') == sides[0]
        )
        page.close_notifications()
        page.screenshot(SCREENSHOTS / 'arms.png')
    finally:
        page.close()


def test_a_browser_can_change_only_the_values_of_controls(graph, arm26):
    port, asked = free_port(), []
    page = Page(arm26, '127.0.0.1', port, False, lambda *what: asked.append(what))
    slider = page.controls.sliders[0]
    control = {'type': 'GuiUpdateMessage', 'uuid': slider._impl.uuid}
    try:
        with ThreadPoolExecutor(1) as aside, visit(port, f'http://localhost:{port}') as mine:
            aside.submit(read, mine)
            mine.send(msgspec.msgpack.encode({'type': 'ViewerCameraMessage', **CAMERA}))
            graph.wait(page.looked_at.is_set, 'the visitor to be counted')
            mine.send(b'no message')
            for updates in {'update_cb': []}, 5, {'value': float(slider.max)}:
                mine.send(msgspec.msgpack.encode({**control, 'updates': updates}))
            # A legal value must not only move the slider, but also request a target.
            graph.wait(lambda: page.send_entries() or asked, 'what the visitor asked for')
        assert asked == [('targets', {arm26.joints[0]: pytest.approx(slider.max)})]
    finally:
        page.close()


@pytest.fixture
def clock(monkeypatch):
    """Return the clock [s] of the controls, which only the test advances."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(controls, 'monotonic', lambda: clock.now)
    return clock


@pytest.fixture
def entering(arm26, graph):
    """Return a page, its visitor's requests, and a function that enters values at a slider."""
    port, asked = free_port(), []
    page = Page(arm26, '127.0.0.1', port, False, lambda *what: asked.append(what))
    try:
        with ThreadPoolExecutor(1) as aside, visit(port, f'http://localhost:{port}') as mine:
            aside.submit(read, mine)
            mine.send(msgspec.msgpack.encode({'type': 'ViewerCameraMessage', **CAMERA}))
            graph.wait(page.looked_at.is_set, 'the visitor to be counted')

            def enter(slider: Any, *values: float) -> None:
                received = []

                async def receive(event: Any) -> None:  # called after the callback of the page
                    if event.client is not None:
                        received.append(event.target.value)

                slider.on_update(receive)
                change = {'type': 'GuiUpdateMessage', 'uuid': slider._impl.uuid}
                for value in map(float, values):
                    updates = {'value': value}
                    mine.send(msgspec.msgpack.encode({**change, 'updates': updates}))
                graph.wait(lambda: len(received) == len(values), 'the page to receive the values')

            yield page, asked, enter
    finally:
        page.close()


def follow(page: Page, elbow: float) -> None:
    """Show an estimate on the page, with the elbow at an angle [rad] and the shoulder at 0."""
    theta = np.array([0.0, elbow])
    page.draw({'estimated': theta}, np.full(6, 30.0), np.zeros(6, dtype=int))
    page.follow(0.0, None)


def rest(page: Page, elbow: float, clock: Any) -> None:
    """Show the same estimate for so long that the arm is at rest."""
    follow(page, elbow)
    clock.now += REST_TIME
    follow(page, elbow)


def test_sliders_follow_an_arm_that_rests_but_not_one_that_moves(entering, clock):
    page, _, _ = entering
    slider = page.controls.sliders[-1]
    rest(page, -0.5, clock)
    assert slider.value == pytest.approx(-0.5)
    for elbow in np.linspace(-0.6, -1.0, 9):
        clock.now += 0.5 * REST_TIME
        follow(page, elbow)
        assert slider.value == pytest.approx(-0.5)
    clock.now += REST_TIME
    follow(page, -1.0)
    assert slider.value == pytest.approx(-1.0)


def test_a_number_is_sent_when_it_is_complete_and_is_not_overwritten_before(arm26, entering, clock):
    page, asked, enter = entering
    slider, elbow = page.controls.sliders[-1], arm26.joints[-1]
    rest(page, -0.5, clock)
    assert slider.value == pytest.approx(-0.5)
    follow(page, -0.51)  # noise of the estimate must not change the box while somebody uses it
    assert slider.value == pytest.approx(-0.5)
    for number in -1.0, -1.2:
        enter(slider, number)
        clock.now += 0.9 * SETTLE_TIME
        # The mode of the controller may be a second old: this must not revive the following.
        page.offer(['controller'], explores=True)
        follow(page, -0.7)
        page.send_entries()
        assert slider.value == number and asked == []
    clock.now += 0.2 * SETTLE_TIME
    for _ in range(2):
        page.send_entries()
        follow(page, -0.7)
        assert slider.value == -1.2 and asked == [('targets', {elbow: -1.2})]


@pytest.mark.parametrize('is_left', [False, True], ids=['in the box', 'left the box'])
def test_a_number_beyond_the_limits_is_refused_and_taken_back(arm26, entering, clock, is_left):
    page, asked, enter = entering
    slider, elbow = page.controls.sliders[-1], arm26.joints[-1]
    rest(page, -0.5, clock)
    # When the visitor leaves the box, the browser clamps the number to the limit.
    enter(slider, -1.0, -12.0, *[slider.min] * is_left)
    clock.now += SETTLE_TIME
    page.send_entries()
    legal = f'{slider.min:g} to {slider.max:g}'
    assert asked == [('refused', f'{elbow}: expected {legal}, got -12')]
    assert slider.value == pytest.approx(-0.5)


def test_a_payload_is_sent_when_it_is_complete_and_is_not_overwritten_before(entering, clock):
    page, asked, enter = entering
    for mass in 2.0, 2.5:
        enter(page.controls.payload, mass)
        page.send_entries()
        page.follow(0.0, None)
        assert page.controls.payload.value == mass and asked == []
    clock.now += SETTLE_TIME
    page.send_entries()
    page.follow(0.0, None)  # the emulator has not answered yet
    assert page.controls.payload.value == 2.5
    assert asked == [('payload', 2.5)]


@pytest.mark.usefixtures('clock')
def test_a_dragged_slider_is_followed_at_once(entering, arm26):
    page, asked, enter = entering
    enter(page.controls.sliders[-1], *np.arange(-30, -20) / 25.0)
    page.send_entries()
    assert asked == [('targets', {arm26.joints[-1]: pytest.approx(-0.84)})]


@pytest.mark.parametrize('is_stop', [True, False], ids=['stop', 'departure'])
def test_a_stop_or_departure_discards_a_target_that_is_being_entered(entering, clock, is_stop):
    page, asked, enter = entering
    enter(page.controls.sliders[-1], -1.0)
    if is_stop:
        page.controls.request('controller/stop')
    else:
        page.controls.end_visit()
    clock.now += SETTLE_TIME
    page.send_entries()
    assert asked == [('controller/stop',)] * is_stop


def enter_page(port):
    """Return the connection of a new visitor."""
    connection = visit(port, f'http://localhost:{port}')
    connection.send(msgspec.msgpack.encode({'type': 'ViewerCameraMessage', **CAMERA}))
    return connection


def test_a_push_ends_when_its_visitor_leaves(arm26, graph):
    port, asked = free_port(), []
    page = Page(arm26, '127.0.0.1', port, False, lambda *what: asked.append(what))
    try:
        with enter_page(port):
            graph.wait(page.looked_at.is_set, 'the visitor to be counted')
            ends = {'start_position': np.zeros(3), 'end_position': np.ones(3)}
            assert page.controls.push(SimpleNamespace(phase='update', **ends)).any()
            assert asked == []
        graph.wait(lambda: asked, 'the end of the push')
    finally:
        page.close()
    ((what, force),) = asked
    assert what == 'push' and not force.any()


def test_visitors_who_come_and_go_at_once_are_not_counted_for_ever(arm26, graph):
    port = free_port()
    page = Page(arm26, '127.0.0.1', port, True, lambda *_: None)
    try:
        with ThreadPoolExecutor(4) as pool:
            for _ in pool.map(lambda _: enter_page(port).close(), range(100)):
                pass
        with enter_page(port):
            graph.wait(page.looked_at.is_set, 'the last visitor to be counted')
        graph.wait(lambda: not page.looked_at.is_set(), 'all visitors to leave')
        with enter_page(port):
            graph.wait(page.looked_at.is_set, 'a new visitor to be counted')
    finally:
        page.close()


def test_an_address_that_cannot_be_used_is_refused(arm26):
    with pytest.raises(MusculoskeletalError, match=r'page at port \d+ of 192\.0\.2\.1: Cannot'):
        Page(arm26, '192.0.2.1', free_port(), False, lambda *_: None)
    with pytest.raises(MusculoskeletalError, match=r'of 127\.\.0\.1: .*choose another'):
        Page(arm26, '127..0.1', free_port(), False, lambda *_: None)


def test_a_page_of_another_site_is_turned_away_and_a_port_in_use_is_named(arm26):
    port = free_port()
    page = Page(arm26, '127.0.0.1', port, True, lambda *_: None)
    try:
        foreign = 'http://evil.example', f'http://evil.example:{port}', 'null', 'http://[bad'
        for origin in foreign:
            with pytest.raises(InvalidStatus, match='403'):
                visit(port, origin)
        # A site whose domain name resolves to this machine names itself as the host, too.
        headers = {'Host': f'evil.example:{port}', 'Origin': f'http://evil.example:{port}'}
        with pytest.raises(HTTPError, match='403'):
            urlopen(Request(f'http://127.0.0.1:{port}/', headers=headers), timeout=60)
        with visit(port, f'http://localhost:{port}') as mine:
            assert mine.recv(timeout=300)
        named = f'cannot serve the page at port {port} of 127.0.0.1: Address already in use'
        with pytest.raises(MusculoskeletalError, match=named):
            Page(arm26, '127.0.0.1', port, True, lambda *_: None)
    finally:
        page.close()
