# SPDX-License-Identifier: Apache-2.0
"""What `check_driver` says of a driver of arm26 with one thing wrong, for each thing in turn.

python -m bench driver_faults > doc/results/door/driver_faults.txt

A driver of the emulated arm, stepped without ROS and as fast as it goes (a busy machine is a fault
of its own), judged by what `check_driver` judges with: listened to for 5 s at rest or for 8 s while
its hand is pushed about, or two of its muscles wound in. Those are the drivers of
test/driver/test_faults.py.
"""

import sys
from pathlib import Path
from typing import Any

from musculoskeletal_ae.options import Parser


def main(argv: list[str]) -> int:
    """Print the verdicts; exit status 1 if a fault is not found by the check that it belongs to."""
    Parser('driver_faults', 'What check_driver says of drivers that err.').parse_args(argv)
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
    from driver.scripted import Driver
    from driver.test_faults import BICEPS, HEARD, ROBOT, WOUND

    cases: list[tuple[str, dict[str, Any], str, str]] = [
        *(
            (name, {'publish': change}, how, check)
            for name, (change, how, check, _) in HEARD.items()
        ),
        ('20 Hz instead of 100', {'period': 0.05}, 'at rest', 'rate'),
        *((name, changes, 'wound in', check) for name, (changes, check, _) in WOUND.items()),
    ]
    found = 0
    for name, changes, how, check in cases:
        driver = Driver(ROBOT)
        if how == 'wound in':
            driver.listen(2.0)
        for attribute, value in changes.items():
            setattr(driver, attribute, value)
        if how == 'wound in':
            verdict = driver.wind((0, BICEPS))
        else:
            verdict = driver.listen(8.0 if how == 'moved' else 5.0, moved=how == 'moved')
        found += check in verdict.wrong
        print(f'{name} ({how}): {"found" if check in verdict.wrong else "NOT FOUND"}')
        for fault in verdict.faults:
            names = [ROBOT.muscles[m] for m in fault.muscles]
            whose = ', '.join(names) if len(names) < ROBOT.muscle_count else 'all muscles'
            print(f'  {fault.check} of {whose}: {fault.saw}\n    change: {fault.change}')
    print(f'\n{found} of {len(cases)} drivers found out, by the check that it belongs to')
    return 0 if found == len(cases) else 1
