# SPDX-License-Identifier: Apache-2.0
"""`python -m bench` lists and starts all benches."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from bench import bodies, covariance, false_stops, lab, pictures
from bench.__main__ import benches, main
from bench.regression import BASELINES
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot


def test_every_bench_is_listed_with_what_it_measures(capsys):
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, text in benches().items():
        assert any(line.startswith(name) and line.endswith(text) for line in lines) and text


def test_every_bench_is_explained():
    # `benches` finds modules by their function `main`. A bench that lacks it is noticed here,
    # because the table in README.md names it.
    text = (Path(__file__).parents[1] / 'bench' / 'README.md').read_text(encoding='utf-8')
    assert {line.split('`')[1] for line in text.splitlines() if line[:3] == '| `'} == set(benches())


@pytest.mark.parametrize('name', benches())
def test_every_bench_has_help(name, capsys):
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f'bench.{name}').main(['--help'])
    assert ended.value.code == 0
    assert 'usage' in capsys.readouterr().out


def test_an_unknown_bench_ends_with_status_2(capsys):
    assert main(['speed']) == 2
    assert 'calibration' in capsys.readouterr().err


def test_what_the_package_refuses_is_one_line_and_status_1(capsys):
    assert main(['soak', '--robot', 'nowhere']) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: robot 'nowhere'") and error.count('\n') == 1


def test_a_busy_process_takes_its_oldest_message_and_the_last_of_a_full_queue():
    process, received = lab.Process(25.0, [0]), []
    for n in range(10_000):
        now = n * lab.SAMPLE_TIME
        process.send(lab.Message(now, n))
        if (at := process.runs(now)) is not None:
            received.append([content for _, _, content in process.receive(at)])
    assert max(map(len, received)) == 1 + lab.QUEUE
    assert sum(map(len, received)) + process.lost == received[-1][-1] + 1
    gap = max(np.diff(numbers)[0] for numbers in received if len(numbers) > 1)
    assert gap > lab.QUEUE and process.longest_delay > gap * lab.SAMPLE_TIME


def test_a_process_that_restarts_receives_no_message_from_before_its_start():
    process = lab.Process(0.0, [0])
    process.restart(2.0)
    for sent_at in (0.0, 1.0, 2.0, 2.01):
        process.send(lab.Message(sent_at, sent_at))
    assert [content for _, _, content in process.receive(2.02)] == [2.0, 2.01]


def test_a_healthy_arm_on_a_busy_computer_is_neither_suspected_nor_stopped(trained):
    loop = false_stops.BusyLoop(EmulatedArm(Robot.load('arm26'), 0), trained['default'], 0, 8.0)
    result = loop.watch(5.0)
    assert result.problem == '' and result.seconds == pytest.approx(5.0)
    assert result.delay > 0.02
    assert loop.controller.supervisor.explores


def test_pictures_of_an_arm_at_rest_and_loaded_are_written(trained, tmp_path):
    files = pictures.draw_simulated(Robot.load('arm26'), trained['default'], tmp_path)
    assert [file.name for file in files] == ['sim_at_rest.png', 'sim_loaded.png']
    assert all(file.read_bytes().startswith(b'\x89PNG') for file in files)


def test_honesty_of_a_covariance_is_0_95_inside_and_nees_1_if_the_errors_follow_it():
    rng, root = np.random.default_rng(0), np.array([[0.03, 0.0], [0.02, 0.01]])
    error = rng.standard_normal((20_000, 2)) @ root.T
    assert covariance.honesty(root @ root.T, error) == pytest.approx(
        (np.linalg.norm(error, axis=1).mean(), 0.95, 1.0), abs=0.02
    )
    too_large = covariance.honesty(4.0 * root @ root.T, error)
    assert too_large.inside > 0.99 and too_large.nees == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize('name', BASELINES)
def test_a_regression_learns_a_smooth_function(name):
    inputs = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 3))
    inputs[:, 2] = 5.0  # some quantities are constant, for example unknown tensions
    outputs = np.stack([np.sin(2.0 * inputs[:, 0]), inputs[:, 0] * inputs[:, 1]], axis=1)
    predicted = BASELINES[name](inputs[:40], outputs[:40])(inputs[40:])
    assert np.abs(predicted - outputs[40:]).mean() < 0.1 * outputs.std()


def test_an_unknown_body_is_refused_with_the_legal_ones(tmp_path):
    with pytest.raises(MusculoskeletalError, match=r'nose:20.*kin_SEED or foreign_SEED'):
        bodies.main(['nose:20', '--cache', str(tmp_path)])


def test_models_that_several_individuals_have_learned_show_median_and_range(tmp_path, capsys):
    individuals = [
        {'seed': seed, 'before': 0.4, 'after': after, 'samples': 9, 'problem': ''}
        for seed, after in ((1, 0.3), (2, 0.1), (3, 0.2))
    ]
    result = {'joints': 1, 'muscles': 6, 'known': 1.0, 'held': '100 %', 'first': 3.0, 'whole': 20.0}
    result |= {'file_lengths': [0.001, 0.003], 'exported_lengths': [0.001, 0.001]}
    result |= {'file_arms': [0.002, 0.004], 'exported_arms': [0.002, 0.005]}
    result |= {'individuals': individuals, 'still': ['elbow'], 'commit': 'abc'}
    (tmp_path / 'arm26').mkdir()
    (tmp_path / 'arm26' / 'result.json').write_text(json.dumps(result))
    main(['mujoco_models', str(tmp_path), '--out', str(tmp_path), '--only', 'arm26'])
    printed = capsys.readouterr().out
    assert '0.400 (0.400 to 0.400) → 0.200 (0.100 to 0.300); without elbow' in printed
    assert '1, 1 worse | 2.00 → 1.00 | 3.00 → 3.50' in printed
