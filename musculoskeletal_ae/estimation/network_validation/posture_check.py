# SPDX-License-Identifier: Apache-2.0
"""Checks a candidate network on fixed random states of the geometric model.

①, ② and ③ are the masks of the network: with ① it computes the muscle lengths l from joint angles
θ and tensions T, with ② θ from T and l, and with ③ T from θ and l. G is the muscle Jacobian ∂l/∂θ.

    ①         must reproduce θ, T, l and G of the geometric model
    ②, ③      must reproduce θ, T and l, if they are given the l of ①

The lengths of a real arm differ from the model's by centimetres, so ② and ③ are compared with the
lengths of ① rather than with the model's. Most of the difference is elongation, because a series
elastic element may be much softer than its model. ① is therefore compared with softened lengths of
the model: the elongation of each muscle is multiplied by one factor, which is fitted to the
differences between ① and the model. Differences that are the same in all states do not change the
factor.

A further check is the *scale*: the factor by which all route lengths of ① differ from those of the
model, after the elongations have been removed. Errors of single muscles average out: the scale was
0.84 to 1.11 for healthy networks of both presets, on arm26 and musashi_left_arm, with both emulator
models. The error of the scale is its distance from 1.

The relative error of a joint or muscle is its root mean square error divided by the standard
deviation of the true values. A network with a constant output has a relative error of 1. The *mean
error* of a joint is the magnitude of its mean difference, divided by the same standard deviation.
LIMITS holds the largest permitted values.

The muscles may determine a joint only poorly, for example because several postures have the same
lengths. For such a joint, the permitted relative error of θ is UNDETERMINED times that of the best
affine map from T and l to θ. This does not apply to the mean error.
"""

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.network_validation.comparison import Comparison
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.robot.equilibrium_states import equilibrium_states, has_followers
from musculoskeletal_ae.robot.robot import Robot

POSTURES = 64  # check a network on this many fixed random states of the geometric model
SEARCHED = 60  # search equilibria from this many random postures
#: name of the error of the scale: the factor by which all route lengths differ from the model's
SCALE = 'scale of l by ①'

#: reject a network with a larger relative error than these; healthy networks have smaller ones
#: (`python -m bench gate`)
LIMITS = {
    'θ by ①': 0.6,
    'T by ①': 1.35,  # permit less than √2, the error after an exchange of two muscles
    'l by ①': 1.7,
    'θ by ②': 1.3,  # permit more than 1, the error of a joint that the muscles do not determine
    'T by ②': 1.35,
    'l by ②': 0.6,
    'θ by ③': 0.7,
    'T by ③': 13.0,
    'l by ③': 0.6,
    'G by ①': 1.6,
    SCALE: 0.3,
    'mean θ by ①': 0.6,
    'mean θ by ③': 0.7,
}
#: divide the error of a length by at least this standard deviation [m]: a small error of a muscle
#: that hardly changes its length is then no large relative error
LEAST_SPREAD = 0.04
LEAST_ARM = 0.01  # divide errors of the muscle Jacobian by moment arms of at least this size [m]
#: before comparing lengths, multiply the modelled elongation of each muscle by a factor between
#: these two: the constants of a real elastic element may be e^±1.5 times those of the model
STIFFEST, SOFTEST = 0.2, 4.5
#: use at least this sum of squared elongations as a divisor [m²]; a muscle without elongation has 0
INELASTIC = 1e-12
#: for a joint that the muscles determine poorly, permit this multiple of the error that the best
#: affine map from tensions and lengths to angles makes
UNDETERMINED = 1.2
#: fit the affine map to this many states, and measure its error on as many others
AFFINE = 1000


