# SPDX-License-Identifier: Apache-2.0
"""Resilience.

Paper (§III-D). A muscle that is switched off is noticed; the estimate goes on trusting it. Its
successor (arXiv 2409.14951) goes on without a ruptured muscle.

Here. Estimates of the held-out motion with every muscle isolated in turn, and with pairs of them,
beside the healthy one. Then estimator and controller as the nodes connect them, `on_anomaly:
isolate`, on the exploring arm: every muscle is cut in turn, and it is right if that muscle, and no
other, is isolated as broken within 10 s. After that `proposed` goes to random postures that the
true body can hold without the muscle, a minute at most until it rests (which share of all that it
holds with it is "held"; where that is none, the muscle has no targets and counts in all else);
"known" is how many of those the learned body knows to hold, the others are refused; "trapped", at
how many of them the arm lay on a stop where the rest cannot hold it. Every length
and tension sensor dies in turn (reads 0): the error counts from the isolation on, or from the fault
if there is none. Five hours of healthy exploration, over all individuals, with 3.6 kg grasped and
released each minute and a push of 10 to 30 N for a second every ten: isolations there are wrong.
"""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import Command
from musculoskeletal_ae.control.exploration import TRIES
from musculoskeletal_ae.control.follower import FALLEN
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.faults import Readings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.settings import Detection
from musculoskeletal_ae.exceptions import InfeasibleError, MessageError
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.detection import grasp_and_release
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop, judge
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.tension import holding_tension

EVERY = 10  # messages of the held-out motion
TARGETS = 2
#: [s] before a fault, at most until it is isolated, and after that
MOVING, DECIDED, AFTERWARDS = 12.0, 10, 6.0
#: [s] to a target at most (winches slow it; an arm that falls is sent again), and at rest there;
#: what rests turns no joint by more than this in a second [rad]
GOING, SETTLING, STILL = 60, 4, 0.02
HEALTHY_TIME = 18_000.0  # [s] over all individuals
PUSH_EVERY, PUSH = 10.0, (10.0, 30.0)  # [s], [N]


class Guarded(ClosedLoop):
    """The loop with the estimator's detector, which isolates what it finds broken."""

    def __init__(self, arm: Arm, mae: Mae, seed: int = 0) -> None:
        """Connect an arm that stands."""
        self.estimator = Estimator(arm.robot, mae.preset)
        self.estimator.configure(Detection(on_anomaly='isolate'))
        self._latched, self.isolated = False, tuple[int, ...]()
        self.found: list[tuple[tuple[int, ...], str]] = []  # isolated, and why, at each verdict
        self.error = np.nan  # ‖θ_est − θ‖ of the last message [rad]
        super().__init__(arm, mae, Settings(), seed)

    def use(self, mae: Mae) -> None:
        """Estimate and control by another network."""
        super().use(mae)
        self.estimator.use(mae)

    def estimate(self, read: Readings, now: float) -> Array:
        """Return θ [rad] (D,), and tell the controller what the estimator node tells it."""
        core, true = self.estimator, self.arm.theta
        states = np.array([read.length, read.tension, read.temperature])
        estimate = core.step(states, now, now)
        assert estimate is not None
        if bool(core.cause) != self._latched:
            self._latched = bool(core.cause)
            self.core.anomaly(self._latched)
            if not self._latched:
                self.found.append((core.body.isolated, core.suspects.last_verification))
        if core.body.isolated != self.isolated:
            self.isolated = core.body.isolated
            self.core.use_body(core.body)
        self.error = float(np.linalg.norm(estimate.state.theta - true))
        return estimate.state.theta

    def commanded(self, command: Command | None, now: float) -> None:
        """Let the estimator know the command."""
        if command is not None:
            self.estimator.commanded(now, **{command.kind: command.value})

    def run(self, duration: float) -> Array:
        """Let time pass [s]; return the error of every estimate [rad]."""
        errors = list[float]()
        for _ in range(round(duration / SAMPLE_TIME)):
            self.step()
            errors.append(self.error)
        return np.array(errors)


def broken(arm: Arm, mae: Mae, seed: int, muscle: int, fault: str) -> tuple[Guarded, Array]:
    """Return the loop after a muscle broke while exploring, and the errors that count [rad]."""
    loop = Guarded(arm, mae, seed)
    loop.run(1.0)
    loop.core.explore(True)
    loop.run(MOVING)
    name, errors = arm.robot.muscles[muscle], list[Array]()
    if fault:
        arm.set_faults([f'dead_sensor:{fault}:{name}'])
    else:
        arm.set_ruptured([name])
    for _ in range(DECIDED):
        if loop.found:
            break
        before = loop.isolated
        errors.append(loop.run(1.0))
        if loop.isolated and not before:
            errors.clear()
    return loop, np.concatenate([*errors, loop.run(AFTERWARDS)])


class Reached(NamedTuple):
    """What is left without a muscle.

    Attributes:
        share: Of the postures that the true body holds, those that it still holds.
        distances: At which `proposed` ends from some of those [rad], None where it refuses.
        trapped: Those of an arm that fell to where the true body's other muscles cannot hold it:
            it lies on a stop, from which they cannot lift it either.
    """

    share: float
    distances: list[float | None]
    trapped: list[float]


