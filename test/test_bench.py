# SPDX-License-Identifier: Apache-2.0
"""`python -m bench` lists and starts what is there."""

import importlib
from pathlib import Path

import pytest

from bench.__main__ import benches, main


def test_every_bench_is_listed_with_what_it_measures(capsys):
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, text in benches().items():
        assert any(line.startswith(name) and line.endswith(text) for line in lines) and text


def test_every_bench_is_explained():
    # One that lost its main would else leave the list without a word.
    text = (Path(__file__).parents[1] / 'bench' / 'README.md').read_text(encoding='utf-8')
    assert {line.split('`')[1] for line in text.splitlines() if line[:3] == '| `'} == set(benches())


def test_what_draws_flames_is_there_before_anything_is_measured(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv('PATH', str(tmp_path))
    with pytest.raises(SystemExit):
        importlib.import_module('bench.performance').main(['--flames', '--out', str(tmp_path)])
    assert 'pip install py-spy' in capsys.readouterr().err


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


def test_options_and_status_are_handed_through(monkeypatch):
    given = []

    def kills(argv):
        given.append(argv)
        return 3

    monkeypatch.setattr('bench.kills.main', kills)
    assert main(['kills', '--count', '5']) == 3
    assert given == [['--count', '5']]
