# SPDX-License-Identifier: Apache-2.0
"""Command lines of `record` and `replay`: every mistake is one clear line and status 2."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from musculoskeletal_ae.bags.topics import TOPICS
from musculoskeletal_ae.bags.writer import COMPRESSIONS
from musculoskeletal_ae.options import not_negative, positive

ROS_HELP = 'ROS options follow --ros-args: -r __ns:=/left_arm, -r TOPIC:=OTHER.'


class OneLineParser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and end with status 2."""
        print(f'{self.prog}: error: {message} (see {self.prog} --help)', file=sys.stderr)
        sys.exit(2)


def names(text: str) -> list[str]:
    """Return the names in a list separated by commas."""
    found = [name.strip() for name in text.split(',') if name.strip()]
    if not found:
        raise argparse.ArgumentTypeError('no topic is named')
    return found


def _recorded(text: str) -> list[str]:
    found = names(text)
    for name in found:
        if name not in TOPICS:
            raise argparse.ArgumentTypeError(f'{name!r} is none of {", ".join(TOPICS)}')
    return list(dict.fromkeys(found))


def parse_record(arguments: list[str]) -> argparse.Namespace:
    """Return the options of `record`."""
    parser = OneLineParser(
        prog='record',
        description='Records the topics of this package to a bag that `ros2 bag` can read. '
        'Ctrl-C ends it. ' + ROS_HELP,
    )
    parser.add_argument('directory', nargs='?', type=Path, metavar='DIR', help='new directory')
    parser.add_argument('-o', '--out', type=Path, metavar='DIR', help='the same')
    parser.add_argument(
        '--topics', type=_recorded, default=list(TOPICS), help='a list with commas (all)'
    )
    parser.add_argument('--duration', type=positive, metavar='S', help='end after so long [s]')
    parser.add_argument('--compression', choices=COMPRESSIONS, default='zstd', help='(zstd)')
    parser.add_argument(
        '--recover',
        type=Path,
        metavar='BAG',
        help='make a finished bag of one whose recorder was killed: in place, the original kept '
        'as BAG.unfinished, or in DIR',
    )
    options = parser.parse_args(arguments)
    if options.directory and options.out:
        parser.error('DIR is given twice')
    options.out = options.out or options.directory
    return options


def parse_replay(arguments: list[str]) -> argparse.Namespace:
    """Return the options of `replay`."""
    parser = OneLineParser(
        prog='replay',
        description='Plays a recorded bag onto the topics, with the recorded spacing. ' + ROS_HELP,
        epilog='While it plays, the services replay/pause, replay/resume and replay/step '
        '(std_srvs/Trigger) stop it, go on, and publish the messages of the next recorded time.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='a bag directory or an mcap file')
    add('--check', action='store_true', help='play nothing; say what is in it (exit status 1: bad)')
    add('--robot', help='for --check: a shipped robot or a directory that the bag must fit')
    add(
        '--topics',
        type=names,
        default=['default'],
        metavar='LIST',
        help='default: what hardware, vision, user and controller sent; all: also what nodes '
        'compute; or names separated by commas',
    )
    add('--keep-names', action='store_true', help='keep the recorded namespace')
    add('--from-namespace', metavar='NS', help='which arm, of a bag that has several')
    add('--rate', type=positive, default=1.0, help='times the recorded speed; needs --clock')
    add('--clock', action='store_true', help='publish the recorded time on /clock')
    add('--loop', action='store_true', help='start again at the end')
    add('--start', type=not_negative, default=0.0, metavar='S', help='begin so far into the bag')
    add('--duration', type=positive, metavar='S', help='play so much of the bag [s]')
    add('--paused', action='store_true', help='wait for replay/resume or replay/step')
    add('--wait', type=not_negative, default=2.0, metavar='S', help='for subscribers, at most (2)')
    options = parser.parse_args(arguments)
    if options.rate != 1 and not options.clock:
        parser.error(
            '--rate other than 1 needs --clock, and nodes with use_sim_time: '
            'by their own clocks they would take the arm to be faster or slower than it was'
        )
    if options.robot and not options.check:
        parser.error('--robot is for --check')
    return options
