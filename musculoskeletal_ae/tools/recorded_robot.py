# SPDX-License-Identifier: Apache-2.0
"""Tells whether a recording is one of a given robot, and if not, of which robot it is.

    python -m musculoskeletal_ae.executables tools.recorded_robot BAG ROBOT [NAMESPACE]

ends with status 1 and one line if the nodes of the robot could not use the recording. `bringup.sh`
calls it before it starts anything. It only reads the beginning of a recording that fits;
`replay --check` reads all of it, and also compares the order of the muscles.
"""

import sys
from pathlib import Path

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import LATEST
from musculoskeletal_ae.bags.streams import described_robot, read_streams
from musculoskeletal_ae.bags.topics import interface_topics
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError, printable
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.robot.robot import Robot

#: first read this much time of a recording [ns], which reveals most wrong robots quickly
BEGINNING = 2_000_000_000


def misfit(bag: Bag, name: str, namespace: str | None = None) -> str:
    """Return why a recording does not fit a robot, and what to pass instead; '' if it fits.

    Args:
        bag: The recording to check.
        name: A shipped robot or a robot directory.
        namespace: The namespace of the arm; required only if the bag has several.

    Raises:
        MusculoskeletalError: If the robot or the recording is unusable.
    """
    robot = Robot.load(name)
    # First raise errors that do not depend on the robot.
    topics = interface_topics(bag, namespace, robot.description.motor_topics)
    # The first messages may be faulty, so read the whole recording before refusing it.
    for stop in bag.start + BEGINNING, LATEST:
        problem = _problem(bag, robot, namespace, stop)
        if not problem:
            return ''
    fits = [
        other
        for other in shipped_robots()
        if not _problem(bag, Robot.load(other), namespace, bag.start + BEGINNING)
    ]
    if fits:
        remedy = f'it fits {", ".join(fits)}; pass --robot {fits[0]}'
    else:
        remedy = 'pass --robot with the directory of the robot that was recorded'
        recorded, joints = described_robot(bag, topics.get('robot_description'))
        if joints:
            stated = f'its robot_description is that of {recorded!r}, with the joints '
            remedy = f'{stated}{", ".join(joints)}; {remedy}'
    robot_name = robot.description.directory.name
    return f'{bag.path} is not a recording of {robot_name}: {problem}; {remedy}'


def _problem(bag: Bag, robot: Robot, namespace: str | None, stop: int) -> str:
    """Return why the messages up to a log time [ns] do not fit a robot; '' if they do."""
    try:
        read_streams(bag, robot, namespace, stop=stop)
    except BagError as error:
        return error.problem
    return ''


def main(arguments: list[str]) -> int:
    """Print why a recording does not fit a robot; return the exit status."""
    path, robot, *namespace = arguments
    try:
        problem = misfit(Bag.open(Path(path)), robot, *namespace)
    except (MusculoskeletalError, OSError) as error:
        problem = str(error)
    if problem:
        print(f'error: {printable(problem)}', file=sys.stderr)
    return 1 if problem else 0
