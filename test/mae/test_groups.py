# SPDX-License-Identifier: Apache-2.0
"""A body of several limbs: the groups that its routes form, and a network with a block for each."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.mae.checkpoint import from_bytes, to_bytes
from musculoskeletal_ae.mae.default_training import MOST_STEPS, blocks, default_steps, grown
from musculoskeletal_ae.mae.network import Network, from_mae, to_mae
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.robot.groups import Group, groups, parts
from musculoskeletal_ae.robot.robot import Robot

# Three limbs. The indices of their joints and muscles are interleaved, because a user may list
# joints and muscles in any order.
LIMBS = (Group((0, 4), (1, 6, 7, 8)), Group((1,), (0, 5)), Group((2, 3), (2, 3, 4)))
JOINTS, MUSCLES = 5, 9


#: bases of the limbs' blocks; in the second case, the first and the last limb depend on the second
#: one, as fingers depend on the wrist
BASES = (0, 1, 2), (1, 1, 1)


@pytest.fixture(scope='module', params=BASES)
def mae(request):
    rng = np.random.default_rng(0)
    mean, std = rng.normal(size=23), rng.uniform(0.5, 2.0, 23)
    torch.manual_seed(0)
    blocks = {limb: (6 + i, 4) for i, limb in enumerate(LIMBS)}
    network = Network(JOINTS, MUSCLES, blocks, 'silu', mean, std, request.param)
    return to_mae(network, tuple('abcde'), tuple('ABCDEFGHI'), 'default', '')


def read_by(mae):
    """Return the joints and muscles of each block's own group, and those that it reads."""
    for group, base in zip(LIMBS, mae.bases):
        read = {group, LIMBS[base]}
        yield *group, [j for g in read for j in g.joints], [m for g in read for m in g.muscles]


@pytest.fixture
def state():
    rng = np.random.default_rng(1)
    sizes = (7, JOINTS), (7, MUSCLES), (7, MUSCLES)
    return [scale * rng.normal(size=size) for scale, size in zip((1.0, 100.0, 0.1), sizes)]


def test_two_arms_and_a_neck_are_three_groups():
    robot = Robot.load('musashi_upper_body')
    named = [
        ({robot.joints[j].split('_')[0] for j in g.joints}, len(g.muscles)) for g in robot.groups
    ]
    assert named == [({'left'}, 14), ({'right'}, 14), ({'neck'}, 12)]


@pytest.mark.parametrize('name', ['arm26', 'musashi_left_arm'])
def test_one_arm_is_one_group(name):
    robot = Robot.load(name)
    assert robot.groups == (Group.whole(robot.joint_count, robot.muscle_count),)


def test_groups_are_what_muscles_connect_however_they_are_listed():
    crossed = np.zeros((MUSCLES, JOINTS), dtype=bool)
    for joints, muscles in LIMBS:
        # Only the first muscle of a limb crosses two joints, and thereby connects them.
        for k, muscle in enumerate(muscles):
            crossed[muscle, joints[k % len(joints)]] = True
            crossed[muscle, joints[(k + 1) % len(joints)]] |= k == 0
    assert groups(crossed) == LIMBS


def test_a_joint_without_muscles_and_a_muscle_without_joints_are_in_some_group():
    crossed = np.array([[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]], dtype=bool)
    result = groups(crossed)
    for whole, each in zip((range(4), range(3)), zip(*result)):
        assert sorted(sum(each, ())) == [*whole]
    assert all(joints and muscles for joints, muscles in result)


def test_fingers_depend_on_the_wrist_and_not_on_each_other():
    # Joints 0 and 1 are the wrist; the others are three fingers of two joints each.
    crossed = np.zeros((11, 8), dtype=bool)
    crossed[[0, 1], [0, 1]] = True
    for finger in range(3):
        joints, muscles = 2 + 2 * finger + np.arange(2), 2 + 3 * finger + np.arange(3)
        crossed[np.ix_(muscles[:2], joints)] = True
        crossed[muscles[0], :2] = crossed[muscles[2], joints[0]] = True
    order = np.array([3, 0, 5, 1, 2, 7, 4, 6])
    wrist, *fingers = parts(crossed[:, order], Group.whole(8, 11))
    assert {order[j] for j in wrist.joints} == {0, 1}
    assert wrist.muscles == (0, 1)
    found = {(frozenset(order[list(g.joints)].tolist()), g.muscles) for g in fingers}
    assert found == {
        (frozenset((2, 3)), (2, 3, 4)),
        (frozenset((4, 5)), (5, 6, 7)),
        (frozenset((6, 7)), (8, 9, 10)),
    }


def test_a_chain_whose_muscles_cross_neighbours_is_not_divided():
    crossed = np.eye(4, dtype=bool) | np.eye(4, k=1, dtype=bool)
    assert parts(crossed, Group.whole(4, 4)) == (Group.whole(4, 4),)


