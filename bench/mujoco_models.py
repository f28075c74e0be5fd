# SPDX-License-Identifier: Apache-2.0
"""Lets public MuJoCo models learn, one command for each, and writes the page of the results.

    python -m bench mujoco_models CLONES --out DIR [--only NAME,…] [--seeds 1,2,3] [--whole]
    python -m bench mujoco_models CLONES --out DIR --prospects
    python -m bench mujoco_models CLONES --out DIR --page doc/results/mujoco.md
    python -m bench mujoco_models CLONES --out DIR --only arm26 --experiments --whole --minutes 10

CLONES has a clone (a working tree) of each repository of MODELS in OWNER/NAME; models of MyoSuite
load only from a folder of their repository's name. A model whose clone is missing is left out.
Finished models are read from DIR, so the same command continues an interrupted run. The folder of
a model has the network of the first individual (`learned.safetensors`), for `export_mjcf`.

Each model takes the way of `train --mujoco FILE --seed 1 --quick`, by the same functions: import,
prospects, initial training, a minute of exploration and learning on an emulated individual, and
export into a copy of the file. The export is imported again. Further individuals (--seeds) learn
with the same initial network and are not exported. The numbers of a model are

- the share of random postures that the muscles can hold, or near how many of ten random postures
  joint stops or springs support the arm (`design/prospects.py`),
- the CPU time until the prospects were known; with --prospects, this is all,
- the CPU time from the start of the import to the first network, thus to the first estimate, and
  that of everything [s],
- the estimation error on 60 s of held-out motion before and after learning [rad, norm over the
  joints that contacts let move], and the number of rest samples: median and range over the
  individuals,
- how many muscles of the exported model have learned points, and how many of these differ more from
  the individual than in the file,
- how far the file and the exported model differ from the individual over POSTURES random postures
  [mm, mean over the muscles]: in length (standard deviation) and moment arms (root mean square).

If a model is refused, the reason is stored with the CPU time after which it was known.

With --experiments, each individual of --seeds makes the experiments of `mujoco_experiments.py`
instead, which takes 10 min or longer for each individual.
"""

import json
import re
import shutil
import subprocess
import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.mujoco_experiments import EXPERIMENTS_HEAD, arm_errors, experiment_rows
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.design.prospects import Prospects, prospects
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.exporting.exported_mjcf import export_into
from musculoskeletal_ae.figures import save_figure
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.importing.source import compare
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.options import Parser, names
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.mujoco_learning import learn

SEEDS = 1, 2, 3  # seeds of the emulated individuals; the first one is also exported
POSTURES = 200  # compare exported models with the individual in this many postures
SAME = 1e-6  # regard an exported muscle as unchanged if it differs from the file by less [m]
QUICK = 10  # divide the number of mini-batches of the initial training by this, without --whole
SOON = 10.0  # name what cannot work within this time [s]
#: file of a complete result, and of one that has only the prospects
RESULT, PROSPECTS = 'result.json', 'prospects.json'
ROOT = Path(__file__).parents[1]


class Model(NamedTuple):
    """A public model, or a part of one."""

    name: str
    repository: str  # owner/name on GitHub
    file: str  # path in the repository
    joints: tuple[str, ...] = ()  # the joints that are imported; all if empty


