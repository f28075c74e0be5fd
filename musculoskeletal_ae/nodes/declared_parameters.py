# SPDX-License-Identifier: Apache-2.0
"""The parameters of every node, in one table.

Declarations and descriptions (`node_parameters`), the `--help` of each node and `config/nodes.yaml`
are generated from this table; `python doc/make.py` writes the file.

This module imports nothing slow, so that `--help` answers quickly.
"""

import json
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from difflib import get_close_matches

from musculoskeletal_ae.control.settings import Settings as ControlSettings
from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.parameters import (
    CHECKPOINT,
    PRESET,
    RATE,
    ROBOT,
    SEED,
    Parameter,
    parameters_of,
)

FRAME_PREFIX = Parameter('', 'prefix of every published frame name, such as "left/"')
#: parameters of every node
SHARED = {'robot': ROBOT, 'rate': RATE, 'frame_prefix': FRAME_PREFIX}
#: parameters of every node that uses a network
NETWORK = {**SHARED, 'checkpoint': CHECKPOINT, 'preset': PRESET}

STATE_DIRECTORY = Parameter(
    'auto',
    'directory in which the learner saves its samples and network, the controller its latched '
    'stop, and the estimator its length offsets (auto: below XDG_STATE_HOME; empty: nothing is '
    'saved)',
)

PARAMETERS: dict[str, dict[str, Parameter]] = {  # all parameters of all nodes, by node and by name
    'controller': {
        **SHARED,
        'checkpoint': CHECKPOINT,
        'seed': SEED,
        'explore': Parameter(False, 'explore from the start'),
        'stop_recordings': Parameter(
            10, 'number of stop recordings to keep (0: none)', '', (0, 1000), settable=True
        ),
        'state_directory': STATE_DIRECTORY,
        **parameters_of(ControlSettings),
    },
    'estimator': {
        **NETWORK,
        'zero_posture': Parameter(
            (),
            'posture of the arm when estimator/zero is called, one angle for each joint ([]: '
            'unknown; length offsets are then estimated while the arm moves gently)',
            'rad or m',
            (-100.0, 100.0),
            settable=True,
        ),
        'zero_at_start': Parameter(
            False, 'calibrate length offsets at the start, for winches without absolute encoders'
        ),
        'state_directory': STATE_DIRECTORY,
        'on_anomaly': Parameter(
            'stop',
            '`stop`: the arm stops until estimator/reset is called; `isolate`: the suspect muscle '
            'is verified and, if it is faulty, isolated; then the arm resumes',
            legal=('stop', 'isolate'),
            settable=True,
        ),
        'isolate_muscles': Parameter(
            ('',),
            'muscles to isolate at the start, or when estimator/isolate is called, until '
            'estimator/restore',
            settable=True,
        ),
        'mirror_muscles': Parameter(
            False, 'publish muscle_joint_states: l and T under the names of the muscles, for plots'
        ),
    },
    'hardware_emulator': {
        **SHARED,
        'seed': SEED,
        'reality': Parameter(
            'kin',
            'emulator model: kin, foreign (an independent one in MuJoCo), or the model.xml that '
            'import_robot wrote for the robot',
        ),
        'deviates': Parameter(
            False,
            'if `reality` is a file: emulate an individual that deviates from the file, '
            'depending on `seed` (doc/howto/mujoco.md)',
        ),
        'clock': Parameter(
            False,
            'publish /clock, which runs slower if the computer is too slow for real time; all '
            'nodes then need use_sim_time',
        ),
        'payload': Parameter(0.0, 'mass in the hand', 'kg', (0.0, 20.0), settable=True),
        'faults': Parameter(
            ('',),
            'faults, each KIND[:QUANTITY][:MUSCLE or JOINT][:SIZE], such as rupture:MUSCLE '
            '([""]: none; doc/reference/topics_and_services.md lists the kinds)',
            settable=True,
        ),
        'sensors': Parameter(
            ('joints',),
            'sensors besides those of the muscle modules: joints (joint_states), marker[:RATE] '
            '(marker_pose, at 10 Hz unless RATE is stated) and imu:LINK (imu) ([""]: none)',
        ),
    },
    'sim': {
        **NETWORK,
        'as_robot': Parameter(False, 'publish joint_states and muscle_states instead of sim/…'),
    },
    'learner': {
        **NETWORK,
        'checkpoint': replace(
            CHECKPOINT,
            meaning='trained network to start from if no state is saved; if set while the node '
            'runs, it replaces what was learned',
        ),
        'seed': SEED,
        'joint_source': Parameter(
            'sensor',
            'source of joint angles: sensor (joint_states), marker (vision_joint_states) or none',
            legal=('sensor', 'marker', 'none'),
        ),
        'relearn_muscles': Parameter(
            ('',),
            'replaced or re-tied muscles that learner/relearn relearns',
            settable=True,
        ),
        'fresh': Parameter(
            False,
            'start from `checkpoint` instead of the saved samples and network',
        ),
        'state_directory': STATE_DIRECTORY,
    },
    'bringup_status': {
        **SHARED,
        'duration': Parameter(
            0.0,
            'time from the first estimate after which the node ends (0: never)',
            's',
            (0.0, 1e9),
        ),
        'patience': Parameter(
            0.0, 'longest wait for the first estimate (0: unlimited)', 's', (0.0, 1e9)
        ),
        'end_with_replay': Parameter(
            False,
            'exit when the recording that `replay` plays ends, with an error if it led to no '
            'estimate',
        ),
    },
}

