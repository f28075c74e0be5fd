# SPDX-License-Identifier: Apache-2.0
"""`bench recordings`: reading of clones, and recovery of known parameters by its models."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from bench.recordings import Result, main, table
from bench.recordings_baselines import baselines
from bench.recordings_learn import Statics, effort_slope, error, joined, polynomial
from bench.recordings_platform import (
    ATTACHED,
    ENTRY,
    HEIGHT,
    PULLEY,
    Platform,
    cable_length,
    cable_platform,
)
from bench.recordings_read import Files, Run, SoftLink, fitted, soft_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot

AZIMUTHS = tuple(np.radians([90.0, -150.0, -30.0]).tolist())
LINK = SoftLink('link', AZIMUTHS, (0.05,) * 3, 0.1, 0.2, 0.7)


@pytest.fixture(scope='module')
def link(tmp_path_factory) -> Robot:
    return Robot.load(LINK.write(tmp_path_factory.mktemp('link')))


def rests(link, values, load, count, seed):
    """Return rest samples of a link, computed from lengths by the balance of forces."""
    rng = np.random.default_rng(seed)
    bend = rng.uniform(-0.35, 0.35, (count, 2))
    length = link.routes.absolute_lengths(bend) - link.routes.length_at_zero
    run = Run('', load, length, np.zeros((count, 0)), np.zeros((count, 2)), np.zeros((0, 2), int))
    model = object.__new__(Statics)
    model._robot = link
    theta = model.posture(run, values)
    return Run('', load, length, np.zeros((count, 0)), theta, np.zeros((0, 2), int))


def test_statics_predict_a_payload_that_was_not_trained(link):
    """A spring of 1.2 N·m/rad and soft tendons; training with 0 and 0.5 kg, test with 1 kg."""
    true = np.array([np.log(1.2), np.log(1500.0), 0.03, 0.001, 1.1])
    none, half, whole = (rests(link, true, load, 12, seed=7) for load in (0.0, 0.5, 1.0))
    assert np.linalg.norm(none.theta - whole.theta, axis=1).mean() > 0.02
    model = Statics(link, [none, half])
    assert error(model.posture, whole) < 0.006
    assert error(polynomial(joined([none, half]), 1, False), whole) > 0.02


def test_a_clone_may_be_a_working_tree_or_a_git_directory(tmp_path):
    tree = tmp_path / 'tree'
    name = 'graphs/Control/PID/Masa_200/a.csv'
    (tree / name).parent.mkdir(parents=True)
    row = ', '.join(['0'] * 5 + ['0.1', '-0.2', '1', '-1', '0', '0', '0', '0', '7', '8', '9'])
    (tree / name).write_text('\n'.join([row] * 120), encoding='utf-8')
    author = ['-c', 'user.name=a', '-c', 'user.email=a@b']
    for command in (['init', '-q'], ['add', '.'], [*author, 'commit', '-qm', 'data']):
        subprocess.run(['git', '-C', tree, *command], check=True)
    bare = tmp_path / 'bare'
    subprocess.run(['git', 'clone', '-q', '--bare', tree, bare], check=True)
    for path in (tree, bare):
        (run,) = soft_arm(Files(path)).runs
        assert run.load == pytest.approx(0.2)
        rest = run.at_rest()
        np.testing.assert_allclose(rest.theta, [[0.1, -0.2]])
        np.testing.assert_allclose(rest.length, [[-0.0093, 0.0093, 0.0]])
        np.testing.assert_allclose(rest.effort, [[7.0, 8.0, 9.0]])
        with pytest.raises(MusculoskeletalError, match=r'clone .* lacks .*other\.csv; clone'):
            Files(path).text('other.csv')
    with pytest.raises(MusculoskeletalError, match='expected a clone'):
        Files(tmp_path / 'nothing')


def test_without_a_clone_the_remedy_is_named(tmp_path):
    with pytest.raises(MusculoskeletalError, match='no repository of the bench is cloned in'):
        main(['--clones', str(tmp_path), '--out', str(tmp_path / 'out')])
    assert not Path(tmp_path / 'out').exists()


def test_tendons_stand_where_their_lengths_put_them(link):
    theta = np.random.default_rng(0).uniform(-0.3, 0.3, (40, 2))
    length = link.routes.absolute_lengths(theta) - link.routes.length_at_zero - 0.004
    run = Run('', 0.0, length, length, theta, np.zeros((0, 2), int))
    estimated_link, at_zero = fitted(LINK, run)
    np.testing.assert_allclose(estimated_link.azimuths, AZIMUTHS, atol=0.02)
    np.testing.assert_allclose(estimated_link.radius, LINK.radius, rtol=0.05)
    np.testing.assert_allclose(at_zero, -0.004, atol=1e-3)


def test_the_slope_of_the_effort_is_the_stiffness_against_the_bend():
    out = np.stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)], axis=1)
    wound = np.random.default_rng(0).normal(size=(30, 3))
    spans = np.arange(30)[:, None] + np.array([0, 1])
    run = Run('', 0.0, -wound, 2.5 * wound, wound @ out, spans)
    assert effort_slope(run, np.array(AZIMUTHS)) == pytest.approx(2.5)


def test_the_table_marks_the_best_model_of_each_split():
    errors = ('a', 'x', 0.1), ('a', 'y', 0.2), ('b', 'y', 0.3), ('b', 'z, of all rows', 0.2)
    lines = table([Result('r', split, 9, model, off) for split, model, off in errors]).split('\n')
    assert lines[2:4] == ['| x | **0.100** | – |', '| y | 0.200 | **0.300** |']
    assert lines[4].endswith('| – | 0.200 |')


def test_the_cable_of_a_swivelling_pulley_is_a_tangent_arc_and_a_straight_line():
    entry = ENTRY[0]
    for end in (np.array([0.0, 0.1, 0.9]), np.array([-0.4, 0.5, 0.4])):
        out = end - entry
        out[0] = 0.0
        out /= np.linalg.norm(out)
        forward, centre = np.array([1.0, 0.0, 0.0]), entry + PULLEY * out
        turns = np.linspace(0.0, np.pi, 200_001)[:, None]
        leaves = centre + PULLEY * (np.sin(turns) * forward - np.cos(turns) * out)
        straight = end - leaves
        along = np.cos(turns) * forward + np.sin(turns) * out
        # The cable leaves the pulley where it points to the end.
        angle = (straight * along).sum(axis=1) / np.linalg.norm(straight, axis=1)
        at = int(angle.argmax())
        expected = PULLEY * turns[at, 0] + np.linalg.norm(straight[at])
        assert cable_length(entry, end) == pytest.approx(expected, abs=1e-6)


def test_runs_of_the_platform_have_lengths_relative_to_its_middle(tmp_path):
    (tmp_path / '.git').mkdir()
    still, count = np.zeros((3, 40)), 40
    middle = [cable_length(a, b + [0.0, 0.0, HEIGHT]) for a, b in zip(ENTRY, ATTACHED)]
    length = np.tile(np.array(middle)[:, None], (1, count))
    length[:, 20:] += np.linspace(0.0, 0.5, 20)  # moves after two seconds
    content = {'epsilon': still, 'cable_length': length, 'tensions': np.full((4, count), 50.0)}
    for name in ('sc_27_final', 'sc_27_medium_a', 'sc_8_final', 'sc_8_medium_a'):
        savemat(tmp_path / f'{name}_parsed.mat', {'st': content})
    run = cable_platform(Files(tmp_path)).runs[0]
    np.testing.assert_allclose(run.length[:20], 0.0, atol=1e-12)
    assert np.isnan(run.theta[:, :3]).all() and (run.theta[:, 3:] == 0.0).all()
    assert len(run.rests) == 3
    robot = Robot.load(Platform().write(tmp_path / 'robot'))
    assert (robot.joint_count, robot.muscle_count) == (6, 4)


def test_baselines_estimate_a_smooth_function():
    rng = np.random.default_rng(0)
    length = rng.uniform(-1.0, 1.0, (120, 2))
    theta = np.stack([np.sin(2.0 * length[:, 0]), length[:, 0] * length[:, 1]], axis=1)
    run = Run('', 0.0, length, np.zeros((120, 0)), theta, np.zeros((0, 2), int))
    training, test = run.at(slice(0, 60)), run.at(slice(60, None))
    linear = error(polynomial(training, 1, False), test)
    for _, model in baselines(training, False):
        assert error(model, test) < 0.2 * linear
