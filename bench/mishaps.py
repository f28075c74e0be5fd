# SPDX-License-Identifier: Apache-2.0
"""Lets mishaps of a laboratory happen, and checks what the nodes state and advise.

    python -m bench mishaps [--seeds 0,1,2,3,4] [--reality kin,foreign] [--kinds NAME,…] [--quick]
    python -m bench mishaps --graph    # mishaps of nodes and topics, on the real ROS graph
    python -m bench mishaps --page doc/results/mishaps.md     # write the page from the results

An individual explores and learns for LEARNING seconds in the laboratory of `bench/lab.py`. Each
mishap of `bench/mishap_kinds.py` then begins from a copy of this laboratory (a forked process), at
a random moment, with a random size, muscle or joint. An obedient operator waits until something is
stated, and takes the advised steps literally, in their order. A person repairs or checks only what
a statement names. If nothing is stated for PATIENCE seconds, the person finds the fault without the
nodes. At the end, the estimate is compared with the true posture for AFTER seconds.

Each emulator model and seed has a file of its own, so several processes may share the work, as in

    python -m bench mishaps --reality kin & python -m bench mishaps --reality foreign

Results are kept in the folder `--out`, one line of JSON for each mishap, so that a run can be
continued: mishaps that have a result there are not repeated. `--again` repeats them. `--healthy`
lets healthy arms explore for some hours instead; every warning or error of theirs is false.

The table states for each mishap and emulator model:

- true: how often a true statement was made within GOAL seconds of the first effect; a statement
  that was there before the mishap began does not count
- after: the median time from the first effect to the first true statement
- false: the number of different false statements until the mishap was mended
- well: how often the arm explored again, without any condition and with a true error of at most
  WELL times that before (or WELL_RAD more), after the advice alone was followed
- error: the medians of the true error before and after
- tension: the highest tension, in multiples of tension.limit

Exit status 1 if the goals are missed: true within 5 s in 95 % of all cases that need a statement,
no false statement, and all of them end well.
"""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench import mishap_kinds
from bench.lab import SAMPLE_TIME, Lab
from bench.learned_arm import initial
from bench.mishap_kinds import MISHAPS, NAMES, SELF, SOFTWARE, Case, Mishap
from bench.statements import Statement, statements, troubles
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN, make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.explored_postures import holdable_postures
from musculoskeletal_ae.options import Parser, names, positive
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.robot.robot import Robot

LEARNING = 180.0  # let an individual explore and learn for this time before its mishaps [s]
#: learn for this time [s] with the individual of this seed, whose network serves as a wrong one
OTHER_LEARNING, OTHER_SEED = 90.0, 990
LOOK = 0.1  # read the statements at this interval [s]
GOAL = 5.0  # count a true statement as timely up to this time after the first effect [s]
PATIENCE = 30.0  # let a person find an unstated fault this long after its first effect [s]
LONGEST_WAIT = 75.0  # wait at most this long for the first effect and PATIENCE together [s]
REACTION = 5.0  # let the operator react this long after a node has first advised a step [s]
BETWEEN = 0.5  # take the steps of a remedy at this interval [s]
SETTLING = 4.0  # read the statements again this long after the steps of a remedy [s]
QUIET = 3.0  # call the arm well once it has explored without any condition for this time [s]
CALIBRATION = 60.0  # wait at most this long for a length calibration [s]
COOLING = 240.0  # wait at most this long for motors to cool, in all [s]
AFTER = 20.0  # measure the true error over this time [s]
#: a case has not ended well if the error has grown to more than this multiple, and by more than
#: this [rad]
WELL, WELL_RAD = 1.5, 0.02
HOLDABLE = 4  # choose the posture to hold among this many holdable ones
#: individuals and emulator models of the complete table
SEEDS, REALITIES = (0, 1, 2, 3, 4), (KIN, FOREIGN)
PAGE_FACTS = ('true', 'after', 'false', 'well', 'error', 'tension')


