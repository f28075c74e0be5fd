# SPDX-License-Identifier: Apache-2.0
"""Resilience.

Paper (§III-D). A switched-off muscle is detected, but the estimate continues to use it. The
successor of the method (arXiv 2409.14951) continues without a ruptured muscle.

Here. The held-out motion is estimated with all muscles, without each muscle and without each pair
of muscles. Then the arm explores in closed loop through estimator and controller, with `on_anomaly:
isolate`, until a muscle ruptures. The estimator isolates the suspect muscle, and the controller
then verifies it. An isolation is correct if the first verification ends within 16 s and leaves
exactly the ruptured muscle isolated. Afterwards, `proposed` moves the arm to random postures that
the true body can hold without the muscle, for at most a minute each. Every muscle is ruptured in
turn. In the same way, every length sensor and every tension sensor fails in turn: it reads 0. The
error of the estimate is averaged from the isolation on, or from the fault on if nothing is
isolated. Finally, healthy arms explore for five hours, shared by the individuals. They grasp or
release 3.6 kg each minute, and a force of 10 to 30 N acts on the hand for one of every ten seconds.
Every isolation in these hours counts as wrong.

- held: share of the holdable postures that remain holdable without the muscle. If none remain, no
  targets are approached without this muscle, but its other numbers count.
- known: share of the targets that the learned body considers holdable. The controller refuses all
  other targets.
- trapped: number of targets whose motion ended at a joint stop, in a posture that the remaining
  muscles can neither hold nor leave
"""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.faults import ArmReadings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.exceptions import InfeasibleError, MessageError
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.detection import grasp_and_release
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop, make_error_function
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.explored_postures import TRIES
from musculoskeletal_ae.robot.tension import holding_tension

#: evaluate only every tenth message of the held-out motion, because it is estimated very often
EVERY = 10
TARGETS = 2  # let the arm approach this many targets without each muscle
MOVING = 12.0  # let the arm explore for this time before a fault [s]
#: wait at most this long after a fault for the end of the first verification [s]
LATEST_VERDICT = 10
AFTERWARDS = 6.0  # then let the arm continue its activity for this time [s]
#: wait at most this long for the arm to reach a target [s]; this allows for slow winches
LONGEST_APPROACH = 60
SETTLING = 4  # count the arm as arrived after this time at rest [s]
AWAY = 0.2  # count the arm as away from its target if a joint ends further than this from it [rad]
STILL = 0.02  # count the arm as at rest if no joint moves more than this in a second [rad]
HEALTHY_TIME = 18_000.0  # let healthy arms explore for this time, shared by the individuals [s]
PUSH_EVERY = 10.0  # push the hand of a healthy arm at this interval [s]
PUSH = (10.0, 30.0)  # push the hand of a healthy arm with forces in this range [N]


class IsolatingLoop(ClosedLoop):
    """A closed loop that isolates faulty muscles, and notes verdicts and errors."""

    def __init__(self, arm: Arm, mae: Mae, seed: int = 0) -> None:
        """Connect an arm at rest to an estimator that isolates suspect muscles.

        `seed` determines the exploration.
        """
        #: isolated muscles and the reason, after each verification
        self.verdicts: list[tuple[tuple[int, ...], str]] = []
        self.error = np.nan  # distance ‖θ_est − θ‖ at the last message [rad]
        super().__init__(arm, mae, Settings(), seed)
        self.estimator.suspects.isolates = True

    @property
    def isolated(self) -> tuple[int, ...]:
        """Indices of the muscles that the controller does not use."""
        return self.core.stream.body.isolated

    def estimate(self, read: ArmReadings, now: float) -> Array:
        """Estimate θ [rad] (D,); record the error, and each verification that has ended."""
        core, before = self.estimator, self.core.stream.body
        theta = super().estimate(read, now)
        if before.has_anomaly and not core.body.has_anomaly:
            self.verdicts.append((core.body.isolated, core.suspects.last_verification))
        self.error = float(np.linalg.norm(theta - self.arm.theta))
        return theta

    def run(self, duration: float) -> Array:
        """Advance by `duration` [s]; return ‖θ_est − θ‖ after each of the N steps [rad], (N,)."""
        errors = list[float]()
        for _ in range(round(duration / SAMPLE_TIME)):
            self.step()
            errors.append(self.error)
        return np.array(errors)


