# SPDX-License-Identifier: Apache-2.0
"""Each advice about a file of a robot directory is followed in a directory that has the fault.

A row has the edits that cause the fault, a regular expression for the advice, and the edits that
follow the advice, each of which is made in a directory of its own. An edit gets the directory and
the match of the advice. After each of them, the directory can be read. `Members` is an edit for
each member of the legal set, which is the first group of the advice.
"""

import re
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from remedies import Members, check_remedy, in_file
from robots import chain, copy_robot, read_muscles, write_muscles

from musculoskeletal_ae.design.checks import read_declared_actions
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.robot.description import load_description

Edit = Callable[[Path, 're.Match[str] | None'], object]


class Row(NamedTuple):
    """A fault, and its advice with the edits that follow it."""

    breaks: tuple[Edit, ...]
    advice: str
    mends: tuple[object, ...]


def of_muscles(change):
    """Return an edit that changes the document of muscles.yaml."""

    def edit(directory, match=None):
        document = read_muscles(directory)
        change(document, match)
        write_muscles(directory, document)

    return edit


def at(path, value):
    """Return an edit that sets a place in muscles.yaml; a function makes the value of the match."""

    def change(document, match):
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value(match) if callable(value) else value

    return of_muscles(change)


def without(*path):
    """Return an edit that removes a place from muscles.yaml."""

    def change(document, _):
        for key in path[:-1]:
            document = document[key]
        del document[path[-1]]

    return of_muscles(change)


def within(*path, index, entry):
    """Return an edit that inserts an entry in a list of muscles.yaml."""

    def change(document, _):
        for key in path:
            document = document[key]
        document.insert(index, entry)

    return of_muscles(change)


def in_urdf(old, new):
    return in_file('robot.urdf', old, new)


def added(*parts):
    """Return an edit that adds elements to robot.urdf."""
    return in_urdf('</robot>', ''.join(parts) + '</robot>')


def content(name, text):
    return lambda directory, _=None: (directory / name).write_text(text)


def motors(**values):
    """Return an edit that writes motors.yaml."""
    document = {'state_topic': 'states', **values}
    return lambda directory, _=None: (directory / 'motors.yaml').write_text(
        yaml.safe_dump(document)
    )


def link(name):
    return f'<link name="{name}"/>'


def joint(name, parent, child, kind='fixed', inner=''):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inner}</joint>'


def expanded(directory, _):
    """Expand the URDF with xacro, as the advice says."""
    tool = shutil.which('xacro')
    if tool is None:
        pytest.skip('xacro is not installed')
    file = directory / 'robot.urdf'
    new = subprocess.run([tool, str(file)], check=True, capture_output=True, text=True).stdout
    file.write_text(new)


def in_order(*edits):
    def edit(directory, match=None):
        for each in edits:
            each(directory, match)

    return edit


JOINTS = 'shoulder', 'elbow'
LIMIT = '<limit lower="-1.3963" upper="0.6981" effort="20" velocity="6"/>'
ROUTE = 'muscles', 0, 'route'
POINT = {'link': 'forearm', 'xyz': [0.03, 0.0, -0.05]}
WRAP = {
    'wrap': 'cylinder', 'link': 'forearm', 'axis': [0.0, 1.0, 0.0], 'xyz': [0.0, 0.0, 0.0],
    'radius': 0.01,
}  # fmt: skip
BALL = {'wrap': 'sphere', 'link': 'forearm', 'xyz': [0.0, 0.0, 0.0], 'radius': 0.01}
DRIVE = {'torque_constant': 0.02, 'gear': 50.0, 'spool_radius': 0.01}
WHEEL = in_order(added(link('w'), joint('wheel', 'hand', 'w', 'continuous')))
SPRINGS = [
    {'joint': 'shoulder', 'stiffness': 2.0, 'coupled': {'elbow': 3.0}},
    {'joint': 'elbow', 'stiffness': 4.0},
]
OTHER_FINGER = (
    link('f'),
    joint('finger', 'hand', 'f', 'revolute', LIMIT),
)  # fmt: skip


