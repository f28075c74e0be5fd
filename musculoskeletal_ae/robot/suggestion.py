# SPDX-License-Identifier: Apache-2.0
"""The smallest change of via points that makes an arm sound, by CMA-ES.

    min  mean_p |d_p| / r + penalty(d),    d_p = r · x_p / √(1 + |x_p|²)

over x: each via point p is moved by d_p, less than the reach r. The penalty is zero where stiffness
and moment arms are what the check requires in all but a few postures.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from tqdm import tqdm

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.files import read_yaml
from musculoskeletal_ae.robot import checks
from musculoskeletal_ae.robot.description import RoutePoint, refusal, written
from musculoskeletal_ae.robot.drawing import draw_arm, save_picture
from musculoskeletal_ae.robot.robot import Robot

FORGIVEN = 0.02  # of the postures; the check, which draws others, tolerates 0.05
PENALTY = 10.0  # where all is lacking; the size of a change is below 1
START = 0.2  # spread of x at first
TRIES = 40  # for each coordinate of a via point
RESOLUTION = 1e-4  # [m]
THIN = 0.003  # of a muscle in the picture [m]


def suggest(robot: Robot, reach: float, postures: int, seed: int) -> tuple[Array, float, float]:
    """Return d [m] (P, 3), in the links' frames, and what is `lacking` without and with it.

    Lacking is also that a muscle changes the sign of its main action which did not before. Arms are
    tried in so many random postures, other ones than a check with this seed draws.
    """
    import cma

    still = np.zeros((len(robot.routes.point), 3))
    theta = robot.random_postures(postures, np.random.default_rng(seed + 1))

    def check(change: Array) -> checks.RobotCheck:
        return checks.judge(checks.Setting.of(moved(robot, change), theta))

    flips = np.maximum(checks.main_actions(check(still).moment_arms)[1], FORGIVEN)

    def lacks(change: Array) -> float:
        result = check(change)
        more = checks.main_actions(result.moment_arms)[1] - flips
        return lacking(result) + float(np.maximum(more, 0.0).sum())

    if not (before := lacks(still)):
        return still, 0.0, 0.0

    def change_of(x: Array) -> Array:
        x = x.reshape(still.shape)
        change = reach * x / np.sqrt(1.0 + np.sum(x**2, axis=1, keepdims=True))
        return np.trunc(change / RESOLUTION) * RESOLUTION  # never beyond the reach

    def cost(x: Array) -> float:
        missing, size = lacks(change_of(x)), np.linalg.norm(change_of(x), axis=1).mean() / reach
        return float(size + (1.0 + PENALTY * missing) * (missing > 0.0))

    options = {'seed': seed % 2**32 + 1, 'verbose': -9, 'tolfun': 1e-3}
    search = cma.CMAEvolutionStrategy(still.ravel(), START, options)
    for _ in tqdm(range(TRIES * still.size // search.popsize), disable=None):
        if not search.stop():
            tried = search.ask()
            search.tell(tried, [cost(x) for x in tried])
    change = change_of(search.best.x)
    if not lacks(change):
        for p in np.argsort(np.linalg.norm(change, axis=1)):
            back = np.where(np.arange(len(change))[:, None] == p, 0.0, change)
            change = change if lacks(back) else back
    return change, before, lacks(change)


def moved(robot: Robot, change: Array) -> Robot:
    """Return a robot whose via points are elsewhere by (P, 3) [m], in the links' frames."""
    left = iter(change)
    routes = [
        tuple(p._replace(xyz=p.xyz + next(left)) if isinstance(p, RoutePoint) else p for p in route)
        for route in robot.description.routes
    ]
    return Robot(replace(robot.description, routes=tuple(routes)))


def lacking(check: checks.RobotCheck) -> float:
    """Return what an arm lacks that via points could give it; 0: nothing, and with a margin."""
    arms, least = check.moment_arms, check.matters
    torque = np.linalg.norm(check.missing_torque, axis=1)
    soft = np.maximum(1.0 - check.stiffness / check.required, 0.0)
    weak = np.where(check.held, soft / (1.0 + soft), 1.0 + torque / (1.0 + torque))
    # Of either direction, as shares of what matters.
    short = [1.0 - arms.max(axis=1) / least, 1.0 + arms.min(axis=1) / least]
    actions = checks.read_declared_actions(check.setting.robot.description).items()
    short += [(RESOLUTION - sign * arms[:, [m], j]) / least[j] for (m, j), sign in actions]
    rows = np.sort(np.column_stack([weak, np.maximum(np.hstack(short), 0.0)]), axis=0)
    missing = (least + RESOLUTION - np.abs(arms).max(axis=0)) / least
    useless = np.maximum(missing.min(axis=1), 0.0)
    return float(rows[: len(rows) - int(FORGIVEN * len(rows))].mean(axis=0).sum() + useless.sum())


def write(robot: Robot, change: Array, out: Path) -> None:
    """Write a robot directory with via points moved by (P, 3) [m], and a picture of both."""
    here, after = robot.description.directory, moved(robot, change)
    document = read_yaml(here / 'muscles.yaml', refusal)
    for muscle, route in zip(document['muscles'], after.description.routes, strict=True):
        muscle['route'] = [written(item) for item in route]
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
    out.mkdir(parents=True, exist_ok=True)
    (out / 'muscles.yaml').write_text(text, encoding='utf-8')  # whatever becomes of the rest
    # Meshes come along, wherever they lie in the directory; what is written may lie there too.
    skipped = {out.resolve(), (here / 'muscles.yaml').resolve()}

    def left(folder: str, names: list[str]) -> list[str]:
        paths = {name: Path(folder, name) for name in names}
        copied = [n for n, p in paths.items() if p.is_file() or p.is_dir()]  # no pipe, no dead link
        return [name for name in names if name not in copied or paths[name].resolve() in skipped]

    try:
        shutil.copytree(here, out, ignore=left, dirs_exist_ok=True)
    except shutil.Error as error:
        told = '; '.join(f'{source}: {why}' for source, _, why in error.args[0])
        raise refusal(out, f'muscles.yaml is written, but not copied was {told}') from error
    middle, bias = 0.5 * (robot.lower + robot.upper), robot.tension.bias
    lines = []
    for was, now in zip(*(draw_arm(each, middle, bias) for each in (robot, after)), strict=True):
        if was.kind == 'bones':
            lines.append(now)
        elif np.array_equal(was.points, now.points):
            lines.append(now._replace(colour=(0.6, 0.6, 0.7), width=THIN))
        else:
            lines += [was._replace(colour=(0.9, 0.2, 0.1), width=THIN), now._replace(width=THIN)]
    told = 'red: before, green: after, grey: as it was'
    save_picture(lines, out / 'suggestion.png', told, whole=False)
