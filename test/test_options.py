# SPDX-License-Identifier: Apache-2.0
"""Properties that the command lines of all tools and benches have."""

import argparse
from importlib import import_module
from pathlib import Path

import pytest

from musculoskeletal_ae import options
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.process_signals import INTERRUPTED


def parser():
    made = Parser('tool', 'Does something.')
    made.add_robot()
    made.add_preset()
    made.add_seed('of the noise')
    made.add_seeds((0, 1, 2))
    made.add_minutes('of exploration', None)
    made.add_out('DIR', default=Path('results'))
    made.add_plot('the result')
    made.add_argument('--jobs', type=options.whole(1, 8), default=2, help='processes')
    made.add_argument('--quick', action='store_true', help='less')
    return made


@pytest.mark.parametrize(
    ('arguments', 'problem'),
    [
        (['--preset', 'best'], "--preset: invalid choice: 'best'"),
        (['--seed', '-1'], "--seed: '-1': expected 0 to"),
        (['--seeds', '1,1'], 'expected different whole numbers, as in 0,1,2'),
        (['--minutes', 'nan'], "--minutes: 'nan': expected 0.2 to 600"),
        (['--nonsense'], 'unrecognized arguments: --nonsense'),
    ],
)
def test_a_mistake_is_one_line_that_names_the_option_and_status_2(arguments, problem, capsys):
    with pytest.raises(SystemExit) as ended:
        parser().parse_args(arguments)
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert problem in message
    assert message.startswith('tool: error: ')
    assert message.count('\n') == 1


def test_a_robot_may_be_required_or_come_by_position(capsys):
    required = Parser('tool', '')
    required.add_robot(default=None)
    with pytest.raises(SystemExit):
        required.parse_args([])
    assert '--robot' in capsys.readouterr().err
    positional = Parser('tool', '')
    positional.add_robot('robot')
    assert positional.parse_args(['arm26']).robot == 'arm26'


@pytest.mark.parametrize(
    ('kind', 'good', 'bad'),
    [
        (options.positive, ['0.1', '1e300'], ['0', '-1', 'nan', 'inf', 'x', '']),
        (options.not_negative, ['0', '3'], ['-1e-9', 'nan', 'inf', 'x']),
        (options.number(1.0, 2.0), ['1', '2.0'], ['0.9', '2.1', 'nan', 'x']),
        (options.whole(1, 3), ['1', '3'], ['0', '4', '1.5', 'x']),
        (options.names, ['a', 'a, b'], ['', ',', ' ,']),
    ],
)
def test_option_types_accept_legal_values_only(kind, good, bad):
    for text in good:
        kind(text)
    for text in bad:
        with pytest.raises(argparse.ArgumentTypeError):
            kind(text)


def test_names_are_listed_once_and_in_order():
    assert options.names('b,a, b') == ['b', 'a']


def test_an_error_of_the_package_is_one_line_and_status_1(capsys):
    def refuse():
        raise RobotDescriptionError('robot.urdf: is no robot')

    assert exit_status(refuse) == 1
    assert capsys.readouterr().err == 'error: robot.urdf: is no robot\n'
    assert exit_status(lambda: None) == 0
    assert exit_status(lambda: 3) == 3


def test_ctrl_c_ends_without_a_traceback(capsys):
    def interrupt():
        raise KeyboardInterrupt

    assert exit_status(interrupt) == INTERRUPTED
    assert capsys.readouterr().err == 'interrupted\n'


def test_an_unexpected_exception_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        exit_status(lambda: 1 // 0)


TOOLS = [
    'ros_tools.check_driver', 'ros_tools.record', 'ros_tools.render', 'ros_tools.replay',
    'ros_tools.view',
    'tools.check_robot', 'tools.experiment', 'tools.fit_series_elastic', 'tools.import_robot',
    'tools.train',
]  # fmt: skip


@pytest.mark.parametrize('tool', TOOLS)
def test_help_states_no_default_twice(tool, capsys):
    with pytest.raises(SystemExit):
        import_module(f'musculoskeletal_ae.{tool}').main(['--help'])
    options = ' '.join(capsys.readouterr().out.split()).split(' --')
    assert [option for option in options if option.count('(default:') > 1] == []


@pytest.mark.parametrize('is_directory', [False, True])
@pytest.mark.parametrize('writes', [False, True])
def test_ctrl_c_ends_with_one_line_that_says_whether_the_result_was_written(
    tmp_path, capsys, is_directory, writes
):
    out = tmp_path / 'out'
    file = out / 'file' if is_directory else out
    if is_directory:
        out.mkdir()

    def work():
        if writes:
            file.write_text('result')
        raise KeyboardInterrupt

    assert exit_status(work, out=out) == INTERRUPTED
    result = 'was written' if writes else 'was not written'
    assert capsys.readouterr().err == f'interrupted; {out} {result}\n'
