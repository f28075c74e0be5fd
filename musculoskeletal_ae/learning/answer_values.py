# SPDX-License-Identifier: Apache-2.0
"""What an update tells people, for /diagnostics."""

from __future__ import annotations

from musculoskeletal_ae.learning.worker_process import Answer
from musculoskeletal_ae.robot.robot import Robot


def answer_values(answer: Answer, robot: Robot) -> dict[str, str]:
    """Return name and value of what came of the last update."""
    values = {
        'error at newest samples': f'{answer.error:.4f} rad',
        'loss': f'{answer.loss:.4f}',
        'update': f'{answer.seconds:.2f} s',
        'anomaly calibrated': str(answer.calibrated),
    }
    if len(answer.noise):
        worst = int(answer.noise.argmax())
        values['length noise'] = f'{1e3 * answer.noise[worst]:.2f} mm ({robot.muscles[worst]})'
    if answer.doubtful:
        names = ', '.join(robot.muscles[m] for m in answer.doubtful)
        values['newest samples contradict several muscles'] = f'{names}; look at the joint sensors'
    return values