PAGE = """\
# Mishaps of a laboratory

`python -m bench mishaps` lets {kinds} mishaps happen to arms that have learned for {learning} s and
explore or hold, with emulator models {realities}, individuals {seeds} ({runs} runs; page
written at {commit}, commits of the runs in the
[results](../results.md#mishaps-of-a-laboratory)). Size, moment, muscle or joint are random. An
obedient operator takes the advised steps
literally, and a person repairs or checks only what a statement names. A run ends when the arm
explores again without any condition, or when the patience of the operator ends.

| | measured | goal |
|---|---|---|
| true statement within {goal} s of the first effect, if one is needed | {soon} % | ≥ 95 % |
| false statements until the mishap was mended | {false} | 0 |
| advice ends well | {well} % | 100 % |
| highest tension, in multiples of `tension.limit` | {worst} | – |

- **true**: cases with a true statement within {goal} s of the first effect, of those that need a
  statement. A statement that was there before the mishap began does not count. A case needs
  none if the mishap is harmless, or had no effect within {longest} s.
- **after**: median time from the first effect to the first true statement. Most mishaps have an
  effect at once. Wrong readings have one from {angle} rad, {length} mm or {tension} N on, a module
  when its tension differs from the demanded one by {tension} N, and a turned base when it has
  turned.
- **false**: different false statements, over all cases. Statements about other muscles and joints
  are false, too, unless they only quote a reading or an estimate beyond its limits.
- **well**: cases in which the advice alone brought the arm back: it explores without any condition,
  and the true error of its estimate over {after} s is at most {ratio} times that before, or {more}
  rad more.
- **error**: medians of the true error [rad] before the mishap and after the end.
- **tension**: highest true tension in multiples of `tension.limit`."""


GRAPH = 'graph'  # emulator model of results on the ROS graph
GRAPH_TEXT = """\
`python -m bench mishaps --graph`: the nodes run as processes on an emulated arm26. A statement is
the status line. The operator is that of `bench attack`."""