def wrap(**changes):
    """Return an edit that adds a wrap to the first route, with other values; None removes one."""
    entry = {key: value for key, value in (WRAP | changes).items() if value is not None}
    return within(*ROUTE, index=1, entry=entry)


def of_wrap(key, value):
    return at((*ROUTE, 1, key), value)


def number_in(group=1):
    return lambda match: float(match[group])


MUSCLES = {
    'unknown key': Row(
        (at(['stifness'], 1e4),), "unknown key 'stifness'; legal keys: (.*)$",
        (without('stifness'), in_order(without('stifness'), at(['stiffness'], 1e4))),
    ),
    'unknown key of a sphere': Row(
        (within(*ROUTE, index=1, entry=BALL | {'axis': [0.0, 1.0, 0.0]}),),
        "unknown key 'axis'; legal for a sphere: link", (without(*ROUTE, 1, 'axis'),),
    ),
    'wrong word': Row(
        (at(['actuation'], 'torque'),), 'expected one of (.*), got',
        (Members(lambda word: at(['actuation'], word)),),
    ),
    'missing key': Row(
        (without('muscles', 0, 'name'),), "key 'name' is missing",
        (at(['muscles', 0, 'name'], 'a'),),
    ),
    'range': Row(
        (at(['stiffness'], 1e30),), r'expected float <= ([\d.]+)', (at(['stiffness'], number_in()),)
    ),
    'number as text': Row(
        (at(['stiffness'], '1e5'),), r'YAML reads 1e5 as text; write 1.0e\+5',
        (in_file('muscles.yaml', '1e5', '1.0e+5'),),
    ),
    'written twice': Row(
        (in_file('muscles.yaml', 'muscles:', 'joints: [elbow]\nmuscles:'),),
        "key 'joints' is written twice", (in_file('muscles.yaml', 'joints: [elbow]\n', ''),),
    ),
    'keys of a wrap at a point': Row(
        (at((*ROUTE, 1, 'radius'), 0.01),),
        'radius, side and side_link need wrap: sphere, wrap: cylinder or wrap: pulley',
        (without(*ROUTE, 1, 'radius'), in_order(
            within(*ROUTE, index=2, entry=POINT), of_wrap('wrap', 'sphere'))),
    ),
    'divisor at a wrap': Row(
        (wrap(divisor=2.0),), 'legal only at a point where a branch begins; remove it here',
        (without(*ROUTE, 1, 'divisor'),),
    ),
    'side_link without side': Row(
        (wrap(side_link='hand'),), "side_link needs side; key 'side' is missing",
        (of_wrap('side', [0.05, 0.0, 0.0]),),
    ),
    'wrap without radius': Row(
        (wrap(radius=None),), "key 'radius' is missing", (of_wrap('radius', 0.01),)
    ),
    'cylinder without axis': Row(
        (wrap(axis=None),), "key 'axis' is missing",
        (of_wrap('axis', [0.0, 1.0, 0.0]), of_wrap('wrap', 'sphere')),
    ),
    'axis without direction': Row(
        (wrap(axis=[0.0, 1e-7, 0.0]),), r'expected a vector with a length of at least ([\d.e-]+)',
        (of_wrap('axis', lambda match: [0.0, float(match[1]), 0.0]),),
    ),
    'side on the axis': Row(
        (wrap(side=[0.0, 0.05, 0.0]),), 'expected a point beside the axis',
        (of_wrap('side', [0.05, 0.05, 0.0]),),
    ),
    'route ends with a wrap': Row(
        (within(*ROUTE, index=0, entry=WRAP),), 'expected a point before and after each wrap',
        (within(*ROUTE, index=0, entry={'link': 'torso', 'xyz': [0.03, 0.0, 0.1]}),),
    ),
    'wrap before a branch': Row(
        (within(*ROUTE, index=1, entry=POINT | {'divisor': 2.0}), wrap(),
         within(*ROUTE, index=1, entry=POINT)),
        'expected no wrap before a point with a divisor', (without(*ROUTE, 2),),
    ),
    'muscle name': Row(
        (at(['muscles', 0, 'name'], ' a,b'),), 'a name without a comma and without spaces around',
        (at(['muscles', 0, 'name'], 'a b'),),
    ),
    'escape in a name': Row(
        (at(['muscles', 0, 'name'], 'a\x9b1m'),), 'expected printable characters only',
        (at(['muscles', 0, 'name'], 'µ'),),
    ),
    'name twice': Row(
        (at(['joints'], ['elbow', 'elbow']),), 'names must be unique', (at(['joints'], ['elbow']),)
    ),
    'unknown link': Row(
        (at((*ROUTE, 0, 'link'), 'chest'),), 'links of robot.urdf: (.*)$',
        (Members(lambda name: at((*ROUTE, 0, 'link'), name)),),
    ),
    'one point': Row(
        (of_muscles(lambda document, _: document['muscles'][0]['route'].__setitem__(
            slice(1, None), [document['muscles'][0]['route'][0]])),),
        'expected at least 2 different points', (within(*ROUTE, index=2, entry=POINT),),
    ),
    'unknown joint': Row(
        (WHEEL, at(['joints'], ['knee'])),
        'unknown joint .*; revolute and prismatic joints of robot.urdf: (.*)$',
        (Members(lambda name: at(['joints'], [name])),),
    ),
    'unknown joint beside a mimic': Row(
        (added(link('f'), joint('finger', 'hand', 'f', 'revolute',
                                f'{LIMIT}<mimic joint="elbow"/>')),
         at(['joints'], ['knee'])),
        'unknown joint .*; revolute and prismatic joints of robot.urdf: (.*)$',
        (Members(lambda name: at(['joints'], [name])),),
    ),
    'continuous joint': Row(
        (WHEEL, at(['joints'], [*JOINTS, 'wheel'])),
        'legal: revolute or prismatic joints with one degree of freedom and limits',
        (at(['joints'], JOINTS), in_urdf('type="continuous">', f'type="revolute">{LIMIT}')),
    ),
    'limits in the wrong order': Row(
        (in_urdf('lower="-1.3963"', 'lower="1.3963"'),),
        'expected finite lower < upper in its <limit>',
        (in_urdf('lower="1.3963"', 'lower="-1.3963"'),),
    ),
    'listed joint that follows': Row(
        (at(['couplings'], [{'joint': 'elbow', 'master': 'shoulder'}]),),
        '`joints` may list only joints that follow no other joint',
        (at(['joints'], ['shoulder']), without('couplings')),
    ),
    'listed joint that mimics': Row(
        (added(link('f'), joint('finger', 'hand', 'f', 'revolute',
                                f'{LIMIT}<mimic joint="elbow"/>')),
         at(['joints'], [*JOINTS, 'finger'])),
        'by its <mimic> in robot.urdf; `joints` may list only joints that follow no other joint',
        (at(['joints'], JOINTS), in_urdf('<mimic joint="elbow"/>', '')),
    ),
    'master that is missing': Row(
        (added(*OTHER_FINGER), at(['couplings'], [{'joint': 'finger', 'master': 'knee'}])),
        "unknown joint 'knee'; revolute and prismatic joints of robot.urdf: (shoulder, elbow)",
        (Members(lambda name: at(['couplings', 0, 'master'], name)),),
    ),
    'loop of couplings': Row(
        (added(*OTHER_FINGER, link('g'), joint('tip', 'f', 'g', 'revolute', LIMIT)),
         at(['couplings'], [{'joint': 'finger', 'master': 'tip'},
                            {'joint': 'tip', 'master': 'finger'}])),
        'follows itself; joints of the loop', (at(['couplings', 1, 'master'], 'elbow'),),
    ),
    'polynomial of high degree': Row(
        (added(*OTHER_FINGER, link('g'), joint('tip', 'f', 'g', 'revolute', LIMIT)),
         at(['couplings'], [
             {'joint': 'finger', 'master': 'elbow', 'polynomial': [0.0, *[0.1] * 7]},
             {'joint': 'tip', 'master': 'finger', 'polynomial': [0.0, *[0.1] * 7]}])),
        r'of degree 49; legal: at most (\d+)',
        (at(['couplings', 1, 'polynomial'], lambda match: [0.0] + [0.1] * (int(match[1]) // 7)),),
    ),
    'polynomial and ratio': Row(
        (added(*OTHER_FINGER), at(['couplings'], [
            {'joint': 'finger', 'master': 'elbow', 'ratio': 2.0, 'polynomial': [0.0, 1.0]}])),
        'expected polynomial, or ratio and offset, got both',
        (without('couplings', 0, 'ratio'), without('couplings', 0, 'polynomial')),
    ),
    'end_effector and end_effectors': Row(
        (at(['end_effectors'], ['hand']),), 'expected end_effector or end_effectors, got both',
        (without('end_effector'), without('end_effectors')),
    ),
    'end effector at rest': Row(
        (at(['end_effector'], 'torso'),), r'expected a link that the joints move \((.*)\), got',
        (Members(lambda name: at(['end_effector'], name)),),
    ),
    'order of tensions': Row(
        (at(['tension'], {'bias': 50.0, 'limit': 40.0, 'max': 60.0}),),
        'expected bias < limit <= max', (at(['tension', 'limit'], 60.0),),
    ),
    'joint of a spring': Row(
        (at(['joint_elasticity'], [{'joint': 'knee', 'stiffness': 1.0}]),), 'legal: (.*)$',
        (Members(lambda name: at(['joint_elasticity', 0, 'joint'], name)),),
    ),
    'spring at a joint that follows': Row(
        (added(*OTHER_FINGER), at(['couplings'], [{'joint': 'finger', 'master': 'elbow'}]),
         at(['joint_elasticity'], [{'joint': 'finger', 'stiffness': 1.0}])),
        r'it follows another joint: state the spring there\); legal: shoulder, elbow',
        (at(['joint_elasticity', 0, 'joint'], 'elbow'),),
    ),
    'spring coupled to itself': Row(
        (at(['joint_elasticity'], [{'joint': 'elbow', 'coupled': {'elbow': 1.0}}]),),
        'is the joint itself; state its own stiffness as `stiffness`',
        (at(['joint_elasticity'], [{'joint': 'elbow', 'stiffness': 1.0}]),),
    ),
    'springs coupled twice': Row(
        (at(['joint_elasticity'], [
            {'joint': 'shoulder', 'stiffness': 2.0, 'coupled': {'elbow': 1.0}},
            {'joint': 'elbow', 'stiffness': 2.0, 'coupled': {'shoulder': 1.0}}]),),
        'coupled twice; remove one entry', (without('joint_elasticity', 1, 'coupled'),),
    ),
    'strong coupling of springs': Row(
        (at(['joint_elasticity'], SPRINGS),), r'legal: at most ([\d.]+), the geometric mean',
        (at(['joint_elasticity', 0, 'coupled', 'elbow'], number_in()),),
    ),
    'three springs': Row(
        (added(*OTHER_FINGER), at(['joints'], [*JOINTS, 'finger']),
         at(['joint_elasticity'], [
             {'joint': 'shoulder', 'stiffness': 1.0, 'coupled': {'elbow': 0.9, 'finger': 0.9}},
             {'joint': 'elbow', 'stiffness': 1.0, 'coupled': {'finger': -0.9}},
             {'joint': 'finger', 'stiffness': 1.0}])),
        'reduce the values in `coupled`',
        (in_order(at(['joint_elasticity', 0, 'coupled'], {'elbow': 0.3, 'finger': 0.3}),
                  at(['joint_elasticity', 1, 'coupled'], {'finger': -0.3})),),
    ),
    'currents without drives': Row(
        (at(['tension_source'], 'current'), at(['actuation'], 'position')),
        r'needs drive: {torque_constant: \[N·m/A\], gear: ratio, spool_radius: \[m\]}, of the robot'
        ' or of each muscle',
        (at(['drive'], DRIVE), of_muscles(lambda document, _: [
            muscle.update(drive=DRIVE) for muscle in document['muscles']])),
    ),
    'drives without currents': Row(
        (at(['drive'], DRIVE), at(['actuation'], 'position')),
        'remove drive, or set tension_source: current',
        (without('drive'), at(['tension_source'], 'current')),
    ),
    'no tensions for muscle stiffness control': Row(
        (at(['tension_source'], 'none'),),
        r'\(tension_source: sensor\), or set actuation: position',
        (at(['tension_source'], 'sensor'), at(['actuation'], 'position')),
    ),
    'speed of other modules': Row(
        (at(['speed'], 0.3),), 'remove speed, or set actuation: position',
        (without('speed'), at(['actuation'], 'position')),
    ),
}  # fmt: skip

URDF = {
    'prefix of xacro is missing': Row(
        (content('tool.urdf', f'<robot name="t">{link("tool")}</robot>'),
         added('<include filename="tool.urdf"/>', joint('t', 'hand', 'tool'))),
        'write it as <xacro:include>, with (xmlns:xacro="[^"]*") in <robot>, and expand it to a '
        'new file first:  xacro FILE > NEW.urdf',
        (in_order(
            in_urdf('<include ', '<xacro:include '),
            lambda directory, match: in_urdf('<robot ', f'<robot {match[1]} ')(directory),
            expanded,
        ),),
    ),
    'xacro': Row(
        (in_urdf('<mass value="0.8"/>', '<mass value="${0.4 + 0.4}"/>'),),
        'expand it to a new file first:  xacro FILE > NEW.urdf', (expanded,),
    ),
    'XInclude': Row(
        (in_urdf(
            '</robot>', '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="b"/></robot>'
        ),),
        'replace it by the elements of the file that it names',
        (in_urdf('<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="b"/>',
                 f'{link("t")}{joint("t", "hand", "t")}'),),
    ),
    'doctype': Row(
        (in_urdf('<robot', '<!DOCTYPE robot><robot'),), 'no DOCTYPE is allowed here; remove it',
        (in_urdf('<!DOCTYPE robot>', ''),),
    ),
    'many links': Row(
        (content('robot.urdf', chain(1001)),), r'legal: at most (\d+)',
        # 999 joints and 1000 links, of which none is in muscles.yaml
        (lambda directory, match: in_order(
            copy_urdf, added(*(f'{link(f"l{i}")}{joint(f"j{i}", "hand", f"l{i}")}'
                               for i in range(int(match[1]) // 2 - 5))))(directory),),
    ),
    'reserved name': Row(
        (in_urdf('joint name="wrist"', 'joint name="universe"'),), 'rename the joint',
        (in_urdf('joint name="universe"', 'joint name="wrist"'),),
    ),
    'name twice': Row(
        (added(link('hand')),), 'expected unique names', (in_urdf(link('hand') + '</robot>',
                                                                  '</robot>'),),
    ),
    'unknown parent': Row(
        (added(link('f'), joint('j', 'hnad', 'f')),),
        r'parent: expected a link of this file \((.*)\), got',
        (in_urdf('"hnad"', '"hand"'), in_urdf('"hnad"', '"torso"')),
    ),
    'unknown child': Row(
        (added(link('f'), joint('j', 'hand', 'x')),),
        r'child: expected a link of this file \(', (in_urdf('child link="x"', 'child link="f"'),),
    ),
    'child twice': Row(
        (added(link('f'), joint('j', 'hand', 'forearm')),),
        'expected a link that is the child of no other joint',
        (in_urdf('<parent link="hand"/><child link="forearm"/>',
                 '<parent link="hand"/><child link="f"/>'),),
    ),
    'second root': Row(
        (added(link('f')),), 'expected exactly one root link, which is the child of no joint',
        (added(joint('j', 'hand', 'f')), in_urdf(link('f'), '')),
    ),
    'loop': Row(
        (added(link('a'), link('b'), joint('j', 'b', 'a'), joint('k', 'a', 'b')),),
        'a loop of joints holds a, b; correct the parent of one of them',
        (in_urdf('<parent link="b"/>', '<parent link="hand"/>'),),
    ),
    'kind of joint': Row(
        (in_urdf('type="fixed"', 'type="hinge"'),), 'expected one of (.*), got',
        (Members(lambda kind: in_urdf('type="hinge">', f'type="{kind}">{LIMIT}')),),
    ),
    'axis': Row(
        (in_urdf('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'),), 'expected a nonzero vector',
        (in_urdf('<axis xyz="0 0 0"/>', '<axis xyz="0 2 0"/>'),),
    ),
    'limit': Row(
        (in_urdf(LIMIT, ''),), 'missing: (.*)$',
        (lambda directory, match: in_urdf('<axis', '<limit ' + ' '.join(
            f'{name}="{1 + 2 * place}"' for place, name in enumerate(match[1].split(', '))
        ) + '/><axis')(directory),),
    ),
    'no number': Row(
        (in_urdf('<mass value="0.8"/>', '<mass value="0,8"/>'),),
        'expected a finite number, got',
        (in_urdf('<mass value="0,8"/>', '<mass value="0.8"/>'),),
    ),
    'negative mass': Row(
        (in_urdf('<mass value="0.8"/>', '<mass value="-1"/>'),), 'expected a mass >= 0 kg',
        (in_urdf('<mass value="-1"/>', '<mass value="0"/>'),),
    ),
    'no mass': Row(
        (in_urdf('<mass value="0.8"/>', ''),),
        'mass: expected value, or remove <inertial> if the link has no mass',
        (lambda directory, _=None: in_pattern(directory, r'(<link name="forearm">)\s*<inertial>.*?'
                                         '</inertial>'),),
    ),
}  # fmt: skip


def copy_urdf(directory, _=None):
    copy_robot('arm26', directory)


def in_broken(edit, match):
    """Return an edit of a directory with a match of the advice."""
    return lambda directory: edit(directory, match)


def in_pattern(directory, pattern):
    file = directory / 'robot.urdf'
    text, count = re.subn(pattern, r'\1', file.read_text(), flags=re.DOTALL)
    assert count == 1
    file.write_text(text)


MOTORS = {
    'unknown muscle': Row(
        (motors(motors={'tail': {}}),), 'unknown muscle .*; legal: (.*); doc/howto',
        (Members(lambda name: motors(motors={name: {}})),),
    ),
    'motor of two muscles': Row(
        (motors(motors={'brachialis': {'joint': 'm'}, 'biceps_long': {'joint': 'm'}}),),
        'each muscle needs its own motor',
        (motors(motors={'brachialis': {'joint': 'm'}, 'biceps_long': {'joint': 'n'}}),),
    ),
    'order of commands': Row(
        (motors(command_topic='c', command_order=['brachialis']),), 'expected each of (.*) once;',
        (lambda directory, match: motors(
            command_topic='c', command_order=match[1].split(', ')[::-1])(directory),),
    ),
    'direction': Row(
        (motors(direction=2.0),), 'expected (1 or -1)',
        (Members(lambda value: motors(direction=float(value))),),
    ),
    'no tension for an effort': Row(
        (motors(tension_per_effort=0.0),), 'expected a number other than 0',
        (motors(tension_per_effort=-0.1),),
    ),
    'name of a topic': Row(
        (motors(state_topic='motor states'),),
        'legal: words of letters, digits and _, joined by /, as in (arm/joint_states)',
        (Members(lambda name: motors(state_topic=name)), motors(state_topic='a_1/b2')),
    ),
    'unknown key': Row(
        (motors(radius=0.01),), "unknown key 'radius'; legal keys: (.*); doc/howto",
        (motors(spool_radius=0.01),),
    ),
}  # fmt: skip

ACTIONS = {
    'header': Row(
        (content('moment_arms.csv', 'muscle;joint;sign\n'),), 'expected the columns (.*), got',
        (lambda directory, match: content('moment_arms.csv', match[1] + '\n')(directory),),
    ),
    'cells': Row(
        (content('moment_arms.csv', 'muscle,joint,sign\nbrachialis,elbow\n'),),
        r'expected 3 values \(muscle,joint,sign\)',
        (content('moment_arms.csv', 'muscle,joint,sign\nbrachialis,elbow,-\n'),),
    ),
    'word': Row(
        (content('moment_arms.csv', 'muscle,joint,sign\nbrachialis,elbow,down\n'),),
        r'legal: (.*)$',
        (Members(lambda sign: content('moment_arms.csv',
                                   f'muscle,joint,sign\nbrachialis,elbow,{sign}\n')),),
    ),
    'twice': Row(
        (content('moment_arms.csv', 'muscle,joint,sign\n' + 'brachialis,elbow,-\n' * 2),),
        'declared twice; remove one line',
        (content('moment_arms.csv', 'muscle,joint,sign\nbrachialis,elbow,-\n'),),
    ),
}  # fmt: skip

FILES = {
    'no muscles.yaml': Row(
        (lambda directory, _=None: (directory / 'muscles.yaml').unlink(),),
        'a robot directory contains robot.urdf and muscles.yaml', (copy_urdf,),
    ),
    'huge file': Row(
        (in_file('muscles.yaml', 'joints:', '#' * (1 << 19) + '\njoints:'),),
        'is larger than (\\d+) bytes, the largest legal size',
        (lambda directory, match: in_file(
            'muscles.yaml', '#' * (1 << 19), '#' * (int(match[1]) // 2))(directory),),
    ),
    'no UTF-8': Row(
        (lambda directory, _=None: (directory / 'muscles.yaml').write_bytes(b'# \xe4'),),
        'is not UTF-8 text', (copy_urdf,),
    ),
    'many aliases': Row(
        (content('muscles.yaml', 'a: &a [0, 0]\n' + ''.join(
            f'{name}: &{name} [{", ".join([f"*{last}"] * 60)}]\n'
            for last, name in zip('abcd', 'bcde'))),),
        'legal: at most 100000, with aliases expanded', (copy_urdf,),
    ),
    'deep': Row(
        (content('muscles.yaml', '[' * 60 + ']' * 60),), 'nested too deeply; legal: at most',
        (copy_urdf,),
    ),
}  # fmt: skip

ROWS = {
    f'{table}: {name}': row
    for table, rows in (
        ('muscles', MUSCLES), ('urdf', URDF), ('motors', MOTORS), ('moment arms', ACTIONS),
        ('files', FILES),
    )
    for name, row in rows.items()
}  # fmt: skip


@pytest.mark.parametrize('name', ROWS)
def test_a_directory_can_be_read_after_the_advice_was_followed(name, tmp_path):
    row = ROWS[name]

    numbers = count()

    def broken():
        directory = copy_robot('arm26', tmp_path / f'arm{next(numbers)}')
        (directory / 'moment_arms.csv').unlink(missing_ok=True)
        without('stiffness')(directory)  # the default
        for edit in row.breaks:
            edit(directory, None)
        return directory

    def use(edit):
        directory = broken()
        edit(directory)
        read_declared_actions(load_description(directory))

    ways = [mend if isinstance(mend, Members) else partial(in_broken, mend) for mend in row.mends]
    check_remedy(use, in_order(), row.advice, ways, RobotDescriptionError)


def test_a_robot_that_is_not_there_can_be_chosen_as_the_message_says(tmp_path):
    with pytest.raises(RobotDescriptionError) as refused:
        load_description(tmp_path / 'nothing')
    for name in re.search(r'shipped robot \((.*?)\)', str(refused.value))[1].split(', '):
        load_description(name)
    directory = copy_robot('arm26', tmp_path / 'own')
    with pytest.raises(RobotDescriptionError, match=r'name the directory that has robot\.urdf'):
        load_description(directory / 'robot.urdf')
    load_description(directory)
