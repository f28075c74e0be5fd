# SPDX-License-Identifier: Apache-2.0
"""The pinocchio wheel is loaded even if a ROS with another pinocchio is sourced.

The pinocchio of ROS may have been compiled for another NumPy; it would then crash the process.
"""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from musculoskeletal_ae.pinocchio_wheel import LIBRARIES

PINOCCHIO = find_spec('pinocchio')
pytestmark = pytest.mark.skipif(
    PINOCCHIO is None or 'cmeel.prefix' not in str(PINOCCHIO.origin),
    reason='this Python has no pinocchio wheel',
)


def test_bindings_and_libraries_of_another_pinocchio_are_passed_over(tmp_path):
    for package in ('pinocchio', 'eigenpy', 'coal'):
        (tmp_path / package).mkdir()
        (tmp_path / package / '__init__.py').write_text('raise SystemExit(139)')
    for library in LIBRARIES:
        (tmp_path / library).touch()  # an empty file, on which the dynamic loader fails
    variables = {
        name: os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get(name)])])
        for name in ('PYTHONPATH', 'LD_LIBRARY_PATH')
    }
    script = 'import musculoskeletal_ae.robot.kinematics, pinocchio; print(pinocchio.__file__)'
    run = subprocess.run(
        [sys.executable, '-c', script],
        cwd=Path(__file__).parents[1],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert 'cmeel.prefix' in run.stdout
