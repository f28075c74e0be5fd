# SPDX-License-Identifier: Apache-2.0
"""The programs of doc/howto/command_from_python.md run as they are printed."""

import re
import sys
from pathlib import Path

import pytest
from controlled_arm import ControlledArm
from graph import Process

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


def test_the_first_program_moves_the_arm_and_says_if_a_target_is_refused(arm, tmp_path):
    move, *_ = PROGRAMS
    theta = [-0.5, -1.2]
    target = dict(zip(arm.robot.joints, theta, strict=True))
    assert run(arm.graph, tmp_path, move, TARGET=target) == 'moving, holding\n'
    arm.goes_to(theta)
    short = move.replace('+ 30.0', '+ 2.0')
    assert run(arm.graph, tmp_path, short, TARGET={'wrist': 0.0}) == 'the target was refused\n'


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
HASTY = 'while detected[-1]:', 'while False:'


@pytest.mark.parametrize(('number', 'is_hasty'), [(1, False), (3, True)])
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
    assert f"['{muscle}']: set" in printed and "['']: set" in printed
    assert 'restored: isolated: ' in printed
    explores_healthily(arm)
    arm.graph.spin(5.0)  # nothing else is found in the repaired arm
    explores_healthily(arm)


def test_the_programs_of_the_guide_call_services_set_parameters_and_send_nothing_to_a_stopped_arm(
    graph, arm, arm26, tmp_path
):
    move, _, call, set_parameter = PROGRAMS
    printed = run(graph, tmp_path, call, 'controller/explore', 'true').splitlines()
    assert printed[0] == 'looking for controller/explore' and printed[-1] == 'done: exploring'
    arm.says('exploring')
    for service, *value in ('controller/explore',), ('estimator/reset', 'true'):
        printed = run(graph, tmp_path, call, service, *value, expected_status=1)
        assert f'{service} ' + ('takes no value' if value else 'needs a value') in printed
    assert 'done: stopped' in run(graph, tmp_path, call, 'controller/stop')
    target = dict.fromkeys(arm26.joints, 0.0)
    printed = run(graph, tmp_path, move, TARGET=target, expected_status=1)
    assert printed == 'stopped:operator_stop: call controller/reset first\n'
    assert arm.controller.core.target_state.theta is None
    explore = 'controller/explore', 'true'
    assert 'refused: ' in run(graph, tmp_path, call, *explore, expected_status=1)
    assert 'done: ' in run(graph, tmp_path, call, 'controller/reset')
    names = f"['{arm26.muscles[0]}']"
    rupture = 'hardware_emulator', 'ruptured_muscles'
    assert run(graph, tmp_path, set_parameter, *rupture, names).splitlines()[-1] == 'set'
    assert arm.hardware.parameter('ruptured_muscles') == (arm26.muscles[0],)
    wrong = *rupture, "['no_muscle']"
    assert 'refused: ' in run(graph, tmp_path, set_parameter, *wrong, expected_status=1)
