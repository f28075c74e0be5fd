# SPDX-License-Identifier: Apache-2.0
"""Learned route points, except for muscles that the points of the robot directory describe better.

Learned points are fitted to the lengths of the network. A muscle keeps its original points

- if there are too few samples to tell how its length differs, for example because a joint never
  moved,
- if the arm differs in ways that route points cannot express, so that learned points are not closer
  to the network,
- or if its length would jump in some posture, because its tendon slips over an object there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.design.route_jumps import newly_jumping
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.description import Route, RoutePoint
from musculoskeletal_ae.robot.robot import Robot

POSTURES = 400  # compare routes with the network in this many postures
#: keep the points of a muscle unless its length changes by more than this multiple of what the
#: samples leave open (`Mae.length_spread`)
CLEAR = 2.5
#: what moves as one: a site of the user's file, by its name, or route point k of muscle m, (m, k)
Site = str | tuple[int, int]


class Errors(NamedTuple):
    """How far routes differ from a network, for each muscle (M,)."""

    lengths: Array  # standard deviation of the length error in random postures [m]
    #: error of the moment arms: norm over the joints, root mean square over the postures [m]
    arms: Array


class LearnedRoutes(NamedTuple):
    """Routes with learned points, and the muscles that keep their original points."""

    routes: tuple[Route, ...]
    kept: dict[str, str]  # reason why a muscle keeps its points, by muscle
    before: Errors
    after: Errors


def learned_routes(
    robot: Robot,
    body: CalibratedBody,
    mae: Mae,
    sites: Sequence[Sequence[Site | None]] | None = None,
) -> LearnedRoutes:
    """Return routes with learned points.

    Args:
        robot: The robot whose points are moved.
        body: The calibrated body that was fitted to the network.
        mae: The network.
        sites: For each muscle, the sites of its route points, and None where a point cannot be
            moved. A site that several muscles share stays shared. None if all points may be moved
            on their own.
    """
    if sites is None:
        counts = [len(body.link_shifts(m)) for m in range(robot.muscle_count)]
        sites = [[(m, k) for k in range(count)] for m, count in enumerate(counts)]
    theta = robot.random_postures(POSTURES, np.random.default_rng([3, 0xE2]))
    before = errors(robot, mae, theta)
    kept, is_kept = dict[str, str](), np.zeros(robot.muscle_count, dtype=bool)
    if mae.length_spread is not None:
        learned = robot.with_routes(_moved(robot, body, is_kept, sites)).routes
        change = learned.absolute_lengths(theta) - robot.routes.absolute_lengths(theta)
        is_kept = change.std(axis=0) < CLEAR * mae.length_spread
        kept = {
            robot.muscles[m]: 'too few samples to tell how it differs'
            for m in np.flatnonzero(is_kept).tolist()
        }
    while True:
        routes = _moved(robot, body, is_kept, sites)
        moved = robot.with_routes(routes)
        after = errors(moved, mae, theta)
        is_worse = (after.lengths > before.lengths) | (after.arms > before.arms)
        is_moved = np.array([a is not b for a, b in zip(routes, robot.description.routes)])
        jumps = is_moved & newly_jumping(
            moved.routes.absolute_lengths, robot.routes.absolute_lengths, robot
        )
        reasons = (
            (jumps, 'its length would jump'),
            (is_worse & is_moved, 'learned points are not closer to the network'),
        )
        found = False
        for mask, reason in reasons:
            for m in np.flatnonzero(mask & ~is_kept).tolist():
                kept.setdefault(robot.muscles[m], reason)
                found, is_kept[m] = True, True
        if not found:
            break
    for name, own, first in zip(robot.muscles, routes, robot.description.routes, strict=True):
        if own is first:
            kept.setdefault(name, 'its points cannot be moved')
    return LearnedRoutes(routes, kept, before, after)


def errors(robot: Robot, mae: Mae, theta: Array) -> Errors:
    """Return how far the routes of a robot differ from a network at θ (N, D)."""
    middle = 0.5 * (robot.tension.bias + robot.tension.limit)
    tension = np.broadcast_to(middle, (len(theta), robot.muscle_count))
    off = robot.routes.absolute_lengths(theta) - mae.lengths(theta, tension)
    arms = robot.routes.muscle_jacobian(theta) - mae.muscle_jacobian(theta, tension)
    return Errors(off.std(axis=0), np.sqrt((arms**2).sum(axis=2).mean(axis=0)))


def _moved(
    robot: Robot, body: CalibratedBody, is_kept: Bools, sites: Sequence[Sequence[Site | None]]
) -> tuple[Route, ...]:
    """Return the routes with learned points; unchanged routes are those of the description.

    Args:
        robot: The robot whose points are moved.
        body: The fitted body, which has the displacement of each point.
        is_kept: Which muscles keep their points, (M,).
        sites: As in `learned_routes`. Shared sites move by the mean of their displacements. They
            stay if one of their muscles keeps its points.
    """
    shifts, fixed = dict[Site, list[Array]](), set[Site]()
    for m, own in enumerate(sites):
        for site, shift in zip(own, body.link_shifts(m), strict=True):
            if site is not None:
                shifts.setdefault(site, []).append(shift)
                if is_kept[m]:
                    fixed.add(site)
    steps = {site: np.mean(each, axis=0) for site, each in shifts.items() if site not in fixed}
    routes = list[Route]()
    for own, route in zip(sites, robot.description.routes, strict=True):
        left, items = iter(own), list(route)
        for i, item in enumerate(route):
            if isinstance(item, RoutePoint) and (site := next(left)) in steps:
                items[i] = item._replace(xyz=item.xyz + steps[site])
        routes.append(tuple(items) if not steps.keys().isdisjoint(own) else route)
    return tuple(routes)
