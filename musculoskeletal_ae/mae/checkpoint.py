# SPDX-License-Identifier: Apache-2.0
"""A trained network as safetensors bytes: for files, and for the topic `mae_checkpoint`.

Nothing of a checkpoint is used before all of it has been checked, and every fault is a
`CheckpointError` that names the source, the value, what is legal and what to do. Never pickle.
"""

import json
import re
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
from musculoskeletal_ae.mae.mae import ACTIVATIONS, Layer, Mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, TouchStatistics
from musculoskeletal_ae.mae.units import UNITS
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.groups import Group
from musculoskeletal_ae.robot.robot import Robot

FORMAT_VERSION = 1
MAX_BYTES = 64 * 1024 * 1024  # a hundred times the shipped arms' networks
MAX_HEADER_BYTES = 1024 * 1024
# A weight or spread beyond these is no trained network, and could overflow where they are folded.
LARGEST = 1e9
SMALLEST_STD = 1e-9
LARGEST_FRICTION = 5.0  # a factor of 150 between the ends of a wire
SMALLEST_EIGENVALUE = 1e-12  # of the largest one
#: beyond what a trained network says of a posture at rest: θ [rad], T [N], l [m], G [m/rad]
ABSURD = (100.0, 1e5, 100.0, 1e5)

Count = Annotated[int, Meta(ge=0, le=2**53)]
Names = Annotated[tuple[str, ...], Meta(min_length=1, max_length=1000)]
Units = Annotated[int, Meta(ge=1, le=4096)]
Threshold = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
#: what network and metadata call the same
SHARED = ('joints', 'muscles', 'activation', 'preset', 'version', 'training')


class Metadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a checkpoint says of its network; safetensors holds each entry as JSON text.

    Without anomaly statistics `anomaly_calibrated` is None.
    """

    format_version: int
    joints: Names
    muscles: Names
    layer_sizes: Annotated[tuple[Units, ...], Meta(min_length=3, max_length=21_000)]
    activation: str
    units: str
    preset: str
    version: Count
    training: Annotated[str, Meta(max_length=10_000)]
    anomaly_calibrated: bool | None
    anomaly_samples: Count
    anomaly_thresholds: Annotated[dict[str, Threshold], Meta(max_length=1000)]
    anomaly_postures: Annotated[int, Meta(ge=0, le=10_000)] = 0
    groups: Annotated[tuple[Group, ...], Meta(max_length=1000)] = ()  # none: it is all one
    touch_time: Annotated[float, Meta(ge=0.0, le=LARGEST)] | None = None  # none: no statistics
    uncertain: bool = False  # whether it tells the covariance of its estimates
    isolated: Annotated[tuple[Count, ...], Meta(max_length=1000)] = ()  # places of muscles

    def __post_init__(self) -> None:
        """Check what types cannot say."""
        for what, names in (('joints', self.joints), ('muscles', self.muscles)):
            if len(set(names)) < len(names) or not all(n and n.isprintable() for n in names):
                raise ValueError(f'{what} {names}; legal: different names, printable')
        for what, word, legal in (
            ('units', self.units, (UNITS,)),
            ('activation', self.activation, ACTIVATIONS),
            ('preset', self.preset, PRESETS),
        ):
            if word not in legal:
                raise ValueError(f'{what} {word!r}; legal: {" or ".join(map(repr, legal))}')
        for names, places in zip((self.joints, self.muscles), zip(*self.whole), strict=True):
            if sorted(chain(*places)) != [*range(len(names))] or not all(places):
                raise ValueError(f'groups {self.groups}; legal: each joint and muscle in one group')
        if len(set(self.isolated)) < len(self.isolated) or max(self.isolated, default=0) >= len(
            self.muscles
        ):
            raise ValueError(f'isolated {self.isolated}; legal: different places of muscles')
        # Encoder and decoder have the same hidden layers, so the latent one stands in the middle.
        for (joints, muscles), sizes in zip(self.whole, self.sizes_by_group(), strict=True):
            d, m = len(joints), len(muscles)
            ends = d + 2 * m + 3, d + m, d + 2 * m
            uneven = len(sizes) % 2 == 0 or len(sizes) * len(self.whole) != len(self.layer_sizes)
            if uneven or (sizes[0], sizes[len(sizes) // 2], sizes[-1]) != ends:
                legal_sizes = '{}, …, {}, …, {}'.format(*ends)
                raise ValueError(f'layer_sizes {sizes}; legal: {legal_sizes}')

    @property
    def whole(self) -> tuple[Group, ...]:
        """The groups; one of all joints and muscles where none are given."""
        return self.groups or (Group.whole(len(self.joints), len(self.muscles)),)

    def sizes_by_group(self) -> list[tuple[int, ...]]:
        """Return the layer sizes of each group."""
        each = -(-len(self.layer_sizes) // len(self.whole))
        return [self.layer_sizes[g * each :][:each] for g in range(len(self.whole))]

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return name and shape of every tensor of such a network."""
        values = len(self.joints) + 2 * len(self.muscles)
        shapes: dict[str, tuple[int, ...]] = {'mean': (values,), 'std': (values,)}
        for g, sizes in enumerate(self.sizes_by_group()):
            depth = len(sizes) // 2
            for i, (into, out) in enumerate(pairwise(sizes)):
                name, layer = ('decoder', 'encoder')[i < depth], g * depth + i % depth
                shapes |= {f'{name}.{layer}.weight': (out, into), f'{name}.{layer}.bias': (out,)}
        if self.anomaly_calibrated is not None:
            muscles = 2 * len(self.muscles)
            shapes |= {'anomaly.mean': (muscles,), 'anomaly.covariance': (muscles, muscles)}
        if self.anomaly_postures:
            shapes['anomaly.postures'] = self.anomaly_postures, len(self.joints)
        if self.touch_time is not None:
            shapes |= {'touch.friction': (len(self.muscles),), 'touch.spread': (len(self.joints),)}
        if self.uncertain:
            shapes['covariance'] = len(self.joints), len(self.joints)
        return shapes