def run_with_fault(
    study: Study, seed: int, muscle: int, sensor: str
) -> tuple[IsolatingLoop, Array]:
    """Let an arm explore, make a muscle or one of its sensors fail, and continue.

    Args:
        study: Options of the run.
        seed: Seed of the individual and of its exploration.
        muscle: Index of the muscle that fails.
        sensor: 'length' or 'tension' for a sensor that fails; '' for a rupture.

    Returns:
        The loop, and the errors of the estimate [rad] since the isolation, or since the fault if no
        muscle was isolated.
    """
    arm = study.arm(seed)
    loop = IsolatingLoop(arm, study.network(seed), seed)
    loop.run(1.0)
    loop.core.explore(True)
    loop.run(study.seconds(MOVING))
    name, errors = arm.robot.muscles[muscle], list[Array]()
    if sensor:
        arm.set_faults([f'dead_sensor:{sensor}:{name}'])
    else:
        arm.set_faults([f'rupture:{name}'])
    for _ in range(LATEST_VERDICT):
        if loop.verdicts:
            break
        before = loop.isolated
        errors.append(loop.run(1.0))
        if loop.isolated and not before:
            errors.clear()
    return loop, np.concatenate([*errors, loop.run(study.seconds(AFTERWARDS))])


class Reach(NamedTuple):
    """Results on the postures that an arm can hold and approach without one of its muscles.

    Attributes:
        share: Share of the holdable postures of the true body that remain holdable.
        distances: Final distance of `proposed` from each target [rad]; None if the controller
            refused the target.
        trapped: The entries of `distances` for motions that ended at a joint stop, in a posture
            that the remaining muscles can neither hold nor leave.
        approaches: Distance ‖θ_target − θ‖ after each second of every approach that was not refused
            [rad].
    """

    share: float
    distances: list[float | None]
    trapped: list[float]
    approaches: list[list[float]]


def measure_reach(
    loop: IsolatingLoop, muscle: int, rng: np.random.Generator, targets: int
) -> Reach:
    """Measure which postures an arm can hold without a muscle, and approach `targets` of them."""
    robot, held, count = loop.arm.robot, [], 0
    reduced_robot = robot.without([muscle])
    postures = robot.random_postures(TRIES, rng)
    jacobians = loop.arm.individual.muscle_jacobian(postures)
    for theta, jacobian in zip(postures, jacobians):
        try:
            holding_tension(robot, theta, jacobian=jacobian)
            count += 1
            holding_tension(reduced_robot, theta, jacobian=jacobian)
            held.append(theta)
        except InfeasibleError:
            continue
        if count >= 100 and len(held) >= targets:
            break
    distances, trapped, approaches = list[float | None](), list[float](), list[list[float]]()
    for theta in held[:targets]:
        try:
            loop.target(theta)
            approaches.append([float(np.linalg.norm(loop.arm.theta - theta))])
            #: time at rest so far [s], and the posture one second ago
            rest_time, before = 0, loop.arm.theta
            for _ in range(LONGEST_APPROACH):
                if rest_time == SETTLING:
                    break
                loop.run(1.0)
                still = np.abs(loop.arm.theta - before).max() < STILL
                is_resting = still and not loop.core.activities.follower.progress.is_moving
                rest_time = rest_time + 1 if is_resting else 0
                before = loop.arm.theta
                approaches[-1].append(float(np.linalg.norm(before - theta)))
            distance = approaches[-1][-1]
            distances.append(distance)
            if np.abs(before - theta).max() > AWAY:
                jacobian = loop.arm.individual.muscle_jacobian(before[None])[0]
                holding_tension(reduced_robot, before, jacobian=jacobian)
        except MessageError:
            distances.append(None)
        except InfeasibleError:
            trapped.append(distance)
    return Reach(len(held) / max(count, 1), distances, trapped, approaches)


def isolations_of_healthy_arm(
    arm: Arm, mae: Mae, seed: int, duration: float
) -> list[tuple[int, ...]]:
    """Let a healthy arm explore for `duration` [s]; return which muscles are wrongly isolated.

    The result has one tuple of muscles for each verification of a suspect. The tuple is empty if
    the verification isolates no muscle.
    """
    loop, rng = IsolatingLoop(arm, mae, seed), np.random.default_rng([seed, 0x4EA])
    loop.run(1.0)
    every, wrench = round(PUSH_EVERY / SAMPLE_TIME), np.zeros(6)
    for n in range(round(duration / SAMPLE_TIME)):
        grasp_and_release(arm, n * SAMPLE_TIME)
        if n % every in (0, round(1.0 / SAMPLE_TIME)):
            direction = rng.normal(size=3)
            force = rng.uniform(*PUSH) * direction / np.linalg.norm(direction)
            wrench[:3] = force if n % every == 0 else 0.0
            arm.set_wrench(wrench)
        loop.explore()  # also resets the estimator, which stops the arm after two false alarms
    return [isolated for isolated, _ in loop.verdicts]


