# SPDX-License-Identifier: Apache-2.0
"""Writes the pages and pictures that are generated from the code.

    python doc/make.py

- `reference/api.md`: public classes and functions
- `reference/parameters.md`: the parameters of all nodes
- `reference/command_line.md`: `--help` of all scripts and executables
- `reference/stops.md`: modes and stop causes
- the tables of results in `README.md`, `results.md` and `explanation/how_it_compares.md`, and that
  of conditions in `reference/diagnostics.md`
- `images/elastic_unit.png`: the series elastic element; `images/muscles.png`: an arm
- the charts of the results in `results/`
- `config/nodes.yaml`: all parameters with their defaults
"""

import ast
import json
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import comparison
import numpy as np
import pages

from musculoskeletal_ae.experiments import plots, robustness, sensors
from musculoskeletal_ae.experiments.results import individuals, read
from musculoskeletal_ae.experiments.study import Measured
from musculoskeletal_ae.nodes.declared_parameters import yaml_text
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.robot.robot import Robot

FOLDER = Path(__file__).resolve().parent
PACKAGE = FOLDER.parent / 'musculoskeletal_ae'
README = FOLDER.parent / 'README.md'
DOCUMENTS = (
    README,
    FOLDER / 'explanation' / 'how_it_compares.md',
    FOLDER / 'results.md',
    FOLDER / 'reference' / 'diagnostics.md',
)
#: what a program in Python builds on, module by module
MODULES = {
    'robot/robot.py': ['Robot'],
    'robot/description.py': ['RobotDescription', 'TensionRange', 'load_description'],
    'robot/actuation.py': ['Actuation'],
    'robot/tension_source.py': ['TensionSource'],
    'robot/series_elastic.py': ['SeriesElastic'],
    'robot/joint_units.py': ['JointUnits', 'JointUnit'],
    'robot/kinematics.py': ['Kinematics'],
    'robot/routes.py': ['Routes'],
    'design/checks.py': ['check_robot', 'RobotCheck', 'Setting'],
    'design/holding_remedies.py': ['remedies'],
    'design/suggestion.py': ['suggest', 'write'],
    'robot/tension.py': ['holding_tension', 'least_tension'],
    'mae/mae.py': ['Mae'],
    'mae/units.py': ['State'],
    'mae/checkpoint.py': ['load', 'save', 'from_bytes', 'to_bytes'],
    'mae/initial_training.py': ['initial_mae'],
    'conditions.py': [
        'Condition',
        'ConditionKind',
        'Stop',
        'FindingReaction',
        'Revokes',
        'from_json',
    ],
    'problems.py': ['Problem'],
    'report.py': ['Report'],
    'messages/arrival.py': ['Arrival'],
    'awake_clock.py': ['AwakeClock'],
    'estimation/estimator.py': ['Estimator', 'Output'],
    'estimation/finding.py': ['Finding', 'Observation', 'Detector'],
    'estimation/health.py': ['HealthMonitor'],
    'signals/body_state.py': ['BodyState', 'LengthOffsets', 'Trust'],
    'signals/muscle_states.py': ['MuscleReadings', 'Quantity'],
    'signals/muscle_stream.py': ['MuscleStream', 'MuscleSample', 'RejectionError'],
    'signals/friction.py': ['FrictionDirection', 'Transmission'],
    'control/controller.py': ['Controller'],
    'control/supervisor.py': ['Supervisor', 'Activity', 'StopState'],
    'control/watchdog.py': ['Watchdog'],
    'control/controller_status.py': ['report', 'conditions', 'slowed'],
    'control/settings.py': ['Settings'],
    'motion/trajectory.py': ['Trajectory', 'Setpoint'],
    'messages/message_reading.py': ['TrajectoryPoints'],
    'motion/follower.py': ['Follower'],
    'motion/progress.py': ['Progress'],
    'learning/learner.py': ['Learner'],
    'simulation/simulation.py': ['Simulation'],
    'emulator/reality.py': ['make_arm'],
    'emulator/faults.py': ['ArmReadings'],
    'emulator/modules.py': ['Arm'],
    'driver/listening.py': ['Listening'],
    'driver/stiffness_motion_test.py': ['Winding'],
    'driver/verdict.py': ['Verdict'],
    'tables/table.py': ['Table'],
    'tables/csv_file.py': ['read_csv'],
    'learning/recordings.py': ['learn_table', 'table_errors'],
    'bags/reader.py': ['Bag'],
    'bags/streams.py': ['read_streams', 'Streams'],
    'exceptions.py': ['MusculoskeletalError'],
}


