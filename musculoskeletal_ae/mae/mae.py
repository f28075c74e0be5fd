# SPDX-License-Identifier: Apache-2.0
"""The trained Musculoskeletal AutoEncoder for inference: numpy only, immutable, fast.

    z = f_encode(θ, T, l, mask),   (θ, T, l) = f_decode(z)

(paper, §III-A). Inputs and outputs are in SI units. The constructor folds the units of the network,
its standardisation and the constant mask inputs into the first and last layers. One estimate
therefore computes only six small matrix products and the activations between them.

The products use single precision, because the weights of a large body then fit into a core's cache.
The rounding error of 1e-6 is far below the error of a network. Inputs and outputs are arrays of
double precision.

Here ①(θ, T) are the lengths that the network reconstructs from θ and T, and ② reconstructs (θ, T,
l) from measured T and l. Sensor values of isolated muscles have no influence. If muscles are
isolated, θ is the most likely posture for the lengths of all other muscles:

    θ = argmin eᵀ Σ⁻¹ e + ‖(θ − θ̄)/s‖²,  e = l − ①(θ, T) of the muscles that are not isolated

The length of each isolated muscle is then replaced by ①(θ, T), and ② gives T and l of all muscles.

θ̄ and s are the mean and standard deviation of θ in the training data. Σ is the covariance of the
length residuals of ② on the healthy arm. These residuals lack the part that an error of θ explains,
because ② fits θ to the same lengths. Generalised least squares give the same θ with or without that
part, for any subset of the muscles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints, Singles
from musculoskeletal_ae.gauss_newton import minimise_each, whitening
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, TouchStatistics
from musculoskeletal_ae.mae.units import (
    LENGTH_SCALE,
    ActivationName,
    Mask,
    State,
    scale_vector,
    visible,
)
from musculoskeletal_ae.robot.groups import Group, union
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.signals.friction import Transmission

Layer = tuple[Array, Array]  # weight (out, in) and bias (out,) of one layer

# Constants of the estimate with isolated muscles.
ROUNDS = 15  # end the fit of a posture to lengths after this many Gauss–Newton steps
#: add sensor noise of this standard deviation to the covariance Σ of the length residuals [m]
LENGTH_NOISE = 0.0003
#: assume this standard deviation of each length residual [m] if the checkpoint has no statistics
LENGTH_SPREAD = 0.003


class BlockDiagonal:
    """A weight (in, out) that consists of blocks, each with its own outputs.

    Blocks may share inputs.
    """

    __array_ufunc__ = None  # makes numpy call __rmatmul__ for x @ weight

    def __init__(
        self,
        blocks: Sequence[Singles],
        into: Ints | None,
        out: Ints | None,
        starts: Ints | None = None,
    ) -> None:
        """Combine blocks.

        Args:
            blocks: Weights of the blocks, each (in, out).
            into: Indices of x that are the inputs of the blocks, one block after another; None if x
                already has this order.
            out: Indices that bring the outputs of the blocks, one block after another, into the
                order of the result; None if the result has the order of the blocks.
            starts: If given, bring the outputs into the order `out`, and sum them from each of
                these places to the next. The transposed weight of blocks that share inputs needs
                this.
        """
        ends = np.cumsum([0, *map(len, blocks)]).tolist()
        self._blocks = [*zip(map(slice, ends, ends[1:]), blocks)]
        self._into, self._out, self._starts = into, out, starts

    def __rmatmul__(self, x: Singles) -> Singles:
        """Return x @ weight, shape (..., out), for x (..., in)."""
        if self._into is not None:
            x = x[..., self._into]
        parts = [product(x[..., into], block) for into, block in self._blocks]
        result: Singles = np.concatenate(parts, axis=-1)
        # `take` keeps rows contiguous in memory, like a matrix product; [..., out] would not.
        if self._out is not None:
            result = result.take(self._out, axis=-1)
        if self._starts is not None:
            result = np.add.reduceat(result, self._starts, axis=-1)
        return result

    @cached_property
    def T(self) -> BlockDiagonal:
        """The transposed weight."""
        into, out = (
            None if p is None else p.argsort(kind='stable') for p in (self._out, self._into)
        )
        starts = None
        if self._into is not None and len(np.unique(self._into)) < len(self._into):
            starts = np.unique(np.sort(self._into), return_index=True)[1]
        return BlockDiagonal([block.T for _, block in self._blocks], into, out, starts)


def product(x: Singles, weight: Singles | BlockDiagonal) -> Singles:
    """Return x @ weight, shape (..., out), for x (..., in).

    This function calls `dot` where possible, because the operator @ takes 0.4 µs longer: as much as
    the whole product of one row with a layer.
    """
    if x.ndim > 2 or isinstance(weight, BlockDiagonal):
        return x @ weight
    result: Singles = x.dot(weight)
    return result


class Activation(NamedTuple):
    """An activation h(u) with u = gain · x.

    Attributes:
        value: Returns h(u); may overwrite u.
        with_slope: Returns h and dh/du at u + bias; may overwrite u.
        gain: Factor from x to u; the weights of the layer before the activation include it.
    """

    value: Callable[[Singles], Singles]
    with_slope: Callable[[Singles, Singles], tuple[Singles, Singles]]
    gain: float


def _tanh(u: Singles) -> Singles:
    return np.tanh(u, out=u)


def _tanh_slope(u: Singles, bias: Singles) -> tuple[Singles, Singles]:
    u += bias
    h = _tanh(u)
    slope: Singles = 1.0 - h * h
    return h, slope


def _silu(u: Singles) -> Singles:
    # x σ(x) = u t with u = x/2 and t = 1 + tanh u. This form cannot overflow and needs only one
    # temporary array.
    result: Singles = np.tanh(u)
    result += 1.0
    result *= u
    return result


def _silu_slope(u: Singles, bias: Singles) -> tuple[Singles, Singles]:
    # h = u t and dh/du = t + h (2 − t). Three arrays suffice, so a batch stays in the cache.
    u += bias
    t = np.tanh(u)
    t += 1.0
    u *= t
    slope: Singles = np.subtract(2.0, t)
    slope *= u
    slope += t
    return u, slope


def _linear(u: Singles) -> Singles:
    return u


def _linear_slope(u: Singles, bias: Singles) -> tuple[Singles, Singles]:
    u += bias
    return u, np.ones(1, np.float32)


#: activations by their names in a checkpoint
ACTIVATIONS = {
    'tanh': Activation(_tanh, _tanh_slope, 1.0),
    'silu': Activation(_silu, _silu_slope, 0.5),
}
#: no activation: join encoder and decoder by this, because the latent layer is linear
LINEAR = Activation(_linear, _linear_slope, 1.0)


@dataclass(frozen=True, eq=False)
class Stack:
    """A sequence of layers x @ weight + bias, with an activation after each layer except the last.

    The weights (in, out) before an activation include its gain. Inputs and outputs have double
    precision; intermediate values have single precision.
    """

    layers: tuple[tuple[Singles | BlockDiagonal, Singles], ...]
    activations: tuple[Activation, ...]

    @cached_property
    def _back(self) -> list[Singles | BlockDiagonal]:
        """The transposed weights, last layer first, contiguous for faster products."""
        return [
            weight.T if isinstance(weight, BlockDiagonal) else np.ascontiguousarray(weight.T)
            for weight, _ in self.layers[::-1]
        ]

    def __call__(self, values: Array) -> Array:
        """Return the output (..., out) for an input (..., in)."""
        x = values.astype(np.float32)
        for (weight, bias), activation in zip(self.layers, self.activations):
            x = product(x, weight)
            x += bias
            x = activation.value(x)
        weight, bias = self.layers[-1]
        return (product(x, weight) + bias).astype(np.float64)

    def with_pullback(self, values: Array) -> tuple[Array, Callable[[Array], Array]]:
        """Return the output and its pullback: a function that maps dL/d(output) to dL/d(input)."""
        x, slopes = values.astype(np.float32), []
        for (weight, bias), activation in zip(self.layers, self.activations):
            x, slope = activation.with_slope(product(x, weight), bias)
            slopes.append(slope)
        last, last_bias = self.layers[-1]

        def pullback(by_output: Array) -> Array:
            gradient, (first, *others) = by_output.astype(np.float32), self._back
            gradient = product(gradient, first)
            for weight, slope in zip(others, slopes[::-1], strict=True):
                gradient *= slope
                gradient = product(gradient, weight)
            return gradient.astype(np.float64)

        return (product(x, last) + last_bias).astype(np.float64), pullback

    def tangent(self, values: Array, directions: Array) -> tuple[Array, Array]:
        """Return the output and its derivatives along K directions of the input.

        Args:
            values: The input, (..., in).
            directions: Directions of the input, (..., K, in).

        Returns:
            The output (..., out) and its directional derivatives (..., K, out).
        """
        x, tangent = values.astype(np.float32), directions.astype(np.float32)
        for i, (weight, bias) in enumerate(self.layers):
            # Multiply all rows at once: numpy would multiply each (K, in) matrix separately, which
            # takes twice as long.
            shape = tangent.shape[:-1]
            if len(shape) > 1:
                tangent = tangent.reshape(-1, tangent.shape[-1])
            x, tangent = product(x, weight), product(tangent, weight)
            if len(shape) > 1:
                tangent = tangent.reshape(*shape, -1)
            if i < len(self.activations):
                x, slope = self.activations[i].with_slope(x, bias)
                tangent = tangent * slope[..., None, :]
        x += bias
        return x.astype(np.float64), tangent.astype(np.float64)


def side_by_side(
    stacks: Sequence[Stack], into: Ints | None = None, out: Ints | None = None
) -> Stack:
    """Put stacks side by side: return one stack that computes all with block-diagonal layers.

    Args:
        stacks: The stacks; all have equally many layers.
        into: Indices of the inputs of the stacks, one stack after another; None if the input
            already has this order.
        out: Indices that bring the outputs, one stack after another, into the order of the result;
            None to keep them.
    """
    if len(stacks) == 1:
        return stacks[0]
    layers = list[tuple[BlockDiagonal, Singles]]()
    for i, level in enumerate(zip(*(stack.layers for stack in stacks), strict=True)):
        ends = into if i == 0 else None, out if i == len(stacks[0].layers) - 1 else None
        weights, biases = zip(*level, strict=True)
        bias = np.concatenate(biases)
        layers.append((BlockDiagonal(weights, *ends), bias if ends[1] is None else bias[out]))
    return Stack(tuple(layers), stacks[0].activations)


@dataclass(frozen=True, eq=False)
class Mae:
    """A trained network, with the statistics and other data that its checkpoint contains."""

    joints: tuple[str, ...]  # D names, in the order of θ
    muscles: tuple[str, ...]  # M names, in the order of T and l
    preset: str
    activation: ActivationName
    #: weight (out, in) and bias (out,) in scaled, standardised units, group by group
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]
    mean: Array  # mean by which scaled (θ, T, l) are standardised, (D+2M,)
    std: Array  # standard deviation by which scaled (θ, T, l) are standardised, (D+2M,)
    version: int = 0  # number that the learner gives to each new network; higher ones are newer
    training: str = ''  # description of the training, for people
    anomaly: AnomalyStatistics | None = None  # statistics of the residuals on healthy data
    #: tendon friction, and residual torques of the healthy arm; None if not yet learned
    touch: TouchStatistics | None = None
    #: covariance of θ_est − θ [rad²], (D, D); None if not yet learned
    covariance: Array | None = None
    #: how far the learned lengths may be wrong over the workspace [m], (M,), without their means
    #: (`body_model.covariance.length_spread`); None if not yet learned
    length_spread: Array | None = None
    #: learned springs and measured damping of the joints; None if neither is known
    elasticity: JointElasticity | None = None
    #: groups of joints and muscles, each with a block of the network; () for one block
    groups: tuple[Group, ...] = ()
    #: for each block, the index of its base, whose inputs and part of z it uses as well, as a
    #: finger uses those of the wrist; its own index without a base; () if no block has a base
    bases: tuple[int, ...] = ()
    isolated: tuple[int, ...] = ()  # indices of isolated muscles in T and l
    _enter: dict[Mask, Stack] = field(init=False, repr=False)
    _leave: Stack = field(init=False, repr=False)
    _leave_length: Stack = field(init=False, repr=False)
    #: maps z (..., D+M) to scaled (θ, T, l) as one array (..., D+2M)
    decode_scaled: Stack = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Freeze the arrays and fold units, standardisation and masks into the layers."""
        mean, std = map(_frozen, (self.mean, self.std))
        encoder, decoder = (
            tuple((_frozen(weight), _frozen(bias)) for weight, bias in stack)
            for stack in (self.encoder, self.decoder)
        )
        joints, muscles = len(self.joints), len(self.muscles)
        scale = scale_vector(joints, muscles)
        activation = ACTIVATIONS[self.activation]
        groups = self.groups or (Group.whole(joints, muscles),)
        bases = complete_bases(self.bases, len(groups))
        enter: dict[Mask, list[Stack]] = {mask: [] for mask in Mask}
        leave, leave_length, leave_scaled = list[Stack](), list[Stack](), list[Stack]()
        columns = [group.columns(joints, muscles) for group in groups]
        groups_read = read_groups(groups, bases)
        read_columns = [group.columns(joints, muscles) for group in groups_read]
        depth = len(encoder) // len(groups)
        for g, (own, read) in enumerate(zip(columns, read_columns, strict=True)):
            layers, sizes = slice(g * depth, (g + 1) * depth), tuple(map(len, groups[g]))
            (first, first_bias), *rest = encoder[layers]
            after = tuple(_transposed(*layer) for layer in rest)
            for mask, stacks in enter.items():
                selected = visible(mask, *map(len, groups_read[g]))
                weight = first[:, : len(read)][:, selected] / std[read][selected]
                constant = first[:, len(read) :] @ np.array(mask.value, dtype=float)
                bias = first_bias + constant - weight @ mean[read][selected]
                layer = _transposed(weight * scale[read][selected], bias)
                stacks.append(_stack((layer, *after), activation))
            *rest, (last, last_bias) = decoder[layers]
            before = tuple(_transposed(*layer) for layer in rest)
            weight, bias = last * std[own][:, None], last_bias * std[own] + mean[own]
            si_weight, si_bias = weight / scale[own][:, None], bias / scale[own]
            lengths = si_weight[-sizes[1] :], si_bias[-sizes[1] :]
            for stacks, final in (
                (leave, (si_weight, si_bias)),
                (leave_length, lengths),
                (leave_scaled, (weight, bias)),
            ):
                stacks.append(_stack((*before, _transposed(*final)), activation))
        inputs = np.concatenate(read_columns)
        out = np.argsort(np.concatenate(columns))
        out_length = np.argsort(np.concatenate([group.muscles for group in groups]))

        def entered(mask: Mask) -> Ints:
            selected = visible(mask, joints, muscles)
            places: Ints = (np.cumsum(selected) - 1)[inputs[selected[inputs]]]
            return places

        into = None
        if bases != tuple(range(len(groups))):
            into = np.concatenate(latent_places(groups, bases))

        vars(self).update(  # a frozen dataclass refuses assignments to its attributes
            mean=mean,
            std=std,
            encoder=encoder,
            decoder=decoder,
            groups=groups,
            bases=bases,
            _enter={mask: side_by_side(stacks, entered(mask)) for mask, stacks in enter.items()},
            _leave=side_by_side(leave, into, out),
            _leave_length=side_by_side(leave_length, into, out_length),
            decode_scaled=side_by_side(leave_scaled, into, out),
        )

    @property
    def layer_sizes(self) -> tuple[int, ...]:
        """Number of units of each layer from input to output, one group after the other.

        The middle layer of each group is its part of z, with one unit for each joint and each
        muscle of the group.
        """
        each, depth = len(self.groups), len(self.encoder) // len(self.groups)
        stacks = ((*self.encoder[i : i + depth], *self.decoder[i : i + depth])
                  for i in range(0, each * depth, depth))  # fmt: skip
        return tuple(
            size
            for stack in stacks
            for size in (stack[0][0].shape[1], *(len(bias) for _, bias in stack))
        )

    def encode(
        self,
        mask: Mask,
        theta: Array | None = None,
        tension: Array | None = None,
        length: Array | None = None,
    ) -> Array:
        """Encode θ [rad] (..., D), T [N] (..., M) and l [m] (..., M) as z (..., D+M).

        Only the two quantities that the mask selects are used; the third may be None.

        Raises:
            ValueError: If one of the two selected quantities is None.
        """
        quantities = (theta, tension, length)
        one, two = (q for q, is_used in zip(quantities, mask.value, strict=True) if is_used)
        if one is None or two is None:
            raise ValueError(f'mask {mask.name}: one of its two quantities is None; pass both')
        return self._enter[mask](np.concatenate((one, two), axis=-1))

    def decode(self, z: Array) -> State:
        """Decode (θ, T, l) in SI units from z of shape (..., D+M)."""
        joints, muscles = len(self.joints), len(self.muscles)
        values = self._leave(z)
        return State(values[..., :joints], values[..., joints:-muscles], values[..., -muscles:])

    def estimate(self, tension: Array, length: Array) -> State:
        """Estimate (θ, T, l) from measured T and l with the network (paper, §III-D).

        Sensor values of isolated muscles are not used; their T and l are estimates as well.

        Args:
            tension: Bone-side tension T_end [N], from which tendon friction is removed, (..., M).
            length: Muscle length [m], (..., M).
        """
        if not self.isolated:
            return self.decode(self.encode(Mask.TENSION_LENGTH, tension=tension, length=length))
        tension, length, lost = tension.copy(), length.copy(), list(self.isolated)
        joints, muscles = len(self.joints), len(self.muscles)
        mean_tension = (self.mean / scale_vector(joints, muscles))[joints:-muscles]
        tension[..., lost], length[..., lost] = mean_tension[lost], 0.0
        start = np.broadcast_to(self.usual_posture[0], (*length.shape[:-1], joints))
        theta = self.fit_posture(tension, length, self._length_root, start)
        length[..., lost] = self.lengths(theta, tension)[..., lost]
        state = self.decode(self.encode(Mask.TENSION_LENGTH, tension=tension, length=length))
        return state._replace(theta=theta)

    def fit_posture(self, tension: Array, length: Array, root: Array, start: Array) -> Array:
        """Fit the most likely posture to measured lengths; return θ [rad], (..., D).

        Args:
            tension: Bone-side tension T_end [N], (..., M).
            length: Muscle length [m], (..., M).
            root: R with RᵀR = Σ⁻¹ [1/m], (K, M). Muscles whose columns are 0 have no influence.
            start: Posture with which the fit starts [rad], (..., D).
        """
        mean, std = self.usual_posture
        by_prior = np.broadcast_to(np.diag(1.0 / std), (*start.shape, len(std)))

        def residuals(theta: Array) -> tuple[Array, Array]:
            predicted, jacobian = self._lengths_and_jacobian(theta, tension)
            value = np.concatenate(((predicted - length) @ root.T, (theta - mean) / std), axis=-1)
            return value, np.concatenate((root @ jacobian, by_prior), axis=-2)

        return minimise_each(residuals, start, 1.0 / std**2, ROUNDS)

    def posture_covariance(self, jacobian: Array) -> Array:
        """Return the covariance of a posture that `fit_posture` fits to the muscles in use.

            P = (Gᵀ Σ⁻¹ G + diag(1/s²))⁻¹

        Args:
            jacobian: Muscle Jacobian G in this posture [m/rad], (..., M, D). It does not depend on
                which muscles are isolated.

        Returns:
            P [rad²], (..., D, D).
        """
        rows = self._length_root @ jacobian
        prior = np.diag(1.0 / self.usual_posture[1] ** 2)
        information = rows.swapaxes(-1, -2) @ rows + prior
        return np.asarray(np.linalg.inv(information), dtype=np.float64)

    @cached_property
    def usual_posture(self) -> tuple[Array, Array]:
        """Mean θ̄ and standard deviation s of θ in the training data [rad], (D,) each."""
        joints = len(self.joints)
        scale = scale_vector(joints, len(self.muscles))
        return (self.mean / scale)[:joints], (self.std / scale)[:joints]

    @cached_property
    def _length_root(self) -> Array:
        """R with RᵀR = Σ⁻¹, for the K muscles that are not isolated [1/m], (K, M)."""
        muscles = len(self.muscles)
        used = np.delete(np.arange(muscles), self.isolated)
        if self.anomaly is None:
            covariance = LENGTH_SPREAD**2 * np.eye(len(used))
        else:
            healthy = self.anomaly.covariance[muscles:, muscles:][np.ix_(used, used)]
            covariance = healthy / LENGTH_SCALE**2 + LENGTH_NOISE**2 * np.eye(len(used))
        root = np.zeros((len(used), muscles))
        root[:, used] = whitening(covariance)
        return root

    @property
    def transmission(self) -> Transmission:
        """The learned relation between tension readings and the bone-side tension T_end."""
        if self.touch is None:
            return Transmission(self.friction)
        return Transmission(self.friction, self.touch.drive, self.touch.drive_covariance)

    @property
    def friction(self) -> Array:
        """Tendon friction μ of each muscle (M,); 0 until it has been learned."""
        return np.zeros(len(self.muscles)) if self.touch is None else self.touch.friction

    @property
    def is_calibrated(self) -> bool:
        """Whether the anomaly detector was calibrated with enough messages of the healthy arm."""
        return self.anomaly is not None and self.anomaly.calibrated

    def without(self, isolated: Iterable[int]) -> Mae:
        """Return the same network with exactly these muscles isolated.

        The anomaly statistics lose the residuals of the isolated muscles. If a muscle is restored,
        the statistics still lack its residuals and are therefore marked as not calibrated.
        """
        isolated = tuple(sorted(isolated))
        if isolated == self.isolated:
            return self
        anomaly = self.anomaly
        if anomaly is not None and set(self.isolated) - set(isolated):
            anomaly = replace(anomaly, calibrated=False)
        elif anomaly is not None:
            anomaly = anomaly.without(isolated)
        return replace(self, isolated=isolated, anomaly=anomaly)

    def lengths(self, theta: Array, tension: Array) -> Array:
        """Return the muscle lengths l [m], (..., M), that the network computes from θ and T.

        Args:
            theta: Joint angles [rad], (..., D).
            tension: Bone-side tensions [N], (..., M).
        """
        return self.decode(self.encode(Mask.THETA_TENSION, theta, tension)).length

    def lengths_with_pullback(
        self, theta: Array, tension: Array
    ) -> tuple[Array, Callable[[Array], Array]]:
        """Return the lengths l [m] (N, M) reconstructed from θ and T, and a pullback.

        The pullback is a function that maps the gradient dL/dl of any scalar L to dL/dθ. Applied to
        T, it returns Gᵀ T at the cost of one evaluation instead of D.
        """
        length, pullback = self._compiled.with_pullback(np.concatenate((theta, tension), axis=-1))
        joints = len(self.joints)
        return length, lambda gradient: pullback(gradient)[..., :joints]

    @cached_property
    def _compiled(self) -> Stack:
        # Imported here, because estimators and controllers do not need numba.
        from musculoskeletal_ae.mae.compiled import WITH_SLOPE

        enter, leave = self._enter[Mask.THETA_TENSION], self._leave_length
        own = ACTIVATIONS[self.activation]._replace(with_slope=WITH_SLOPE[self.activation])
        before, after = ([own] * len(stack.activations) for stack in (enter, leave))
        return Stack((*enter.layers, *leave.layers), (*before, LINEAR, *after))

    def muscle_jacobian(self, theta: Array, tension: Array) -> Array:
        """Return the muscle Jacobian G = ∂l/∂θ [m/rad], (..., M, D), of `lengths` at (θ, T).

        The derivative is exact, without finite differences.

        Args:
            theta: Joint angles [rad], (..., D).
            tension: Bone-side tensions [N], (..., M).
        """
        return self._lengths_and_jacobian(theta, tension)[1]

    def _lengths_and_jacobian(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        x = np.concatenate((theta, tension), axis=-1)
        z, tangent = self._enter[Mask.THETA_TENSION].tangent(x, self._directions)
        length, slopes = self._leave_length.tangent(z, tangent)
        slopes = slopes.swapaxes(-1, -2)
        if len(self.groups) == 1:
            return length, slopes
        result = np.zeros((*x.shape[:-1], len(self.muscles), len(self.joints)))
        for (_, muscles), joints in zip(self.groups, self._read_joints, strict=True):
            rows, columns = np.ix_(muscles, joints)
            result[..., rows, columns] = slopes[..., muscles, : len(joints)]
        return length, result

    @cached_property
    def _directions(self) -> Array:
        """Directions of (θ, T), each of which moves at most one joint of every block, (K, D+M).

        Blocks that do not read each other do not affect each other, so K is the largest number of
        joints that a block reads.
        """
        largest = max(map(len, self._read_joints))
        directions = np.zeros((largest, len(self.joints) + len(self.muscles)))
        for joints in self._read_joints:
            directions[np.arange(len(joints)), joints] = 1.0
        return directions

    @cached_property
    def _read_joints(self) -> list[tuple[int, ...]]:
        """The joints that each block reads, those of its base first.

        A base has no base itself, so a joint has the same place in each of these lists.
        """
        return [
            union([self.groups[r] for r in reversed(read)]).joints
            for read in read_blocks(self.bases)
        ]


def complete_bases(bases: Sequence[int], count: int) -> tuple[int, ...]:
    """Complete the indices of the bases of `count` blocks: () means that no block has a base.

    A block without a base has its own index.
    """
    return tuple(bases) or tuple(range(count))


def read_groups(groups: Sequence[Group], bases: Sequence[int]) -> list[Group]:
    """Return the joints and muscles that each block reads: its own, then those of its base."""
    return [union([groups[r] for r in read]) for read in read_blocks(bases)]


def read_blocks(bases: Sequence[int]) -> list[tuple[int, ...]]:
    """Return the indices of the blocks that each block reads: its own, and that of its base."""
    return [(g,) if base == g else (g, base) for g, base in enumerate(bases)]


def latent_places(groups: Sequence[Group], bases: Sequence[int]) -> list[Ints]:
    """Return, for each block, which places of z its decoder reads: its own, then its base's."""
    ends = np.cumsum([0, *(sum(map(len, group)) for group in groups)])
    return [
        np.concatenate([np.arange(ends[r], ends[r + 1]) for r in read])
        for read in read_blocks(bases)
    ]


def _frozen(array: Array) -> Array:
    copy = np.array(array, dtype=np.float64, order='C')
    copy.setflags(write=False)
    return copy


def _stack(layers: tuple[tuple[Singles, Singles], ...], activation: Activation) -> Stack:
    gain = np.float32(activation.gain)
    hidden = tuple((gain * weight, gain * bias) for weight, bias in layers[:-1])
    return Stack((*hidden, layers[-1]), (activation,) * len(hidden))


def _transposed(weight: Array, bias: Array) -> tuple[Singles, Singles]:
    return np.array(weight.T, np.float32, order='C'), bias.astype(np.float32)
