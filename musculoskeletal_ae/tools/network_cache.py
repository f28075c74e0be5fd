# SPDX-License-Identifier: Apache-2.0
"""The cache of initial networks, which `bringup.sh` and `train --from-bag` share.

    python -m musculoskeletal_ae.executables tools.network_cache ROBOT PRESET [quick]

prints the file of an initial network for bringup.sh, and creates its directory. With `quick`, the
file is that of a shortened training, unless a network with the complete training exists.

The name of the file contains a hash of everything that determines the network: the two files of the
robot directory, and the code that reads them and trains. Another robot, or another version of the
package, therefore has another file. The network is trained with the default seed.

This module imports nothing slow.
"""

import hashlib
import os
import sys
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.directories import find_robot

PACKAGE = Path(__file__).resolve().parents[1]
#: hash these files and directories of the package, because they determine an initial network
CODE = (
    'robot',
    'mae',
    'presets',
    'paper',  # contains the initial training (§III-B of the paper)
    'tools/model_training.py',
)
ROBOT_FILES = 'robot.urdf', 'muscles.yaml'


def network_file(robot: str | Path, preset: str, quick: bool = False) -> Path:
    """Return the file in the cache for the initial network of a robot; it may not exist.

    Args:
        robot: A shipped robot or a robot directory.
        preset: Name of the preset that trains the network.
        quick: Whether the network is trained with `train --quick`.

    Raises:
        MusculoskeletalError: If there is no such robot, or no place for a cache.
    """
    directory = find_robot(robot).resolve()
    digest = hashlib.sha256()
    for name, file in _sources(directory):
        data = file.read_bytes()
        digest.update(f'{name} {len(data)}\n'.encode())
        digest.update(data)
    kind = f'{preset}-quick' if quick else preset
    name = f'{directory.name}-{kind}-{digest.hexdigest()[:16]}.safetensors'
    return _cache_directory() / name


def _sources(directory: Path) -> list[tuple[str, Path]]:
    """Return the files that determine the initial network of a robot, each with its name."""
    files = [(name, directory / name) for name in ROBOT_FILES if (directory / name).is_file()]
    for part in CODE:
        code = PACKAGE / part
        listed = [code] if code.is_file() else sorted(code.rglob('*'))
        files += [
            (file.relative_to(PACKAGE).as_posix(), file)
            for file in listed
            if file.suffix in ('.py', '.yaml')
        ]
    return files


def _cache_directory() -> Path:
    home = os.environ.get('XDG_CACHE_HOME') or '~/.cache'
    try:
        return Path(home).expanduser() / 'musculoskeletal_ae'
    except RuntimeError as error:
        problem = 'the home directory is unknown; set HOME, or XDG_CACHE_HOME to a directory'
        raise MusculoskeletalError(problem) from error


def main(arguments: list[str]) -> int:
    """Print the file of an initial network; return the exit status."""
    robot, preset, *quick = arguments
    try:
        file = network_file(robot, preset)
        if quick and not file.is_file():  # otherwise, the network with the complete training exists
            file = network_file(robot, preset, True)
        file.parent.mkdir(parents=True, exist_ok=True)
    except (MusculoskeletalError, OSError) as error:
        remedy = '; set XDG_CACHE_HOME to a folder that can be written'
        advice = remedy if isinstance(error, OSError) else ''
        print(f'cache of initial networks: {error}{advice}', file=sys.stderr)
        return 1
    print(file)
    return 0
