# SPDX-License-Identifier: Apache-2.0
"""Decides which joint sensors are trusted: finds those that slip, drift or stick.

The readings are mainly compared with the muscle lengths:

    x_j = (θ_j − θ̂_j) − median of θ_j − θ̂_j in earlier messages

θ_j is the reading of joint sensor j, and θ̂_j the network's estimate from tensions and lengths,
which no joint sensor enters. A false sensor therefore changes its own x_j only. This also holds if
only some joints have sensors, and if two sensors are exchanged.

The earlier messages are the reference. Both x_j and the median are computed with the network in
use, and are computed again for each new network. A network that learns from a false sensor follows
the new readings and departs from the earlier ones, so the difference between the two remains. A
constant offset of a sensor cancels out.

A sensor is doubted once the median of |x_j| over the newest messages exceeds a limit: a constant or
a multiple of the healthy spread of θ_j − θ̂_j, whichever is larger. This spread is computed with
the estimates that were made when the earlier messages arrived. A network that has since learned
from these messages fits them better than it will fit later ones, above all at the beginning. Only
messages of different postures count, because the error of a network in one posture says little
about others. Messages of an arm that carries a load do not count.

A doubted sensor is compared with its own readings before the doubt. Their usual deviation and
spread are kept until the doubt ends, even if these readings are forgotten meanwhile. If a user
confirms the sensor, its newest deviations become the usual ones. When another network is used, kept
deviations change by as much as its estimates of the earlier messages.

A change of muscle lengths also changes θ̂. The readings are therefore compared with two hypotheses:
the sensors of the joints with large x are false, or the length of a single muscle has changed.

    Δ = l − l_net(θ, T_end) − median of earlier l − l_net(θ̂, T_end)

θ are the readings without their usual deviations, and the estimates for joints without a sensor.
Under the first hypothesis, the angles of the joints in question may have any value: θ̂ plus any
motion, whose effect on the lengths follows from the muscle Jacobian. Under the second, Δ of one
muscle does not count. Sensors are doubted only if the first hypothesis leaves a clearly smaller sum
of squares of Δ, measured in healthy spreads.

While a sensor reports impossible readings again and again (`signals/joint_stream.py`), it is not
used either. Its other readings may be wrong as well, for example if two programs publish joint
angles.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.estimation.contact import Contact
from musculoskeletal_ae.estimation.finding import Detector, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_trust_message import NOT_USED, JointTrust, SensorTrust

SPACING = 0.5  # judge sensors by at most one message in this time [s]
#: skip a message unless the estimated angle of a joint has changed by this much since the last
#: message that was stored [rad]: more messages of one posture tell nothing about others
MOVED = 0.03
#: compare new readings with at most this many earlier messages, which are at least 5 min of motion
EARLIER = 600
#: Skip messages in which the evidence d for an external load (`contact.py`) exceeds this. Under a
#: load that was not learned, the estimate may be wrong instead of the joint sensor.
LOADED = 3.0
ENOUGH = 80  # judge a sensor by at least this many earlier messages
NEWEST = 48  # judge this many of the newest messages, by all messages before them
#: Judge a sensor by its deviation x in three windows. Each has a number of newest messages, the
#: smallest limit of the median of |x| [rad], and the limit in healthy spreads; the larger limit
#: applies. The short window finds large errors fast; the long window averages over more postures.
WINDOWS = ((6, 0.12, 7.0), (12, 0.08, 4.7), (24, 0.07, 3.0), (NEWEST, 0.06, 2.2))
#: Trust a doubted sensor again once the median of its deviation |x| is below AGREEING_LIMIT [rad]
#: or AGREEING_SPREADS healthy spreads, whichever is larger: over the newest AGREEING messages,
#: and also over the newer half of them.
AGREEING, AGREEING_LIMIT, AGREEING_SPREADS = 12, 0.035, 1.0
#: assume at least this healthy spread of a length residual [m], because no length sensor is more
#: precise
LEAST_SPREAD = 0.0005
#: Doubt joint sensors only if they explain the length errors clearly better than a changed muscle:
#: the sum of squares that they leave is below this share of what any single muscle leaves.
BETTER = 0.7
USES = 10  # compute the medians of the earlier messages again only after this many new messages
TO_SIGMA = 1.48  # multiply a median of absolute deviations by this to get the standard deviation
#: doubt a sensor even with few earlier messages if its reading differs from the estimate by this
#: much [rad]
GROSS = 0.8


class _CountedMessage(NamedTuple):
    """A message that counts when joint sensors are judged: its readings, and θ − θ̂."""

    time: float  # time of the message on the steady clock [s]
    theta: Array  # readings of the joint sensors [rad], (D,); NaN where unknown or in doubt
    tension: Array  # bone-side tensions [N], (M,)
    length: Array  # lengths [m], (M,); NaN for isolated muscles
    deviation: Array  # θ − θ̂ [rad], (D,), with the network that was in use when it arrived


class _Usual(NamedTuple):
    """Usual values on the healthy arm: medians of earlier messages, and spreads about them."""

    deviation: Array  # usual deviation θ − θ̂ of each joint sensor [rad], (D,); 0 if unknown
    #: spread of these deviations in the newest of the messages, when they arrived [rad], (D,); NaN
    #: if unknown
    deviation_spread: Array
    residual: Array  # usual length error l − l_net(θ̂, T_end) of each muscle [m], (M,)
    residual_spread: Array  # spread of these length errors [m], (M,)


class SensorDoubt(NamedTuple):
    """A joint sensor in doubt, with the values by which it can be trusted again."""

    deviation: float  # by how much it differed from the lengths when the doubt began [rad]
    usual: float  # its usual deviation θ − θ̂ before the doubt [rad]
    spread: float  # healthy spread of this deviation [rad]; NaN if unknown


class JointSensorTrust(Detector):
    """Decides which joint sensors of one arm are trusted, by comparing them with muscle lengths.

    Attributes:
        trust: The newest decision on every sensor.
    """

    def __init__(self, robot: Robot) -> None:
        """Start without a network."""
        self._robot = robot
        self._mae: Mae | None = None
        self.trust = JointTrust.full(robot.joint_count)
        #: messages in order of time; the last NEWEST messages are judged by those before
        self._messages: deque[_CountedMessage] = deque(maxlen=EARLIER + NEWEST)
        #: θ − θ̂ [rad] (D,) and l − l_net(θ̂, T_end) [m] (M,) of each message with the network in use
        self._compared: deque[tuple[Array, Array]] = deque(maxlen=EARLIER + NEWEST)
        self._since = 0.0  # time since a message was last stored [s]
        #: estimated joint angles at that message [rad], (D,)
        self._counted_at = np.full(robot.joint_count, np.inf)
        self._usual: _Usual | None = None  # None if it has to be computed
        self._uses = 0  # number of messages judged by `_usual`
        #: usual deviation θ − θ̂ and its spread [rad], (2, D), of joints whose earlier messages do
        #: not show them because of a doubt; NaN for all other joints
        self._kept = np.full((2, robot.joint_count), np.nan)

    def use(self, mae: Mae) -> None:
        """Use another network from now on, and ignore the muscles that it isolates."""
        previous, self._mae, self._usual = self._mae, mae, None
        self._compared.clear()
        if not self._messages:
            return
        readings = ((each.theta, each.tension, each.length) for each in self._messages)
        theta, tension, length = map(np.array, zip(*readings))
        estimate = mae.estimate(tension, np.nan_to_num(length)).theta
        used = ~np.isin(np.arange(length.shape[1]), mae.isolated)
        # Messages in which a muscle that is used now was isolated cannot be compared.
        is_complete = np.isfinite(length[:, used]).all(axis=1)
        deviation = np.where(is_complete[:, None], theta - estimate, np.nan)
        residual = np.where(is_complete[:, None] & used, length, np.nan)
        self._compared.extend(zip(deviation, residual - mae.lengths(estimate, tension)))
        if previous is not None and np.isfinite(self._kept[0]).any():
            used |= ~np.isin(np.arange(length.shape[1]), previous.isolated)
            rows = np.isfinite(length[:, used]).all(axis=1)
            if rows.any():
                before = previous.estimate(tension[rows], np.nan_to_num(length[rows])).theta
                self._kept[0] += np.median(before - estimate[rows], axis=0)

    def drop_newest(self) -> None:
        """Drop the newest messages, because an anomaly has been found."""
        for _ in range(min(NEWEST, len(self._messages))):
            self._messages.pop()
            self._compared.pop()

    def forget(self) -> None:
        """Forget all messages, because the length offsets have changed.

        The trust stays, and so do the usual deviations of doubted sensors, which end the doubt.
        """
        self._usual = None
        self._kept[:, ~self.trust.is_doubted] = np.nan
        self._messages.clear()
        self._compared.clear()

    def confirm(self) -> tuple[int, ...]:
        """Confirm all doubted sensors, because a user says that they are right.

        Earlier readings of these sensors, which contradict the present ones, are discarded. From
        now on, the deviations since the beginning of the doubt count as usual.

        Returns:
            Indices of the joints whose sensors were in doubt.
        """
        joints, doubted = self.trust.doubted, self.trust.is_doubted
        if not joints:
            return ()
        self._usual = None
        for j in joints:
            self._kept[:, j] = self._newest_deviation(j), np.nan
        self._set(doubted, SensorTrust.CONFIRMED)
        for message, (deviation, _) in zip(self._messages, self._compared, strict=True):
            message.theta[doubted] = deviation[doubted] = np.nan
        return joints

    def _newest_deviation(self, joint: int) -> float:
        """Return the median of a joint's newest deviations since its doubt began [rad], or NaN."""
        since = self.trust.since[joint]
        deviation = [
            compared[joint]
            for message, (compared, _) in zip(self._messages, self._compared, strict=True)
            if message.time >= since and np.isfinite(compared[joint])
        ]
        return float(np.median(deviation[-AGREEING:])) if deviation else np.nan

    @property
    def doubts(self) -> dict[int, SensorDoubt]:
        """The sensors in doubt, by index of the joint."""
        usual, spread = self._kept.tolist()
        deviation = self.trust.deviation.tolist()
        return {j: SensorDoubt(deviation[j], usual[j], spread[j]) for j in self.trust.doubted}

    def begin_in_doubt(self, doubts: Mapping[int, SensorDoubt], now: float) -> None:
        """Begin with sensors in doubt, because an earlier estimator has doubted them.

        Args:
            doubts: Their doubts, by index of the joint.
            now: Time on the steady clock [s].
        """
        trust, since, deviation = list(self.trust.trust), self.trust.since, self.trust.deviation
        since, deviation = since.copy(), deviation.copy()
        for j, doubt in doubts.items():
            trust[j], since[j], deviation[j] = SensorTrust.DOUBTED, now, doubt.deviation
            self._kept[:, j] = doubt.usual, doubt.spread
        if doubts:
            self.trust, self._usual = JointTrust(tuple(trust), since, deviation), None

    def use_impossible(self, since: Mapping[int, float]) -> None:
        """Use no sensors that report impossible readings again and again.

        Args:
            since: Time of the first of these readings [s], by index of the joint.
        """
        if not since and SensorTrust.IMPOSSIBLE not in self.trust.trust:
            return
        trust, begin = list(self.trust.trust), self.trust.since.copy()
        for j, each in enumerate(trust):
            if j in since and each not in NOT_USED:
                trust[j], begin[j] = SensorTrust.IMPOSSIBLE, since[j]
            elif j not in since and each is SensorTrust.IMPOSSIBLE:
                trust[j] = SensorTrust.TRUSTED
        if tuple(trust) != self.trust.trust:
            self.trust = JointTrust(tuple(trust), begin, self.trust.deviation)

    # -- messages -------------------------------------------------------------------------------

    def step_healthy(self, observation: Observation, load: Contact | None) -> None:
        """Judge the sensors by a message, unless the evidence for a load exceeds LOADED."""
        theta = observation.joints
        if theta is None or (load is not None and load.distance > LOADED):
            return
        self._since += observation.dt
        estimate, sample = observation.estimate.state.theta, observation.sample
        if self._mae is None or self._since < SPACING - 1e-9 or np.isnan(theta).all():
            return
        has_moved = (np.abs(estimate - self._counted_at) > MOVED).any()
        # Look for readings that are far from the estimate even while the arm stands still.
        kept = np.nan_to_num(self._kept[0])
        usual = kept if self._usual is None else self._usual.deviation
        is_far = np.abs(theta - estimate - usual) > GROSS
        if not (has_moved or (is_far & ~self.trust.is_doubted).any()):
            return
        self._since, self._counted_at = 0.0, estimate
        length = np.where(sample.usable, sample.length, np.nan)
        tension = np.nan_to_num(sample.bone_tension)
        deviation = theta - estimate
        message = _CountedMessage(observation.now, theta.copy(), tension, length, deviation)
        self._messages.append(message)
        self._compared.append((deviation.copy(), length - self._mae.lengths(estimate, tension)))
        if len(self._messages) >= WINDOWS[0][0]:
            self._judge()
        if len(self._messages) > NEWEST:
            # Do not compare later readings with those of a sensor that is not used.
            unused = ~self.trust.is_used
            self._messages[-1 - NEWEST].theta[unused] = np.nan
            self._compared[-1 - NEWEST][0][unused] = np.nan

    def conditions(self) -> Iterator[Condition]:
        """Yield the condition that sensors are in doubt, with the deviation of each of them."""
        trust, robot = self.trust, self._robot
        if trust.doubted:
            detail = ', '.join(
                f'{robot.joints[j]} by {robot.units[j].position_text(trust.deviation[j], "+.2f")}'
                for j in trust.doubted
            )
            names = [robot.joints[j] for j in trust.doubted]
            yield ConditionKind.JOINT_SENSORS_DOUBTED.condition(detail, names)

    def _judge(self) -> None:
        usual = self._usual
        if usual is None or self._uses >= USES:
            usual, self._uses = self._compute_usual(), 0
        self._usual, self._uses = usual, self._uses + 1
        first = max(len(self._compared) - NEWEST, 0)
        deviation = np.array([each[0] for each in islice(self._compared, first, None)])
        excess = deviation - usual.deviation
        doubted = self.trust.is_doubted
        for count, limit in self._limits(usual):
            new = (_median(np.abs(excess[-count:])) > limit) & ~doubted
            # If a window exceeds the limit, at least its newer half shows the change.
            rows = -(count // 2)
            if new.any() and self._explains(new, excess[rows:], usual):
                self._set(new, SensorTrust.DOUBTED, excess)
                return
        agrees = doubted & self._agrees(excess, usual)
        if agrees.any():
            self._set(agrees, SensorTrust.TRUSTED)
            self._give_up(agrees)

    def _compute_usual(self) -> _Usual:
        """Compute the usual values: medians of the earlier messages, and spreads about them."""
        earlier = list(self._compared)[:-NEWEST]
        deviation, residual = (
            np.array([each[part] for each in earlier]).reshape(len(earlier), len(values))
            for part, values in enumerate(self._compared[0])
        )
        messages = islice(self._messages, len(earlier))
        arrived = np.array([message.deviation for message in messages]).reshape(deviation.shape)
        shown = _usual_deviations(deviation, arrived)
        is_shown = np.isfinite(shown[0])
        usual = np.where(is_shown, shown, self._kept)
        self._kept = np.where(is_shown & ~self.trust.is_doubted, np.nan, usual)
        usual_residual = _median(residual)
        residual_spread = TO_SIGMA * _median(np.abs(residual - usual_residual))
        residual_spread = np.fmax(residual_spread, LEAST_SPREAD)
        return _Usual(np.nan_to_num(usual[0]), usual[1], usual_residual, residual_spread)

    def _is_precise(self) -> bool:
        """Return whether estimates are precise enough to judge errors smaller than GROSS.

        A network that has learned little makes large errors in new postures. Without tensions, a
        load changes the estimates as false joint sensors would.
        """
        has_tensions = self._robot.tension_source.is_known
        return self._mae is not None and self._mae.is_calibrated and has_tensions

    def _limits(self, usual: _Usual) -> Iterator[tuple[int, Array]]:
        """Yield the limits of each joint's deviation in each window.

        Each item is the number of messages in the window, and the limit of the median of |x| [rad],
        (D,).
        """
        for count, smallest, spreads in WINDOWS:
            limit = np.fmax(smallest, spreads * usual.deviation_spread)
            is_gross = np.isnan(usual.deviation_spread) | (not self._is_precise())
            yield count, np.where(is_gross, GROSS, limit)

    def _agrees(self, excess: Array, usual: _Usual) -> Bools:
        """Return the joints whose newest readings agree with the muscle lengths again, (D,)."""
        limit = np.fmax(AGREEING_LIMIT, AGREEING_SPREADS * usual.deviation_spread)
        agrees = np.ones(len(limit), dtype=bool)
        for count in (AGREEING // 2, AGREEING):
            agrees &= _median(np.abs(excess[-count:])) < limit
        return agrees

    def _explains(self, joints: Bools, excess: Array, usual: _Usual) -> bool:
        """Return whether false sensors explain the newest messages better than a changed muscle.

        Args:
            joints: The joints whose sensors may be false, (D,).
            excess: Deviations x of the sensors in these messages [rad], (N, D).
            usual: Usual values on the healthy arm, from earlier messages.
        """
        mae, spread = self._mae, usual.residual_spread
        assert mae is not None
        messages = [*islice(self._messages, len(self._messages) - len(excess), None)]
        tension = np.array([message.tension for message in messages])
        length = np.nan_to_num([message.length for message in messages])
        estimate = mae.estimate(tension, length).theta
        # Remove the usual errors of readings and lengths, which are no sign of a fault.
        read = estimate + np.nan_to_num(excess)
        length = length - np.nan_to_num(usual.residual)
        used = ~np.isin(np.arange(length.shape[1]), mae.isolated)

        def misfit(is_free: Bools, muscles: Bools) -> float:
            """Return the misfit of the lengths of `muscles` if the joints `is_free` may move."""
            theta = np.where(is_free, estimate, read)
            change = (length - mae.lengths(theta, tension)) / spread
            jacobian = mae.muscle_jacobian(theta, tension) / spread[:, None]
            return _unexplained(change[:, muscles], jacobian[:, muscles][:, :, is_free])

        is_unknown = np.asarray(np.isnan(excess).any(axis=0), dtype=bool)
        by_joints = misfit(joints | is_unknown, used)
        by_muscle = min(
            misfit(is_unknown, used & (np.arange(len(used)) != muscle))
            for muscle in np.flatnonzero(used)
        )
        return by_joints < BETTER * by_muscle

    def _give_up(self, joints: Bools) -> None:
        """Discard the newest readings of joints, except those by which they are trusted again."""
        for place in range(max(-NEWEST, -len(self._messages)), -AGREEING):
            self._messages[place].theta[joints] = self._compared[place][0][joints] = np.nan

    def _set(self, joints: Bools, trust: SensorTrust, excess: Array | None = None) -> None:
        """Set the trust in some joints; with `excess`, a doubt begins.

        Args:
            joints: The joints, (D,).
            trust: The new trust in each of them.
            excess: Deviations x of the sensors in the newest messages [rad], (N, D).
        """
        old = self.trust
        trusts = tuple(trust if is_it else each for is_it, each in zip(joints, old.trust))
        since, deviation = old.since.copy(), old.deviation.copy()
        if excess is not None:
            assert self._usual is not None
            usual = np.array([self._usual.deviation, self._usual.deviation_spread])
            self._kept = np.where(joints, usual, self._kept)
            for j in np.flatnonzero(joints).tolist():
                since[j] = self._begin_of_doubt(j)
                deviation[j] = np.nanmedian(excess[-(WINDOWS[0][0] // 2) :, j])
        self.trust = JointTrust(trusts, since, deviation)

    def _begin_of_doubt(self, joint: int) -> float:
        """Return the time since which the readings of a joint may be wrong [s].

        Until this time, the readings agreed with the lengths, averaged over a window.
        """
        count = WINDOWS[0][0]
        deviation = np.array([deviation[joint] for deviation, _ in self._compared])
        earlier = deviation[:-NEWEST]
        # The earlier messages have no readings of a sensor that a user has confirmed.
        usual = np.nan_to_num(self._kept[0, joint])
        if np.isfinite(earlier).any():
            usual = np.nanmedian(earlier)
        excess = np.abs(deviation - usual)
        for end in range(len(excess) - 1, count, -1):
            if np.median(excess[end - count : end]) < AGREEING_LIMIT:  # NaN never agrees
                return self._messages[end - count // 2].time
        return self._messages[0].time


def _unexplained(change: Array, jacobian: Array) -> float:
    """Return the median sum of squares of length changes that motions of joints do not explain.

    Args:
        change: Length changes, in healthy spreads, (N, M).
        jacobian: Derivatives of the lengths by the angles of these K joints, divided by the healthy
            spreads, (N, M, K).
    """
    if jacobian.shape[2]:
        motion = np.einsum('nkm,nm->nk', np.linalg.pinv(jacobian), change)
        change = change - np.einsum('nmk,nk->nm', jacobian, motion)
    return float(np.median(np.square(change).sum(axis=1)))


def _usual_deviations(deviation: Array, arrived: Array) -> Array:
    """Return the usual deviation and its spread of each joint, (2, D), from N earlier messages.

    Both are NaN for a joint of which fewer than ENOUGH of these messages have a reading.

    Args:
        deviation: θ − θ̂ with the network in use [rad], (N, D); NaN where there is no reading.
        arrived: θ − θ̂ with the network that was in use when each message arrived [rad], (N, D).
    """
    usual = np.full((2, deviation.shape[1]), np.nan)
    for j, (values, then) in enumerate(zip(deviation.T, arrived.T, strict=True)):
        known = np.isfinite(values)
        if np.count_nonzero(known) >= ENOUGH:
            newest = then[known][-ENOUGH:]
            spread = TO_SIGMA * np.median(np.abs(newest - np.median(newest)))
            usual[:, j] = np.median(values[known]), spread
    return usual


def _median(values: Array) -> Array:
    """Return the median of each column of (N, K), NaN where most values are unknown.

    With few rows this is much faster than `numpy.nanmedian(values, axis=0)`.
    """
    if not len(values):
        return np.full(values.shape[1], np.nan)
    known_count, column = np.isfinite(values).sum(axis=0), np.arange(values.shape[1])
    ordered = np.sort(values, axis=0)  # NaN comes last
    low, high = ordered[(known_count - 1) // 2, column], ordered[known_count // 2, column]
    return np.where(2 * known_count > len(values), 0.5 * (low + high), np.nan)
