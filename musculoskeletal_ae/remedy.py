# SPDX-License-Identifier: Apache-2.0
"""Declares the steps of remedies: identifiers for programs, and texts for users.

A remedy is a sequence of steps, to be taken in order. Remedies are declared with the problems: for
stop causes in `control/stops.py`, for findings in `estimation/finding.py`. /diagnostics contains a
remedy twice: the value `remedy` is a text for users, and `remedy steps` lists the identifiers.
"""

from collections.abc import Iterable
from enum import Enum


class Step(Enum):
    """One step of a remedy; the value contains the stable identifier and the text."""

    def __init__(self, identifier: str, text: str) -> None:
        self.identifier, self.text = identifier, text

    RESET_CONTROLLER = 'reset_controller', 'call controller/reset'
    RESET_ESTIMATOR = 'reset_estimator', 'call estimator/reset'
    CALIBRATE_LENGTHS = 'calibrate_lengths', 'call estimator/zero'
    CORRECT_WIRING = (
        'correct_wiring',
        'correct the order of the muscles, or the sign of the length, in the driver',
    )
    EXPLORE = 'explore', 'call controller/explore true to explore again'
    EXPLORE_GENTLY = (
        'explore_gently',
        'call controller/explore true to explore again, gently until the offsets are known',
    )
    REPAIR_MUSCLE = 'repair_muscle', 'repair the muscle'
    RESTORE_MUSCLES = 'restore_muscles', 'call estimator/restore'
    FREE_ARM = 'free_arm', 'free the arm'
    CHECK_SENSOR = (
        'check_sensor',
        'check the named sensor, or call estimator/zero if the lengths have offsets',
    )
    CHECK_CHECKPOINT = 'check_checkpoint', 'check that the checkpoint belongs to this arm'
    CHECK_DRIVER = (
        'check_driver',
        'check that the driver is running and that the computer is not overloaded',
    )
    CHECK_ESTIMATOR = (
        'check_estimator',
        'check that the estimator is running and that the computer is not overloaded',
    )
    CHECK_REPLAY = 'check_replay', 'check that the replay is not paused and has not ended'
    STOP_SECOND_PUBLISHER = (
        'stop_second_publisher',
        'stop the node that does not belong to this arm',
    )
    STOP_OTHER_ROBOT = (
        'stop_other_robot',
        'stop the node of the other robot that publishes accepted_checkpoint',
    )
    PROVIDE_CHECKPOINT = (
        'provide_checkpoint',
        'set the parameter `checkpoint`, or start the learner',
    )
    WAIT_UNTIL_COOL = 'wait_until_cool', 'wait until all windings are below temperature_limit'
    REPORT_LOG = 'report_log', 'report the error with the log of the controller'


STEPS = {step.identifier: step for step in Step}  # all steps by identifier
REMEDY_STEPS = 'remedy steps'  # key of a value in /diagnostics
#: remedy for an anomaly
REPAIR = Step.REPAIR_MUSCLE, Step.RESET_ESTIMATOR
#: key of a value of hardware_emulator: the parameters that cause a fault, separated by commas
EMULATED_FAULTS = 'emulated faults'
NO_FAULTS = 'none'  # the value EMULATED_FAULTS while no parameter causes a fault
#: how to repair a muscle of an emulated arm, by the parameter of hardware_emulator
EMULATED_REPAIRS = {
    'ruptured_muscles': (
        "set ruptured_muscles of hardware_emulator to [''], or press Repair on the page"
    ),
    'faults': "set faults of hardware_emulator to ['']",
}


def sentence(steps: Iterable[Step], emulated_faults: str = '') -> str:
    """Return a remedy as a text for users.

    Args:
        steps: The steps of the remedy.
        emulated_faults: The value EMULATED_FAULTS of the emulator, or ''.
    """
    repairs = [
        repair for name, repair in EMULATED_REPAIRS.items() if name in emulated_faults.split(', ')
    ]
    how = f': {" and ".join(repairs)}' if repairs else ''
    return '; '.join(step.text + how * (step is Step.REPAIR_MUSCLE) for step in steps)


def identifiers(steps: Iterable[Step]) -> str:
    """Return a remedy as the value `remedy steps` of /diagnostics."""
    return ', '.join(step.identifier for step in steps)


def parse(value: str) -> tuple[Step, ...]:
    """Return the steps whose identifiers `value` lists, separated by commas.

    `value` is the value `remedy steps` of /diagnostics. Unknown identifiers are ignored.
    """
    return tuple(STEPS[name] for name in value.split(', ') if name in STEPS)


def table() -> str:
    """Return all steps of remedies as a Markdown table."""
    rows = [f'| `{step.identifier}` | {step.text} |' for step in Step]
    return '\n'.join(['| identifier | step |', '|---|---|', *rows])