def to_bytes(mae: Mae) -> bytes:
    """Return a network as safetensors bytes; `from_bytes` gives back the same bits."""
    anomaly = mae.anomaly
    tensors: dict[str, Array] = {'mean': mae.mean, 'std': mae.std}
    for name, stack in (('encoder', mae.encoder), ('decoder', mae.decoder)):
        for i, (weight, bias) in enumerate(stack):
            tensors |= {f'{name}.{i}.weight': weight, f'{name}.{i}.bias': bias}
    if anomaly is not None:
        tensors |= {'anomaly.mean': anomaly.mean, 'anomaly.covariance': anomaly.covariance}
        if len(anomaly.postures):
            tensors['anomaly.postures'] = anomaly.postures
    entries = {name: getattr(mae, name) for name in (*SHARED, 'layer_sizes')} | {
        'format_version': FORMAT_VERSION,
        'units': UNITS,
        'anomaly_calibrated': None if anomaly is None else anomaly.calibrated,
        'anomaly_samples': 0 if anomaly is None else anomaly.samples,
        'anomaly_thresholds': {} if anomaly is None else dict(anomaly.thresholds),
        'anomaly_postures': 0 if anomaly is None else len(anomaly.postures),
    }
    if len(mae.groups) > 1:
        entries['groups'] = mae.groups
    if mae.isolated:
        entries['isolated'] = mae.isolated
    if (touch := mae.touch) is not None:
        tensors |= {'touch.friction': touch.friction, 'touch.spread': touch.spread}
        entries['touch_time'] = touch.time
    if mae.covariance is not None:
        tensors['covariance'], entries['uncertain'] = mae.covariance, True
    return save_tensors(
        {name: np.ascontiguousarray(value) for name, value in tensors.items()},
        {key: json.dumps(value, allow_nan=False) for key, value in entries.items()},
    )


def from_bytes(data: bytes, robot: Robot | None = None, source: str = 'checkpoint') -> Mae:
    """Return the network of safetensors bytes, checked; messages call them `source`.

    Raises:
        CheckpointError: If anything is wrong, or it does not fit the robot: not the same joints and
            muscles in the same order, or values that cannot be computed with.
    """
    try:
        header, meta = _parsed(data)
        mae = _mae(meta, _tensors(data, header, meta))
        if robot is not None:
            _check_fit(mae, robot)
    except CheckpointError as error:
        raise _refused(source, str(error)) from error.__cause__
    return mae


def _refused(source: str | Path, problem: str) -> CheckpointError:
    return CheckpointError(f'{source}: {problem}; use another checkpoint, or make one with `train`')


def _parsed(data: bytes) -> tuple[dict[str, Any], Metadata]:
    """Return what the header says of each tensor, and the metadata."""
    if len(data) > MAX_BYTES:
        raise CheckpointError(f'{len(data)} bytes; at most {MAX_BYTES} are legal')
    size = int.from_bytes(data[:8], 'little')
    if not 2 <= size <= min(MAX_HEADER_BYTES, len(data) - 8):
        raise CheckpointError(
            f'{len(data)} bytes with a header of {size} bytes are not safetensors '
            f'(a header has 2 to {MAX_HEADER_BYTES} bytes and lies inside the file)'
        )
    header = _json(data[8 : 8 + size], 'header')
    entries = header.pop('__metadata__', None) if isinstance(header, dict) else None
    if not isinstance(entries, dict):
        raise CheckpointError('no metadata; this is not a checkpoint of musculoskeletal_ae')
    # Before all else: a newer format may differ in everything that is checked below.
    version = _json(entries.get('format_version'), 'format_version')
    if version is True or version != FORMAT_VERSION:
        told = f'format_version {version!r:.100}'
        raise CheckpointError(f'{told}; this program reads {FORMAT_VERSION}')
    values = {key: _json(text, key) for key, text in entries.items()}
    try:
        return header, msgspec.convert(values, Metadata)
    except msgspec.ValidationError as error:
        place = re.search(r'`\$\.(\w+)', str(error))
        value = f': {values[place[1]]!r:.100}' if place else ''
        raise CheckpointError(f'metadata: {error}{value}') from error


