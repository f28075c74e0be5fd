# SPDX-License-Identifier: Apache-2.0
"""Refuse a version of MuJoCo that this package does not work with."""

import re

import mujoco

from musculoskeletal_ae.exceptions import MusculoskeletalError

#: First version that works, and first one that no longer does. MuJoCo 3.9 lacks what the emulator
#: uses. MuJoCo 4.0 routes a tendon another way where its side site lies on the axis of a cylinder.
#: The same range is in setup.cfg.
RANGE = (3, 10), (4,)


def check_mujoco(version: str = mujoco.__version__) -> None:
    """Raise a MusculoskeletalError if the installed MuJoCo is outside the range."""
    first, end = RANGE
    numbers = tuple(map(int, re.findall(r'\d+', version)[:3]))
    if not first <= numbers < end:
        legal = f'>={".".join(map(str, first))},<{".".join(map(str, end))}'
        raise MusculoskeletalError(
            f'mujoco {version} is installed; legal: {legal}; run: pip install "mujoco{legal}"'
        )
