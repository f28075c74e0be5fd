# SPDX-License-Identifier: Apache-2.0
"""Where every executable starts: `--help` loads nothing heavy, and Ctrl-C shows no traceback."""

import faulthandler
import os
import signal
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType

INTERRUPTED = 130


def load(module: str) -> ModuleType:
    """Import what takes a while; on Ctrl-C the process ends, as an import cut short would talk."""
    before = signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    try:
        return import_module(module)
    finally:
        signal.signal(signal.SIGINT, before)


def main() -> int | None:
    """Run the node or tool that this process is named after; return its exit status."""
    name = Path(sys.argv[0]).stem
    # MuJoCo would ask for the library of its windows, by a process that Ctrl-C makes talk.
    os.environ.setdefault('MUJOCO_GL', 'disable')
    # What ends the interpreter itself says where, on stderr (there may be none).
    with suppress(AttributeError, ValueError, RuntimeError, OSError):
        faulthandler.enable()
    try:
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # setup.py says why
            signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        known = load('musculoskeletal_ae.nodes.parameters')
        if name in {**known.PARAMETERS, **known.COMBINED}:
            return load('musculoskeletal_ae.nodes.running').run(name)
        is_tool = Path(__file__).with_name('tools').joinpath(f'{name}.py').exists()
        folder = 'tools' if is_tool else 'nodes'
        return load(f'musculoskeletal_ae.{folder}.{name}').main()
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:  # of what Python does at its end nothing is worth a second Ctrl-C
        signal.signal(signal.SIGINT, signal.SIG_IGN)
