# SPDX-License-Identifier: Apache-2.0
"""Mishaps of nodes and topics, which need the real ROS graph: a part of `bench mishaps`.

The whole system of `bench attack` runs on an emulated arm26. A mishap is judged by what users read:
the status line. It is stated truly by the first line that matches `says`, and falsely by each line
that matches `denies`. The operator of `bench attack` then follows the advice of the status line.
"""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from bench.attack_graph import NODES, OWN, Attack
from bench.attack_kinds import Scene
from bench.processes import end_processes

WATCHED = 15.0  # watch the status line for this time while the mishap lasts [s]
ERROR_TIME = 10.0  # measure the true error over this time [s]
#: count statements that blame the computer as false, unless other programs keep it busy
OVERLOADED = 'overloaded|stop other programs'
BUSY = 8  # keep the computer busy with this many programs


class GraphMishap(NamedTuple):
    """A kind of mishap on the graph.

    Attributes:
        name: Name of the mishap in tables.
        begin: Lets the mishap happen; returns the function that ends it, or None if the operator
            of `Scene` has to end it.
        says: Regular expression of status lines that state the mishap truly.
        denies: Regular expression of false status lines, or ''.
        moment: State of the arm before the mishap, 'holding' or 'exploring'.
    """

    name: str
    begin: Callable[[Scene], Callable[[], object] | None]
    says: str
    denies: str = ''
    moment: str = 'exploring'


def killed(node: str) -> Callable[[Scene], None]:
    """Return a mishap in which a node is killed."""

    def begin(scene: Scene) -> None:
        scene.attack.watches_processes = False
        scene.attack.processes[node].kill()

    return begin


def suspended(node: str) -> Callable[[Scene], None]:
    """Return a mishap in which a node is suspended until somebody resumes or restarts it."""
    return lambda scene: scene.pause(node)


def second(node: str) -> Callable[[Scene], Callable[[], object]]:
    """Return a mishap in which a node runs a second time, under another name."""

    def begin(scene: Scene) -> Callable[[], object]:
        scene.attack.start_second(node, f'other_{node}')
        return lambda: None

    return begin


def zeros(scene: Scene) -> Callable[[], object]:
    """Let a second program publish joint angles of 0."""
    attack = scene.attack
    message = JointState(name=attack.robot.joints)
    message.position = [0.0] * attack.robot.joint_count
    publisher = attack.node.create_publisher(JointState, 'joint_states', OWN)
    attack.publishers['joint_states'] = publisher

    def publish() -> None:
        if 'joint_states' in attack.publishers:
            message.header.stamp = attack.node.get_clock().now().to_msg()
            publisher.publish(message)

    timer = attack.node.create_timer(0.01, publish)
    return lambda: attack.node.destroy_timer(timer)


def busy(scene: Scene, *rest: Callable[[Scene], Any]) -> Callable[[], object]:
    """Let other programs keep the computer busy, and then let the mishaps `rest` happen."""
    code = 'while True: pass'
    programs = [subprocess.Popen([sys.executable, '-c', code]) for _ in range(BUSY)]
    scene.attack.spin(5.0)
    for begin in rest:
        begin(scene)
    return lambda: end_processes(programs, signal.SIGKILL)


def stopped_verification(scene: Scene) -> Callable[[], object]:
    """Let an operator stop the arm while a suspect is verified."""
    attack = scene.attack
    scene.set('estimator', 'on_anomaly', 'isolate')
    scene.set('hardware_emulator', 'faults', [f'rupture:{attack.robot.muscles[1]}'])
    attack.wait(lambda: attack.has_detected, 'a rupture is detected', 'second muscle')
    attack.call(Trigger, 'controller/stop')
    return lambda: scene.set('estimator', 'on_anomaly', 'stop')


SEVERAL = 'several|second|other_'
_ALONE = 'no report|silent|died|ended|not running|unresponsive|no usable|too old|stopped'


def _of(node: str) -> str:
    return rf'{node}.*({_ALONE})|({_ALONE}).*{node}'


