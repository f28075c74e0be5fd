# SPDX-License-Identifier: Apache-2.0
"""`python -m bench` lists and starts all benches."""

import importlib
from pathlib import Path

import pytest

from bench import sim_pictures
from bench.__main__ import benches, main
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
    assert main(['kills', '--robot', 'nowhere']) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: robot 'nowhere'") and error.count('\n') == 1


def test_pictures_of_an_arm_at_rest_and_loaded_are_written(trained, tmp_path):
    files = sim_pictures.save_both(Robot.load('arm26'), trained['default'], tmp_path / 'new')
    assert [file.name for file in files] == ['sim_at_rest.png', 'sim_loaded.png']
    assert all(file.read_bytes().startswith(b'\x89PNG') for file in files)
