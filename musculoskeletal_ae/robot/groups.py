# SPDX-License-Identifier: Apache-2.0
"""Groups of joints and muscles, such as the limbs of a body, derived from the muscle routes.

`groups` finds independent groups, such as two arms. `parts` divides a large group further: the
fingers of a hand depend on the wrist, but not on each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Bools, Ints


class Group(NamedTuple):
    """Joints and the muscles that cross them, such as a limb; no muscle crosses two groups."""

    joints: tuple[int, ...]  # indices of the joints in θ
    muscles: tuple[int, ...]  # indices of the muscles in T and l

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


def union(of: Sequence[Group]) -> Group:
    """Return the joints and muscles of several groups, one group after the other."""
    joints, muscles = zip(*of, strict=True)
    return Group(sum(joints, ()), sum(muscles, ()))


def groups(crossed: Bools) -> tuple[Group, ...]:
    """Divide the joints and muscles of a body into independent groups.

    A group is a connected component of the graph in which a muscle links the joints that it
    crosses.

    A muscle that crosses no joint is assigned to the first joint. A joint without muscles is
    assigned to the first group.

    Args:
        crossed: Whether each muscle crosses each joint, (M, D).
    """
    of_joint = _components(crossed)
    of_muscle = of_joint[crossed.argmax(axis=1)]
    of_joint[~np.isin(of_joint, of_muscle)] = of_muscle[0]
    return tuple(
        Group(*(tuple(np.flatnonzero(of == g).tolist()) for of in (of_joint, of_muscle)))
        for g in np.unique(of_muscle)
    )


def parts(crossed: Bools, group: Group) -> tuple[Group, ...]:
    """Divide a group into a shared part and parts that depend on it, but not on each other.

    The shared part has as few as possible of the joints that most muscles cross, such as the wrist
    of a hand. No other part may have more than half of the joints. The muscles of the shared part
    cross none of the other joints.

    Args:
        crossed: Whether each muscle of the body crosses each joint, (M, D).
        group: One of `groups`.

    Returns:
        The shared part and the other parts, or the whole group if it cannot be divided like this.
    """
    joints, muscles = np.array(group.joints), np.array(group.muscles)
    own = crossed[np.ix_(muscles, joints)]
    by_count = np.argsort(-own.sum(axis=0), kind='stable')
    for count in range(1, len(joints) - 1):
        is_shared = np.isin(np.arange(len(joints)), by_count[:count])
        others = own & ~is_shared
        of_joint = np.where(is_shared, -1, _components(others))
        of_muscle = np.where(others.any(axis=1), of_joint[others.argmax(axis=1)], -1)
        names = np.unique(of_joint)
        sizes = [(of_joint == name).sum() for name in names[1:]]
        if len(sizes) > 1 and 2 * max(sizes) <= len(joints):
            if not np.isin(names, of_muscle).all():
                break
            return tuple(
                Group(
                    tuple(joints[of_joint == name].tolist()),
                    tuple(muscles[of_muscle == name].tolist()),
                )
                for name in names
            )
    return (group,)


def _components(crossed: Bools) -> Ints:
    """Return the group of each joint, (D,): the lowest index of a joint in it.

    Joints that a muscle crosses together are in one group.

    `crossed` (M, D) says which joints each muscle crosses.
    """
    of_joint = np.arange(crossed.shape[1])
    for own in crossed[crossed.any(axis=1)]:
        of_joint[np.isin(of_joint, of_joint[own])] = of_joint[own].min()
    return of_joint
