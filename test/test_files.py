# SPDX-License-Identifier: Apache-2.0
"""Files that a user names by mistake or malice are refused at once, in one line, by name."""

import os
import sys
from pathlib import Path

import pytest
import yaml

from musculoskeletal_ae import files
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.robot.checks import read_declared_actions
from musculoskeletal_ae.robot.description import load_description
from musculoskeletal_ae.tools import fit_series_elastic

COLUMNS = ['a', 'b']


class Refused(Exception):  # noqa: N818
    """What the caller's error is in these tests."""


def refuse(file, problem):
    return Refused(f'{file}: {problem}')


def fifo(file):
    os.mkfifo(file)


def endless(file):
    file.symlink_to('/dev/zero')


def terminal(file):
    file.symlink_to('/dev/tty')


def dangling(file):
    file.symlink_to(file.with_name('nowhere'))


def folder(file):
    file.mkdir()


def latin(file):
    file.write_bytes('a,b\n1,ä\n'.encode('latin-1'))


def large(file):
    file.write_bytes(b'a,b\n' + b'1,2\n' * 1_750_000)  # 7 MB


def forbidden(file):
    file.write_text('a,b\n')
    file.chmod(0)
    if os.access(file, os.R_OK):
        pytest.skip('the superuser may read everything')


STRANGE = {
    fifo: 'no regular file',
    endless: 'no regular file',
    terminal: 'cannot be read',
    dangling: 'No such file',
    folder: 'no regular file',
    latin: 'is not text in UTF-8 (byte 6)',
    large: 'is larger than 1048576 bytes',
    forbidden: 'Permission denied',
}


@pytest.mark.parametrize('make', STRANGE)
def test_what_is_no_file_of_text_is_refused_by_name(make, tmp_path):
    file = tmp_path / 'table.csv'
    make(file)
    with pytest.raises(Refused) as error:
        files.read_csv(file, COLUMNS, refuse)
    assert str(file) in str(error.value)
    assert STRANGE[make] in str(error.value)


@pytest.mark.parametrize('make', STRANGE)
@pytest.mark.parametrize('name', ['robot.urdf', 'muscles.yaml', 'moment_arms.csv'])
def test_no_file_of_a_robot_directory_can_be_anything_else(make, name, tmp_path):
    from robots import copy_robot

    file = copy_robot('arm26', tmp_path) / name
    file.unlink(missing_ok=True)
    make(file)
    with pytest.raises(RobotDescriptionError, match=name):
        read_declared_actions(load_description(file.parent))


@pytest.mark.parametrize('make', STRANGE)
def test_no_testbed_table_can_be_anything_else(make, tmp_path):
    file = tmp_path / 'table.csv'
    make(file)
    with pytest.raises(RobotDescriptionError, match=r'table\.csv'):
        fit_series_elastic.read_table(file)


def test_a_nul_in_a_path_is_refused(tmp_path):
    with pytest.raises(Refused, match='null'):
        files.read_text(tmp_path / 'a\0b', refuse)


def test_no_more_than_the_limit_is_read_of_a_file_that_has_no_length():
    # Files of /proc say 0 bytes and hold more.
    with pytest.raises(Refused, match='is larger than 3 bytes'):
        files.read_bytes(Path('/proc/self/status'), refuse, 3)


@pytest.mark.parametrize(
    ('text', 'rows'),
    [
        ('a,b\n', []),
        ('# c\n\n a , b \n1,2\n# d\n"x, y",\n', [(4, ['1', '2']), (6, ['x, y', ''])]),
        ('a,b\n"1\n2",3\n', [(2, ['1']), (3, ['2"', '3'])]),  # a row is a line
    ],
)
def test_a_table_is_its_rows_with_their_lines(text, rows, tmp_path):
    file = tmp_path / 'table.csv'
    file.write_text(text)
    assert [(line, cells) for line, _, cells in files.read_csv(file, COLUMNS, refuse)] == rows


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('', 'columns a,b, got nothing'),
        ('b,a\n1,2\n', "columns a,b, got 'b,a'"),
        ('a,b\n1,' + 'x' * 200_000, 'line 2: no line of a table: field larger'),
    ],
)
def test_what_is_no_table_is_refused(text, problem, tmp_path):
    file = tmp_path / 'table.csv'
    file.write_text(text)
    with pytest.raises(Refused, match=problem):
        files.read_csv(file, COLUMNS, refuse)


def test_what_yaml_writes_is_read(tmp_path):
    value = {'a': [1, 2.5, None, True, 'text'], 'b': {'c': [[], {}, 'x' * 5000]}, 'é': -1}
    for flow in (False, True):
        text = yaml.safe_dump(value, default_flow_style=flow, allow_unicode=True)
        (tmp_path / 'a.yaml').write_text(text)
        assert files.read_yaml(tmp_path / 'a.yaml', refuse) == value