PARAMETERS_INTRODUCTION = """\
`python doc/make.py` writes this page from the code. Pass parameters with `--ros-args -p
NAME:=VALUE`, `--params-file FILE`, or `./bringup.sh -p NODE:NAME:=VALUE`.
[config/nodes.yaml](../../config/nodes.yaml) holds all defaults as a parameter file, and `ros2 param
describe` gives the same texts.

Parameters marked * can be set while the node runs. To empty a list of names, use `"['']"`. An
unknown parameter and a value outside the legal range are refused, with the legal set."""
COMMAND_LINE_INTRODUCTION = """\
`python doc/make.py` writes this page from `--help`. `ros2 run musculoskeletal_ae NAME` and
`$bin/NAME` run the same executable ([which](../howto/install.md#use-it-in-another-terminal)).
Nodes take no options of their own, only `--ros-args`: see [Parameters](parameters.md) and
[Topics and services](topics_and_services.md). `check_driver`, `record`, `render`, `replay` and
`view` also take `--ros-args` after their own options, such as `--ros-args -r __ns:=/left_arm -r
TOPIC:=OTHER`. `-h` prints the help.

On Ctrl-C (SIGINT), SIGTERM and SIGHUP (closed terminal), a node ends with exit status 0. `record`
and `replay` also end with 0, because this is the usual way to end them. Any other tool ends with
130 and prints one line, which states whether its result was written. In this case,
`train --from-bag` saves what it has learned to `NAME.interrupted.safetensors` beside the file of
`--out`."""

#: parts of every --help that the page states once
REPEATED = (
    r'(?m)^  -h, --help +show this help message and exit\n',
    r'\s+Options\s+of\s+ROS\s+follow\s+--ros-args,\s+such\s+as\s+--ros-args[^.]+\.',
)


def _first(node: ast.AST) -> str:
    text = ast.get_docstring(node) or ''  # type: ignore[arg-type]
    return ' '.join(text.split('\n\n')[0].split())


def _signature(node: ast.FunctionDef, name: str) -> str:
    arguments = ast.unparse(node.args).removeprefix('self').removeprefix('cls').removeprefix(', ')
    returned = f' -> {ast.unparse(node.returns)}' if node.returns and name == node.name else ''
    return f'`{name}({arguments}){returned}`'


def _class(node: ast.ClassDef) -> list[str]:
    methods = [member for member in node.body if isinstance(member, ast.FunctionDef)]
    made = next((member for member in methods if member.name == '__init__'), None)
    lines = [f'**{_signature(made, node.name) if made else f"`{node.name}`"}** {_first(node)}', '']
    fields = [
        f'{ast.unparse(member.target)}: {ast.unparse(member.annotation)}'
        for member in node.body
        if isinstance(member, ast.AnnAssign)
    ]
    for member in methods:
        marks = [ast.unparse(mark) for mark in member.decorator_list]
        plain = 'property' in marks or 'cached_property' in marks
        kind = f': {ast.unparse(member.returns)}' if plain and member.returns else '()'
        fields.append(member.name + kind)
    public = ' '.join(f'`{name}`' for name in fields if not name.startswith('_'))
    return [*lines[:1], public, ''] if public else lines


def api() -> str:
    """Return the page of public classes and functions."""
    lines = [
        '# Python, without ROS',
        '',
        'This page lists the classes and functions that a program may use; `python doc/make.py`',
        'writes it from the code. Arrays are arrays of numpy, and units are SI units. θ has the',
        'order of `joints` in `muscles.yaml`, and T and l have the order of its muscles. θ is in',
        'rad for prismatic joints, too: 60 mm count as 1 rad. `robot.units` converts from and to',
        'metres. `help()` shows the docstrings, which describe arguments and results.',
        '',
    ]
    for file, names in MODULES.items():
        tree = ast.parse((PACKAGE / file).read_text(encoding='utf-8'))
        module = f'musculoskeletal_ae.{file.removesuffix(".py").replace("/", ".")}'
        lines += [f'## {module}', '']
        if len(names) > 1:  # the summary of a single class says the same
            lines += [_first(tree), '']
        nodes = {node.name: node for node in tree.body if hasattr(node, 'name')}
        for name in names:
            node = nodes[name]
            if isinstance(node, ast.ClassDef):
                lines += _class(node)
            else:
                lines += [f'**{_signature(node, name)}** {_first(node)}', '']
    return '\n'.join(lines).rstrip() + '\n'


def parameters() -> str:
    """Return the page of all parameters of all nodes."""
    from musculoskeletal_ae.nodes.declared_parameters import PARAMETERS

    lines = ['# Parameters', '', *PARAMETERS_INTRODUCTION.splitlines(), '']
    for node, table in PARAMETERS.items():
        lines += [
            f'## {node}',
            '',
            '| parameter | default | meaning | legal |',
            '|---|---|---|---|',
        ]
        for name, parameter in table.items():
            mark = '*' if parameter.settable else ''
            default = json.dumps(parameter.default)
            meaning, legal = (
                text.replace('|', '\\|') for text in (parameter.meaning, parameter.legal_values)
            )
            lines.append(f'| `{name}`{mark} | `{default}` | {meaning} | {legal} |')
        lines.append('')
    return '\n'.join(lines).rstrip() + '\n'


