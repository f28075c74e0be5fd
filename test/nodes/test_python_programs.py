# SPDX-License-Identifier: Apache-2.0
"""The programs of doc/howto/command_from_python.md run as they are printed."""

import re
import sys
from pathlib import Path

import pytest
from controlled_arm import ControlledArm
from graph import Process
from std_srvs.srv import Trigger

from musculoskeletal_ae.nodes.controller import ControllerNode

PAGE = Path(__file__).parents[2] / 'doc' / 'howto' / 'command_from_python.md'
PROGRAMS = re.findall(r'```python\n(.*?)```', PAGE.read_text('utf-8'), re.S)


def run(graph, folder, program, *arguments, expected_status=0, **values):
    """Set constants of a program, run it to its end, and return what it prints."""
    for name, value in values.items():
        program, count = re.subn(rf'(?m)^{name} = .*$', f'{name} = {value!r}', program)
        assert count == 1
    file = folder / 'program.py'
    file.write_text(program, encoding='utf-8')
    command = [
        sys.executable,
        str(file),
        *arguments,
        '--ros-args',
        '-r',
        f'__ns:={graph.namespace}',
    ]
    process = Process(file.name, command)
    graph.tools.append(process)
    graph.wait(lambda: not process.alive(), f'the end of the program; it printed {process.output}')
    status, output = process.ended()
    assert status == expected_status, output
    return output


@pytest.fixture
def arm(graph, arm26, trained_file):
    return ControlledArm(graph, arm26, trained_file)


def test_the_first_program_moves_the_arm_unless_it_is_stopped_or_the_target_is_refused(
    graph, arm, tmp_path
):
    move, *_ = PROGRAMS
    theta = [-0.5, -1.2]
    target = dict(zip(arm.robot.joints, theta, strict=True))
    assert graph.call(Trigger, 'controller/stop').success
    printed = run(graph, tmp_path, move, TARGET=target, expected_status=1)
    assert printed == 'stopped:operator_stop: call controller/reset first\n'
    assert arm.controller.core.target_state.theta is None
    assert graph.call(Trigger, 'controller/reset').success
    assert run(graph, tmp_path, move, TARGET=target) == 'moving, holding\n'
    arm.goes_to(theta)
    short = move.replace('+ 30.0', '+ 0.5')
    assert run(graph, tmp_path, short, TARGET={'wrist': 0.0}) == 'the target was refused\n'


def explores_healthily(arm):
    """Wait until the arm explores with all muscles, and check that it has no anomaly."""
    controller, core = arm.controller.core, arm.estimator.core
    arm.graph.wait(
        lambda: controller.supervisor.is_running and controller.supervisor.explores,
        'the arm to explore',
    )
    assert core.cause == ''
    assert core.body.offsets.known
    assert core.body.isolated == ()
    arm.graph.wait(lambda: controller.robot.isolated == (), 'the controller to use all muscles')


# A program that does not wait for the verification must not do any harm either.
HASTY = 'while bodies[-1][1] == VERIFYING:', 'while False:'


@pytest.mark.parametrize(
    ('number', 'is_hasty'), [(1, False), pytest.param(3, True, marks=pytest.mark.thorough)]
)
def test_the_second_program_breaks_and_repairs_a_muscle_and_the_arm_explores_on(
    arm, tmp_path, number, is_hasty
):
    _, repair, *_ = PROGRAMS
    assert repair.count(HASTY[0]) == 1
    arm.controller.core.explore(True)
    explores_healthily(arm)
    muscle = arm.robot.muscles[number]
    printed = run(
        arm.graph, tmp_path, repair.replace(*HASTY) if is_hasty else repair, MUSCLE=muscle
    )
    assert 'isolate: set' in printed
    assert f"['rupture:{muscle}']: set" in printed and "['']: set" in printed
    assert 'restored: isolated: ' in printed
    explores_healthily(arm)
    arm.graph.spin(2.0)  # nothing else is found in the repaired arm
    explores_healthily(arm)


def test_the_other_programs_call_services_and_set_parameters(graph, tmp_path):
    _, _, call, set_parameter = PROGRAMS
    controller = graph.host(ControllerNode, robot='arm26')
    printed = run(graph, tmp_path, call, 'controller/explore', expected_status=1)
    assert 'controller/explore needs a value' in printed
    printed = run(graph, tmp_path, call, 'controller/stop').splitlines()
    assert printed[0] == 'looking for controller/stop' and printed[-1].startswith('done: stopped')
    explore = 'controller/explore', 'true'
    assert 'refused: ' in run(graph, tmp_path, call, *explore, expected_status=1)
    names = 'controller', 'joint_stiffness'
    printed = run(graph, tmp_path, set_parameter, *names, '[1.0, 2.0]')
    assert printed.splitlines()[-1] == 'set'
    assert controller.parameter('joint_stiffness') == (1.0, 2.0)
    assert 'refused: ' in run(graph, tmp_path, set_parameter, *names, '[1.0]', expected_status=1)
