# SPDX-License-Identifier: Apache-2.0
"""Touch, a part of the experiment `motion`: pushes that are felt, and an arm that a hand moves."""

from dataclasses import replace
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.exploration import TRIES, holdable_postures
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.estimation.contact import Contact, ContactEstimator
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop, columns
from musculoskeletal_ae.experiments.study import Measured, Plot, Rows, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import FrictionDirection

TOUCH_STREAM = 7000
POSTURES, COLLISIONS, FLOATS = 15, 20, 4
TRIED = 20  # moments for each collision, at most: it hits an arm that moves
HEALTHY = 3600.0  # [s] over all individuals
LEAST, MOST = 10.0, 50.0  # [N]
LIGHT, FIRM = 15.0, 20.0  # [N] of a hand that moves a floating arm
MOVE, PUSH, JUDGED, APART = 4.0, 1.5, 0.5, 3.0  # [s]
FLOATING, MOVED = 30.0, 1.0  # [s]
SOON = 0.1  # [s] in which a collision is to be noticed
INSIDE = 0.1  # share of the joint ranges that postures stay inside of the limits


class FeelingLoop(ClosedLoop):
    """A closed loop that is asked what pushes the arm."""

    def __init__(self, arm: Arm, mae: Mae, settings: Settings, seed: int) -> None:
        self._contact, self._sliding = ContactEstimator(arm.robot), FrictionDirection()
        super().__init__(arm, mae, settings, seed)

    def use(self, mae: Mae) -> None:
        """Estimate, control and feel by another network."""
        super().use(mae)
        self._contact.use(mae)

    def feel(self, exploring: bool = False) -> Contact:
        """Let a message's time pass; return what it says of the outside."""
        _ = self.explore() if exploring else self.step()
        length, friction = self._read.length, self.mae.friction
        end = self._sliding.end_tension(friction, self._read.tension, length)
        return self._contact.step(self.mae.estimate(end, length).theta, end, SAMPLE_TIME)

    def feel_during(self, duration: float, exploring: bool = False) -> list[Contact]:
        """Let time pass [s]; return what each message says."""
        return [self.feel(exploring) for _ in range(round(duration / SAMPLE_TIME))]

    def rest(self, theta: Array) -> None:
        """Go to θ [rad] (D,), with a reset if a push stopped the arm before."""
        self.push(np.zeros(3))
        self.core.reset(self._now)
        self.target(theta)
        self.feel_during(MOVE)

    def push(self, force: Array) -> None:
        """Push the hand by a force [N] (3,)."""
        self.arm.set_wrench(np.concatenate([force, np.zeros(3)]))


def measure(study: Study, seed: int) -> Measured:
    """Push an individual that has learned, at rest, in motion and afloat."""
    robot, rng = study.robot, np.random.default_rng([seed, TOUCH_STREAM])
    settings, share = Settings(first_duration=2.0), 0.005 if study.quick else 1.0
    loop = FeelingLoop(study.arm(seed), study.network(seed), settings, TOUCH_STREAM + seed)

    def count(whole: float) -> int:
        return max(1, round(share * whole))

    pushes = []
    for _ in range(count(POSTURES)):
        loop.rest(_holdable(robot, rng))
        pushes += [_pushed(loop, _force(robot, rng, LEAST, MOST)) for _ in range(2)]
    hits, delays = _collisions(loop, rng, count(COLLISIONS))
    soon = delays <= SOON + 1e-9
    loop.arm.reset()
    seconds = share * HEALTHY / len(study.seeds)
    contacts = _healthy(loop, seconds)
    drift, moved = zip(*(_afloat(study, seed, rng) for _ in range(count(FLOATS))))
    true, felt, free = columns(pushes)
    size, angle = _errors(true, felt)
    numbers: dict[str, Any] = {
        'wrench_error': float(size.mean()),
        'wrench_error_deg': float(angle.mean()),
        'pushes_free_share': float(free.mean()),
        'false_contacts': contacts,
        'healthy_touch_s': seconds,
        'float_drift_rad': float(np.max(drift)),
        'float_moved_m': float(np.mean(moved)),
    }
    if len(hits):
        numbers['collision_s'] = float(np.median(delays))
        numbers['collisions_soon_share'] = float(soon.mean())
    if (firm := hits > 0.5 * (LEAST + MOST)).any():
        numbers['firm_collisions_soon_share'] = float(soon[firm].mean())
    if free.any():
        numbers['wrench_free_error'] = float(size[free].mean())
        numbers['wrench_free_error_deg'] = float(angle[free].mean())
    return Measured(numbers, {'true': true, 'felt': felt, 'free': free})


