# SPDX-License-Identifier: Apache-2.0
"""Readers of public recordings of tendon-driven robots. The data are not part of this repository.

A recording is read from a clone: a working tree, or a git directory without one. Each reader
returns runs with tendon lengths, efforts and true joint angles, in SI units, and the rest samples
among them. Two revolute joints stand for the bend of a soft link, which the orientation of its tip
determines: θ = β (cos φ, sin φ) of inclination β and azimuth φ.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import yaml

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MusculoskeletalError

#: robot that stands for a soft link: two joints, whose axes cross in the middle of the link, with
#: one half of the link below them and one half above
URDF = """<robot name="{name}">
  <link name="base"/>
  <joint name="bend_x" type="revolute"><parent link="base"/><child link="cross"/>
    <origin xyz="0 0 {half}"/><axis xyz="0 1 0"/>
    <limit lower="{low}" upper="{high}" effort="10" velocity="10"/></joint>
  <link name="cross"><inertial><mass value="0.01"/>
    <inertia ixx="1e-5" ixy="0" ixz="0" iyy="1e-5" iyz="0" izz="1e-5"/></inertial></link>
  <joint name="bend_y" type="revolute"><parent link="cross"/><child link="tip"/>
    <origin xyz="0 0 0"/><axis xyz="-1 0 0"/>
    <limit lower="{low}" upper="{high}" effort="10" velocity="10"/></joint>
  <link name="tip"><inertial><origin xyz="0 0 {half}"/><mass value="{mass}"/>
    <inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial></link>
  <joint name="top" type="fixed"><parent link="tip"/><child link="head"/>
    <origin xyz="0 0 {half}"/></joint>
  <link name="head"/>
</robot>
"""
REST = 0.2  # average a rest sample over this time at the end of a pose [s]


@dataclass(frozen=True)
class Run:
    """The readings of one recorded run, in which the payload is constant."""

    name: str
    load: float  # mass of the payload [kg]
    #: l, length of tendon paid out since the start [m], (N, M); `continuum_stand` scales it by 10
    length: Array
    effort: Array  # effort of the motors in units of the recording, (N, M); (N, 0) if it is unknown
    theta: Array  # θ, which an independent sensor measured [rad], (N, D); NaN if it was not
    rests: Ints  # first row of each rest, and the row after its last row, (R, 2)

    def at(self, rows: Any) -> Run:
        """Return a run with the selected rows and without rests."""
        parts = {part: getattr(self, part)[rows] for part in ('length', 'effort', 'theta')}
        return replace(self, rests=self.rests[:0], **parts)

    def at_rest(self, rows: slice = slice(None)) -> Run:
        """Return a run with one row for each rest: the means of lengths, efforts and θ in it."""
        spans = self.rests[rows]
        length, effort, theta = (
            np.array([part[a:b].mean(axis=0) for a, b in spans])
            for part in (self.length, self.effort, self.theta)
        )
        return replace(self, length=length, effort=effort, theta=theta, rests=spans[:0])


def written_robot(directory: Path, urdf: str, muscles: dict[str, Any]) -> Path:
    """Write a robot directory from a URDF and the document of muscles.yaml; return its path."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / 'robot.urdf').write_text(urdf, encoding='utf-8')
    text = yaml.safe_dump(muscles, sort_keys=False)
    (directory / 'muscles.yaml').write_text(text, encoding='utf-8')
    return directory


class Body(Protocol):
    """A recorded robot, of which a robot directory can be written."""

    @property
    def name(self) -> str:
        """Name of the recorded robot, which its URDF states."""

    @property
    def measures_tension(self) -> bool:
        """Whether the recorded efforts are tensions [N]."""

    def write(self, directory: Path, tension_source: str = 'none') -> Path:
        """Write the robot directory, with `tension_source` in muscles.yaml; return its path."""

    def __hash__(self) -> int:
        """Return a hash that equal bodies share."""


@dataclass(frozen=True)
class SoftLink:
    """A soft link with tendons parallel to it, as a robot of two joints."""

    measures_tension: ClassVar[bool] = False

    name: str
    azimuths: tuple[float, ...]  # azimuth of each tendon [rad]
    radius: tuple[float, ...]  # distance of each tendon from the middle [m]
    height: float  # length of the link [m]
    mass: float  # mass of the tip of the link [kg]
    limit: float  # limit of both joints that represent the bend [rad]

    def write(self, directory: Path, tension_source: str = 'none') -> Path:
        """Write the robot directory, with `tension_source` in muscles.yaml; return its path.

        The muscle modules regulate positions.
        """
        low, high, half = -self.limit, self.limit, 0.5 * self.height
        urdf = URDF.format(name=self.name, half=half, mass=self.mass, low=low, high=high)
        muscles = []
        for i, (azimuth, radius) in enumerate(zip(self.azimuths, self.radius, strict=True), 1):
            x, y = (float(radius * f(azimuth)) for f in (np.cos, np.sin))
            ends = {'link': 'base', 'xyz': [x, y, 0.0]}, {'link': 'tip', 'xyz': [x, y, half]}
            muscles.append({'name': f'tendon_{i}', 'route': list(ends)})
        document = {
            'joints': ['bend_x', 'bend_y'], 'muscles': muscles, 'end_effector': 'head',
            'actuation': 'position', 'tension_source': tension_source,
            # The tendons are of steel and have no series elastic element, so they hardly stretch.
            'series_elastic': {'force': 1000.0, 'rate': 1000.0, 'wire_stretch': 1e-6},
            'tension': {'bias': 5.0, 'limit': 60.0, 'max': 100.0},
        }  # fmt: skip
        return written_robot(directory, urdf, document)


