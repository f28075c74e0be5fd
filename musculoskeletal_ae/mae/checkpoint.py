# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: a trained network as safetensors bytes, in files and on the topic `mae_checkpoint`.

A checkpoint is checked completely before any part of it is used. Every fault raises a
`CheckpointError` that names the source, the problem and the remedy. Pickle is never used, because
unpickling can run arbitrary code.
"""

import json
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.files import read_bytes, write_whole
from musculoskeletal_ae.mae.mae import Layer, Mae, complete_bases, latent_places, read_groups
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, TouchStatistics
from musculoskeletal_ae.mae.units import UNITS, ActivationName
from musculoskeletal_ae.presets.preset import PRESET_NAMES
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.groups import Group
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.schema import Strict, convert
from musculoskeletal_ae.signals.friction import LARGEST_GAIN

FORMAT_VERSION = 1  # reject checkpoints of any other version of the file format
#: reject a larger checkpoint [bytes]; those of the shipped robots are a hundred times smaller
MAX_BYTES = 64 * 1024 * 1024
MAX_HEADER_BYTES = 1024 * 1024  # reject a checkpoint with a larger header [bytes]
#: reject a checkpoint with a number beyond ± this: no trained network has such a number, which
#: could overflow when `Mae` folds units and standardisation into the layers
LARGEST = 1e9
SMALLEST_STD = 1e-9  # reject a checkpoint with a smaller standard deviation, which is a divisor
#: reject a checkpoint with a larger tendon friction |μ|, at which the tensions at the ends of a
#: tendon would differ 150-fold
LARGEST_FRICTION = 5.0
#: reject a covariance whose smallest eigenvalue is not above this multiple of the largest one
SMALLEST_EIGENVALUE = 1e-12
#: reject a stiffness matrix of the springs with an eigenvalue below this multiple of the largest
#: one; rounding can make eigenvalues slightly negative, springs cannot
SMALLEST_SPRING_EIGENVALUE = -1e-6
#: reject a network whose estimate at the middle of all joint ranges exceeds these absolute values:
#: θ [rad], T [N], l [m] and muscle Jacobian G [m/rad]
LARGEST_ESTIMATES = (100.0, 1e5, 100.0, 1e5)

Count = Annotated[int, Meta(ge=0, le=2**53)]  # a whole number that JSON represents exactly
Names = Annotated[tuple[str, ...], Meta(min_length=1, max_length=1000)]  # joints or muscles
Units = Annotated[int, Meta(ge=1, le=4096)]  # number of units in one layer
Threshold = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]  # threshold of a detector
#: copy these entries of the metadata to and from the attributes of `Mae` with the same name
SHARED = (
    'joints', 'muscles', 'groups', 'bases', 'isolated', 'activation', 'preset', 'version',
    'training',
)  # fmt: skip


class Metadata(Strict, frozen=True):
    """Metadata of a checkpoint; safetensors stores each entry as JSON text."""

    format_version: int
    units: str
    joints: Names
    muscles: Names
    layer_sizes: Annotated[tuple[Units, ...], Meta(min_length=3, max_length=21_000)]
    groups: Annotated[tuple[Group, ...], Meta(min_length=1, max_length=1000)]
    isolated: Annotated[tuple[Count, ...], Meta(max_length=1000)]  # indices of muscles
    activation: ActivationName
    preset: str
    version: Count
    training: Annotated[str, Meta(max_length=10_000)]
    anomaly_calibrated: bool | None  # None without anomaly statistics
    anomaly_samples: Count
    anomaly_thresholds: Annotated[dict[str, Threshold], Meta(max_length=1000)]
    anomaly_postures: Annotated[int, Meta(ge=0, le=10_000)]
    #: duration of motion in the touch statistics [s]; None if there are no touch statistics
    touch_time: Annotated[float, Meta(ge=0.0, le=LARGEST)] | None
    uncertain: bool  # whether the covariance of the estimates is included
    touch_peaks: Annotated[int, Meta(ge=0, le=1000)] = 0  # number of peaks in the touch statistics
    length_spread: bool = False  # whether the possible errors of the learned lengths are included
    drive: bool = False  # whether learned constants of motor currents are included
    elastic: bool = False  # whether learned springs of the joints are included
    #: for each group's block, the index of its base (the block whose inputs it uses as well) or,
    #: without a base, its own index; () if no block has a base
    bases: Annotated[tuple[Count, ...], Meta(max_length=1000)] = ()

    def __post_init__(self) -> None:
        """Check the rules that types cannot express."""
        for key, names in (('joints', self.joints), ('muscles', self.muscles)):
            if len(set(names)) < len(names) or not all(n and n.isprintable() for n in names):
                raise ValueError(f'{key} {names}; legal: printable names, each at most once')
        words = ('units', self.units, [UNITS]), ('preset', self.preset, PRESET_NAMES)
        for key, word, legal in words:
            if word not in legal:
                raise ValueError(f'{key} {word!r}; legal: {", ".join(legal)}')
        for names, places in zip((self.joints, self.muscles), zip(*self.groups), strict=True):
            if sorted(chain(*places)) != [*range(len(names))] or not all(places):
                problem = f'groups {self.groups}; legal: each joint and muscle in exactly one group'
                raise ValueError(problem)
        known, muscles = set(self.isolated), range(len(self.muscles))
        if len(known) < len(self.isolated) or not known <= {*muscles}:
            indices = f'indices of muscles, 0 to {len(muscles) - 1}, each at most once'
            raise ValueError(f'isolated {self.isolated}; legal: {indices}')
        bases, count = self.bases_by_group(), len(self.groups)
        are_bases = len(bases) == count and max(bases) < count
        if not are_bases or any(bases[base] != base for base in bases):
            expected = f'for each of {count} groups the index of its base, and for a base its own'
            raise ValueError(f'bases {self.bases}; legal: {expected}')
        # Encoder and decoder have equally many hidden layers; the latent layer is between them.
        depth, rest = divmod(len(self.layer_sizes), len(self.groups))
        groups_read = read_groups(self.groups, bases)
        for group, read, sizes in zip(self.groups, groups_read, self.sizes_by_group(), strict=True):
            d, m = map(len, group)
            ends = len(read.joints) + 2 * len(read.muscles) + 3, d + m, d + 2 * m
            is_symmetric = rest == 0 and depth % 2 == 1
            if not is_symmetric or (sizes[0], sizes[depth // 2], sizes[-1]) != ends:
                expected = '{}, …, {}, …, {}'.format(*ends)
                raise ValueError(f'layer_sizes {sizes}; legal: {expected}')

    def sizes_by_group(self) -> list[tuple[int, ...]]:
        """Return the layer sizes of each group's block."""
        depth = len(self.layer_sizes) // len(self.groups)
        return [self.layer_sizes[g * depth :][:depth] for g in range(len(self.groups))]

    def bases_by_group(self) -> tuple[int, ...]:
        """Return the index of the base of each group's block."""
        return complete_bases(self.bases, len(self.groups))

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the name and shape of every tensor that belongs to this metadata."""
        values = len(self.joints) + 2 * len(self.muscles)
        shapes: dict[str, tuple[int, ...]] = {'mean': (values,), 'std': (values,)}
        latents = latent_places(self.groups, self.bases_by_group())
        for g, sizes in enumerate(self.sizes_by_group()):
            depth = len(sizes) // 2
            for i, (into, out) in enumerate(pairwise(sizes)):
                stack = 'encoder' if i < depth else 'decoder'
                if i == depth:  # the decoder also reads the latent units of its base group
                    into = len(latents[g])
                layer = g * depth + i % depth
                shapes[f'{stack}.{layer}.weight'] = out, into
                shapes[f'{stack}.{layer}.bias'] = (out,)
        if self.anomaly_calibrated is not None:
            muscles = 2 * len(self.muscles)
            shapes |= {'anomaly.mean': (muscles,), 'anomaly.covariance': (muscles, muscles)}
        if self.anomaly_postures:
            shapes['anomaly.postures'] = self.anomaly_postures, len(self.joints)
        if self.touch_time is not None:
            shapes |= {'touch.friction': (len(self.muscles),), 'touch.spread': (len(self.joints),)}
        if self.touch_time is not None and self.touch_peaks:
            shapes['touch.peaks'] = (self.touch_peaks,)
        if self.touch_time is not None and self.drive:
            shapes['touch.drive'] = 3, len(self.muscles)
            shapes['touch.drive_covariance'] = len(self.muscles), 3, 3
        if self.uncertain:
            shapes['covariance'] = len(self.joints), len(self.joints)
        if self.length_spread:
            shapes['length_spread'] = (len(self.muscles),)
        if self.elastic:
            count = len(self.joints)
            shapes |= {f'elasticity.{name}': (count,) for name in ('preload', 'damping')}
            shapes['elasticity.stiffness'] = count, count
        return shapes


def to_bytes(mae: Mae) -> bytes:
    """Return a network as safetensors bytes, which `from_bytes` converts back without loss."""
    anomaly = mae.anomaly
    tensors: dict[str, Array] = {'mean': mae.mean, 'std': mae.std}
    for name, stack in (('encoder', mae.encoder), ('decoder', mae.decoder)):
        for i, (weight, bias) in enumerate(stack):
            tensors |= {f'{name}.{i}.weight': weight, f'{name}.{i}.bias': bias}
    if anomaly is not None:
        tensors |= {'anomaly.mean': anomaly.mean, 'anomaly.covariance': anomaly.covariance}
        if len(anomaly.postures):
            tensors['anomaly.postures'] = anomaly.postures
    touch = mae.touch
    if touch is not None:
        tensors |= {'touch.friction': touch.friction, 'touch.spread': touch.spread}
        if len(touch.peaks):
            tensors['touch.peaks'] = touch.peaks
        if touch.drive is not None:
            certain = np.zeros((len(mae.muscles), 3, 3))
            known = touch.drive_covariance
            tensors['touch.drive'] = touch.drive
            tensors['touch.drive_covariance'] = certain if known is None else known
    if mae.covariance is not None:
        tensors['covariance'] = mae.covariance
    if mae.length_spread is not None:
        tensors['length_spread'] = mae.length_spread
    if (springs := mae.elasticity) is not None:
        tensors['elasticity.stiffness'] = springs.stiffness
        tensors |= {'elasticity.preload': springs.preload, 'elasticity.damping': springs.damping}
    entries = {name: getattr(mae, name) for name in SHARED} | {
        'format_version': FORMAT_VERSION,
        'units': UNITS,
        'layer_sizes': mae.layer_sizes,
        'anomaly_calibrated': None if anomaly is None else anomaly.calibrated,
        'anomaly_samples': 0 if anomaly is None else anomaly.samples,
        'anomaly_thresholds': {} if anomaly is None else dict(anomaly.thresholds),
        'anomaly_postures': 0 if anomaly is None else len(anomaly.postures),
        'touch_time': None if touch is None else touch.time,
        'touch_peaks': 0 if touch is None else len(touch.peaks),
        'drive': touch is not None and touch.drive is not None,
        'uncertain': mae.covariance is not None,
        'length_spread': mae.length_spread is not None,
        'elastic': mae.elasticity is not None,
    }
    return save_tensors(
        {name: np.ascontiguousarray(value) for name, value in tensors.items()},
        {key: json.dumps(value, allow_nan=False) for key, value in entries.items()},
    )


def from_bytes(data: bytes, robot: Robot | None = None, source: str = 'checkpoint') -> Mae:
    """Check safetensors bytes and return their network.

    Args:
        data: Content of the checkpoint.
        robot: The robot whose joints and muscles the network must have in the same order, or None
            to accept any. The network's estimate of this robot's middle posture must be within
            LARGEST_ESTIMATES.
        source: Name of the checkpoint in error messages.

    Raises:
        CheckpointError: If the checkpoint is invalid or does not fit the robot.
    """
    try:
        return restored(data, robot)
    except CheckpointError as error:
        raise _refused(source, str(error)) from error.__cause__


def restored(data: bytes, robot: Robot | None = None) -> Mae:
    """Return the network like `from_bytes`, but with errors that state only the problem.

    Args:
        data: Content of the checkpoint.
        robot: See `from_bytes`.

    Raises:
        CheckpointError: The problem, without the name of the checkpoint and without a remedy.
    """
    meta = _metadata(data)
    mae = _mae(meta, _tensors(data, meta))
    if robot is not None:
        _check_fit(mae, robot)
    return mae


def _refused(source: str | Path, problem: str) -> CheckpointError:
    return CheckpointError(f'{source}: {problem}; use another checkpoint, or make one with `train`')


class _Header(msgspec.Struct, frozen=True):
    """Header of safetensors bytes; safetensors itself checks the entries of the tensors."""

    metadata: dict[str, str] = msgspec.field(name='__metadata__')


def _metadata(data: bytes) -> Metadata:
    """Return the metadata of safetensors bytes."""
    if len(data) > MAX_BYTES:
        raise CheckpointError(f'it has {len(data)} bytes; legal: at most {MAX_BYTES}')
    if len(data) < 10:  # 8 bytes for the size of the header, and at least 2 for the header
        problem = f'not safetensors: it has {len(data)} bytes; legal: at least 10'
        raise CheckpointError(problem)
    size, most = int.from_bytes(data[:8], 'little'), min(MAX_HEADER_BYTES, len(data) - 8)
    if not 2 <= size <= most:
        raise CheckpointError(
            f'not safetensors: the first 8 bytes state a header of {size} bytes; '
            f'legal: 2 to {most} ({len(data)} bytes in total)'
        )
    try:
        entries = msgspec.json.decode(data[8 : 8 + size], type=_Header).metadata
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        problem = f'no metadata ({error}); this is not a checkpoint of musculoskeletal_ae'
        raise CheckpointError(problem) from error
    values = {key: _json(text, key) for key, text in entries.items()}
    # Check the version first: a file of another version may violate the schema in many ways, and
    # the error should name the cause.
    version = values.get('format_version')
    if version is True or version != FORMAT_VERSION:
        problem = f'format_version {version!r:.100}; legal: {FORMAT_VERSION}'
        raise CheckpointError(problem)
    return convert(values, Metadata, lambda problem: CheckpointError(f'metadata: {problem}'))


def _json(text: str, key: str) -> Any:
    try:
        return msgspec.json.decode(text)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise CheckpointError(f'{key} is not valid JSON ({error}): {text!r:.100}') from error


def _tensors(data: bytes, meta: Metadata) -> dict[str, Array]:
    """Return the tensors that belong to the metadata, after checking shapes and values."""
    try:
        tensors: dict[str, Array] = load_tensors(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f'not valid safetensors ({error})') from error
    shapes = meta.tensor_shapes()
    for problem, names in (
        ('missing tensors', shapes.keys() - tensors.keys()),
        ('unknown tensors', tensors.keys() - shapes.keys()),
    ):
        if names:
            raise CheckpointError(f'{problem}: {", ".join(sorted(names))[:200]}')
    for name, value in tensors.items():
        if value.dtype != np.float64:
            raise CheckpointError(f'tensor {name} has type {value.dtype}; legal: float64')
        if value.shape != shapes[name]:
            raise CheckpointError(f'tensor {name} has shape {value.shape}; legal: {shapes[name]}')
        if not (np.abs(value) <= LARGEST).all():
            problem = f'tensor {name} has a value that is not finite or is beyond ±{LARGEST:g}'
            raise CheckpointError(problem)
    for name in ('std', 'touch.spread'):
        if name in tensors and (least := tensors[name].min()) < SMALLEST_STD:
            value_text, limit = distinct(least, SMALLEST_STD)
            problem = f'tensor {name} has the value {value_text}; legal: at least {limit}'
            raise CheckpointError(problem)
    if (most := np.abs(tensors.get('touch.friction', np.zeros(1))).max()) > LARGEST_FRICTION:
        value_text, limit = distinct(most, LARGEST_FRICTION)
        problem = f'tensor touch.friction has a value of ±{value_text}; legal: -{limit} to {limit}'
        raise CheckpointError(problem)
    if (most := np.abs(tensors.get('touch.drive', np.zeros((3, 1)))[0]).max()) > LARGEST_GAIN:
        value_text, limit = distinct(most, LARGEST_GAIN)
        problem = f'tensor touch.drive has a gain of ±{value_text}; legal: -{limit} to {limit}'
        raise CheckpointError(problem)
    for name in ('length_spread', 'touch.peaks'):
        if (least := tensors.get(name, np.zeros(1)).min()) < 0.0:
            raise CheckpointError(f'tensor {name} has the value {least:g}; legal: 0 or more')
    for name in ('anomaly.covariance', 'covariance'):
        if name in tensors:
            _check_covariance(name, tensors[name])
    for covariance in tensors.get('touch.drive_covariance', ()):
        least, most = np.linalg.eigvalsh(covariance)[[0, -1]]
        if not np.array_equal(covariance, covariance.T) or least < -SMALLEST_EIGENVALUE * most:
            raise CheckpointError(
                f'tensor touch.drive_covariance has eigenvalues from {least:g} to {most:g}; legal: '
                'a symmetric matrix with eigenvalues of 0 or more'
            )
    if meta.elastic:
        _check_elasticity(tensors['elasticity.stiffness'], tensors['elasticity.damping'])
    return tensors


def _check_covariance(name: str, covariance: Array) -> None:
    if not np.array_equal(covariance, covariance.T):
        raise CheckpointError(f'tensor {name} is not symmetric')
    try:
        least, most = np.linalg.eigvalsh(covariance)[[0, -1]]  # one value if the matrix is (1, 1)
    except np.linalg.LinAlgError as error:
        raise CheckpointError(f'tensor {name}: its eigenvalues cannot be computed') from error
    # Require a covariance that is positive definite and, because the detector inverts that of the
    # residuals, not nearly singular.
    if not least > SMALLEST_EIGENVALUE * most:
        raise CheckpointError(
            f'tensor {name} has eigenvalues from {least:g} to {most:g}; the smallest must '
            f'be positive and above {SMALLEST_EIGENVALUE:g} times the largest'
        )


def _check_elasticity(stiffness: Array, damping: Array) -> None:
    if not np.array_equal(stiffness, stiffness.T):
        raise CheckpointError('tensor elasticity.stiffness is not symmetric')
    least, most = np.linalg.eigvalsh(stiffness)[[0, -1]]
    if least < SMALLEST_SPRING_EIGENVALUE * most or damping.min() < 0.0:
        raise CheckpointError(
            f'tensor elasticity.stiffness has eigenvalues from {least:g} to {most:g}, and '
            f'elasticity.damping has values from {damping.min():g}; legal: 0 or more, because '
            'springs only store energy and dampers only dissipate it'
        )


def _mae(meta: Metadata, tensors: dict[str, Array]) -> Mae:
    def stack(name: str) -> tuple[Layer, ...]:
        layers = range(sum(len(sizes) // 2 for sizes in meta.sizes_by_group()))
        return tuple((tensors[f'{name}.{i}.weight'], tensors[f'{name}.{i}.bias']) for i in layers)

    anomaly = None
    if meta.anomaly_calibrated is not None:
        anomaly = AnomalyStatistics(
            tensors['anomaly.mean'],
            tensors['anomaly.covariance'],
            meta.anomaly_calibrated,
            meta.anomaly_samples,
            meta.anomaly_thresholds,
            tensors.get('anomaly.postures', np.empty((0, 0))),
        )
    touch = None
    if meta.touch_time is not None:
        friction, spread = tensors['touch.friction'], tensors['touch.spread']
        drive = tensors.get('touch.drive'), tensors.get('touch.drive_covariance')
        peaks = tensors.get('touch.peaks', np.empty(0))
        touch = TouchStatistics(friction, spread, meta.touch_time, *drive, peaks)
    elasticity = None
    if meta.elastic:
        elasticity = JointElasticity(
            tensors['elasticity.stiffness'],
            tensors['elasticity.preload'],
            tensors['elasticity.damping'],
        )
    return Mae(
        encoder=stack('encoder'),
        decoder=stack('decoder'),
        mean=tensors['mean'],
        std=tensors['std'],
        anomaly=anomaly,
        touch=touch,
        covariance=tensors.get('covariance'),
        length_spread=tensors.get('length_spread'),
        elasticity=elasticity,
        **{name: getattr(meta, name) for name in SHARED},
    )


def _check_fit(mae: Mae, robot: Robot) -> None:
    """Check that a network fits a robot, and estimates the middle posture plausibly."""
    for kind in ('joints', 'muscles'):
        network_names, robot_names = getattr(mae, kind), getattr(robot, kind)
        if network_names != robot_names:
            raise CheckpointError(
                f'made for the {kind} {", ".join(network_names)}; '
                f'this robot has the {kind} {", ".join(robot_names)}, in this order'
            )
    if mae.transmission.drive is not None and not robot.tension_source.is_current:
        raise CheckpointError(
            'learned with motor currents (tension_source: current); '
            f'this robot has tension_source: {robot.tension_source.kind}'
        )
    theta = 0.5 * (robot.lower + robot.upper)
    tension = np.full(robot.muscle_count, robot.tension.bias)
    with np.errstate(all='ignore'):
        state = mae.estimate(tension, robot.muscle_lengths(theta, tension))
        answers = (*state, mae.muscle_jacobian(theta, tension))
        if not all(
            np.abs(part).max() <= most
            for part, most in zip(answers, LARGEST_ESTIMATES, strict=True)
        ):
            limits = '±{:g} rad, ±{:g} N, ±{:g} m or ±{:g} m/rad'.format(*LARGEST_ESTIMATES)
            problem = f'the estimate of the middle posture is not finite, or is beyond {limits}'
            raise CheckpointError(problem)


def save(mae: Mae, path: str | Path) -> None:
    """Save a network as a checkpoint file, atomically.

    Raises:
        OSError: If the file cannot be written.
    """
    write_whole(Path(path), to_bytes(mae))


def load(path: str | Path, robot: Robot | None = None) -> Mae:
    """Load and check a checkpoint file (see `from_bytes`).

    Raises:
        CheckpointError: If the file cannot be read, is invalid or does not fit the robot.
    """
    return from_bytes(read_bytes(Path(path), _refused, MAX_BYTES), robot, str(path))
