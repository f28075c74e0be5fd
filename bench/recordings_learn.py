# SPDX-License-Identifier: Apache-2.0
"""Models that estimate θ in recordings: this package, and the statics of a soft link.

Every model maps lengths (and efforts) to θ. `regression` has the models that know nothing of a
robot.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from bench.recordings_cases import Case
from bench.recordings_read import Body, Run
from bench.regression import Predict
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import learn_table
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.load import LoadTree
from musculoskeletal_ae.tables.table import Table

INITIAL_STEPS = 1000
#: Assign this tension above T_bias [N] to a strong effort, which is the 95 % quantile of the
#: efforts in the training data. Tensions are proportional to efforts.
STRONG = 40.0

#: a model: returns the estimated θ [rad], (N, D), of the N rows of a run
Model = Callable[[Run], Array]


def error(model: Model, run: Run) -> float:
    """Return the mean distance of the estimated θ from the measured one [rad]."""
    return float(np.linalg.norm(np.nan_to_num(model(run) - run.theta), axis=1).mean())


def regression(fit: Callable[[Array, Array], Predict], training: Run, with_effort: bool) -> Model:
    """Return a regression for θ from lengths, or from lengths and efforts; unmeasured θ stays 0."""

    def inputs(run: Run) -> Array:
        return np.hstack([run.length, run.effort]) if with_effort else run.length

    predict = fit(inputs(training), np.nan_to_num(training.theta))
    return lambda run: predict(inputs(run))


def tensions(body: Body, robot: Robot, training: Run, with_effort: bool) -> Callable[[Run], Array]:
    """Return a function that computes the tensions of a run [N], (N, M).

    Efforts may be measured tensions. Otherwise, a tension is T_bias plus a multiple of the effort
    of the motor. Without efforts, it is the tension that the robot assumes for muscles without a
    tension sensor.
    """
    if not with_effort:
        return lambda run: np.tile(robot.actuation.assumed_tension, (len(run.length), 1))
    if body.measures_tension:
        return lambda run: np.clip(run.effort, 0.0, robot.tension.max)
    strong = np.quantile(np.abs(training.effort), 0.95)

    def scaled(run: Run) -> Array:
        above = np.maximum(run.effort, 0.0) * (STRONG / strong)
        return np.clip(robot.tension.bias + above, 0.0, robot.tension.max)

    return scaled


@cache
def described(body: Body, with_effort: bool) -> tuple[Robot, Mae]:
    """Return the robot of a body, and a network of its geometric model.

    With efforts, the robot measures tensions; without, tensions are unknown.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = 'sensor' if with_effort else 'none'
        robot = Robot.load(body.write(Path(folder) / 'robot', source))
    return robot, initial_mae(robot, steps=INITIAL_STEPS, seed=0)


def package(case: Case, robot: Robot, mae: Mae, with_effort: bool, seed: int = 0) -> Model:
    """Return a model that estimates θ by the network that the package learns from a case.

    It learns as `train --from-csv` does, with one row for each resting posture. With efforts, it
    uses the efforts as tensions.

    Args:
        case: The case.
        robot: The robot of the case.
        mae: The first network.
        with_effort: Whether efforts are used.
        seed: Random seed of the training.
    """
    tension = tensions(case.body, robot, case.training, with_effort)
    learner = Learner(robot, mae, seed=seed)
    rows = case.training
    known = tension(rows) if with_effort else None
    warning = learn_table(learner, Table.of(robot, rows.theta, rows.length, known))
    if warning:
        print(f'{case.name}: {warning}', flush=True)
    return network(learner.mae, tension)


def network(mae: Mae, tension: Callable[[Run], Array]) -> Model:
    """Return a model that estimates θ by a network, with tensions from the function `tension`."""
    return lambda run: mae.estimate(tension(run), run.length).theta