@dataclass(frozen=True)
class Recording:
    """All runs that one repository contains, and the robot that was recorded."""

    link: Body
    runs: list[Run]


@dataclass(frozen=True)
class Repository:
    """A public repository with recordings of a robot, and how to read it."""

    name: str  # name of the repository on GitHub: OWNER/NAME
    recording: str  # name of the link; the results are stored under it
    licence: str
    robot: str  # one line about the robot and its sensors
    read: Callable[[Files], Recording]


class Files:
    """The files of a clone, read from its working tree or from git."""

    def __init__(self, path: Path) -> None:
        """Open a working tree or a git directory.

        Raises:
            MusculoskeletalError: If it is neither.
        """
        self._path = path
        self._is_bare = not (path / '.git').exists() and (path / 'HEAD').is_file()
        if not self._is_bare and not path.is_dir():
            legal = 'a clone of the repository: a directory with its files, or a git directory'
            raise MusculoskeletalError(f'{path}: expected {legal}')

    def names(self, pattern: str) -> list[str]:
        """Return the files whose whole name matches a regular expression, sorted."""
        if self._is_bare:
            listed = self._git('ls-tree', '-r', '-z', '--name-only', 'HEAD').decode().split('\0')
        else:
            files = (file for file in self._path.rglob('*') if file.is_file())
            listed = [str(file.relative_to(self._path)) for file in files]
        return sorted(name for name in listed if re.fullmatch(pattern, name))

    def text(self, name: str) -> str:
        """Return the text of a file; errors as of `data`."""
        return self.data(name).decode(errors='replace')

    def data(self, name: str) -> bytes:
        """Return the content of a file.

        Raises:
            MusculoskeletalError: If the clone lacks it.
        """
        if self._is_bare:
            return self._git('show', f'HEAD:{name}')
        try:
            return (self._path / name).read_bytes()
        except OSError as error:
            raise self._lacks(name) from error

    def _git(self, *arguments: str) -> bytes:
        done = subprocess.run(['git', '-C', self._path, *arguments], capture_output=True)
        if done.returncode:
            raise self._lacks(arguments[-1])
        return done.stdout

    def _lacks(self, name: str) -> MusculoskeletalError:
        return MusculoskeletalError(
            f'the clone {self._path} lacks {name}; clone the repository again'
        )


def _columns(text: str) -> dict[str, Array]:
    lines = text.strip().split('\n')
    rows = np.array([[float(cell) for cell in line.split(',')] for line in lines[1:]])
    return dict(zip(lines[0].strip().split(','), rows.T, strict=True))


def _ends(changes: Ints, count: int, rows: int) -> Ints:
    """Return for each pose its last `rows` rows, as the first row and the row after the last one.

    A pose ends at a row in `changes` or at `count`. Poses of at most twice `rows` are left out. The
    result is (R, 2) for R poses.
    """
    ends = np.append(changes, count)
    starts = np.append(0, changes)
    spans = [(end - rows, end) for start, end in zip(starts, ends) if end - start > 2 * rows]
    return np.array(spans)


