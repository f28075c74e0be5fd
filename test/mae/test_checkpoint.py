# SPDX-License-Identifier: Apache-2.0

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.mae.checkpoint import from_bytes, load, save, to_bytes
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, TouchStatistics
from musculoskeletal_ae.robot.robot import Robot


def small() -> Mae:
    """A network small enough to damage every byte: one joint, two muscles, hidden layers of 4."""
    rng = np.random.default_rng(0)
    sizes = (8, 4, 3, 4, 5)
    stack = [(rng.normal(size=(o, i)), rng.normal(size=o)) for i, o in pairwise(sizes)]
    return Mae(
        joints=('knee',),
        muscles=('quad', 'ham'),
        preset='default',
        activation='silu',
        encoder=tuple(stack[:2]),
        decoder=tuple(stack[2:]),
        mean=rng.normal(size=5),
        std=np.ones(5),
        version=7,
        training='by hand; θ',
        anomaly=replace(
            AnomalyStatistics.of(rng.normal(size=(50, 4)), True), thresholds={'norm': 0.25}
        ),
    )


GOOD = to_bytes(small())


def rewritten(header_change) -> bytes:
    size = int.from_bytes(GOOD[:8], 'little')
    header = json.loads(GOOD[8 : 8 + size])
    header = header_change(header) or header
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, 'little') + text + GOOD[8 + size :]


def with_metadata(**changes) -> bytes:
    def change(header):
        header['__metadata__'].update({k: json.dumps(v) for k, v in changes.items()})

    return rewritten(change)


def arrays(mae: Mae):
    result = [part for layer in (*mae.encoder, *mae.decoder) for part in layer]
    result += [mae.mean, mae.std]
    if mae.anomaly is not None:
        result += [mae.anomaly.mean, mae.anomaly.covariance]
    return result


def check_same(one: Mae, two: Mae) -> None:
    for a, b in zip(arrays(one), arrays(two), strict=True):
        assert a.tobytes() == b.tobytes()
    for name in ('joints', 'muscles', 'preset', 'activation', 'version', 'training'):
        assert getattr(one, name) == getattr(two, name)
    if one.anomaly is not None:
        assert one.anomaly.calibrated is two.anomaly.calibrated
        assert one.anomaly.samples == two.anomaly.samples
        assert dict(one.anomaly.thresholds) == dict(two.anomaly.thresholds)


def test_round_trip_keeps_every_bit(mae, robot):
    check_same(mae, from_bytes(to_bytes(mae), robot))
    check_same(small(), from_bytes(GOOD))
    bare = replace(small(), anomaly=None)
    assert from_bytes(to_bytes(bare)).anomaly is None
    check_same(bare, from_bytes(to_bytes(bare)))


def test_what_one_joint_has_learned_is_read_back():
    learned = replace(small(), covariance=np.array([[1e-4]]), length_spread=np.array([0.0, 0.002]))
    back = from_bytes(to_bytes(learned))
    check_same(learned, back)
    np.testing.assert_array_equal(back.covariance, learned.covariance)
    np.testing.assert_array_equal(back.length_spread, learned.length_spread)


def test_a_file_written_in_this_format_is_read():
    read = load(Path(__file__).parent / 'format_1.safetensors')
    for ours, theirs in zip(arrays(read), arrays(small()), strict=True):
        # Each processor rounds the covariance differently.
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    for name in ('joints', 'muscles', 'preset', 'activation', 'version', 'training'):
        assert getattr(read, name) == getattr(small(), name)
    assert read.anomaly.calibrated and read.anomaly.thresholds == {'norm': 0.25}


def test_file_round_trip_leaves_nothing_beside_it(mae, robot, tmp_path):
    file = tmp_path / 'a.safetensors'
    file.write_bytes(b'old')
    save(mae, file)
    check_same(mae, load(file, robot))
    assert [p.name for p in tmp_path.iterdir()] == ['a.safetensors']


def test_failed_write_keeps_the_old_file(mae, tmp_path, monkeypatch):
    file = tmp_path / 'a.safetensors'
    file.write_bytes(b'old')
    monkeypatch.setattr('os.fsync', lambda _: (_ for _ in ()).throw(OSError('disk full')))
    with pytest.raises(OSError, match='disk full'):
        save(mae, file)
    assert file.read_bytes() == b'old'
    assert [p.name for p in tmp_path.iterdir()] == ['a.safetensors']


