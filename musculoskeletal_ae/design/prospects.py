# SPDX-License-Identifier: Apache-2.0
"""Estimates within seconds whether an arm can be learned, before minutes of training.

An arm that its muscles cannot hold explores nothing and therefore learns nothing. `check_robot`
finds more, but takes longer for large arms.
"""

import time
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.design.checks import COUNTED_ARM_SHARE, LEAST_COUNTED_ARM
from musculoskeletal_ae.design.contacts import Contacts, contacts
from musculoskeletal_ae.motion.explored_postures import supported_postures
from musculoskeletal_ae.robot.actuation import DESIRED_SHARE
from musculoskeletal_ae.robot.equilibrium_states import has_followers
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

POSTURES = 150  # examine at most this many random postures
BUDGET = 2.5  # examine no further posture after this time [s]
LEAST_POSTURES = 20  # examine at least this many postures, however long that takes
#: warn that training is pointless below this share of holdable postures: the arm then explores at
#: most where joint stops support it
POINTLESS_SHARE = 0.02
#: if hardly any posture is holdable, seek near this many random postures others in which joint
#: stops support some joints
NEAR_POSTURES = 10
HARD_SHARE = 0.5  # warn that the arm explores only a part if fewer postures are holdable than this


class Prospects(NamedTuple):
    """Prospects of learning a robot: how many postures it can hold, and what prevents more."""

    robot: Robot
    held: int  # number of postures that the muscles can hold
    postures: int  # number of postures that were examined
    #: near how many of NEAR_POSTURES random postures muscles and joint stops hold the arm; 0 unless
    #: the muscles alone hold hardly any
    supported: int
    idle: Bools  # whether no muscle moves each joint, (D,)
    #: joints that most often lack torque in a posture that is not held, and in how many postures
    lacking: tuple[tuple[str, int], ...]
    contacts: Contacts | None  # contacts in random postures; None if the robot was not imported

    @property
    def share(self) -> float:
        """Share of the examined postures that the muscles can hold."""
        return self.held / self.postures

    @property
    def is_pointless(self) -> bool:
        """Whether training is pointless, because the arm cannot explore."""
        return self.share < POINTLESS_SHARE and not self.supported

    def lines(self) -> list[str]:
        """Return the prospects as lines of text for users, warnings first."""
        robot, lines = self.robot, list[str]()
        counts = f'{self.held} of {self.postures} random postures can be held'
        lacking = ', '.join(f'{name} ({count})' for name, count in self.lacking)
        lack = f'; torque is missing most at {lacking}' if lacking else ''
        if idle := [robot.joints[j] for j in np.flatnonzero(self.idle)]:
            names = ', '.join(idle)
            remedy = 'hold them (leave them out of --joints, or of `joints` in muscles.yaml)'
            lines.append(f'warning: no muscle moves {names}; {remedy}')
        moved = robot.joint_count - len(idle)
        if robot.muscle_count < moved:
            problem = 'cannot tell the angles of'
            reason = 'the arm is learned only where springs, weight and muscles balance'
            counts_of = f'the lengths of {robot.muscle_count} muscles', f'{moved} joints'
            lines.append(f'warning: {counts_of[0]} {problem} {counts_of[1]}; {reason}')
        if self.is_pointless:
            remedy = (
                'choose a part of the model (--joints, --end), or run check_robot, which suggests '
                'remedies'
            )
            problem = 'training is pointless, because the arm cannot explore'
            lines.append(f'warning: {counts}: {problem}{lack}; {remedy}')
        elif self.share < POINTLESS_SHARE:
            near = f'near {self.supported} of {NEAR_POSTURES} of them'
            balance = 'springs, weight or joint stops balance the muscles'
            support = 'joint stops support some joints'
            how = balance if has_followers(robot) else support
            text = f'the arm explores postures {near} in which {how}'
            lines.append(f'warning: {counts}; {text}{lack}')
        elif self.share < HARD_SHARE:
            lines.append(f'warning: {counts}, and only these are explored{lack}')
        else:
            lines.append(f'{counts}')
        if self.contacts is not None and not self.is_pointless:
            lines += self.contacts.lines(robot)
        lines.append(f'{robot.joint_count} joints, {robot.muscle_count} muscles')
        return lines


def prospects(robot: Robot) -> Prospects:
    """Examine random postures of a robot for a few seconds."""
    start = time.monotonic()
    theta = robot.random_postures(POSTURES, np.random.default_rng(0))
    limits, held, examined = robot.tension, 0, 0
    longest, lacking = np.zeros(robot.joint_count), np.zeros(robot.joint_count, np.int64)
    for n, at in enumerate(theta):
        if n >= LEAST_POSTURES and time.monotonic() - start > BUDGET:
            break
        jacobian = robot.routes.muscle_jacobian(at[None])[0]
        torque = robot.kinematics.holding_torque(at)
        wanted = DESIRED_SHARE * limits.limit
        missing = least_tension(jacobian, torque, limits.bias, limits.limit, wanted).missing_torque
        longest = np.maximum(longest, np.abs(jacobian).max(axis=0))
        examined += 1
        if missing.any():
            lacking[np.abs(missing).argmax()] += 1
        else:
            held += 1
    worst = [int(j) for j in np.argsort(-lacking)[:3] if lacking[j]]
    named = tuple((robot.joints[j], int(lacking[j])) for j in worst)
    idle = longest <= min(LEAST_COUNTED_ARM, COUNTED_ARM_SHARE * float(longest.max()))
    supported = 0
    if held < POINTLESS_SHARE * examined:
        supported = len(supported_postures(robot, theta[:NEAR_POSTURES]))
    return Prospects(robot, held, examined, supported, idle, named, contacts(robot))