def test_aliases_and_merge_keys_stand_for_what_they_say():
    text = """
        base: &base {x: 1, y: [1, 2]}
        more: &more {<<: *base, x: 2}
        last: {<<: [*more, {z: 3}], list: *base}
    """
    base = {'x': 1, 'y': [1, 2]}
    assert files.parse_yaml(text) == {
        'base': base,
        'more': base | {'x': 2},
        'last': base | {'x': 2, 'z': 3, 'list': base},
    }


def bomb(step, depth=40):
    """Each line says the one before it nine times."""
    lines = ['a0: &a0 {k: x}'] + [
        f'a{i}: &a{i} ' + step.format(', '.join([f'*a{i - 1}'] * 9)) for i in range(1, depth)
    ]
    return '\n'.join(lines)


# Each takes hours or all memory if it is simply loaded; none is longer than it must be for that.
HOSTILE = {
    'alias bomb': (bomb('[{}]', 16), 'line 6: more than 100000 entries, aliases included'),
    'merge-key bomb': (bomb('{{<<: [{}]}}', 16), 'line 6: more than 100000 entries'),
    'self-reference': ('a: &a [*a]', '*a stands for nothing before it'),
    'keys twice': ('a: {b: 1, c: 2, b: 3}', "line 1: key 'b' is written twice"),
    '8000 keys, one twice': (
        '\n'.join(f'k{i % 7999}: {i}' for i in range(8000)),
        "line 8000: key 'k0' is written twice",
    ),
    'many entries': ('[' + '0,' * 200_000 + ']', 'more than 100000 entries'),
    'too deep': ('[' * 100_000, 'more than 50 levels'),
    'deep mapping': ('\n'.join(' ' * i + 'a:' for i in range(100)), 'more than 50 levels'),
    'base-60 integer': ('a: 1' + ':00' * 300_000, 'unquoted number of over 1000 characters'),
    'tagged integer': ('a: !!int "' + '1:' * 1000 + '0"', 'explicit type tag:yaml.org,2002:int'),
    'python object': ('!!python/object/apply:os.abort []', 'explicit type tag:yaml.org'),
    'no date': ('a: 2020-13-45', 'month must be in 1..12'),
    'endless number': ('a: ' + '9' * 5000, 'unquoted number'),
    'two documents': ('a: 1\n---\nb: 2', 'expected a single document'),
    'unhashable key': ('{[a, b]: 1}', 'unhashable key'),
    'open bracket': ('a: [', 'expected'),
    'control character': ('a: \x01', 'not allowed'),
}


@pytest.mark.parametrize('case', HOSTILE)
@pytest.mark.parametrize('loader', ['CSafeLoader', 'SafeLoader'])
def test_hostile_yaml_is_refused_before_anything_is_built(case, loader, monkeypatch):
    if not hasattr(yaml, loader):
        pytest.skip('PyYAML was built without libyaml')
    monkeypatch.setattr(files, '_Loader', getattr(yaml, loader))
    text, problem = HOSTILE[case]
    if loader == 'SafeLoader':
        problem = {'control character': 'special characters'}.get(case, problem)
        problem = {'open bracket': ''}.get(case, problem)
    with pytest.raises(ValueError, match=r'.') as error:
        files.parse_yaml(text)
    assert problem in str(error.value)
    assert '\n' not in str(error.value)


def test_bombs_are_as_small_as_a_kilobyte():
    for case in ('alias bomb', 'merge-key bomb'):
        assert len(HOSTILE[case][0]) < 1024


def test_work_on_yaml_is_bounded_by_entries_not_by_what_aliases_stand_for(monkeypatch):
    """The loader that builds is never asked for more entries than the limit."""
    built = []
    original = yaml.load
    monkeypatch.setattr(yaml, 'load', lambda *a, **k: built.append(1) or original(*a, **k))
    for text, _ in (HOSTILE['alias bomb'], HOSTILE['merge-key bomb'], HOSTILE['too deep']):
        with pytest.raises(ValueError, match='more than'):
            files.parse_yaml(text)
    assert not built


def test_larger_yaml_than_anybody_writes_is_not_even_parsed(tmp_path):
    (tmp_path / 'a.yaml').write_text('#' * (1 << 20) + '\n')
    with pytest.raises(Refused, match='is larger than 1048576 bytes'):
        files.read_yaml(tmp_path / 'a.yaml', refuse)


@pytest.mark.skipif(sys.platform != 'linux', reason='/dev/full')
def test_reading_leaves_no_descriptor_open(tmp_path):
    (tmp_path / 'a').write_text('x')
    os.mkfifo(tmp_path / 'fifo')
    before = len(list(Path('/proc/self/fd').iterdir()))
    for _ in range(5):
        files.read_text(tmp_path / 'a', refuse)
        with pytest.raises(Refused):
            files.read_text(tmp_path / 'fifo', refuse)
    assert len(list(Path('/proc/self/fd').iterdir())) == before
