# SPDX-License-Identifier: Apache-2.0
"""Fewer sensors.

Paper (§II-A). Musashi has joint sensors at few joints, and a marker on the hand replaces the
others. The paper does not measure the error with fewer or no joint sensors.

Here. Learners with fewer sensors learn from the messages of the default network’s exploration,
which used all joint sensors. All are evaluated on the held-out motion.

- all: all joint sensors
- elbow: only the joint sensors of the elbow (all joints with "elbow" in their names, or else the
  last revolute joint)
- none: no joint sensors
- marker: no joint sensors, but a marker on the hand in one of ten samples, from which the estimator
  computes θ by inverse kinematics
- accelerometer: no joint sensors, but an accelerometer on the hand’s link
- in the ellipsoid: share of the messages whose true joint angles lie within the network’s 95 %
  confidence ellipsoid, with all joint sensors and with none
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.covariance import ellipsoids
from musculoskeletal_ae.emulator.modules import accelerometer_reading, camera_reading
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.online_learning import JointView, new_learner, teach
from musculoskeletal_ae.experiments.recording import (
    SAMPLE_TIME,
    Recording,
    end_tensions,
    estimation_error,
)
from musculoskeletal_ae.experiments.roles import elbows
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study
from musculoskeletal_ae.learning.collector import MARKER, NONE, SENSOR
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics

CAMERA = 10  # receive one message of the camera or the accelerometer for this many muscle messages
SIGHTED = 10  # let the camera detect the marker in one of this many samples


def measure(study: Study, seed: int) -> Measured:
    """Return the errors of learners with different sensors on the messages of an individual."""
    robot, held_out = study.robot, study.stream(seed, 'held_out')
    rng = np.random.default_rng([seed, 0x5E])
    elbow, hand = elbows(robot), robot.description.end_effector

    def marker(learner: Learner, n: int, theta: Array, _: Array) -> Array | None:
        if n % CAMERA or not sighted(learner):
            return None
        pose = camera_reading(robot.kinematics.end_effector_pose(theta), rng)
        guess = learner.mae.estimate(tension[n], length[n]).theta
        return inverse_kinematics(robot, pose, guess).observed_theta

    def tilt(learner: Learner, n: int, theta: Array, _: Array) -> None:
        if n % CAMERA == 0:
            learner.imu(SAMPLE_TIME * n, hand, accelerometer_reading(robot, theta, hand, rng))

    sources: dict[str, tuple[str, JointView]] = {
        'elbow_only': (SENSOR, lambda _l, _n, _t, read: np.where(elbow, read, np.nan)),
        'none': (NONE, lambda *_: None),
        'marker_tenth': (MARKER, marker),
        'imu': (NONE, tilt),
    }
    stream = study.stream(seed, 'exploring')
    length, tension = stream.length, stream.tension
    # The network that controlled the exploration learned from all joint sensors.
    networks = {'before': study.network(None, 'default'), 'all': study.network(seed, 'default')}
    for name, (source, view) in sources.items():
        learner = new_learner(study, seed, 'default', source)
        teach(learner, zip(*stream, strict=True), view)
        networks[name] = learner.mae
    errors = {f'{name}_rad': estimation_error(mae, held_out) for name, mae in networks.items()}
    numbers: dict[str, float | None] = {**errors}
    for name, key in ('all', 'ellipsoid_share'), ('none', 'none_ellipsoid_share'):
        known = networks[name].covariance is not None
        numbers[key] = ellipsoid_share(networks[name], held_out) if known else None
    return Measured(numbers, {})


def sighted(learner: Learner) -> bool:
    """Return whether the emulated camera now detects the marker.

    It detects the marker after every SIGHTED-th accepted rest sample, until the next is accepted.
    """
    # Count accepted samples, because the number of stored ones is bounded.
    return learner.samples.accepted % SIGHTED == 0


def ellipsoid_share(mae: Mae, recording: Recording) -> float:
    """Return the share of messages whose true θ lies in the 95 % ellipsoid around the estimate."""
    assert mae.covariance is not None  # checked by the caller
    tension = end_tensions(mae, recording)
    error = mae.estimate(tension, recording.length).theta - recording.theta
    return float((ellipsoids(mae.covariance, error) <= 1.0).mean())


BARS = {
    'before_rad': 'before learning',
    'none_rad': 'no joint sensors',
    'imu_rad': 'no joint sensors, accelerometer on the hand',
    'elbow_only_rad': 'joint sensors of the elbow only',
    'marker_tenth_rad': 'no joint sensors, marker in 1 of 10 samples',
    'all_rad': 'all joint sensors',
}


def sensors(_: Study | None, rows: Rows) -> Plot:
    """Draw the errors of the learners with each set of sensors."""
    figure, (panel,) = plots.new_figure(8.0, 3.2)
    measured = {key: [row.numbers[key] for row in rows.values()] for key in BARS}
    ranked = sorted(BARS, key=lambda key: plots.mean_of_known(measured[key])[0], reverse=True)
    values = {BARS[key]: measured[key] for key in ranked}
    colours = [plots.BEFORE if key == 'before_rad' else plots.AFTER for key in ranked]
    title = 'Joint-angle error with fewer joint sensors'
    plots.ranked_bars(panel, values, colours, 'mean error on held-out motion [rad]', title)
    return figure, (
        'Mean joint-angle error on held-out motion, by the sensors that the learner uses. Each dot '
        f'is one of the individuals {", ".join(map(str, rows))}.'
    )


EXPERIMENT = Experiment(__doc__, measure, (sensors,), 24.0)
