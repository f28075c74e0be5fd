# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import find_robot

from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.tools import fit_series_elastic as tool

TESTBED = find_robot('arm26').parent / 'testbed' / 'one_muscle.csv'


def constants(force, rate, wire_stretch):
    return SeriesElastic(np.array([force]), np.array([rate]), np.array([wire_stretch]))


@settings(max_examples=50)
@given(st.floats(20.0, 300.0), st.floats(10.0, 80.0), st.floats(0.0, 1e-4), st.floats(0.0, 500.0))
def test_compliance_and_length_slope_are_the_derivatives_of_elongation(force, rate, wire, pull):
    elastic, length = constants(force, rate, wire), np.array([0.3])
    tension, step = np.array([pull + 1.0]), 1e-3
    rise = elastic.elongation(length, tension + step) - elastic.elongation(length, tension - step)
    np.testing.assert_allclose(elastic.compliance(length, tension), rise / (2 * step), rtol=1e-6)
    longer = elastic.elongation(length + step, tension) - elastic.elongation(length, tension)
    np.testing.assert_allclose(elastic.length_slope(tension), longer / step, atol=1e-9)


def test_elongation_inverts_the_exponential_spring_when_the_tendon_is_stiff():
    elastic = constants(100.0, 30.0, 0.0)
    stretch = elastic.elongation(np.array([0.3]), np.array([250.0]))
    np.testing.assert_allclose(100.0 * (np.exp(30.0 * stretch) - 1.0), 250.0)


def test_a_tendon_that_cannot_push_does_not_shorten():
    assert constants(100.0, 30.0, 2e-5).elongation(np.array([0.3]), np.array([-50.0])) == 0.0


@settings(max_examples=20)
@given(st.floats(40.0, 250.0), st.floats(15.0, 60.0), st.floats(5e-6, 1e-4))
def test_the_fit_recovers_known_constants(force, rate, wire_stretch):
    tension, length = (a.ravel() for a in np.meshgrid([5, 20, 60, 150, 300, 500], [0.2, 0.4, 0.6]))
    elongation = constants(force, rate, wire_stretch).elongation(length, tension)
    fitted = tool.fit_series_elastic(tension.astype(float), length, elongation)
    for value, true in zip(
        (fitted.force, fitted.rate, fitted.wire_stretch), (force, rate, wire_stretch), strict=True
    ):
        np.testing.assert_allclose(value, true, rtol=1e-3)


@pytest.mark.parametrize(
    ('spring', 'wire'),
    [(lambda t: t / 20e3, 0.0), (lambda t: 0.0 * t, 1e-5), (lambda t: t / 20e3, 1e-5)],
)
def test_linear_and_rigid_springs_give_constants_that_muscles_yaml_accepts(
    tmp_path, capsys, spring, wire
):
    rows = [(t, a, spring(t) + wire * a * t) for t in (5.0, 50.0, 200.0) for a in (0.1, 0.3, 0.6)]
    file = tmp_path / 'table.csv'
    text = '\n'.join(','.join(map(repr, row)) for row in rows)
    file.write_text(f'{",".join(tool.COLUMNS)}\n{text}\n')
    assert tool.main([str(file)]) == 0
    reported = capsys.readouterr().out.splitlines()[0]
    printed = yaml.safe_load(reported)['series_elastic']
    assert all(0.0 < value <= 1e8 for value in printed.values())
    fitted = constants(**printed)
    for t, a, x in rows:
        assert fitted.elongation(np.array([a]), np.array([t]))[0] == pytest.approx(x, abs=2e-5)


def test_a_table_that_cannot_pin_down_the_constants_is_refused():
    one = np.ones(5)
    with pytest.raises(ValueError, match='several tensions at several muscle lengths'):
        tool.fit_series_elastic(one, one, one)
    with pytest.raises(ValueError, match='at least 4'):
        tool.fit_series_elastic(one[:2], one[:2], one[:2])


def test_the_tool_fits_the_shipped_table_to_its_noise(tmp_path, capsys):
    assert tool.main([str(TESTBED), '--plot', str(tmp_path / 'fit.png')]) == 0
    printed = capsys.readouterr().out
    assert 'series_elastic: {force: ' in printed
    rms = float(printed.split('rms ')[1].split(' mm')[0])
    assert 0.05 < rms < 0.15  # the lengths in the table have a noise of 0.1 mm
    assert (tmp_path / 'fit.png').read_bytes().startswith(b'\x89PNG')


def test_a_table_saved_by_a_spreadsheet_is_read(tmp_path, capsys):
    file = tmp_path / 'table.csv'
    rows = [f'{t},{length},{t / 5000:.4f}' for length in (0.1, 0.3) for t in (5, 50, 100)]
    text = '\n'.join(['tension,absolute_length,elongation', *rows])
    file.write_text(text, encoding='utf-8-sig')
    assert tool.main([str(file)]) == 0
    assert 'series_elastic: {' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('text', 'fragments'),
    [
        ('a,b,c\n1,2,3\n', ['columns', 'a,b,c']),
        ('tension,absolute_length,elongation\n5,0.2,0.001\n6,0.2,soft\n', ['row 3', 'soft']),
        ('tension,absolute_length,elongation\n5,200,1.5\n', ['row 2', 'at most 10 m', 'by 1000']),
        (
            'tension,absolute_length,elongation\n5,0.2,0.02\n50,0.2,0.01\n5,0.3,0.02\n50,0.3,0\n',
            ['does not grow'],
        ),
    ],
)
def test_a_bad_table_is_refused_naming_file_and_row(tmp_path, capsys, text, fragments):
    file = tmp_path / 'table.csv'
    file.write_text(text)
    assert tool.main([str(file)]) == 1
    message = capsys.readouterr().err
    for fragment in ['table.csv', *fragments]:
        assert fragment in message


def test_a_missing_table_is_an_error_not_a_traceback(tmp_path, capsys):
    assert tool.main([str(tmp_path / 'none.csv')]) == 1
    assert 'none.csv' in capsys.readouterr().err
