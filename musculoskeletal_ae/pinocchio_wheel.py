# SPDX-License-Identifier: Apache-2.0
"""Prefer the pinocchio wheel of a virtual environment to the pinocchio of a sourced ROS.

A sourced ROS may provide its own pinocchio (apt package ros-jazzy-pinocchio), compiled for NumPy 1.
In a virtual environment with NumPy 2, the pinocchio of ROS crashes the process with a segmentation
fault. Without this module, Python would import the pinocchio of ROS instead of the wheel:
PYTHONPATH lists its bindings before those of the wheel, and LD_LIBRARY_PATH lists its libraries
before the libraries of the wheel, which have the same names.
"""

import ctypes
import os
import sys
from pathlib import Path

#: libraries of the wheel, each listed after those on which it depends
LIBRARIES = (
    'libeigenpy.so',
    'libcoal.so',
    'libpinocchio_default.so',
    'libpinocchio_collision.so',
    'libpinocchio_parsers.so',
    'libpinocchio_visualizers.so',
)


def prefer_wheel() -> None:
    """Make `import pinocchio` load the wheel with its own libraries.

    If there is no wheel, the function does nothing. Python then imports the system's pinocchio,
    which requires the NumPy for which it was compiled.
    """
    bindings = next((entry for entry in sys.path if _is_wheel(Path(entry))), None)
    if bindings is None:
        return
    sys.path.remove(bindings)
    sys.path.insert(0, bindings)  # this folder contains only pinocchio and its dependencies
    prefix = Path(bindings).parents[2]
    searched = filter(None, os.environ.get('LD_LIBRARY_PATH', '').split(os.pathsep))
    if any(Path(folder, name).exists() for folder in searched for name in LIBRARIES):
        # Load the wheel's libraries first: the dynamic loader then reuses them instead of searching
        # for libraries of the same names.
        for name in LIBRARIES:
            if (prefix / 'lib' / name).exists():
                ctypes.CDLL(str(prefix / 'lib' / name))


def _is_wheel(folder: Path) -> bool:
    """Return whether a folder contains pinocchio's bindings from a wheel that cmeel built."""
    return 'cmeel.prefix' in folder.parts and (folder / 'pinocchio').is_dir()