def reach(loop: Guarded, muscle: int, rng: np.random.Generator) -> Reached:
    """Measure what an arm can still hold and go to without a muscle."""
    robot, held, count = loop.arm.robot, [], 0
    without = robot.without([muscle])
    postures = robot.random_postures(TRIES, rng)
    for theta, slope in zip(postures, loop.arm.individual.muscle_jacobian(postures)):
        try:
            holding_tension(robot, theta, jacobian=slope)
            count += 1
            holding_tension(without, theta, jacobian=slope)
            held.append(theta)
        except InfeasibleError:
            continue
        if count >= 100 and len(held) >= TARGETS:
            break
    ended, trapped = list[float | None](), list[float]()
    for theta in held[:TARGETS]:
        try:
            loop.target(theta)
            rested, before = 0, loop.arm.theta
            for _ in range(GOING):
                if rested == SETTLING:
                    break
                loop.run(1.0)
                still = np.abs(loop.arm.theta - before).max() < STILL
                rested = rested + 1 if still and not loop.core.activities.follower.is_moving else 0
                before = loop.arm.theta
            distance = float(np.linalg.norm(before - theta))
            ended.append(distance)
            if np.abs(before - theta).max() > FALLEN:
                slope = loop.arm.individual.muscle_jacobian(before[None])[0]
                holding_tension(without, before, jacobian=slope)
        except MessageError:
            ended.append(None)
        except InfeasibleError:
            trapped.append(distance)
    return Reached(len(held) / max(count, 1), ended, trapped)


def healthy(arm: Arm, mae: Mae, seed: int, duration: float) -> list[tuple[int, ...]]:
    """Return what was isolated of a healthy arm at each verdict: nothing, if it was acquitted."""
    loop, rng = Guarded(arm, mae, seed), np.random.default_rng([seed, 0x4EA])
    loop.run(1.0)
    every, wrench = round(PUSH_EVERY / SAMPLE_TIME), np.zeros(6)
    for n in range(round(duration / SAMPLE_TIME)):
        grasp_and_release(arm, n * SAMPLE_TIME)
        if n % every in (0, round(1.0 / SAMPLE_TIME)):
            way = rng.normal(size=3)
            wrench[:3] = rng.uniform(*PUSH) * way / np.linalg.norm(way) if n % every == 0 else 0.0
            arm.set_wrench(wrench)
        loop.explore()
        if loop.core.watchdog.has_anomaly and not loop.isolated:
            loop.estimator.reset()  # as somebody would: acquitted twice, the arm stays stopped
    return [isolated for isolated, _ in loop.found]


def measure(study: Study, seed: int) -> Measured:
    """Return the numbers and traces of one individual."""
    robot, mae, rng = study.robot, study.network(seed), np.random.default_rng([seed, 0x2E5])
    stream, stride = study.stream(seed, 'held_out'), EVERY * (10 if study.quick else 1)
    error = judge(stream, stride)
    whole = error(mae)
    muscles = range(robot.muscle_count)
    one = [error(mae.without([m])) for m in muscles]
    two = [error(mae.without(pair)) for pair in combinations(muscles, 2)]
    right, ended, shares, dead, trapped, cuts = [], [], [], [], [], {}
    for m in rng.permutation(robot.muscle_count)[:1].tolist() if study.quick else muscles:
        loop, _ = broken(study.arm(seed), mae, seed, m, '')
        isolated, why = loop.found[0] if loop.found else ((), 'nothing')
        right.append(isolated == (m,))
        reached = reach(loop, m, rng)
        shares.append(reached.share)
        ended += reached.distances
        trapped += reached.trapped
        cut = {'found': why, 'held_share': reached.share, 'estimate_rad': one[m]}
        cuts[robot.muscles[m]] = cut
        for sensor in ('length',) if study.quick else ('length', 'tension'):
            loop, errors = broken(study.arm(seed), mae, seed, m, sensor)
            dead.append(float(errors.mean()))
            why = loop.found[0][1] if loop.found else 'nothing'
            cuts[robot.muscles[m]][f'dead_{sensor}'] = f'{why}; {dead[-1]:.3f} rad'
    duration = 10.0 if study.quick else HEALTHY_TIME / len(study.seeds)
    verdicts = healthy(study.arm(seed), mae, seed, duration)
    arrived = [distance for distance in ended if distance is not None]
    numbers: dict[str, Any] = {
        'healthy_rad': whole,
        'one_isolated_rad': float(np.mean(one)),
        'one_isolated_worst_rad': max(one),
        'two_isolated_rad': float(np.mean(two)),
        'two_isolated_worst_rad': max(two),
        'right_isolations_share': float(np.mean(right)),
        'held_share': float(np.mean(shares)),
        'known_share': len(arrived) / max(len(ended), 1),
        'trapped': len(trapped),
        'dead_sensor_rad': float(np.mean(dead)),
        'wrong_isolations': sum(map(bool, verdicts)),
        'acquittals': verdicts.count(()),
        'healthy_s': duration,
        'muscles': cuts,
    }
    numbers['proposed_one_isolated_rad'] = float(np.mean(arrived)) if arrived else None
    if free := len(arrived) - len(trapped):
        numbers['proposed_not_trapped_rad'] = (sum(arrived) - sum(trapped)) / free
    return Measured(numbers, {'one': one, 'two': two, 'healthy': whole})


def isolated(study: Study, rows: Rows) -> Plot:
    """Draw the estimate's error without each muscle, beside the healthy one."""
    figure, (panel,) = plots.new_figure(8.0, 0.35 * study.robot.muscle_count + 1.5)
    place = np.arange(study.robot.muscle_count)
    for row in rows.values():
        ratio = np.array(row.traces['one']) / row.traces['healthy']
        panel.plot(ratio, place, 'o', color=plots.AFTER, alpha=0.6, ms=5)
    panel.axvline(1.5, color=plots.TRUE, ls=':', label='aim')
    panel.set_yticks(place, study.robot.muscles)
    panel.invert_yaxis()
    plots.tidy(panel, 'error of the estimate without it, over the healthy one', legend='below')
    return figure, 'Error of the estimate with each muscle isolated; one point per individual.'


EXPERIMENT = Experiment(__doc__, measure, (isolated,), 60.0)
