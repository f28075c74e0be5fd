# SPDX-License-Identifier: Apache-2.0
"""`bench recordings`: reading of clones, and recovery of known parameters by its models."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from bench.recordings import Result, main, table
from bench.recordings_cases import DRAWS, cases, drawn, joined
from bench.recordings_learn import Statics, effort_slope, error, regression
from bench.recordings_platform import (
    ATTACHED,
    ENTRY,
    HEIGHT,
    PULLEY,
    Platform,
    cable_length,
    cable_platform,
)
from bench.recordings_read import Files, Recording, Run, SoftLink, fitted, soft_arm
from bench.regression import BASELINES
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
    fit = BASELINES['polynomial']
    assert error(regression(fit, joined([none, half]), False), whole) > 0.02


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


def test_the_table_has_mean_and_spread_of_the_draws_and_the_ratio_to_the_best_rival():
    errors = ('GP', 0.1, 0.3), ('this package', 0.14, 0.16)
    results = [
        Result('r', '20 random rows', 20, draw, 'lengths', model, off)
        for model, *offs in errors
        for draw, off in enumerate(offs)
    ]
    results.append(Result('r', 'rests', 9, 0, 'lengths', 'this package', 0.4))
    results.append(Result('r', 'rests', 9, 0, 'lengths', 'geometry', 2.0))
    lines = table(results).split('\n')
    assert lines[0] == '| mean error [rad] | inputs | geometry | GP | this package | ratio |'
    assert lines[2:] == [
        '| 20 random rows | lengths | – | 0.2000 ± 0.1414 | **0.1500** ± 0.0141 | 0.75 |',
        '| rests (9) | lengths | > 1 | – | **0.4000** | 0.20 |',
    ]


def test_random_rows_are_learned_from_every_other_pose_and_tested_on_the_poses_between():
    rows = np.arange(120.0)
    spans = np.stack([np.arange(8, 128, 10), np.arange(10, 130, 10)], axis=1)
    run = Run('0 g', 0.0, rows[:, None], np.zeros((120, 0)), np.zeros((120, 2)), spans)
    recording = Recording(SoftLink('soft_neck', (0.0,), (0.1,), 0.1, 0.1, 1.0), [run] * 3)
    one, other = (drawn(recording, 20, draw) for draw in (0, 1))
    assert (one.training.length // 10 % 2 == 0).all() and (one.test.length // 10 % 2 == 1).all()
    assert len(one.training.length) == 20
    assert set(one.training.length.ravel()) != set(other.training.length.ravel())
    every = [case for case in cases(recording, [20, 100, 400], DRAWS) if 'random' in case.name]
    # There are fewer than 100 rows; all of them are learned once.
    assert [len(case.training.length) for case in every] == [20, 20, 20, 60]


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