def test_metadata_says_what_the_checkpoint_is(mae, robot, tmp_path):
    save(mae, tmp_path / 'a')
    with safe_open(tmp_path / 'a', 'numpy') as file:
        text = {key: json.loads(value) for key, value in file.metadata().items()}
    assert text['format_version'] == 1
    assert text['joints'] == list(robot.joints)
    assert text['muscles'] == list(robot.muscles)
    assert text['layer_sizes'] == list(mae.layer_sizes)
    assert text['anomaly_calibrated'] is False
    assert 'arm26' in text['training']


def test_checkpoint_of_another_robot_is_refused_by_name(mae):
    with pytest.raises(CheckpointError, match=r'joints shoulder.*shoulder_roll'):
        from_bytes(to_bytes(mae), Robot.load('musashi_left_arm'))


def test_permuted_muscles_are_refused(mae, robot):
    permuted = replace(mae, muscles=mae.muscles[::-1])
    with pytest.raises(CheckpointError, match='in this order'):
        from_bytes(to_bytes(permuted), robot)


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        ({'format_version': 2}, 'format_version 2; legal: 1'),
        ({'format_version': True}, 'format_version'),
        ({'extra': 1}, "unknown key 'extra'; legal keys: format_version, units"),
        ({'joints': [1]}, r'\$.joints\[0\]: expected str, got int: 1'),
        ({'joints': ['kn\nee']}, 'printable'),
        ({'muscles': ['quad', 'quad']}, 'printable names, each at most once'),
        ({'layer_sizes': [8, 4, 3, 4, 6]}, 'layer_sizes'),
        ({'layer_sizes': [8, 5, 3, 5, 5]}, 'shape'),
        ({'layer_sizes': [8, 10**12, 3, 10**12, 5]}, r'layer_sizes\[1\]: expected int <= 4096'),
        ({'activation': 'relu'}, 'expected one of silu, tanh'),
        ({'preset': 'other'}, 'legal: default, paper'),
        ({'units': 'degree'}, 'units'),
        ({'version': -1}, 'version: expected int >= 0, got -1'),
        ({'isolated': [2]}, 'indices of muscles, 0 to 1, each at most once'),
        ({'anomaly_calibrated': None}, 'unknown tensors: anomaly'),
        ({'elastic': True}, 'missing tensors: elasticity'),
        ({'anomaly_thresholds': {'norm': float('nan')}}, 'NaN'),
        ({'anomaly_thresholds': {'norm': 10**400}}, 'anomaly_thresholds'),
    ],
)
def test_wrong_metadata_is_refused_by_name(change, problem):
    with pytest.raises(CheckpointError, match=problem):
        from_bytes(with_metadata(**change))


def test_an_entry_that_is_missing_is_named():
    with pytest.raises(CheckpointError, match="key 'touch_time' is missing"):
        from_bytes(rewritten(lambda header: header['__metadata__'].pop('touch_time') and None))


@pytest.mark.parametrize('name', ['mean', 'std', 'encoder.0.weight', 'anomaly.covariance'])
@pytest.mark.parametrize('value', [np.nan, 1e300])
def test_numbers_that_are_no_weights_are_refused(name, value):
    size = int.from_bytes(GOOD[:8], 'little')
    start = json.loads(GOOD[8 : 8 + size])[name]['data_offsets'][0] + 8 + size
    data = GOOD[:start] + np.float64(value).tobytes() + GOOD[start + 8 :]
    with pytest.raises(CheckpointError, match=name):
        from_bytes(data)


def test_zero_spread_is_refused():
    with pytest.raises(CheckpointError, match='std'):
        from_bytes(to_bytes(replace(small(), std=np.full(5, 1e-30))))


def test_a_negative_spread_of_lengths_is_refused():
    with pytest.raises(CheckpointError, match=r'length_spread has the value -0\.1; legal: 0 or'):
        from_bytes(to_bytes(replace(small(), length_spread=np.array([0.1, -0.1]))))


@pytest.mark.parametrize(
    'covariance',
    [
        -np.eye(4),
        np.triu(np.ones((4, 4))),
        np.zeros((4, 4)),
        np.ones((4, 4)) + 1e-15 * np.eye(4),
    ],
)
def test_covariance_that_is_none_is_refused(covariance):
    good = small()
    bad = replace(good, anomaly=replace(good.anomaly, covariance=covariance))
    with pytest.raises(CheckpointError, match='covariance'):
        from_bytes(to_bytes(bad))


