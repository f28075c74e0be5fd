# SPDX-License-Identifier: Apache-2.0
"""Decides what follows from a finding: from the isolation of a muscle to the end of the anomaly.

The sequence after the rupture of a tendon, with `on_anomaly: isolate`:

 1. Rupture. The muscle has no tension, and its readings disagree with the other muscles.
 2. Finding. A detector of `health.py` names the muscle: after about half a second if the modules
    keep T_bias, otherwise as soon as the tendon should carry load. The finding is latched: the
    estimator publishes a body state with an anomaly, and the controller stops the arm.
 3. Isolation. The suspect is isolated immediately: estimation and control continue without it.
 4. Verification. The controller winds the suspect in by a few millimetres.
    `suspect_verification.py` classifies its response: ruptured, jammed, sensor fault, or healthy.
 5. Resuming. A faulty muscle stays isolated, a healthy one is restored. Either way the anomaly is
    over, and the controller resumes after a verification (`control/supervisor.py`).

With `on_anomaly: stop` the sequence ends with step 2, and the finding stays latched until
`estimator/reset`. The same applies if two suspects were verified as healthy within the last 60 s,
because there must be a fault that a verification does not reveal, and before the first network,
because a verification compares the suspect with the network. Some kinds of findings have other
consequences:

    values_missing          is never latched. With `on_anomaly: isolate` the muscle is isolated
                            without a verification, because a sensor that reports NaN is faulty.
    sensor_saturated        With `on_anomaly: isolate` the muscle is isolated without a verification
                            and without a stop: a verification demands less tension than that at
                            which the sensor saturates.
    lengths_jumped          concern several muscles, none of which is isolated. The length offsets
    lengths_disagree        become unreliable, and the finding stays latched until the next length
    muscles_exchanged       calibration.
    length_jump             concern one muscle, which is isolated and verified like any other. If
    length_disagrees        it is not isolated, its length offset alone becomes unreliable, and the
                            finding stays latched as for several muscles.

A muscle may be repaired while its finding is latched, and the repair may make its length jump, or
its winch may take seconds to come to rest. A wrong length of this muscle alone therefore neither
replaces the finding nor revokes its length offset (`Evidence.MOVED`). `Estimator.reset` checks
whether the length agrees with the rest of the arm, and so does `Estimator.restore` for isolated
muscles. While a muscle is being verified, it cannot be restored, and the anomaly can only be ended
by isolating this muscle or by a length calibration.
"""

from collections.abc import Iterable

from musculoskeletal_ae.conditions import FindingReaction
from musculoskeletal_ae.estimation.finding import Finding
from musculoskeletal_ae.estimation.suspect_verification import (
    Outcome,
    Verification,
    VerificationVerdict,
)
from musculoskeletal_ae.robot.robot import Robot

#: verify no further suspect, and wait for a user, if this many suspects were verified as healthy
#: within WITHIN: there must be a fault that a verification does not reveal
ACQUITTALS = 2
WITHIN = 60.0  # remember for this long that a suspect was verified as healthy [s]


#: isolate the muscle without a verification if its kind of finding declares one of these reactions,
#: because there is no doubt which muscle is faulty
AT_ONCE = FindingReaction.ISOLATE_AT_ONCE, FindingReaction.ISOLATE_ONLY