GRAPH_MISHAPS: tuple[GraphMishap, ...] = (
    *(
        GraphMishap(f'{node} {how}', begin(node), _of(node), OVERLOADED)
        for node in ('controller', 'estimator', 'learner', 'hardware_emulator')
        for how, begin in (('is killed', killed), ('hangs', suspended))
    ),
    GraphMishap(
        'estimator killed on a busy computer',
        lambda scene: busy(scene, killed('estimator')),
        _of('estimator'),
    ),
    GraphMishap('other programs use up the computer', busy, OVERLOADED),
    GraphMishap('a second controller runs', second('controller'), SEVERAL, OVERLOADED),
    GraphMishap('a second estimator runs', second('estimator'), SEVERAL, OVERLOADED),
    GraphMishap('a second source of joint angles', zeros, 'joint_states', OVERLOADED),
    GraphMishap('stop of a verification on the graph', stopped_verification, 'controller/stop'),
)  # fmt: skip


def play(scene: Scene, mishap: GraphMishap, seed: int) -> dict[str, Any] | None:
    """Play a mishap, and recover; return its result, or None if the arm was not ready for it.

    The result has the same keys as those of `bench mishaps`.
    """
    attack = scene.attack
    scene.what = mishap.name
    if not scene.bring(mishap.moment):
        return None
    before = true_error(attack)
    loads, begun = len(attack.loads), time.time()
    broken = sum(map(len, attack.findings.values()))
    end = mishap.begin(scene)
    attack.spin(WATCHED)
    lines = [(at - begun, level, text) for at, level, text in attack.status if at > begun]
    if end is not None:
        end()
    scene.recover(mishap.moment)
    attack.watches_processes = True
    true = [(at, text) for at, _, text in lines if re.search(mishap.says, text)]
    false = {
        f'status line {match[0]}': {'at': round(at, 1), 'text': text}
        for at, _, text in reversed(lines)
        if mishap.denies and (match := re.search(mishap.denies, text)) is not None
    }
    well = sum(map(len, attack.findings.values())) == broken
    ended = '' if well else str([each[-1] for each in attack.findings.values()][-1])
    limit = attack.robot.tension.limit
    pulls = [float((pull / limit).max()) for _, pull in attack.loads[loads:]]
    return {
        'mishap': mishap.name,
        'seed': seed,
        'reality': 'graph',
        'detail': '',
        'effect': 0.0,
        'needs statement': True,
        'true after': round(true[0][0], 2) if true else None,
        'true': true[0][1] if true else '',
        'false': false,
        'afterwards': {},
        'mended by advice': well,
        'well': well,
        'ended': ended[:300],
        'steps': [],
        'error before': round(before, 4),
        'error after': round(true_error(attack), 4),
        'peak': round(max(pulls, default=math.nan), 3),
        'simulated': round(time.time() - begun, 1),
        'cpu': 0.0,
        'lines': sorted({text for _, _, text in lines}),
    }


def true_error(attack: Attack) -> float:
    """Return the median of ‖θ_est − θ‖ [rad] over ERROR_TIME, with θ from the joint sensors.

    The result is NaN if no messages have arrived.
    """
    errors: list[float] = []
    end = time.monotonic() + ERROR_TIME
    while time.monotonic() < end:
        attack.spin(0.2)
        topics = 'joint_states', 'estimated_joint_states'
        both: list[Any] = [attack.genuine[topic] for topic in topics if topic in attack.genuine]
        if len(both) == len(topics):
            measured, estimated = (dict(zip(each.name, each.position)) for each in both)
            gap = [measured[name] - estimated[name] for name in estimated if name in measured]
            errors.append(float(np.linalg.norm(gap)))
    return float(np.median(errors)) if errors else math.nan


def run(
    folder: Path, initial: Path, seed: int, kinds: list[str], keep: Callable[[dict[str, Any]], None]
) -> None:
    """Run the system, and play the named mishaps; call `keep` with each result.

    `seed` selects muscles, joints and sizes. `initial` is the network to start from.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with Attack(folder, initial, seed) as attack:
        scene = Scene(attack)
        attack.wait(lambda: set(attack.levels) == set(NODES), 'every node goes on', 'all nodes')
        attack.spin(30.0)  # let the learner learn from the first postures
        for mishap in GRAPH_MISHAPS:
            if mishap.name in kinds:
                result = play(scene, mishap, seed)
                if result is not None:
                    keep(result)