MUJOCO, MYO, OSTRICH = 'google-deepmind/mujoco', 'MyoHub/myo_sim', 'vittorione94/ostrichrl'
PLAYGROUND, SOFT = 'google-deepmind/mujoco_playground', 'CyPhiLab/tendon_clf'
GYMNASIUM = 'Farama-Foundation/Gymnasium-Robotics'
AERO = 'mujoco_playground/_src/manipulation/aero_hand/xmls/right_hand.xml'
ADROIT = 'gymnasium_robotics/envs/assets/adroit_hand/adroit_pen.xml'
INDEX = 'mcp2_flexion', 'mcp2_abduction', 'pm2_flexion', 'md2_flexion'
MIDDLE = 'mcp3_flexion', 'mcp3_abduction', 'pm3_flexion', 'md3_flexion'
THUMB = 'cmc_abduction', 'cmc_flexion', 'mp_flexion', 'ip_flexion'
ARM = 'elv_angle', 'shoulder_elv', 'shoulder_rot', 'elbow_flexion', 'pro_sup'
LEG = 'hip_flexion_r', 'knee_angle_r', 'ankle_angle_r'
MODELS = (
    Model('arm26', MUJOCO, 'model/tendon_arm/arm26.xml'),
    Model('elbow (1 joint)', MYO, 'elbow/myoelbow_1dof6muscles.xml'),
    Model('elbow (2 joints)', MYO, 'elbow/myoelbow_2dof6muscles.xml'),
    Model('finger with motors', MYO, 'finger/motorfinger_v0.xml'),
    Model('finger with muscles', MYO, 'finger/myofinger_v0.xml'),
    Model('index finger', MYO, 'hand/myohand.xml', INDEX),
    Model('middle finger', MYO, 'hand/myohand.xml', MIDDLE),
    Model('thumb', MYO, 'hand/myohand.xml', THUMB),
    Model('wrist', MYO, 'hand/myohand.xml', ('pro_sup', 'deviation', 'flexion')),
    Model('whole hand', MYO, 'hand/myohand.xml'),
    Model('shoulder and elbow of the arm', MYO, 'arm/myoarm.xml', ARM),
    Model('elbow of the arm', MYO, 'arm/myoarm.xml', ('elbow_flexion', 'pro_sup')),
    Model('one leg', MYO, 'leg/myolegs.xml', LEG),
    Model('both legs', MYO, 'leg/myolegs.xml'),
    Model('whole arm', MYO, 'arm/myoarm.xml'),
    Model('torso', MYO, 'torso/myotorso_rigid.xml'),
    Model('head', MYO, 'head/myohead_simple.xml'),
    Model('ostrich neck', OSTRICH, 'ostrichrl/assets/models/ostrich/ostrich_neck.xml'),
    Model('whole ostrich', OSTRICH, 'ostrichrl/assets/models/ostrich/ostrich.xml'),
    Model('Aero hand', PLAYGROUND, AERO),
    Model('SpiRob', SOFT, 'mujoco_models/spirob/spirob.xml'),
    Model('Helix', SOFT, 'mujoco_models/helix/helix_control.xml'),
    Model('Adroit hand', GYMNASIUM, ADROIT),
)


def measured(model: Model, file: Path, folder: Path, args: Namespace) -> dict[str, Any]:
    """Import a model, let an individual of it learn, export what it learned; return the numbers."""
    begun, result = time.process_time(), dict[str, Any]()

    def seconds() -> float:
        return time.process_time() - begun

    robot_folder = folder / 'robot'
    try:
        robot, source = import_robot(file, robot_folder, joints=model.joints)
        found = prospects(robot)
        result.update(joints=robot.joint_count, muscles=robot.muscle_count, known=seconds())
        result.update(held=held_text(found))
        if found.is_pointless:
            raise MusculoskeletalError(' '.join(found.lines()[:-1]))
        if args.prospects:
            return result
        compare(source, robot)  # `train --mujoco` prints it, so its time counts
        preset = preset_named('default')
        steps = preset.initial_steps(robot) // (1 if args.whole else QUICK)
        initial = initial_mae(robot, preset.name, args.seeds[0], steps=steps)
        result['first'] = seconds()
        result['individuals'] = individuals = list[dict[str, Any]]()
        for seed in args.seeds:
            learned = learn(robot, initial, robot_folder / 'model.xml', seed, args.minutes)
            individuals.append({
                'seed': seed, 'before': learned.before, 'after': learned.after,
                'samples': learned.samples, 'problem': learned.problem,
            })  # fmt: skip
            if seed == args.seeds[0]:
                result['still'] = learned.still
                checkpoint.save(learned.mae, folder / 'learned.safetensors')
                export_into(robot, learned.mae, file, folder / 'exported', seed)
                result['whole'] = seconds()
        exported = folder / 'exported' / file.name, folder / 'exported_robot'
        again = import_robot(*exported, joints=model.joints).robot
    except MusculoskeletalError as error:
        # The prospects do not name the file; the paths in other errors are those of this machine.
        text = str(error).replace(f'{file}: ', '').replace(f'{folder}/', '')
        result.update(refused=text, known=result.get('known', seconds()))
        return result
    theta = robot.random_postures(POSTURES, np.random.default_rng(0x308))
    model_file = str(robot_folder / 'model.xml')
    body = make_arm(robot, args.seeds[0], model_file, deviates=True).individual
    for name, other in (('file', robot), ('exported', again)):
        length, arm = differences(other, body, theta)
        result |= {f'{name}_lengths': length.tolist(), f'{name}_arms': arm.tolist()}
    return result


