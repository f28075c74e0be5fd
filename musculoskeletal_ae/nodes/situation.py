# SPDX-License-Identifier: Apache-2.0
"""Summarizes the state of a running arm from the reports of all nodes on /diagnostics.

The level of the whole arm is the worst level of its nodes. It is 'error' if a required node stops
reporting, if an anomaly is detected, or if nodes use different networks. This module decides only
by identifiers in the reports, such as the controller's values `mode` and `stop cause`. It shows the
sentences in the reports unchanged, and never parses them.
"""

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from musculoskeletal_ae import remedy
from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.control import stops
from musculoskeletal_ae.control.stops import Clears, StopCause
from musculoskeletal_ae.control.supervisor import Activity, StopState
from musculoskeletal_ae.estimation.status import CALIBRATION, GENTLE_MOTION, ISOLATION
from musculoskeletal_ae.estimation.verification import LONGEST
from musculoskeletal_ae.nodes.diagnostics import PERIOD
from musculoskeletal_ae.nodes.needed_topics import SILENT_TOPIC
from musculoskeletal_ae.nodes.progress import LONGEST_STALL
from musculoskeletal_ae.nodes.sources import SEVERAL
from musculoskeletal_ae.remedy import EMULATED_FAULTS, NO_FAULTS, REMEDY_STEPS, REPAIR, Step
from musculoskeletal_ae.report import (
    ANOMALY,
    END_OF_RECORDING,
    LENGTH_OFFSETS,
    MUSCLE_STATES,
    NOT_WAITED_FOR,
    PLAYING,
    WAITING,
    WAITS_FOR,
    Level,
    load_text,
    overload_advice,
    overload_text,
)

LARGEST_AGE = 1.0  # age above which a measured or estimated value is no longer shown [s]
#: time without a report after which a node counts as silent [s]; nodes report once a second
SILENCE = 2.0
TICK = 1.0  # time between two ticks above which this process was paused [s]
#: time without a report after which a node that is not in NEEDED no longer counts [s]
FORGET_TIME = 5.0
#: nodes whose silence is an error once they have reported
NEEDED = 'controller', 'estimator', 'hardware_emulator', 'learner', 'sim'
FOLLOWERS = 'controller', 'sim'  # nodes that use the network that the estimator has accepted
VERSION = 'checkpoint version'  # key of the version in reports
#: number of the estimator's reports (one a second) during which other nodes may lag behind the
#: estimator: they may use a previous network, or wait for the end of an anomaly that has just ended
REPORTS = 3

STOPPED, VERIFYING = StopState.STOPPED.value, StopState.VERIFYING.value
#: remedy for a length calibration that does not end
CALIBRATION_STEPS = Step.CHECK_SENSOR, Step.CALIBRATE_LENGTHS
#: activities in which the arm does not move while the length offsets are unknown, and in which
#: controller/explore is not refused
STANDING_STILL = Activity.IDLE, Activity.HOLDING, Activity.MOVING, Activity.TORQUE
#: modes in which the arm runs without exploring
NOT_EXPLORING = {activity.value for activity in (*STANDING_STILL, Activity.GRAVITY_COMPENSATION)}


def figures(measured: bool, error: float, anomaly: float, unit: str = 'rad') -> str:
    """Return the estimation error and the anomaly measure A as text.

    For an unknown value, the text names the topic on which messages are missing.

    Args:
        measured: Whether joint sensors measure θ.
        error: Estimation error in the unit `unit`; NaN if it is unknown.
        anomaly: A; NaN if it is unknown.
        unit: Unit of the error.
    """
    joints = 'estimated_joint_states' if measured else 'joint_states'
    error_text = f'waits for {joints}' if math.isnan(error) else f'{error:.3f} {unit}'
    anomaly_text = 'waits for anomaly' if math.isnan(anomaly) else f'{anomaly:.3f}'
    return f'error {error_text}  A {anomaly_text}'


class Trouble(NamedTuple):
    """One part of the status line: a problem with its remedy."""

    text: str
    steps: tuple[Step, ...] = ()  # the remedy


class Node:
    """The last report of one node.

    Attributes:
        level: Level of the report.
        message: Message of the report.
        values: Values of the report, by name.
        heard_at: Time of arrival, excluding pauses of this process [s].
    """

    def __init__(self, status: DiagnosticStatus, heard_at: float) -> None:
        self.level: bytes = status.level
        self.message: str = status.message
        self.values = {value.key: value.value for value in status.values}
        self.heard_at = heard_at


