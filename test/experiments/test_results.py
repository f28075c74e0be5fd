# SPDX-License-Identifier: Apache-2.0
"""result.json combines several individuals, even if the experiment failed on some of them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from musculoskeletal_ae.emulator.reality import FOREIGN
from musculoskeletal_ae.exceptions import InfeasibleError, MusculoskeletalError
from musculoskeletal_ae.experiments import (
    measurement,
    online_learning,
    plots,
    results,
    robustness,
    runner,
)
from musculoskeletal_ae.experiments.results import (
    combine,
    read,
    readme_table,
    write_report,
)
from musculoskeletal_ae.experiments.study import Measured, Study
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.tools import experiment


def test_result_json_has_means_of_the_seeds_that_have_them_but_counts_alarms(arm26, tmp_path):
    study = Study(arm26, 'default', (0, 1), 1.0, True, tmp_path)
    rows = {
        0: {'after_rad': 0.1, 'false_alarms': 1, 'first': {'error_rad': 0.2}, 'joint': 'elbow'},
        1: {'after_rad': 0.3, 'false_alarms': 2, 'first': {'error_rad': 0.4}, 'joint': 'elbow'},
    }
    rows[0] |= {'hand_circle_m': None, 'ellipsoid_share': None}  # None: could not be measured
    rows[1] |= {'hand_circle_m': 0.01, 'ellipsoid_share': None}
    content = combine(study, {seed: Measured(row, {}) for seed, row in rows.items()})
    assert content['after_rad'] == 0.2
    assert content['false_alarms'] == 3
    assert content['first']['error_rad'] == pytest.approx(0.3)
    assert content['joint'] == 'elbow'
    assert content['hand_circle_m'] == 0.01 and content['ellipsoid_share'] is None
    assert content['seeds']['1']['after_rad'] == 0.3


def test_a_number_that_json_cannot_say_is_refused(arm26, tmp_path):
    study = Study(arm26, 'default', (0,), 1.0, True, tmp_path)
    with pytest.raises(MusculoskeletalError, match='finite'):
        combine(study, {0: Measured({'deep': {'list': [1.0, float('nan')]}}, {})})


def test_plots_are_written_as_png_and_the_same_numbers_give_the_same_pdf(
    arm26, tmp_path, monkeypatch
):
    def errors(_study, rows):
        figure, (panel,) = plots.new_figure(4.0, 3.0)
        panel.plot([row.numbers['error_rad'] for row in rows.values()])
        return figure, 'The errors.'

    drawn = runner.EXPERIMENTS['sensors']._replace(plots=(errors,))
    monkeypatch.setitem(runner.EXPERIMENTS, 'sensors', drawn)
    rows = {'sensors': {seed: Measured({'error_rad': 0.1 * seed}, {}) for seed in (0, 1)}}
    for folder, is_quick in (('one', False), ('two', False), ('quick', True)):
        study = Study(arm26, 'default', (0, 1), 1.0, is_quick, tmp_path)
        results.write(study, rows, tmp_path / folder)
    one, two, quick = (tmp_path / folder / 'sensors' for folder in ('one', 'two', 'quick'))
    assert (one / 'errors.pdf').read_bytes() == (two / 'errors.pdf').read_bytes()
    assert (one / 'errors.pdf').read_bytes().startswith(b'%PDF')
    assert (quick / 'errors.png').read_bytes().startswith(b'\x89PNG')
    assert not (quick / 'errors.pdf').exists()


def test_both_kinds_of_bars_show_the_mean_of_the_individuals_that_have_a_value():
    columns = {'all': [0.1, 0.3], 'one': [0.2, None], 'nobody': [None, None]}
    _, (panel, ranked) = plots.new_figure(4.0, 3.0, 1, 2)
    table = np.array(list(columns.values()), dtype=float).T
    plots.bars(panel, list(columns), {'error': (plots.AFTER, table)}, '', '')
    plots.ranked_bars(ranked, columns, 3 * [plots.AFTER], '', '')
    for axes in (panel, ranked):
        shown = [text.get_text() for text in axes.texts if text.get_text() != 'mean']
        assert shown == ['0.200', '0.200 (1 of 2)', 'none']
        assert [bar.get_width() for bar in axes.patches] == pytest.approx([0.2, 0.2, 0.0])


@pytest.fixture
def kept(tmp_path):
    """Return the folder of a copy of the committed results."""
    return shutil.copytree(Path(__file__).parents[2] / 'doc' / 'results', tmp_path / 'results')


def changed(kept, name, **numbers):
    """Replace numbers in the result of an experiment in the folder `kept`."""
    file = kept / name / 'result.json'
    result = json.loads(file.read_text('utf-8')) | numbers
    file.write_text(json.dumps(result), encoding='utf-8')


@pytest.mark.parametrize('text', ['', '{"about": {}, "se', '[]', '{"about": {}, "seeds": {}}'])
def test_what_is_no_result_is_left_out_of_the_report(kept, text, capsys):
    file = kept / 'estimation' / 'result.json'
    file.write_text(text)
    page = write_report(kept).read_text('utf-8')
    assert 'id="control"' in page and 'id="estimation"' not in page
    assert f'{file} is not a valid result of an experiment' in capsys.readouterr().err


def test_a_number_that_was_not_measured_is_a_dash(kept):
    changed(kept, 'simulation', after_rad=None)
    changed(kept, 'estimation', switched_off_detection_s=None)
    assert 'after – s' in ' '.join(write_report(kept).read_text('utf-8').split())


def test_a_result_without_a_number_that_the_report_shows_is_an_error_with_the_remedy(kept):
    changed(kept, 'estimation', cuts=0)
    with pytest.raises(MusculoskeletalError, match='lacks a number: '):
        write_report(kept)


def test_a_page_without_a_place_for_the_table_is_refused_before_the_work(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(
        measurement,
        'run',
        lambda *_: pytest.fail('the measurement began before the page was checked'),
    )
    readme = tmp_path / 'README.md'
    options = f'body_change --robot arm26 --quick --readme {readme} --out {tmp_path}'.split()
    assert experiment.main(options) == 1
    readme.write_text('no markers')
    assert experiment.main(options) == 1
    assert 'expected the lines <!-- results -->' in capsys.readouterr().err


def fails(_study, seed):
    if seed:
        raise InfeasibleError('no tension at all')
    return Measured({'error_rad': 0.5}, {})


def not_finite(_study, seed):
    return Measured({'error_rad': float('nan') if seed else 0.5}, {})


def learns(_study, _seed):
    return Measured({}, {})


@pytest.mark.parametrize(
    ('learning', 'measuring', 'told'),
    [
        (learns, fails, 'InfeasibleError in body_change: no tension at all'),
        (learns, not_finite, 'MusculoskeletalError in body_change: the result error_rad is nan'),
        (fails, learns, 'InfeasibleError in online_learning: no tension at all'),
    ],
)
def test_a_failed_part_is_reported_everywhere_and_the_others_continue(
    monkeypatch, tmp_path, capsys, learning, measuring, told
):
    monkeypatch.setattr(online_learning, 'train_initial', lambda *_: None)
    for name, measure in ('online_learning', learning), ('body_change', measuring):
        faked = runner.EXPERIMENTS[name]._replace(measure=measure, plots=())
        monkeypatch.setitem(runner.EXPERIMENTS, name, faked)
    command = f'body_change --robot arm26 --seeds 0,1 --jobs 1 --out {tmp_path}'
    assert experiment.main(command.split()) == 1
    assert f'body_change of individual 1: {told}' in capsys.readouterr().err
    content = json.loads((tmp_path / 'body_change' / 'result.json').read_text('utf-8'))
    assert content['failed']['1'].startswith(told)
    assert list(content['seeds']) == ['0']
    assert f'body_change of individual 1: {told}' in (tmp_path / 'report.html').read_text('utf-8')
    assert f'Failed: body_change of individual 1: {told}' in readme_table(read(tmp_path))


def test_if_initial_training_fails_every_part_reports_it(monkeypatch, tmp_path, capsys):
    def train(_study, _preset):
        raise InfeasibleError('no tension at all')

    monkeypatch.setattr(online_learning, 'train_initial', train)
    assert experiment.main(f'all --robot arm26 --seeds 0,1 --jobs 1 --out {tmp_path}'.split()) == 1
    assert (
        f'{[*runner.EXPERIMENTS][-1]} of individual 1: InfeasibleError in'
        in capsys.readouterr().err
    )
    written = read(tmp_path)
    assert set(written) == set(runner.EXPERIMENTS)
    assert all(set(result['failed']) == {'0', '1'} for result in written.values())
    assert 'no tension at all' in (tmp_path / 'report.html').read_text('utf-8')


def test_a_network_is_read_whole_while_another_individual_brings_it(arm26, tmp_path):
    study = Study(arm26, 'default', (0, 1), 1.0, True, tmp_path)
    for preset in PRESETS:
        study.network_file(preset, None).write_text('first')
    part = robustness._study_of_model(study, 0, FOREIGN)
    file = part.network_file('default', None)
    with file.open() as reading:
        study.network_file('default', None).write_text('second')
        robustness._study_of_model(study, 1, FOREIGN)
        assert reading.read() == 'first'
    assert file.read_text() == 'second'
    assert len(list(part.folder.iterdir())) == len(PRESETS)
