# SPDX-License-Identifier: Apache-2.0
"""Motion.

Paper (§IV-C). The arm approaches each posture in 5 s. The paper shows no fast motion.

Here. After learning, the arm follows minimum-jerk trajectories in 1 s and in 2 s between random
postures that the true body can hold, and rests for 0.6 s after each. Inverse dynamics computes the
commands. Three other methods receive the same postures as targets and approach them in the same
time: `proposed` by a trajectory of its own, `first` and `second` by ramps of the lengths. `tension`
receives the desired posture in every message. The controller may use the full speed of the emulated
winches. A trajectory that is too fast for the winches is slowed, and errors refer to the slowed
trajectory. Then `proposed` moves the arm to 20 such postures in turn, with 8 s for each.
Afterwards, the hand moves along circles of 10 cm diameter at 0.1 m/s, for which `target_pose`
receives 50 poses a second. A planar arm draws the circles in its plane. Then forces of 10 to 50 N
in random directions push the hand: for 1.5 s while the arm rests, and for 1 s while it explores. At
rest, a joint stop may carry a part of the force. In method `float`, the arm is first left alone,
and then guided with 15 to 20 N. If the controller stops on a trajectory, the experiment fails for
this individual. If it stops in another method, the numbers of this method are missing. If no circle
is reachable, the error on circles is missing.

- tracking: mean of ‖θ_desired − θ_true‖ over the motion
- settled: the same distance 0.5 s after the end of the motion
- slowed: factor by which the duration of the trajectory was extended
- tension: mean ‖T‖ relative to the least T ≥ T_bias that moves the true body along the same path
- attainable: the same ratio if the least T also overcomes winch drag and friction
- settle: time from a target of `proposed` until the arm stays within 0.05 rad of it
- distance: ‖θ_target − θ_true‖ 8 s after a target of `proposed`. Further than 0.06 rad, the target
  counts as missed; further than 0.4 rad, the motion counts as stuck.
- wrench_error: |‖F_est‖ − ‖F‖| / ‖F‖ in the last half second of a push
- false contacts: contacts that are detected in one hour of exploration (shared by the individuals)
  without external forces
"""

from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.faults import SPEED_LIMIT
from musculoskeletal_ae.emulator.kin.arm import VISCOUS
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.emulator.modules import MOTOR_GAIN, Arm
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.experiments import contact, plots
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop, times
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Measured,
    Plot,
    Rows,
    Study,
    first_individual,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.explored_postures import TRIES, holdable_postures
from musculoskeletal_ae.motion.hand import POSITION
from musculoskeletal_ae.motion.holdable_paths import lacking
from musculoskeletal_ae.motion.ramps import RAMP_SHARE
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

DURATIONS = (1.0, 2.0)  # move from one posture to the next in these times [s]
MOTIONS, CIRCLES = 6, 3  # make this many motions of each duration, and of circles of the hand
STARTING = 3.0  # move to the first posture in this time [s]
REST = 0.6  # rest for this time after each motion [s]
SETTLED = 0.5  # read the settled error this long after the end of a motion [s]
OURS = 'trajectory'
METHODS = {
    OURS: plots.AFTER,
    'proposed': '#56B4E9',
    'tension': plots.AS_PRINTED,
    'first': '#E69F00',
    'second': '#009E73',
}
#: control methods of a shortened run; all but OURS are only measured in motions of DURATIONS[0]
QUICK_METHODS = OURS, 'tension', 'second'
RADIUS, SPEED = 0.05, 0.1  # move the hand along circles of this radius [m] at this speed [m/s]
EVERY = 2  # send a pose of the hand with every second message, which makes 50 poses a second
NEAR = 0.002  # treat a pose as reachable if the hand comes this close to it [m]
#: maps a time [s] to the desired pose of the hand
Place = Callable[[float], pin.SE3]
TARGETS = 20  # let `proposed` approach this many targets
ARRIVING = 8.0  # read the distance from a target after this time [s]
SETTLING_TIME = 4.0  # wait at most this long for the arm to settle [s]
WITHIN = 0.05  # count the arm as settled within this distance from the target [rad]
MISSED = 0.06  # count a target as missed if the arm ends further away than this [rad]
STUCK = 0.4  # count a motion as stuck if the arm ends further away than this [rad]
LAP = 2.0 * np.pi * RADIUS / SPEED  # duration of a circle [s]