def measure(study: Study, seed: int) -> Measured:
    """Measure how well one individual continues without each muscle and with each faulty sensor."""
    robot, mae, rng = study.robot, study.network(seed), np.random.default_rng([seed, 0x2E5])
    stream, stride = study.stream(seed, 'held_out'), EVERY * (10 if study.quick else 1)
    error = make_error_function(stream, stride)
    healthy_error = error(mae)
    muscles = range(robot.muscle_count)
    one = [error(mae.without([m])) for m in muscles]
    two = [error(mae.without(pair)) for pair in combinations(muscles, 2)]
    correct, distances, shares, sensor_errors, trapped = [], [], [], [], []
    by_muscle: dict[str, dict[str, Any]] = {}
    approaches: dict[str, list[list[float]]] = {}
    for m in rng.permutation(robot.muscle_count)[:1].tolist() if study.quick else muscles:
        loop, _ = run_with_fault(study, seed, m, '')
        isolated, reason = loop.verdicts[0] if loop.verdicts else ((), 'nothing')
        correct.append(isolated == (m,))
        reach = measure_reach(loop, m, rng, study.number(TARGETS))
        shares.append(reach.share)
        distances += reach.distances
        trapped += reach.trapped
        approaches[robot.muscles[m]] = reach.approaches
        row = {'found': reason, 'held_share': reach.share, 'estimate_rad': one[m]}
        for sensor in ('length',) if study.quick else ('length', 'tension'):
            loop, errors = run_with_fault(study, seed, m, sensor)
            sensor_errors.append(float(errors.mean()))
            reason = loop.verdicts[0][1] if loop.verdicts else 'nothing'
            row[f'dead_{sensor}'] = f'{reason}; {sensor_errors[-1]:.3f} rad'
        by_muscle[robot.muscles[m]] = row
    duration = study.seconds(HEALTHY_TIME / len(study.seeds))
    isolations = isolations_of_healthy_arm(study.arm(seed), mae, seed, duration)
    arrived = [distance for distance in distances if distance is not None]
    numbers: dict[str, Any] = {
        'healthy_rad': healthy_error,
        'one_isolated_rad': float(np.mean(one)),
        'one_isolated_worst_rad': max(one),
        'two_isolated_rad': float(np.mean(two)),
        'two_isolated_worst_rad': max(two),
        'right_isolations_share': float(np.mean(correct)),
        'held_share': float(np.mean(shares)),
        'known_share': len(arrived) / max(len(distances), 1),
        'trapped': len(trapped),
        'dead_sensor_rad': float(np.mean(sensor_errors)),
        'wrong_isolations': sum(map(bool, isolations)),
        'acquittals': isolations.count(()),
        'healthy_s': duration,
        'muscles': by_muscle,
    }
    numbers['proposed_one_isolated_rad'] = float(np.mean(arrived)) if arrived else None
    if free := len(arrived) - len(trapped):
        numbers['proposed_not_trapped_rad'] = (sum(arrived) - sum(trapped)) / free
    traces = {'one': one, 'two': two, 'healthy': healthy_error, 'approaches': approaches}
    return Measured(numbers, traces)


def isolated(study: Study, rows: Rows) -> Plot:
    """Draw the estimation error without each muscle, relative to the error with all muscles."""
    figure, (panel,) = plots.new_figure(8.0, 0.35 * study.robot.muscle_count + 1.5)
    place = np.arange(study.robot.muscle_count)
    for row in rows.values():
        ratio = np.array(row.traces['one']) / row.traces['healthy']
        panel.plot(ratio, place, 'o', color=plots.AFTER, alpha=0.6, ms=5)
    panel.axvline(1.5, color=plots.TRUE, ls=':', label='goal')
    panel.set_yticks(place, study.robot.muscles)
    panel.invert_yaxis()
    xlabel = 'estimation error without the muscle / error with all muscles'
    plots.tidy(panel, xlabel, legend='below')
    return figure, 'Estimation error with each muscle isolated; one point per individual.'


def approaches(_: Study, rows: Rows) -> Plot:
    """Draw the distance from each target over time, and name the muscles without which it stays."""
    figure, (panel,) = plots.new_figure(8.0, 3.6)
    for seed, row in rows.items():
        for muscle, distances in row.traces['approaches'].items():
            for distance in distances:
                is_away = distance[-1] > AWAY
                label = f'individual {seed} without {muscle}' if is_away else None
                style = {'color': None, 'lw': 2.0} if is_away else {'color': plots.AFTER, 'lw': 0.8}
                panel.plot(distance, label=label, **style)
    legend = 'right' if panel.get_legend_handles_labels()[1] else ''
    plots.tidy(panel, 'time [s]', '‖θ_target − θ‖ [rad]', legend=legend)
    caption = (
        'Distance from the target after the rupture of each muscle. Motions that end further than '
        f'{AWAY} rad away have a label.'
    )
    return figure, caption


EXPERIMENT = Experiment(__doc__, measure, (isolated, approaches), 60.0)
