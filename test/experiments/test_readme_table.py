# SPDX-License-Identifier: Apache-2.0
"""The README's results table is what its command makes of the committed results."""

from __future__ import annotations

from pathlib import Path

import pytest
from musculoskeletal_ae.experiments.report.readme import (
    BEGIN,
    END,
    KEPT,
    main,
    results_in,
    table,
    update_readme,
    write_table,
)
from musculoskeletal_ae.experiments.report.rows import ROWS, missed_by, verdict

from musculoskeletal_ae.exceptions import MusculoskeletalError

REPOSITORY = Path(__file__).parents[2]


def test_the_readme_says_what_the_committed_results_say():
    readme = REPOSITORY / 'README.md'
    if not readme.is_file():
        pytest.skip('runs in the repository only')
    text = readme.read_text(encoding='utf-8')
    between = text.split(BEGIN)[1].split(END)[0]
    expected = table(results_in(REPOSITORY / KEPT))
    remedy = 'run: python -m musculoskeletal_ae.experiments.report.readme README.md'
    assert between == f'\n{expected}\n', remedy


def test_committed_results_are_of_full_runs():
    for name, result in results_in(REPOSITORY / KEPT).items():
        assert not result['about']['quick'], name
        assert len(result['about']['seeds']) >= 5, name


def test_a_run_is_kept_and_its_table_written(quick, tmp_path):
    readme = tmp_path / 'README.md'
    readme.write_text(f'before\n{BEGIN}\nlast year\n{END}\nafter\n', encoding='utf-8')
    files = update_readme(quick, readme)
    assert (tmp_path / KEPT / 'control' / 'result.json') in files
    text = readme.read_text(encoding='utf-8')
    assert text.startswith('before\n') and text.endswith('\nafter\n')
    assert 'last year' not in text
    assert text.count('\n| ') == 1 + len(ROWS)
    assert main([str(readme)]) == 0
    assert readme.read_text(encoding='utf-8') == text


def test_a_readme_without_markers_is_left_alone(tmp_path):
    readme = tmp_path / 'README.md'
    readme.write_text('no place', encoding='utf-8')
    with pytest.raises(MusculoskeletalError, match='results'):
        write_table(readme)
    assert main([str(readme)]) == 1
    assert readme.read_text(encoding='utf-8') == 'no place'


def test_aims_are_judged_in_the_right_direction():
    after = next(r for r in ROWS if r.default == 'after_rad' and r.experiment == 'online_learning')
    named = next(r for r in ROWS if r.default == 'named_share')
    good = {'online_learning': {'after_rad': 0.08}, 'estimation': {'named_share': 0.95}}
    bad = {'online_learning': {'after_rad': 0.13}, 'estimation': {'named_share': 0.5}}
    assert [verdict(good, row) for row in (after, named)] == ['met', 'met']
    assert verdict(bad, after) == 'missed by 0.030'
    assert missed_by(bad, named) == pytest.approx(0.4)