class Statics:
    """Computes rest postures by the balance of springs, weight, payload and elastic tendons.

        0 = g(θ) + K θ − λ m Jᵀ F₁ + G(θ)ᵀ T,     T = k max(0, f_geo(θ) − γ l + p)

    g is the torque that holds the weight of the link, J the Jacobian of its tip, F₁ the weight of 1
    kg, G the muscle Jacobian, and f_geo the length of the route. The lengths l are known, and the
    tensions T follow from them. The spring K, the stiffness k of the tendons, the scale γ of the
    spools, the pretension p and the share λ of the payload are fitted to rest samples with known
    payloads m. The orientation of the IMU in each of these runs is fitted as well; in other runs it
    is taken to be 0.
    """

    #: means and standard deviations of the prior of log K [N·m/rad], log k [N/m], log γ, p [m], λ
    MEAN = np.array([0.0, np.log(3000.0), 0.0, 0.001, 1.0])
    SPREAD = np.array([1.0, 1.5, 0.1, 0.002, 0.5])
    #: standard deviations of the IMU's orientation in the prior, and of θ in a rest sample [rad]
    TILT, NOISE = 0.02, 0.015
    ROUNDS = 15
    CONVERGED = 1e-10  # end the search for the postures once a step is no larger than this [rad]

    def __init__(self, robot: Robot, rests: list[Run]) -> None:
        """Fit the unknowns to the rest samples of runs with different payloads."""
        self._robot, self._rests = robot, rests
        tilts = np.zeros(2 * len(rests))
        self._mean = np.concatenate([self.MEAN, tilts])
        self._spread = np.concatenate([self.SPREAD, tilts + self.TILT])
        fits = []
        for softer in (0.0, -1.0, -2.0):
            start = self._mean.copy()
            start[1] += softer * self.SPREAD[1]
            fits.append(least_squares(self._residuals, start, x_scale=self._spread))
        self.values = min(fits, key=lambda fit: fit.cost).x

    def _residuals(self, values: Array) -> Array:
        parts = [(values - self._mean) / self._spread]
        for run, tilt in zip(self._rests, values[5:].reshape(-1, 2), strict=True):
            off = self.posture(run, values) + tilt - run.theta
            parts.append((off / self.NOISE).ravel())
        return np.concatenate(parts)

    def posture(self, run: Run, values: Array | None = None) -> Array:
        """Return the postures at which the forces of a run are in balance [rad], (N, D).

        The tendon lengths and the payload are those of the run. `values` are the fitted unknowns;
        by default those found from the rest samples.
        """
        spring, stiff, scale, pretension, share = (self.values if values is None else values)[:5]
        robot = self._robot.with_elasticity(
            JointElasticity(np.exp(spring) * np.eye(2), np.zeros(2), np.zeros(2))
        )
        load, eye = LoadTree.of(robot.kinematics).load, np.eye(2)
        wrench = np.tile([0.0, 0.0, -9.81 * share * run.load, 0.0, 0.0, 0.0], (len(run.length), 1))
        length = np.exp(scale) * run.length
        theta = np.zeros_like(run.theta)
        for _ in range(self.ROUNDS):
            absolute = robot.routes.absolute_lengths(theta) - robot.routes.length_at_zero
            jacobian = robot.routes.muscle_jacobian(theta)
            over = absolute - length + pretension
            held, slope = load(theta, wrench)
            stiffness = np.exp(stiff) * (over > 0.0)
            torque = held + np.einsum('nmd,nm->nd', jacobian, stiffness * over)
            slope = slope + np.einsum('nmi,nm,nmj->nij', jacobian, stiffness, jacobian)
            # With slack tendons, a payload may make the link unstable: the slope is then not
            # positive definite, and the Newton step would not lead to an equilibrium.
            least = np.linalg.eigvalsh(slope)[:, 0]
            slope = slope + np.maximum(0.0, 0.2 - least)[:, None, None] * eye
            step = np.linalg.solve(slope, torque[..., None])[..., 0]
            theta = np.clip(theta - np.clip(step, -0.2, 0.2), robot.lower, robot.upper)
            if np.abs(step).max() < self.CONVERGED:
                break
        return theta


def payload_share(runs: list[Run], with_effort: bool, with_theta: bool) -> float:
    """Estimate each run's payload by ridge regression on the other runs; return R².

    The inputs are the means of lengths, and optionally efforts and θ, at the last rest of each run.
    R² is 1 if all payloads are estimated exactly, and 0 or less if the mean payload of the other
    runs is at least as good an estimate.
    """
    rests = [run.at_rest(slice(-1, None)) for run in runs]
    parts = [[run.length[0]] for run in rests]
    for row, run in zip(parts, rests, strict=True):
        row += [run.effort[0]] * with_effort + [run.theta[0]] * with_theta
    values, load = (
        np.array([np.concatenate(row) for row in parts]),
        np.array([r.load for r in runs]),
    )
    values = (values - values.mean(axis=0)) / values.std(axis=0)
    off, plain = np.empty(len(runs)), np.empty(len(runs))
    for n in range(len(runs)):
        rest = np.arange(len(runs)) != n
        x = np.c_[values[rest], np.ones(rest.sum())]
        ridge = x.T @ x + np.diag([1.0] * values.shape[1] + [0.0])
        weight = np.linalg.solve(ridge, x.T @ load[rest])
        off[n] = np.append(values[n], 1.0) @ weight - load[n]
        plain[n] = load[rest].mean() - load[n]
    return float(1.0 - (off @ off) / (plain @ plain))


def bend_gain(run: Run, azimuths: Array) -> float:
    """Return the slope of the bend at rest over the commanded bend [rad/m].

    Args:
        run: The run, which contains rests.
        azimuths: Azimuth of each tendon [rad], (M,). With these, the tendon lengths [m] give the
            commanded bend in two directions.
    """
    out = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    rest = run.at_rest()
    wound = -rest.length @ out
    wound, theta = wound - wound.mean(axis=0), rest.theta - rest.theta.mean(axis=0)
    return float((wound * theta).sum() / (wound * wound).sum())


def effort_slope(run: Run, azimuths: Array) -> float:
    """Return the slope of the efforts at rest over the commanded bend [unit of the effort per m].

    Args:
        run: The run, which contains rests.
        azimuths: Azimuth of each tendon [rad], (M,). With these, the tendon lengths [m] give the
            commanded bend in two directions.
    """
    out = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    rest = run.at_rest()
    wound, effort = -rest.length @ out, rest.effort @ out
    return float((wound * effort).sum() / (wound * wound).sum())
