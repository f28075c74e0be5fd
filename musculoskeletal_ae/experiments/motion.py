# SPDX-License-Identifier: Apache-2.0
"""Motion.

Paper (§IV-C). Postures are approached in 5 s; it shows no motion at speed.

Here. Minimum-jerk motions between random postures that the true body can hold, in 1 s and in 2 s,
each 0.6 s apart, after learning: the joint trajectory is followed by inverse dynamics. Tracking:
the mean over the motion of ‖θ_desired − θ_true‖ over all joints; settled: the same 0.5 s after its
end. Beside it the other ways to get there in that time: a target under `proposed`, `first` and
`second`, by ramps of lengths that are as long as the motion, and the desired posture, message by
message, under `tension`. Where winches cannot follow, a trajectory is slowed, and its own desired
posture counts; "slowed" is by how much. The controller may use the speed that the emulated winches
have. "Tension" is the mean of ‖T‖ beside that of the least T ≥ T_bias that moves the true body
along the path (inverse dynamics). "Attainable" is the same beside the least that this body's
winches and friction leave: a wire that is pulled out drags its winch along, wires and joints rub.
To settle: the time from a target under `proposed` until the arm stays within 0.05 rad of it. The
circles, of 10 cm, are random ones that can be reached, in its plane by a planar arm; the hand's
position is sent by target_pose, 50 times a second, at 0.1 m/s. Touch: the hand is pushed in random
directions, by 10 to 50 N, at rest in random postures that can be held and while the arm explores.
`wrench_error` is |‖F_est‖ − ‖F‖| / ‖F‖ after a second; a push that drives joints against their
stops, which then bear a part of it, counts like any other. Then an hour of healthy exploration,
spread over the individuals, in which every contact is a false one. In method `float` the arm is
left alone, and pushed by 15 to 20 N. What a robot cannot do has no number: one of the other ways
whose control stops, circles of which none is found. Where the trajectory's control stops, the
individual failed.
"""

from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.exploration import TRIES, holdable_postures
from musculoskeletal_ae.control.hand import POSITION
from musculoskeletal_ae.control.ramps import RAMP_SHARE
from musculoskeletal_ae.control.reach import lacking
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.emulator.arm import VISCOUS
from musculoskeletal_ae.emulator.faults import SPEED_LIMIT
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.emulator.modules import MOTOR_GAIN, Arm
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.experiments import plots, touch
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop, times
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study, first
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

DURATIONS = (1.0, 2.0)  # [s]
MOTIONS, CIRCLES = 6, 3
STARTING = 3.0  # [s] to the first posture
REST, SETTLED = 0.6, 0.5  # [s] after a motion, and when it is read
OURS = 'trajectory'
METHODS = {
    OURS: plots.AFTER,
    'proposed': '#56B4E9',
    'tension': plots.AS_PRINTED,
    'first': '#E69F00',
    'second': '#009E73',
}
RADIUS, SPEED = 0.05, 0.1  # [m], [m/s]
EVERY = 2  # messages between two poses
NEAR = 0.002  # [m]
#: where the hand is to be at a time [s]
Place = Callable[[float], pin.SE3]
WATCHED, WITHIN = 4.0, 0.05  # [s], [rad]
LAP = 2.0 * np.pi * RADIUS / SPEED


class Followed(NamedTuple):
    """N messages of one motion."""

    desired: Array  # θ [rad], (N, D)
    theta: Array  # true [rad], (N, D)
    tension: Array  # ‖T‖ of the true arm while it moves [N], (N',)
    bound: Array  # least ‖T‖ of the same, and with drag and friction, see `bounds` [N], (…, N')
    slowed: float

    @property
    def error(self) -> Array:
        """‖θ_desired − θ_true‖ [rad], (N,)."""
        return np.linalg.norm(self.desired - self.theta, axis=1)


def loop_at(arm: Arm, mae: Mae, start: Array, method: str, duration: float) -> ClosedLoop:
    """Return a loop that has brought an arm to a posture [rad] (D,)."""
    # `first` takes all of the time but for the ramp of the other part, if it has one.
    ramp = duration / RAMP_SHARE
    first_part = 0.5 * ramp if method == 'second' else ramp
    settings = Settings(rate_limit=SPEED_LIMIT)
    loop = ClosedLoop(arm, mae, settings)
    loop.step()
    loop.go(start, STARTING)
    if method != OURS:
        other = Settings(
            method=method, rate_limit=SPEED_LIMIT, target_duration=0.0,
            first_duration=first_part, second_duration=0.5 * ramp,
        )  # fmt: skip
        loop.core.configure(other)
        loop.go(start, STARTING)
    return loop


