# SPDX-License-Identifier: Apache-2.0
"""Measure contact estimation and hand guiding, as a part of the experiment `motion`."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.estimation.contact import Contact
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop, columns
from musculoskeletal_ae.experiments.study import Measured, Plot, Rows, Study
from musculoskeletal_ae.motion.explored_postures import TRIES, holdable_postures
from musculoskeletal_ae.robot.robot import Robot

CONTACT_STREAM = 7000
#: push the resting arm twice in this many postures, make this many collisions, and test method
#: `float` this many times
POSTURES, COLLISIONS, FLOATS = 15, 20, 4
#: try each collision at most this many times; a try fails if the arm hardly moves, or if a contact
#: is detected before the push
TRIES_PER_COLLISION = 20
#: let healthy arms explore without contact for this time [s], shared by the individuals; count
#: every detected contact as false
HEALTHY = 3600.0
LEAST, MOST = 10.0, 50.0  # push the hand with forces in this range [N]
LIGHT, FIRM = 15.0, 20.0  # guide the hand in method `float` with forces in this range [N]
MOVE = 4.0  # move to a posture in this time before a push [s]
PUSH = 1.5  # push the resting arm for this time [s]
EVALUATED = 0.5  # average estimates over this time at the end of a push [s]
APART = 3.0  # let the arm explore for at most this time before a collision [s]
WARM_UP = 5.0  # explore for this time before contacts of the healthy arm are counted [s]
FLOATING = 30.0  # measure the drift of the untouched arm in method `float` over this time [s]
MOVED = 1.0  # push the moving arm, or guide the hand, for this time [s]
SOON = 0.1  # report the share of collisions that are detected within this time [s]
INSIDE = 0.1  # keep random postures away from the joint limits by this fraction of the joint ranges


#: stands for the estimate that is missing while length offsets are unknown
NOTHING = Contact(np.zeros(0), lambda: np.zeros(3), math.nan, False)


class ContactLoop(ClosedLoop):
    """A closed loop whose arm is pushed."""

    def contact(self, exploring: bool = False) -> Contact:
        """Simulate until the next message, and return the contact that is estimated from it.

        If `exploring`, the arm explores for this message; otherwise, it continues as before.
        """
        _ = self.explore() if exploring else self.step()
        output = self.estimator.output
        if output is None or output.contact is None:  # a push has led to a finding about lengths
            return NOTHING
        return output.contact

    def contacts_during(self, duration: float, exploring: bool = False) -> list[Contact]:
        """Advance by `duration` [s]; return the contact estimate of each message."""
        return [self.contact(exploring) for _ in range(round(duration / SAMPLE_TIME))]

    def rest(self, theta: Array) -> None:
        """End the push, end a stop that it may have caused, and move to θ [rad] (D,)."""
        self.push(np.zeros(3))
        self.end_finding()
        self.core.reset(self.time)
        self.target(theta)
        self.contacts_during(MOVE)

    def push(self, force: Array) -> None:
        """Apply a force [N] (3,) to the hand until the next call."""
        self.arm.set_wrench(np.concatenate([force, np.zeros(3)]))


def measure(study: Study, seed: int) -> Measured:
    """Push the hand of one individual at rest, in motion and under gravity compensation.

    The loop uses the network that has learned this individual.
    """
    robot, rng = study.robot, np.random.default_rng([seed, CONTACT_STREAM])
    settings = Settings(first_duration=2.0)
    loop = ContactLoop(study.arm(seed), study.network(seed), settings, CONTACT_STREAM + seed)
    tried = []
    for _ in range(study.number(POSTURES)):
        loop.rest(_holdable(robot, rng))
        tried += [_push_at_rest(loop, _force(robot, rng, LEAST, MOST)) for _ in range(2)]
    pushes = [push for push in tried if push is not None]
    if not pushes:
        raise MusculoskeletalError(
            f'each of {len(tried)} pushes of {LEAST:g} to {MOST:g} N on the hand of individual '
            f'{seed} led to a finding, after which no external force is estimated'
        )
    forces, delays = _collisions(loop, rng, study.number(COLLISIONS))
    soon = delays <= SOON + 1e-9
    loop.arm.reset()
    # To the estimator of the other loop, the reset would be a jump of all lengths.
    loop = ContactLoop(loop.arm, study.network(seed), settings, CONTACT_STREAM + seed)
    seconds = study.seconds(HEALTHY / len(study.seeds))
    contacts, seconds = _healthy(loop, seconds, study.seconds(WARM_UP))
    drift, moved = zip(*(_guide_by_hand(study, seed, rng) for _ in range(study.number(FLOATS))))
    true, estimated, free = columns(pushes)
    size, angle = _errors(true, estimated)
    numbers: dict[str, Any] = {
        'wrench_error': float(size.mean()),
        'wrench_error_deg': float(angle.mean()),
        'pushes_free_share': float(free.mean()),
        'pushes_left_out': len(tried) - len(pushes),
        'false_contacts': contacts,
        'healthy_touch_s': seconds,
        'float_drift_rad': float(np.max(drift)),
        'float_moved_m': float(np.mean(moved)),
    }
    if len(forces):
        numbers['collision_s'] = float(np.median(delays))
        numbers['collisions_soon_share'] = float(soon.mean())
    if (firm := forces > 0.5 * (LEAST + MOST)).any():
        numbers['firm_collisions_soon_share'] = float(soon[firm].mean())
    if free.any():
        numbers['wrench_free_error'] = float(size[free].mean())
        numbers['wrench_free_error_deg'] = float(angle[free].mean())
    return Measured(numbers, {'true': true, 'estimated': estimated, 'free': free})


def _errors(true: Array, estimated: Array) -> tuple[Array, Array]:
    """Return the relative errors of N estimated magnitudes, and the direction errors [deg].

    Both results have the shape (N,). `true` and `estimated` are the forces [N], (N, 3).
    """
    sizes, estimated_sizes = np.linalg.norm(true, axis=1), np.linalg.norm(estimated, axis=1)
    cosine = (true * estimated).sum(axis=1) / np.maximum(sizes * estimated_sizes, 1e-9)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.abs(estimated_sizes - sizes) / sizes, angle


def _force(robot: Robot, rng: np.random.Generator, least: float, most: float) -> Array:
    """Return a random force (3,) with a magnitude from `least` to `most` [N].

    The force has no component along those axes of the root link along which no force produces
    joint torques. On a planar arm, the force therefore lies in the plane of the arm.
    """
    postures = robot.random_postures(20, rng)
    jacobians = [robot.kinematics.end_effector_jacobian(theta)[:3] for theta in postures]
    observable = np.abs(np.concatenate(jacobians, axis=1)).max(axis=1) > 1e-6
    direction = rng.normal(size=3) * observable
    force: Array = rng.uniform(least, most) * direction / np.linalg.norm(direction)
    return force


def _holdable(robot: Robot, rng: np.random.Generator) -> Array:
    postures = (robot.random_postures(1, rng, -INSIDE)[0] for _ in range(TRIES))
    ((theta, _),) = holdable_postures(robot, postures, 1)
    return theta


def _push_at_rest(loop: ContactLoop, force: Array) -> tuple[Array, Array, bool] | None:
    """Push the hand of the resting arm.

    Returns:
        The force [N] (3,), its estimate [N] (3,) averaged over the last EVALUATED [s] of the push,
        and whether all joints stayed within their limits. None if the push led to a finding, after
        which no force is estimated.
    """
    robot, estimates, free = loop.arm.robot, list[Array](), True
    loop.push(force)
    is_estimated = True
    for _ in range(round(PUSH / SAMPLE_TIME)):
        contact = loop.contact()
        is_estimated &= contact is not NOTHING
        estimates.append(contact.force())
        theta = loop.arm.theta
        free &= bool(((theta > robot.lower) & (theta < robot.upper)).all())
    loop.push(np.zeros(3))
    loop.contacts_during(MOVED)
    if not is_estimated:
        return None
    evaluated = estimates[-round(EVALUATED / SAMPLE_TIME) :]
    return force, np.mean(evaluated, axis=0), free


def _collisions(loop: ContactLoop, rng: np.random.Generator, count: int) -> Array:
    """Push the moving arm up to `count` times, and measure how soon each push is detected.

    Returns:
        An array (2, N) of the magnitudes of the N forces [N] and their detection delays [s]. A push
        that is not detected has a delay of MOVED, the duration of the push.
    """
    robot, collisions = loop.arm.robot, list[tuple[float, float]]()
    for _ in range(TRIES_PER_COLLISION * count):
        if len(collisions) == count:
            break
        *_, before = loop.contacts_during(rng.uniform(0.5, 1.0) * APART, exploring=True)
        if before.is_contact or np.linalg.norm(loop.arm.velocity) < 0.1:
            continue
        force = _force(robot, rng, LEAST, MOST)
        loop.push(force)
        detected = [each.is_contact for each in loop.contacts_during(MOVED, exploring=True)]
        loop.push(np.zeros(3))
        # The message with index 0 was read before the push, so an index is the delay in messages.
        delay = detected.index(True) * SAMPLE_TIME if any(detected) else MOVED
        collisions.append((float(np.linalg.norm(force)), delay))
    return np.array(collisions).reshape(-1, 2).T


def _healthy(loop: ContactLoop, seconds: float, warm_up: float) -> tuple[int, float]:
    """Let an arm explore without contact; return the number of false contacts, and the time [s].

    The arm explores for `warm_up` [s] first. Contacts are counted in the following `seconds` [s].
    """
    contacts, before, counted = 0, False, 0
    for n in range(round((seconds + warm_up) / SAMPLE_TIME)):
        contact = loop.contact(exploring=True)
        is_counted = contact is not NOTHING and n * SAMPLE_TIME >= warm_up
        now = contact.is_contact and is_counted
        contacts, before, counted = contacts + (now and not before), now, counted + is_counted
    return contacts, counted * SAMPLE_TIME


def _guide_by_hand(study: Study, seed: int, rng: np.random.Generator) -> tuple[float, float]:
    """Measure the drift of the arm under gravity compensation, and push its hand afterwards.

    Returns:
        The largest drift of a joint [rad], and the distance [m] by which the push moves the hand.
    """
    settings, arm = Settings(first_duration=2.0), study.arm(seed)
    loop = ContactLoop(arm, study.network(seed), settings, seed)
    loop.rest(_holdable(study.robot, rng))
    loop.core.configure(replace(settings, method='float'))
    loop.wait(MOVED)
    start, drift = arm.theta, 0.0
    for _ in range(round(study.seconds(FLOATING) / SAMPLE_TIME)):
        loop.step()
        drift = max(drift, float(np.abs(arm.theta - start).max()))
    before = arm.hand.translation.copy()
    loop.push(_force(study.robot, rng, LIGHT, FIRM))
    loop.wait(MOVED)
    loop.check()
    return drift, float(np.linalg.norm(arm.hand.translation - before))


def forces(_: Study, rows: Rows) -> Plot:
    """Plot the magnitudes and direction errors of estimated forces over the true magnitudes."""
    keys = 'true', 'estimated', 'free'
    parts = [[row.traces[key] for key in keys] for row in rows.values()]
    true, estimated, free = map(np.concatenate, zip(*parts))
    sizes, angle = np.linalg.norm(true, axis=1), _errors(true, estimated)[1]
    figure, (left, right) = plots.new_figure(9.0, 3.6, columns=2)
    kinds = (free, plots.AFTER, 'no joint at a stop'), (~free, plots.MARK, 'a joint at its stop')
    for which, colour, name in kinds:
        style = {'color': colour, 's': 12, 'label': name}
        left.scatter(sizes[which], np.linalg.norm(estimated[which], axis=1), **style)
        right.scatter(sizes[which], angle[which], **style)
    left.plot([0.0, MOST], [0.0, MOST], color=plots.TRUE, linewidth=0.8)
    plots.tidy(left, 'force [N]', 'estimated force [N]', 'magnitude', 'above')
    plots.tidy(right, 'force [N]', 'error [deg]', 'direction')
    return figure, (
        f'Estimates of {len(sizes)} external forces on the hand of the resting arm, one second '
        'after the force began.'
    )