def _errors(true: Array, felt: Array) -> tuple[Array, Array]:
    """Return relative errors in size and those in direction [deg] of forces (N, 3)."""
    sizes, felt_sizes = np.linalg.norm(true, axis=1), np.linalg.norm(felt, axis=1)
    cosine = (true * felt).sum(axis=1) / np.maximum(sizes * felt_sizes, 1e-9)
    return np.abs(felt_sizes - sizes) / sizes, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _force(robot: Robot, rng: np.random.Generator, least: float, most: float) -> Array:
    """Draw a force [N] (3,) that the joints can feel somewhere: in the plane of a planar arm."""
    postures = robot.random_postures(20, rng)
    jacobians = [robot.kinematics.end_effector_jacobian(theta)[:3] for theta in postures]
    felt = np.abs(np.concatenate(jacobians, axis=1)).max(axis=1) > 1e-6
    direction = rng.normal(size=3) * felt
    force: Array = rng.uniform(least, most) * direction / np.linalg.norm(direction)
    return force


def _holdable(robot: Robot, rng: np.random.Generator) -> Array:
    postures = (robot.random_postures(1, rng, -INSIDE)[0] for _ in range(TRIES))
    ((theta, _),) = holdable_postures(robot, postures, 1)
    return theta


def _pushed(loop: FeelingLoop, force: Array) -> tuple[Array, Array, bool]:
    """Push the resting hand; return the force, the felt one [N], and if no joint met its stop."""
    robot, felt, free = loop.arm.robot, list[Array](), True
    loop.push(force)
    for _ in range(round(PUSH / SAMPLE_TIME)):
        felt.append(loop.feel().force())
        theta = loop.arm.theta
        free &= bool(((theta > robot.lower) & (theta < robot.upper)).all())
    loop.push(np.zeros(3))
    loop.feel_during(MOVED)
    return force, np.mean(felt[-round(JUDGED / SAMPLE_TIME) :], axis=0), free


def _collisions(loop: FeelingLoop, rng: np.random.Generator, count: int) -> Array:
    """Return sizes of pushes of the moving arm [N], and how long until they are noticed [s]."""
    robot, found = loop.arm.robot, list[tuple[float, float]]()
    for _ in range(TRIED * count):
        if len(found) == count:
            break
        *_, before = loop.feel_during(rng.uniform(0.5, 1.0) * APART, exploring=True)
        if before.is_contact or np.linalg.norm(loop.arm.velocity) < 0.1:
            continue
        force = _force(robot, rng, LEAST, MOST)
        loop.push(force)
        noticed = [felt.is_contact for felt in loop.feel_during(MOVED, exploring=True)]
        loop.push(np.zeros(3))
        delay = (noticed.index(True) + 1) * SAMPLE_TIME if any(noticed) else MOVED
        found.append((float(np.linalg.norm(force)), delay))
    return np.array(found).reshape(-1, 2).T


def _healthy(loop: FeelingLoop, seconds: float) -> int:
    """Return how often a contact begins in so much healthy exploration [s], the first 5 s apart."""
    contacts, before = 0, False
    for n in range(round((seconds + 5.0) / SAMPLE_TIME)):
        now = loop.feel(exploring=True).is_contact and n * SAMPLE_TIME > 5.0
        contacts, before = contacts + (now and not before), now
    return contacts


def _afloat(study: Study, seed: int, rng: np.random.Generator) -> tuple[float, float]:
    """Return how far a floating joint drifts [rad], and how far a hand moves the hand [m]."""
    settings, arm = Settings(first_duration=2.0), study.arm(seed)
    loop = FeelingLoop(arm, study.network(seed), settings, seed)
    loop.rest(_holdable(study.robot, rng))
    loop.core.configure(replace(settings, method='float'))
    loop.wait(MOVED)
    start, drift = arm.theta, 0.0
    for _ in range(round(FLOATING / SAMPLE_TIME)):
        loop.step()
        drift = max(drift, float(np.abs(arm.theta - start).max()))
    before = arm.hand.translation.copy()
    loop.push(_force(study.robot, rng, LIGHT, FIRM))
    loop.wait(MOVED)
    loop.check()
    return drift, float(np.linalg.norm(arm.hand.translation - before))


def forces(_: Study, rows: Rows) -> Plot:
    """Draw sizes and directions of all pushes."""
    parts = [[row.traces[key] for key in ('true', 'felt', 'free')] for row in rows.values()]
    true, felt, free = map(np.concatenate, zip(*parts))
    sizes, angle = np.linalg.norm(true, axis=1), _errors(true, felt)[1]
    figure, (left, right) = plots.new_figure(9.0, 3.6, columns=2)
    kinds = (free, plots.AFTER, 'free'), (~free, plots.MARK, 'a joint at its stop')
    for which, colour, name in kinds:
        style = {'color': colour, 's': 12, 'label': name}
        left.scatter(sizes[which], np.linalg.norm(felt[which], axis=1), **style)
        right.scatter(sizes[which], angle[which], **style)
    left.plot([0.0, MOST], [0.0, MOST], color=plots.TRUE, linewidth=0.8)
    plots.tidy(left, 'push [N]', 'estimated [N]', 'size', 'above')
    plots.tidy(right, 'push [N]', 'error [deg]', 'direction')
    return figure, f'{len(sizes)} pushes of the hand at rest, one second after they began.'
