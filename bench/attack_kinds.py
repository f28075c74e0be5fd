# SPDX-License-Identifier: Apache-2.0
"""Known attacks on an arm, each in several variants, while it holds and while it explores.

Most attacks mark the time in which something is wrong (`Scene.wrong`). After each attack, the scene
takes the steps that /diagnostics advises until the arm moves on.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from bench.attack_graph import COOLING, NODES, OWN, PATIENCE, Attack, digest, set_request
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import LENGTH_SCALE
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.ros.message_building import LATCHED, array_message, bytes_message
from musculoskeletal_ae.signals.body_state import Anomaly, BodyState, LengthOffsets, Trust

MOMENTS = 'holding', 'exploring'
LASTING = 4.0  # let an attack last for this time [s]
#: report a violation if the status line says OK this long after a problem has begun [s]
REPORT_TIME = 2.0
#: steps that end the faults of the emulated arm
REPAIRS = {
    Step.REPAIR_MUSCLE,
    Step.REPAIR_EMULATED_FAULT,
    Step.FREE_ARM,
    Step.CHECK_SENSOR,
    Step.CHECK_TENDON,
    Step.CHECK_MODULE,
    Step.CHECK_COOLING,
    Step.CHECK_JOINT_SENSOR,
    Step.REPAIR_SENSOR,
}
OFFSET = 0.08  # publish false length offsets of this absolute value [m]


class Scene:
    """Performs one known attack on an arm that holds or explores, and recovers the arm."""

    def __init__(self, attack: Attack) -> None:
        """Prepare attacks on the system that `attack` has started."""
        self.attack, self.rng = attack, attack.rng
        self.what = ''  # description of the present attack, for the reports of violations

    # -- the course of an attack ----------------------------------------------------------------

    def play(self, kind: str, shape: int, moment: str) -> None:
        """Play one attack: bring the arm into a state, attack it, and recover it as advised.

        Args:
            kind: Kind of the attack, a key of KINDS.
            shape: Number of the variant of this kind.
            moment: State of the arm, 'holding' or 'exploring'.
        """
        self.what = f'{kind}, shape {shape}, {moment}'
        if not self.bring(moment):
            return
        KINDS[kind][shape](self)
        self.recover(moment)
        self.attack.watches_processes = True
        self.attack.tried['attacks'] += 1

    @contextmanager
    def wrong(self) -> Iterator[None]:
        """Return a context in which something is wrong and the status line has to say so.

        A status line that reports OK later than REPORT_TIME after the start is a violation.
        """
        begin = time.time()
        yield
        silent = [
            at
            for at, level, _ in self.attack.status
            if begin + REPORT_TIME < at < time.time() and level == 'ok'
        ]
        self.attack.tried['status'] += 1
        if silent:
            late = max(silent) - begin
            self.attack.found(
                'no OK while something is wrong',
                f'{self.what}: the status line was still OK after {late:.1f} s',
            )

    def bring(self, moment: str) -> bool:
        """Bring a healthy arm to hold a posture or explore; return whether it does."""
        attack = self.attack
        if not attack.moving():
            return False
        if moment == 'holding':
            robot = attack.robot
            attack.call(SetBool, 'controller/explore', SetBool.Request(data=False))
            middle = JointState(name=robot.joints)
            middle.position = (0.6 * robot.lower + 0.4 * robot.upper).tolist()
            self.publish('target_joint_states', middle)
            attack.spin(1.5)
        return True

    def recover(self, moment: str) -> None:
        """Follow the advice until nothing is wrong and the arm is in the state `moment` again."""
        attack, end, trouble = self.attack, time.monotonic() + PATIENCE, ''
        longest = end + COOLING
        while time.monotonic() < end:
            begun = time.monotonic()
            attack.spin(1.0)
            level = attack.situation.level()
            trouble = attack.situation.trouble()
            if level != 'error' and self._goes_on(moment):
                return
            waits_for_cooling = Step.WAIT_UNTIL_COOL in attack.situation.steps()
            self.follow_advice()
            # A hot winding cools by about 0.1 °C per second only, so extend the deadline by this
            # time.
            if waits_for_cooling:
                end = min(end + time.monotonic() - begun, longest)
        attack.found(
            'the remedy helps', f'{self.what}: no recovery in {PATIENCE:g} s; status: {trouble}'
        )
        attack.end_strangers()
        for name in NODES:
            self.resume(name)

    def _goes_on(self, moment: str) -> bool:
        mode = self.attack.modes[-1][1] if self.attack.modes else ''
        if moment == 'exploring' and mode in ('idle', 'holding'):
            request = SetBool.Request(data=True)
            self.attack.call(SetBool, 'controller/explore', request)
            return False
        return mode in ('idle', 'holding', 'moving', 'exploring')

    def follow_advice(self) -> None:
        """Follow the advice of all reports on /diagnostics, and restart silent nodes."""
        attack = self.attack
        for node in attack.situation.silent_nodes():
            attack.processes[node].kill()
            attack.start(node)

            def has_reported(node: str = node) -> bool:
                return node in attack.levels

            attack.wait(has_reported, 'the remedy helps', f'a report of {node}')
        for step in attack.situation.steps():
            self._take(step)

    def _take(self, step: Step) -> None:
        """Take one step of the advice on /diagnostics, as an operator would."""
        attack = self.attack
        if step in (Step.STOP_SECOND_PUBLISHER, Step.STOP_OTHER_ROBOT):
            attack.end_strangers()
        elif step in REPAIRS:
            attack.set_faults([])
            attack.spin(1.0)
        elif step is Step.WAIT_UNTIL_COOL:
            attack.spin(3.0)
        elif step in (Step.CHECK_DRIVER, Step.CHECK_ESTIMATOR):
            for name in ('hardware_emulator', 'estimator'):
                self.resume(name)
        elif step is Step.RESTORE_MUSCLES:
            attack.call(Trigger, 'estimator/restore')
        elif step is Step.CALIBRATE_LENGTHS:
            attack.calibrate_lengths()
        elif step in (Step.EXPLORE, Step.EXPLORE_GENTLY, Step.CHANGE_TARGET):
            attack.call(SetBool, 'controller/explore', SetBool.Request(data=True))
        elif step in (Step.RESET_CONTROLLER, Step.RESET_ESTIMATOR):
            node = 'controller' if step is Step.RESET_CONTROLLER else 'estimator'
            attack.call(Trigger, f'{node}/reset')
            attack.spin(0.5)

    # -- actions of the hostile node ------------------------------------------------------------

    def publish(self, topic: str, *messages: Any, period: float = 0.1, qos: Any = OWN) -> None:
        """Publish messages on a topic of the arm as the hostile node, one every `period` [s]."""
        attack = self.attack
        if topic not in attack.publishers:
            kind = type(messages[0])
            attack.publishers[topic] = attack.node.create_publisher(kind, topic, qos)
            attack.spin(0.3)
        for message in messages:
            attack.sent.add(digest(message))
            attack.publishers[topic].publish(message)
            attack.tried['messages'] += 1
            attack.spin(period)

    def latch(self, topic: str, *messages: Any) -> None:
        """Latch false messages on a topic; the status line must report the problem."""
        with self.wrong():
            self.publish(topic, *messages, qos=LATCHED)
            self.attack.spin(LASTING)

    def set(self, node: str, name: str, value: Any) -> None:
        """Set the parameter `name` of a node to `value`, as any program on the graph may."""
        self.attack.call(SetParameters, f'{node}/set_parameters', set_request(name, value))

    def pause(self, name: str) -> None:
        """Suspend the process of a node, so that it no longer reacts to anything."""
        self.attack.processes[name].process.send_signal(signal.SIGSTOP)

    def resume(self, name: str) -> None:
        """Resume the suspended process of a node."""
        self.attack.processes[name].process.send_signal(signal.SIGCONT)

    def genuine(self, topic: str) -> Any:
        """Return the last genuine message of a topic."""
        return self.attack.genuine[topic]


def _body(
    scene: Scene,
    offset: float = 0.0,
    deviation: float = 0.0,
    trust: Trust = Trust.KNOWN,
    isolated: Sequence[int] = (),
    anomaly: Anomaly = Anomaly.NONE,
) -> Float64MultiArray:
    """Return a false body state.

    Args:
        scene: The attacked arm, whose present body state is falsified.
        offset: Absolute value of the length offsets, whose signs alternate [m].
        deviation: Standard deviation that the body state states for the offsets [m].
        trust: Whether it states that the offsets may be used.
        isolated: Indices of the muscles that are isolated.
        anomaly: State of the anomaly.
    """
    muscles = scene.attack.robot.muscle_count
    sign = np.where(np.arange(muscles) % 2, 1.0, -1.0)
    offsets = LengthOffsets.of(sign * offset, deviation, trust)
    suspect = None if anomaly is Anomaly.NONE else 0
    generation = scene.rng.randrange(1, 2**50)
    body = BodyState(offsets, tuple(isolated), anomaly, suspect, generation)
    return array_message(body.rows, 'quantity', 'muscle')


def zeros_unknown_then_false(scene: Scene) -> None:
    """Publish unknown length offsets, then false ones."""
    scene.latch('body_state', _body(scene, trust=Trust.UNKNOWN), _body(scene, OFFSET, 1e-3))


def zeros_false(scene: Scene) -> None:
    """Publish false length offsets in place of those of the estimator."""
    scene.latch('body_state', _body(scene, OFFSET, 1e-3))


def zeros_alternating(scene: Scene) -> None:
    """Publish length offsets that change their signs again and again."""
    pair = [_body(scene, OFFSET, 1e-3), _body(scene, -OFFSET, 1e-3)]
    scene.latch('body_state', *pair * 10)


def isolate_most(scene: Scene) -> None:
    """Publish that most muscles are isolated, so that the controller must not use them."""
    most = range(scene.attack.robot.muscle_count - 1)
    scene.latch('body_state', _body(scene, isolated=most))


def isolate_all(scene: Scene) -> None:
    """Publish that all muscles are isolated, so that no muscle can hold the arm."""
    muscles = range(scene.attack.robot.muscle_count)
    scene.latch('body_state', _body(scene, isolated=muscles))


def isolate_in_turns(scene: Scene) -> None:
    """Publish for one muscle after the other that it alone is isolated."""
    each = [_body(scene, isolated=[m]) for m in range(scene.attack.robot.muscle_count)]
    scene.latch('body_state', *each, _body(scene))


def _denials(scene: Scene) -> list[Float64MultiArray]:
    """Return false body states: that there was no anomaly, and that the anomaly has ended."""
    return [_body(scene, anomaly=each) for each in (Anomaly.NONE, Anomaly.ENDED)]


def deny_an_anomaly(scene: Scene) -> None:
    """Publish that there is no anomaly while a muscle is ruptured."""
    attack = scene.attack
    muscle = attack.robot.muscles[scene.rng.randrange(attack.robot.muscle_count)]
    scene.set('hardware_emulator', 'faults', [f'rupture:{muscle}'])
    with scene.wrong():
        attack.wait(lambda: attack.has_detected, 'a rupture is detected', f'rupture of {muscle}')
        scene.publish('body_state', *_denials(scene), qos=LATCHED)
        attack.call(Trigger, 'controller/reset')
        attack.call(SetBool, 'controller/explore', SetBool.Request(data=True))
        attack.spin(LASTING)


def deny_and_go(scene: Scene) -> None:
    """Publish that there is no anomaly, and leave the graph before the reset."""
    attack = scene.attack
    scene.set('hardware_emulator', 'faults', [f'rupture:{attack.robot.muscles[0]}'])
    with scene.wrong():
        attack.wait(
            lambda: attack.has_detected,
            'a rupture is detected',
            'rupture of the first muscle',
        )
        scene.publish('body_state', *_denials(scene), qos=LATCHED)
        attack.end_strangers()
        attack.spin(0.5)
        answer = attack.call(Trigger, 'controller/reset')
        if answer is not None and answer.success:
            attack.found('a latch holds', f'{scene.what}: reset with a ruptured muscle')
        attack.spin(LASTING)


def repeat_an_estimate(scene: Scene) -> None:
    """Suspend the estimator, and repeat its last estimate."""
    old = scene.genuine('estimated_joint_states')
    scene.pause('estimator')
    with scene.wrong():
        scene.publish('estimated_joint_states', *[old] * int(50 * LASTING), period=0.02)
    scene.resume('estimator')


def shifted(topic: str, joints: float) -> Callable[[Scene], None]:
    """Return an attack that publishes false joint states between the genuine messages of `topic`.

    The false angles are the genuine ones plus `joints` [rad].
    """

    def attack(scene: Scene) -> None:
        with scene.wrong():
            for _ in range(int(50 * LASTING)):
                message = scene.genuine(topic)
                other = JointState(header=message.header, name=message.name)
                other.position = [angle + joints for angle in message.position]
                scene.publish(topic, other, period=0.02)

    return attack


def second(name: str, node: str = '') -> Callable[[Scene], None]:
    """Return an attack that starts the node `name` a second time, as `node` if this is given."""

    def attack(scene: Scene) -> None:
        begin, graph = time.time(), scene.attack
        graph.start_second(name, node)
        own = {'controller': 'muscle_length_command', 'estimator': 'anomaly'}
        topic = f'{graph.namespace}/{own.get(name, "mae_checkpoint")}'
        graph.wait(
            lambda: graph.node.count_publishers(topic) > 1, 'a second node starts', scene.what
        )
        with scene.wrong():
            graph.spin(LASTING)
        graph.call(Trigger, 'controller/stop')
        graph.end_strangers()
        if name == 'controller':
            graph.foreign.append((begin, time.time() + 0.5))

    return attack


def wrong_network(change: Callable[[Mae], Mae]) -> Callable[[Scene], None]:
    """Return an attack that publishes a wrong network on the topic of the learner.

    `change` derives this network from the one in use.
    """

    def attack(scene: Scene) -> None:
        mae = checkpoint.from_bytes(
            bytes(scene.genuine('accepted_checkpoint').data), scene.attack.robot
        )
        other = replace(change(mae), version=mae.version + 1000)
        message: UInt8MultiArray = bytes_message(checkpoint.to_bytes(other))
        scene.latch('mae_checkpoint', message)

    return attack


def _lengths(scale: float, offset: float = 0.0, every: int = 1) -> Callable[[Mae], Mae]:
    """Return a function that falsifies the lengths of a network.

    It multiplies lengths by `scale` and adds `offset` [m], for every muscle, or for every second
    one if `every` is 2.
    """

    def change(mae: Mae) -> Mae:
        mean, std = mae.mean.copy(), mae.std.copy()
        lengths = slice(len(mae.joints) + len(mae.muscles), None, every)
        mean[lengths] = mean[lengths] * scale + offset / LENGTH_SCALE
        std[lengths] *= scale
        return replace(mae, mean=mean, std=std)

    return change


def without(name: str, is_paused: bool) -> Callable[[Scene], None]:
    """Return an attack that suspends the node `name` if `is_paused`, and kills it otherwise."""

    def attack(scene: Scene) -> None:
        # The attack itself ends or suspends the process, which is no violation. `recover` restarts
        # the node when its reports are missing.
        scene.attack.watches_processes = False
        if is_paused:
            scene.pause(name)
        else:
            scene.attack.processes[name].kill()
        scene.attack.tried['kills'] += 1
        with scene.wrong():
            scene.attack.spin(1.5 * LASTING)

    return attack


def fault(line: str, *services: str) -> Callable[[Scene], None]:
    """Return an attack that injects the fault `line` into the arm, and then calls services."""

    def attack(scene: Scene) -> None:
        scene.attack.set_faults([line])
        scene.attack.spin(0.5 * LASTING)
        for service in services:
            scene.attack.call(Trigger, service)
        scene.attack.spin(LASTING)
        scene.attack.set_faults([])

    return attack


def change_method(*methods: str) -> Callable[[Scene], None]:
    """Return an attack that changes the control method during motion."""

    def attack(scene: Scene) -> None:
        for method in (*methods, 'proposed'):
            scene.set('controller', 'method', method)
            scene.attack.spin(1.0)

    return attack


def stop_a_verification(scene: Scene) -> None:
    """Stop the arm as an operator while a suspect muscle is verified."""
    attack = scene.attack
    scene.set('estimator', 'on_anomaly', 'isolate')
    scene.set('hardware_emulator', 'faults', [f'rupture:{attack.robot.muscles[1]}'])
    with scene.wrong():
        attack.wait(
            lambda: attack.has_detected,
            'a rupture is detected',
            'rupture of the second muscle',
        )
        attack.call(Trigger, 'controller/stop')
        attack.spin(2.0 * LASTING)
    scene.set('hardware_emulator', 'faults', [''])
    scene.set('estimator', 'on_anomaly', 'stop')
    attack.spin(1.0)
    attack.call(Trigger, 'estimator/restore')


def random_event(scene: Scene) -> None:
    """Trigger one random event: a target, a service, a fault, a suspended node or a false state."""
    attack, rng = scene.attack, scene.rng
    robot = attack.robot
    name = rng.choice(NODES)

    def target() -> None:
        message = JointState(name=robot.joints)
        message.position = [rng.uniform(a, b) for a, b in zip(robot.lower, robot.upper)]
        scene.publish('target_joint_states', message, period=0.0)

    def false_state() -> None:
        message = rng.choice((
            _body(scene, isolated=[rng.randrange(robot.muscle_count)]),
            _body(scene, rng.choice((OFFSET, -OFFSET)), 1e-3),
            _body(scene, anomaly=rng.choice((Anomaly.NONE, Anomaly.FOUND))),
            _body(scene, anomaly=Anomaly.ENDED),
        ))  # fmt: skip
        scene.publish('body_state', message, qos=LATCHED)
        attack.end_strangers()

    def suspend() -> None:
        scene.pause(name)
        attack.spin(rng.uniform(0.1, 3.0))
        scene.resume(name)

    def restart() -> None:
        attack.processes[name].kill()
        attack.tried['kills'] += 1
        attack.start(name)

    def call() -> None:
        service = rng.choice((
            'controller/stop', 'controller/reset', 'estimator/reset', 'estimator/restore',
            'estimator/zero', 'learner/save',
        ))  # fmt: skip
        attack.send(Trigger, service)

    def explore() -> None:
        attack.send(SetBool, 'controller/explore', SetBool.Request(data=rng.random() < 0.7))

    def method() -> None:
        attack.send_parameter('controller', 'method', rng.choice(('proposed', 'tension', 'second')))

    often = (target, explore, call, method, attack.fault, suspend, false_state)
    rng.choice(often * 4 + (restart,))()
    attack.tried['events'] += 1
    attack.spin(rng.uniform(0.05, 0.5))


#: variants of each kind of attack
KINDS: dict[str, tuple[Callable[[Scene], None], ...]] = {
    'lost zeros': (fault('unzeroed:0.05'), fault('unzeroed:0.02')),
    'stop of a verification': (stop_a_verification,),
    'change of method': (change_method('tension'), change_method('geometric', 'tension', 'second')),
    'silent node': tuple(
        without(name, is_paused)
        for name in ('controller', 'sim', 'learner', 'estimator', 'hardware_emulator')
        for is_paused in (False, True)
    ),
    'hot reading': (fault('spike:temperature:199'), fault('bias:temperature:60')),
    'false zeros': (zeros_unknown_then_false, zeros_false, zeros_alternating),
    'false isolation': (isolate_most, isolate_all, isolate_in_turns),
    'denied anomaly': (deny_an_anomaly, deny_and_go),
    'foreign postures': (
        repeat_an_estimate,
        shifted('estimated_joint_states', 0.3),
        shifted('joint_states', 0.3),
    ),
    'second node': (
        second('controller'),
        second('controller', 'other_controller'),
        second('estimator'),
        second('estimator', 'other_estimator'),
        second('learner'),
    ),
    'wrong network': (
        wrong_network(_lengths(0.5)),
        wrong_network(_lengths(1.5)),
        wrong_network(_lengths(1.0, OFFSET)),
        wrong_network(_lengths(1.0, -OFFSET)),
        wrong_network(_lengths(-1.0, every=2)),
        wrong_network(lambda mae: replace(mae, anomaly=None)),
    ),
}


def all_attacks() -> list[tuple[str, int, str]]:
    """Return all combinations of kind, variant and state of the arm."""
    return [
        (kind, shape, moment)
        for kind, shapes in KINDS.items()
        for shape in range(len(shapes))
        for moment in MOMENTS
    ]
