# SPDX-License-Identifier: Apache-2.0
"""A trained network as safetensors bytes: for files, and for the topic `mae_checkpoint`.

Nothing of a checkpoint is used before all of it has been checked, and every fault is a
`CheckpointError` that names the source, the value, what is legal and what to do. Never pickle.
"""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.mae import metadata
from musculoskeletal_ae.mae.anomaly_statistics import AnomalyStatistics
from musculoskeletal_ae.mae.layers import Layer
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.metadata import Metadata
from musculoskeletal_ae.robot.robot import Robot

# A hundred times the shipped arms' networks.
MAX_BYTES = 64 * 1024 * 1024
MAX_HEADER_BYTES = 1024 * 1024
SMALLEST_EIGENVALUE = 1e-12  # of the largest one
#: beyond what a trained network restores of a posture at rest: rad, N, m
ABSURD = (100.0, 1e5, 100.0)
REMEDY = 'use another checkpoint, or make one with `train`'


def to_bytes(mae: Mae) -> bytes:
    """Return a network as safetensors bytes; `from_bytes` gives back the same bits."""
    tensors: dict[str, Array] = {'mean': mae.mean, 'std': mae.std}
    for name, stack in (('encoder', mae.encoder), ('decoder', mae.decoder)):
        for i, (weight, bias) in enumerate(stack):
            tensors[f'{name}.{i}.weight'] = weight
            tensors[f'{name}.{i}.bias'] = bias
    if mae.anomaly is not None:
        tensors['anomaly.mean'] = mae.anomaly.mean
        tensors['anomaly.covariance'] = mae.anomaly.covariance
    contiguous = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    return save_tensors(contiguous, metadata.to_text(mae))


def from_bytes(data: bytes, robot: Robot | None = None, source: str = 'checkpoint') -> Mae:
    """Return the network of safetensors bytes, checked.

    Args:
        data: What `to_bytes` made.
        robot: The robot it has to fit: same joints and muscles in the same order.
        source: What to call the bytes in a message, such as the file's name.

    Raises:
        CheckpointError: If anything is wrong; the message says what.
    """
    try:
        if len(data) > MAX_BYTES:
            raise CheckpointError(f'{len(data)} bytes; at most {MAX_BYTES} are legal')
        header = _header(data)
        meta = metadata.from_text(header.get('__metadata__'))
        _check_robot(meta, robot)
        tensors = _tensors(data, header, meta)
    except CheckpointError as error:
        # What a hostile header says may hold halves of characters, which no message can carry.
        said = f'{error}'.encode('utf-8', 'backslashreplace').decode()
        raise CheckpointError(f'{source}: {said}; {REMEDY}') from error.__cause__
    depth = len(meta.layer_sizes) // 2
    mae = Mae(
        joints=meta.joints,
        muscles=meta.muscles,
        preset=meta.preset,
        activation=meta.activation,
        encoder=_stack(tensors, 'encoder', depth),
        decoder=_stack(tensors, 'decoder', depth),
        mean=tensors['mean'],
        std=tensors['std'],
        version=meta.version,
        training=meta.training,
        anomaly=None
        if meta.anomaly_calibrated is None
        else AnomalyStatistics(
            tensors['anomaly.mean'],
            tensors['anomaly.covariance'],
            meta.anomaly_calibrated,
            meta.anomaly_samples,
            meta.anomaly_thresholds,
        ),
    )
    if robot is not None and not _restores_something(mae, robot):
        raise CheckpointError(
            f'{source}: does not restore a posture at rest to finite, sensible values; {REMEDY}'
        )
    return mae


def _restores_something(mae: Mae, robot: Robot) -> bool:
    """Return whether the network's answer for the middle posture can be computed with."""
    theta = 0.5 * (robot.lower + robot.upper)
    tension = np.full(robot.muscle_count, robot.tension.bias)
    with np.errstate(all='ignore'):
        state = mae.estimate(tension, robot.muscle_lengths(theta, tension))
        jacobian = mae.muscle_jacobian(theta, tension)
        sensible = [np.abs(part).max() <= most for part, most in zip(state, ABSURD, strict=True)]
        return all(sensible) and bool(np.abs(jacobian).max() <= max(ABSURD))


