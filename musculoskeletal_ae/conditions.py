# SPDX-License-Identifier: Apache-2.0
"""Declares everything that can be wrong with a running arm, in one table.

A *condition* is a fact that a user should know: a fault, a stop, or something that a node waits
for. The node that owns a fact reports it as long as it is true, and no other node infers it. A node
reports all conditions that are present; none hides another. Conditions travel on /diagnostics as
the value `conditions` (`to_json`), and readers sort and print them.

`ConditionKind` declares every kind with its text, its remedy and its consequence. The reference
pages on stops and on diagnostics are generated from this table.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from enum import Enum
from itertools import chain
from typing import Literal, NamedTuple, cast, get_args

from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.remedy_steps import REPAIR, Step

#: 'ok' means that nothing has to be done: another condition, or the user, is the cause
Level = Literal['ok', 'warn', 'error']
LEVELS: tuple[Level, ...] = get_args(Level)
CONDITIONS = 'conditions'  # key under which /diagnostics contains the list of conditions


class Clears(Enum):
    """How a stop may end before a reset, as the reference states it."""

    #: afterwards, once the arm has been released, only by a reset
    CONDITION = 'if the condition clears within `hold_time`'
    VERIFICATION = 'when a verification of the suspect muscle ends'
    RESET = '–'  # no earlier end


class Stop(NamedTuple):
    """Consequence of a stop cause: how the stop ends, and how the arm is released.

    A stop keeps the last command for `hold_time`, then pays out every muscle to T_bias.
    """

    clears: Clears
    #: whether the cause is a single event, which is over at once; otherwise it lasts until it
    #: clears
    is_event: bool = False
    releases_at_once: bool = False  # whether every muscle is paid out without waiting for hold_time


class FindingReaction(Enum):
    """What the estimator does about a finding besides reporting it, as the reference states it."""

    STOP = 'stops'  # latches an anomaly, which stops the arm
    #: latches an anomaly, or isolates and verifies the muscle with `on_anomaly: isolate`
    ISOLATE = 'stops or isolates'
    #: latches an anomaly, or isolates the muscle without a stop and without a verification
    ISOLATE_AT_ONCE = 'stops or isolates at once'
    ISOLATE_ONLY = 'isolates at once'  # only with `on_anomaly: isolate`, and without a stop


class Revokes(Enum):
    """The length offsets that become unreliable because of a finding."""

    ONE = 'revokes its offset'  # that of the muscle, unless it is isolated
    ALL = 'revokes all offsets'


class Declaration(NamedTuple):
    """Declaration of a kind of condition: its texts for users, its remedy and its consequences."""

    identifier: str  # stable name, by which programs recognise the kind
    owner: str  # names of the nodes that report the kind
    level: Level
    when: str  # when the condition is present, for the reference pages
    text: str  # text for users that says what happened
    steps: tuple[Step, ...] = ()  # steps of the remedy, in order
    stop: Stop | None = None  # what a stop cause does to the arm; None if the kind is no stop cause
    #: what the estimator does about a finding; None if the kind is no finding
    reaction: FindingReaction | None = None
    #: length offsets that become unreliable by a finding; None if there are none
    revokes: Revokes | None = None
    #: whether the muscle of a finding is damaged: a reset is refused until its readings fit again
    #: (`repair_check`), and its length may have another offset after the repair
    is_damage: bool = False


_RESET, _VERIFICATION, _CONDITION = Clears.RESET, Clears.VERIFICATION, Clears.CONDITION
_ALL = 'every node'


class ConditionKind(Enum):
    """All kinds of conditions. Readers print the conditions of one level in this order.

    If several stop causes begin together, `stop cause` of the controller is the first one here.
    """

    def __init__(  # the fields of `Declaration`
        self,
        identifier: str,
        owner: str,
        level: Level,
        when: str,
        text: str,
        steps: tuple[Step, ...],
        stop: Stop | None,
        reaction: FindingReaction | None,
        revokes: Revokes | None,
        is_damage: bool,
    ) -> None:
        self.identifier, self.owner, self.level = identifier, owner, level
        self.when, self.text, self.steps = when, text, steps
        self.stop, self.reaction, self.revokes = stop, reaction, revokes
        self.is_damage = is_damage

    @property
    def releases_at_once(self) -> bool:
        """Whether a stop of this cause pays the muscles out without holding the last command."""
        assert self.stop is not None, self
        return self.stop.releases_at_once

    @property
    def clears(self) -> Clears:
        """The ways in which a stop of this cause may end."""
        assert self.stop is not None, self
        return self.stop.clears

    # -- nodes and topics -----------------------------------------------------------------------

    NODE_ENDED = Declaration(
        'node_ended',
        'the status line and the page',
        'error',
        'a node of the arm that has reported before is not in the ROS graph any more',
        'the node has ended',
        (Step.RESTART_NODE,),
    )
    NODE_SILENT = Declaration(
        'node_silent',
        'the status line and the page',
        'error',
        'a node of the arm that has reported before has not reported for 2 s',
        'the node does not report',
        (Step.RESTART_NODE,),
    )
    INTERNAL_ERROR = Declaration(
        'internal_error',
        _ALL,
        'error',
        'an exception has escaped a timer of the node in the last 10 s',
        'internal error',
        (Step.REPORT_LOG,),
    )
    SECOND_PUBLISHER = Declaration(
        'second_publisher',
        _ALL,
        'error',
        'another node publishes a topic of the driver, the estimator, the learner or the '
        'controller, or has the name of this node',
        'another node publishes for this arm, or has the same name',
        (Step.STOP_SECOND_PUBLISHER, Step.RESET_CONTROLLER),
        Stop(_RESET),
    )
    SILENT_TOPIC = Declaration(
        'silent_topic',
        _ALL,
        'error',
        '`muscle_states` or `estimated_joint_states` is published or was received, but no usable '
        'message has arrived for 1 s',
        'no usable messages',
        (Step.CHECK_DRIVER,),
    )
    MISSING_TOPIC = Declaration(
        'missing_topic',
        _ALL,
        'warn',
        'a topic that the node needs has no publisher, and no usable message has arrived yet',
        'waiting for a topic',
    )
    SLOW_TOPIC = Declaration(
        'slow_topic',
        'estimator',
        'warn',
        'for 3 s, `muscle_states` have come at less than 40 % of the parameter `rate`',
        'messages come too slowly',
        (Step.CHECK_RATE,),
    )

    # -- emulated arm ---------------------------------------------------------------------------

    EMULATION_DIVERGED = Declaration(
        'emulation_diverged',
        'hardware_emulator',
        'error',
        'the emulated arm has left the range in which it can be simulated',
        'the emulated arm has left the range that can be simulated',
        (Step.RESET_EMULATOR,),
    )
    MODULES_IN_SAFE_STATE = Declaration(
        'modules_in_safe_state',
        'hardware_emulator',
        'warn',
        'the emulated modules receive no commands',
        'the modules are in their safe state, because no commands arrive',
        (Step.START_CONTROLLER,),
    )
    EMULATED_FAULT = Declaration(
        'emulated_fault',
        'hardware_emulator',
        'ok',
        'the parameter `faults` of the emulator names faults',
        'the emulator imitates faults',
        (Step.REPAIR_EMULATED_FAULT,),
    )

    # -- the body: findings of the detectors ----------------------------------------------------

    SLACK_TENDON = Declaration(
        'slack_tendon',
        'estimator',
        'error',
        'a muscle shows no tension although its command demands some: its tendon has ruptured or '
        'is slack, its winch is jammed, or its sensor reads too little',
        'a muscle shows no tension',
        REPAIR,
        reaction=FindingReaction.ISOLATE,
        is_damage=True,
    )
    MODULE_NOT_FOLLOWING = Declaration(
        'module_not_following',
        'estimator',
        'error',
        'the tension of a module (the length, if it follows positions) stays away from the value '
        'that its command demands, and its winch does not correct the difference: its motor is '
        'jammed or weak, a reading is wrong, or commands do not arrive',
        'a module does not follow its commands',
        REPAIR,
        reaction=FindingReaction.ISOLATE,
        is_damage=True,
    )
    SENSOR_FROZEN = Declaration(
        'sensor_frozen',
        'estimator',
        'error',
        'a length or tension sensor repeats one reading',
        'a sensor repeats one reading',
        REPAIR,
        reaction=FindingReaction.ISOLATE,
        is_damage=True,
    )
    RESIDUAL_DISTANCE = Declaration(
        'residual_distance',
        'estimator',
        'error',
        'tensions and lengths disagree with the learned body by more than on the healthy arm',
        'the readings do not fit the learned body',
        REPAIR,
        reaction=FindingReaction.ISOLATE,
        is_damage=True,
    )
    LENGTH_JUMP = Declaration(
        'length_jump',
        'estimator',
        'error',
        'the length of one muscle has jumped',
        'the length of a muscle has jumped',
        (Step.CHECK_TENDON, Step.CALIBRATE_LENGTHS),
        reaction=FindingReaction.ISOLATE,
        revokes=Revokes.ONE,
    )
    LENGTHS_JUMPED = Declaration(
        'lengths_jumped',
        'estimator',
        'error',
        'the lengths of several muscles have jumped',
        'several lengths have jumped',
        (Step.CALIBRATE_LENGTHS,),
        reaction=FindingReaction.STOP,
        revokes=Revokes.ALL,
    )
    MUSCLES_EXCHANGED = Declaration(
        'muscles_exchanged',
        'estimator',
        'error',
        'the driver has exchanged two muscles or reversed the sign of a length, in readings and '
        'commands',
        'the driver uses another order or sign of muscles',
        (Step.CORRECT_WIRING, Step.CALIBRATE_LENGTHS),
        reaction=FindingReaction.STOP,
        revokes=Revokes.ALL,
    )
    LENGTH_DISAGREES = Declaration(
        'length_disagrees',
        'estimator',
        'error',
        'the length of one muscle disagrees with the joint sensors',
        'the length of a muscle disagrees with the joint sensors',
        (Step.CHECK_TENDON, Step.CALIBRATE_LENGTHS),
        reaction=FindingReaction.ISOLATE,
        revokes=Revokes.ONE,
    )
    LENGTHS_DISAGREE = Declaration(
        'lengths_disagree',
        'estimator',
        'error',
        'the lengths of several muscles disagree with the joint sensors',
        'several lengths disagree with the joint sensors',
        (Step.CALIBRATE_LENGTHS,),
        reaction=FindingReaction.STOP,
        revokes=Revokes.ALL,
    )
    JOINT_SENSORS_DOUBTED = Declaration(
        'joint_sensors_doubted',
        'estimator',
        'warn',
        'readings of joint sensors disagree with the muscle lengths; they are neither used nor '
        'learned',
        'joint sensors are not used, because they disagree with the muscle lengths',
        (Step.CHECK_JOINT_SENSOR,),
    )
    JOINT_READINGS_IMPOSSIBLE = Declaration(
        'joint_readings_impossible',
        'estimator',
        'warn',
        'for more than 2 s, readings of a joint sensor were beyond the joint limits, or jumped '
        'further than a joint can move; the sensor is used again after 1 s without such a reading',
        'joint sensors are not used, because their readings are impossible',
        (Step.CHECK_JOINT_DRIVER,),
    )
    JOINT_READINGS_MISSING = Declaration(
        'joint_readings_missing',
        'estimator',
        'warn',
        'a joint that had readings in `joint_states` has had none for 1 s, or only NaN, although '
        '`muscle_states` are received',
        'no readings of joint sensors',
        (Step.CHECK_JOINT_DRIVER, Step.CONFIRM_REMOVED_SENSORS),
    )
    READINGS_REJECTED = Declaration(
        'readings_rejected',
        'estimator',
        'error',
        'muscle_states have been rejected for 0.1 s, because values are missing or implausible',
        'muscle_states are rejected',
        (Step.CHECK_SENSOR,),
    )
    VALUES_MISSING = Declaration(
        'values_missing',
        'estimator',
        'error',
        'the length or the tension of one muscle has been NaN for 0.15 s',
        'the length or the tension of a muscle is NaN',
        REPAIR,
        reaction=FindingReaction.ISOLATE_ONLY,
        is_damage=True,
    )
    SENSOR_SATURATED = Declaration(
        'sensor_saturated',
        'estimator',
        'error',
        'a tension sensor cannot read values up to tension.limit, so the muscle may pull harder '
        'than the sensor reads',
        'a tension sensor saturates below tension.limit',
        (Step.REPAIR_SENSOR, Step.RESET_ESTIMATOR),
        reaction=FindingReaction.ISOLATE_AT_ONCE,
    )
    HOT_MODULE_CHANGED = Declaration(
        'thermal_drift',
        'estimator',
        'error',
        'the constants of the thermal model of a hot module have changed',
        'a hot module heats up or cools down at another rate than before',
        REPAIR,
        reaction=FindingReaction.ISOLATE,
        is_damage=True,
    )
    MODULE_CHANGED = Declaration(
        'module_changed',
        'estimator',
        'warn',
        'the constants of the thermal model of a cool module have changed',
        'a cool module heats up or cools down at another rate than before',
        (Step.CHECK_MODULE,),
    )

    # -- the body: isolated muscles, length offsets, network ------------------------------------

    MUSCLE_ISOLATED = Declaration(
        'muscle_isolated',
        'estimator',
        'warn',
        'a muscle is isolated, and is not being verified',
        'a muscle is isolated and not used',
        (Step.REPAIR_MUSCLE, Step.RESTORE_MUSCLES),
    )
    MUSCLE_NEEDED = Declaration(
        'muscle_needed',
        'estimator',
        'warn',
        'a muscle is isolated, and joint angles would be undetermined if one of the named muscles '
        'were lost as well',
        'joint angles would be undetermined without another of these muscles',
        (Step.RESTORE_MUSCLES,),
    )
    LENGTH_OFFSETS_UNKNOWN = Declaration(
        'length_offsets_unknown',
        'estimator',
        'warn',
        'the length offsets of muscles are unknown or have been revoked',
        'length offsets unknown',
        (Step.CALIBRATE_LENGTHS,),
    )

    LENGTH_CALIBRATION_STUCK = Declaration(
        'length_calibration_stuck',
        'estimator',
        'warn',
        'a length calibration has enough data, but its offsets are not reliable',
        'the length calibration does not end',
        (Step.CHECK_SENSOR, Step.CALIBRATE_LENGTHS),
    )
    OTHER_MOUNTING = Declaration(
        'other_mounting',
        'estimator',
        'warn',
        'the tensions of an arm that has learned show another direction of gravity than robot.urdf',
        'the tensions show another direction of gravity than robot.urdf',
        (Step.CORRECT_MOUNTING, Step.RESET_ESTIMATOR),
    )
    UNSUITABLE_NETWORK = Declaration(
        'unsuitable_network',
        'estimator',
        'warn',
        'the network that the parameter checkpoint names explains the last 10 s clearly worse than '
        'the network before it, which had learned',
        'the chosen network fits this arm worse than the one before',
        (Step.CHECK_CHECKPOINT,),
    )

    # -- why the arm stands still ---------------------------------------------------------------

    OPERATOR = Declaration(
        'operator_stop',
        'controller',
        'error',
        'controller/stop was called',
        'controller/stop was called',
        (Step.RESET_CONTROLLER,),
        Stop(_RESET, is_event=True),
    )
    RESTARTED = Declaration(
        'restarted',
        'controller',
        'error',
        'the previous controller of this arm was killed or has crashed while it commanded the arm',
        'the previous controller did not end properly',
        (Step.RESET_CONTROLLER,),
        Stop(_RESET, is_event=True),
    )
    CONTROL_FAULT = Declaration(
        'control_fault',
        'controller',
        'error',
        'an exception escaped the computation of a command',
        'internal error of the controller',
        (Step.REPORT_LOG, Step.RESET_CONTROLLER),
        Stop(_RESET, is_event=True),
    )
    COMMAND_NOT_FINITE = Declaration(
        'command_not_finite',
        'controller',
        'error',
        'a computed command contains NaN or infinity',
        'the computed command is not finite',
        (Step.REPORT_LOG, Step.RESET_CONTROLLER),
        Stop(_RESET, is_event=True),
    )
    UNFIT_CHECKPOINT = Declaration(
        'unfit_checkpoint',
        'controller',
        'error',
        'a checkpoint was published that does not fit the robot',
        'unfit checkpoint',
        (Step.STOP_OTHER_ROBOT, Step.RESET_CONTROLLER),
        Stop(_RESET, is_event=True),
    )
    NO_CHECKPOINT = Declaration(
        'no_checkpoint',
        'estimator, controller, learner, sim',
        'warn',
        'the node has no network yet',
        'no network (checkpoint) yet',
        (Step.PROVIDE_CHECKPOINT, Step.RESET_CONTROLLER),
        Stop(_RESET),
    )
    ANOMALY = Declaration(
        'anomaly_detected',
        'controller',
        'error',
        'an anomaly is present; the estimator reports the finding',
        'the estimator has found a fault, which it reports',
        (Step.RESET_CONTROLLER,),
        Stop(_VERIFICATION),
    )
    LENGTH_OFFSETS_REVOKED = Declaration(
        'length_offsets_revoked',
        'controller',
        'error',
        'lengths jumped or disagree with joint sensors, and are not calibrated again yet',
        'the lengths are unreliable',
        (Step.CALIBRATE_LENGTHS, Step.RESET_CONTROLLER),
        Stop(_RESET),
    )
    IMPLAUSIBLE_MUSCLE_STATES = Declaration(
        'implausible_muscle_states',
        'controller',
        'error',
        'muscle_states were implausible for 0.1 s',
        'muscle_states are implausible',
        (Step.CHECK_SENSOR, Step.RESET_CONTROLLER),
        Stop(_VERIFICATION),
    )
    IMPLAUSIBLE_ESTIMATE = Declaration(
        'implausible_estimate',
        'controller',
        'error',
        'estimated_joint_states were implausible for 0.1 s',
        'the estimate is implausible',
        (Step.CHECK_CHECKPOINT, Step.CALIBRATE_LENGTHS, Step.RESET_CONTROLLER),
        Stop(_VERIFICATION),
    )
    OVERLOAD = Declaration(
        'overload',
        'controller',
        'error',
        'a tension is above 1.1 × tension.limit for 0.2 s although its muscle is paid out',
        'overload, although the muscle is paid out',
        (Step.FREE_ARM, Step.RESET_CONTROLLER),
        Stop(_VERIFICATION, releases_at_once=True),
    )
    OVERHEATED = Declaration(
        'overheated',
        'controller',
        'error',
        'a winding is 20 °C above temperature_limit, or heat limits all muscles to T_bias',
        'overheated',
        (Step.CHECK_COOLING, Step.WAIT_UNTIL_COOL, Step.RESET_CONTROLLER),
        Stop(_RESET),
    )
    STALE_MUSCLE_STATES = Declaration(
        'stale_muscle_states',
        'controller',
        'error',
        'no usable muscle_states have arrived for max_age',
        'no usable muscle_states',
        (Step.CHECK_DRIVER, Step.RESET_CONTROLLER),
        Stop(_CONDITION),
    )
    STALE_ESTIMATE = Declaration(
        'stale_estimate',
        'controller',
        'error',
        'no usable estimated_joint_states have arrived for max_age',
        'no usable estimated_joint_states',
        (Step.CHECK_ESTIMATOR, Step.RESET_CONTROLLER),
        Stop(_CONDITION),
    )

    # -- control --------------------------------------------------------------------------------

    GENTLE_ONLY = Declaration(
        'gentle_only',
        'controller',
        'warn',
        'the arm does not move, because its length offsets are unknown',
        'the length offsets are unknown: until they are known, the arm can only explore gently',
        (Step.EXPLORE_GENTLY,),
    )
    NOT_EXPLORING = Declaration(
        'not_exploring',
        'controller',
        'warn',
        'a stop has ended the exploration, or it was refused at the start',
        'the exploration was ended by a stop or refused, and does not go on by itself',
        (Step.EXPLORE,),
    )
    TARGET_CLAMPED = Declaration(
        'target_clamped',
        'controller',
        'warn',
        'the target of a joint exceeded its limits and was moved to the limit',
        'target clamped to the joint limits',
        (Step.CHANGE_TARGET,),
    )
    EFFORT_IGNORED = Declaration(
        'effort_ignored',
        'controller',
        'warn',
        'the target has efforts, which the control method does not use',
        'the effort of the target is ignored',
    )
    TRAJECTORY_SLOWED = Declaration(
        'trajectory_slowed',
        'controller',
        'warn',
        'the muscle modules are too slow for the requested trajectory',
        'trajectory slowed',
    )
    TORQUE_MISSING = Declaration(
        'torque_missing',
        'controller',
        'warn',
        'the target needs more torque than the muscles can exert',
        'the target needs more torque than the muscles can exert',
        (Step.CHANGE_TARGET,),
    )
    OUT_OF_REACH = Declaration(
        'out_of_reach',
        'controller',
        'warn',
        'the muscles cannot hold the target or move the arm there, or the hand cannot reach it',
        'the target cannot be reached or held',
        (Step.CHANGE_TARGET,),
    )
    AWAY_FROM_TARGET = Declaration(
        'away_from_target',
        'controller',
        'warn',
        'while the arm rests after a motion, a joint has been more than 0.5 rad away from its '
        'target for 5 s, or 0.25 rad further away than before in this rest, according to the '
        'estimate',
        'the arm is not at its target',
        (Step.CHECK_LOAD,),
    )
    LOAD_CHANGED = Declaration(
        'load_changed',
        'controller',
        'warn',
        'while the arm rests after a motion, the external torque has changed by more than three '
        'times the residual torque of the healthy moving arm, and no payload in the hand explains '
        'the change',
        'the load on the resting arm has changed',
        (Step.CHECK_LOAD, Step.CHANGE_TARGET),
    )
    TENSION_LIMITED_BY_HEAT = Declaration(
        'tension_limited_by_heat',
        'controller',
        'warn',
        'the temperature of a winding limits the tension of its muscle to less than 90 % of '
        'tension.limit',
        'heat limits the tension',
        (Step.CHECK_COOLING, Step.WAIT_UNTIL_COOL),
    )

    # -- learning -------------------------------------------------------------------------------

    TRAINING_FAILED = Declaration(
        'training_failed',
        'learner',
        'error',
        'the training process has ended or does not answer',
        'the training process has ended or does not answer',
        (Step.RESTART_NODE,),
    )
    STATE_NOT_SAVED = Declaration(
        'state_not_saved',
        'estimator, controller, learner',
        'warn',
        'what a restarted node should know cannot be saved: the length offsets, isolated muscles '
        'and joint sensors in doubt, the stop, or the samples and the network (error)',
        'the newest state is not on disk',
        (Step.FREE_DISK,),
    )
    SENSOR_OFFSET_IMPOSSIBLE = Declaration(
        'sensor_offset_impossible',
        'learner',
        'error',
        'an update has found an offset of a joint sensor above 0.35 rad, and is not used',
        'the result of learning is not used, because it contains a larger offset than a joint '
        'sensor can have',
        (Step.CHECK_JOINT_SENSOR, Step.LEARN_AFRESH),
    )
    LEARNING_DISABLED = Declaration(
        'learning_disabled',
        'learner',
        'warn',
        'learner/enable was called with false',
        'learning was stopped by learner/enable',
        (Step.ENABLE_LEARNING,),
    )
    LEARNING_WAITS = Declaration(
        'learning_waits',
        'learner',
        'ok',
        'learning waits for the end of an anomaly or of a length calibration',
        'learning waits',
    )
    NOTHING_TO_LEARN = Declaration(
        'nothing_to_learn',
        'learner',
        'warn',
        'no message was usable for 5 s',
        'nothing to learn from',
    )

    # -- requests and recordings ----------------------------------------------------------------

    REQUEST_REFUSED = Declaration(
        'request_refused',
        _ALL,
        'warn',
        'a request was refused in the last 10 s',
        'a request was refused',
    )
    REPLAY_STANDS = Declaration(
        'replay_stands',
        'replay',
        'warn',
        'the replay waits for nodes, is paused, or has ended',
        'the recording is not being played',
    )
    REPLAY_SLOW = Declaration(
        'replay_slow',
        'replay',
        'warn',
        'playback waits for nodes and runs at less than half of the wanted speed',
        'the recording is played slowly',
    )

    def condition(
        self,
        detail: str = '',
        subjects: Iterable[str] = (),
        *,
        level: Level | None = None,
        steps: Iterable[Step] | None = None,
    ) -> Condition:
        """Return a condition of this kind.

        Args:
            detail: Values and names that the text states.
            subjects: Names of the muscles, joints, topics or nodes that are concerned.
            level: Level of this condition, if it differs from the declared one.
            steps: Remedy of this condition, if it differs from the declared one.
        """
        return Condition(
            self.identifier,
            self.level if level is None else level,
            f'{self.text}: {detail}' if detail else self.text,
            self.steps if steps is None else tuple(steps),
            tuple(subjects),
        )


KINDS = {kind.identifier: kind for kind in ConditionKind}  # all kinds by identifier
ORDER = {identifier: place for place, identifier in enumerate(KINDS)}


class Condition(NamedTuple):
    """A condition that is present.

    Attributes:
        identifier: Identifier of its kind, for programs.
        level: How urgent it is.
        text: What has happened, for users; understandable without any other text.
        steps: Steps that end it, in order; () if it ends by itself.
        subjects: Names of the muscles, joints, topics or nodes that it concerns.
    """

    identifier: str
    level: Level
    text: str
    steps: tuple[Step, ...] = ()
    subjects: tuple[str, ...] = ()

    @property
    def kind(self) -> ConditionKind:
        """The declaration of this kind of condition."""
        return KINDS[self.identifier]


def ordered(conditions: Iterable[Condition]) -> tuple[Condition, ...]:
    """Return conditions in the order in which users read them: by level, then as declared."""
    return tuple(
        sorted(
            conditions,
            key=lambda each: (-LEVELS.index(each.level), ORDER.get(each.identifier, len(ORDER))),
        )
    )


def worst(conditions: Iterable[Condition]) -> Level:
    """Return the level of the most urgent condition; 'ok' without conditions."""
    levels = (each.level for each in conditions)
    return max(levels, key=LEVELS.index, default='ok')


def remedy_of(conditions: Iterable[Condition]) -> tuple[Step, ...]:
    """Return the steps that end all these conditions, each step once.

    A reset of the controller comes after the steps that remove causes, and an exploration after the
    reset (`Step.place`).
    """
    steps = dict.fromkeys(chain.from_iterable(each.steps for each in conditions))
    return tuple(sorted(steps, key=lambda step: step.place))


def to_json(conditions: Iterable[Condition]) -> str:
    """Return conditions as the value `conditions` of /diagnostics: a JSON list of objects."""
    rows = [
        {
            'identifier': each.identifier,
            'level': each.level,
            'text': printable(each.text),
            'steps': [step.identifier for step in each.steps],
            'subjects': [printable(subject) for subject in each.subjects],
        }
        for each in conditions
    ]
    return json.dumps(rows, ensure_ascii=False, separators=(',', ':'))


def from_json(value: str) -> tuple[Condition, ...]:
    """Return the conditions that a value `conditions` of /diagnostics contains.

    Any node may publish on /diagnostics. Entries that are not conditions are left out, and so are
    unknown steps.
    """
    try:
        rows = json.loads(value)
    except (ValueError, RecursionError):
        return ()
    conditions = []
    for row in rows if isinstance(rows, list) else []:
        if not isinstance(row, dict) or row.get('level') not in LEVELS:
            continue
        identifier, text = row.get('identifier'), row.get('text')
        if not (isinstance(identifier, str) and isinstance(text, str)):
            continue
        steps = (Step.named(name) for name in _strings(row.get('steps')))
        conditions.append(
            Condition(
                identifier,
                cast(Level, row['level']),
                text,
                tuple(step for step in steps if step is not None),
                _strings(row.get('subjects')),
            )
        )
    return tuple(conditions)


def _strings(value: object) -> tuple[str, ...]:
    items = value if isinstance(value, list) else []
    return tuple(item for item in items if isinstance(item, str))


def stop_causes() -> list[ConditionKind]:
    """Return the kinds that stop the arm."""
    return [kind for kind in ConditionKind if kind.stop is not None]