def test_layers_and_training_steps_grow_with_a_large_group():
    arm, small, large = (Group.whole(*sizes) for sizes in ((5, 10), (2, 6), (7, 14)))
    layers = blocks((arm, small, large))
    assert list(layers.values()) == [(200, 100), (200, 100), (280, 140)]
    assert grown(3000, (arm, small)) == 3000
    assert grown(3000, (arm, large, small)) == 4200
    assert default_steps((arm, large, small)) == round(3000 * 1.4**1.5)
    assert default_steps((Group.whole(7, 40),)) == MOST_STEPS


@pytest.mark.parametrize('index', range(3))
def test_numpy_agrees_with_torch(mae, state, index):
    scaled = np.concatenate([state[0], state[1] / 200.0, 10.0 * state[2]], axis=1)
    with torch.no_grad():
        expected = from_mae(mae)(torch.tensor(scaled).float(), torch.full((7,), index))
    z = mae.encode(list(Mask)[index], *state)
    assert z.shape == (7, JOINTS + MUSCLES)
    np.testing.assert_allclose(mae.decode_scaled(z), expected.numpy(), atol=1e-5)
    np.testing.assert_allclose(mae.decode(z).scaled(), expected.numpy(), atol=1e-5)


def test_a_limb_is_estimated_from_its_own_muscles_and_those_of_its_base_alone(mae, state):
    _, tension, length = state
    before = mae.estimate(tension, length)
    for joints, _, _, muscles in read_by(mae):
        others = np.delete(np.arange(MUSCLES), muscles)
        other = [part.copy() for part in (tension, length)]
        for part in other:
            part[:, others] += 1.0
        changed = mae.estimate(*other).theta != before.theta
        assert not changed[:, joints].any()
    assert (mae.estimate(tension + 1.0, length + 1.0).theta != before.theta).all()


def test_the_muscle_jacobian_is_the_slope_of_the_lengths_and_zero_between_limbs(mae, state):
    theta, tension, _ = state
    jacobian = mae.muscle_jacobian(theta, tension)
    step = 0.1 * np.eye(JOINTS)[:, None]
    ahead, behind = (mae.lengths(theta + s * step, np.tile(tension, (JOINTS, 1, 1)))
                     for s in (1.0, -1.0))  # fmt: skip
    difference = np.moveaxis((ahead - behind) / 0.2, 0, -1)
    np.testing.assert_allclose(jacobian, difference, atol=2e-2 * np.abs(jacobian).max())
    own = np.zeros((MUSCLES, JOINTS), dtype=bool)
    for _, muscles, joints, _ in read_by(mae):
        own[np.ix_(muscles, joints)] = True
    assert (jacobian[:, ~own] == 0.0).all()
    assert (jacobian[:, own] != 0.0).all()
    _, pullback = mae.lengths_with_pullback(theta, tension)
    expected = np.einsum('nmd,nm->nd', jacobian, tension)
    np.testing.assert_allclose(pullback(tension.copy()), expected, rtol=1e-4, atol=1e-3)


def test_a_checkpoint_stores_the_groups_and_gives_the_same_answers(mae, state):
    again = from_bytes(to_bytes(mae))
    assert (again.groups, again.bases) == (LIMBS, mae.bases)
    for part, expected in zip(again.estimate(*state[1:]), mae.estimate(*state[1:])):
        np.testing.assert_array_equal(part, expected)


@pytest.mark.parametrize(
    ('change', 'says'),
    [
        ({'groups': LIMBS[:2]}, 'each joint and muscle in exactly one group'),
        ({'groups': 3}, 'groups'),
        ({'layer_sizes': [1, 2, 3]}, 'layer_sizes'),
        ({'bases': [0, 1]}, 'bases'),
        ({'bases': [0, 0, 3]}, 'bases'),
        ({'bases': [1, 2, 2]}, 'and for a base its own'),
    ],
)
def test_groups_that_do_not_fit_are_refused(mae, change, says):
    data = to_bytes(mae)
    size = int.from_bytes(data[:8], 'little')
    header = json.loads(data[8 : 8 + size])
    header['__metadata__'] |= {key: json.dumps(value) for key, value in change.items()}
    text = json.dumps(header).encode()
    with pytest.raises(CheckpointError, match=says):
        from_bytes(len(text).to_bytes(8, 'little') + text + data[8 + size :])


def test_training_goes_on_from_a_network_of_groups(mae):
    network = from_mae(replace(mae, version=3))
    again = to_mae(network, mae.joints, mae.muscles, 'default', '')
    assert (again.groups, again.bases) == (mae.groups, mae.bases)
    assert again.layer_sizes == mae.layer_sizes
    for (w1, b1), (w2, b2) in zip(again.encoder + again.decoder, mae.encoder + mae.decoder):
        np.testing.assert_array_equal(w1, w2)
        np.testing.assert_array_equal(b1, b2)
