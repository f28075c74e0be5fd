# SPDX-License-Identifier: Apache-2.0
"""Records the moving picture of the README from the page, in a headless Chromium.

python doc/film.py --checkpoint INITIAL.safetensors [--out doc/images/view.gif]

An emulated arm explores, is learned meanwhile, and has a muscle cut at the end. Arm, learner,
estimator and simulator are stepped here, frame by frame, so that a slow machine records the same;
INITIAL is what `train` writes.
"""

import argparse
import io
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.experiments.recording import EXPLORATION_STREAM, SAMPLE_TIME, record
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation
from musculoskeletal_ae.view.body import Kind
from musculoskeletal_ae.view.page import Page

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test' / 'view'))
from browser import Browser

MUSCLE = 'deltoid_anterior'
CUT, END = 50.0, 54.0  # [s] of the arm's time
EVERY, EVERY_LATER = 0.8, 0.2  # [s] between frames, before and around the cut
SIZE, SCALED, COLOURS = (1180, 740), (885, 555), 200
FRAME, LAST = 130, 2500  # [ms]
PORT = 8099


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--checkpoint', type=Path, required=True)
    parser.add_argument('--out', type=Path, default=Path(__file__).parent / 'images' / 'view.gif')
    options = parser.parse_args()
    robot = Robot.load('musashi_left_arm')
    mae = checkpoint.load(options.checkpoint, robot)
    arm, learner, estimator = EmulatedArm(robot, 0), Learner(robot, mae), Estimator(robot)
    simulation = Simulation(robot, mae)
    simulation.settle()
    temperatures: list[np.ndarray] = []

    def script(body: EmulatedArm, now: float) -> None:
        temperatures.append(body.sense().temperature)
        if now >= CUT:
            body.set_ruptured((MUSCLE,))

    stream = record(arm, mae, EXPLORATION_STREAM, END, script)
    page = Page(robot, '127.0.0.1', PORT, False, lambda *_: None)
    page.offer(['controller', 'hardware_emulator', 'pushed'])
    frames: list[Image.Image] = []
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(Path(profile), f'http://127.0.0.1:{PORT}', SIZE)
        try:
            browser.wait_for('Explore')
            due, kinds = 0.0, np.zeros(robot.muscle_count, dtype=int)
            estimator.use(mae)
            for n in range(round(END / SAMPLE_TIME)):
                now, tension, length = n * SAMPLE_TIME, stream.tension[n], stream.length[n]
                theta, command = stream.theta_sensor[n], stream.command[n]
                if not estimator.cause:
                    learner.step(now, theta, tension, length)
                if learner.mae is not estimator.mae:
                    estimator.use(learner.mae)
                    simulation.use(learner.mae)
                estimator.commanded(now, command)
                states = np.array([length, tension, temperatures[n]])
                estimate = estimator.step(states, now, now)
                simulation.command = command[None]
                simulated = simulation.step(SAMPLE_TIME).theta[0]
                values = estimator.report(now).values
                error = float(np.linalg.norm(estimate.state.theta - theta))
                distance, limit = (float(values.get(key, 'nan')) for key in ('d', 'd limit'))
                if now < due:
                    continue
                due = now + (EVERY if now < CUT - 1.0 else EVERY_LATER)
                if estimator.cause:
                    kinds[robot.muscles.index(values['suspect muscle'])] = Kind.SUSPECT
                if now >= CUT:
                    kinds[robot.muscles.index(MUSCLE)] = Kind.CUT
                posture = {'measured': theta, 'estimated': estimate.state.theta}
                page.draw({**posture, 'simulated': simulated}, tension, kinds)
                moment = f'{now:.1f} s'
                lines = [f'{moment} · error {error:.3f} rad · A {estimate.anomaly:.2f}']
                lines.append(f'samples {len(learner.samples)} · exploring')
                alarm = f'ANOMALY: {values["suspect muscle"]}' if estimator.cause else ''
                known = error, estimate.anomaly, distance, limit
                page.tell(lines, alarm, np.stack([tension, temperatures[n]]), now, known)
                page.follow(0.0, None)
                browser.wait_for(moment)
                if not frames:
                    time.sleep(3.0)  # the warning that there is no graphics card comes late
                    browser.close_notifications()
                time.sleep(0.5)
                shot = Image.open(io.BytesIO(browser.screenshot(Path(profile) / 'frame.png')))
                frames.append(shot.convert('RGB').resize(SCALED, Image.Resampling.LANCZOS))
        finally:
            browser.close()
            page.close()
    several = frames[:: max(1, len(frames) // 8)]  # so that the palette has every arm's colours
    collage = Image.new('RGB', (SCALED[0], SCALED[1] * len(several)))
    for i, frame in enumerate(several):
        collage.paste(frame, (0, SCALED[1] * i))
    palette = collage.quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [FRAME] * (len(small) - 1) + [LAST]
    small[0].save(
        options.out,
        save_all=True,
        append_images=small[1:],
        duration=durations,
        loop=0,
        optimize=True,
    )
    frames[-1].save(options.out.with_suffix('.png'))
    print(f'{options.out}: {len(small)} frames, {options.out.stat().st_size / 1e6:.2f} MB')


if __name__ == '__main__':
    main()
