# SPDX-License-Identifier: Apache-2.0
"""Creates each platform of doc/howto/install.md, starts the system there, and runs tests.

python -m bench platforms                          # all of them
python -m bench platforms wheels-3.13 sourced      # some
python -m bench platforms --node wheels-3.12       # without torch: the core and one node
python -m bench platforms rclpy-7.1.11             # needs git access to GitHub, and a C++ compiler

Without --node, each platform has a clean clone of the committed state, where ./bringup.sh installs
the dependencies. With --node, the sources of this folder run in a virtual environment of the
platform. The folder of a platform is deleted when the platform has passed.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import Parser

ROOT = Path(__file__).resolve().parents[1]
ROS_REQUIREMENTS = ROOT / '.ci' / 'requirements-ros.txt'
#: packages that `--node` installs: all that the core and the estimator import
NODE_REQUIREMENTS = ('numpy', 'pin', 'safetensors', 'msgspec', 'PyYAML')
#: versions that Ubuntu 24.04 ships, which the emulated system must contain
UBUNTU = ('numpy==1.26.4', 'scipy==1.11.4', 'matplotlib==3.8.4', 'PyYAML==6.0.1', 'lark==1.1.9')
#: a pinocchio compiled for NumPy 1, like the one of apt
APT_PINOCCHIO = ('pin==2.7.0', 'numpy==1.26.4')
DEBIAN_PACKAGES = 'python3,ca-certificates,procps,util-linux'
BRINGUP = ('--robot', 'arm26', '--duration', '10')
#: tests of parts that depend on the platform: arithmetic, compiled libraries, files, processes and
#: rclpy
TESTS = (
    'test/robot/test_kinematics.py',
    'test/robot/test_wrapping.py',
    'test/robot/test_description.py',
    'test/signals/test_muscle_stream.py',
    'test/mae/test_checkpoint.py',
    'test/emulator/test_arm.py',
    'test/emulator/test_wrapping.py',
    'test/bags/test_writer.py',
    'test/bags/test_reader.py',
    'test/nodes/test_executor.py',
    'test/nodes/test_hardware_emulator.py',
    'test/nodes/test_markers.py',
    'test/nodes/test_follow_joint_trajectory.py',
    'test/test_pinocchio_wheel.py',
)
#: tests of the platforms that differ in rclpy only
NODE_TESTS = ('test/nodes',)
#: commands that install the dependencies of the tests, as ./test.sh does
SET_UP = ('repository=$PWD', '. .ci/environment.sh', 'environment_setup test')
KEPT = ('LANG', 'PATH', 'ROS_DOMAIN_ID', 'TERM', 'TMPDIR')
KEPT_PREFIXES = ('PIP_', 'SSL_', 'http', 'https', 'no_proxy', 'GIT_CONFIG')


@dataclass
class Site:
    """One platform: its clone, its log, and the commands that enter it."""

    folder: Path
    setup: list[str] = field(default_factory=list)  # shell lines that precede every command
    inside: list[str] = field(default_factory=list)  # words of the command that enters the platform
    clone_inside: str = ''  # path of the clone as seen on the platform, if it differs from `clone`

    @property
    def clone(self) -> Path:
        """Path of the platform's clone of the repository."""
        return self.folder / 'clone'

    @property
    def log(self) -> Path:
        """Log file with the output of all commands."""
        return self.folder / 'log.txt'

    def run(self, title: str, *lines: str, on_platform: bool = False) -> str:
        """Run shell lines on the host, or on the platform; return their output.

        `title` is printed first.

        Raises:
            MusculoskeletalError: If a line fails. The end of the output has then been printed.
        """
        print(f'   {title}', flush=True)
        script, command = ['set -e', *lines], ['bash', '-c']
        if on_platform:
            clone = shlex.quote(self.clone_inside or str(self.clone))
            script = ['set -e', *self.setup, f'cd {clone}', *lines]
            command = [*self.inside, *command]
        ended = subprocess.run(
            [*command, '\n'.join(script)],
            cwd=self.folder, env=_environment(self.folder), text=True, errors='replace',
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        with self.log.open('a', encoding='utf-8') as log:
            log.write(f'\n== {title}\n{ended.stdout}')
        if ended.returncode != 0:
            print(*ended.stdout.splitlines()[-25:], sep='\n', file=sys.stderr)
            raise MusculoskeletalError(f'{title}: status {ended.returncode}; see {self.log}')
        return ended.stdout


def _environment(home: Path) -> dict[str, str]:
    """Return the variables of a login shell without ROS and without this virtual environment."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name in KEPT or name.startswith(KEPT_PREFIXES)
    }
    paths = kept.get('PATH', '').split(os.pathsep)
    kept['PATH'] = os.pathsep.join(path for path in paths if not path.startswith(sys.prefix))
    # By default, pip's cache is in HOME, which changes below. Keep the user's cache, so that pip
    # does not download all packages again.
    kept.setdefault('PIP_CACHE_DIR', str(Path.home() / '.cache' / 'pip'))
    return {**kept, 'HOME': str(home)}


def interpreter(version: str) -> Path | None:
    """Return the path of a Python of `version`, such as 3.12.

    The result is None if neither PATH nor pyenv has this version.
    """
    pyenv = Path(os.environ.get('PYENV_ROOT', Path.home() / '.pyenv')) / 'versions'
    candidates = [shutil.which(f'python{version}')]
    candidates += map(str, sorted(pyenv.glob(f'{version}.*/bin/python')))
    for candidate in filter(None, candidates):
        # A candidate on PATH may be a shim of pyenv. It runs no Python, but reports an error, if
        # pyenv has not selected this version.
        script = 'import sys, venv; print("%d.%d" % sys.version_info[:2])'
        run = subprocess.run([candidate, '-c', script], capture_output=True, text=True)
        if run.stdout.strip() == version:
            return Path(candidate)
    return None


def _needed(version: str) -> Path:
    python = interpreter(version)
    if python is None:
        raise MusculoskeletalError(f'python{version} is neither on PATH nor in pyenv; install it')
    return python


# --- the platforms -------------------------------------------------------------------------------


def _wheels(version: str) -> Callable[[Site], None]:
    def make(site: Site) -> None:
        site.setup = [f'export PYTHON={shlex.quote(str(_needed(version)))}']

    return make


def _sourced(site: Site) -> None:
    """Emulate Ubuntu 24.04 with a sourced /opt/ros/jazzy, by means of the ROS wheels.

    The system's Python is a copy with the packages of Ubuntu. The wheels are unpacked into a
    prefix, which a setup.bash like that of ROS puts on the paths.
    """
    python, system, jazzy = _needed('3.12'), site.folder / 'system', site.folder / 'jazzy'
    base = Path(
        subprocess.run(
            [python, '-c', 'import sys; print(sys.base_prefix)'],
            capture_output=True, text=True, check=True,
        ).stdout.strip()
    )  # fmt: skip
    if base == Path('/usr'):
        raise MusculoskeletalError(
            'Python 3.12 is installed in /usr, which cannot be copied; install another one with '
            'pyenv'
        )
    packages = 'lib/python3.12/site-packages'
    system_python = system / 'bin' / 'python3.12'
    site.run(
        "Ubuntu's Python and packages",
        f'cp -a {base} {system}',
        f'ln -sf python3.12 {system}/bin/python3',
        f'{system_python} -m pip install --no-compile {" ".join(UBUNTU)}',
    )
    site.run(
        'the prefix of ROS',
        f'{system_python} -m venv {jazzy}',
        f'{jazzy}/bin/python -m pip install --no-compile -r {ROS_REQUIREMENTS}',
        # On Ubuntu these are packages of the system, so the prefix of ROS does not contain them.
        f'{jazzy}/bin/python -m pip uninstall -y numpy PyYAML lark-parser empy setuptools',
        f'rm {jazzy}/bin/python* {jazzy}/pyvenv.cfg',
    )
    libraries = [jazzy / 'lib', *sorted((jazzy / packages).glob('ros_*.libs'))]
    (jazzy / 'setup.bash').write_text(
        '\n'.join(
            f'export {line}'
            for line in (
                'ROS_VERSION=2 ROS_PYTHON_VERSION=3 ROS_DISTRO=jazzy',
                'ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET',
                f'AMENT_PREFIX_PATH={jazzy}',
                f'PYTHONPATH={jazzy / packages}',
                f'LD_LIBRARY_PATH={os.pathsep.join(map(str, libraries))}',
                f'PATH={jazzy}/bin:$PATH',
            )
        )
        + '\n'
    )
    site.setup = [f'export PATH={system}/bin:$PATH', f'. {jazzy}/setup.bash']


def _sourced_with_pinocchio(site: Site) -> None:
    _sourced(site)
    jazzy, wheels = site.folder / 'jazzy', site.folder / 'pinocchio'
    site.run(
        'a pinocchio for NumPy 1 in the prefix of ROS',
        f'{site.folder}/system/bin/python3.12 -m pip install --no-compile --target {wheels}'
        f' {" ".join(APT_PINOCCHIO)}',
        f'cp -a {wheels}/cmeel.prefix/lib/. {jazzy}/lib/',
        f'[ -e {jazzy}/lib/python3.12/site-packages/pinocchio ]',
    )


def _debian_13(site: Site) -> None:
    """Create a minimal Debian 13, in which later commands of the platform run.

    It has Python 3.13, but no compiler, no libgomp and no venv.
    """
    root = site.folder / 'debian'
    if os.getuid() != 0 or shutil.which('debootstrap') is None:
        raise MusculoskeletalError(
            'the platform Debian 13 requires root and debootstrap; install debootstrap and run as '
            'root'
        )
    site.run(
        'Debian 13',
        f'debootstrap --variant=minbase --include={DEBIAN_PACKAGES} trixie {root}',
        f'cp /etc/resolv.conf {root}/etc/',
        # Some networks need a custom certificate or pip.conf to reach package registries.
        f'[ -z "${{PIP_CERT-}}" ] || cp -L "$PIP_CERT" {root}/"$PIP_CERT"',
        f'[ ! -e /etc/pip.conf ] || cp /etc/pip.conf {root}/etc/',
        f'cp -a {site.clone} {root}/root/clone',
    )
    mounts = f'mount -t proc proc {root}/proc; mount --rbind /dev {root}/dev'
    site.clone_inside = '/root/clone'
    site.inside = [
        'unshare', '--mount', 'bash', '-c', f'{mounts}; HOME=/root exec chroot {root} "$@"', 'bash',
    ]  # fmt: skip
    site.setup = ['export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin']


def _rclpy(version: str) -> Callable[[Site], None]:
    """Return a function that replaces rclpy in the wheels, with Python 3.12 as on Ubuntu 24.04.

    control_msgs, which the wheels lack, is built as well.
    """

    def make(site: Site) -> None:
        _wheels('3.12')(site)
        site.run('dependencies', *SET_UP, on_platform=True)
        packages = f'rclpy=={version} control_msgs'
        site.run(
            f'{packages} from source',
            f'.venv/bin/python -m bench ros_sources {packages}',
            on_platform=True,
        )

    return make


PLATFORMS: dict[str, Callable[[Site], None]] = {
    **{f'wheels-{version}': _wheels(version) for version in ('3.10', '3.11', '3.12', '3.13')},
    'sourced': _sourced,
    'sourced-pinocchio': _sourced_with_pinocchio,
    'debian-13': _debian_13,
    **{f'rclpy-{version}': _rclpy(version) for version in ('7.1.1', '7.1.11')},
}
WITH_NODE = tuple(name for name in PLATFORMS if name.startswith(('wheels-', 'sourced')))


# --- checks --------------------------------------------------------------------------------------


def check_system(name: str, folder: Path, tests: tuple[str, ...]) -> str:
    """Check a platform in an empty folder; return one line about bring-up and tests."""
    site = Site(folder)
    site.run('cloning', f'git clone -q {shlex.quote(str(ROOT))} clone')
    PLATFORMS[name](site)
    output = site.run('bringup.sh', f'./bringup.sh {" ".join(BRINGUP)}', on_platform=True)
    errors = re.findall(r' s  error ([\d.]+) rad', output)
    if not errors:
        raise MusculoskeletalError(f'bringup.sh printed no estimate; see {site.log}')
    output = site.run(
        'tests',
        *SET_UP,
        'export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST OMP_NUM_THREADS=1',
        '. .ci/udp.sh',
        f'"$python" -m pytest -q -p no:cacheprovider {" ".join(tests)}',
        on_platform=True,
    )
    return f'bring-up: error {errors[-1]} rad; tests: {output.splitlines()[-1].strip("= ")}'


def pinned(file: Path, version: str, names: tuple[str, ...] = ()) -> list[str]:
    """Return the pinned requirements in `file` that apply to a Python version.

    If `names` is given, only requirements of these packages are returned.
    """
    lines = []
    for line in file.read_text('utf-8').splitlines():
        requirement, _, condition = line.partition(';')
        match = re.match(r'([\w-]+)==', requirement)
        if match and (not names or match[1] in names):
            is_old = version == '3.10'
            if not condition or ('<' in condition) == is_old:
                lines.append(requirement.strip())
    return lines


def check_node(name: str, folder: Path, checkpoint: Path) -> str:
    """Check the core and one node in a virtual environment; return one line with the result."""
    is_sourced = not name.startswith('wheels-')
    version = '3.12' if is_sourced else name.removeprefix('wheels-')
    site, venv = Site(folder), folder / 'venv'
    PLATFORMS[name](site)
    packages = pinned(ROOT / 'requirements.txt', version, NODE_REQUIREMENTS)
    packages += [] if is_sourced else pinned(ROS_REQUIREMENTS, version)
    site.run(
        f'Python {version} with {len(packages)} packages and their dependencies',
        *site.setup,
        f'"${{PYTHON:-python3}}" -m venv {"--system-site-packages" if is_sourced else ""} {venv}',
        f'{venv}/bin/python -m pip install --no-compile {" ".join(packages)}',
    )
    output = site.run(
        'a node',
        *site.setup,
        f'cd {shlex.quote(str(ROOT))}',
        f'export AMENT_PREFIX_PATH="${{AMENT_PREFIX_PATH:-{venv}}}"',
        'export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST',
        f'{venv}/bin/python -m bench.platform_node {shlex.quote(str(checkpoint))}',
    )
    return output.splitlines()[-1]


def _options(argv: list[str]) -> argparse.Namespace:
    parser = Parser('platforms', 'Creates platforms, starts the system there, and runs tests.')
    parser.add_argument('names', nargs='*', metavar='NAME', help=', '.join(PLATFORMS))
    parser.add_argument(
        '--node', type=Path, metavar='CHECKPOINT',
        help='check only the core and one node, without torch, with this checkpoint of arm26',
    )  # fmt: skip
    parser.add_argument(
        '--folder', type=Path, metavar='DIR', help='working folder (default: a temporary one)'
    )
    parser.add_argument(
        '--tests', nargs='+', metavar='TEST',
        help='tests for pytest (default: those that depend on the platform)',
    )  # fmt: skip
    options = parser.parse_args(argv)
    for name in options.names:
        if name not in PLATFORMS:
            parser.error(f'unknown platform {name!r}; legal: {", ".join(PLATFORMS)}')
        if options.node and name not in WITH_NODE:
            parser.error(
                f'--node does not support platform {name!r}; legal: {", ".join(WITH_NODE)}'
            )
    return options


def main(argv: list[str]) -> int:
    """Check platforms one after another; exit status 1 if one fails."""
    options = _options(argv)
    names = options.names or (WITH_NODE if options.node else tuple(PLATFORMS))
    rows, failed = [], 0
    for name in names:
        print(f'-- {name}', flush=True)
        folder = Path(tempfile.mkdtemp(prefix=f'{name}-', dir=options.folder))
        started = time.monotonic()
        try:
            if options.node:
                outcome = check_node(name, folder, options.node.resolve())
            else:
                tests = NODE_TESTS if name.startswith('rclpy-') else TESTS
                outcome = check_system(name, folder, tuple(options.tests or tests))
        except MusculoskeletalError as error:
            print(error, file=sys.stderr)
            failed += 1
            outcome = f'FAILED, see {folder}'
        else:
            shutil.rmtree(folder)
        minutes = (time.monotonic() - started) / 60.0
        rows.append(f'| {name} | {outcome} | {time.strftime("%Y-%m-%d")} | {minutes:.1f} min |')
        print(rows[-1], flush=True)
    print('\n| platform | outcome | date | time |\n|---|---|---|---|')
    print('\n'.join(rows))
    return 1 if failed else 0
