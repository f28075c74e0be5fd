# SPDX-License-Identifier: Apache-2.0
"""Which body plays reality; the one place where nodes and experiments get their arms from."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot

KIN, FOREIGN = 'kin', 'foreign'


def make_arm(
    robot: Robot,
    seed: int = 0,
    reality: str = KIN,
    friction: bool = True,
    deviates: bool = False,
) -> Arm:
    """Return an individual at rest, or the same body without friction in wires and joints.

    Realities are 'kin', the first body, which differs from its model in what the learner fits;
    'foreign', the second one, whose mechanics are foreign too; or a user's MJCF file, whose joints
    and tendons have the names of the robot's joints and muscles. A file is played as it is, or, if
    the individual deviates, as its seed draws it (`emulator/deviation.py`).

    Raises:
        MusculoskeletalError: If there is no such reality, or the robot's names are not in the file.
    """
    if reality == KIN:
        individual = Individual(robot, seed)
        if not friction:
            individual.cable_friction[:] = 0.0
            individual.joint_friction[:] = 0.0
        return EmulatedArm(robot, seed, individual)
    file = None
    if reality != FOREIGN:
        with suppress(RuntimeError, OSError):  # no such home, a name too long
            file = path if (path := Path(reality).expanduser()).is_file() else None
        if file is None:
            legal = f'{KIN}, {FOREIGN} or an MJCF file'
            raise MusculoskeletalError(f'reality {reality[:80]!r} is no such file; legal: {legal}')
    # Only here, so that the first body does not wait for MuJoCo.
    from musculoskeletal_ae.emulator.effects import Effects
    from musculoskeletal_ae.emulator.foreign import ForeignArm

    effects = Effects()
    if not friction:
        effects = replace(effects, guide_friction=0.0, joint_friction=0.0)
    return ForeignArm(robot, seed, effects, file, deviates)
