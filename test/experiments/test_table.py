# SPDX-License-Identifier: Apache-2.0
"""The table of results is the one that its command creates from the committed results."""

from pathlib import Path

import pytest

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import PAPER, paper_page
from musculoskeletal_ae.experiments.results import (
    BEGIN,
    END,
    read,
    readme_table,
    update_readme,
)
from musculoskeletal_ae.experiments.results import ROWS as TABLE
from musculoskeletal_ae.experiments.runner import EXPERIMENTS
from musculoskeletal_ae.presets.preset import PAPER_PRESET

REPOSITORY = Path(__file__).parents[2]
RESULTS = REPOSITORY / 'doc' / 'results.md'
KEPT = RESULTS.with_suffix('')
PAGE = KEPT / 'paper.md'
ROWS = [(name, row) for name, rows in TABLE.items() for row in rows]


def rows(key):
    """Return the rows of the results table that show the value of `key` in result.json."""
    return [row for _, row in ROWS if row.default == key]


def test_the_page_shows_the_committed_results():
    text = RESULTS.read_text(encoding='utf-8')
    between = text.split(BEGIN)[1].split(END)[0]
    remedy = 'run: python -m musculoskeletal_ae.experiments.results doc/results.md'
    assert between == readme_table(read(KEPT)), remedy


def test_committed_results_are_of_full_runs_of_every_experiment():
    results, of_page = read(KEPT), read(PAGE.with_suffix(''))
    assert set(results) | set(of_page) == set(EXPERIMENTS)
    assert set(of_page) <= set(PAPER)
    for name, result in [*results.items(), *of_page.items()]:
        assert not result['about']['quick'], name
    assert all(len(result['about']['seeds']) >= 5 for result in results.values())


def test_the_page_of_the_paper_shows_the_results_and_pictures_beside_it():
    folder = PAGE.with_suffix('')
    page = PAGE.read_text(encoding='utf-8')
    remedy = f'run: python -m musculoskeletal_ae.experiments.paper_page {PAGE}'
    assert page == paper_page.text(read(folder), folder), remedy
    for picture in folder.glob('*.png'):
        assert f']({folder.name}/{picture.name})' in page
        assert picture.stat().st_size <= paper_page.LARGEST


def test_every_row_of_the_paper_is_filled_from_the_results_of_its_page():
    page = PAGE.read_text(encoding='utf-8')
    for name, rows_of_table in paper_page.TABLES.items():
        for row in rows_of_table:
            assert f'| {row.quantity} |' in page, (name, row.quantity)


def test_a_page_without_results_is_refused(tmp_path):
    with pytest.raises(MusculoskeletalError, match='no results'):
        paper_page.update_page(tmp_path / 'paper.md')


@pytest.mark.parametrize(('name', 'row'), ROWS, ids=[row.quantity for _, row in ROWS])
def test_every_row_is_filled_from_the_committed_results(name, row):
    result = read(KEPT)[name]
    for key in filter(None, (row.paper.format(preset=PAPER_PRESET), row.default, row.bound)):
        assert row.number(result, key) is not None, key


def test_a_row_of_the_worst_individual_shows_the_largest_of_them():
    (row,) = [row for _, row in ROWS if row.worst]
    seeds = {'0': {row.default: 0.2}, '1': {row.default: 0.7}}
    assert row.number({row.default: 0.45, 'seeds': seeds}, row.default) == 0.7


def test_a_run_is_kept_and_its_table_written(quick, tmp_path):
    readme = tmp_path / 'page.md'
    readme.write_text(f'before\n{BEGIN}\nlast year\n{END}\nafter\n', encoding='utf-8')
    files = update_readme(readme, quick)
    assert (tmp_path / 'page' / 'control' / 'result.json') in files
    text = readme.read_text(encoding='utf-8')
    assert text.startswith('before\n') and text.endswith('\nafter\n')
    assert 'last year' not in text
    headings = {name for name, _ in ROWS}
    assert text.count('\n| ') == 1 + len(ROWS) + len(headings)
    assert update_readme(readme) == [readme]
    assert readme.read_text(encoding='utf-8') == text


def test_a_readme_without_markers_is_left_alone(tmp_path):
    readme = tmp_path / 'page.md'
    readme.write_text('no place', encoding='utf-8')
    with pytest.raises(MusculoskeletalError, match='results'):
        assert update_readme(readme) == [readme]
    assert readme.read_text(encoding='utf-8') == 'no place'


@pytest.mark.parametrize(
    ('key', 'number', 'verdict'),
    [
        ('after_rad', 0.08, 'met'),
        ('after_rad', 0.13, 'missed by 0.030'),
        ('named_share', 0.95, 'met'),
        ('named_share', 0.5, 'missed by 0.40'),
        ('after_rad', None, ''),
    ],
)
def test_aims_are_judged_in_the_right_direction(key, number, verdict):
    (row, *_) = rows(key)
    assert row.cells({} if number is None else {key: number}).verdict == verdict