class Course:
    """The course of one mishap: watches statements and tensions, and plays the operator."""

    def __init__(self, lab: Lab, mishap: Mishap) -> None:
        """Prepare a mishap, which `play` will let happen in the laboratory."""
        self.lab, self.mishap, self.case = lab, mishap, Case('', lambda _: None)
        self.begun_at = math.inf  # time at which the mishap begins [s]
        self.effect_at: float | None = None  # time of the first effect [s]
        self.true_at: float | None = None  # time of the first true statement [s]
        self.first_true = ''
        self.advised_at: float | None = None  # time of the first advice [s]
        self.started_at = lab.now  # zero of the times in the result [s]
        self.mended_at: float | None = None
        self.is_found_by_advice = False
        self.false: dict[str, dict[str, Any]] = {}  # first occurrence of each false statement
        #: false statements that came only after the fault was mended
        self.later: dict[str, str] = {}
        self.stated: dict[str, Any] = {}  # all different statements, with time and judgement
        #: steps that the operator took, each with its refusal if there was one
        self.taken: list[str] = []
        self.peak = 0.0  # highest tension, in multiples of tension.limit
        self.quiet_since = lab.now
        self._next_look = lab.now
        self._cooled_for = 0.0  # time for which the operator has waited for motors to cool [s]
        self._errors: list[float] | None = None  # true errors of the estimate [rad]
        self.present: list[Statement] = []
        #: statements that were there before the mishap began, and have not been absent since; they
        #: do not state the mishap
        self._earlier: frozenset[tuple[str, str]] = frozenset()

    # -- time -----------------------------------------------------------------------------------

    def run(self, seconds: float) -> None:
        """Run the laboratory for a time [s], and watch statements and tensions."""
        for _ in range(round(seconds / SAMPLE_TIME)):
            self.step()

    def step(self) -> None:
        """Simulate one sample period, and watch statements and tensions."""
        lab = self.lab
        lab.step()
        self.peak = max(self.peak, float((lab.arm.tension / lab.arm.robot.tension.limit).max()))
        output = lab.estimator.output
        if self._errors is not None and output is not None:
            self._errors.append(float(np.linalg.norm(output.state.theta - lab.arm.theta)))
        if self.effect_at is None and lab.now > self.begun_at and self.case.is_visible(lab):
            self.effect_at = lab.now
        if self.mended_at is None and lab.now - self.begun_at >= self.case.lasts:
            self.mend()
        if lab.now >= self._next_look - 1e-9:
            self._next_look = lab.now + LOOK
            self.look()

    def look(self) -> None:
        """Read the statements of all nodes, and judge them."""
        lab, now = self.lab, self.lab.now
        found = statements(lab.estimator, lab.controller, lab.learner, now)
        self.present = troubles(found)
        self._earlier &= {(each.owner, each.identifier) for each in self.present}
        if self.present or not self._explores:
            self.quiet_since = now
        is_over = self.mended_at is not None and now - self.mended_at > LOOK
        for each in self.present:
            judged = judge(each, self.mishap, self.case)
            what = f'{each.owner} {each.identifier} {" ".join(sorted(each.subjects))}'.strip()
            self.stated.setdefault(what, [round(now - self.started_at, 2), judged, each.text[:200]])
            is_earlier = (each.owner, each.identifier) in self._earlier
            if judged == 'true' and self.true_at is None and not is_earlier:
                self.true_at, self.first_true = now, each.text
            if judged == 'false' and not is_over:
                key = f'{each.owner} {each.identifier}'
                at = round(now - self.started_at, 2)
                self.false.setdefault(key, {'at': at, 'text': each.text})
            if is_over and judged == 'false':
                self.later.setdefault(f'{each.owner} {each.identifier}', each.text)
            if each.steps and self.advised_at is None:
                self.advised_at = now

    @property
    def _explores(self) -> bool:
        supervisor = self.lab.controller.supervisor
        return supervisor.is_running and supervisor.explores

    @property
    def is_well(self) -> bool:
        """Whether the mishap is over, and the arm explores without any condition."""
        return self.mended_at is not None and self.lab.now - self.quiet_since >= QUIET

    def mend(self, by_advice: bool = False) -> None:
        """Mend the fault, as a person would; `by_advice` if a true message led to it."""
        if self.mended_at is None:
            self.case.mend(self.lab)
            self.mended_at, self.is_found_by_advice = self.lab.now, by_advice

    def mean_error(self, seconds: float) -> float:
        """Return the mean true error of the estimate [rad] over a time [s]."""
        self._errors = []
        self.run(seconds)
        errors, self._errors = self._errors, None
        return float(np.mean(errors)) if errors else math.nan

    # -- operator -------------------------------------------------------------------------------

    def play(self, rng: np.random.Generator) -> None:
        """Play the mishap, and follow the advice until the arm is well or it is too late."""
        self.run(rng.uniform(2.0, 8.0))
        if self.mishap.holds:
            self._hold(rng)
        self.false.clear()
        self.stated.clear()
        self.peak = 0.0
        self.begun_at = self.started_at = self.lab.now
        self.advised_at = self.true_at = None
        self.first_true = ''
        self._earlier = frozenset((each.owner, each.identifier) for each in self.present)
        self.case = self.mishap.begin(self.lab, rng)
        self._wait_for_advice()
        self._follow_advice(self.lab.now + self.mishap.patience)
        if self.mended_at is None:  # the person finds the fault without a statement
            self.taken.append('— found by the person —')
            self.mend()
            self._follow_advice(self.lab.now + 0.6 * self.mishap.patience)

    def _hold(self, rng: np.random.Generator) -> None:
        robot, lab = self.lab.arm.robot, self.lab
        lab.controller.explore(False)
        postures = robot.random_postures(200, rng)
        theta = [theta for theta, _ in holdable_postures(robot, iter(postures), HOLDABLE)][-1]
        self.run(0.1)
        lab.controller.target(dict(zip(robot.joints, ((t, 0.0) for t in theta.tolist()))))
        self.run(8.0)

    def _wait_for_advice(self) -> None:
        """Wait for REACTION seconds after the first advice, or until PATIENCE has ended."""
        lab, end = self.lab, self.begun_at + LONGEST_WAIT
        least = self.begun_at + self.case.lasts + REACTION if self.case.lasts < math.inf else 0.0
        while lab.now < max(end, least):
            self.step()
            if self.effect_at is not None:
                end = min(end, self.effect_at + PATIENCE)
            if self.advised_at is not None and lab.now > self.advised_at + REACTION:
                return
            if self.is_well and lab.now - self.begun_at > self.case.lasts + REACTION:
                return

    def _follow_advice(self, end: float) -> None:
        lab = self.lab
        while not self.is_well and lab.now < end:
            advised = list(
                dict.fromkeys((step, each) for each in self.present for step in each.steps)
            )
            cooled_before = self._cooled_for
            for step in dict.fromkeys(step for step, _ in advised):
                self._take(step, [each for other, each in advised if other is step])
                self.run(BETWEEN)
            end += self._cooled_for - cooled_before
            if not self.present and not self._explores and self.mended_at is not None:
                lab.controller.explore(True)  # the operator goes on with the work
            elif not advised and not self.present and self.mended_at is None:
                return  # nothing is stated, although the fault is present
            waited = lab.now + CALIBRATION
            self.run(SETTLING)
            while lab.estimator.calibration is not None and lab.now < min(waited, end):
                if lab.controller.supervisor.is_latched:
                    break
                self.run(1.0)

    def _take(self, step: Step, by: list[Statement]) -> None:
        """Take one step literally; `by` are the statements that advise it."""
        lab, refused = self.lab, ''
        try:
            if step is Step.RESET_CONTROLLER:
                present = lab.controller.reset(lab.now)
                refused = '' if present is None else present.text
            elif step is Step.RESET_ESTIMATOR:
                self._reset_estimator()
            elif step is Step.CALIBRATE_LENGTHS:
                lab.estimator.calibrate_lengths()
                lab.publish()
                self._reset_estimator()
            elif step in (Step.EXPLORE, Step.EXPLORE_GENTLY, Step.CHANGE_TARGET):
                refused = lab.controller.explore(True)
            elif step is Step.RESTORE_MUSCLES:
                isolated = lab.estimator.body.isolated
                lab.estimator.restore(isolated)
                lab.estimator.networks.declare_repaired(isolated, lab.now)
                lab.publish()
            elif step is Step.WAIT_UNTIL_COOL:
                self._wait_until_cool()
            elif step not in SOFTWARE:
                refused = self._mend_named(by)
        except MusculoskeletalError as error:
            refused = str(error)
        if self.mended_at is None and not refused and step in self.case.settled_by:
            self.mended_at, self.is_found_by_advice = lab.now, True
        if len(self.taken) < 60:
            self.taken.append(step.identifier + (f' ({refused[:90]})' if refused else ''))

    def _wait_until_cool(self) -> None:
        """Wait for motors to cool while a statement advises it; `_follow_advice` adds this time."""
        while self._cooled_for < COOLING:
            if not any(Step.WAIT_UNTIL_COOL in each.steps for each in self.present):
                break
            self.run(1.0)
            self._cooled_for += 1.0

    def _reset_estimator(self) -> None:
        lab = self.lab
        if not lab.estimator.cause and lab.estimator.confirm_joint_sensors():
            lab.publish()
            return
        finding = lab.estimator.suspects.finding
        lab.estimator.reset()
        if finding is not None:
            lab.estimator.networks.declare_repaired(finding.muscles, lab.now)
        lab.publish()

    def _mend_named(self, by: list[Statement]) -> str:
        """Mend what a true statement names; if none is true, return what the person finds."""
        if self.mended_at is not None:
            return ''
        for each in by:
            named = each.subjects & {*self.case.subjects, *self.case.found_at}
            if named or judge(each, self.mishap, self.case) == 'true':
                self.mend(by_advice=True)
                return ''
        subjects = ', '.join(sorted({name for each in by for name in each.subjects}))
        return f'nothing is wrong with {subjects or "it"}'