def soft_neck(files: Files) -> Recording:
    """Read the open-loop runs of the soft neck, with 100 rows per second.

    They contain the angles of motor encoders [degrees] and the orientation of the tip by an IMU.
    """
    folder = 'paper-results/csv-results/Frontiers-Test-Bench-Evaluation-Soft-Robotic-Link'
    # radius of the spool [m], and distance of the tendons from the middle as a multiple of it
    spool, ratio = 0.01, 5.69
    runs = []
    for load in (0, 500, 1000):
        column = _columns(files.text(f'{folder}/imu_openloop/spring_test_{load}gr.csv'))

        def of_motors(kind: str, column: dict[str, Array] = column) -> Array:
            return np.stack([column[f'{kind}{i}'] for i in (1, 2, 3)], axis=1)

        inclination, azimuth = (
            np.radians(column[f'{what}_sensor']) for what in ('inclination', 'orientation')
        )
        theta = inclination[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        changes = np.flatnonzero((np.diff(of_motors('target_motor'), axis=0) != 0.0).any(axis=1))
        rests = _ends(changes + 1, len(theta), round(REST / 0.01))
        length = -spool * np.radians(of_motors('encoder'))
        effort = of_motors('cs')
        runs.append(Run(f'{load} g', 1e-3 * load, length, effort, theta, rests))
    azimuths = tuple(np.radians([90.0, -150.0, -30.0]).tolist())
    return Recording(SoftLink('soft_neck', azimuths, (spool * ratio,) * 3, 0.1, 0.2, 0.7), runs)


def soft_arm(files: Files) -> Recording:
    """Read the control runs of the soft arm, with 50 rows per second.

    They contain motor angles [rad], motor currents [mA] and the orientation of the tip by an IMU.
    """
    # radius of the spool, and distance of the tendons from the middle of the link [m]
    spool, distance = 0.0093, 0.0382
    runs = []
    for name in files.names(r'graphs/Control/.*/Masa_f?\d+/.*\.csv'):
        rows = [line.split(',') for line in files.text(name).split('\n')]
        table = np.array([[float(cell) for cell in row] for row in rows if len(row) == 16])
        load = 1e-3 * float(re.findall(r'Masa_f?(\d+)', name)[0])
        if len(table) < 100 or not np.isfinite(table).all():
            continue
        theta, length = table[:, 5:7], -spool * table[:, 7:10]
        if np.abs(theta).max() > 1.6 or np.abs(length).max() > 0.2:
            continue  # impossible values: the motors or the IMU failed during this run
        rests = np.array([[len(table) - round(REST / 0.02), len(table)]])
        short, effort = name.rpartition('/')[2], table[:, 13:16]
        runs.append(Run(short, load, length, effort, theta, rests))
    azimuths = tuple(np.radians([0.0, -120.0, 120.0]).tolist())
    return Recording(SoftLink('soft_arm', azimuths, (distance,) * 3, 0.2, 0.1, 1.7), runs)


def continuum_stand(files: Files) -> Recording:
    """Read the recording of the test stand of a continuum robot.

    It contains the commanded shortenings of three tendons [0.1 mm] and the tracked positions of the
    tip [mm]. The tip moves on a sphere. The bend follows from the direction from the centre of this
    sphere to the tip, relative to the axis of the unloaded link. The publication does not state
    where the tendons run; `fitted` estimates it from the training rows. A tendon that is not
    shortened is slack where the link bends away from it. Lengths are returned ten times as large as
    they are, because the learner is made for links of human size.
    """
    rows = [line.split(',') for line in files.text('Dataset/Dataset.txt').split()]
    table = np.array(rows, float)
    tip = 1e-3 * table[:, 3:]
    known = np.linalg.lstsq(np.c_[2.0 * tip, np.ones(len(tip))], (tip**2).sum(axis=1), rcond=None)
    out = tip - known[0][:3]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    axis = out[table[:, :3].sum(axis=1) < 5.0].mean(axis=0)
    axis /= np.linalg.norm(axis)
    first = np.cross([0.0, 0.0, 1.0], axis)
    first /= np.linalg.norm(first)
    across = np.stack([out @ first, out @ np.cross(axis, first)], axis=1)
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    theta = across / np.maximum(sine, 1e-12) * np.arctan2(sine, (out @ axis)[:, None])
    length, nothing = -1e-3 * table[:, :3], np.zeros((len(table), 0))
    single = np.arange(len(table))[:, None] + np.array([0, 1])
    run = Run('no load', 0.0, length, nothing, theta, single)
    limit = 1.1 * float(np.abs(theta).max())
    link = SoftLink('continuum_stand', (0.0,) * 3, (0.1,) * 3, 0.3, 0.1, limit)
    return Recording(link, [run])


def fitted(link: SoftLink, training: Run) -> tuple[SoftLink, Array]:
    """Estimate the positions of a link's tendons and their lengths at θ = 0 from training rows.

    Rows in which a tendon is not shortened contain no information about it.
    """
    arms, at_zero = [], []
    for length in training.length.T:
        rows = length != 0.0
        known = np.c_[training.theta, np.ones(len(length))][rows]
        *slope, zero = np.linalg.lstsq(known, length[rows], rcond=None)[0]
        arms.append(-np.array(slope))
        at_zero.append(zero)
    radius = [float(np.linalg.norm(arm)) for arm in arms]
    azimuths = [float(np.arctan2(arm[1], arm[0])) for arm in arms]
    return replace(link, azimuths=tuple(azimuths), radius=tuple(radius)), np.array(at_zero)


def repositories() -> Iterator[Repository]:
    """Yield the repositories, in the order of the table."""
    from bench.recordings_platform import cable_platform

    yield Repository(
        'HUMASoft/Data-and-Results', 'soft_neck', 'LGPL-3.0',
        'soft neck, 3 tendons, motor encoders, IMU; 0, 500 and 1000 g', soft_neck,
    )  # fmt: skip
    yield Repository(
        'HUMASoft/Soft-Arm', 'soft_arm', 'no licence file',
        'soft arm, 3 tendons, motor encoders and currents (157:1 gears), IMU; 0 to 500 g', soft_arm,
    )  # fmt: skip
    yield Repository(
        'ARM-Lab/Learning-Based-Position-Control-for-Continuum-Robots', 'continuum_stand', 'MIT',
        'continuum robot, 3 tendons, commanded shortenings, tracked tip; no load', continuum_stand,
    )  # fmt: skip
    yield Repository(
        'fzoffoli/UACDPR_SelfCalibration', 'cable_platform', 'no licence file',
        'platform on 4 cables, cable lengths and tensions, inclinometer; errors of the orientation',
        cable_platform,
    )  # fmt: skip