class SuspectHandling:
    """Latches a finding, and decides which muscles are isolated because of it.

    Attributes:
        isolates: Whether suspects are isolated and verified, as with `on_anomaly: isolate`.
        finding: The latched finding, or None.
        verification: The running verification of the muscle that the finding names, or None.
        last_verdict: Index of the last verified suspect, or of a muscle isolated without a
            verification, and its verdict; None before the first.
        faults: Verdicts on the isolated muscles that turned out to be faulty, by index.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.isolates = False
        self.finding: Finding | None = None
        self.verification: Verification | None = None
        self.last_verdict: tuple[int, VerificationVerdict] | None = None
        self.faults: dict[int, VerificationVerdict] = {}
        self._acquitted: list[float] = []  # times at which suspects were verified as healthy [s]

    @property
    def verified(self) -> int | None:
        """Index of the muscle that is being verified; None if there is none."""
        if self.finding is None or self.verification is None:
            return None
        return self.finding.muscle

    @property
    def cause(self) -> str:
        """The latched finding as a text for users; '' if there is none."""
        if self.finding is None:
            return ''
        return f'{self._robot.muscles[self.finding.muscle]}: {self.finding.evidence}'

    @property
    def last_verification(self) -> str:
        """The last verdict of a verification as a text for users; '' before the first."""
        if self.last_verdict is None:
            return ''
        muscle, verdict = self.last_verdict
        return f'{self._robot.muscles[muscle]}: {verdict}'

    def take(
        self, finding: Finding, isolated: Iterable[int], now: float, has_network: bool = True
    ) -> tuple[int, ...]:
        """Take a finding: latch it and isolate its muscle, as its kind and the settings require.

        Args:
            finding: The finding of a detector.
            isolated: Indices of the muscles isolated so far.
            now: Time on a steady clock [s].
            has_network: Whether there is a network, without which no suspect can be verified.

        Returns:
            Indices of the muscles that are isolated from now on.
        """
        isolated, muscle = tuple(isolated), finding.muscle
        if finding.kind.reaction in AT_ONCE and self.isolates and muscle not in isolated:
            self.last_verdict = muscle, VerificationVerdict(Outcome(finding.kind.identifier))
            self.faults[muscle] = self.last_verdict[1]
            return (*isolated, muscle)
        if finding.kind.reaction is FindingReaction.ISOLATE_ONLY:
            return isolated
        if self.finding is not None:
            if finding.kind.revokes is not None and self.finding.kind.revokes is None:
                isolated = self.clear(isolated)  # the earlier finding is based on wrong lengths
                self.finding = finding
            return isolated
        self.finding = finding
        recent = [time for time in self._acquitted if now - time < WITHIN]
        may_isolate = self.isolates and finding.kind.reaction is FindingReaction.ISOLATE
        if not (may_isolate and has_network) or len(recent) >= ACQUITTALS:
            return isolated
        self.verification = self._verification_of(muscle)
        return (*isolated, muscle)

    def explains(self, finding: Finding) -> bool:
        """Return whether the repair of a muscle explains a new finding of a wrong length.

        The repair explains it if the latched finding names the same muscle and asks for a repair,
        because a repaired muscle may have another length offset.
        """
        suspected = self.finding
        if suspected is None or not suspected.kind.is_damage:
            return False
        return finding.is_of_one_length and finding.muscle in suspected.muscles

    def _verification_of(self, muscle: int) -> Verification:
        robot, bias = self._robot, float(self._robot.description.tension.bias[muscle])
        elastic = robot.series_elastic.of(muscle)
        at_zero = robot.routes.length_at_zero[muscle]
        return robot.actuation.choose(
            Verification(bias, stiffness=float(robot.stiffness[muscle])),
            Verification(
                bias, elongation=lambda tension: float(elastic.elongation(at_zero, tension))
            ),
        )

    def conclude(
        self, verdict: VerificationVerdict, isolated: Iterable[int], now: float
    ) -> tuple[int, ...]:
        """Conclude verification and anomaly; return which muscles (indices) stay isolated.

        A healthy suspect is restored, a faulty one stays isolated.
        """
        assert self.finding is not None
        muscle = self.finding.muscle
        self.last_verdict = muscle, verdict
        if verdict.outcome is Outcome.HEALTHY:
            self._acquitted.append(now)
        else:
            self.faults[muscle] = verdict
            self.verification = None  # so that `clear` leaves the suspect isolated
        return self.clear(isolated)

    def clear(self, isolated: Iterable[int]) -> tuple[int, ...]:
        """Clear the anomaly; return the indices of the muscles that are isolated from now on.

        A suspect that is being verified is restored.
        """
        verified = self.verified
        self.finding = self.verification = None
        return tuple(muscle for muscle in isolated if muscle != verified)

    def on_isolated(self, isolated: Iterable[int]) -> None:
        """Discard the verdicts on muscles that are no longer isolated, and stop verifying them.

        The finding stays latched. `isolated` are the indices of the muscles isolated from now on.
        """
        isolated = tuple(isolated)
        self.faults = {m: verdict for m, verdict in self.faults.items() if m in isolated}
        if self.verified not in isolated:
            self.verification = None