def judge(statement: Statement, mishap: Mishap, case: Case) -> str:
    """Judge whether a statement is 'true', 'allowed' (true but secondary) or 'false'.

    If the mishap concerns certain muscles or joints, a true statement names one of them.
    """
    concerned, subjects = frozenset(case.subjects), statement.subjects
    names_it = not concerned or bool(subjects & concerned)
    # A statement that only names other muscles or joints is about something else.
    is_about = names_it or not subjects
    is_said = bool(mishap.says) and re.search(mishap.says, statement.text, re.I) is not None
    is_true = statement.identifier in mishap.true or is_said
    if is_true and names_it:
        return 'true'
    is_secondary = is_true or statement.identifier in mishap.allowed
    if statement.identifier in SELF or (is_about and is_secondary):
        return 'allowed'
    return 'false'


# -- running ---------------------------------------------------------------------------------------


def learned_lab(robot: Robot, first: Mae, seed: int, reality: str, seconds: float) -> Lab:
    """Return a laboratory whose individual has explored and learned for `seconds` [s].

    `reality` and `seed` name the individual, and `first` is its initial network.
    """
    lab = Lab(make_arm(robot, seed, reality), first, seed)
    lab.run(1.0)
    lab.controller.explore(True)
    lab.run(seconds - AFTER)
    return lab


