# SPDX-License-Identifier: Apache-2.0
"""Sends the supervisor many random events, and checks its invariants after each.

    python -m bench supervisor [--events 200000]

The bench runs the stateful property test of `test/control/test_supervisor.py` for longer. The exit
status is 1 if an invariant was violated; hypothesis then prints the shortest sequence of events
that violates it.
"""

from control.test_supervisor import Arm
from hypothesis import settings
from hypothesis.stateful import run_state_machine_as_test

from musculoskeletal_ae.options import Parser, whole

STEPS = 100  # number of events in one sequence


def main(argv: list[str]) -> int:
    """Run the bench; return the exit status."""
    parser = Parser('supervisor', 'Random events for the supervisor of control.')
    parser.add_argument('--events', type=whole(1, 10**8), default=200_000, help='number of events')
    options = parser.parse_args(argv)
    sequences = max(1, options.events // STEPS)
    long = settings(max_examples=sequences, stateful_step_count=STEPS, deadline=None, database=None)
    try:
        run_state_machine_as_test(Arm, settings=long)
    except AssertionError as error:
        print(error)
        return 1
    print(f'{sequences * STEPS} events in {sequences} sequences: every invariant held')
    return 0