def held_text(found: Prospects) -> str:
    """Return which share of random postures can be held, or near how many stops support the arm."""
    if found.supported:
        return f'with stops ({found.supported} of 10)'
    return f'{100 * found.share:.0f} %'


def differences(robot: Robot, body: Any, theta: Array) -> tuple[Array, Array]:
    """Return how far each muscle of a robot differs from the same muscle of an individual [m].

    Returns:
        The standard deviation of the difference in length over postures θ (N, D), and the root mean
        square of the difference in moment arms, (M,) each.
    """
    length = robot.routes.absolute_lengths(theta) - body.absolute_lengths(theta)
    return length.std(axis=0), arm_errors(robot.routes.muscle_jacobian, body.muscle_jacobian, theta)


def result_of(model: Model, args: Namespace) -> dict[str, Any] | None:
    """Return the stored result of a model, or None; with --prospects or --page, also a part."""
    folder = args.out / folder_name(model)
    files = [RESULT, *([PROSPECTS] if args.prospects or args.page else [])]
    stored = [folder / name for name in files if (folder / name).is_file()]
    return json.loads(stored[0].read_text(encoding='utf-8')) if stored else None


def folder_name(model: Model) -> str:
    """Return the name of a model's folder in --out."""
    return re.sub(r'\W+', '_', model.name).strip('_')


def run(model: Model, args: Namespace) -> dict[str, Any] | None:
    """Measure a model, store its result and return it; None if the file of the model is missing."""
    file = args.clones / model.repository / model.file
    if not file.is_file():
        return None
    folder = args.out / folder_name(model)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    result = measured(model, file, folder, args) | {'commit': commit()}
    is_whole = 'refused' in result or 'whole' in result
    name = RESULT if is_whole else PROSPECTS
    (folder / name).write_text(json.dumps(result), encoding='utf-8')
    return result


def cells(model: Model, result: dict[str, Any]) -> list[str]:
    """Return the cells of a model that can learn; those not measured have a dash."""
    size = f'{result["joints"]} × {result["muscles"]}'
    head = [model.name, size, result['held'], f'{result["known"]:.1f}']
    if 'whole' not in result:
        return [*head, *('–' for _ in HEAD[len(head) :])]
    before, after = (
        np.array([result[f'{kind}_lengths'], result[f'{kind}_arms']])
        for kind in ('file', 'exported')
    )
    means = zip(1e3 * before.mean(axis=1), 1e3 * after.mean(axis=1), strict=True)
    length, arm = (f'{first:.2f} → {last:.2f}' for first, last in means)
    is_moved = (np.abs(after - before) > SAME).any(axis=0)
    is_worse = (after > before + SAME).any(axis=0)
    moved = f'{is_moved.sum()}, {is_worse.sum()} worse' if is_moved.any() else '0'
    times = f'{result["first"]:.0f}', f'{result["whole"]:.0f}'
    found = [values(result, name, '.3f') for name in ('before', 'after')]
    errors = ' → '.join(found)
    if still := result['still']:
        errors += f'; without {", ".join(still)}'
    return [*head, *times, errors, values(result, 'samples', '.0f'), moved, length, arm]


def values(result: dict[str, Any], name: str, form: str) -> str:
    """Return the median of a value of the individuals, with its range if there are several."""
    found = [each[name] for each in result['individuals']]
    spread = f' ({min(found):{form}} to {max(found):{form}})' if len(found) > 1 else ''
    return f'{float(np.median(found)):{form}}{spread}'