def play(lab: Lab, mishap: Mishap, seed: int, reality: str, before: float) -> dict[str, Any]:
    """Play one mishap in a laboratory; return its result by name.

    `reality` and `seed` name the individual. `before` is the error of its estimate so far [rad].
    """
    number = [each.name for each in MISHAPS].index(mishap.name)
    rng = np.random.default_rng([seed, reality == FOREIGN, number, 0x315])
    begun, from_now = time.process_time(), lab.now
    course = Course(lab, mishap)
    course.play(rng)
    is_quiet = course.is_well
    after = course.mean_error(AFTER)
    is_accurate = after <= max(WELL * before, before + WELL_RAD)
    case, effect, true_at = course.case, course.effect_at, course.true_at
    is_needed = not mishap.is_harmless and (effect is not None or true_at is not None)
    # Count a statement as immediate if it comes before the effect that this bench can see.
    delay = None if true_at is None else round(max(0.0, true_at - (effect or true_at)), 2)
    ended = '' if is_quiet else '; '.join(each.text for each in course.present) or 'not exploring'
    is_advised = course.is_found_by_advice or case.lasts < math.inf or mishap.is_harmless
    return {
        'mishap': mishap.name,
        'seed': seed,
        'reality': reality,
        'detail': case.detail,
        'effect': None if effect is None else round(effect - course.begun_at, 2),
        'needs statement': is_needed,
        'true after': delay,
        'true': course.first_true,
        'false': course.false,
        'afterwards': course.later,
        'stated': course.stated,
        'mended by advice': is_advised,
        'well': bool(is_quiet and is_accurate and (is_advised or effect is None)),
        'ended': ended[:300],
        'steps': course.taken,
        'error before': round(before, 4),
        'error after': round(after, 4),
        'peak': round(course.peak, 3),
        'simulated': round(lab.now - from_now, 1),
        'cpu': round(time.process_time() - begun, 1),
    }


