# SPDX-License-Identifier: Apache-2.0
"""Declares the steps of remedies: identifiers for programs, and texts for users.

A remedy is a sequence of steps, to be taken in order. `conditions.py` states the remedy of each
kind of condition.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum


class Step(Enum):
    """One step of a remedy; the value contains the stable identifier and the text.

    The steps of several remedies are taken in the order of `place`, which is 0 for steps that
    remove a cause.
    """

    def __init__(self, identifier: str, text: str, place: int = 0) -> None:
        self.identifier, self.text, self.place = identifier, text, place

    CORRECT_WIRING = (
        'correct_wiring',
        'correct the order of the muscles, or the sign of the length, in the driver',
    )
    REPAIR_MUSCLE = 'repair_muscle', 'repair tendon, winch or sensor of the named muscle'
    REPAIR_EMULATED_FAULT = (
        'repair_emulated_fault',
        "set faults of hardware_emulator to ['']; a tendon can also be repaired on the page",
    )
    FREE_ARM = 'free_arm', 'remove what pulls at the arm'
    CHECK_SENSOR = (
        'check_sensor',
        'check the sensors of the named muscles',
    )
    REPAIR_SENSOR = (
        'repair_sensor',
        'replace the tension sensor, or set tension.limit below what it can read',
    )
    CHECK_LOAD = (
        'check_load',
        'check payload, contacts, isolated muscles and the mounting of the base',
    )
    CORRECT_MOUNTING = (
        'correct_mounting',
        'mount the base as robot.urdf states, or correct robot.urdf',
    )
    CHECK_JOINT_SENSOR = (
        'check_joint_sensor',
        'correct the named joint sensors or their order; if they are right, call estimator/reset',
    )
    CHECK_JOINT_DRIVER = (
        'check_joint_driver',
        'check the named joint sensors, their cables, and the driver that publishes joint_states',
    )
    CONFIRM_REMOVED_SENSORS = (
        'confirm_removed_sensors',
        'if the sensors were removed for good, call estimator/reset',
        1,
    )
    CHECK_MODULE = (
        'check_module',
        'check drag, cooling and tension sensor of the module; then call estimator/reset',
    )
    CHECK_COOLING = 'check_cooling', 'check what heats the named motors, and their cooling'
    CHECK_TENDON = 'check_tendon', 'check tendon and length sensor of the named muscle'
    CHECK_CHECKPOINT = 'check_checkpoint', 'check that the checkpoint belongs to this arm'
    CHECK_DRIVER = 'check_driver', 'check that the driver is running'
    CHECK_RATE = 'check_rate', 'check the rate at which the driver publishes'
    CHECK_ESTIMATOR = 'check_estimator', 'check that the estimator is running'
    CHECK_REPLAY = 'check_replay', 'check that the replay is not paused and has not ended'
    RESTART_NODE = 'restart_node', 'see the log of the node, then restart the node or bringup.sh'
    START_CONTROLLER = 'start_controller', 'start the controller, or publish commands'
    STOP_SECOND_PUBLISHER = (
        'stop_second_publisher',
        'stop the node that does not belong to this arm',
    )
    STOP_OTHER_ROBOT = (
        'stop_other_robot',
        'stop the node that publishes this checkpoint, or restart it with the files of this robot',
    )
    PROVIDE_CHECKPOINT = (
        'provide_checkpoint',
        'set the parameter checkpoint, or start the learner',
    )
    WAIT_UNTIL_COOL = (
        'wait_until_cool',
        'let the arm rest or pull less until the motors have cooled and this condition ends',
    )
    REPORT_LOG = 'report_log', 'keep the log of the node, and report the error'
    FREE_DISK = 'free_disk', 'make the state directory writable, with free space'
    LEARN_AFRESH = (
        'learn_afresh',
        'discard the wrong samples of the learner: set its parameter checkpoint anew, to a file',
        1,
    )
    RESET_EMULATOR = 'reset_emulator', 'call hardware_emulator/reset'
    RESET_ESTIMATOR = 'reset_estimator', 'call estimator/reset', 1
    CALIBRATE_LENGTHS = 'calibrate_lengths', 'call estimator/zero to calibrate the lengths', 1
    RESTORE_MUSCLES = (
        'restore_muscles',
        'once the isolated muscle is repaired, call estimator/restore to use it again',
        1,
    )
    RESET_CONTROLLER = 'reset_controller', 'call controller/reset', 2
    EXPLORE = 'explore', 'call controller/explore true to explore again', 3
    EXPLORE_GENTLY = (
        'explore_gently',
        'call controller/explore true: the arm explores gently until its length offsets are known',
        3,
    )
    CHANGE_TARGET = (
        'change_target',
        'command a target that the arm can reach and hold, explore, or reduce the load',
        3,
    )
    ENABLE_LEARNING = 'enable_learning', 'call learner/enable true to learn again', 4

    @classmethod
    def named(cls, identifier: str) -> Step | None:
        """Return the step with this identifier, or None if there is none."""
        return _STEPS.get(identifier)


_STEPS = {step.identifier: step for step in Step}
#: remedy for a fault of one muscle
REPAIR = Step.REPAIR_MUSCLE, Step.RESET_ESTIMATOR


def sentence(steps: Iterable[Step]) -> str:
    """Return a remedy as a text for users."""
    return '; '.join(step.text for step in steps)