def _printed(command: list[str]) -> str:
    environment = os.environ | {'COLUMNS': '100'}
    return subprocess.run(  # noqa: S603 - commands of this file only
        command, capture_output=True, text=True, check=True, env=environment
    ).stdout.rstrip()


def command_line() -> str:
    """Return the page with the help of all scripts and executables."""
    from musculoskeletal_ae import executables

    usage = _printed([str(FOLDER.parent / 'bringup.sh'), '--help'])
    lines = ['# Command line', '', *COMMAND_LINE_INTRODUCTION.splitlines(), '']
    lines += ['## ./bringup.sh', '', '```text', usage, '```', '']
    for name in sorted(name for name, value in vars(executables).items() if callable(value)):
        function = getattr(executables, name)
        if not isinstance(function, partial):
            continue
        code = f'from musculoskeletal_ae.executables import {name} as run; raise SystemExit(run())'
        text = _printed([sys.executable, '-c', code, '--help'])
        for repeated in REPEATED:
            text = re.sub(repeated, '', text)
        if text.startswith('The node '):  # the page on topics says the rest
            text = text.partition('\n\n')[0]
        if name == 'combined':
            text = 'The nodes `estimator` and `controller` in one process.'
        lines += [
            f'## {name}',
            '',
            '```text',
            text.partition('\nParameters:')[0].rstrip(),
            '```',
            '',
        ]
    return '\n'.join(lines).rstrip() + '\n'


#: of doc/results.md: what, a text with numbers of an experiment's result.json, and the experiment
CAPABILITIES = (
    (
        'joint-angle error after learning without joint sensors',
        (
            '{none_rad:.3f} rad ({before_rad:.3f} before; '
            'later versions have [more](#fewer-joint-sensors))'
        ),
        'sensors',
    ),
    (
        'the same, if a camera sees a marker on the hand in a tenth of the resting postures',
        '{marker_tenth_rad:.3f} rad',
        'sensors',
    ),
    (
        'naming the ruptured muscle, if it carried tension',
        '{named} of {counted_cuts}, {detection_s:.2f} s after the rupture on average',
        'estimation',
    ),
    (
        'false alarms of healthy arms',
        '{false_alarms} in {hours:.0f} h',
        'estimation',
    ),
    (
        'isolating exactly the ruptured muscle within 16 s (`on_anomaly: isolate`)',
        '{isolated} of {ruptures}',
        'resilience',
    ),
    (
        'wrong isolations of healthy arms',
        '{wrong_isolations} in {hours:.0f} h',
        'resilience',
    ),
    (
        'mean tracking error of point-to-point motions of 1 s, slowed to 1.2 s on average',
        '{track_1s_rad:.3f} rad',
        'motion',
    ),
    (
        'estimating a force of 10–50 N on the hand without a force sensor',
        'magnitude {wrench_error:.0%} and direction {wrench_error_deg:.1f}° off',
        'motion',
    ),
)


def capabilities_table() -> str:
    """Return the table of capabilities in doc/results.md."""
    results = read(FOLDER / 'results')
    lines = ['| capability on `kin` | result | experiment |', '|---|---|---|']
    for what, text, name in CAPABILITIES:
        which = individuals(results[name]['about']['seeds'])
        lines.append(f'| {what} | {_with_numbers(text, results[name])} | `{name}`, {which} |')
    return '\n'.join(lines)


def _with_numbers(text: str, result: dict[str, Any]) -> str:
    """Replace the placeholders in a text by numbers of a result and counts derived from them."""
    numbers = dict(result)
    numbers['hours'] = result.get('healthy_s', 0.0) / 3600.0
    if 'named_share' in result:
        numbers['named'] = round(result['named_share'] * result['counted_cuts'])
    if 'right_isolations_share' in result:
        numbers['ruptures'] = len(result['muscles']) * len(result['about']['seeds'])
        numbers['isolated'] = round(result['right_isolations_share'] * numbers['ruptures'])
    return text.format(**numbers)


def recordings_tables() -> str:
    """Return the tables of the recordings of other people's robots."""
    return (FOLDER / 'results' / 'recordings' / 'tables.md').read_text('utf-8').strip()


TABLES = {
    'estimates': comparison.estimates,
    'methods': comparison.methods,
    'capabilities': capabilities_table,
    'recordings': recordings_tables,
    'random_rows': comparison.random_rows,
    'conditions': pages.conditions,
}


