# SPDX-License-Identifier: Apache-2.0
"""Finds the smallest change of via points that makes an arm sound, by CMA-ES.

    min  mean_p |d_p| / r + penalty(d),    d_p = r · x_p / √(1 + |x_p|²)

Each via point p moves by d_p, which is shorter than the reach r, because the search varies x_p
instead of d_p. The penalty is zero if the muscles hold the arm, and its stiffness and moment arms
meet the requirements of the check, in all but a few postures.
"""

import shutil
from pathlib import Path

import numpy as np
import yaml

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.design import checks
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_yaml
from musculoskeletal_ae.progress_bar import ProgressBar
from musculoskeletal_ae.robot.description import refusal, written
from musculoskeletal_ae.robot.drawing import draw_arm, save_picture
from musculoskeletal_ae.robot.robot import Robot

#: accept a change of via points if at most this share of postures misses the requirements; the
#: check, with other postures, tolerates a share of 0.05
FAILING_SHARE = 0.02
#: weigh missed requirements by this in the cost, above the displacement, which costs less than 1
PENALTY = 10.0
START_SPREAD = 0.2  # start the search with this standard deviation of the variables x
TRIES = 40  # evaluate this many candidates for each of the 3P coordinates of the via points
RESOLUTION = 1e-4  # round displacements of via points to this step [m]
THIN = 0.003  # draw muscles this wide in the picture of old and new routes [m]


def suggest(robot: Robot, reach: float, postures: int, seed: int) -> tuple[Array, float, float]:
    """Suggest a change of the via points that makes a robot sound.

    A change after which a muscle acts in the wrong direction in more postures than before is not
    accepted either.

    Args:
        robot: The robot.
        reach: Largest distance by which a via point may move [m].
        postures: Number of random postures in which each candidate is evaluated.
        seed: Random seed. The postures differ from the postures of a check with the same seed.

    Returns:
        The displacement of each via point in the frame of its link [m], (P, 3); and by how much the
        requirements are missed before and after the change (`lacking`), 0 if they are met.
    """
    import cma

    unchanged = np.zeros((len(robot.routes.point), 3))
    theta = robot.random_postures(postures, np.random.default_rng(seed + 1))

    setting = checks.Setting.of(robot, theta)

    def check(change: Array) -> checks.RobotCheck:
        return checks.measure(setting.rerouted(robot.with_moved_points(change)))

    flips = np.maximum(checks.main_actions(check(unchanged).moment_arms)[1], FAILING_SHARE)

    def lacks(change: Array) -> float:
        result = check(change)
        more = checks.main_actions(result.moment_arms)[1] - flips
        return lacking(result) + float(np.maximum(more, 0.0).sum())

    if not (before := lacks(unchanged)):
        return unchanged, 0.0, 0.0

    def change_of(x: Array) -> Array:
        x = x.reshape(unchanged.shape)
        change = reach * x / np.sqrt(1.0 + np.sum(x**2, axis=1, keepdims=True))
        # Round towards zero, so that every displacement stays within reach.
        return np.trunc(change / RESOLUTION) * RESOLUTION

    def cost(x: Array) -> float:
        missing, size = lacks(change_of(x)), np.linalg.norm(change_of(x), axis=1).mean() / reach
        return float(size + (1.0 + PENALTY * missing) * (missing > 0.0))

    options = {'seed': seed % 2**32 + 1, 'verbose': -9, 'tolfun': 1e-3}
    search = cma.CMAEvolutionStrategy(unchanged.ravel(), START_SPREAD, options)
    tries = TRIES * unchanged.size // search.popsize
    with ProgressBar('searching for places of via points', tries) as bar:
        for _ in range(tries):
            if not search.stop():
                candidates = search.ask()
                search.tell(candidates, [cost(x) for x in candidates])
            bar.add()
    change = change_of(search.best.x)
    if not lacks(change):
        # Move each point back to its old place, the least moved first, if the arm stays sound.
        for p in np.argsort(np.linalg.norm(change, axis=1)):
            without_point = np.where(np.arange(len(change))[:, None] == p, 0.0, change)
            if not lacks(without_point):
                change = without_point
    return change, before, lacks(change)