def save(mae: Mae, path: str | Path) -> None:
    """Write a checkpoint so that a reader sees the old file or the new one, never a part.

    Raises:
        OSError: If the file cannot be written.
    """
    path = Path(path)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(descriptor, 'wb') as file:
            file.write(to_bytes(mae))
            file.flush()
            os.fchmod(file.fileno(), 0o644)  # mkstemp makes it private
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(temporary).unlink()
        raise
    # The new name survives a power cut only once the directory is on disk too.
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def load(path: str | Path, robot: Robot | None = None) -> Mae:
    """Read a checkpoint file; see `from_bytes`.

    Raises:
        CheckpointError: If it cannot be read, is damaged or does not fit the robot.
    """
    try:
        with Path(path).open('rb') as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        raise CheckpointError(f'{path}: cannot be read ({error}); {REMEDY}') from error
    return from_bytes(data, robot, str(path))


def _header(data: bytes) -> dict[str, object]:
    size = int.from_bytes(data[:8], 'little')
    if len(data) < 8 or not 2 <= size <= min(MAX_HEADER_BYTES, len(data) - 8):
        raise CheckpointError(
            f'{len(data)} bytes with a header of {size} bytes are not safetensors '
            f'(a header has 2 to {MAX_HEADER_BYTES} bytes and lies inside the file)'
        )
    return metadata.parse_object(data[8 : 8 + size], 'header')


def _check_robot(meta: Metadata, robot: Robot | None) -> None:
    if robot is None:
        return
    for what, ours, theirs in (
        ('joints', meta.joints, robot.joints),
        ('muscles', meta.muscles, robot.muscles),
    ):
        if ours != theirs:
            raise CheckpointError(
                f'made for {what} {", ".join(ours)}; '
                f'this robot has {", ".join(theirs)}, in this order'
            )


def _tensors(data: bytes, header: dict[str, object], meta: Metadata) -> dict[str, Array]:
    legal = meta.tensor_shapes()
    found = set(header) - {'__metadata__'}
    if found != set(legal):
        odd = ', '.join(sorted(found ^ set(legal)))
        raise CheckpointError(f'tensors missing or unknown: {odd[:200]}')
    for name, shape in legal.items():
        entry = header[name]
        kind = entry.get('dtype') if isinstance(entry, dict) else None
        if kind != 'F64':
            raise CheckpointError(f'tensor {name} is of type {kind!r}; only F64 is legal')
        if not isinstance(entry, dict) or entry.get('shape') != list(shape):
            given = entry.get('shape') if isinstance(entry, dict) else None
            raise CheckpointError(f'tensor {name} has shape {given!r}; {list(shape)} is legal')
    try:
        tensors: dict[str, Array] = load_tensors(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f'not valid safetensors ({error})') from error
    for name, value in tensors.items():
        if not np.isfinite(value).all() or np.abs(value).max(initial=0.0) > metadata.LARGEST:
            raise CheckpointError(
                f'tensor {name} holds a value that is not finite or beyond ±{metadata.LARGEST:g}'
            )
    if tensors['std'].min() < metadata.SMALLEST_STD:
        raise CheckpointError(
            f'tensor std holds {tensors["std"].min():g}; '
            f'at least {metadata.SMALLEST_STD:g} is legal'
        )
    if 'anomaly.covariance' in tensors:
        _check_covariance(tensors['anomaly.covariance'])
    return tensors


def _check_covariance(covariance: Array) -> None:
    if not np.array_equal(covariance, covariance.T):
        raise CheckpointError('tensor anomaly.covariance is not symmetric')
    try:
        least, *_, most = np.linalg.eigvalsh(covariance)
    except np.linalg.LinAlgError as error:
        raise CheckpointError('tensor anomaly.covariance has no eigenvalues') from error
    # Nearer to singular it could not be inverted, as the detector does.
    if not least > SMALLEST_EIGENVALUE * most:
        raise CheckpointError(
            f'tensor anomaly.covariance has eigenvalues from {least:g} to {most:g}; the least must '
            f'be positive and above {SMALLEST_EIGENVALUE:g} times the largest'
        )


def _stack(tensors: dict[str, Array], name: str, depth: int) -> tuple[Layer, ...]:
    return tuple((tensors[f'{name}.{i}.weight'], tensors[f'{name}.{i}.bias']) for i in range(depth))
