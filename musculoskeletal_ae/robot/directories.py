# SPDX-License-Identifier: Apache-2.0
"""Find robot directories: shipped robots by name, others by path.

This module imports nothing slow, because the help texts of commands list the shipped robots.
"""

from pathlib import Path

from musculoskeletal_ae.exceptions import RobotDescriptionError


def shipped_robots() -> dict[str, Path]:
    """Return the directories of the shipped robots by name."""
    here = Path(__file__).resolve()
    roots = [here.parents[2] / 'config']
    # colcon installs this file as <prefix>/lib/pythonX.Y/site-packages/musculoskeletal_ae/robot/…
    roots += [up / 'share' / 'musculoskeletal_ae' / 'config' for up in here.parents]
    shipped: dict[str, Path] = {}
    for root in roots:
        for file in sorted(root.glob('*/muscles.yaml')):
            shipped.setdefault(file.parent.name, file.parent)
    return shipped


def find_robot(robot: str | Path) -> Path:
    """Return the directory of a robot.

    Args:
        robot: The name of a shipped robot, or the path of a robot directory.

    Raises:
        RobotDescriptionError: If `robot` is neither.
    """
    shipped = shipped_robots()
    if str(robot) in shipped:
        return shipped[str(robot)]
    is_file = False
    try:
        directory = Path(robot).expanduser()
        is_file = directory.is_file()
        if str(robot) and directory.is_dir():
            return directory.resolve()
    except (RuntimeError, ValueError, OSError):  # unknown home directory, NUL or too long a name
        pass
    if is_file:
        raise RobotDescriptionError(
            f'robot {str(robot)!r} is a file; name the directory that has robot.urdf and '
            'muscles.yaml. `import_robot FILE --out DIR` makes one from a MuJoCo or CARDSflow model'
        )
    raise RobotDescriptionError(
        f'robot {str(robot)!r} is neither a directory nor a shipped robot '
        f'({", ".join(sorted(shipped))}); use one of these names, or a directory with '
        'robot.urdf and muscles.yaml'
    )
