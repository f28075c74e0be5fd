# SPDX-License-Identifier: Apache-2.0
"""The text part of a checkpoint: written, parsed and checked.

safetensors allows strings only, so every value is JSON text.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.mae.layers import ACTIVATIONS
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import UNITS
from musculoskeletal_ae.presets import PRESETS

FORMAT_VERSION = 1
KEYS = (
    'format_version',
    'joints',
    'muscles',
    'layer_sizes',
    'activation',
    'units',
    'preset',
    'version',
    'training',
    'anomaly_calibrated',
    'anomaly_samples',
    'anomaly_thresholds',
)
MAX_NAMES = 1000
MAX_UNITS = 4096
MAX_TEXT = 10_000
# A weight or spread beyond these is no trained network, and could overflow where they are folded.
LARGEST = 1e9
SMALLEST_STD = 1e-9


@dataclass(frozen=True)
class Metadata:
    """Checked metadata; anomaly_calibrated is None where there are no statistics."""

    joints: tuple[str, ...]
    muscles: tuple[str, ...]
    layer_sizes: tuple[int, ...]
    activation: str
    preset: str
    version: int
    training: str
    anomaly_calibrated: bool | None
    anomaly_samples: int
    anomaly_thresholds: Mapping[str, float]

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return name and shape of every tensor that belongs to this metadata."""
        values = len(self.joints) + 2 * len(self.muscles)
        shapes: dict[str, tuple[int, ...]] = {'mean': (values,), 'std': (values,)}
        depth = len(self.layer_sizes) // 2
        for i, (into, out) in enumerate(zip(self.layer_sizes, self.layer_sizes[1:], strict=False)):
            name = f'encoder.{i}' if i < depth else f'decoder.{i - depth}'
            shapes[f'{name}.weight'] = (out, into)
            shapes[f'{name}.bias'] = (out,)
        if self.anomaly_calibrated is not None:
            muscles = 2 * len(self.muscles)
            shapes |= {'anomaly.mean': (muscles,), 'anomaly.covariance': (muscles, muscles)}
        return shapes


def to_text(mae: Mae) -> dict[str, str]:
    """Return the metadata of a network as safetensors stores it."""
    anomaly = mae.anomaly
    entries: dict[str, object] = {
        'format_version': FORMAT_VERSION,
        'joints': mae.joints,
        'muscles': mae.muscles,
        'layer_sizes': mae.layer_sizes,
        'activation': mae.activation,
        'units': UNITS,
        'preset': mae.preset,
        'version': mae.version,
        'training': mae.training,
        'anomaly_calibrated': None if anomaly is None else anomaly.calibrated,
        'anomaly_samples': 0 if anomaly is None else anomaly.samples,
        'anomaly_thresholds': {} if anomaly is None else dict(anomaly.thresholds),
    }
    return {key: json.dumps(value, allow_nan=False) for key, value in entries.items()}


def parse_object(text: bytes | str, what: str) -> dict[str, Any]:
    """Return the JSON object of a text that may be hostile."""
    value = _parse(text, what)
    if not isinstance(value, dict):
        raise CheckpointError(f'{what} is not a JSON object')
    return value


def from_text(entries: object) -> Metadata:
    """Check the metadata of a safetensors header.

    Raises:
        CheckpointError: Naming the key, its value and what is legal.
    """
    if not isinstance(entries, dict):
        raise CheckpointError('no metadata; this is not a checkpoint of musculoskeletal_ae')
    # Before all else: a newer format may differ in everything that is checked below.
    version = _parse(entries.get('format_version'), 'format_version')
    if not _is_int(version, 1, FORMAT_VERSION):
        raise CheckpointError(
            f'format_version {_short(version)}; this program reads 1 to {FORMAT_VERSION}'
        )
    if set(entries) != set(KEYS):
        odd = ', '.join(sorted(map(str, set(entries) ^ set(KEYS))))
        raise CheckpointError(f'metadata missing or unknown: {odd[:200]}')
    values = {key: _parse(entries[key], key) for key in KEYS}
    joints, muscles = _names(values['joints'], 'joints'), _names(values['muscles'], 'muscles')
    _legal('units', values['units'], (UNITS,))
    calibrated = values['anomaly_calibrated']
    if calibrated is not None and not isinstance(calibrated, bool):
        _fail('anomaly_calibrated', calibrated, 'true, false or null')
    training = values['training']
    if not isinstance(training, str) or len(training) > MAX_TEXT:
        _fail('training', training, f'text of at most {MAX_TEXT} characters')
    return Metadata(
        joints=joints,
        muscles=muscles,
        layer_sizes=_layer_sizes(values['layer_sizes'], len(joints), len(muscles)),
        activation=_legal('activation', values['activation'], tuple(ACTIVATIONS)),
        preset=_legal('preset', values['preset'], tuple(PRESETS)),
        version=_count(values['version'], 'version'),
        training=training,
        anomaly_calibrated=calibrated,
        anomaly_samples=_count(values['anomaly_samples'], 'anomaly_samples'),
        anomaly_thresholds=_thresholds(values['anomaly_thresholds']),
    )


def _parse(text: object, what: str) -> Any:
    if not isinstance(text, str | bytes):
        raise CheckpointError(f'{what} is missing or not text')

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f'{constant} is not a number')

    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:  # includes UnicodeDecodeError
        raise CheckpointError(f'{what} is not valid JSON ({error})') from error


def _names(value: Any, what: str) -> tuple[str, ...]:
    if (
        not isinstance(value, list)
        or not 1 <= len(value) <= MAX_NAMES
        or not all(isinstance(name, str) and name.isprintable() and name for name in value)
        or len(set(value)) != len(value)
    ):
        _fail(what, value, f'1 to {MAX_NAMES} different names of printable characters')
    return tuple(value)


def _layer_sizes(value: Any, joints: int, muscles: int) -> tuple[int, ...]:
    sizes = tuple(value) if isinstance(value, list) else ()
    ends = joints + 2 * muscles + 3, joints + muscles, joints + 2 * muscles
    # Encoder and decoder have the same hidden layers, so the latent one stands in the middle.
    if (
        not 3 <= len(sizes) <= 21
        or len(sizes) % 2 == 0
        or not all(_is_int(size, 1, MAX_UNITS) for size in sizes)
        or (sizes[0], sizes[len(sizes) // 2], sizes[-1]) != ends
    ):
        legal = f'{ends[0]}, …, {ends[1]}, …, {ends[2]} with 1 to {MAX_UNITS} units between'
        _fail('layer_sizes', value, legal)
    return sizes


def _thresholds(value: Any) -> dict[str, float]:
    if (
        not isinstance(value, dict)
        or len(value) > MAX_NAMES
        or not all(
            isinstance(number, int | float)
            and not isinstance(number, bool)
            and abs(number) <= LARGEST
            and math.isfinite(number)
            for number in value.values()
        )
    ):
        _fail('anomaly_thresholds', value, f'names with numbers within ±{LARGEST:g}')
    return {key: float(number) for key, number in value.items()}


def _count(value: Any, what: str) -> int:
    if not _is_int(value, 0, 2**53):
        _fail(what, value, 'a whole number >= 0')
    return int(value)


def _is_int(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _legal(what: str, value: Any, legal: tuple[str, ...]) -> str:
    if not isinstance(value, str) or value not in legal:
        _fail(what, value, ' or '.join(map(repr, legal)))
    return value


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else f'{text[:100]}…'


def _fail(what: str, value: Any, legal: str) -> NoReturn:
    raise CheckpointError(f'{what} is {_short(value)}; legal: {legal}')
