# SPDX-License-Identifier: Apache-2.0
"""What a user may choose about control: one table for the core and the node's parameters."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.parameters import PRESET, settable

UNREACHABLE = ('refuse', 'nearest')
METHODS = ('geometric', 'first', 'second', 'proposed', 'tension', 'stiffness', 'float')
BY_TENSION = ('tension', 'float')  # which command tensions, the others lengths
MOST_STIFFNESS = 1000.0  # [N·m/rad] that may be desired of a joint


@dataclass(frozen=True)
class Settings:
    """Settings of control; `Controller.configure` takes changed ones."""

    method: str = settable('proposed', 'how a target posture becomes a command', legal=METHODS)
    preset: str = replace(PRESET, settable=True).field()
    joint_stiffness: tuple[float, ...] = settable(
        (0.0,),
        f'desired diagonal of the joint stiffness, one for each joint, at most {MOST_STIFFNESS:g} '
        'where it turns (0 or []: as it comes)',
        'N·m/rad or N/m',
        0.0,
        MOST_STIFFNESS / 0.06**2,  # where it slides: RACK, which --help is not to load
    )
    first_duration: float = settable(5.0, 'movement duration', 's', 0.1, 60.0)
    second_duration: float = settable(
        2.0, 'duration of the second movement of `second`, and after a checkpoint', 's', 0.1, 60.0
    )
    target_duration: float = settable(
        1.2,
        'movement to a target under `proposed` and `stiffness`, longer where winches need it '
        '(0: first_duration)',
        's',
        0.0,
        60.0,
    )
    constant_tension: float = settable(
        0.0, 'T_const of `first`, kept within [T_bias, T_limit]', 'N', 0.0, 1000.0
    )
    rate_limit: float = settable(
        0.1, 'fastest change of a length command (of a tension: times K_stiff)', 'm/s', 0.001, 1.0
    )
    position_gain: float = settable(
        10.0,
        'torque towards the target, method `tension` (0: torque only; over 0.06² where it slides)',
        'N·m/rad',
        0.0,
        200.0,
    )
    velocity_gain: float = settable(
        0.5,
        'damping torque, method `tension` (0: none; over 0.06² where it slides)',
        'N·m·s/rad',
        0.0,
        20.0,
    )
    feedback_gain: float = settable(
        0.5, 'correction of `proposed` at rest: error, needless tension (0: none)', '1/s', 0.0, 2.0
    )
    hand_speed: float = settable(
        0.25, 'fastest of the hand on its way to a single target_pose', 'm/s', 0.01, 2.0
    )
    unreachable: str = settable(
        'refuse',
        'what is done with a target_pose out of reach, or a target out of that of the muscles left',
        legal=UNREACHABLE,
    )
    max_age: float = settable(
        0.2, 'older muscle_states or estimated_joint_states stop the arm', 's', 0.01, 10.0
    )
    hold_time: float = settable(
        0.5, 'how long a stop holds the last command; data back by then resumes', 's', 0.0, 60.0
    )
    temperature_limit: float = settable(
        85.0,
        'highest of a winding, by which muscles are limited; 20 °C more stop the arm',
        '°C',
        40.0,
        200.0,
    )

    def desired_stiffness(self, radian: Iterable[float]) -> tuple[float, ...]:
        """Return `joint_stiffness`, one for each joint; nothing, or one 0, is all as they come.

        `radian` is what counts as one of each joint, as in `Kinematics` [rad or m].
        """
        values, most = self.joint_stiffness, [MOST_STIFFNESS / each**2 for each in radian]
        if values in ((), (0.0,)):
            return (0.0,) * len(most)
        if len(values) != len(most) or not all(0.0 <= v <= high for v, high in zip(values, most)):
            ends = ', '.join(f'{high:g}' for high in most)
            legal = f'{len(most)} numbers of at least 0, at most {ends}'
            raise MusculoskeletalError(f'{list(values)}; legal: {legal} [N·m/rad or N/m], or []')
        return values