class Situation:
    """The newest diagnostics of one namespace, and the remedies for the problems in them.

    Attributes:
        detected: Whether the estimator has detected an anomaly.
        suspect: Name of the muscle that the estimator suspects most, or ''.
        evidence: Why the estimator has detected an anomaly, or ''.
        distance: Distance d of the anomaly detector; NaN if unknown.
        limit: Value of d above which a message counts as an anomaly; NaN if unknown.
        samples: Number of samples learned, or '' without a learner.
        checkpoints: Number of networks published, or '' without a learner.
        doing: Message of the controller's last report.
    """

    def __init__(
        self,
        namespace: str,
        clock: Callable[[], float] = time.monotonic,
        expects_replay: bool = False,
    ) -> None:
        """Start without reports.

        Args:
            namespace: The namespace of the arm.
            clock: Returns the time of a steady clock [s].
            expects_replay: Whether messages come from a node `replay`, which may not run yet.
        """
        self._clock, self._awake = clock, AwakeClock(TICK)
        self._here = namespace.rstrip('/')
        self.detected = False
        self.samples = self.checkpoints = self.doing = ''
        self.suspect = self.evidence = ''
        self._finding = ''  # kind of the estimator's finding; 'none', or '' if it is unknown
        self._clear_reports = 0  # successive reports of the estimator without a finding
        self._has_ended = False  # whether an anomaly has ended during the present stop
        self._was_verifying = False  # whether the last anomaly ended with a verification
        #: whether an emulator has reported, since the last anomaly began, that no muscle is faulty
        self._has_no_faults = False
        #: number of the estimator's reports since the last one during a length calibration
        self._since_calibration = REPORTS + 1
        self.distance = self.limit = math.nan
        #: when `replay` began or continued to play [s]; inf: it does not play; -inf: there is none
        self._playing_since = math.inf if expects_replay else -math.inf
        self._recording_ended_at = math.inf  # when `replay` first reported its end [s]
        self._nodes: dict[str, Node] = {}  # last report of each node, by full name
        self._accepted: deque[str] = deque(maxlen=REPORTS)  # versions in the estimator's reports
        #: version of the network that a node uses instead of the accepted network, and the number
        #: of reports that name this version, by node
        self._other_networks: dict[str, tuple[str, int]] = {}

    def tick(self) -> None:
        """Remove the reports of nodes that have ended.

        Call this about once a second, because longer intervals count as pauses of this process.
        """
        self._awake.tick(self._clock())
        for name, node in list(self._nodes.items()):
            if not _is_needed(name) and self._now - node.heard_at > FORGET_TIME:
                del self._nodes[name]
                if name == f'{self._here}/replay':
                    self._playing_since = -math.inf

    @property
    def _now(self) -> float:
        """The present time, excluding pauses of this process [s]."""
        return self._awake.at(self._clock())

    def diagnosed(self, message: DiagnosticArray) -> None:
        """Store the reports that a message of /diagnostics contains."""
        for status in message.status:
            full_name, _, _ = status.name.partition(':')
            namespace, _, name = full_name.rpartition('/')
            if namespace != self._here:
                continue
            node = self._nodes[full_name] = Node(status, self._now)
            if name == 'learner':
                self.samples = node.values.get('samples', '')
                self.checkpoints = node.values.get('checkpoints', '')
            elif name == 'estimator':
                self._take_estimator(node.values)
                self._accepted.append(node.values.get(VERSION, ''))
            elif name == 'hardware_emulator':
                self._has_no_faults = node.values.get(EMULATED_FAULTS) == NO_FAULTS
            elif name == 'controller':
                self.doing = node.message
                if node.values.get('mode') not in (STOPPED, VERIFYING):
                    self._has_ended = False
            elif name == 'replay':
                self._take_replay(node.values.get('state', PLAYING))
            if name in FOLLOWERS:
                self._compare_network(name, node.values.get(VERSION, ''))

    def _take_estimator(self, values: dict[str, str]) -> None:
        was_detected = self.detected
        self._finding = values.get('finding', '')
        self.detected = self._finding not in ('', 'none')
        if self.detected and not was_detected:
            self._has_no_faults = False  # the last report of the emulator may be older
        if self._finding == 'none' and was_detected:
            self._has_ended = True
        if self.detected:
            self._was_verifying = values.get('verification') == 'running'
        is_calibrating = values.get('state') == 'calibrating'
        self._since_calibration = 0 if is_calibrating else self._since_calibration + 1
        self._clear_reports = self._clear_reports + 1 if self._finding == 'none' else 0
        self.suspect = values.get('suspect muscle', '')
        self.evidence = values.get('evidence', '')
        self.distance = self.limit = math.nan
        with contextlib.suppress(ValueError):
            self.distance = float(values.get('d', 'nan'))
            self.limit = float(values.get('d limit', 'nan'))

    def _take_replay(self, state: str) -> None:
        if state != PLAYING:
            self._playing_since = math.inf
        elif math.isinf(self._playing_since):
            self._playing_since = self._now
        if state != END_OF_RECORDING:
            self._recording_ended_at = math.inf
        elif math.isinf(self._recording_ended_at):
            self._recording_ended_at = self._now

    def _compare_network(self, node: str, version: str) -> None:
        """Count the successive reports in which a node's network differs from the estimator's."""
        if not version or not self._accepted or version in self._accepted:
            self._other_networks.pop(node, None)
            return
        _, reports = self._other_networks.get(node, ('', 0))
        self._other_networks[node] = version, reports + 1

    def level(self) -> Level:
        """Return the level of the whole arm."""
        if self.detected or self._silent() or self._mismatches():
            return 'error'
        levels = [node.level for name, node in self._nodes.items() if not _is_own(name)]
        if any(level not in (DiagnosticStatus.OK, DiagnosticStatus.WARN) for level in levels):
            return 'error'
        return 'warn' if DiagnosticStatus.WARN in levels else 'ok'

    def trouble(self) -> str:
        """Return, as one text, the causes of a stop with remedies, other errors, and warnings."""
        return ', '.join(trouble.text for trouble in self._troubles())

    def steps(self) -> list[str]:
        """Return the identifiers of the steps that `trouble` advises (`remedy.Step`), each once."""
        steps = (step for trouble in self._troubles() for step in trouble.steps)
        return [step.identifier for step in dict.fromkeys(steps)]

    def _troubles(self) -> list[Trouble]:
        others = [Trouble(text) for text in (*self._mismatches(), *self._silent())]
        errors, warnings = list[Trouble](), list[Trouble]()
        if self.has_recording_ended:
            errors.append(Trouble('end of the recording'))
        elif waiting := self.replay_waits():
            errors.append(Trouble(waiting))
        # Just after a replay has begun to play, the last reports of nodes may be older.
        is_silence_explained = self._now - self._playing_since < REPORTS * PERIOD
        for name, node in self._nodes.items():
            if _is_own(name) or node.level == DiagnosticStatus.OK:
                continue
            is_silence = SILENT_TOPIC in node.values or node.values.get(WAITS_FOR) == MUSCLE_STATES
            if is_silence and is_silence_explained:
                continue
            if self._is_shown(name, node):
                if (silent := node.values.get(SILENT_TOPIC)) and not self._explains(node):
                    errors.append(Trouble(f'{name}: {silent}'))
                if refused := node.values.get('refused'):
                    warnings.append(Trouble(f'warning: {name}: refused {refused}'))
                continue
            if node.level == DiagnosticStatus.WARN:
                # A pause ends by itself, so its steps are not necessary yet.
                is_paused = 'stop cause' in node.values
                steps = () if is_paused else remedy.parse(node.values.get(REMEDY_STEPS, ''))
                warnings.append(Trouble(f'warning: {name}: {node.message}', steps))
            else:
                steps = remedy.parse(node.values.get(REMEDY_STEPS, ''))
                errors.append(Trouble(f'{name}: {node.message}', steps))
        return [*self._stops(), *others, *errors, *self._body(), *warnings]

    def replay_waits(self) -> str:
        """Return what `replay` waits for before it begins to play, or ''."""
        if self._values('replay').get('state') != WAITING:
            return ''
        return f'replay is {self._nodes[f"{self._here}/replay"].message}'

    @property
    def has_recording_ended(self) -> bool:
        """Whether `replay` has played its recording to the end."""
        return self._values('replay').get('state') == END_OF_RECORDING

    @property
    def has_last_report(self) -> bool:
        """Whether the learner, if there is one, has reported since the recording ended."""
        learner = self._nodes.get(f'{self._here}/learner')
        return learner is None or learner.heard_at > self._recording_ended_at

    def learned(self) -> str:
        """Return from how many samples of a recording the learner has learned; '' without one.

        If nodes may have missed messages, the text says so, with the remedy.
        """
        if self.samples == '':
            return ''
        postures = 'resting posture' if self.samples == '1' else 'resting postures'
        text = f'learned from {self.samples} {postures} of the recording'
        if lost := self._values('replay').get(NOT_WAITED_FOR):
            cause = overload_text() or 'see their logs'
            text += (
                f'; {lost} may have missed messages, because the replay got no answer ({cause}): '
                'play the recording again, or use train --from-bag, which loses none'
            )
        return text

    def why_no_estimate(self) -> str:
        """Return why there are no estimates: the last rejected message of the estimator, or ''.

        If the estimator has rejected nothing, the text states the problems of all nodes.
        """
        rejected = self._values('estimator').get('last rejected', '')
        return f'rejected {rejected}' if rejected else self.trouble()

    def _values(self, name: str) -> dict[str, str]:
        node = self._nodes.get(f'{self._here}/{name}')
        return {} if node is None else node.values

    @property
    def _has_consequences(self) -> bool:
        """Whether other stop causes, those in `stops.CONSEQUENCES`, are caused by an anomaly.

        Users then need no steps against these other causes. Just after the end of an anomaly, the
        last reports of other nodes may be older, so the result is still True. It is False if an
        earlier anomaly has already ended during this stop: its remedy has not helped, and the
        anomaly may itself be the consequence of another cause.
        """
        is_new = not self._has_ended if self.detected else self._has_just_ended
        return is_new and f'{self._here}/estimator' not in self.silent_nodes()

    @property
    def _has_just_ended(self) -> bool:
        """Whether the anomaly of this stop has ended so recently that reports may be older."""
        return self._has_ended and 0 < self._clear_reports <= REPORTS

    def _explains(self, node: Node) -> bool:
        """Return whether the anomaly explains why a node receives no usable estimates."""
        # The step for a silent topic is the last one (`NeededTopics`).
        steps = remedy.parse(node.values.get(REMEDY_STEPS, ''))
        return self._has_consequences and steps[-1:] == (Step.CHECK_ESTIMATOR,)

    def _is_shown(self, name: str, node: Node) -> bool:
        """Return whether `_stops` or `_body` already shows the report of a node."""
        if node.level == DiagnosticStatus.OK or 'fault' in node.values:
            return False
        if SEVERAL in node.values:  # already shown if the controller's stop names these publishers
            control = self._values('controller')
            is_stopped = control.get('stop cause') == StopCause.SECOND_PUBLISHER.identifier
            return is_stopped and node.values[SEVERAL] in control.get('stop', '')
        if node.values.get(WAITS_FOR) == ANOMALY:
            # When the anomaly has just ended, the last report of the waiting node may be older.
            return self.detected or 0 < self._clear_reports <= REPORTS
        if node.values.get(WAITS_FOR) == LENGTH_OFFSETS:
            return bool(self._unknown_offsets) or self._has_just_calibrated
        if name == f'{self._here}/controller':
            return node.values.get('mode') in (STOPPED, VERIFYING)
        if name == f'{self._here}/estimator':
            is_isolating = node.values.get('state') == 'isolated'
            return is_isolating if node.level == DiagnosticStatus.WARN else self.detected
        return False

    def _stops(self) -> list[Trouble]:
        """Return the parts of the status line about an anomaly and a stop."""
        control, estimator = self._values('controller'), self._values('estimator')
        mode, cause = control.get('mode'), control.get('stop cause', '')
        is_stopped = mode in (STOPPED, VERIFYING)
        causes = stops.parse(control.get(stops.STOP_CAUSES, cause))
        # A verification, and what follows from it, ends the stop unless a cause needs a reset.
        ends_by_itself = self.is_verifying or (self._has_just_ended and self._was_verifying)
        passing = {each for each in causes if each.clears is Clears.VERIFICATION}
        lasting = [each for each in causes if each not in passing | stops.CONSEQUENCES]
        # If the anomaly is one of the causes of the stop, the remedy is shown with the stop only.
        is_in_stop = is_stopped and StopCause.ANOMALY in causes
        evidence = f': {self.evidence}' if self.evidence else ''
        of_finding = remedy.parse(estimator.get(REMEDY_STEPS, '')) or REPAIR
        troubles = []
        if self.detected and self.is_verifying:
            end = f'(ends by itself within {LONGEST:g} s)'
            troubles.append(Trouble(f'ANOMALY: {self.suspect} is being verified{evidence} {end}'))
        elif self.detected and is_in_stop:
            troubles.append(Trouble(f'ANOMALY: {self.suspect}{evidence}'))
        elif self.detected:
            troubles.append(self._with_remedy(f'ANOMALY: {self.suspect}{evidence}', *of_finding))
        stop = control.get('stop', cause)
        if is_stopped and ends_by_itself and not lasting:
            if self.detected and cause != StopCause.ANOMALY.identifier:
                troubles.append(Trouble(f'STOPPED: {stop}'))
        elif is_stopped:
            text, steps = control.get('remedy', ''), remedy.parse(control.get(REMEDY_STEPS, ''))
            if (is_in_stop and self._finding) or (causes and self.detected):
                # The estimator knows the kind of the finding, and whether the anomaly has ended.
                explored = Step.EXPLORE in steps
                known = of_finding if self.detected and not ends_by_itself else ()
                settled = stops.CONSEQUENCES if self._has_consequences else ()
                needed = lasting if ends_by_itself else causes
                steps = tuple(stops.remedy_of(needed, explored, known, settled))
                text = self._sentence(steps)
            troubles.append(Trouble(f'STOPPED: {stop} (to go on: {text})', self._needed(steps)))
        return troubles

    def _with_remedy(self, text: str, *steps: Step) -> Trouble:
        return Trouble(f'{text} (to go on: {self._sentence(steps)})', self._needed(steps))

    def _needed(self, steps: Iterable[Step]) -> tuple[Step, ...]:
        """Return the steps of a remedy without a repair that an emulated arm does not need."""
        needless = {Step.REPAIR_MUSCLE} if self._has_no_faults else set()
        return tuple(step for step in steps if step not in needless)

    def _sentence(self, steps: Iterable[Step]) -> str:
        """Return a remedy as a text, which also states how to repair an emulated arm."""
        faults = self._values('hardware_emulator').get(EMULATED_FAULTS, '')
        return remedy.sentence(self._needed(steps), faults)

    def _mismatches(self) -> list[str]:
        overload = overload_advice()
        mismatches = []
        for node, (version, reports) in self._other_networks.items():
            if reports < REPORTS:
                continue
            advice = f'if this lasts, restart {node} or bringup.sh'
            if overload and reports * PERIOD <= LONGEST_STALL:
                advice = overload
            mismatches.append(
                f'{node} uses network {version}, but the estimator uses network '
                f'{self._accepted[-1]}; {advice}'
            )
        return mismatches

    def silent_nodes(self) -> dict[str, float]:
        """Return the time [s] since the last report of each needed node that is silent, by name."""
        now = self._now
        return {
            name: now - node.heard_at
            for name, node in self._nodes.items()
            if now - node.heard_at > SILENCE and _is_needed(name)
        }

    def _silent(self) -> list[str]:
        silent = self.silent_nodes()
        if not silent:
            return []
        names, longest = ', '.join(silent), max(silent.values())
        since = f'{names}: no report for {longest:.0f} s'
        if overload := overload_advice():
            text = f'{since}; {overload}'
            # A node that hangs ends by itself by this time, so a healthy node has no reason to be
            # restarted earlier.
            if longest <= LONGEST_STALL:
                return [text]
            return [f'{text}; if it persists, see the log of each node and restart bringup.sh']
        if len(silent) > 1:  # several nodes hardly end together, so there is a common cause
            advice = f'perhaps the computer is overloaded (load {load_text()})'
            return [f'{since}; {advice}; if it persists, see their logs and restart bringup.sh']
        return [f'{since}; see its log, then restart the node or bringup.sh']

    def _body(self) -> list[Trouble]:
        """Return the parts of the status line about isolated muscles and length offsets.

        Length offsets are unknown if the estimator or the controller reports them as unknown. Only
        the controller does so after a restart of the estimator: the estimator then uses the offsets
        with which it starts every time, and these may be wrong.
        """
        values, troubles = self._values('estimator'), []
        if isolated := self._isolated():
            troubles.append(Trouble(isolated))
        if unknown := self._unknown_offsets:
            text = f'length offsets unknown: {unknown}'
            steps: tuple[Step, ...] = (Step.CALIBRATE_LENGTHS,)
            of_finding = remedy.parse(values.get(REMEDY_STEPS, ''))
            if self._has_consequences and Step.CALIBRATE_LENGTHS not in of_finding:
                steps = ()  # the lengths are calibrated after the anomaly
            if values.get('state') == 'calibrating':
                steps = CALIBRATION_STEPS if values.get('calibration problem') else ()
                if not steps and values.get(CALIBRATION) == GENTLE_MOTION and self._stands_still:
                    steps = (Step.EXPLORE_GENTLY,)
            troubles.append(self._with_remedy(text, *steps) if steps else Trouble(text))
        return troubles

    @property
    def _unknown_offsets(self) -> str:
        """Names of the muscles with unknown length offsets, or ''.

        Just after a length calibration, the last report of the controller may be older.
        """
        key = 'unknown length offsets'
        names = self._values('estimator').get(key, '')
        if names or self._has_just_calibrated:
            return names
        return self._values('controller').get(key, '')

    @property
    def _has_just_calibrated(self) -> bool:
        return 0 < self._since_calibration <= REPORTS

    def _isolated(self) -> str:
        """Return a text on the isolated muscles, or ''.

        The text states how to use these muscles again. These steps are not part of `steps`, because
        the arm also works without the muscles. A suspect that is being verified is not mentioned.
        """
        values = self._values('estimator')
        names = values.get('isolated muscles', '')
        each = (values.get(ISOLATION) or names).split(', ')
        if self.is_verifying:
            each = [muscle for muscle in each if muscle != self.suspect]
        if not any(each):
            return ''
        has_faults = values.get(ISOLATION, names) != names
        steps = (Step.REPAIR_MUSCLE,) * has_faults + (Step.RESTORE_MUSCLES,)
        return f'isolated: {", ".join(each)} (to use it again: {self._sentence(steps)})'

    @property
    def is_verifying(self) -> bool:
        """Whether a suspect is isolated only to be verified.

        The estimator decides this. The controller may report the mode `verifying` for longer.
        """
        return self._values('estimator').get('verification') == 'running'

    @property
    def _stands_still(self) -> bool:
        """Whether the arm waits, without moving, while length offsets are unknown.

        It waits in the modes `idle`, `holding`, `moving` and `torque` of the controller.
        """
        mode = self._values('controller').get('mode')
        return mode in [activity.value for activity in STANDING_STILL]

    @property
    def is_stopped(self) -> bool:
        """Whether the controller is stopped."""
        return self._values('controller').get('mode') == STOPPED

    def hint(self) -> str:
        """Return why the error may rise before learning begins; '' once learning has begun."""
        values = self._values('learner')
        if self.samples == '' or values.get('network learned') == 'True':
            return ''
        needed = values.get('samples to begin with', '1')
        if not self.samples.isdecimal() or int(self.samples) >= int(needed):
            return ''
        why = 'nothing learned yet: the error may rise'
        return why if needed == '1' else f'{why}; learning begins with {needed} samples'

    def unexplored(self) -> str:
        """Return that the arm does not explore, with its mode, or ''.

        The text is '' without a learner, during a stop, and if `trouble` says the same.
        """
        mode = self._values('controller').get('mode')
        advised = {Step.EXPLORE.identifier, Step.EXPLORE_GENTLY.identifier}.intersection(
            self.steps()
        )
        if self.samples == '' or mode not in NOT_EXPLORING or advised:
            return ''
        return f'{mode}, not exploring'


def _is_needed(name: str) -> bool:
    """Return whether a node's silence is an error."""
    return name.rpartition('/')[2] in NEEDED


def _is_own(name: str) -> bool:
    """Return whether a node only summarizes the reports of other nodes."""
    return name.rpartition('/')[2] == 'bringup_status'
