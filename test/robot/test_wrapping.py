# SPDX-License-Identifier: Apache-2.0
"""Tendons around spheres and cylinders and through rings: lengths, gradients, lift-off, drawing."""

import numpy as np
import pytest
from differences import slopes
from hypothesis import example, given
from hypothesis import strategies as st
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.design import route_jumps
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.wrapping import WrapObjects, wrapped_segments

NONE = [np.nan] * 3
ROUND = {'wrap': 'cylinder', 'link': 'upper', 'axis': [0.1, 2.0, 0.0]}
WRAPS = {
    'ball': {'wrap': 'sphere', 'link': 'upper', 'xyz': [0.0, 0.0, -0.3], 'radius': 0.03},
    'drum': {**ROUND, 'xyz': [0.0, 0.0, -0.3], 'radius': 0.03},
    'sided': {**ROUND, 'xyz': [0.0, 0.0, -0.3], 'radius': 0.03, 'side': [-0.2, 0.0, -0.3]},
    'ring': {**ROUND, 'xyz': [-0.06, 0.0, -0.3], 'radius': 0.01, 'side': [-0.06, 0.0, -0.3]},
}


def wire(start, end, radius, axis=(0, 0, 0), side=NONE):
    one = (np.array(v, float)[None] for v in (np.zeros(3), axis, side))
    root = np.zeros(1, np.int64)
    objects = WrapObjects(
        root, *one, side_joint=root, radius=np.array([float(radius)]), swivels=np.zeros(1, bool)
    )
    ends = (np.array(v, float)[None, None] for v in (start, end))
    length, leave, arrive = wrapped_segments(
        objects, np.eye(3)[None, None], np.zeros((1, 1, 3)), *ends
    )
    return length[0, 0], leave[0, 0], arrive[0, 0]


@pytest.fixture(scope='module', params=WRAPS)
def robot(request, tmp_path_factory):
    """Return an arm whose muscle `straightener` wraps around an object at the elbow."""
    directory = write_robot(tmp_path_factory.mktemp('wraps'))
    document = read_muscles(directory)
    route = next(m['route'] for m in document['muscles'] if m['name'] == 'straightener')
    route[1:2] = [WRAPS[request.param]]
    return Robot.load(write_muscles(directory, document))


@pytest.mark.parametrize(
    ('start', 'end', 'expected'),
    [
        ([1.0, -0.5, 0.0], [1.0, 0.5, 0.0], 1.0),  # the tendon misses the ball
        ([1.0, -0.5, 0.0], [-1.0, -0.5, 0.0], 2.0),  # the tendon just touches the ball
        # The straight line passes through the centre of the ball: two tangents and an arc.
        ([1, 0, 0], [-1, 0, 0], 2 * np.sqrt(0.75) + 0.5 * (np.pi - 2 * np.arccos(0.5))),
    ],
)
def test_a_tendon_is_straight_or_two_tangents_and_an_arc(start, end, expected):
    assert wire(start, end, 0.5)[0] == pytest.approx(expected)


point = st.tuples(*[st.floats(-0.3, 0.3)] * 3)


@given(point, point, st.floats(0.001, 0.1))
# The centre and both ends are almost on one line, so that they hardly define a plane.
@example((0.0, 0.001, 1.4641753369134492e-12), (0.0, 0.25, 0.0), 0.001)
def test_wrapping_never_shortens_and_pulls_with_unit_force(start, end, radius):
    straight = np.linalg.norm(np.subtract(end, start))
    value, leave, arrive = wire(start, end, radius)
    assert value >= straight - 1e-9
    if straight > 1e-6:
        assert np.linalg.norm(leave) == pytest.approx(1.0, abs=1e-4)
        assert np.linalg.norm(arrive) == pytest.approx(1.0, abs=1e-4)


def test_a_tendon_over_a_drum_is_the_geodesic():
    # Unrolled, the path is straight: two tangents of 0.3 m and half a turn around the drum, while
    # the tendon rises by 0.2 m.
    flat = 2 * 0.3 + np.pi * 0.1
    length, leave, _ = wire([0.1, -0.3, 0], [-0.1, -0.3, 0.2], 0.1, (0, 0, 1), [0, 5, 0])
    assert length == pytest.approx(np.hypot(flat, 0.2))
    np.testing.assert_allclose(leave, np.array([0, flat, 0.2]) / length, atol=1e-9)


