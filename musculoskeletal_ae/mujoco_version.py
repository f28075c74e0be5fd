# SPDX-License-Identifier: Apache-2.0
"""Check that the installed version of MuJoCo is supported."""

import re

import mujoco

from musculoskeletal_ae.exceptions import MusculoskeletalError

#: First supported version, and the first later version that is not; setup.cfg has the same range.
#: MuJoCo 3.9 lacks functions that the emulator uses. MuJoCo 4.0 routes a tendon differently if its
#: side site lies on the axis of a cylinder.
RANGE = (3, 10), (4,)


def check_mujoco(version: str = mujoco.__version__) -> None:
    """Check a version of MuJoCo; raise a MusculoskeletalError if it is not supported."""
    first, end = RANGE
    numbers = tuple(map(int, re.findall(r'\d+', version)[:3]))
    if not first <= numbers < end:
        legal = f'>={".".join(map(str, first))},<{".".join(map(str, end))}'
        raise MusculoskeletalError(
            f'mujoco {version} is installed; legal: {legal}; run: pip install "mujoco{legal}"'
        )