def follow(loop: ClosedLoop, start: Array, goal: Array, method: str, duration: float) -> Followed:
    """Move between two postures [rad] (D,) in a time [s]."""
    core, arm = loop.core, loop.arm
    planned = Trajectory.to(Setpoint.resting(start), goal, duration)
    if method == OURS:
        core.trajectory(planned.points)
        followed = core.activities.follower.trajectory
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
    return Followed(
        desired.theta, np.array(theta), np.array(tension)[:count], bound, planned.slowed
    )


def settling(loop: ClosedLoop, goal: Array) -> float:
    """Return how long it takes from a target [rad] (D,) until the arm stays near it [s]."""
    last = 0
    loop.target(goal)
    for n in range(round(WATCHED / SAMPLE_TIME)):
        loop.step()
        last = n + 1 if np.linalg.norm(loop.arm.theta - goal) > WITHIN else last
    return SAMPLE_TIME * last


def bounds(arm: Arm, motion: Setpoint) -> Array:
    """Return the least ‖T‖ [N] (3, N) that moves the true body along a path, known exactly.

    By inverse dynamics alone, with the winches' drag, and with friction of wires and joints too;
    the last is known of the first body only, (2, N) of others.
    """
    robot, limits, true = arm.robot, arm.robot.tension, arm.individual
    jacobian, bias = true.muscle_jacobian(motion.theta), limits.bias
    torque = map(robot.kinematics.inverse_dynamics, *motion)
    result = []
    for slope, rigid, velocity in zip(jacobian, torque, motion.velocity):
        speed = slope @ velocity
        dragged = np.minimum(bias + np.maximum(speed, 0.0) / MOTOR_GAIN, limits.limit)
        ways = [(slope, rigid, bias), (slope, rigid, dragged)]
        if isinstance(true, Individual):
            passed_on = np.exp(true.cable_friction * np.sign(speed))
            rubbed = VISCOUS * velocity + true.joint_friction * np.sign(velocity)
            ways.append((passed_on[:, None] * slope, rigid + rubbed, dragged))
        least = [least_tension(*way, limits.limit).tension for way in ways]
        result.append(np.linalg.norm(least, axis=1))
    return np.array(result).T


def circles(
    robot: Robot, mae: Mae, rng: np.random.Generator, count: int
) -> list[tuple[Array, Place]]:
    """Return random circles that can be followed: a posture, and where the hand is at times [s]."""
    found = list[tuple[Array, Place]]()
    for theta, _ in holdable_postures(robot, robot.random_postures(TRIES, rng), 40):
        centre = robot.kinematics.end_effector_pose(theta).translation
        frame, reach, _ = np.linalg.svd(robot.kinematics.end_effector_jacobian(theta)[:3])
        planar = len(reach) < 3 or reach[2] < 1e-6
        axes = frame if planar else np.linalg.qr(rng.normal(size=(3, 3)))[0]

        def place(time: float, centre: Array = centre, axes: Array = axes) -> pin.SE3:
            turn = SPEED / RADIUS * time
            along: Array = RADIUS * (np.cos(turn) * axes[:, 0] + np.sin(turn) * axes[:, 1])
            return pin.SE3(np.eye(3), centre + along)

        at, far = theta, False
        for time in np.linspace(0.0, LAP, 25):
            at, distance, *_ = inverse_kinematics(robot, place(time), at, POSITION)
            far = far or distance > NEAR or bool(lacking(robot, mae, at))
        if not far:
            found.append((theta, place))
        if len(found) == count:
            break
    return found


def circle(loop: ClosedLoop, start: Array, place: Place) -> tuple[Array, Array]:
    """Go round once; return where the hand was to be and where it was [m], each (N, 3)."""
    loop.go(start, STARTING)
    loop.core.pose(place(0.0), False, -1.0)
    loop.wait(1.5)
    wanted, true = [], []
    for n in range(round(LAP / SAMPLE_TIME)):
        if n % EVERY == 0:
            with suppress(MessageError):  # out of reach by a hair: as at the node, nothing changes
                loop.core.pose(place(n * SAMPLE_TIME), False, n * SAMPLE_TIME)
        loop.step()
        wanted.append(place((n + 1) * SAMPLE_TIME).translation)
        true.append(loop.arm.hand.translation)
    loop.check()
    return np.array(wanted), np.array(true)


