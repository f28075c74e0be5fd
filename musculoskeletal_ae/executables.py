# SPDX-License-Identifier: Apache-2.0
"""The executables, one function each: setup.py lists them as console scripts.

This module imports nothing heavy, so that `--help` answers at once, and signals are handled before
torch and rclpy are loaded. On Ctrl-C and SIGTERM a node ends with status 0. A tool ends with 130,
but `record` and `replay`, whose ordinary end that is, with 0. None of them shows a traceback.
"""

import ast
import faulthandler
import os
import sys
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path

from musculoskeletal_ae.exceptions import replace_unprintable
from musculoskeletal_ae.stop_signals import INTERRUPTED, STOP, Reaction


def _prepare_process() -> None:
    """Make a native crash print where it happened, and let MuJoCo load no graphics library.

    With glfw, importing MuJoCo would start processes that look for a display.
    """
    replace_unprintable()
    os.environ.setdefault('MUJOCO_GL', 'disable')
    with suppress(AttributeError, ValueError, RuntimeError, OSError):  # stderr may be closed
        faulthandler.enable()


def _run_node(name: str) -> int:
    """Run a node, or several in one process; return the exit status."""
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
    """End a process whose nodes, ROS context and child processes have ended already.

    Python would first collect as garbage all that torch, numba and pinocchio have made. On a busy
    machine that takes up to ten seconds, and whoever waits for the end takes the node to hang.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _node_help(name: str) -> str:
    """Return the docstrings of the nodes, read without importing them, and their parameters."""
    from musculoskeletal_ae.nodes.parameters import COMBINED, help_text

    parts = []
    for node in COMBINED.get(name, (name,)):
        source = Path(__file__).with_name('nodes') / f'{node}.py'
        parts.append(ast.get_docstring(ast.parse(source.read_text(encoding='utf-8'))) or '')
    return '\n\n'.join([*parts, help_text(name)])


def _run_tool(module: str) -> int:
    """Run the `main` of a tool; return the exit status."""
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
check_driver = partial(_run_tool, 'nodes.check_driver')
record = partial(_run_tool, 'nodes.record')
render = partial(_run_tool, 'nodes.render')
replay = partial(_run_tool, 'nodes.replay')
view = partial(_run_tool, 'nodes.view')

# Tools without ROS
check_robot = partial(_run_tool, 'tools.check_robot')
experiment = partial(_run_tool, 'tools.experiment')
export_mjcf = partial(_run_tool, 'tools.export_mjcf')
fit_series_elastic = partial(_run_tool, 'tools.fit_series_elastic')
import_robot = partial(_run_tool, 'tools.import_robot')
train = partial(_run_tool, 'tools.train')
