# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of README and documents that need a running system or a simulator.

    python -m bench pictures [--only film,simulation] [--out doc/images]

`film` runs `./bringup.sh --view` with `on_anomaly: isolate`, and takes screenshots of the page:

1. The arm explores and learns; the estimate converges to the measured arm.
2. A click on the button "Rupture" ruptures the muscle that is selected on the page.
3. The estimator isolates the muscle, and the arm moves on.

All data in the film come over ROS topics from the nodes of a real run. This requires Chromium and
takes about three minutes; a busy machine takes fewer pictures. `view.gif` is the film, `view.png`
its picture at the end of learning, `view_rupture.png` that when the ruptured muscle is named, and
`view_isolated.png` that when the arm moves on.

`simulation` draws the simulated arm at rest (`sim_at_rest.png`), and with a weight in the hand
(`sim_loaded.png`). `render --topic sim/markers` draws a running simulator in the same way.

`python doc/make.py` makes the charts, `muscles.png` and `elastic_unit.png`. `arm.png` is a picture
by `render`, and `mujoco.png` a screenshot of `./bringup.sh --mujoco FILE.xml --view`.
"""

import io
import os
import signal
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from threading import Thread

import numpy as np
from PIL import Image

from bench.processes import end_processes
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.methods import first_command
from musculoskeletal_ae.options import DEFAULT_ROBOT, Parser, names, positive, whole
from musculoskeletal_ae.robot.drawing import draw_arm, save_picture
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.simulation.simulation import Simulation

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'test' / 'view'))
from browser import Browser  # noqa: E402 - the tests' own browser

SIZE = 1280, 720  # open the page in a browser window of this size [pixels]
#: scale pictures of the page by this factor, and reduce them to this many colours
SCALE, COLOURS = 0.75, 128
SCALED = round(SCALE * SIZE[0]), round(SCALE * SIZE[1])
LEARNING = 60.0  # record the running system for this time before the rupture [s]
MOVING_ON = 25.0  # record the system for this time after the isolation [s]
EVERY = 1.0  # take a picture at this interval while the arm learns [s]
EVERY_LATER = 0.4  # take a picture at this interval around the rupture [s]
FRAME = 110  # show each picture of the film this long [ms]
LAST = 1500  # show the last picture of the film this long [ms]
SETTLE = 3.0  # wait this long after the first status, until the whole page is drawn [s]
PATIENCE = 600.0  # wait at most this long for the start and for each event of the film [s]
KINDS = ('film', 'simulation')
LOAD = -50.0  # load the hand of the simulated arm with this vertical force [N], as the paper does


def record(options: Namespace, folder: Path) -> tuple[list[Image.Image], dict[str, int]]:
    """Record the film; return its pictures, and the indices of those to save, by file name."""
    frames: list[Image.Image] = []
    browser = Browser(folder / 'profile', f'http://127.0.0.1:{options.port}', SIZE)

    def take(seconds: float, every: float, until: Callable[[str], bool] = lambda _: False) -> bool:
        """Take a picture every `every` seconds; return whether `until` held within `seconds`.

        `until` receives the text of the page, and ends the series when it returns True.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            begun = time.monotonic()
            shot = browser.screenshot(folder / 'frame.png')
            frames.append(Image.open(io.BytesIO(shot)).convert('RGB'))
            if until(browser.text):
                return True
            time.sleep(max(0.0, begun + every - time.monotonic()))
        return False

    try:
        # Draw fewer pixels than the page has: without a graphics card, drawing takes longer the
        # more pixels there are.
        browser.call(
            'Emulation.setDeviceMetricsOverride',
            width=SIZE[0], height=SIZE[1], deviceScaleFactor=SCALE, mobile=False,
        )  # fmt: skip
        browser.wait_for('samples')
        time.sleep(SETTLE)
        browser.close_notifications()
        take(options.learning, EVERY)
        kept = {'view.png': len(frames) - 1}
        browser.press('Rupture')
        if not take(PATIENCE, EVERY_LATER, until=lambda text: 'ANOMALY' in text):
            raise AssertionError(f'no anomaly was detected within {PATIENCE:g} s')
        kept['view_rupture.png'] = len(frames) - 1
        if not take(PATIENCE, EVERY_LATER, until=lambda text: 'ANOMALY' not in text):
            raise AssertionError(f'the muscle was not isolated within {PATIENCE:g} s')
        take(MOVING_ON, EVERY_LATER)
        kept['view_isolated.png'] = len(frames) - 1
        return frames, kept
    finally:
        browser.close()