def measure(study: Study, seed: int) -> Measured:
    """Return the numbers and traces of one individual."""
    mae, rng = study.network(seed), np.random.default_rng([seed, 0x307])
    robot = study.robot
    count = 1 if study.quick else MOTIONS
    arm = study.arm(seed)
    postures = robot.random_postures(TRIES, rng)
    held = holdable_postures(robot, postures, count + 1, arm.individual.muscle_jacobian)
    postures = np.array([theta for theta, _ in held])
    numbers: dict[str, Any] = {'methods': {}}
    traces: dict[str, Any] = {}
    for method in METHODS:
        row: dict[str, float | str] = {}
        for duration in DURATIONS:
            name = f'{duration:.0f}s'
            try:
                loop = loop_at(study.arm(seed), mae, postures[0], method, duration)
                runs = [follow(loop, a, b, method, duration) for a, b in pairwise(postures)]
            except MusculoskeletalError as error:
                if method == OURS:
                    raise
                row[f'left_out_{name}'] = str(error)
                continue
            row |= {f'{key}_{name}': value for key, value in _said(runs).items()}
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
    loop = loop_at(study.arm(seed), mae, postures[0], OURS, 1.0)
    numbers['settle_s'] = float(np.mean([settling(loop, goal) for goal in postures[1:]]))
    laps = [circle(loop, *each) for each in circles(robot, mae, rng, 1 if study.quick else CIRCLES)]
    off = [np.linalg.norm(true - wanted, axis=1).mean() for wanted, true in laps]
    numbers['hand_circle_m'] = float(np.mean(off)) if laps else None
    traces['laps'] = laps
    felt = touch.measure(study, seed)
    return Measured(numbers | felt.numbers, traces | felt.traces)


def _said(runs: list[Followed]) -> dict[str, float]:
    moving = [run.error[: len(run.tension)] for run in runs]
    at = round(SETTLED / SAMPLE_TIME) - 1
    tension, bound = (np.concatenate(part, axis=-1) for part in zip(*[run[2:4] for run in runs]))
    ratio = tension.mean() / bound.mean(axis=1)
    return {
        'track_rad': float(np.mean([error.mean() for error in moving])),
        'settled_rad': float(np.mean([run.error[len(run.tension) + at] for run in runs])),
        **dict(zip(('tension_ratio', 'winches_ratio', 'attainable_ratio'), ratio.tolist())),
        'slowed': float(np.mean([run.slowed for run in runs])),
    }


def motion(_: Study, rows: Rows) -> Plot:
    """Draw the tracking error of the first individual over time."""
    seed, row = first(rows)
    figure, panels = plots.new_figure(11.0, 6.4, 2)
    for panel, duration in zip(panels, DURATIONS, strict=True):
        for method, colour in METHODS.items():
            if (error := row.traces.get(f'{method} {duration:.0f}s')) is None:
                continue  # left out
            told = f'{method}: {error.mean():.3f} rad'
            plots.line(panel, times(len(error)), error, color=colour, label=told, lw=1.2)
        title = f'individual {seed}, motions of {duration:g} s'
        plots.tidy(panel, 'time [s]', '‖θ_desired − θ‖ [rad]', title, legend='right')
    caption = (
        'Distance from the minimum-jerk motion over time, several motions one after the other.'
    )
    return figure, caption


def motion_hand(_: Study, rows: Rows) -> Plot:
    """Draw the circles of the hand, wanted and true, each in its plane."""
    seed, row = first(rows)
    laps = row.traces['laps']
    figure, panels = plots.new_figure(4.0 * max(len(laps), 1), 4.2, 1, max(len(laps), 1))
    for panel, (wanted, true) in zip(panels, laps):
        centre = wanted.mean(axis=0)
        axes = np.linalg.svd(wanted - centre)[2][:2]
        for name, path, style in (
            ('wanted', wanted, {'color': plots.TRUE, 'ls': '--'}),
            ('true', true, {'color': plots.AFTER}),
        ):
            panel.plot(*(1000.0 * axes @ (path - centre).T), label=name, **style)
        panel.set_aspect('equal')
        off = 1000.0 * np.linalg.norm(true - wanted, axis=1).mean()
        plots.tidy(panel, '[mm]', '[mm]', f'mean {off:.1f} mm', legend='below')
    return figure, f'Circles of the hand at {SPEED} m/s by target_pose, individual {seed}.'


PLOTS = motion, motion_hand, touch.forces
EXPERIMENT = Experiment(__doc__, measure, PLOTS, 16.0)
