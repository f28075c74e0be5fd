# SPDX-License-Identifier: Apache-2.0
"""Prefer the pinocchio wheel of a virtual environment to the pinocchio of a sourced ROS.

A sourced ROS may bring a pinocchio of its own (ros-jazzy-pinocchio of apt), compiled for NumPy 1.
With the NumPy 2 of a virtual environment it ends the process with a segmentation fault. It would
come first in two places: PYTHONPATH lists its bindings before the wheel, and LD_LIBRARY_PATH lists
its libraries, which have the same names, before those that the wheel was linked to.
"""

import ctypes
import os
import sys
from pathlib import Path

#: The libraries of the wheel, each after those that it needs.
LIBRARIES = (
    'libeigenpy.so',
    'libcoal.so',
    'libpinocchio_default.so',
    'libpinocchio_collision.so',
    'libpinocchio_parsers.so',
    'libpinocchio_visualizers.so',
)


def prefer_wheel() -> None:
    """Make `import pinocchio` find the wheel and its own libraries.

    Without the wheel nothing changes: the pinocchio of the system is then imported, and needs the
    NumPy that it was compiled for.
    """
    bindings = next((entry for entry in sys.path if _is_wheel(Path(entry))), None)
    if bindings is None:
        return
    sys.path.remove(bindings)
    sys.path.insert(0, bindings)  # nothing but bindings lies in this folder
    prefix = Path(bindings).parents[2]
    searched = filter(None, os.environ.get('LD_LIBRARY_PATH', '').split(os.pathsep))
    if any(Path(folder, name).exists() for folder in searched for name in LIBRARIES):
        # The loader does not search for a library again whose name it has already loaded.
        for name in LIBRARIES:
            if (prefix / 'lib' / name).exists():
                ctypes.CDLL(str(prefix / 'lib' / name))


def _is_wheel(folder: Path) -> bool:
    """Return whether this is where wheels built by cmeel, such as `pin`, keep their bindings."""
    return 'cmeel.prefix' in folder.parts and (folder / 'pinocchio').is_dir()
