# SPDX-License-Identifier: Apache-2.0
"""Files of users are read within limits, or rejected with an error that names the file."""

import os
from pathlib import Path

import pytest
import yaml

from musculoskeletal_ae import files
from musculoskeletal_ae.design.checks import read_declared_actions
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.description import load_description
from musculoskeletal_ae.tools import fit_series_elastic

COLUMNS = ['a', 'b']


class Refused(Exception):  # noqa: N818
    """The exception that the functions under test are asked to raise."""


def refuse(file, problem):
    return Refused(f'{file}: {problem}')


def fifo(file):
    os.mkfifo(file)


def endless(file):
    file.symlink_to('/dev/zero')


def missing(file):
    file.unlink(missing_ok=True)


def folder(file):
    file.mkdir()


def latin(file):
    file.write_bytes('a,b\n1,ä\n'.encode('latin-1'))


def large(file):
    file.write_bytes(b'a,b\n' + b'1,2\n' * 1_750_000)  # 7 MB, which is larger than is legal


def forbidden(file):
    file.write_text('a,b\n')
    file.chmod(0)
    if os.access(file, os.R_OK):
        pytest.skip('the superuser may read everything')


UNREADABLE = {
    fifo: 'not a regular file',
    endless: 'not a regular file',
    missing: 'No such file',
    folder: 'not a regular file',
    latin: 'is not UTF-8 text (byte 6)',
    large: 'is larger than 1048576 bytes',
    forbidden: 'Permission denied',
}


@pytest.mark.parametrize('make', UNREADABLE)
def test_what_is_no_file_of_text_is_refused_by_name(make, tmp_path):
    file = tmp_path / 'table.csv'
    make(file)
    with pytest.raises(Refused) as error:
        files.read_csv(file, COLUMNS, refuse)
    assert str(file) in str(error.value)
    assert UNREADABLE[make] in str(error.value)


@pytest.mark.parametrize('name', ['robot.urdf', 'muscles.yaml', 'moment_arms.csv'])
def test_an_unreadable_file_of_a_robot_is_named(name, tmp_path):
    from robots import copy_robot

    file = copy_robot('arm26', tmp_path) / name
    file.unlink(missing_ok=True)
    folder(file)
    with pytest.raises(MusculoskeletalError, match=name):
        read_declared_actions(load_description(file.parent))


def test_an_unreadable_testbed_table_is_named(tmp_path):
    with pytest.raises(MusculoskeletalError, match=r'table\.csv'):
        fit_series_elastic.read_table(tmp_path / 'table.csv')


def test_a_nul_in_a_path_is_refused(tmp_path):
    with pytest.raises(Refused, match='null'):
        files.read_text(tmp_path / 'a\0b', refuse)


@pytest.mark.parametrize(
    ('text', 'rows'),
    [
        ('a,b\n', []),
        ('# c\n\n a , b \n1,2\n# d\n"x, y",\n', [(4, ['1', '2']), (6, ['x, y', ''])]),
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
        ('a,b\n1,' + 'x' * 200_000, 'line 2: not valid CSV: field larger'),
    ],
)
def test_what_is_no_table_is_refused(text, problem, tmp_path):
    file = tmp_path / 'table.csv'
    file.write_text(text)
    with pytest.raises(Refused, match=problem):
        files.read_csv(file, COLUMNS, refuse)


def test_what_yaml_writes_is_read(tmp_path):
    value = {'a': [1, 2.5, None, True, 'text'], 'b': {'c': [[], {}, 'x' * 5000]}, 'é': -1}
    (tmp_path / 'a.yaml').write_text(yaml.safe_dump(value, allow_unicode=True))
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


def bomb(step):
    """Return YAML in which each line refers to the previous one nine times."""
    lines = ['a0: &a0 {k: x}'] + [
        f'a{i}: &a{i} ' + step.format(', '.join([f'*a{i - 1}'] * 9)) for i in range(1, 16)
    ]
    return '\n'.join(lines)


