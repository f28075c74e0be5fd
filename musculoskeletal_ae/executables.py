# SPDX-License-Identifier: Apache-2.0
"""The executables, one function each; setup.py lists them as console scripts.

This module imports nothing heavy. Hence `--help` answers quickly, and signals are handled before
torch and rclpy are loaded. On Ctrl-C, SIGTERM or SIGHUP, nodes exit with status 0 and tools with
130. `record` and `replay` exit with 0, because Ctrl-C is how a user normally ends them. An
interrupted tool prints what it has written. No executable prints a traceback.
"""

import ast
import faulthandler
import os
import sys
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path

from musculoskeletal_ae.output import secure_output
from musculoskeletal_ae.process_signals import INTERRUPTED, STOP, Reaction


def _prepare_process() -> None:
    """Prepare terminal output, crash reports and the import of MuJoCo.

    A native crash prints the stacks of all threads. An environment variable stops MuJoCo from
    loading a graphics library; otherwise the import could start processes that look for a display.
    """
    secure_output()
    os.environ.setdefault('MUJOCO_GL', 'disable')
    with suppress(AttributeError, ValueError, RuntimeError, OSError):  # stderr may be no file
        faulthandler.enable()


def _run_node(name: str) -> int:
    """Run the nodes of an executable in this process; return the exit status."""
    _prepare_process()
    STOP.install(Reaction.EXIT, exit_status=0)
    if {'--help', '-h'} & set(sys.argv[1:]):
        print(_node_help(name))
        return 0
    try:
        status = int(import_module('musculoskeletal_ae.nodes.running').run(name))
    finally:
        STOP.ignore()
    _end_process(status)
    return status


def _end_process(status: int) -> None:
    """End the process without garbage collection.

    The nodes, the ROS context and the child processes must have ended before. An ordinary exit
    would garbage-collect the objects of torch, numba and pinocchio. On a busy machine that takes up
    to ten seconds, during which the node appears to hang.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _node_help(name: str) -> str:
    """Return the help of an executable: docstrings and parameters of its nodes.

    The nodes are not imported, because that would take too long.
    """
    from musculoskeletal_ae.nodes.declared_parameters import COMBINED, help_text

    parts = []
    for node in COMBINED.get(name, (name,)):
        source = Path(__file__).with_name('nodes') / f'{node}.py'
        parts.append(ast.get_docstring(ast.parse(source.read_text(encoding='utf-8'))) or '')
    return '\n\n'.join([*parts, help_text(name)])


def _run_tool(module: str) -> int:
    """Run the function `main` of a tool's module and return the exit status."""
    _prepare_process()
    STOP.install(Reaction.EXIT)
    main = import_module(f'musculoskeletal_ae.{module}').main
    try:
        with STOP.reacting(Reaction.RAISE):
            return int(main())
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        STOP.ignore()


# Nodes
bringup_status = partial(_run_node, 'bringup_status')
combined = partial(_run_node, 'combined')
controller = partial(_run_node, 'controller')
estimator = partial(_run_node, 'estimator')
hardware_emulator = partial(_run_node, 'hardware_emulator')
learner = partial(_run_node, 'learner')
sim = partial(_run_node, 'sim')

# Tools on the ROS graph
check_driver = partial(_run_tool, 'ros_tools.check_driver')
record = partial(_run_tool, 'ros_tools.record')
render = partial(_run_tool, 'ros_tools.render')
replay = partial(_run_tool, 'ros_tools.replay')
view = partial(_run_tool, 'ros_tools.view')

# Tools without ROS
check_robot = partial(_run_tool, 'tools.check_robot')
experiment = partial(_run_tool, 'tools.experiment')
export_mjcf = partial(_run_tool, 'tools.export_mjcf')
fit_series_elastic = partial(_run_tool, 'tools.fit_series_elastic')
import_robot = partial(_run_tool, 'tools.import_robot')
train = partial(_run_tool, 'tools.train')


def _help_bringup(module: str, arguments: list[str]) -> int:
    """Run the function `main` of a module for bringup.sh; return the exit status.

    On Ctrl-C, the process ends at once and silently.
    """
    _prepare_process()
    STOP.install(Reaction.EXIT)
    try:
        return int(import_module(f'musculoskeletal_ae.{module}').main(arguments))
    finally:
        STOP.ignore()


if __name__ == '__main__':  # python -m musculoskeletal_ae.executables MODULE ARGUMENT…
    sys.exit(_help_bringup(sys.argv[1], sys.argv[2:]))
