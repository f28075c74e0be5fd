# SPDX-License-Identifier: Apache-2.0
"""Reading an arm's readings from CSV files and arrays, and `train --from-csv`."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from musculoskeletal_ae.learning import convergence, learner, recordings
from musculoskeletal_ae.mae.checkpoint import load
from musculoskeletal_ae.process_signals import INTERRUPTED
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tables.csv_file import looks_like_a_sequence, read_csv
from musculoskeletal_ae.tables.table import MARGIN, Table, TableError
from musculoskeletal_ae.tools import recording_learning
from musculoskeletal_ae.tools.train import main

POSITIONS = 'shoulder', 'elbow'


@pytest.fixture(scope='module')
def arm26():
    return Robot.load('arm26')


def headers(robot, length='length_{}', tension='tension_{}'):
    """Return the headers of all columns, with those of lengths and tensions by a pattern."""
    lengths = [length.format(name) for name in robot.muscles]
    return [*POSITIONS, *lengths, *(tension.format(name) for name in robot.muscles)]


def readings(robot, count=100, seed=0):
    """Return rows of θ [rad], l [m] and T [N] of the geometric model in random postures."""
    rng = np.random.default_rng(seed)
    theta = robot.random_postures(count, rng)
    tension = rng.uniform(40.0, 120.0, (count, robot.muscle_count))
    return np.hstack([theta, robot.muscle_lengths(theta, tension), tension])


def write(file, names, rows, delimiter=',', comma=False):
    """Write a CSV file; `comma` writes decimal commas."""
    lines = [delimiter.join(names)]
    lines += [delimiter.join(f'{cell:.6f}' for cell in row) for row in rows]
    text = '\n'.join(lines)
    file.write_text(text.replace('.', ',') if comma else text)
    return file


@pytest.mark.parametrize(
    ('length', 'tension'),
    [
        ('length_{}', 'tension_{}'),
        ('{}.length', '{}.force'),
        ('Length {} [m]', 'Tension {} (N)'),
        ('{}_length_m', '{}/tension_n'),
    ],
)
def test_headers_name_joints_and_muscles_in_many_ways(arm26, tmp_path, length, tension):
    rows = readings(arm26)
    table, _ = read_csv(write(tmp_path / 'a.csv', headers(arm26, length, tension), rows), arm26)
    np.testing.assert_allclose(table.rows.theta, rows[:, :2], atol=1e-6)
    np.testing.assert_allclose(table.rows.length, rows[:, 2:8], atol=1e-6)
    np.testing.assert_allclose(table.rows.tension, rows[:, 8:], atol=1e-6)
    assert table.at_rest


def test_units_of_headers_and_options_are_converted(arm26, tmp_path):
    rows = readings(arm26)
    scaled = rows * np.r_[np.full(2, 180.0 / np.pi), np.full(6, -100.0), np.ones(6)]
    names = headers(arm26)
    names[:2] = 'shoulder angle (deg)', 'theta_elbow_deg'
    file = write(tmp_path / 'a.csv', names, scaled)
    table, _ = read_csv(file, arm26, units={'length': '-0.01'})
    np.testing.assert_allclose(table.rows.theta, rows[:, :2], atol=1e-6)
    np.testing.assert_allclose(table.rows.length, rows[:, 2:8], atol=1e-6)


@pytest.mark.parametrize('delimiter', [';', '\t', ' '])
def test_decimal_commas_and_other_delimiters_are_read(arm26, tmp_path, delimiter):
    rows = readings(arm26)
    file = write(tmp_path / 'a.csv', headers(arm26), rows, delimiter, comma=True)
    table, _ = read_csv(file, arm26)
    np.testing.assert_allclose(table.rows.length, rows[:, 2:8], atol=1e-6)


def test_columns_are_chosen_by_header_or_by_number(arm26, tmp_path):
    rows, names = readings(arm26), headers(arm26)
    file = write(tmp_path / 'a.csv', ['q1', *names[1:]], rows)
    table, _ = read_csv(file, arm26, columns={'shoulder': 'q1', 'elbow': ''})
    np.testing.assert_allclose(table.rows.theta[:, 0], rows[:, 0], atol=1e-6)
    assert np.isnan(table.rows.theta[:, 1]).all()
    bare = write(tmp_path / 'b.csv', [f'{cell:.6f}' for cell in rows[0]], rows[1:])
    keys = [name.replace('_', ':', 1) if '_' in name else name for name in names]
    chosen = {key: f'#{i}' for i, key in enumerate(keys, 1)}
    table, _ = read_csv(bare, arm26, columns=chosen)
    np.testing.assert_allclose(table.rows.tension, rows[:, 8:], atol=1e-6)
    first, *others = bare.read_text().splitlines()
    bare.write_text('\n'.join([',' + first.partition(',')[2], *others]))  # an angle is missing
    table, _ = read_csv(bare, arm26, columns=chosen)
    assert len(table) == len(rows) and np.isnan(table.rows.theta[0, 0])


def test_units_at_the_end_of_the_headers_of_chosen_columns_are_used(arm26, tmp_path):
    rows = readings(arm26)
    scaled = rows * np.r_[np.full(2, 180.0 / np.pi), np.full(6, 1000.0), np.full(6, 0.001)]
    lengths, loads = ([each.format(i) for i in range(6)] for each in ('enc{}_mm', 'load{}_kN'))
    names = ['q1_deg', 'q2_deg', *lengths, *loads]
    keys = headers(arm26, 'length:{}', 'tension:{}')
    file = write(tmp_path / 'a.csv', ['elapsed_ms', *names], np.c_[np.arange(100), scaled])
    columns = dict(zip(['time', *keys], ['elapsed_ms', *names], strict=True))
    table, found = read_csv(file, arm26, columns)
    np.testing.assert_allclose(table.rows.time, 0.001 * np.arange(100))
    np.testing.assert_allclose(table.rows.theta, rows[:, :2], atol=1e-6)
    np.testing.assert_allclose(table.rows.length, rows[:, 2:8], atol=1e-6)
    np.testing.assert_allclose(table.rows.tension, rows[:, 8:], atol=1e-2)
    assert {column.unit for column in found} == {'ms', 'deg', 'mm', 'kN'}
    names = [name.replace('load', 'load_a').replace('_kN', '_a') for name in names]
    file = write(tmp_path / 'a.csv', ['elapsed_ms', *names], np.c_[np.arange(100), scaled])
    columns = dict(zip(['time', *keys], ['elapsed_ms', *names], strict=True))
    assert read_csv(file, arm26, columns, {'tension': 'kN'})[1][-1].unit == 'kN'


def test_rows_without_a_value_are_left_out_and_counted(arm26, tmp_path):
    rows = readings(arm26)
    rows[3, 5] = rows[4, 9] = np.nan
    rows[6, :2] = np.nan
    rows[7, 0] = np.nan  # the other joint is known
    table, _ = read_csv(write(tmp_path / 'a.csv', headers(arm26), rows), arm26)
    assert len(table) == 97
    assert table.left_out == {
        'a length is missing': 1,
        'a tension is missing': 1,
        'no joint position is known': 1,
    }


def text(robot, *lines):
    return '\n'.join([','.join(headers(robot)), *lines])


@pytest.mark.parametrize(
    ('lines', 'expected'),
    [
        (['1,2,3'], 'line 2 has 3 cells, but the first line has 14'),
        ([','.join('0,5' for _ in range(14))], 'separate the cells by semicolons'),
        ([','.join(['0.1'] * 13 + ['12 N'])], "column 'tension_triceps_long': '12 N' is not a n"),
        ([], 'no rows of readings'),
        ([','.join(['0.1'] * 13 + [''])], 'no row is usable (a tension is missing: 1 rows)'),
    ],
)
def test_bad_cells_are_named_with_line_and_remedy(arm26, tmp_path, lines, expected):
    file = tmp_path / 'a.csv'
    file.write_text(text(arm26, *lines))
    with pytest.raises(TableError) as raised:
        read_csv(file, arm26)
    assert str(raised.value).startswith(f'{file}: ')
    assert expected in str(raised.value)


@pytest.mark.parametrize(
    ('names', 'options', 'expected'),
    [
        ({'elbow': 'q2'}, {}, 'there is no column for elbow; columns: shoulder, q2, '),
        ({'elbow': 'shoulder'}, {}, "two columns are named 'shoulder'"),
        ({'elbow': 'shoulder angle'}, {}, "'shoulder' and 'shoulder angle' both contain shoulder"),
        ({'elbow': 'elbow [deg]'}, {}, "'shoulder' states no unit, but 'elbow [deg]' does"),
        ({'elbow': 'elbow [turn]'}, {}, "unknown unit 'turn'; expected one of rad, deg"),
        ({}, {'columns': {'wrist': 'q'}}, "column of 'wrist': expected a joint"),
        ({}, {'columns': {'elbow': 'q9'}}, "there is no column 'q9' for elbow"),
        ({}, {'units': {'angles': 'deg'}}, "units of 'angles': expected one of angle, "),
        ({}, {'units': {'tension': 'A'}}, "unknown unit 'A'; expected one of N, kN"),
        ({'elbow': 'time'}, {'rate': 100.0, 'columns': {'elbow': ''}}, 'leave out --rate'),
    ],
)
def test_columns_that_do_not_fit_the_robot_are_named(arm26, tmp_path, names, options, expected):
    changed = [names.get(name, name) for name in headers(arm26)]
    file = write(tmp_path / 'a.csv', changed, readings(arm26, 3))
    with pytest.raises(TableError) as raised:
        read_csv(file, arm26, **options)
    assert expected in str(raised.value)


def test_arrays_of_other_sizes_and_decreasing_times_are_refused(arm26):
    theta, length, tension = np.split(readings(arm26, 20), [2, 8], axis=1)
    with pytest.raises(TableError, match=r'tension has the shape \(19, 6\)'):
        Table.of(arm26, theta, length, tension[1:])
    with pytest.raises(TableError, match='the tensions are missing'):
        Table.of(arm26, theta, length)
    time = np.r_[np.arange(10), np.arange(10)]
    with pytest.raises(TableError, match='the time decreases by 9 s after row 10'):
        Table.of(arm26, theta, length, tension, time)


def test_the_held_out_part_consists_of_whole_blocks(arm26):
    theta, length, tension = np.split(readings(arm26, 100), [2, 8], axis=1)
    learned, held_out = Table.of(arm26, theta, length, tension).split()
    assert [len(learned), len(held_out)] == [80, 20]
    rows = held_out.rows.time
    assert np.count_nonzero(np.diff(rows) > 1.0) == 1
    assert len([*held_out.segments()]) == 2 and len([*learned.segments()]) == 3
    assert not set(rows) & set(learned.rows.time)


def test_held_out_readings_of_a_motion_keep_a_distance_to_learned_ones(arm26):
    theta, length, tension = np.split(readings(arm26, 1000), [2, 8], axis=1)
    table = Table.of(arm26, theta, length, tension, 0.1 * np.arange(1000))
    learned, held_out = table.split()
    nearest = np.abs(learned.rows.time[:, None] - held_out.rows.time).min()
    assert not table.at_rest and nearest > MARGIN
    with pytest.raises(TableError, match='too short'):
        Table.of(arm26, theta, length, tension, 0.001 * np.arange(1000)).split()


def test_rows_of_a_motion_without_times_are_noticed(arm26):
    time = 0.01 * np.arange(300)
    theta = 0.5 * np.sin(np.outer(time, [1.7, 2.3]))
    tension = np.full((300, arm26.muscle_count), 60.0)
    arrays = theta, arm26.muscle_lengths(theta, tension), tension
    assert looks_like_a_sequence(Table.of(arm26, *arrays))
    assert not looks_like_a_sequence(Table.of(arm26, *arrays, time))
    assert not looks_like_a_sequence(Table.of(arm26, *np.split(readings(arm26), [2, 8], axis=1)))


@pytest.fixture
def trained(trained_file, tmp_path, monkeypatch):
    """Return a function that runs `train --from-csv` with few and short updates."""
    monkeypatch.setattr(convergence, 'MOST_UPDATES', 2)
    monkeypatch.setattr(recordings, 'STEPS', 100)
    out = tmp_path / 'out.safetensors'

    def run(*options):
        arguments = ['--robot', 'arm26', '--checkpoint', str(trained_file), '--out', str(out)]
        return main([*arguments, '--from-csv', *map(str, options)])

    run.out = out
    return run


def test_training_from_a_table_of_rests_with_unknown_zeros_lowers_the_held_out_error(
    arm26, trained, tmp_path, capsys
):
    rows = readings(arm26, 60)
    rows[:, 2] *= 1.15  # the moment arms of one muscle are larger than modelled
    rows[:, 2:8] += 0.3
    file = write(tmp_path / 'a.csv', headers(arm26), rows)
    assert trained(file) == 1
    assert 'add --estimate-zeros' in capsys.readouterr().err
    assert trained(file, '--estimate-zeros') == 0
    printed = capsys.readouterr().out
    assert f'{file}: 60 resting postures; angle in rad, length in m, tension in N' in printed
    (held_out,) = (line for line in printed.splitlines() if 'held out' in line)
    words = held_out.split('joint-angle error ')[1].split()
    assert words[1] == words[4] == 'rad'
    assert float(words[3]) < float(words[0])
    assert 'always estimating the mean learned posture: ' in held_out
    assert load(trained.out, arm26).joints == tuple(arm26.joints)


def test_joint_positions_with_another_zero_are_named_and_nothing_is_written(
    arm26, trained, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(learner, 'LARGEST_OFFSET', 0.1)  # reached after few updates
    rows = readings(arm26, 60)
    rows[:, 1] -= 0.5
    assert trained(write(tmp_path / 'a.csv', headers(arm26), rows)) == 1
    printed = capsys.readouterr().err
    assert re.search(r'nothing was learned \(2 updates\): 2 of 2 updates were refused', printed)
    assert re.search(r'elbow \(-0\.\d+ rad, largest 0\.10\)', printed)
    assert 'shoulder (' not in printed
    assert not trained.out.exists()


def test_a_refusal_of_the_last_update_is_a_warning_if_earlier_ones_were_used(
    arm26, trained, tmp_path, capsys, monkeypatch
):
    def found(self):
        return {'elbow': '0.50 rad, largest 0.35'} if self.updates == 2 else {}

    monkeypatch.setattr(learner.Learner, 'impossible_offsets', property(found))
    assert trained(write(tmp_path / 'a.csv', headers(arm26), readings(arm26, 60))) == 0
    assert 'warning: 1 of 2 updates were refused' in capsys.readouterr().err
    assert trained.out.exists()


def test_wrong_units_and_signs_are_named_before_the_training(
    arm26, trained, tmp_path, capsys, monkeypatch
):
    def interrupt(*_):  # as a user does after reading the warning
        raise KeyboardInterrupt

    monkeypatch.setattr(recording_learning, 'collect', interrupt)
    rows = readings(arm26, 60)
    degrees = rows * np.r_[np.full(2, 180.0 / np.pi), np.ones(12)]
    file = write(tmp_path / 'a.csv', headers(arm26), degrees)
    assert trained(file, '--estimate-zeros') == 1
    assert 'State their unit with --units' in capsys.readouterr().err
    rows[:, 3] *= -1.0
    assert trained(write(file, headers(arm26), rows), '--estimate-zeros') == INTERRUPTED
    expected = f'the length of {arm26.muscles[1]} has the wrong sign'
    assert expected in capsys.readouterr().err


def test_preset_paper_says_that_it_does_not_learn_from_20_postures(
    arm26, trained_files, tmp_path, capsys
):
    file = write(tmp_path / 'a.csv', headers(arm26), readings(arm26, 25))  # 20 are learned
    out = tmp_path / 'out.safetensors'
    options = ['--checkpoint', str(trained_files['paper']), '--out', str(out), '--preset', 'paper']
    assert main(['--robot', 'arm26', '--from-csv', str(file), *options]) == 1
    expected = '20 different resting postures, and preset paper learns from at least 21'
    assert expected in capsys.readouterr().err
    assert not out.exists()


def test_files_of_a_robot_without_tension_sensors_need_no_tensions(tmp_path, arm26):
    directory = tmp_path / 'robot'
    directory.mkdir()
    for file in ('robot.urdf', 'muscles.yaml'):
        content = (arm26.description.directory / file).read_text()
        content = content.replace('stiffness: 10000.0\n', '')
        more = 'tension_source: none\nactuation: position\n' if file == 'muscles.yaml' else ''
        (directory / file).write_text(content + more)
    robot = Robot.load(directory)
    names, rows = headers(robot)[:8], readings(robot)[:, :8]
    table, _ = read_csv(write(tmp_path / 'a.csv', names, rows), robot)
    np.testing.assert_allclose(table.rows.tension[0], robot.actuation.assumed_tension)
    time = np.r_[0.0, np.nan, np.arange(2, 100)]
    table, _ = read_csv(write(tmp_path / 'b.csv', ['time', *names], np.c_[time, rows]), robot)
    assert table.left_out == {'the time is missing': 1}


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [
        (['--from-csv', 'a', '--from-bag', 'b'], 'cannot be combined'),
        (['--rate', '100'], 'with --from-csv only'),
        (['--from-csv', 'a', '--columns', 'elbow'], 'expected an entry such as'),
        (['--from-csv', 'a', '--from-namespace', 'b'], 'with --from-bag only'),
        (['--from-csv', 'a', '--hold-out', 'a'], 'both learned from and in --hold-out'),
    ],
)
def test_options_that_do_not_fit_together_end_with_one_error(tmp_path, capsys, arguments, expected):
    with pytest.raises(SystemExit) as ended:
        main(['--robot', 'arm26', '--out', str(tmp_path / 'out'), *arguments])
    assert ended.value.code == 2
    assert expected in capsys.readouterr().err


def test_the_example_writes_a_file_that_can_be_learned(tmp_path):
    example = Path(__file__).resolve().parents[2] / 'examples' / 'make_csv.py'
    for options in ([], ['--moving']):
        file = tmp_path / f'arm{len(options)}.csv'
        done = [sys.executable, example, file, '--postures', '5', *options]
        subprocess.run(
            done, check=True, env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}
        )
        assert file.read_text().startswith('t [ms];' if options else 'shoulder (deg);q2;')
