# SPDX-License-Identifier: Apache-2.0
"""Contacts of an imported body that keep its joints from parts of their range.

MuJoCo computes which bodies overlap in random postures. The model is the `model.xml` beside the
robot directory, whose contacts are those of the user's file.
"""

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot

MODEL = 'model.xml'  # the file that `import_robot` writes into the robot directory
POSTURES = 150  # examine this many random postures
DEEP = 1e-3  # count bodies as touching if they overlap by more than this [m]
PARTS = 10  # divide the range of a joint into this many equal parts
#: count a part of a joint's range as blocked if fewer of the postures in it are free of contact
FREE_SHARE = 0.1
#: count a joint as not movable if its longest free part is smaller than this share of its range
MOVABLE_SHARE = 0.5
NAMED = 3  # name at most this many pairs of bodies, and describe at most this many joints


class Blocked(NamedTuple):
    """A joint that contacts keep from a part of its range."""

    joint: int
    low: float  # lower end of the longest part without contact [rad]
    high: float  # upper end of it [rad]; equals `low` if bodies touch everywhere
    pairs: tuple[str, ...]  # the bodies that touch, such as 'palm and nail', most frequent first
    share: float  # the longest part without contact, relative to the range

    @property
    def is_movable(self) -> bool:
        """Whether the joint counts as movable."""
        return self.share >= MOVABLE_SHARE


class Contacts(NamedTuple):
    """Contacts in random postures."""

    postures: int
    touching: int  # number of postures in which bodies touch
    pairs: tuple[tuple[str, int], ...]  # pairs of bodies, and in how many postures they touch
    blocked: tuple[Blocked, ...]
    problem: str = ''  # why the contacts could not be examined; empty if they were

    def lines(self, robot: Robot) -> list[str]:
        """Return the contacts as lines of text for users; none if nothing is prevented."""
        if self.problem:
            return [f'warning: contacts were not examined: {self.problem}']
        lines = list[str]()
        # The most restricted joints come first; of the others, only the names follow.
        ordered = sorted(self.blocked, key=lambda each: each.share)
        for each in ordered[:NAMED]:
            name, units = robot.joints[each.joint], robot.units[each.joint]
            whole = units.range_text(robot.lower[each.joint], robot.upper[each.joint])
            free = f'only from {units.range_text(each.low, each.high)}'
            reach = free if each.high > each.low else 'nowhere'
            touching = ', '.join(each.pairs)
            ending = '' if each.is_movable else '; it counts as not movable'
            problem = f'joint {name} (range {whole}) can move without contact {reach}'
            remedy = 'hold the joint (leave it out of --joints), or exclude the contact in the file'
            lines.append(
                f'warning: contacts: {problem}; elsewhere, these bodies touch in nearly every '
                f'random posture: {touching}{ending}; {remedy} (contact/exclude)'
            )
        if others := ', '.join(robot.joints[each.joint] for each in ordered[NAMED:]):
            lines.append(f'warning: contacts: they also restrict {others}')
        if not self.blocked and self.touching > 0.5 * self.postures:
            pairs = ', '.join(f'{pair} ({count})' for pair, count in self.pairs[:NAMED])
            counts = f'bodies touch in {self.touching} of {self.postures} random postures'
            lines.append(f'warning: contacts: {counts}, most often {pairs}')
        return lines


def contacts(robot: Robot) -> Contacts | None:
    """Examine the contacts in random postures; return None for a robot that was not imported."""
    file = Path(robot.description.directory) / MODEL
    if not file.is_file():
        return None
    # Imported here because only imported robots need MuJoCo.
    from musculoskeletal_ae.emulator.foreign.mujoco_model import from_file

    try:
        model = from_file(robot, file)
    except MusculoskeletalError as error:  # for example because robot.urdf was edited
        return Contacts(0, 0, (), (), str(error))
    theta = robot.random_postures(POSTURES, np.random.default_rng(0))
    tree = robot.kinematics.tree
    of_joint = np.array([model.joint(name).qposadr[0] for name in robot.kinematics.model.names[1:]])
    movers = _movers(robot, model)
    touched = [_touching(model, of_joint, q) for q in tree.angles(theta)]
    #: whether a joint moves two bodies that touch against each other, (N, D)
    hindered = np.zeros(theta.shape, dtype=bool)
    hindering = [Counter[str]() for _ in robot.joints]
    count = Counter[str]()
    for n, pairs in enumerate(touched):
        for first, second in pairs:
            pair = f'{model.body(first).name} and {model.body(second).name}'
            count[pair] += 1
            moving = movers[first] ^ movers[second]
            hindered[n] |= moving
            for j in np.flatnonzero(moving).tolist():
                hindering[j][pair] += 1
    blocked = list[Blocked]()
    for j in range(robot.joint_count):
        found = _free_range(theta[:, j], hindered[:, j], robot.lower[j], robot.upper[j])
        if found is not None:
            share = (found[1] - found[0]) / (robot.upper[j] - robot.lower[j])
            named = tuple(pair for pair, _ in hindering[j].most_common(NAMED))
            blocked.append(Blocked(j, *found, named, float(share)))
    touching = sum(bool(pairs) for pairs in touched)
    return Contacts(len(theta), touching, tuple(count.most_common()), tuple(blocked))


def movable_joints(robot: Robot) -> Bools:
    """Return which joints contacts allow to move over at least half of their range, (D,)."""
    movable, found = np.ones(robot.joint_count, dtype=bool), contacts(robot)
    for each in found.blocked if found else ():
        movable[each.joint] = each.is_movable
    return movable


def _movers(robot: Robot, model: Any) -> Bools:
    """Return which joints of θ move each body, (bodies, D)."""
    tree = robot.kinematics.tree
    names = list(robot.kinematics.model.names)
    movers = np.zeros((model.nbody, robot.joint_count), dtype=bool)
    for body in range(1, model.nbody):
        movers[body] = movers[model.body_parentid[body]]
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            movers[body, tree.theta_index[names.index(model.joint(joint).name)]] = True
    return movers


def _touching(model: Any, of_joint: Array, q: Array) -> set[tuple[int, int]]:
    """Return the pairs of bodies that overlap at the joint positions q, (J−1,)."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[of_joint] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    contact = data.contact
    bodies = np.sort(model.geom_bodyid[contact.geom], axis=1)[contact.dist < -DEEP]
    return {(int(first), int(second)) for first, second in bodies}


def _free_range(
    theta: Array, hindered: Bools, lower: float, upper: float
) -> tuple[float, float] | None:
    """Return the ends of the longest part of a joint's range without contact, or None if all is.

    Args:
        theta: Angles of the joint in N postures [rad], (N,).
        hindered: Whether bodies that the joint moves touch in each of them, (N,).
        lower: Lower limit [rad].
        upper: Upper limit [rad].
    """
    part = np.clip((PARTS * (theta - lower) / (upper - lower)).astype(int), 0, PARTS - 1)
    count = np.bincount(part, minlength=PARTS)
    free = np.bincount(part, ~hindered, minlength=PARTS)
    is_free = (free >= FREE_SHARE * count) | (count == 0)
    if is_free.all():
        return None
    best = first = length = 0
    for k, good in enumerate(is_free.tolist()):
        run = k + 1 - first if good else 0
        first = first if good else k + 1
        if run > length:
            best, length = first, run
    ends = lower + (upper - lower) * np.array([best, best + length]) / PARTS
    return float(ends[0]), float(ends[1])