def _json(text: Any, what: str) -> Any:
    if not isinstance(text, str | bytes):
        raise CheckpointError(f'{what} is missing or not text')
    try:
        return msgspec.json.decode(text)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise CheckpointError(f'{what} is not valid JSON ({error}): {text!r:.100}') from error


def _tensors(data: bytes, header: dict[str, Any], meta: Metadata) -> dict[str, Array]:
    shapes = meta.tensor_shapes()
    if odd := header.keys() ^ shapes.keys():
        raise CheckpointError(f'tensors missing or unknown: {", ".join(sorted(odd))[:200]}')
    for name, shape in shapes.items():
        entry = header[name] if isinstance(header[name], dict) else {}
        for what, legal in (('dtype', 'F64'), ('shape', list(shape))):
            if (given := entry.get(what)) != legal:
                raise CheckpointError(f'tensor {name} has {what} {given!r}; legal: {legal!r}')
    try:
        tensors: dict[str, Array] = load_tensors(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f'not valid safetensors ({error})') from error
    for name, value in tensors.items():
        if not (np.abs(value) <= LARGEST).all():
            raise CheckpointError(f'tensor {name} holds a value beyond ±{LARGEST:g}, or not finite')
    for name in ('std', 'touch.spread'):
        if name in tensors and (least := tensors[name].min()) < SMALLEST_STD:
            told = f'tensor {name} holds {least:g}; at least {SMALLEST_STD:g} is legal'
            raise CheckpointError(told)
    if (most := np.abs(tensors.get('touch.friction', np.zeros(1))).max()) > LARGEST_FRICTION:
        told = f'tensor touch.friction holds ±{most:g}; at most {LARGEST_FRICTION:g} is legal'
        raise CheckpointError(told)
    for name in ('anomaly.covariance', 'covariance'):
        if name in tensors:
            _check_covariance(name, tensors[name])
    return tensors


def _check_covariance(name: str, covariance: Array) -> None:
    if not np.array_equal(covariance, covariance.T):
        raise CheckpointError(f'tensor {name} is not symmetric')
    try:
        least, most = np.linalg.eigvalsh(covariance)[[0, -1]]  # the same one, of one joint
    except np.linalg.LinAlgError as error:
        raise CheckpointError(f'tensor {name} has no eigenvalues') from error
    # Nearer to singular it could not be inverted, as the detector does.
    if not least > SMALLEST_EIGENVALUE * most:
        raise CheckpointError(
            f'tensor {name} has eigenvalues from {least:g} to {most:g}; the least must '
            f'be positive and above {SMALLEST_EIGENVALUE:g} times the largest'
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
        touch = TouchStatistics(friction, spread, meta.touch_time)
    return Mae(
        encoder=stack('encoder'),
        decoder=stack('decoder'),
        mean=tensors['mean'],
        std=tensors['std'],
        anomaly=anomaly,
        touch=touch,
        covariance=tensors.get('covariance'),
        groups=meta.groups,
        isolated=meta.isolated,
        **{name: getattr(meta, name) for name in SHARED},
    )


def _check_fit(mae: Mae, robot: Robot) -> None:
    """Refuse other names, and a network whose answer for the middle posture is no use."""
    for what in ('joints', 'muscles'):
        ours, theirs = getattr(mae, what), getattr(robot, what)
        if ours != theirs:
            had, needed = ', '.join(ours), ', '.join(theirs)
            raise CheckpointError(f'made for {what} {had}; this robot has {needed}, in this order')
    theta = 0.5 * (robot.lower + robot.upper)
    tension = np.full(robot.muscle_count, robot.tension.bias)
    with np.errstate(all='ignore'):
        state = mae.estimate(tension, robot.muscle_lengths(theta, tension))
        answers = (*state, mae.muscle_jacobian(theta, tension))
        if not all(np.abs(part).max() <= most for part, most in zip(answers, ABSURD, strict=True)):
            raise CheckpointError('does not restore a posture at rest to finite, sensible values')


def save(mae: Mae, path: str | Path) -> None:
    """Write a checkpoint so that a reader sees the old file or the new one, never a part.

    Raises:
        OSError: If the file cannot be written.
    """
    write_whole(Path(path), to_bytes(mae))


def load(path: str | Path, robot: Robot | None = None) -> Mae:
    """Read a checkpoint file as `from_bytes` does, with a CheckpointError if it cannot be read."""
    return from_bytes(read_bytes(Path(path), _refused, MAX_BYTES), robot, str(path))
