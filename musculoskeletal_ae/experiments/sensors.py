# SPDX-License-Identifier: Apache-2.0
"""Fewer sensors.

Paper (§II-A). Musashi has joint sensors at few joints, and a marker on the hand takes their place;
what a part of them or none is worth is not measured.

Here. The messages of the default network’s exploration teach learners that see less of them: all
joint sensors; only those of elbows (joints so named, else the last that turns); none; none but a
marker on the hand in one of ten samples, by inverse kinematics as in the estimator; none but an
accelerometer on the link of the hand. All are judged on the held-out motion. "In the ellipsoid" is
the share of its messages whose true angles lie in the ellipsoid of 95 % that the network tells,
with all joint sensors and with none. The arm explored with the network that saw all joint sensors.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.modules import felt_at_rest, seen_by_camera
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.online_learning import See, pupil, teach
from musculoskeletal_ae.experiments.recording import (
    SAMPLE_TIME,
    Recording,
    end_tensions,
    estimation_error,
)
from musculoskeletal_ae.experiments.roles import elbows
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study
from musculoskeletal_ae.learning.collector import MARKER, NONE, SENSOR
from musculoskeletal_ae.learning.covariance import ellipsoids
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics

CAMERA = 10  # messages to one picture, or to one of the accelerometer
SIGHTED = 10  # samples to one that the marker is seen in


def measure(study: Study, seed: int) -> Measured:
    """Teach learners that see less and less of an individual."""
    robot, held_out = study.robot, study.stream(seed, 'held_out')
    rng = np.random.default_rng([seed, 0x5E])
    elbow, hand = elbows(robot), robot.description.end_effector

    def marker(learner: Learner, n: int, theta: Array, _: Array) -> Array | None:
        if n % CAMERA or not sighted(learner):
            return None
        pose = seen_by_camera(robot.kinematics.end_effector_pose(theta), rng)
        guess = learner.mae.estimate(tension[n], length[n]).theta
        return inverse_kinematics(robot, pose, guess).seen

    def tilt(learner: Learner, n: int, theta: Array, _: Array) -> None:
        if n % CAMERA == 0:
            learner.imu(SAMPLE_TIME * n, hand, felt_at_rest(robot, theta, hand, rng))

    ways: dict[str, tuple[str, See]] = {
        'elbow_only': (SENSOR, lambda _l, _n, _t, read: np.where(elbow, read, np.nan)),
        'none': (NONE, lambda *_: None),
        'marker_tenth': (MARKER, marker),
        'imu': (NONE, tilt),
    }
    stream = study.stream(seed, 'exploring')
    length, tension = stream.length, stream.tension
    # The one that explored was taught by all joint sensors.
    networks = {'before': study.network(None, 'default'), 'all': study.network(seed, 'default')}
    for name, (source, see) in ways.items():
        learner = pupil(study, seed, 'default', source)
        teach(learner, zip(*stream, strict=True), see)
        networks[name] = learner.mae
    errors = {f'{name}_rad': estimation_error(mae, held_out) for name, mae in networks.items()}
    numbers: dict[str, float | None] = {**errors}
    for name, key in ('all', 'ellipsoid_share'), ('none', 'none_ellipsoid_share'):
        known = networks[name].covariance is not None
        numbers[key] = ellipsoid_share(networks[name], held_out) if known else None
    return Measured(numbers, {})


def sighted(learner: Learner) -> bool:
    """Whether the marker is seen until the next sample; a full store grows no more."""
    return learner.samples.accepted % SIGHTED == 0


def ellipsoid_share(mae: Mae, recording: Recording) -> float:
    """Return the share of messages whose true θ lies in the ellipsoid of 95 %."""
    assert mae.covariance is not None  # asked by the caller
    tension = end_tensions(mae, recording)
    error = mae.estimate(tension, recording.length).theta - recording.theta
    return float((ellipsoids(mae.covariance, error) <= 1.0).mean())


BARS = {
    'before_rad': 'before learning',
    'none_rad': 'no joint sensors',
    'imu_rad': 'none, accelerometer on the hand',
    'elbow_only_rad': 'sensors of the elbow only',
    'marker_tenth_rad': 'none, marker in 1 of 10 samples',
    'all_rad': 'all joint sensors',
}


def sensors(_: Study | None, rows: Rows) -> Plot:
    """Draw the error that is left with fewer and fewer joint sensors."""
    figure, (panel,) = plots.new_figure(8.0, 3.2)
    means = {key: np.mean([row.numbers[key] for row in rows.values()]) for key in BARS}
    ranked = sorted(BARS, key=means.__getitem__, reverse=True)
    values = {BARS[key]: [row.numbers[key] for row in rows.values()] for key in ranked}
    colours = [plots.BEFORE if key == 'before_rad' else plots.AFTER for key in ranked]
    title = 'Joint-angle error by what the learner knows of the joints'
    plots.ranked_bars(panel, values, colours, 'mean error on held-out motion [rad]', title)
    return figure, (
        'Mean joint-angle error on held-out motion, by what the learner knows of the joints; a dot '
        f'is one of the individuals {", ".join(map(str, rows))}.'
    )


EXPERIMENT = Experiment(__doc__, measure, (sensors,), 24.0)