def test_the_side_point_decides_the_direction_around_a_drum():
    near, _, _ = wire([0.2, 0.05, 0], [-0.2, 0.05, 0], 0.1, (0, 0, 1), [0, 1, 0])
    far, _, _ = wire([0.2, 0.05, 0], [-0.2, 0.05, 0], 0.1, (0, 0, 1), [0, -1, 0])
    free, _, _ = wire([0.2, 0.05, 0], [-0.2, 0.05, 0], 0.1, (0, 0, 1))
    assert near == pytest.approx(free)
    assert far > near + 0.05


def test_a_ring_pulls_the_tendon_inwards_at_equal_angles():
    length, leave, arrive = wire([0.3, 0.2, 0], [-0.3, 0.2, 0], 0.05, (0, 0, 1), [0, 0, 0])
    assert length == pytest.approx(2 * np.hypot(0.3, 0.15))
    np.testing.assert_allclose(leave * [-1, 1, 1], arrive, atol=1e-6)


@pytest.mark.parametrize(('axis', 'side'), [((0, 0, 0), NONE), ((0, 0.6, 0.8), [0.1, 0.2, 0])])
def test_a_mirrored_or_reversed_tendon_has_the_same_length(axis, side):
    ends = np.array([[0.2, -0.05, 0.05], [-0.15, -0.02, 0.06]])
    length, leave, arrive = wire(*ends, 0.09, axis, side)
    back = wire(*ends[::-1], 0.09, axis, side)
    mirrored = wire(*-ends, 0.09, axis, -np.array(side))
    assert length > np.linalg.norm(ends[1] - ends[0]) + 1e-4
    assert back[0] == pytest.approx(length)
    assert mirrored[0] == pytest.approx(length)
    np.testing.assert_allclose(back[1], arrive, atol=1e-9)
    np.testing.assert_allclose(mirrored[1], -leave, atol=1e-9)


def test_length_and_direction_are_continuous_where_the_tendon_lifts_off():
    """Near lift-off, the angle of the tangent grows with the square root of the height."""
    for axis in ((0, 0, 0), (0, 0, 1)):
        for gap in (1e-6, -1e-6):
            length, leave, _ = wire([0.3, 0.1 + gap, 0], [-0.3, 0.1 + gap, 0.1], 0.1, axis)
            assert length == pytest.approx(np.hypot(0.6, 0.1), abs=3e-6)
            straight = np.array([-0.6, 0.0, 0.1]) / np.hypot(0.6, 0.1)
            np.testing.assert_allclose(leave, straight, atol=1e-4)


def test_the_gradient_is_the_derivative_of_the_length(robot):
    theta = robot.random_postures(40, np.random.default_rng(0))
    expected = slopes(robot.routes.absolute_lengths, theta)
    np.testing.assert_allclose(robot.routes.muscle_jacobian(theta), expected, atol=2e-6)
    touches = (robot.routes.detours(theta)[:, robot.muscles.index('straightener')] > 1e-4).mean()
    assert touches > 0.2


def test_the_emulator_without_differences_is_the_geometric_model(robot, monkeypatch):
    monkeypatch.setattr(route_jumps, 'LINES', 5)  # saves time; lengths that jump do not matter here
    theta = robot.random_postures(20, np.random.default_rng(1))
    body = Individual(robot, 0, NOMINAL)
    np.testing.assert_allclose(
        body.absolute_lengths(theta), robot.routes.absolute_lengths(theta), atol=1e-10
    )
    np.testing.assert_allclose(
        body.muscle_jacobian(theta), robot.routes.muscle_jacobian(theta), atol=1e-9
    )
    arm = EmulatedArm(robot, 1)
    arm.step(0.2)
    assert np.isfinite(arm.theta).all()


def test_an_uncorrected_body_wraps_too(robot):
    theta = robot.random_postures(9, np.random.default_rng(2))
    tension = np.full((9, robot.muscle_count), 40.0)
    (length,) = CalibratedBody(robot).lengths(theta, tension, np.zeros_like(tension))
    np.testing.assert_allclose(length, robot.muscle_lengths(theta, tension), atol=1e-9)


def test_the_drawn_line_is_as_long_as_the_muscle(robot):
    theta = robot.random_postures(20, np.random.default_rng(3))
    for posture in theta:
        lines = draw_arm(robot, posture, np.full(robot.muscle_count, 50.0))
        muscles = [line.points for line in lines if line.kind == 'muscles']
        drawn = [np.linalg.norm(np.diff(points, axis=0), axis=1).sum() for points in muscles]
        # An arc is drawn as eight chords, which are together a little shorter than it.
        np.testing.assert_allclose(drawn, robot.routes.absolute_lengths(posture), atol=2e-4)
