# SPDX-License-Identifier: Apache-2.0
"""Groups of joints and muscles, such as the limbs of a body, derived from the muscle routes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Bools, Ints


class Group(NamedTuple):
    """Joints and the muscles that cross them, such as a limb; no muscle crosses two groups."""

    joints: tuple[int, ...]  # indices in θ
    muscles: tuple[int, ...]  # indices in T and l

    @classmethod
    def whole(cls, joints: int, muscles: int) -> Group:
        """Return the group of all D joints and M muscles of a body."""
        return cls(tuple(range(joints)), tuple(range(muscles)))

    def columns(self, joints: int, muscles: int) -> Ints:
        """Return the indices of the group's entries in the vector (θ, T, l) of the whole body.

        Args:
            joints: Number of joints of the whole body.
            muscles: Number of muscles of the whole body.
        """
        own = joints + np.array(self.muscles)
        return np.concatenate([self.joints, own, muscles + own])


def groups(crossed: Bools) -> tuple[Group, ...]:
    """Divide the joints and muscles of a body into independent groups.

    A group is a connected component of the graph in which a muscle links the joints that it
    crosses.

    A muscle that crosses no joint is assigned to the first joint. A joint without muscles is
    assigned to the first group.

    Args:
        crossed: Whether each muscle crosses each joint, (M, D).
    """
    of_joint = np.arange(crossed.shape[1])
    for own in crossed[crossed.any(axis=1)]:
        of_joint[np.isin(of_joint, of_joint[own])] = of_joint[own].min()
    of_muscle = of_joint[crossed.argmax(axis=1)]
    of_joint[~np.isin(of_joint, of_muscle)] = of_muscle[0]
    return tuple(
        Group(*(tuple(np.flatnonzero(of == g).tolist()) for of in (of_joint, of_muscle)))
        for g in np.unique(of_muscle)
    )