class PostureCheck:
    """Checks networks on fixed random states of the geometric model of one robot.

    Attributes:
        theta: Joint angles [rad], (N, D).
        tension: Tensions [N], (N, M).
        length: Muscle lengths of the geometric model [m], (N, M).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.theta, self.tension, self.length = self._states(POSTURES)
        self._elongation = robot.routes.relative_lengths(self.theta) - self.length
        self._centred = self._elongation - self._elongation.mean(axis=0)
        slope = robot.series_elastic.length_slope(self.tension)[..., None]
        self._jacobian = robot.routes.muscle_jacobian(self.theta) * (1.0 - slope)

    def faults(self, mae: Mae) -> Iterator[str | None]:
        """Yield a text for each fault of a network, and None after each piece of work."""
        for item in self.errors(mae):
            yield None
            if item is None:
                continue
            name, error = item
            limit = np.full(len(error), LIMITS[name])
            if name.startswith('θ') and not error.max() <= LIMITS[name]:
                limit = np.maximum(limit, self._undetermined)
            owners = self._robot.joints if 'θ' in name else self._robot.muscles
            owners = ('all muscles',) if name == SCALE else owners
            source = 'the geometric model' if name.endswith('①') else 'the lengths of ①'
            reference = f'relative to the spread, from {source}'
            yield from Comparison(name, owners, error, limit, reference).faults()

    def errors(self, mae: Mae) -> Iterator[tuple[str, Array] | None]:
        """Yield the name of each error in LIMITS with its values, one for each joint or muscle.

        The values are relative to the standard deviation of the true values. Between pairs, None
        may be yielded, so that the caller can do other work.
        """
        own_length = mae.lengths(self.theta, self.tension)
        for mask, symbol in zip(Mask, '①②③', strict=True):
            reconstructed = mae.decode(mae.encode(mask, self.theta, self.tension, own_length))
            length = self._softened(own_length) if symbol == '①' else own_length
            truth = self.theta, self.tension, length
            for name, value, true in zip('θTl', reconstructed, truth, strict=True):
                usual = self.length if name == 'l' and symbol == '①' else true
                spread = np.maximum(usual.std(axis=0), LEAST_SPREAD if name == 'l' else 1e-9)
                yield f'{name} by {symbol}', _root_mean_square(value - true) / spread
                if name == 'θ' and symbol != '②':
                    yield f'mean θ by {symbol}', np.abs((value - true).mean(axis=0)) / spread
        yield SCALE, np.array([abs(self._scale(own_length) - 1.0)])
        error = np.empty_like(self._jacobian)
        for rows in np.array_split(np.arange(POSTURES), 4):
            jacobian = mae.muscle_jacobian(self.theta[rows], self.tension[rows])
            error[rows] = jacobian - self._jacobian[rows]
            yield None
        muscle_count = error.shape[1]
        size, moment_arm = (
            _root_mean_square(part.swapaxes(1, 2).reshape(-1, muscle_count))
            for part in (error, self._jacobian)
        )
        yield 'G by ①', size / np.maximum(moment_arm, LEAST_ARM)

    def _slope_over_elongation(self, length: Array) -> Array:
        """Return how much each length changes per metre of the muscle's elongation, (M,).

        This is the slope of a linear regression over the fixed states.

        Args:
            length: Lengths at the fixed states [m], (N, M).
        """
        products = (length * self._centred).sum(axis=0)
        squares = np.square(self._centred).sum(axis=0)
        slope: Array = products / np.maximum(squares, INELASTIC)
        return slope

    def _softened(self, length: Array) -> Array:
        """Return the lengths of the geometric model with softer or stiffer elastic elements.

        The elongation of each muscle is multiplied by a factor, which is fitted to a network.

        Args:
            length: Lengths that the network computes at the fixed states [m], (N, M).

        Returns:
            The lengths of the model with these elongations [m], (N, M).
        """
        factor = 1.0 - self._slope_over_elongation(length - self.length)
        factor = np.clip(factor, STIFFEST, SOFTEST)
        return self.length - (factor - 1.0) * self._elongation

    def _scale(self, length: Array) -> float:
        """Return the factor by which a network's route lengths differ from those of the model.

        Args:
            length: Lengths that the network computes at the fixed states [m], (N, M).
        """
        routes, read = (
            part - part.mean(axis=0) - self._slope_over_elongation(part) * self._centred
            for part in (self.length + self._elongation, length)
        )
        return float((routes * read).sum() / np.square(routes).sum())

    def _states(self, count: int) -> tuple[Array, Array, Array]:
        """Draw random states of the geometric model, always the same for the same `count`.

        Every second state of a robot with fewer muscles than joints is an equilibrium.

        Returns:
            Joint angles [rad], (N, D); tensions [N], (N, M); muscle lengths [m], (N, M).
        """
        robot, rng = self._robot, np.random.default_rng(0)
        theta = robot.random_postures(count, rng)
        share = rng.uniform(size=(count, robot.muscle_count))
        tension = robot.tension.bias + share * (robot.tension.limit - robot.tension.bias)
        if has_followers(robot):
            # With ②, tensions and lengths determine θ only where the robot can rest.
            rests = equilibrium_states(robot, len(theta[::2]), rng, SEARCHED)
            if rests is not None:
                theta[::2], tension[::2] = rests
        return theta, tension, robot.muscle_lengths(theta, tension)

    @cached_property
    def _undetermined(self) -> Array:
        """Permitted relative error of each joint, (D,), for joints that muscles determine poorly.

        It is a multiple of the error of the best affine map from tensions and lengths to angles.
        """
        theta, tension, length = self._states(2 * AFFINE)
        ones = np.ones((2 * AFFINE, 1))
        inputs = np.hstack([ones, tension / tension.std(), length / length.std()])
        affine = np.linalg.lstsq(inputs[:AFFINE], theta[:AFFINE], rcond=None)[0]
        error: Array = _root_mean_square((inputs @ affine - theta)[AFFINE:]) / theta.std(axis=0)
        return UNDETERMINED * error


def _root_mean_square(error: Array) -> Array:
    size: Array = np.sqrt(np.square(error).mean(axis=0))
    return size
