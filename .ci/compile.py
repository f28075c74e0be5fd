# SPDX-License-Identifier: Apache-2.0
"""Fill numba's cache by steps of both emulator models and of the simulator, and by one wrap.

A node that compiles at run time cannot keep its rate, and cannot be stopped meanwhile. The progress
is printed, because compilation takes half a minute on a fast computer, and minutes on a busy one.
"""

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from numba.core import event
from numba.extending import is_jitted

import musculoskeletal_ae
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.description import Wrap
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

PACKAGE = Path(musculoskeletal_ae.__path__[0])


def import_functions() -> None:
    """Import all modules with compiled functions, so that their number is known at the start."""
    for file in sorted(PACKAGE.rglob('*.py')):
        if 'njit' in file.read_text(encoding='utf-8'):
            names = file.relative_to(PACKAGE.parent).with_suffix('').parts
            import_module('.'.join(names))


def functions_to_compile() -> set[str]:
    """Return the names of the compiled functions of all imported modules of the package."""
    return {
        _name(function)
        for module_name, module in list(sys.modules.items())
        if module_name.startswith('musculoskeletal_ae.')
        for function in vars(module).values()
        if is_jitted(function)
    }


def _name(function: Any) -> str:
    return f'{function.py_func.__module__}.{function.py_func.__qualname__}'


class Progress(event.Listener):
    """Prints how many functions of the package have been compiled."""

    def __init__(self) -> None:
        self._functions = functions_to_compile()
        self._compiled: set[str] = set()

    def on_start(self, compilation: event.Event) -> None:
        """Do nothing: the end of a compilation counts."""

    def on_end(self, compilation: event.Event) -> None:
        """Count a function; numba may compile it several times, for several types."""
        name = _name(compilation.data['dispatcher'])
        if name in self._functions and name not in self._compiled:
            self._compiled.add(name)
            print(f'compiling: {len(self._compiled)} of {len(self._functions)}', flush=True)


def compute_wrap(robot: Robot) -> None:
    """Compute the lengths of a robot with a wrap; no shipped robot has one."""
    (start, *rest), *others = robot.description.routes
    sphere = Wrap(start.link, start.xyz + 0.05, radius=0.01, axis=None, side=None)
    robot.with_routes([(start, sphere, *rest), *others])  # computes the lengths at θ = 0


import_functions()
with event.install_listener('numba:compile', Progress()):
    robot = Robot.load('arm26')
    for reality in ('kin', 'foreign'):
        make_arm(robot, seed=0, reality=reality).step(0.001)
    # Networks of the presets have different activations, and one simulator runs them all.
    for preset in PRESETS:
        Simulation(robot, initial_mae(robot, preset, steps=1)).step(0.01)
    compute_wrap(robot)