def with_tables(text: str) -> str:
    """Update the generated tables of a document from the committed results.

    A table lies between `<!-- NAME -->` and `<!-- /NAME -->`, where NAME is a key of TABLES.
    """
    for name, make in TABLES.items():
        if f'<!-- {name} -->' not in text:
            continue
        begin, end = f'<!-- {name} -->', f'<!-- /{name} -->'
        head, _, rest = text.partition(begin)
        text = f'{head}{begin}\n\n{make()}\n\n{end}{rest.partition(end)[2]}'
    return text


PAGES = {
    'api.md': api,
    'parameters.md': parameters,
    'command_line.md': command_line,
    'stops.md': pages.stops,
}


def draw_series_elastic(file: Path) -> None:
    """Draw how the constants force, rate and wire_stretch change the elongation L_e(T)."""
    from musculoskeletal_ae.robot.series_elastic import DEFAULT, SeriesElastic

    tension = np.linspace(0.0, 300.0, 200)
    changes = {
        'force': ('N', (50.0, 100.0, 200.0)),
        'rate': ('1/m', (20.0, 30.0, 45.0)),
        'wire_stretch': ('1/N', (0.0, 2e-5, 1e-4)),
    }
    figure, panels = plots.new_figure(9.5, 3.6, 1, len(changes), sharey=True)
    for panel, (name, (unit, values)) in zip(panels, changes.items()):
        for value, colour in zip(values, (plots.BEFORE, plots.TRUE, plots.AFTER)):
            constants = {key: np.array(v) for key, v in (DEFAULT | {name: value}).items()}
            stretch = 1e3 * SeriesElastic(**constants).elongation(np.array(0.5), tension)
            default = ' (default)' if value == DEFAULT[name] else ''
            panel.plot(tension, stretch, color=colour, label=f'{value:g} {unit}{default}')
        plots.tidy(panel, 'tension T [N]', '', name)
        panel.legend(fontsize=9)
    panels[0].set_ylabel('elongation of 0.5 m [mm]')
    figure.savefig(file, dpi=plots.DPI)


def draw_muscles(file: Path) -> None:
    """Draw an arm with its muscles, each in a different colour and with its name."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    colours = colormaps['tab10'].colors
    robot = Robot.load('musashi_left_arm')
    theta = robot.lower + 0.35 * (robot.upper - robot.lower)
    theta[0] = 0.4 * robot.upper[0]
    parts = draw_arm(robot, theta, np.full(robot.muscle_count, robot.tension.bias))
    figure = Figure(figsize=(9.5, 4.6))
    figure.subplots_adjust(0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
    points = np.vstack([part.points for part in parts])
    low, high = points.min(axis=0) - 0.02, points.max(axis=0) + 0.02
    handles = {}
    for place, (title, azimuth) in enumerate({'front': 0.0, 'left side': 90.0}.items(), 1):
        axes: Any = figure.add_axes((0.4 * (place - 1), 0.0, 0.4, 0.95), projection='3d')
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(tuple(high - low), zoom=1.3)
        axes.view_init(elev=8.0, azim=azimuth + 12.0)
        axes.set_axis_off()
        axes.set_title(title, y=0.98)
        muscles = iter(zip(robot.muscles, colours))
        for part in parts:
            if part.kind != 'muscles':
                axes.plot(*part.points.T, color='#D8D4C8', lw=9.0, solid_capstyle='round', zorder=1)
                continue
            name, colour = next(muscles)
            (handles[name],) = axes.plot(*part.points.T, color=colour, lw=2.2, label=name, zorder=2)
    figure.legend(handles=[*handles.values()], loc='center right', frameon=False)
    figure.savefig(file, dpi=plots.DPI)


def draw_results() -> None:
    """Draw the charts of the committed results."""
    results = read(FOLDER / 'results')
    for name, draws in {
        'robustness': (robustness.kin, robustness.foreign, robustness.ablation),
        'sensors': (sensors.sensors,),
    }.items():
        rows = {int(s): Measured(numbers, {}) for s, numbers in results[name]['seeds'].items()}
        for draw in draws:
            figure, _ = draw(None, rows)
            figure.savefig(FOLDER / 'results' / name / f'{draw.__name__}.png', dpi=plots.DPI)


if __name__ == '__main__':
    (FOLDER.parent / 'config' / 'nodes.yaml').write_text(yaml_text(), encoding='utf-8')
    for page, make in PAGES.items():
        (FOLDER / 'reference' / page).write_text(make(), encoding='utf-8')
    for document in DOCUMENTS:
        document.write_text(with_tables(document.read_text('utf-8')), encoding='utf-8')
    draw_series_elastic(FOLDER / 'images' / 'elastic_unit.png')
    draw_muscles(FOLDER / 'images' / 'muscles.png')
    draw_results()