def test_weights_that_cannot_be_computed_with_are_refused_for_a_robot(mae, robot):
    huge = tuple((np.full_like(weight, 1e9), bias) for weight, bias in mae.decoder)
    data = to_bytes(replace(mae, decoder=huge))
    from_bytes(data)
    with pytest.raises(CheckpointError, match='middle posture'):
        from_bytes(data, robot)


@pytest.mark.parametrize('key', ['extra\ud800', 'joints'])
def test_whatever_a_header_holds_its_refusal_can_be_sent_in_a_message(key):
    with pytest.raises(CheckpointError) as refused:
        from_bytes(with_metadata(**{key: ['\ud800']}))
    assert str(refused.value).encode()


@pytest.mark.parametrize(
    ('data', 'problem'),
    [
        (b'', 'it has 0 bytes; legal: at least 10'),
        # a file of pickle, which must never be executed
        (b'\x80\x04N.', 'it has 4 bytes; legal: at least 10'),
        ((2**63).to_bytes(8, 'little') + b'{}', f'a header of {2**63} bytes; legal: 2 to 2'),
        ((2).to_bytes(8, 'little') + b'{}', 'no metadata'),
        ((200_000).to_bytes(8, 'little') + b'[' * 200_000, 'no metadata'),
    ],
)
def test_bytes_that_are_no_checkpoint_are_refused(data, problem):
    with pytest.raises(CheckpointError, match=f'{problem}.*train'):
        from_bytes(data)


def test_deep_metadata_is_refused():
    def change(header):
        header['__metadata__']['joints'] = '[' * 50_000

    with pytest.raises(CheckpointError, match='joints'):
        from_bytes(rewritten(change))


def test_float32_weights_are_refused_by_type():
    tensors = {name: value.astype(np.float32) for name, value in load_tensors(GOOD).items()}
    size = int.from_bytes(GOOD[:8], 'little')
    metadata = json.loads(GOOD[8 : 8 + size])['__metadata__']
    with pytest.raises(CheckpointError, match='float32; legal: float64'):
        from_bytes(save_tensors(tensors, metadata))


def test_missing_file_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r'none\.safetensors'):
        load(tmp_path / 'none.safetensors')
    with pytest.raises(CheckpointError, match='cannot be read'):
        load(tmp_path)


@given(st.integers(0, len(GOOD) - 1), st.integers(1, 255))
def test_any_changed_byte_gives_a_sound_network_or_a_checkpoint_error(place, flip):
    data = bytearray(GOOD)
    data[place] ^= flip
    try:
        mae = from_bytes(bytes(data))
    except CheckpointError:
        return
    # A flipped bit of a weight cannot be noticed if it results in another finite weight.
    assert all(np.isfinite(part).all() for part in arrays(mae))


@given(st.integers(0, len(GOOD) - 1))
def test_any_truncated_file_is_refused(length):
    with pytest.raises(CheckpointError):
        from_bytes(GOOD[:length])


@given(st.binary(max_size=200))
def test_any_header_gives_a_checkpoint_error(header):
    with pytest.raises(CheckpointError):
        from_bytes(len(header).to_bytes(8, 'little') + header)


def test_contact_statistics_are_restored_and_invalid_values_are_refused():
    peaks = np.array([3.5, 4.1, 3.0])
    touch = TouchStatistics(np.array([0.1, 0.05]), np.array([0.3]), 90.0, peaks=peaks)
    mae = from_bytes(to_bytes(replace(small(), touch=touch)))
    assert mae.touch.time == 90.0 and mae.touch.calibrated
    np.testing.assert_array_equal(mae.touch.peaks, peaks)
    np.testing.assert_array_equal(mae.touch.friction, touch.friction)
    np.testing.assert_array_equal(mae.touch.spread, touch.spread)
    assert small().touch is None and from_bytes(GOOD).touch is None
    for wrong, problem in (
        (replace(touch, friction=np.array([0.1, 9.0])), 'touch.friction has a value of ±9'),
        (replace(touch, spread=np.zeros(1)), 'touch.spread has the value 0'),
        (replace(touch, time=-1.0), 'touch_time'),
        (replace(touch, peaks=-peaks), 'touch.peaks has the value -4.1'),
        (replace(touch, spread=np.ones(2)), 'touch.spread has shape'),
    ):
        with pytest.raises(CheckpointError, match=problem):
            from_bytes(to_bytes(replace(small(), touch=wrong)))
