# SPDX-License-Identifier: Apache-2.0
"""Writes what is made from the code: `reference/api.md`, and the picture of the elastic unit.

python doc/make.py
"""

import ast
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
PACKAGE = FOLDER.parent / 'musculoskeletal_ae'
#: what a program in Python builds on, module by module
MODULES = {
    'robot/robot.py': ['Robot'],
    'robot/description.py': ['RobotDescription', 'TensionRange', 'load_description'],
    'robot/series_elastic.py': ['SeriesElastic'],
    'robot/kinematics.py': ['Kinematics'],
    'robot/routes.py': ['Routes'],
    'robot/checks.py': ['check_robot', 'RobotCheck', 'Finding', 'Setting'],
    'robot/remedies.py': ['remedies'],
    'robot/suggestion.py': ['suggest', 'write'],
    'robot/tension.py': ['holding_tension', 'least_tension'],
    'mae/mae.py': ['Mae'],
    'mae/units.py': ['State'],
    'mae/checkpoint.py': ['load', 'save', 'from_bytes', 'to_bytes'],
    'mae/training.py': ['initial_mae'],
    'estimation/estimator.py': ['Estimator', 'Output'],
    'estimation/finding.py': ['Finding', 'Kind', 'Observation', 'Detector'],
    'estimation/health.py': ['HealthMonitor'],
    'signals/body_state.py': ['BodyState', 'LengthOffsets'],
    'signals/muscle_stream.py': ['MuscleStream', 'MuscleSample', 'RejectionError'],
    'signals/friction.py': ['FrictionDirection'],
    'control/controller.py': ['Controller'],
    'control/supervisor.py': ['Supervisor', 'Activity', 'StopState'],
    'control/stops.py': ['StopCause', 'Condition', 'Action', 'Clears'],
    'control/watchdog.py': ['Watchdog'],
    'control/status.py': ['report', 'slowed'],
    'control/settings.py': ['Settings'],
    'control/trajectory.py': ['Trajectory', 'Points', 'Setpoint'],
    'control/follower.py': ['Follower'],
    'learning/learner.py': ['Learner'],
    'simulation/simulation.py': ['Simulation'],
    'emulator/reality.py': ['make_arm'],
    'emulator/modules.py': ['Arm'],
    'driver/listening.py': ['Listening'],
    'driver/winding.py': ['Winding'],
    'driver/verdict.py': ['Verdict', 'Fault'],
    'bags/reader.py': ['Bag'],
    'bags/streams.py': ['read_streams', 'Streams'],
    'exceptions.py': ['MusculoskeletalError'],
}


def _first(node: ast.AST) -> str:
    text = ast.get_docstring(node) or ''  # type: ignore[arg-type]
    return ' '.join(text.split('\n\n')[0].split())


def _signature(node: ast.FunctionDef, name: str) -> str:
    given = ast.unparse(node.args).removeprefix('self').removeprefix('cls').removeprefix(', ')
    returned = f' -> {ast.unparse(node.returns)}' if node.returns and name == node.name else ''
    return f'`{name}({given}){returned}`'


def _class(node: ast.ClassDef) -> list[str]:
    methods = [member for member in node.body if isinstance(member, ast.FunctionDef)]
    made = next((member for member in methods if member.name == '__init__'), None)
    lines = [f'**{_signature(made, node.name) if made else f"`{node.name}`"}** {_first(node)}', '']
    fields = [ast.unparse(m.target) for m in node.body if isinstance(m, ast.AnnAssign)]
    for member in methods:
        plain = any(ast.unparse(mark) == 'property' for mark in member.decorator_list)
        fields.append(member.name + '()' * (not plain))
    public = ' '.join(f'`{name}`' for name in fields if not name.startswith('_'))
    return [*lines[:1], public, ''] if public else lines


def api() -> str:
    """Return the page of public classes and functions."""
    lines = [
        '# Python, without ROS',
        '',
        'What a program may build on; `python doc/make.py` writes this page from the code. Arrays',
        "are numpy's, units SI; θ, T and l have the order of `muscles.yaml`. Docstrings, which",
        '`help()` shows, say what each takes and returns.',
        '',
    ]
    for file, names in MODULES.items():
        tree = ast.parse((PACKAGE / file).read_text(encoding='utf-8'))
        module = f'musculoskeletal_ae.{file.removesuffix(".py").replace("/", ".")}'
        lines += [f'## {module}', '', _first(tree), '']
        found = {node.name: node for node in tree.body if hasattr(node, 'name')}
        for name in names:
            node = found[name]
            if isinstance(node, ast.ClassDef):
                lines += _class(node)
            else:
                lines += [f'**{_signature(node, name)}** {_first(node)}', '']
    return '\n'.join(lines).rstrip() + '\n'


def draw_elastic_unit(file: Path) -> None:
    """Draw what force, rate and wire_stretch each do to L_e(T)."""
    import numpy as np
    from matplotlib.figure import Figure

    from musculoskeletal_ae.robot.series_elastic import DEFAULT, SeriesElastic

    tension = np.linspace(0.0, 300.0, 200)
    figure = Figure(figsize=(11.0, 3.6), layout='constrained')
    changes = {
        'force': ('[N]: how far the soft part reaches', (50.0, 100.0, 200.0)),
        'rate': ('[1/m]: how soon it stiffens', (20.0, 30.0, 45.0)),
        'wire_stretch': ('[1/N]: slope of the wire, for l_abs = 0.5 m', (0.0, 2e-5, 1e-4)),
    }
    for axes, (name, (told, values)) in zip(figure.subplots(1, 3, sharey=True), changes.items()):
        for value in values:
            constants = {key: np.array(v) for key, v in (DEFAULT | {name: value}).items()}
            stretch = 1e3 * SeriesElastic(**constants).elongation(np.array(0.5), tension)
            style = '-' if value == DEFAULT[name] else '--'
            axes.plot(tension, stretch, style, label=f'{name} {value:g}')
        axes.set(title=f'{name} {told}', xlabel='T [N]')
        axes.title.set_fontsize(10)
        axes.legend()
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel('elongation L_e [mm]')
    figure.savefig(file, dpi=90)


if __name__ == '__main__':
    (FOLDER / 'reference' / 'api.md').write_text(api(), encoding='utf-8')
    draw_elastic_unit(FOLDER / 'images' / 'elastic_unit.png')