#: executables that run several nodes in one process, and the names of these nodes
COMBINED = {'combined': ('estimator', 'controller')}

#: parameters that rclpy declares for every node
OF_RCLPY = ('use_sim_time', 'start_type_description_service', 'qos_overrides')


def check_names(names: Iterable[str], node: str = '') -> None:
    """Check that parameters with the given names exist.

    Args:
        names: Names of parameters.
        node: Node or executable to which the parameters are passed; '' for all nodes, as in a file.

    Raises:
        MusculoskeletalError: If no node has a parameter of some name, or if the only node that has
            the parameter is another one than `node`.
    """
    own = COMBINED.get(node, (node,) if node else ())
    every = [*OF_RCLPY, *(name for table in PARAMETERS.values() for name in table)]
    for name in names:
        users = [user for user, table in PARAMETERS.items() if name in table]
        problem = ''
        if name.split('.')[0] not in every:
            legal = [key for one in own for key in PARAMETERS[one]] or every
            near = get_close_matches(name, legal, 1) or ['none, see doc/reference/parameters.md']
            problem = f'no node has a parameter {name!r}; nearest: {near[0]}'
        elif own and len(users) == 1 and users[0] not in own:
            problem = f'{node} has no parameter {name!r}; only {users[0]} has one of this name'
        if problem:
            raise MusculoskeletalError(printable(problem))


HELP_TAIL = """\
Set parameters with  --ros-args -p NAME:=VALUE  or  --ros-args --params-file FILE. Parameters
marked * can also be set while the node runs.
Remap names with  --ros-args -r __ns:=/left_arm -r TOPIC:=OTHER"""


def help_text(executable: str) -> str:
    """Return the part of `--help` that describes the parameters of an executable's nodes."""
    lines, table = ['Parameters:', ''], dict[str, Parameter]()
    for node in COMBINED.get(executable, (executable,)):
        table |= PARAMETERS[node]
    for name, parameter in table.items():
        mark = '*' if parameter.settable else ' '
        lines.append(f' {mark} {name} (default: {json.dumps(parameter.default)})')
        lines.append(f'       {_description(parameter)}')
    return '\n'.join([*lines, '', HELP_TAIL])


def yaml_text() -> str:
    """Return the text of `config/nodes.yaml`: every parameter once, with its default."""
    lines = [
        '# Parameters of all nodes and their defaults, written by `python doc/make.py`',
        '/**:',
        '  ros__parameters:',
    ]
    users = Counter(name for table in PARAMETERS.values() for name in table)
    sections: dict[str, dict[str, Parameter]] = {'shared': {}}
    for node, table in PARAMETERS.items():
        sections[node] = {}
        for name, parameter in table.items():
            sections['shared' if users[name] > 1 else node].setdefault(name, parameter)
    for section, table in sections.items():
        lines.append(f'    # {section}')
        for name, parameter in table.items():
            entry = f'    {name}: {json.dumps(parameter.default)}'
            lines.append(f'{entry:<40} # {_description(parameter)}')
    return '\n'.join(lines) + '\n'


def _description(parameter: Parameter) -> str:
    return f'{parameter.meaning}; {parameter.legal_values}'.removesuffix('; ')


def main(assignments: Sequence[str]) -> int:
    """Check parameter names for bringup.sh.

    Args:
        assignments: Arguments NODE:NAME:=VALUE.

    Returns:
        The exit status: 0, or 2 for an unknown name.
    """
    for assignment in assignments:
        node, name = assignment.partition(':=')[0].split(':', 1)
        try:
            check_names([name], node)
        except MusculoskeletalError as error:
            print(f'-p {assignment!r}: {error}', file=sys.stderr)
            return 2
    return 0