class TrackedMotion(NamedTuple):
    """Postures and tensions during one motion and the rest after it.

    N messages cover the motion and the rest, and the first N' of them the motion itself.
    """

    desired: Array  # desired θ [rad], (N, D)
    theta: Array  # true θ [rad], (N, D)
    tension: Array  # true ‖T‖ during the motion [N], (N',)
    bound: Array  # the bounds of ‖T‖ during the motion, see `bounds` [N], (…, N')
    slowed: float  # factor by which the trajectory was slowed

    @property
    def error(self) -> Array:
        """Distance ‖θ_desired − θ_true‖ at each message [rad], (N,)."""
        return np.linalg.norm(self.desired - self.theta, axis=1)


def loop_at(arm: Arm, mae: Mae, start: Array, method: str, duration: float) -> ClosedLoop:
    """Move an arm to `start` [rad] (D,); return its closed loop with a control method.

    The motion to `start` takes STARTING [s]. The settings of the method are chosen such that its
    later motions take `duration` [s].
    """
    # A ramp takes RAMP_SHARE of the duration that its setting states. Method `second` has two
    # ramps.
    ramp = duration / RAMP_SHARE
    first_part = 0.5 * ramp if method == 'second' else ramp
    settings = Settings(rate_limit=SPEED_LIMIT)
    loop = ClosedLoop(arm, mae, settings)
    loop.step()
    loop.go(start, STARTING)
    if method != OURS:
        other = Settings(
            method=method, rate_limit=SPEED_LIMIT, target_duration=duration,
            first_duration=first_part, second_duration=0.5 * ramp,
        )  # fmt: skip
        loop.core.configure(other)
        loop.go(start, STARTING)
    return loop


def follow(
    loop: ClosedLoop, start: Array, goal: Array, method: str, duration: float
) -> TrackedMotion:
    """Move from `start` to `goal` [rad] (D,) in `duration` [s] with a control method.

    The returned motion includes the rest after it.

    Raises:
        MusculoskeletalError: If the controller stopped.
    """
    core, arm = loop.core, loop.arm
    planned = Trajectory.to(Setpoint.resting(start), goal, duration)
    if method == OURS:
        core.trajectory(planned.points)
        followed = core.activities.follower.progress.trajectory
        assert followed is not None
        planned = followed
    elif method != 'tension':
        loop.target(goal)
    theta, tension = [], []
    count = round(planned.duration / SAMPLE_TIME)
    desired = planned.sample(SAMPLE_TIME + times(count + round(REST / SAMPLE_TIME)))
    for at in desired.theta:
        if method == 'tension':
            loop.target(at)
        loop.step()
        theta.append(arm.theta)
        tension.append(np.linalg.norm(arm.tension))
    loop.check()
    bound = bounds(arm, Setpoint(*(part[:count] for part in desired)))
    return TrackedMotion(
        desired.theta, np.array(theta), np.array(tension)[:count], bound, planned.slowed
    )


def approach(loop: ClosedLoop, goal: Array, duration: float) -> tuple[float, float]:
    """Send a target θ [rad] (D,), and observe the arm for `duration` [s].

    Returns:
        The time until the arm stays within WITHIN of the target, at most SETTLING_TIME [s], and the
        distance ‖θ_target − θ‖ at the end [rad].
    """
    loop.target(goal)
    distances = list[float]()
    for _ in range(round(duration / SAMPLE_TIME)):
        loop.step()
        distances.append(float(np.linalg.norm(loop.arm.theta - goal)))
    beyond = np.array(distances[: round(SETTLING_TIME / SAMPLE_TIME)]) > WITHIN
    settled_at = beyond.nonzero()[0].max(initial=-1) + 1
    return SAMPLE_TIME * float(settled_at), distances[-1]


def arrivals(loop: ClosedLoop, goals: Array, duration: float) -> dict[str, float]:
    """Approach targets θ [rad], (N, D), one after the other, for `duration` [s] each.

    Returns:
        Statistics of settling times, distances and missed targets, by key in result.json.
    """
    settling, distances = np.array([approach(loop, goal, duration) for goal in goals]).T
    return {
        'settle_s': float(settling.mean()),
        'distance_rad': float(distances.mean()),
        'distance_median_rad': float(np.median(distances)),
        'approaches': len(distances),
        'missed': int((distances > MISSED).sum()),
        'stuck': int((distances > STUCK).sum()),
    }


