# SPDX-License-Identifier: Apache-2.0
"""Pushes felt: force of the hand, collisions in motion, false contacts, and the floating arm.

python -m bench touch [--robot …] [--seeds 0,1,2,3,4] [--folder DIR] [--quick] [--out FILE]

Individuals that learned for ten minutes (`learned_arm`); what is measured is in
`musculoskeletal_ae/experiments/touch.py`.
"""

import json
from pathlib import Path

import torch

from bench.learned_arm import learned_arm
from musculoskeletal_ae.experiments.plots import DPI
from musculoskeletal_ae.experiments.results import combined
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.experiments.touch import forces, measure
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

GOALS = {'wrench_error': 0.2, 'wrench_error_deg': 15.0, 'false_contacts': 0, 'collision_s': 0.1}


def main(argv: list[str]) -> int:
    """Print the numbers; exit status 0 if their means meet the goals."""
    parser = Parser('touch', 'Pushes felt, collisions, false contacts, and the floating arm.')
    parser.add_robot()
    parser.add_seeds((0, 1, 2, 3, 4))
    parser.add_minutes('duration of learning', 10.0)
    parser.add_argument('--folder', type=Path, default=Path('bench_touch'), help='what was learned')
    parser.add_quick('a tenth of it')
    parser.add_argument('--out', type=Path, help='JSON file of the numbers; a plot beside it')
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    robot, rows = Robot.load(args.robot), {}
    study = Study(robot, 'default', args.seeds, args.minutes, args.quick, args.folder)
    for seed in args.seeds:
        learned = learned_arm(robot, seed, args.folder, args.minutes)
        checkpoint.save(learned.mae, study.network_file('default', seed))
        rows[seed] = measure(study, seed)
        print(seed, json.dumps(rows[seed].numbers), flush=True)
    result = combined(study, rows)
    print(json.dumps({key: result[key] for key in rows[args.seeds[0]].numbers}, indent=1))
    if args.out:
        args.out.write_text(json.dumps(result, indent=1) + '\n')
        forces(study, rows)[0].savefig(args.out.with_suffix('.png'), dpi=DPI)
    return 0 if all(result[key] <= most for key, most in GOALS.items()) else 1
