# SPDX-License-Identifier: Apache-2.0
"""The programs of doc/howto/command_from_python.md run as they are printed."""

import re
import sys
from pathlib import Path

import numpy as np
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


def test_the_programs_of_the_guide_move_the_arm_and_break_and_repair_a_muscle(
    graph, arm26, trained_file, tmp_path
):
    move, repair, *_ = PROGRAMS
    arm = ControlledArm(graph, arm26, trained_file)
    assert graph.set_parameter('estimator', 'on_anomaly', 'isolate')[0]
    theta = [-0.5, -1.2]
    target = dict(zip(arm26.joints, theta, strict=True))
    assert run(graph, tmp_path, move, TARGET=target) == 'moving, holding\n'
    arm.goes_to(theta)
    short = move.replace('+ 30.0', '+ 2.0')
    assert run(graph, tmp_path, short, TARGET={'wrist': 0.0}) == 'the target was refused\n'
    muscle = arm26.muscles[int(np.argmax(arm.tension()))]
    printed = run(graph, tmp_path, repair, MUSCLE=muscle)
    assert f"['{muscle}']: set" in printed and "['']: set" in printed and 'restored:' in printed
    assert arm.estimator.core.stream.body.isolated == ()


def test_the_programs_of_the_guide_call_services_set_parameters_and_send_nothing_to_a_stopped_arm(
    graph, arm26, trained_file, tmp_path
):
    move, _, call, set_parameter = PROGRAMS
    arm = ControlledArm(graph, arm26, trained_file)
    assert run(graph, tmp_path, call, 'controller/explore', 'true') == 'done: exploring\n'
    arm.says('exploring')
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
    assert run(graph, tmp_path, set_parameter, *rupture, names) == 'set\n'
    assert arm.hardware.parameter('ruptured_muscles') == (arm26.muscles[0],)
    wrong = *rupture, "['no_muscle']"
    assert 'refused: ' in run(graph, tmp_path, set_parameter, *wrong, expected_status=1)
