# SPDX-License-Identifier: Apache-2.0
"""Learned route points, except for muscles that the points of the robot directory describe better.

Learned points are fitted to the lengths of the network. The input may be better for some muscles:
if the samples do not determine the course of their lengths over the workspace, for example because
a joint never moved, if the learned arm deviates in ways that route points cannot express, or if a
tendon slips over an object that it wraps around and its length jumps. Such muscles keep their
points.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.design.route_jumps import newly_jumping
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.description import Route, RoutePoint
from musculoskeletal_ae.robot.robot import Robot

POSTURES = 400  # compare routes with the network in this many postures
#: move the points of a muscle only if this changes the course of its length by more than so many
#: times what samples left open (`Mae.length_spread`)
CLEAR = 2.5
#: identifies the place of a route point: its link, and its position there in units of 1e-7 m
Place = tuple[str, tuple[int, ...]]
#: for each movable route point, its muscle and place → name of its site in the user's file
TendonSites = Mapping[tuple[str, Place], str]


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


def place_of(point: RoutePoint) -> Place:
    """Return the link of a route point, and its position there, as a hashable value."""
    return point.link, tuple(np.rint(1e7 * point.xyz).astype(int).tolist())


def learned_routes(
    robot: Robot, body: CalibratedBody, mae: Mae, sites: TendonSites | None = None
) -> LearnedRoutes:
    """Return routes with learned points.

    Args:
        robot: The robot whose points are moved.
        body: The calibrated body that was fitted to the network.
        mae: The network.
        sites: The sites that may be moved; one that several muscles share stays shared. None if all
            points may be moved on their own.
    """
    theta = robot.random_postures(POSTURES, np.random.default_rng([3, 0xE2]))
    before = errors(robot, mae, theta)
    course = robot.routes.absolute_lengths(theta)
    least_change = 0.0 if mae.length_spread is None else CLEAR * mae.length_spread
    is_kept = np.zeros(robot.muscle_count, dtype=bool)
    kept = dict[str, str]()
    while True:
        routes = _moved(robot, body, is_kept, sites)
        moved = robot.with_routes(routes)
        after = errors(moved, mae, theta)
        is_worse = (after.lengths > before.lengths) | (after.arms > before.arms)
        is_moved = np.array([a is not b for a, b in zip(routes, robot.description.routes)])
        jumps = is_moved & newly_jumping(
            moved.routes.absolute_lengths, robot.routes.absolute_lengths, robot
        )
        change = (moved.routes.absolute_lengths(theta) - course).std(axis=0)
        reasons = (
            (is_moved & (change < least_change), 'the samples do not determine how it differs'),
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
    robot: Robot, body: CalibratedBody, is_kept: Bools, sites: TendonSites | None
) -> tuple[Route, ...]:
    """Return the routes with learned points; unchanged routes are those of the description.

    Args:
        robot: The robot whose points are moved.
        body: The fitted body, which has the displacement of each point.
        is_kept: Which muscles keep their points, (M,).
        sites: As in `learned_routes`. Shared sites move by the mean of their displacements. They
            stay if one of their muscles keeps its points.
    """
    site_of, shifts = dict[tuple[int, int], object](), dict[object, list[Array]]()
    for m, route in enumerate(robot.description.routes):
        points = [(i, item) for i, item in enumerate(route) if isinstance(item, RoutePoint)]
        for (i, point), shift in zip(points, body.link_shifts(m), strict=True):
            key = robot.muscles[m], place_of(point)
            site: object = (m, i) if sites is None else sites.get(key)
            if site is not None:
                site_of[m, i] = site
                shifts.setdefault(site, []).append(shift)
    fixed = {site for (m, _), site in site_of.items() if is_kept[m]}
    result = [list(route) for route in robot.description.routes]
    for (m, i), site in site_of.items():
        if site not in fixed:
            result[m][i] = result[m][i]._replace(
                xyz=result[m][i].xyz + np.mean(shifts[site], axis=0)
            )
    moved = {m for (m, _), site in site_of.items() if site not in fixed}
    return tuple(
        tuple(result[m]) if m in moved else route
        for m, route in enumerate(robot.description.routes)
    )
