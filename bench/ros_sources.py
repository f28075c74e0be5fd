# SPDX-License-Identifier: Apache-2.0
"""Builds ROS 2 packages that are not on PyPI, and installs them beside the ROS wheels.

    python -m bench ros_sources control_msgs    # the action of the controller
    python -m bench ros_sources rclpy==7.1.11   # another version of rclpy

Each package is cloned from the release repository that the packages of apt are built from, and
compiled against the ROS wheels in a separate virtual environment. The result is a wheel, which pip
installs into the virtual environment of this Python, so `pip uninstall ros-control-msgs` removes
it. The bench requires git, a C++ compiler and the headers of Python. It takes one to three minutes
a package.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import Parser

ROOT = Path(__file__).resolve().parents[1]
REQUIREMENTS = ROOT / '.ci' / 'requirements-ros.txt', ROOT / '.ci' / 'requirements-ros-build.txt'
#: remove these paths of the machine that built the wheels from the CMake files in the wheels
BUILD_PATHS = re.compile(r'/(?:opt/python|usr/lib64)/[^";]*')


class Release(NamedTuple):
    """The release repository of a package, and the version that is built by default."""

    repository: str
    version: str

    def url(self) -> str:
        """Return the address of the release repository."""
        return f'https://github.com/ros2-gbp/{self.repository}-release'


RELEASES = {
    'control_msgs': Release('control_msgs', '5.9.0'),
    'rclpy': Release('rclpy', '7.1.11'),
}


class Builder:
    """Builds wheels of ROS packages in a working folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.venv = folder / 'venv'
        self.python = self.venv / 'bin' / 'python'
        version = f'python{sys.version_info[0]}.{sys.version_info[1]}'
        self.site_packages = self.venv / 'lib' / version / 'site-packages'

    def run(self, title: str, *command: str | Path) -> str:
        """Run a command, after printing `title`; return its standard output.

        Raises:
            MusculoskeletalError: If the command fails. The end of its output has then been printed.
        """
        print(f'   {title}', flush=True)
        ended = subprocess.run(
            command, cwd=self.folder, env=self._environment(), text=True, errors='replace',
            stdin=subprocess.DEVNULL, capture_output=True,
        )  # fmt: skip
        output = ended.stdout + ended.stderr
        with (self.folder / 'log.txt').open('a', encoding='utf-8') as log:
            log.write(f'\n== {title}\n{output}')
        if ended.returncode != 0:
            print(*output.splitlines()[-25:], sep='\n', file=sys.stderr)
            raise MusculoskeletalError(
                f'{title}: status {ended.returncode}; see {self.folder / "log.txt"}'
            )
        return ended.stdout

    def _environment(self) -> dict[str, str]:
        libraries = [self.venv / 'lib', *sorted(self.site_packages.glob('ros_*.libs'))]
        removed = ('PYTHONPATH', 'AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH')
        return {
            **{name: value for name, value in os.environ.items() if name not in removed},
            'GIT_TERMINAL_PROMPT': '0',
            'VIRTUAL_ENV': str(self.venv),
            'PATH': f'{self.venv / "bin"}{os.pathsep}{os.environ["PATH"]}',
            'AMENT_PREFIX_PATH': str(self.venv),
            'LD_LIBRARY_PATH': os.pathsep.join(map(str, libraries)),
        }

    def prepare(self) -> None:
        """Prepare a virtual environment with the ROS wheels and the build tools."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.run('a virtual environment', sys.executable, '-m', 'venv', self.venv)
        files = (argument for file in REQUIREMENTS for argument in ('-r', file))
        self.run('the ROS wheels and the build tools', self.python, '-m', 'pip', 'install', *files)
        for file in self.venv.glob('share/*/cmake/*.cmake'):
            text = file.read_text('utf-8')
            if BUILD_PATHS.search(text):
                file.write_text(BUILD_PATHS.sub('', text), 'utf-8')

    def build(self, name: str, version: str) -> Path:
        """Build a version of the ROS package `name`, and return the path of its wheel."""
        print(f'-- {name} {version}', flush=True)
        tag, url = self.tag(name, version), RELEASES[name].url()
        stem = f'ros_{name}-{version}'
        source, build, wheel = (self.folder / part / stem for part in ('source', 'build', 'wheel'))
        for folder in (source, build, wheel):
            shutil.rmtree(folder, ignore_errors=True)
        clone = ('git', '-c', 'advice.detachedHead=false', 'clone', '--depth', '1')
        self.run(f'cloning {tag}', *clone, '--branch', tag, url, source)
        pybind11 = self.site_packages / 'pybind11' / 'share' / 'cmake' / 'pybind11'
        options = {
            'BUILD_TESTING': 'OFF',
            'CMAKE_BUILD_TYPE': 'Release',
            # Otherwise pybind11 optimizes at link time, which takes longer than compiling.
            'CMAKE_INTERPROCEDURAL_OPTIMIZATION': 'OFF',
            'CMAKE_INSTALL_PREFIX': wheel / f'{stem}.data' / 'data',
            'CMAKE_PREFIX_PATH': self.venv,
            'Python3_EXECUTABLE': self.python,
            'pybind11_DIR': pybind11,
        }
        definitions = (f'-D{key}={value}' for key, value in options.items())
        cmake = self.venv / 'bin' / 'cmake'
        self.run('configuring', cmake, '-G', 'Ninja', '-S', source, '-B', build, *definitions)
        self.run('compiling', cmake, '--build', build)
        self.run('installing', cmake, '--install', build)
        return self._pack(name, version, wheel)

    def tag(self, name: str, version: str) -> str:
        """Return the git tag of the newest release of a package in this version."""
        url, prefix = RELEASES[name].url(), f'release/jazzy/{name}/'
        listed = self.run('looking up the release', 'git', 'ls-remote', '--tags', url, f'{prefix}*')
        tags = re.findall(rf'refs/tags/{prefix}([\d.]+)-(\d+)$', listed, re.M)
        increments = [int(increment) for each, increment in tags if each == version]
        if not increments:
            legal = sorted({each for each, _ in tags}, key=lambda v: [*map(int, v.split('.'))])
            raise MusculoskeletalError(f'{name} {version} is no release; legal: {", ".join(legal)}')
        return f'{prefix}{version}-{max(increments)}'

    def _pack(self, name: str, version: str, wheel: Path) -> Path:
        python = f'cp{sys.version_info[0]}{sys.version_info[1]}'
        platform = re.sub(r'\W', '_', sysconfig.get_platform())
        information = wheel / f'ros_{name}-{version}.dist-info'
        information.mkdir(exist_ok=True)
        (information / 'METADATA').write_text(
            f'Metadata-Version: 2.1\nName: ros-{name.replace("_", "-")}\nVersion: {version}\n'
        )
        (information / 'WHEEL').write_text(
            'Wheel-Version: 1.0\nGenerator: musculoskeletal_ae\nRoot-Is-Purelib: false\n'
            f'Tag: {python}-{python}-{platform}\n'
        )
        self.run('packing a wheel', self.python, '-m', 'wheel', 'pack', wheel, '-d', self.folder)
        return self.folder / f'ros_{name}-{version}-{python}-{python}-{platform}.whl'


def _requirement(text: str) -> tuple[str, str]:
    """Return name and version of a package such as rclpy or rclpy==7.1.11."""
    name, _, version = text.partition('==')
    if name not in RELEASES:
        raise argparse.ArgumentTypeError(
            f'unknown package {name!r}; legal: {", ".join(RELEASES)}, or one of them with a '
            'version, as in rclpy==7.1.11'
        )
    return name, version or RELEASES[name].version


def _check_machine() -> None:
    try:
        metadata.version('ros-rclpy')
    except metadata.PackageNotFoundError as error:
        raise MusculoskeletalError(
            f'the ROS wheels are not installed in {sys.prefix}. Run ./bringup.sh first, and start '
            'this bench with .venv/bin/python. If ROS 2 Jazzy is installed, use apt-get instead: '
            'ros-jazzy-control-msgs.'
        ) from error
    header = Path(sysconfig.get_path('include'), 'Python.h')
    found = {
        'git': shutil.which('git'),
        'g++': shutil.which(os.environ.get('CXX', 'c++')),
        'python3-dev': header.exists(),
    }
    if missing := ' '.join(name for name in found if not found[name]):
        raise MusculoskeletalError(
            f'this machine lacks {missing}. On Debian or Ubuntu: sudo apt-get install {missing}'
        )


def _options(argv: list[str]) -> argparse.Namespace:
    parser = Parser('ros_sources', 'Builds ROS 2 packages that are not on PyPI, and installs them.')
    parser.add_argument(
        'packages', nargs='+', type=_requirement, metavar='PACKAGE[==VERSION]',
        help=', '.join(RELEASES),
    )  # fmt: skip
    text = 'working folder with sources, build and wheels'
    parser.add_argument(
        '--folder', type=Path, metavar='DIR', default=Path('build/ros_sources'), help=text
    )
    return parser.parse_args(argv)


def main(argv: list[str]) -> int:
    """Build the wheels of packages, and install them into the environment of this Python."""
    options = _options(argv)
    _check_machine()
    version = f'{sys.version_info[0]}.{sys.version_info[1]}'
    builder = Builder((options.folder / f'python{version}').resolve())
    builder.prepare()
    wheels = [builder.build(name, version) for name, version in options.packages]
    subprocess.run(
        [sys.executable, '-m', 'pip', 'install', '--no-deps', '--force-reinstall', *wheels],
        check=True,
    )
    return 0