HEAD = (
    'model', 'joints × muscles', 'held', 'known [s]', 'first estimate [s]', 'whole [s]',
    'error [rad]', 'samples', 'muscles with learned points', 'lengths [mm]', 'moment arms [mm]',
)  # fmt: skip
REFUSED_HEAD = 'model', 'known after [s]', 'reason'
PAGE = """# Public MuJoCo models

`python -m bench mujoco_models CLONES --out DIR --minutes {minutes:g} --seeds {seeds}{whole}`
imports public models of MuJoCo, lets emulated individuals of each explore and learn for
{minutes:g} min, and exports what the first one learned into a copy of the file. It takes the way of
`train --mujoco FILE --seed {seed}{quick}`, by the same functions ({count} models;
measured {commit}).

{missing}![The models, drawn by this project](mujoco/models.png)

- **held**: share of random postures that the muscles can hold. With stops: near so many of ten
  random postures, joint stops or springs support the joints that the muscles cannot hold. The arm
  explores these postures.
- **known**: CPU time until these prospects were known.
- **first estimate**, **whole**: CPU time from the start of the import to the first network, and to
  the exported model. Other programs shared the two cores, so times vary by a factor of two.
- **error**: before and after learning, on 60 s of held-out motion of the individual, norm over
  the joints; median and range of {individuals} individuals, or of one if there is no range. Joints
  after "without" cannot move over half of their range, because bodies of the file touch, and do not
  count. The exploration is short: the errors of longer runs are in the
  [results](../results.md#mujoco-models).
- **samples**: rest samples in {minutes:g} min.
- **muscles with learned points**: in the exported model, of individual {seed}, and how many of them
  are further from the individual than the file, in length or in moment arms. The others keep
  their points ([why](../howto/mujoco.md#export-the-learned-body)).
- **lengths**, **moment arms**: difference from the individual, before (the file) and after (the
  exported model), over {postures} random postures: standard deviation of the length, and root mean
  square of the moment arms, means over the muscles.

## Models that were explored

Where the error does not fall, a short exploration was not enough.
A dash, if there is one, means that only the prospects were measured (`--prospects`).

{table}

## Models that cannot work

A model that cannot work is refused with the reason, before any training.

{refused}

## Sources

{sources}

The Aero hand was measured without its meshes, and the ostrich with another mesh for its head,
because the clones lack them. The masses and inertias are stated in the files.
"""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def rows_of(
    results: Sequence[tuple[Model, dict[str, Any]]],
) -> tuple[list[list[str]], list[list[str]]]:
    """Return the rows of the models that have learned, and those of refused models."""
    learned = [cells(model, result) for model, result in results if 'refused' not in result]
    refused = [
        [model.name, f'{result["known"]:.1f}', result['refused'].replace('|', '/')]
        for model, result in results
        if 'refused' in result
    ]
    return learned, refused


def commit() -> str:
    """Return the last commit that changed the package."""
    return subprocess.run(
        ['git', 'log', '-1', '--format=%h', '--', 'musculoskeletal_ae'],
        cwd=ROOT, capture_output=True, text=True, check=False,
    ).stdout.strip()  # fmt: skip


def commits(results: Sequence[tuple[Model, dict[str, Any]]]) -> str:
    """Return a text that lists the commits at which the models were measured."""
    at = dict[str, list[str]]()
    for model, result in results:
        at.setdefault(result['commit'], []).append(model.name)
    main, *others = sorted(at, key=lambda each: -len(at[each]))
    return '; '.join([f'at commit {main}', *(f'{", ".join(at[each])}: {each}' for each in others)])


def page(results: Sequence[tuple[Model, dict[str, Any]]], args: Namespace) -> str:
    """Return the page of results in Markdown."""
    learned, refused = rows_of(results)
    sources = [
        [model.name, model.repository, model.file, ', '.join(model.joints) or 'all']
        for model, _ in results
    ]
    measured_names = [model.name for model, _ in results]
    left = [model.name for model in MODELS if model.name not in measured_names]
    text = f'**Incomplete**: {len(results)} of {len(MODELS)} models; not measured: '
    missing = f'{text}{", ".join(left)}.\n\n' if left else ''
    return PAGE.format(
        missing=missing,
        minutes=args.minutes,
        whole=' --whole' if args.whole else '',
        quick='' if args.whole else ' --quick',
        seed=args.seeds[0],
        seeds=','.join(map(str, args.seeds)),
        individuals=len(args.seeds),
        count=len(results),
        commit=commits(results),
        postures=POSTURES,
        table=table(HEAD, learned),
        refused=table(REFUSED_HEAD, refused),
        sources=table(('model', 'repository', 'file', 'joints'), sources),
    )