def bounds(arm: Arm, motion: Setpoint) -> Array:
    """Return the least ‖T‖ [N] that moves the true, exactly known body along a path.

    Returns:
        An array (2, N) or (3, N) for N points of the path. The first row follows from inverse
        dynamics alone. The second row adds the drag of the winches. The third row also adds the
        friction of tendons and joints; it exists for emulator model `kin` only.
    """
    robot, limits, true = arm.robot, arm.robot.tension, arm.individual
    jacobian, bias = true.muscle_jacobian(motion.theta), limits.bias
    torque = map(robot.kinematics.inverse_dynamics, *motion)
    result = []
    for G, rigid, velocity in zip(jacobian, torque, motion.velocity):
        speed = G @ velocity
        # A tendon that is pulled out drags its winch along, which needs additional tension.
        with_drag = np.minimum(bias + np.maximum(speed, 0.0) / MOTOR_GAIN, limits.limit)
        cases = [(G, rigid, bias), (G, rigid, with_drag)]
        if isinstance(true, Individual):
            tendon_friction = np.exp(true.tendon_friction * np.sign(speed))
            joint_friction = VISCOUS * velocity + true.joint_friction * np.sign(velocity)
            cases.append((tendon_friction[:, None] * G, rigid + joint_friction, with_drag))
        least = [least_tension(*case, limits.limit).tension for case in cases]
        result.append(np.linalg.norm(least, axis=1))
    return np.array(result).T


def circles(
    robot: Robot, mae: Mae, rng: np.random.Generator, count: int
) -> list[tuple[Array, Place]]:
    """Return at most `count` random circles that the hand can follow.

    Each circle consists of a start posture [rad] (D,), and of a function that returns the desired
    pose of the hand at a time [s]. `mae` decides whether the arm can hold the postures on the way.
    """
    reachable = list[tuple[Array, Place]]()
    for theta, _ in holdable_postures(robot, robot.random_postures(TRIES, rng), 40):
        centre = robot.kinematics.end_effector_pose(theta).translation
        frame, reach, _ = np.linalg.svd(robot.kinematics.end_effector_jacobian(theta)[:3])
        planar = len(reach) < 3 or reach[2] < 1e-6
        axes = frame if planar else np.linalg.qr(rng.normal(size=(3, 3)))[0]

        def place(time: float, centre: Array = centre, axes: Array = axes) -> pin.SE3:
            turn = SPEED / RADIUS * time
            offset: Array = RADIUS * (np.cos(turn) * axes[:, 0] + np.sin(turn) * axes[:, 1])
            return pin.SE3(np.eye(3), centre + offset)

        at, is_reachable = theta, True
        for time in np.linspace(0.0, LAP, 25):
            at, distance, *_ = inverse_kinematics(robot, place(time), at, POSITION)
            if distance > NEAR or lacking(robot, mae, at):
                is_reachable = False
        if is_reachable:
            reachable.append((theta, place))
        if len(reachable) == count:
            break
    return reachable


def circle(loop: ClosedLoop, start: Array, place: Place) -> tuple[Array, Array]:
    """Follow a circle once; return desired and true positions of the hand [m], each (N, 3).

    The motion to the posture `start` takes STARTING [s].
    """
    loop.go(start, STARTING)
    loop.core.pose(place(0.0), False, -1.0)
    loop.wait(1.5)
    desired, true = [], []
    for n in range(round(LAP / SAMPLE_TIME)):
        if n % EVERY == 0:
            # As the node does, keep the previous target if a pose is just out of reach.
            with suppress(MessageError):
                loop.core.pose(place(n * SAMPLE_TIME), False, n * SAMPLE_TIME)
        loop.step()
        desired.append(place((n + 1) * SAMPLE_TIME).translation)
        true.append(loop.arm.hand.translation)
    loop.check()
    return np.array(desired), np.array(true)


