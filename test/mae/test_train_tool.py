# SPDX-License-Identifier: Apache-2.0

import pytest
from robots import DRUM_ENDS, behind_a_drum

from musculoskeletal_ae.mae.checkpoint import load
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools import model_training
from musculoskeletal_ae.tools.train import main


def test_train_writes_checkpoint_and_plot_and_then_prints_the_nine_errors(
    tmp_path, capsys, monkeypatch
):
    out, plot = tmp_path / 'a.safetensors', tmp_path / 'a.png'
    table, was_written = model_training.table, []

    def table_after(*of):
        was_written.append(out.exists())  # printing may fail, after which nothing else is done
        return table(*of)

    monkeypatch.setattr(model_training, 'table', table_after)
    arguments = ['--robot', 'arm26', '--preset', 'paper', '--quick']
    assert main([*arguments, '--out', str(out), '--plot', str(plot)]) == 0
    assert was_written and all(was_written)
    printed = capsys.readouterr().out
    robot = Robot.load('arm26')
    assert load(out, robot).preset == 'paper'
    assert plot.read_bytes().startswith(b'\x89PNG')
    for text in ('①', '②', '③', '[rad]', '[N]', '[mm]', *robot.joints):
        assert text in printed


@pytest.mark.parametrize(
    'options',
    [
        ['--robot', 'arm26'],
        ['--robot', 'arm26', '--out', 'x', '--preset', 'best'],
        ['--robot', 'arm26', '--out', 'x', '--seed', '-1'],
    ],
)
def test_bad_options_exit_with_2(options):
    with pytest.raises(SystemExit) as exit_:
        main(options)
    assert exit_.value.code == 2


def test_unknown_robot_exits_with_1_in_one_line(tmp_path, capsys):
    assert main(['--robot', 'nobody', '--out', str(tmp_path / 'x')]) == 1
    error = capsys.readouterr().err
    assert 'nobody' in error and error.count('\n') == 1


@pytest.mark.parametrize('name', DRUM_ENDS)
def test_train_warns_of_lengths_that_jump_before_it_trains(tmp_path, capsys, name):
    behind_a_drum(tmp_path / 'arm', DRUM_ENDS[name])
    arguments = ['--robot', str(tmp_path / 'arm'), '--out', str(tmp_path / 'x')]
    # `train` refuses the missing bag before it trains, which keeps this test short.
    assert main([*arguments, '--from-bag', str(tmp_path / 'none')]) == 1
    error = capsys.readouterr().err
    assert ('warning: no network can represent lengths that jump' in error) == (name == 'jumps')
    assert ('straightener (' in error and 'check_robot' in error) == (name == 'jumps')


def test_unwritable_output_exits_with_1_before_training(tmp_path, capsys):
    assert main(['--robot', 'arm26', '--out', str(tmp_path / 'none' / 'x')]) == 1
    assert main(['--robot', 'arm26', '--out', str(tmp_path)]) == 1
    assert main(['--robot', 'arm26', '--out', str(tmp_path / (250 * 'x'))]) == 1
    assert main(['--robot', 'arm26', '--out', '/proc/x']) == 1
    reported = capsys.readouterr().err
    assert reported.count('\n') == 4
    assert reported.count('choose another file') == 2
