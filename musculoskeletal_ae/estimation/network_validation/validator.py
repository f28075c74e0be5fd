# SPDX-License-Identifier: Apache-2.0
"""Checkpoint validation: decides which network the estimator uses.

    candidate of the learner ─► checks ─► accepted, or rejected with a reason
    network of a user        ─► checks ─► accepted, with a note on what it does worse; or refused
    an anomaly begins        ─► a proven network is used again; the doubtful one is rejected

Four checks compare a candidate with the geometric model, the arm and the network in use:

    posture_check.py   errors on fixed states of the geometric model
    message_errors.py  errors on the healthy messages of the last seconds
    agreement.py       differences of joint angles and lengths; the reference is joint
                       sensors, or else the network in use
    detector_check.py  a calibrated anomaly detector reports nothing on these messages,
                       and would detect a rupture

The first network is only subject to the first and the last check, because its error on a body that
differs from its model cannot be predicted. A network that a user has chosen is not subject to the
third check; if it is clearly worse than the network in use, `unsuitable_because` says so.

All limits leave a margin to the values of healthy networks: initial and learned networks of both
presets, on arm26 and musashi_left_arm, with both emulator models. `python -m bench gate` prints
these values, and the values of networks that must be rejected.

A candidate without a calibrated detector inherits the detector in use, which would otherwise be
switched off. A muscle that was repaired within the last 600 s (RELEARNING_TIME) may be relearned,
and its residuals then differ from the calibrated ones. The inherited detector ignores this
muscle and judges all others, until a network with a calibrated detector of its own takes over.

When an anomaly is detected, the networks that took over less than 10 s ago (PROOF) are discarded,
except for the oldest network. The newest of the remaining networks is used again.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.design.route_jumps import jump_warning
from musculoskeletal_ae.estimation.finding import DETECTION_DELAY
from musculoskeletal_ae.estimation.network_validation import detector_check, message_errors
from musculoskeletal_ae.estimation.network_validation.agreement import AgreementCheck
from musculoskeletal_ae.estimation.network_validation.comparison import Comparison
from musculoskeletal_ae.estimation.network_validation.posture_check import PostureCheck
from musculoskeletal_ae.estimation.network_validation.recent_messages import RecentMessages
from musculoskeletal_ae.exceptions import CheckpointError, GateError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState, LengthOffsets

#: after an anomaly, return to a network that had been in use for at least this long without an
#: anomaly [s]
PROOF = 10.0
RELEARNING_TIME = 600.0  # expect that a muscle may be relearned for this long after its repair [s]


class CheckpointValidator:
    """Decides which network is used, by checks of candidates and by anomalies.

    All times `now` are readings of one steady clock [s].

    Attributes:
        body: The body state under which messages arrive; isolated muscles are ignored.
        messages: The healthy messages of the last seconds.
        postures: The check on the geometric model.
        unsuitable_because: Why the network in use, which a user has chosen, fits this arm worse
            than the network before it; '' if it fits as well.
        accepted: Called with each network that is used from now on.
        rejected: Called with each network that is rejected, at once or after an anomaly, and with
            the reason.
    """

    def __init__(self, robot: Robot, use: Callable[[Mae], Mae] = lambda mae: mae) -> None:
        """Start without a network.

        Args:
            robot: The nominal body.
            use: Puts a network to use, and returns it with the torques measured so far
                (`Estimator.use`).
        """
        self._robot, self._use = robot, use
        self.unsuitable_because = ''
        self.accepted: Callable[[Mae], object] = lambda _: None
        self.rejected: Callable[[Mae, str], object] = lambda _, __: None
        self.body = BodyState(LengthOffsets.unknown(robot.muscle_count))
        self.messages = RecentMessages(robot.joint_count)
        self.postures = PostureCheck(robot)
        self._used: list[tuple[float, Mae]] = []  # networks, and the times at which they took over
        self._repaired_at: dict[int, float] = {}  # time of each muscle's last repair [s]

    @property
    def mae(self) -> Mae | None:
        """The network in use; None before the first."""
        return self._used[-1][1] if self._used else None

    # -- decisions ------------------------------------------------------------------------------

    def propose(self, mae: Mae, clock: Callable[[], float]) -> Iterator[None]:
        """Propose a candidate of the learner: use it, or call `rejected` with the reason.

        Each step takes some milliseconds, so that a node can do other work in between.

        Args:
            mae: The candidate. Nothing is decided if it is the network in use.
            clock: Returns the time on the steady clock [s].

        Raises:
            CheckpointError: If the candidate is rejected.
        """
        if self.is_in_use(mae):
            return
        try:
            yield from self.trial(mae)
            now = clock()
            self._accept(self.with_detector(mae, now), now)
        except CheckpointError as error:
            self.rejected(mae, str(error))
            raise

    def choose(self, mae: Mae, now: float) -> None:
        """Use a network that a user has chosen, and set `unsuitable_because`.

        Args:
            mae: The network.
            now: Time on the steady clock [s].

        Raises:
            CheckpointError: If a check rejects it; the network in use then stays.
        """
        self.check(mae, is_chosen=True)
        self._accept(mae, now, unsuitable_because=self._weakness(mae))

    def follow(self, body: BodyState, now: float) -> None:
        """Follow a change of the body state.

        Other length offsets or isolated muscles make the stored messages useless. If an anomaly
        begins, a network that was accepted shortly before may be its cause; it is rejected, and the
        newest network that was in use for 10 s (PROOF) without an anomaly is used again, or the
        oldest one if none was.
        """
        before, self.body = self.body, body
        if body.offsets != before.offsets or body.isolated != before.isolated:
            self.messages.clear()
        if body.has_anomaly == before.has_anomaly:
            return
        if not body.has_anomaly:
            self.messages.clear()  # they may describe the arm as it was before a repair
            return
        self.messages.drop_after(now - DETECTION_DELAY)
        doubtful = self.mae
        while len(self._used) > 1 and now - self._used[-1][0] < PROOF:
            del self._used[-1]
        proven = self.mae
        if proven is doubtful or proven is None or doubtful is None:
            return
        self.unsuitable_because = ''
        self.accepted(self._use(proven))
        self.rejected(doubtful, 'an anomaly was detected soon after this network was accepted')

    def _accept(self, mae: Mae, now: float, unsuitable_because: str = '') -> None:
        try:
            mae = self._use(mae)
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            raise CheckpointError(f'the network cannot be evaluated ({error})') from error
        self.unsuitable_because = unsuitable_because
        self.take(mae, now)
        self.accepted(mae)

    def is_in_use(self, mae: Mae) -> bool:
        """Return whether a network is the one in use, which needs no further decision.

        Isolated muscles, detector, damping and residual torque do not distinguish networks.
        """
        in_use = self.mae
        return (
            in_use is not None
            and mae.version == in_use.version
            and np.array_equal(mae.encoder[0][0], in_use.encoder[0][0])
        )

    def _weakness(self, mae: Mae) -> str:
        """Return for users how a network is clearly worse than the learned network in use.

        On recent messages, the errors of estimated joint angles are compared, if joint sensors
        measured them, or else those of the lengths that each network computes at its estimate.

        Returns:
            The quantity, its error and that of the network in use; '' if the network is not clearly
            worse, or if there are too few messages.
        """
        if self.mae is None or self.mae.covariance is None or not self.messages.are_enough:
            return ''
        in_use = self.mae.without(self.body.isolated)
        mae, check = mae.without(self.body.isolated), self._agreement_check(in_use)
        if (text := check.worse_angle(mae)) is not None:
            return text
        errors, before = self.message_errors(mae), self.message_errors(in_use)
        return message_errors.worse_length(errors, before, self._robot.muscles)

    # -- messages, networks and repairs ---------------------------------------------------------

    def message(
        self,
        tension: Array,
        length: Array,
        sliding: Array,
        now: float,
        theta: Array | None = None,
    ) -> None:
        """Record a measurement on which candidates are tested.

        Args:
            tension: Tensions as read [N], (M,).
            length: Muscle lengths [m], (M,).
            sliding: Direction in which each tendon slid last (`MuscleSample.sliding`), (M,).
            now: Time of the measurement [s].
            theta: Joint angles from joint sensors [rad], (D,), or None if there are none.
        """
        if not self.body.has_anomaly:
            self.messages.note(tension, length, sliding, now, theta)

    # -- checks ---------------------------------------------------------------------------------

    def check(self, mae: Mae, is_chosen: bool = False) -> None:
        """Check a network in a single call; `trial` does the same in steps.

        Args:
            mae: The candidate.
            is_chosen: Whether a user has chosen this network. A chosen network need not agree with
                the network in use.

        Raises:
            GateError: If the candidate is rejected; the text names each quantity that exceeds its
                limit, the value and the limit.
        """
        try:
            deque(self.trial(mae, is_chosen), maxlen=0)
        except GateError as error:
            raise GateError(f'{error}{self._likely_cause}') from error

    def trial(self, mae: Mae, is_chosen: bool = False) -> Iterator[None]:
        """Try a network: check it as `check` does, but in steps of some milliseconds.

        A node can do other work between the steps. `check` describes the arguments and the error.
        """
        faults, steps = list[str](), self._steps(mae.without(self.body.isolated), is_chosen)
        while True:
            # Suppress warnings of overflows, which count as large errors of the candidate.
            with np.errstate(all='ignore'):
                try:
                    fault = next(steps)
                except StopIteration:
                    break
            if fault is not None:
                faults.append(fault)
            yield
        if faults:
            raise GateError('; '.join(faults))

    def declare_repaired(self, muscles: Iterable[int], now: float) -> None:
        """Record that a user has repaired these muscles (indices) and declares them healthy."""
        self._repaired_at |= dict.fromkeys(muscles, now)

    def take(self, mae: Mae, now: float) -> None:
        """Take this network as the one in use from the time `now` [s] on, without any check."""
        self._used.append((now, mae))
        while len(self._used) > 1 and now - self._used[1][0] >= PROOF:
            del self._used[0]

    def message_errors(self, mae: Mae) -> dict[str, Array]:
        """Return the errors of a network on the recent messages; {} if these are too few."""
        return message_errors.message_errors(mae, self.messages, self.body.isolated)

    def agreement(self, mae: Mae) -> list[Comparison]:
        """Compare a network with joint sensors or, without them, with the network in use.

        Return [] if no network is in use.
        """
        if self.mae is None:
            return []
        return self._agreement_check(self.mae.without(self.body.isolated)).comparisons(mae)

    def _agreement_check(self, in_use: Mae) -> AgreementCheck:
        """Return the comparison of other networks with the one in use, without isolated muscles."""
        isolated = self.body.isolated
        return AgreementCheck(self._robot, self.postures, self.messages, in_use, isolated)

    def with_detector(self, mae: Mae, now: float) -> Mae:
        """Return a network with a calibrated anomaly detector, if one is available.

        If `mae` has no calibrated detector of its own, the copy that is returned has the detector
        of the network in use.
        """
        in_use = self.mae
        if mae.is_calibrated or in_use is None or not in_use.is_calibrated:
            return mae
        statistics = in_use.anomaly
        assert statistics is not None
        repaired = [m for m, at in self._repaired_at.items() if 0.0 <= now - at < RELEARNING_TIME]
        statistics = statistics.ignoring(repaired)
        return detector_check.with_detector_of(statistics, mae, self.messages, self.body.isolated)

    def _steps(self, mae: Mae, is_chosen: bool) -> Iterator[str | None]:
        """Check a candidate step by step; yield a text for each fault, or None between steps."""
        yield from self.postures.faults(mae)
        if self.mae is not None:
            errors = self.message_errors(mae)
            in_use = self.message_errors(self.mae.without(self.body.isolated))
            yield None
            compared = message_errors.comparisons(errors, in_use, self._robot.muscles)
            if not is_chosen:
                compared += self.agreement(mae)
            for comparison in compared:
                yield from comparison.faults()
            yield None
        yield from detector_check.faults(mae, self.messages, self.body.isolated)

    @cached_property
    def _likely_cause(self) -> str:
        """Text on a property of the robot that may cause a rejection; '' if it has none."""
        warning = jump_warning(self._robot)
        return f' ({warning})' if warning else ''