def play_forked(lab: Lab, mishap: Mishap, file: Path, *rest: Any) -> None:
    """Play a mishap in a copy of the laboratory, a forked process, and append its result."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        try:
            os.waitpid(child, 0)
        except BaseException:
            os.kill(child, signal.SIGKILL)
            raise
        return
    status = 1
    try:
        result = play(lab, mishap, *rest)
        with file.open('a', encoding='utf-8') as stream:
            stream.write(json.dumps(result, ensure_ascii=False) + '\n')
        print(line(result), flush=True)
        status = 0
    except BaseException:  # noqa: BLE001 - the child must not return into the caller's code
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def line(result: dict[str, Any]) -> str:
    """Return one result as a line for people."""
    after = result['true after']
    said = 'harmless' if not result['needs statement'] else 'never'
    said = f'{after:.1f} s' if after is not None else said
    false = ', '.join(result['false']) or '–'
    return (
        f'{result["reality"]:8}{result["seed"]:3} {result["mishap"][:40]:41}'
        f'{result["detail"][:34]:35} true {said:9} well {"yes" if result["well"] else "NO":4}'
        f'error {result["error before"]:.3f} → {result["error after"]:.3f}  '
        f'peak {result["peak"]:.2f}  {result["simulated"]:.0f} s in {result["cpu"]:.0f} s  '
        f'false: {false}'
    )


def results(folder: Path) -> list[dict[str, Any]]:
    """Return the newest result of each mishap, seed and emulator model in a folder."""
    newest = {}
    for file in sorted(folder.glob('*.jsonl')):
        for text in file.read_text('utf-8').splitlines():
            each = json.loads(text)
            newest[each['reality'], each['seed'], each['mishap']] = each
    return list(newest.values())


def without_result(folder: Path, seed: int, reality: str, kinds: Sequence[str]) -> list[str]:
    """Return the names of those mishaps in `kinds` that have no result in the folder yet.

    `reality` and `seed` name the individual.
    """
    done = {
        each['mishap']
        for each in results(folder)
        if (each['seed'], each['reality']) == (seed, reality)
    }
    return [name for name in kinds if name not in done]


def run_seed(robot: Robot, folder: Path, seed: int, reality: str, to_do: Sequence[str]) -> None:
    """Run mishaps of the individual of `reality` and `seed`, and append the results to its file."""
    file = folder / f'{reality}_{seed}.jsonl'
    first = initial(robot, folder)
    mishap_kinds.OTHER_NETWORK[:] = [other_network(robot, first, reality, folder)]
    begun = time.process_time()
    lab = learned_lab(robot, first, seed, reality, LEARNING)
    watch = Course(lab, NAMES[to_do[0]])
    before = watch.mean_error(AFTER)
    took = time.process_time() - begun
    is_calibrated = lab.estimator.health.residual.is_calibrated
    print(
        f'{reality} {seed}: learned for {LEARNING:g} s in {took:.0f} s, error {before:.4f} rad, '
        f'{lab.learner.updates} updates, detector {"" if is_calibrated else "not "}calibrated',
        flush=True,
    )
    for name in to_do:
        play_forked(lab, NAMES[name], file, seed, reality, before)


def other_network(robot: Robot, first: Mae, reality: str, folder: Path) -> Mae:
    """Return the network of another individual of `reality`, if possible from `folder`."""
    file = folder / f'other_{reality}.safetensors'
    if not file.exists():
        lab = learned_lab(robot, first, OTHER_SEED, reality, OTHER_LEARNING)
        checkpoint.save(lab.learner.mae, file)
    return checkpoint.load(file, robot)


def run_healthy(robot: Robot, folder: Path, seed: int, reality: str, hours: float) -> int:
    """Let a healthy arm explore for `hours`; print and count its different warnings and errors."""
    lab = learned_lab(robot, initial(robot, folder), seed, reality, AFTER)
    course = Course(lab, MISHAPS[0])
    course.run(3600.0 * hours - AFTER)
    print(f'{reality} {seed}: healthy for {lab.now:.0f} s, {len(course.false)} conditions')
    for name, each in course.false.items():
        print(f'    {name} at {each["at"]} s: {each["text"]}', flush=True)
    return len(course.false)


def is_wanted(name: str, kinds: Sequence[str] | None) -> bool:
    """Return whether the option `--kinds` names a mishap or a part of its name."""
    return kinds is None or any(kind in name for kind in kinds)


def run_graph(
    folder: Path, seeds: Iterable[int], wanted: Sequence[str] | None, again: bool
) -> None:
    """Run the mishaps on the ROS graph, once for each seed.

    Mishaps that have a result are left out, unless `again` repeats them.
    """
    from bench.mishaps_on_graph import GRAPH_MISHAPS, run

    network = folder / 'graph.safetensors'
    if not network.exists():
        checkpoint.save(initial_mae(Robot.load('arm26')), network)
    for seed in seeds:
        done = {
            each['mishap']
            for each in results(folder)
            if (each['seed'], each['reality']) == (seed, GRAPH) and not again
        }
        named = [each.name for each in GRAPH_MISHAPS if is_wanted(each.name, wanted)]
        kinds = [name for name in named if name not in done]

        def keep(result: dict[str, Any], file: Path = folder / f'{GRAPH}_{seed}.jsonl') -> None:
            with file.open('a', encoding='utf-8') as stream:
                stream.write(json.dumps(result, ensure_ascii=False) + '\n')
            print(line(result), flush=True)

        if kinds:
            run(folder / f'{GRAPH}_{seed}', network, seed, kinds, keep)


# -- table -----------------------------------------------------------------------------------------


def row(of: Sequence[dict[str, Any]]) -> list[str]:
    """Return the cells of the table for all results of one mishap and emulator model."""
    if not of:
        return ['–'] * len(PAGE_FACTS)
    needed = [each for each in of if each['needs statement']]
    times = [math.inf if each['true after'] is None else each['true after'] for each in needed]
    soon = sum(after <= GOAL for after in times)
    median = float(np.median(times)) if times else math.nan
    after = 'never' if math.isinf(median) else '–' if math.isnan(median) else f'{median:.1f} s'
    before, later = (np.nanmedian([each[f'error {when}'] for each in of]) for when in WHEN)
    return [
        f'{soon}/{len(needed)}' if needed else 'not needed',
        after,
        str(sum(len(each['false']) for each in of)),
        f'{sum(each["well"] for each in of)}/{len(of)}',
        f'{before:.3f} → {later:.3f}',
        f'{max(each["peak"] for each in of):.2f}',
    ]


WHEN = 'before', 'after'


def totals(of: Sequence[dict[str, Any]]) -> tuple[float, int, float]:
    """Return the shares of timely true statements and of good ends, and the false statements.

    Returns:
        Share of true statements within GOAL of the cases that need one [%], number of false
        statements, and share of the cases that ended well [%].
    """
    needed = [each for each in of if each['needs statement']]
    soon = [each['true after'] is not None and each['true after'] <= GOAL for each in needed]
    return (
        100.0 * float(np.mean(soon)) if soon else math.nan,
        sum(len(each['false']) for each in of),
        100.0 * float(np.mean([each['well'] for each in of])) if of else math.nan,
    )


def graph_table(of: Sequence[dict[str, Any]]) -> str:
    """Return the table of the mishaps on the ROS graph in Markdown."""
    lines = ['| mishap | ' + ' | '.join(PAGE_FACTS) + ' |', '|---' * 7 + '|']
    mine = [each for each in of if each['reality'] == GRAPH]
    for name in dict.fromkeys(each['mishap'] for each in mine):
        cells = row([each for each in mine if each['mishap'] == name])
        lines.append('| ' + ' | '.join([name, *cells]) + ' |')
    return '\n'.join(lines)


def table(of: Sequence[dict[str, Any]], realities: Sequence[str]) -> str:
    """Return the table of all mishaps in Markdown."""
    heads = [f'{reality}: {fact}' for reality in realities for fact in PAGE_FACTS]
    lines = ['| mishap | ' + ' | '.join(heads) + ' |', '|---' * (len(heads) + 1) + '|']
    for mishap in MISHAPS:
        cells = [mishap.name]
        for reality in realities:
            cells += row([e for e in of if (e['mishap'], e['reality']) == (mishap.name, reality)])
        if any(cell != '–' for cell in cells[1:]):
            lines.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def _place(name: str) -> int:
    """Return the place of a mishap in tables; those on the graph come last."""
    order = [mishap.name for mishap in MISHAPS]
    return order.index(name) if name in order else len(order)


def _false_statements(of: Iterable[dict[str, Any]]) -> str:
    """Return a Markdown table of the false statements, one for each mishap and identifier."""
    first: dict[tuple[str, str], tuple[str, int]] = {}
    for each in of:
        for name, what in each['false'].items():
            text, count = first.get((each['mishap'], name), (what['text'], 0))
            first[each['mishap'], name] = text, count + 1
    ordered = sorted(first.items(), key=lambda item: (_place(item[0][0]), item[0][1]))
    rows = [
        f'| {mishap} | `{name}` | {count} | {text.replace("|", "/")[:240]} |'
        for (mishap, name), (text, count) in ordered
    ]
    return '\n'.join(['| mishap | node and statement | cases | text |', '|---|---|---|---|', *rows])


def _bad_ends(of: Iterable[dict[str, Any]]) -> str:
    """Return a Markdown table of the cases that did not end well, with the steps and the reason."""
    rows = []
    for each in sorted(of, key=lambda each: _place(each['mishap'])):
        if each['well']:
            continue
        error = f'{each["error before"]:.3f} → {each["error after"]:.3f}'
        how = each['ended'] or ('' if each['mended by advice'] else 'advice did not mend it')
        steps = ', '.join(dict.fromkeys(each['steps'])) or 'none'
        rows.append(
            f'| {each["mishap"]} ({each["detail"]}) | {each["reality"]} {each["seed"]} | {error} '
            f'| {steps.replace("|", "/")[:200]} | {how.replace("|", "/")[:160]} |'
        )
    head = '| mishap | individual | error [rad] | steps that were taken | at the end |'
    return '\n'.join([head, '|---|---|---|---|---|', *rows])


def page(of: Sequence[dict[str, Any]], realities: Sequence[str]) -> str:
    """Return the page of results in Markdown."""
    soon, false, well = totals(of)
    on_graph = [each['reality'] == GRAPH for each in of]
    commit = subprocess.run(
        ['git', 'log', '-1', '--format=%h', '--', 'musculoskeletal_ae'],
        cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False,
    ).stdout.strip()  # fmt: skip
    seeds = sorted({each['seed'] for each in of})
    worst = max((each['peak'] for each in of), default=math.nan)
    head = PAGE.format(
        kinds=len({each['mishap'] for each in of}),
        learning=f'{LEARNING:g}',
        realities=' and '.join(realities),
        seeds=', '.join(map(str, seeds)),
        runs=len(of),
        commit=commit,
        soon=f'{soon:.0f}',
        false=false,
        well=f'{well:.0f}',
        worst=f'{worst:.2f}',
        goal=f'{GOAL:g}',
        longest=f'{LONGEST_WAIT:g}',
        after=f'{AFTER:g}',
        angle=f'{mishap_kinds.SHOWN_ANGLE:g}',
        length=f'{1e3 * mishap_kinds.SHOWN_LENGTH:g}',
        tension=f'{mishap_kinds.SHOWN_TENSION:g}',
        ratio=f'{WELL:g}',
        more=f'{WELL_RAD:g}',
    )
    planned = len(REALITIES) * len(SEEDS) * len(MISHAPS)
    part = len(of) - sum(on_graph)
    missing = f'**Incomplete**: {part} of {planned} runs have a result; the rest was not measured.'
    parts = (
        head,
        *([missing] if part < planned else []),
        table(of, realities),
        *(['## On the ROS graph', GRAPH_TEXT, graph_table(of)] if any(on_graph) else []),
        '## False statements',
        _false_statements(of),
        '## Cases that did not end well',
        _bad_ends(of),
    )
    return '\n\n'.join(parts) + '\n'


def main(argv: list[str]) -> int:
    """Play the mishaps and print the table; return 1 if the goals are missed."""
    parser = Parser('mishaps', (__doc__ or '').partition('\n')[0])
    parser.add_robot()
    parser.add_seeds(SEEDS)
    parser.add_argument(
        '--reality', type=names, default=','.join(REALITIES), help='emulator models'
    )
    parser.add_argument(
        '--kinds', type=names, help='mishaps, or parts of their names (default: all)'
    )
    parser.add_argument('--list', action='store_true', help='list the mishaps and run none')
    parser.add_argument('--again', action='store_true', help='repeat mishaps that have a result')
    parser.add_argument(
        '--healthy', type=positive, help='let healthy arms explore for this time instead [h]'
    )
    parser.add_argument(
        '--graph', action='store_true', help='mishaps of nodes and topics instead, on a ROS graph'
    )
    parser.add_argument(
        '--page', type=Path, help='write the page of all results in --out, run none'
    )
    parser.add_out('DIR', 'folder of the results', Path('bench_mishaps'))
    parser.add_quick('the first 11 mishaps of individual 0, emulator model kin')
    parser.add_workers()
    options = parser.parse_args(argv)
    if options.list:
        print('\n'.join(mishap.name for mishap in MISHAPS))
        return 0
    folder, realities = options.out, options.reality
    if options.page:
        options.page.write_text(page(results(folder), realities), encoding='utf-8')
        return 0
    kinds = [mishap.name for mishap in MISHAPS if is_wanted(mishap.name, options.kinds)]
    if not kinds and not options.graph:
        parser.error(f'--kinds {options.kinds}: no mishap has such a name; see --list')
    seeds = options.seeds
    if options.quick:
        seeds, realities, kinds = seeds[:1], realities[:1], kinds[:11]
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    robot = Robot.load(options.robot)
    if options.healthy:
        return int(
            sum(run_healthy(robot, folder, s, r, options.healthy) for r in realities for s in seeds)
            > 0
        )
    if options.graph:
        run_graph(folder, seeds, options.kinds, options.again)
        print(graph_table(results(folder)))
        return 0
    folder = folder.resolve()
    calls = list[tuple[Robot, Path, int, str, Sequence[str]]]()
    for reality in realities:
        for seed in seeds:
            names_left = without_result(folder, seed, reality, kinds)
            to_do = kinds if options.again else names_left
            if to_do:
                calls.append((robot, folder, seed, reality, to_do))
    for reality in {call[3] for call in calls}:  # train once, and not for each individual
        other_network(robot, initial(robot, folder), reality, folder)
    with workers(options.jobs, options.scheduler) as processes:
        for _ in processes.in_order(run_seed, calls):
            pass
    mine = [
        each
        for each in results(folder)
        if each['seed'] in seeds and each['reality'] in realities and each['mishap'] in kinds
    ]
    print(table(mine, realities))
    soon, false, well = totals(mine)
    print(f'{soon:.0f} % true within {GOAL:g} s, {false} false statements, {well:.0f} % end well')
    return int(not (soon >= 95.0 and false == 0 and well == 100.0))