def measure(study: Study, seed: int) -> Measured:
    """Measure tracking with every control method, circles of the hand, and contact."""
    mae, rng = study.network(seed), np.random.default_rng([seed, 0x307])
    robot = study.robot
    count = study.number(MOTIONS)
    arm = study.arm(seed)
    postures = robot.random_postures(TRIES, rng)
    number = study.number(TARGETS) + 1
    held = holdable_postures(robot, postures, number, arm.individual.muscle_jacobian)
    targets = np.array([theta for theta, _ in held])
    postures = targets[: count + 1]
    numbers: dict[str, Any] = {'methods': {}}
    traces: dict[str, Any] = {}
    for method in QUICK_METHODS if study.quick else METHODS:
        row: dict[str, float | str] = {}
        for duration in DURATIONS[:1] if study.quick and method != OURS else DURATIONS:
            name = f'{duration:.0f}s'
            try:
                loop = loop_at(study.arm(seed), mae, postures[0], method, duration)
                runs = [follow(loop, a, b, method, duration) for a, b in pairwise(postures)]
            except MusculoskeletalError as error:
                if method == OURS:
                    raise
                row[f'left_out_{name}'] = str(error)
                continue
            row |= {f'{key}_{name}': value for key, value in _summary(runs).items()}
            traces[f'{method} {name}'] = np.concatenate([run.error for run in runs])
        numbers['methods'][method] = row
    ours = numbers['methods'][OURS]
    numbers |= {
        'track_1s_rad': ours['track_rad_1s'],
        'track_2s_rad': ours['track_rad_2s'],
        'settled_rad': 0.5 * (ours['settled_rad_1s'] + ours['settled_rad_2s']),
        'tension_ratio': 0.5 * (ours['tension_ratio_1s'] + ours['tension_ratio_2s']),
    }
    if 'attainable_ratio_1s' in ours:
        both = ours['attainable_ratio_1s'] + ours['attainable_ratio_2s']
        numbers['tension_ratio_attainable'] = 0.5 * both
    loop = loop_at(study.arm(seed), mae, targets[0], OURS, 1.0)
    numbers |= arrivals(loop, targets[1:], study.seconds(ARRIVING))
    found = circles(robot, mae, rng, study.number(CIRCLES))
    laps = [circle(loop, *each) for each in found]
    errors = [np.linalg.norm(true - desired, axis=1).mean() for desired, true in laps]
    numbers['hand_circle_m'] = float(np.mean(errors)) if laps else None
    traces['laps'] = laps
    contacts = contact.measure(study, seed)
    return Measured(numbers | contacts.numbers, traces | contacts.traces)


def _summary(runs: list[TrackedMotion]) -> dict[str, float]:
    errors_in_motion = [run.error[: len(run.tension)] for run in runs]
    at = round(SETTLED / SAMPLE_TIME) - 1
    tension, bound = (np.concatenate(part, axis=-1) for part in zip(*[run[2:4] for run in runs]))
    ratio = tension.mean() / bound.mean(axis=1)
    return {
        'track_rad': float(np.mean([error.mean() for error in errors_in_motion])),
        'settled_rad': float(np.mean([run.error[len(run.tension) + at] for run in runs])),
        **dict(zip(('tension_ratio', 'winches_ratio', 'attainable_ratio'), ratio.tolist())),
        'slowed': float(np.mean([run.slowed for run in runs])),
    }


def motion(_: Study, rows: Rows) -> Plot:
    """Draw the tracking errors of the first individual over time."""
    seed, row = first_individual(rows)
    figure, panels = plots.new_figure(11.0, 6.4, 2)
    for panel, duration in zip(panels, DURATIONS, strict=True):
        for method, colour in METHODS.items():
            if (error := row.traces.get(f'{method} {duration:.0f}s')) is None:
                continue  # the controller stopped
            label = f'{method}: {error.mean():.3f} rad'
            plots.line(panel, times(len(error)), error, color=colour, label=label, lw=1.2)
        title = f'individual {seed}, motions of {duration:g} s'
        plots.tidy(panel, 'time [s]', '‖θ_desired − θ‖ [rad]', title, legend='right')
    caption = (
        'Distance from the minimum-jerk trajectory over time, for several consecutive motions.'
    )
    return figure, caption


def motion_hand(_: Study, rows: Rows) -> Plot:
    """Draw the desired and the true circles of the hand, each in the plane of the circle."""
    seed, row = first_individual(rows)
    laps = row.traces['laps']
    figure, panels = plots.new_figure(4.0 * max(len(laps), 1), 4.2, 1, max(len(laps), 1))
    for panel, (desired, true) in zip(panels, laps):
        centre = desired.mean(axis=0)
        axes = np.linalg.svd(desired - centre)[2][:2]
        for name, path, style in (
            ('desired', desired, {'color': plots.TRUE, 'ls': '--'}),
            ('true', true, {'color': plots.AFTER}),
        ):
            panel.plot(*(1000.0 * axes @ (path - centre).T), label=name, **style)
        panel.set_aspect('equal')
        error = 1000.0 * np.linalg.norm(true - desired, axis=1).mean()
        plots.tidy(panel, '[mm]', '[mm]', f'mean error {error:.1f} mm', legend='below')
    return figure, (
        f'Circles of the hand, which target_pose commands at {SPEED} m/s. Individual {seed}.'
    )


PLOTS = motion, motion_hand, contact.forces
EXPERIMENT = Experiment(__doc__, measure, PLOTS, 16.0)
