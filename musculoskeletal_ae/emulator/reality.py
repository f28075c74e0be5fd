# SPDX-License-Identifier: Apache-2.0
"""Selection of the emulator model; nodes and experiments create their arms here."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import Individual
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
    """Make an emulated arm, at rest.

    Args:
        robot: The robot to emulate.
        seed: Selects the emulated individual, and seeds its noise.
        reality: The emulator model. The body of 'kin' differs from the geometric model only in ways
            that the learner can fit; 'foreign' has mechanics that the learner does not model.
            Any other value is the path of the `model.xml` that `import_robot` wrote beside the
            robot.
        friction: False removes the friction of tendons and joints. It has no effect on the body of
            an MJCF file.
        deviates: Whether the body of a file is an individual that differs from the file
            (`emulator/foreign/deviation.py`). By default it equals the file.

    Raises:
        MusculoskeletalError: If `reality` is neither an emulator model nor a file, or if the model
            of the arm cannot be built, for example because the file is not that of the robot.
    """
    if reality == KIN:
        individual = Individual(robot, seed)
        if not friction:
            individual.tendon_friction[:] = 0.0
            individual.joint_friction[:] = 0.0
        return EmulatedArm(robot, seed, individual)
    file = None
    if reality != FOREIGN:
        with suppress(RuntimeError, OSError):  # home directory unknown, or name too long
            file = path if (path := Path(reality).expanduser()).is_file() else None
        if file is None:
            legal = f'{KIN}, {FOREIGN} or the model.xml that import_robot writes'
            raise MusculoskeletalError(f'reality {reality[:80]!r} is unknown; legal: {legal}')
    # Import MuJoCo only here, because `kin` does not need it.
    from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
    from musculoskeletal_ae.emulator.foreign.effects import Effects

    effects = Effects()
    if not friction:
        effects = replace(effects, guide_friction=0.0, joint_friction=0.0)
    return ForeignArm(robot, seed, effects, file, deviates)
