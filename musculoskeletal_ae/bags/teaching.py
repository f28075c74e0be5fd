# SPDX-License-Identifier: Apache-2.0
"""What a hand showed an arm, as a trajectory that the arm can follow: smoothed, evenly spaced."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError, MessageError
from musculoskeletal_ae.validity import read_joints

SHOWN = 'estimated_joint_states'
SMOOTHING = 0.15  # [s] standard deviation: a hand is slower, noise of the estimate is faster
SPACING = 0.1  # [s] between points
LEAD = 3.0  # [s] to go to where it was begun
LEAST = 0.5  # [s]


class Shown(NamedTuple):
    """N points of a trajectory."""

    joints: tuple[str, ...]
    time: Array  # from the start of the motion that leads there [s], (N,)
    theta: Array  # [rad], (N, D)
    velocity: Array  # [rad/s], at rest at both ends, (N, D)


def shown(bag: Bag, topic: str, start: int, stop: int) -> Shown:
    """Return the motion on a recorded topic of JointState, from start to stop [ns, recorded].

    A BagError says that there is none.
    """
    joints, times, rows = tuple[str, ...](), list[float](), list[Array]()
    for message in bag.messages([topic], start, stop):
        said = bag.decode(message)
        joints = joints or tuple(said.name)
        try:
            values = read_joints(said, joints, foreign_allowed=False)
            rows.append(np.array([values[name][0] for name in joints]))
        except (MessageError, KeyError):
            continue  # as a node would
        times.append((message.log_time - start) / 1e9)
    if not times or times[-1] - times[0] < LEAST:
        problem = f'{topic} holds no motion of at least {LEAST:g} s'
        raise BagError(bag.path, problem, 'record it while the arm is shown one')
    seen, theta = np.array(times), np.array(rows)
    time = np.linspace(seen[0], seen[-1], max(2, round((seen[-1] - seen[0]) / SPACING)) + 1)
    weight = np.exp(-0.5 * ((time[:, None] - seen) / SMOOTHING) ** 2)
    smooth = weight @ theta / weight.sum(axis=1, keepdims=True)
    velocity = np.gradient(smooth, time, axis=0)
    velocity[[0, -1]] = 0.0
    return Shown(joints, LEAD + time - time[0], smooth, velocity)