def write(frames: list[Image.Image], kept: dict[str, int], out: Path) -> None:
    """Write the film with one palette for all frames, and the separate pictures.

    `kept` gives the index in `frames` of each separate picture, by file name.
    """
    several = frames[:: max(1, len(frames) // 8)]
    collage = Image.new('RGB', (SCALED[0], SCALED[1] * len(several)))
    for i, frame in enumerate(several):
        collage.paste(frame, (0, SCALED[1] * i))
    palette = collage.quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [FRAME] * (len(small) - 1) + [LAST]
    film = out / 'view.gif'
    small[0].save(
        film, save_all=True, append_images=small[1:], duration=durations, loop=0, optimize=True
    )
    for name, number in kept.items():
        frames[number].save(out / name)
    print(f'{film}: {len(small)} pictures, {film.stat().st_size / 1e6:.2f} MB')


def film(options: Namespace) -> None:
    """Run the system, record its page, and write the film and its pictures."""
    command = ['./bringup.sh', '--view', '--port', str(options.port)]
    command += ['-p', 'estimator:on_anomaly:=isolate']
    with tempfile.TemporaryDirectory() as folder, subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=os.environ
    ) as system:  # fmt: skip
        try:
            for line in system.stdout or ():
                print(line, end='')
                if ' s  error ' in line:
                    break
            else:
                problem = 'bringup.sh ended before its first status line'
                raise MusculoskeletalError(f'{problem}; its output above shows the cause')
            # Read on, because a full pipe would block the process.
            Thread(target=system.communicate, daemon=True).start()
            frames, kept = record(options, Path(folder))
        finally:
            end_processes([system], signal.SIGINT)
    for i, frame in enumerate(frames if options.frames else ()):
        options.frames.mkdir(parents=True, exist_ok=True)
        frame.save(options.frames / f'{i:04d}.png')
    write(frames, kept, options.out)


def draw_simulated(robot: Robot, mae: Mae, folder: Path) -> list[Path]:
    """Draw the simulated arm in mid-range, at rest and with a loaded hand; return both files."""
    simulated = Simulation(robot, mae)
    theta = 0.5 * (robot.lower + robot.upper)
    tension, _ = least_tension(
        mae.muscle_jacobian(theta, np.full(robot.muscle_count, robot.tension.bias)),
        robot.kinematics.holding_torque(theta),
        robot.tension.bias,
        robot.tension.limit,
    )
    simulated.command = first_command(robot, mae, theta, tension)[None]
    files = []
    for name, force, load in (
        ('at_rest', 0.0, 'nothing in the hand'),
        ('loaded', LOAD, f'{LOAD:g} N in z at the hand'),
    ):
        simulated.wrench = np.array([[0.0, 0.0, force, 0.0, 0.0, 0.0]])
        state = simulated.settle()
        lines = draw_arm(robot, state.theta[0], state.tension[0])
        title = (
            f'simulated arm, {load}: '
            f'{state.tension.min():.0f} to {state.tension.max():.0f} N '
            '(green at bias, red at the limit)'
        )
        files.append(folder / f'sim_{name}.png')
        save_picture(lines, files[-1], title)
    return files


def main(argv: list[str]) -> None:
    """Make the pictures that the options name."""
    parser = Parser('pictures', (__doc__ or '').partition('\n')[0])
    parser.add_argument('--only', type=names, default=KINDS, help='pictures to make')
    text = 'port of the page that is recorded'
    parser.add_argument('--port', type=whole(1, 65535), default=8099, metavar='N', help=text)
    text = 'time of learning before a muscle ruptures [s]'
    parser.add_argument('--learning', type=positive, default=LEARNING, metavar='S', help=text)
    parser.add_argument('--frames', type=Path, metavar='DIR', help='folder that keeps every frame')
    parser.add_out('DIR', default=Path('doc/images'))
    options = parser.parse_args(argv)
    if unknown := set(options.only) - set(KINDS):
        parser.error(f'--only: unknown pictures {", ".join(unknown)}; legal: {", ".join(KINDS)}')
    options.out.mkdir(parents=True, exist_ok=True)
    if 'film' in options.only:
        film(options)
    if 'simulation' in options.only:
        robot = Robot.load(DEFAULT_ROBOT)
        print(*draw_simulated(robot, initial_mae(robot), options.out), sep='\n')