def draw(results: Sequence[tuple[Model, dict[str, Any]]], args: Namespace, file: Path) -> None:
    """Draw the bones and muscles of all models that have learned in one picture."""
    from matplotlib.figure import Figure

    drawn = [model for model, result in results if 'refused' not in result]
    columns = 5
    count = -(-len(drawn) // columns)
    figure = Figure(figsize=(2.4 * columns, 2.5 * count), layout='constrained')
    for i, model in enumerate(drawn):
        robot = Robot.load(args.out / folder_name(model) / 'robot')
        theta = np.clip(np.zeros(robot.joint_count), robot.lower, robot.upper)
        lines = draw_arm(robot, theta, robot.tension.bias * np.ones(robot.muscle_count))
        every = np.concatenate([line.points for line in lines if line.kind == 'muscles'])
        middle = 0.5 * (every.max(axis=0) + every.min(axis=0))
        reach = 0.5 * float(np.ptp(every, axis=0).max())
        axes: Any = figure.add_subplot(count, columns, i + 1, projection='3d', proj_type='ortho')
        for line in lines:
            near = line.points[(np.abs(line.points - middle) <= 1.5 * reach).all(axis=1)]
            is_bone = line.kind == 'bones'
            colour, width = ('0.6', 3.0) if is_bone else ('tab:red', 0.8)
            axes.plot(*near.T, color=colour, lw=width, solid_capstyle='round')
        axes.set(**{f'{x}lim': (m - reach, m + reach) for x, m in zip('xyz', middle, strict=True)})
        axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.4)
        axes.view_init(elev=15.0, azim=-50.0)
        axes.set_axis_off()
        axes.set_title(model.name, fontsize=9)
    save_figure(figure, file)


def print_experiments(models: Sequence[Model], args: Namespace) -> None:
    """Print a table with a row for each individual of each model, as soon as it is known."""
    print(table(EXPERIMENTS_HEAD, []), flush=True)
    for model in models:
        file, folder = args.clones / model.repository / model.file, args.out / folder_name(model)
        if not file.is_file():
            continue
        try:
            rows = experiment_rows(model.name, file, model.joints, folder / 'experiments', args)
            for row in rows:
                print(f'| {" | ".join(row)} |', flush=True)
        except MusculoskeletalError as error:
            print(f'| {model.name} | {error} |', flush=True)


def main(argv: list[str]) -> None:
    """Measure all models and print the tables, or write the page."""
    parser = Parser('mujoco_models', (__doc__ or '').partition('\n')[0])
    parser.add_argument('clones', type=Path, metavar='CLONES', help='folder of the clones')
    parser.add_out('DIR', 'folder of the results; the same one continues an interrupted run')
    parser.add_argument('--only', type=names, help='names of models, or parts of them')
    parser.add_minutes('duration of the exploration', 1.0)
    parser.add_seeds(SEEDS)
    text = 'measure the prospects only'
    parser.add_argument('--prospects', action='store_true', help=text)
    text = 'whole initial training, instead of a tenth as with --quick of train'
    parser.add_argument('--whole', action='store_true', help=text)
    text = 'write the page and its picture from the results in --out, run none'
    parser.add_argument('--page', type=Path, metavar='FILE', help=text)
    text = 'make the experiments on each individual, instead of the page'
    parser.add_argument('--experiments', action='store_true', help=text)
    args = parser.parse_args(argv)
    chosen = [
        model for model in MODELS if not args.only or any(name in model.name for name in args.only)
    ]
    if args.experiments:
        print_experiments(chosen, args)
        return
    results = list[tuple[Model, dict[str, Any]]]()
    for model in chosen:
        result = result_of(model, args)
        if result is None and not args.page:
            result = run(model, args)
        if result is None:
            print(f'{model.name}: not measured', flush=True)
            continue
        results.append((model, result))
        learned, refused = rows_of(results[-1:])
        print(' | '.join((learned or refused)[0]), flush=True)
    if args.page:
        args.page.write_text(page(results, args), encoding='utf-8')
        pictures = args.page.with_suffix('')
        pictures.mkdir(exist_ok=True)
        draw(results, args, pictures / 'models.png')