def lacking(check: checks.RobotCheck) -> float:
    """Return how much is lacking for the requirements of `check_robot`, as a number without unit.

    Only requirements that depend on the via points count: holding torque, stiffness, and moment
    arms. The result is 0 if the arm meets all of them with a margin.
    """
    arms, least = check.moment_arms, check.matters
    torque = np.linalg.norm(check.missing_torque, axis=1)
    soft = np.maximum(1.0 - check.stiffness / check.required, 0.0)
    weak = np.where(check.held, soft / (1.0 + soft), 1.0 + torque / (1.0 + torque))
    # Missing moment arm in each direction, relative to the smallest one that counts.
    short = [1.0 - arms.max(axis=1) / least, 1.0 + arms.min(axis=1) / least]
    actions = checks.read_declared_actions(check.setting.robot.description).items()
    short += [(RESOLUTION - sign * arms[:, [m], j]) / least[j] for (m, j), sign in actions]
    rows = np.sort(np.column_stack([weak, np.maximum(np.hstack(short), 0.0)]), axis=0)
    missing = (least + RESOLUTION - np.abs(arms).max(axis=0)) / least
    useless = np.maximum(missing.min(axis=1), 0.0)
    counted = rows[: len(rows) - int(FAILING_SHARE * len(rows))]
    return float(counted.mean(axis=0).sum() + useless.sum())


def write(robot: Robot, change: Array, out: Path) -> None:
    """Write a robot directory with moved via points, and a picture of the old and new routes.

    Args:
        robot: The original robot.
        change: Displacements of the via points in the links' frames [m], (P, 3).
        out: The new directory.

    Raises:
        RobotDescriptionError: If other files of the directory cannot be copied.
    """
    here, after = robot.description.directory, robot.with_moved_points(change)
    document = read_yaml(here / 'muscles.yaml', refusal)
    for muscle, route in zip(document['muscles'], after.description.routes, strict=True):
        muscle['route'] = [written(item) for item in route]
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
    out.mkdir(parents=True, exist_ok=True)
    # Write muscles.yaml first, so that it exists even if copying fails.
    (out / 'muscles.yaml').write_text(text, encoding='utf-8')
    # Copy meshes from anywhere in the directory, but not the output, which may lie there too.
    skipped = {out.resolve(), (here / 'muscles.yaml').resolve()}

    def not_copied(folder: str, names: list[str]) -> list[str]:
        paths = {name: Path(folder, name) for name in names}
        # Copy files and directories, but not pipes or broken links.
        copyable = [name for name, path in paths.items() if path.is_file() or path.is_dir()]
        return [name for name in names if name not in copyable or paths[name].resolve() in skipped]

    try:
        shutil.copytree(here, out, ignore=not_copied, dirs_exist_ok=True)
    except shutil.Error as error:
        failures = '; '.join(f'{source}: {reason}' for source, _, reason in error.args[0])
        problem = f'muscles.yaml is written, but other files could not be copied: {failures}'
        raise RobotDescriptionError(f'{out}: {problem}; copy them from {here}') from error
    middle, bias = 0.5 * (robot.lower + robot.upper), robot.tension.bias
    lines = []
    pairs = zip(draw_arm(robot, middle, bias), draw_arm(after, middle, bias), strict=True)
    for old, new in pairs:
        if old.kind == 'bones':
            lines.append(new)
        elif np.array_equal(old.points, new.points):
            lines.append(new._replace(colour=(0.6, 0.6, 0.7), width=THIN))
        else:
            lines += [old._replace(colour=(0.9, 0.2, 0.1), width=THIN), new._replace(width=THIN)]
    title = 'muscle routes: red before, green after, grey unchanged'
    save_picture(lines, out / 'suggestion.png', title, whole=False)