REFUSED_YAML = {
    'nine to the sixteenth entries': (bomb('[{}]'), 'legal: at most 100000, with aliases'),
    'as many merged keys': (bomb('{{<<: [{}]}}'), 'legal: at most 100000, with aliases'),
    'a list within itself': ('a: &a [*a]', 'alias *a has no anchor before it'),
    'a key twice': ('a: {b: 1, c: 2, b: 3}', "line 1: key 'b' is written twice"),
    'too deep': ('[' * 100_000, 'legal: at most 50 levels'),
    'an object of Python': ('!!python/object/apply:os.abort []', 'could not determine'),
    'no date': ('a: 2020-13-45', 'month must be in 1..12'),
    'two documents': ('a: 1\n---\nb: 2', 'expected a single document'),
    'an open bracket': ('a: [', 'expected'),
}


@pytest.mark.parametrize('case', REFUSED_YAML)
def test_yaml_that_cannot_be_used_is_refused_in_one_line(case):
    text, problem = REFUSED_YAML[case]
    with pytest.raises(ValueError, match=r'.') as error:
        files.parse_yaml(text)
    assert problem in str(error.value)
    assert '\n' not in str(error.value)


def test_larger_yaml_than_anybody_writes_is_not_even_parsed(tmp_path):
    (tmp_path / 'a.yaml').write_text('#' * files.LARGEST_YAML + '\n')
    with pytest.raises(Refused, match='is larger than'):
        files.read_yaml(tmp_path / 'a.yaml', refuse)


# -- writing --------------------------------------------------------------------------------------


def test_a_file_is_replaced_whole_and_the_one_before_it_kept(tmp_path):
    file, previous = tmp_path / 'a', tmp_path / 'before'
    for content in (b'1', b'2', b'3'):
        files.write_whole(file, content, previous)
    assert (file.read_bytes(), previous.read_bytes()) == (b'3', b'2')
    assert set(tmp_path.iterdir()) == {file, previous}


@pytest.mark.parametrize('has_links', [True, False])
def test_a_writer_that_is_killed_leaves_the_file(has_links, tmp_path, monkeypatch):
    file, previous = tmp_path / 'a', tmp_path / 'before'
    files.write_whole(file, b'0', previous)
    replace, states = Path.replace, []

    def record(self, target):
        done = replace(self, target)
        states.append((file.read_bytes(), previous.exists() and previous.read_bytes()))
        return done

    def refuse_link(*_):
        raise PermissionError('no links')

    monkeypatch.setattr(Path, 'replace', record)
    if not has_links:
        monkeypatch.setattr(os, 'link', refuse_link)
    files.write_whole(file, b'1', previous)
    assert states == [(b'0', b'0'), (b'1', b'0')]
    monkeypatch.undo()
    previous.unlink()
    previous.hardlink_to(file)  # as a kill between the two steps leaves them
    files.write_whole(file, b'2', previous)
    assert (file.read_bytes(), previous.read_bytes()) == (b'2', b'1')
    assert set(tmp_path.iterdir()) == {file, previous}


def test_a_file_that_cannot_be_written_leaves_the_one_before_it(tmp_path, monkeypatch):
    file, previous = tmp_path / 'a', tmp_path / 'before'
    files.write_whole(file, b'1', previous)

    def fail(_):
        raise OSError('no space')

    monkeypatch.setattr(os, 'fsync', fail)
    with pytest.raises(OSError, match='no space'):
        files.write_whole(file, b'2', previous)
    assert file.read_bytes() == b'1'
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize('is_there', [False, True])
def test_a_directory_of_results_is_complete_or_as_before(tmp_path, is_there):
    directory = tmp_path / 'results'
    if is_there:
        directory.mkdir()

    @files.new_directory(directory, refuse)
    def interrupted():
        (directory / 'file').write_text('a part')
        (directory / 'folder').mkdir()
        (directory / 'folder' / 'file').write_text('a part')
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert directory.exists() == is_there
    with files.new_directory(directory, refuse):
        (directory / 'file').write_text('everything')
    with pytest.raises(Refused, match='new or empty'), files.new_directory(directory, refuse):
        pass
    assert (directory / 'file').read_text() == 'everything'
