# SPDX-License-Identifier: Apache-2.0
"""What `check_driver` does: listens to one driver, and winds its muscles in.

muscle_states, joint_states → stdout; with --move also muscle_length_command.
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.driver.listening import Listening
from musculoskeletal_ae.driver.verdict import Verdict
from musculoskeletal_ae.driver.winding import Winding
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.messages import array_message
from musculoskeletal_ae.nodes.qos import RELIABLE, SENSOR
from musculoskeletal_ae.nodes.running import start_ros
from musculoskeletal_ae.robot.robot import Robot

STATES, JOINTS, COMMAND = 'muscle_states', 'joint_states', 'muscle_length_command'
DISCOVERY = 1.0  # [s] in which the others on the graph are found
SILENCE = 1.0  # [s] without messages that end the winding


def _say(text: str) -> None:
    print(text, flush=True)


class CheckDriver:
    """Listens to one driver, and winds its muscles in."""

    def __init__(self, robot: Robot, options: Namespace) -> None:
        """Join the graph."""
        self.node: Node = rclpy.create_node('check_driver')
        self.robot, self.options = robot, options
        self.muscle_message: Callable[[Float64MultiArray], object] = lambda _: None
        self.joint_message: Callable[[JointState], object] = lambda _: None
        subscribe: Any = self.node.create_subscription
        subscribe(Float64MultiArray, STATES, lambda m: self.muscle_message(m), SENSOR)
        subscribe(JointState, JOINTS, lambda m: self.joint_message(m), SENSOR)
        self._spin_until(lambda: False, DISCOVERY)

    def _spin_until(self, condition: Callable[[], bool], longest: float) -> bool:
        end = time.monotonic() + longest
        while not condition() and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=min(0.1, max(0.0, end - time.monotonic())))
        return condition()

    def listen(self) -> Verdict:
        """Wait for a driver and listen to it."""
        posture = np.array(self.options.posture) if self.options.posture else None
        listening = Listening(self.robot, self.options.rate, posture)
        self.muscle_message = lambda m: listening.muscles(m, time.monotonic())
        self.joint_message = listening.joints
        topic = self.node.resolve_topic_name(STATES)
        if not self._spin_until(lambda: listening.count > 0, 2.0):
            _say(f'waiting for {topic} (ROS_DOMAIN_ID {self.node.context.get_domain_id()})')
            wait = float('inf') if self.options.wait else self.options.seconds
            self._spin_until(lambda: listening.count > 0 or self._mistyped() != '', wait)
        if listening.count:
            self._spin_until(lambda: False, self.options.seconds)
        verdict = listening.verdict()
        publishers = self.node.count_publishers(STATES)
        if wrong := self._mistyped():
            verdict.failed('order', (), f'{topic} is a {wrong}', 'std_msgs/msg/Float64MultiArray')
        elif publishers > 1:
            told = f'{publishers} nodes publish {topic}'
            verdict.failed('rate', (), told, 'one driver, and no hardware_emulator beside it')
        if not self.node.count_publishers(JOINTS):
            verdict.notes.append('nobody publishes joint_states, from which the learner learns')
        return verdict

    def _mistyped(self) -> str:
        kinds = {info.topic_type for info in self.node.get_publishers_info_by_topic(STATES)}
        return ', '.join(sorted(kinds - {'std_msgs/msg/Float64MultiArray'}))

    def wind(self) -> Verdict:
        """Wind each muscle in a little."""
        if self.node.count_publishers(COMMAND):
            raise MusculoskeletalError(
                f'{self.node.resolve_topic_name(COMMAND)} is published by another node: stop the '
                'controller before anything else moves the arm'
            )
        muscles = tuple(self.robot.muscle_indices(self.options.muscles or []))
        winding = Winding(self.robot, muscles, self.options.tension)
        listening = Listening(self.robot, self.options.rate)
        publisher = self.node.create_publisher(Float64MultiArray, COMMAND, RELIABLE)
        self._spin_until(lambda: publisher.get_subscription_count() > 0, 3.0)
        if not publisher.get_subscription_count():
            winding.verdict.failed(
                'law', (), f'nobody subscribes to {COMMAND}', 'let the driver follow it'
            )
            return winding.verdict
        last, trying = time.monotonic(), ''

        def follow(message: Float64MultiArray) -> None:
            nonlocal last, trying
            now = time.monotonic()
            states = listening.muscles(message, now)
            if states is None:
                return
            last, target = now, winding.step(states, now)
            if target is not None:
                publisher.publish(array_message(target, 'muscle'))
            if winding.trying != trying:
                trying = winding.trying
                _say(f'moving: {trying}')

        self.muscle_message = follow
        self._spin_until(lambda: winding.done or time.monotonic() - last > SILENCE, float('inf'))
        if not winding.done:
            told = f'no muscle_states for {SILENCE:g} s while it was commanded'
            winding.verdict.failed('rate', (), told, 'keep publishing, whatever is commanded')
        return winding.verdict


def check(options: Namespace, arguments: list[str]) -> int:
    """Judge a driver as the options say, and print it; return the exit status."""
    robot = Robot.load(options.robot)
    if options.posture and len(options.posture) != robot.joint_count:
        raise MusculoskeletalError(
            f'--posture: {robot.joint_count} values, one a joint, are wanted'
        )
    start_ros(arguments)
    driver, told = CheckDriver(robot, options), set[tuple[str, tuple[int, ...]]]()
    while True:
        verdict = driver.listen()
        faults = {fault[:2] for fault in verdict.faults}
        if not told or faults != told:  # else it is as it was
            _say(str(verdict))
        told = faults
        if not (options.wait and faults):
            break
        _say('nothing may move before the driver is changed; listening on')
    if options.move and verdict.wrong - {'zero'}:
        _say('not moved: what is wrong already comes first')
    elif options.move:
        verdict.add(driver.wind())
        _say(str(verdict))
    _say('the driver keeps its contract' if not verdict.faults else 'the driver is to be changed')
    return 1 if verdict.faults else 0
