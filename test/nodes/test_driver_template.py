# SPDX-License-Identifier: Apache-2.0
"""The driver template meets the requirements of the controller."""

import importlib.util
import re
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from graph import Process
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.driver.listening import Listening
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.message_building import array_message, joint_message

TEMPLATE = Path(__file__).parents[2] / 'examples' / 'driver.py'
ROBOT = Robot.load('arm26')


def test_the_driver_template_follows_the_last_command_and_ends_silently(graph):
    command = [sys.executable, str(TEMPLATE), '--ros-args', '-r', f'__ns:={graph.namespace}']
    driver = Process('driver.py', command)
    graph.processes.append(driver)
    graph.listen(Float64MultiArray, 'muscle_states')

    def read():
        return np.reshape(graph.next('muscle_states').data, (3, -1))

    bias, known = ROBOT.tension.bias, read()[0]
    lengths = known - 50.0 / ROBOT.stiffness
    for kind, value, least, most in (
        ('length', lengths, bias + 5.0, bias + 60.0),
        ('tension', np.full(len(bias), 120.0), bias + 75.0, bias + 95.0),
        ('length', lengths + 1.0, bias - 10.0, bias + 10.0),
    ):
        publisher = graph.publisher(Float64MultiArray, f'muscle_{kind}_command')

        def pulled(publisher=publisher, value=value, least=least, most=most):
            publisher.publish(Float64MultiArray(data=value.tolist()))
            tension = read()[1]
            return (least < tension).all() and (tension < most).all()

        graph.wait(pulled, f'{kind}s to be followed')
    driver.ends_silently(signal.SIGTERM)


def test_the_driver_template_goes_to_lengths_and_publishes_currents_if_muscles_yaml_says_so(
    graph, tmp_path
):
    folder = shutil.copytree(ROBOT.description.directory, tmp_path / 'servos')
    modules = 'actuation: position\nspeed: 0.2\ntension_source: current\n'
    modules += 'drive: {torque_constant: 0.03, gear: 20.0, spool_radius: 0.01}'
    text, count = re.subn('(?m)^stiffness: .*$', modules, (folder / 'muscles.yaml').read_text())
    assert count == 1
    (folder / 'muscles.yaml').write_text(text)
    command = [sys.executable, str(TEMPLATE), '--ros-args', '-r', f'__ns:={graph.namespace}']
    driver = Process('driver.py', [*command, '-p', f'robot:={folder}'])
    graph.processes.append(driver)
    graph.listen(Float64MultiArray, 'muscle_states')

    def read():
        return np.reshape(graph.next('muscle_states').data, (3, -1))

    known, current, _ = read()
    assert (np.abs(current) < 2.0).all()  # at T_bias, 30 N are 0.5 A
    publisher, target = graph.publisher(Float64MultiArray, 'muscle_length_command'), known - 0.001

    def arrives():
        publisher.publish(Float64MultiArray(data=target.tolist()))
        length, pulled, _ = read()
        return np.abs(length - target).max() < 5e-4 and (pulled > current + 0.2).all()

    graph.wait(arrives, 'the motors to be at their lengths, and to pull harder')
    driver.ends_silently(signal.SIGTERM)


def test_methods_with_tension_commands_are_refused_without_a_driver_for_them(graph):
    core = graph.host(ControllerNode, robot='arm26').core
    graph.listen(Float64MultiArray, 'muscle_length_command')
    graph.wait(
        lambda: not graph.set_parameter('controller', 'method', 'float')[0],
        'the refusal of the method',
    )
    done, reason = graph.set_parameter('controller', 'method', 'tension')
    assert (
        not done and 'subscribes to muscle_length_command only; legal: geometric, first' in reason
    )
    # The first refusal shows that the driver's subscription is known. An attempt before that may
    # have set `float`.
    assert core.settings.method in ('proposed', 'float')
    graph.listen(Float64MultiArray, 'muscle_tension_command')
    graph.wait(
        lambda: graph.set_parameter('controller', 'method', 'tension')[0],
        'the method to be accepted',
    )


@pytest.mark.parametrize(
    ('name', 'messages'),
    [('arm26', 300), pytest.param('musashi_left_arm', 600, marks=pytest.mark.thorough)],
)
def test_the_moved_arm_of_the_template_shows_order_and_sign_of_every_muscle(
    name, messages, monkeypatch
):
    spec = importlib.util.spec_from_file_location('driver_template', TEMPLATE)
    template = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(template)
    now, robot = [100.0], Robot.load(name)
    monkeypatch.setattr(template.time, 'monotonic', lambda: now[0])
    bus, listening = template.Bus(robot, moved=True), Listening(robot, 20.0)
    for _ in range(messages):
        now[0] += 0.05
        angle, tension, temperature, theta = bus.read()
        listening.joints(joint_message(robot.joints, theta, Time()))
        rows = np.stack([-template.SPOOL * angle, tension, temperature])
        listening.muscles(array_message(rows, 'quantity', 'muscle'), now[0])
    verdict = listening.verdict(now[0])
    assert not verdict.faults, str(verdict)
    assert verdict.conclusion == 'no fault found; not judged: law, clip, latency of all muscles'
