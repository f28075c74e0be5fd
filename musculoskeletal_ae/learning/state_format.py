# SPDX-License-Identifier: Apache-2.0
"""The content of a state file: samples and network as MessagePack after a checksum."""

import zlib
from typing import Annotated

import msgspec
import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import CheckpointError, StateError
from musculoskeletal_ae.learning.samples import SampleStore, StoredSample
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

CHECKSUM = 4  # begin a state file with a checksum of this size [bytes]

Values = tuple[float, ...]  # an array of numbers, as it is saved


class SavedSample(msgspec.Struct, frozen=True, array_like=True):
    """One `Sample` with its number and the muscles that it describes, as in `StoredSample`."""

    number: int
    theta: Values
    tension: Values
    length: Values
    direction: Values
    spread: Values
    gravity: Values
    known: tuple[bool, ...]


class SavedState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a learner saves: its samples, oldest first, and its network as a checkpoint's content.

    `held` are the samples that the store holds back, and `held_offset` the length offsets [m] under
    which they were taken. Both are empty if no samples are held back. `accepted` is the number of
    all samples that the store has ever accepted.
    """

    joints: tuple[str, ...]
    muscles: tuple[str, ...]
    tension_source: str
    samples: tuple[SavedSample, ...]
    held: tuple[SavedSample, ...]
    held_offset: Values
    accepted: Annotated[int, msgspec.Meta(ge=0)]
    network: bytes | None


def collect(robot: Robot, samples: SampleStore, network: bytes | None) -> SavedState:
    """Collect what is saved: the samples of a store, and a network as a checkpoint's content."""
    return SavedState(
        robot.joints,
        robot.muscles,
        robot.tension_source.kind,
        tuple(map(_saved, samples.stored)),
        tuple(map(_saved, samples.held)),
        tuple(samples.offset.tolist()) if samples.held else (),
        samples.accepted,
        network,
    )


def _saved(stored: StoredSample) -> SavedSample:
    theta, tension, length, direction, spread, gravity = (
        tuple(part.tolist()) for part in stored.sample
    )
    known = tuple(stored.known.tolist())
    return SavedSample(stored.number, theta, tension, length, direction, spread, gravity, known)


def to_bytes(state: SavedState) -> bytes:
    """Return a state as the bytes of a state file, which begins with a checksum."""
    content = msgspec.msgpack.encode(state)
    return _checksum(content) + content


def from_bytes(data: bytes, robot: Robot) -> SavedState:
    """Decode and check the content of a state file.

    Raises:
        StateError: If the content is damaged or does not fit the robot. The robot must have the
            same joints in the same order, the same tension source, and at least the muscles of the
            state.
    """
    checksum, content = data[:CHECKSUM], data[CHECKSUM:]
    if checksum != _checksum(content):
        raise StateError('the file is damaged or is not a learner state')
    try:
        state = msgspec.msgpack.decode(content, type=SavedState)
    except msgspec.MsgspecError as error:
        raise StateError(f'another version of the learner saved the state ({error})') from error
    if state.joints != robot.joints or not set(state.muscles) <= set(robot.muscles):
        raise StateError(
            f'the state belongs to a robot with joints {", ".join(state.joints)} and muscles '
            f'{", ".join(state.muscles)}; this robot has {", ".join(robot.joints)} and '
            f'{", ".join(robot.muscles)}'
        )
    if state.tension_source != robot.tension_source.kind:
        raise StateError(
            f'the state was learned with tension_source {state.tension_source!r}; this robot has '
            f'{robot.tension_source.kind!r}'
        )
    for sample in (*state.samples, *state.held):
        if not _fits(sample, robot, len(state.muscles)):
            raise StateError(
                f'the arrays of sample {sample.number} do not have the sizes of this robot'
            )
    if state.held and len(state.held_offset) != len(state.muscles):
        raise StateError(
            f'held_offset has {len(state.held_offset)} values; legal: one for each of the '
            f'{len(state.muscles)} muscles'
        )
    return state


def _checksum(content: bytes) -> bytes:
    return zlib.crc32(content).to_bytes(CHECKSUM, 'big')


def _fits(sample: SavedSample, robot: Robot, muscle_count: int) -> bool:
    joint_count, gravity_size = robot.joint_count, 3 * len(robot.kinematics.tree.parent)
    of_muscles = sample.tension, sample.length, sample.direction, sample.known
    return (
        len(sample.theta) == joint_count
        and all(len(part) == muscle_count for part in of_muscles)
        and len(sample.spread) in (0, joint_count)
        and len(sample.gravity) in (0, gravity_size)
    )


def restore_samples(state: SavedState, robot: Robot, samples: SampleStore) -> None:
    """Add the saved samples to an empty store. Samples that were held back remain held back.

    In these samples, muscles that were added to the robot after the save count as unknown.
    """
    for saved in state.samples:
        stored = _restored(saved, state, robot)
        samples.add(stored.sample, stored.known, stored.number)
    samples.held = [_restored(saved, state, robot) for saved in state.held]
    if samples.held:
        samples.offset = np.full(robot.muscle_count, np.nan)
        samples.offset[list(robot.muscle_indices(state.muscles))] = state.held_offset
    samples.accepted = max(samples.accepted, state.accepted)


def _restored(saved: SavedSample, state: SavedState, robot: Robot) -> StoredSample:
    places = list(robot.muscle_indices(state.muscles))
    theta = np.array(saved.theta)
    # Fill in the unmeasured values of added muscles from the geometric model.
    tension = robot.tension.bias.copy()
    length = robot.muscle_lengths(np.nan_to_num(theta), tension)
    direction = np.zeros(robot.muscle_count)
    known: Bools = np.zeros(robot.muscle_count, dtype=bool)
    tension[places] = saved.tension
    length[places] = saved.length
    direction[places] = saved.direction
    known[places] = saved.known
    spread, gravity = np.array(saved.spread), np.array(saved.gravity)
    sample = Sample(theta, tension, length, direction, spread, gravity)
    return StoredSample(sample, known, saved.number)


def restore_network(state: SavedState, robot: Robot) -> Mae | None:
    """Return the saved network, or None if none was saved.

    Raises:
        StateError: If the saved network lacks muscles of the robot, is not a valid checkpoint, or
            does not explain the robot, which may have been changed since.
    """
    if added := [name for name in robot.muscles if name not in state.muscles]:
        raise StateError(
            f'the saved network lacks the muscles {", ".join(added)}, so only the saved samples '
            'are used'
        )
    if state.network is None:
        return None
    try:
        mae = checkpoint.restored(state.network, robot)
        CheckpointValidator(robot).check(mae)
    except CheckpointError as error:
        raise StateError(
            f'the saved network cannot be used, so only the saved samples are used; reason: {error}'
        ) from error
    return mae
