# SPDX-License-Identifier: Apache-2.0
"""Builds bodies of several limbs from musashi_left_arm; config/musashi_upper_body is one of them.

    python -m bench limbs [BODY] DIR

BODY is one of BODIES below. An arm is musashi_left_arm, mirrored on the right side. It may have a
wrist of two joints with several tendons. A neck of three joints and twelve tendons stands on the
torso. Further pairs of arms hang below the first, on the same torso. All numbers are chosen, not
measured.
"""

import csv
from math import cos, radians, sin
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from musculoskeletal_ae.files import read_yaml
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.description import refusal
from musculoskeletal_ae.robot.directories import find_robot

#: limbs of each body, by name. A number stands for an arm with this number of tendons at its wrist
#: (0: no wrist), 'held' for an arm of four joints, whose joint elbow_yaw is fixed.
BODIES: dict[str, tuple[int | str, ...]] = {
    '5x10': (0,),
    '7x14': (4,),
    '10x20': (0, 0),
    '17x40': (4, 4, 'neck'),
    '39x74': (3, 3, 3, 3, 3, 'held'),
}
BELOW = 0.8  # place a pair of arms this far below the pair above [m]
WRIST = """<r>
  <joint name="wrist_flexion" type="revolute"><parent link="forearm"/><child link="carpus"/>
    <origin xyz="0 0 -0.20"/><axis xyz="1 0 0"/>
    <limit lower="-0.7" upper="0.7" effort="8" velocity="6"/></joint>
  <link name="carpus"><inertial><mass value="0.05"/>
    <inertia ixx="5e-5" ixy="0" ixz="0" iyy="5e-5" iyz="0" izz="5e-5"/></inertial>
    <visual><geometry><sphere radius="0.015"/></geometry></visual></link>
  <joint name="wrist_deviation" type="revolute"><parent link="carpus"/><child link="hand"/>
    <origin xyz="0 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-0.45" upper="0.45" effort="8" velocity="6"/></joint></r>"""
#: tendons of a wrist with four or three tendons: name, and angle around the forearm [degrees], from
#: the front towards the left
WRIST_WIRES = {
    4: {'extensor_carpi_radialis': 45, 'extensor_carpi_ulnaris': 135,
        'flexor_carpi_ulnaris': 225, 'flexor_carpi_radialis': 315},
    3: {'extensor_carpi': 90, 'flexor_carpi_ulnaris': 210, 'flexor_carpi_radialis': 330},
}  # fmt: skip
#: place the wrist's tendons at this distance from the long axis of the forearm [m]
WRIST_RADIUS = 0.044
NECK = """<r>
  <joint name="neck_pitch" type="revolute"><parent link="torso"/><child link="neck_pitch_link"/>
    <origin xyz="0 0 0.10"/><axis xyz="0 1 0"/>
    <limit lower="-0.5" upper="0.5" effort="20" velocity="4"/></joint>
  <link name="neck_pitch_link"><inertial><mass value="0.2"/>
    <inertia ixx="3e-4" ixy="0" ixz="0" iyy="3e-4" iyz="0" izz="3e-4"/></inertial></link>
  <joint name="neck_roll" type="revolute"><parent link="neck_pitch_link"/>
    <child link="neck_roll_link"/><origin xyz="0 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-0.45" upper="0.45" effort="20" velocity="4"/></joint>
  <link name="neck_roll_link"><inertial><origin xyz="0 0 0.03"/><mass value="0.2"/>
    <inertia ixx="3e-4" ixy="0" ixz="0" iyy="3e-4" iyz="0" izz="3e-4"/></inertial>
    <visual><origin xyz="0 0 0.03"/><geometry><cylinder radius="0.02" length="0.06"/></geometry>
    </visual></link>
  <joint name="neck_yaw" type="revolute"><parent link="neck_roll_link"/><child link="head"/>
    <origin xyz="0 0 0.06"/><axis xyz="0 0 1"/>
    <limit lower="-0.6" upper="0.6" effort="15" velocity="4"/></joint>
  <link name="head"><inertial><origin xyz="0.01 0 0.08"/><mass value="2.0"/>
    <inertia ixx="0.010" ixy="0" ixz="0" iyy="0.010" iyz="0" izz="0.007"/></inertial>
    <visual><origin xyz="0.01 0 0.09"/><geometry><sphere radius="0.085"/></geometry></visual></link>
  </r>"""
#: via points of each tendon of the neck: first on the torso, then on the head. Each is an angle
#: [degrees] from front to left, a radius [m] and a height [m].
NECK_WIRES = {
    'sternocleidomastoid': ((4, 0.099, 0.032), (109, 0.070, 0.045)),
    'scalene': ((58, 0.077, 0.068), (25, 0.069, -0.020)),
    'trapezius': ((100, 0.110, 0.061), (179, 0.062, 0.045)),
    'levator_scapulae': ((111, 0.065, 0.034), (71, 0.061, -0.020)),
    'splenius': ((154, 0.072, 0.035), (95, 0.070, 0.019)),
    'semispinalis': ((143, 0.070, 0.031), (104, 0.060, 0.050)),
}
#: intended moment arms of the wrist's tendons: beginning of the tendon's name, and joint and sign
#: as in moment_arms.csv
WRIST_SIGNS = [('extensor', 'wrist_flexion', '+'), ('flexor', 'wrist_flexion', '-')]
Muscle = dict[str, Any]


def mirrored(value: str) -> str:
    """Return the text `value` of a vector, 'x y z', mirrored to the other side of the body."""
    x, y, z = map(float, value.split())
    return f'{x:g} {0.0 - y:g} {z:g}'


def on_ring(angle: float, radius: float, height: float) -> list[float]:
    """Return a point [m], (3,), on a horizontal ring of a radius [m] at a height [m].

    The angle [degrees] is from the front towards the left.
    """
    at = radians(angle)
    return [round(radius * cos(at), 4), round(radius * sin(at), 4), height]


class Body:
    """A body that is assembled limb by limb and then written."""

    def __init__(self, name: str, arm: Path) -> None:
        """Begin with the torso of a robot directory that describes a left arm."""
        self._arm = ET.parse(arm / 'robot.urdf').getroot()  # noqa: S314
        self._description = read_yaml(arm / 'muscles.yaml', refusal)
        of_all = ('series_elastic:', 'stiffness:', 'tension:')
        text = (arm / 'muscles.yaml').read_text(encoding='utf-8')
        self._of_all = [line for line in text.splitlines() if line.startswith(of_all)]
        lines = (arm / 'moment_arms.csv').read_text().splitlines()
        self._signs = [*csv.reader(line for line in lines[2:])]
        self.urdf = ET.Element('robot', name=name)
        self.urdf.extend(self._arm.findall('material'))
        self.urdf.append(self._arm.find("link[@name='torso']"))  # type: ignore[arg-type]
        self.joints, self.end_effectors = list[str](), list[str]()
        self.muscles, self.signs = list[Muscle](), list[tuple[str, ...]]()

    def add_arm(self, number: int, wires: int | str) -> None:
        """Add arm number `number`; arms with odd numbers are on the right.

        `wires` is the number of tendons of a wrist; 0 adds no wrist. 'held' adds no wrist either,
        and fixes the last joint of the arm.
        """
        right, pair = number % 2, number // 2
        prefix = ('left_', 'right_')[right] + (f'{pair + 1}_' if pair else '')
        held = 'elbow_yaw' if wires == 'held' else ''
        tendons = wires if isinstance(wires, int) else 0
        parts = [p for p in self._arm if p.tag != 'material' and p.get('name') != 'torso']
        if tendons:
            parts = [p for p in parts if p.get('name') != 'wrist']
            parts[-1:-1] = ET.fromstring(WRIST)  # noqa: S314
        names = {p.get('name') for p in parts}
        for part in map(ET.fromstring, map(ET.tostring, parts)):  # copies, which are changed below
            if part.tag == 'joint' and part.get('type') != 'fixed' and part.get('name') != held:
                self.joints.append(prefix + part.get('name', ''))
            for element in part.iter():
                for key in ('name', 'link'):
                    if element.get(key) in names:
                        element.set(key, prefix + element.get(key, ''))
                if right and element.tag == 'origin':
                    element.set('xyz', mirrored(element.get('xyz', '')))
                    r, p, y = map(float, element.get('rpy', '0 0 0').split())
                    element.set('rpy', f'{-r:g} {p:g} {-y:g}')
                if right and element.tag == 'axis':  # the mirrored joint turns the other way
                    x, y, z = map(float, element.get('xyz', '').split())
                    element.set('xyz', f'{0.0 - x:g} {y:g} {0.0 - z:g}')
            base = part.find("parent[@link='torso']")
            if base is not None and pair:
                origin = part.find('origin')
                assert origin is not None  # every joint of the arm's URDF has an origin
                before, left, _ = origin.get('xyz', '').split()
                origin.set('xyz', f'{before} {left} {-BELOW * pair:g}')
            self.urdf.append(part)
        muscles = [(m['name'], [(p['link'], p['xyz']) for p in m['route']])
                   for m in self._description['muscles']
                   if not (held and m['name'] == 'pronator_teres')]  # fmt: skip
        signs = [sign for sign in self._signs if sign[1] != held]
        for name, angle in WRIST_WIRES.get(tendons, {}).items():
            route = [('ulna', on_ring(angle, WRIST_RADIUS, -0.04)),
                     ('forearm', on_ring(angle, WRIST_RADIUS, -0.19)),
                     ('hand', on_ring(angle, WRIST_RADIUS, -0.03))]  # fmt: skip
            muscles.append((name, route))
            signs += [[name, *rest] for start, *rest in WRIST_SIGNS if name.startswith(start)]
        for name, route in muscles:
            points = []
            for link, (x, y, z) in route:
                torso = link == 'torso'
                z = round(z - BELOW * pair * torso, 4)
                points.append((link if torso else prefix + link, [x, 0.0 - y if right else y, z]))
            self.muscles.append({'name': prefix + name, 'route': points})
        own = {muscle['name'] for muscle in self.muscles}
        self.signs += [(prefix + m, prefix + j, s) for m, j, s in signs if prefix + m in own]
        self.end_effectors.append(prefix + 'hand')

    def add_neck(self) -> None:
        """Add a neck of three joints, a head, and the twelve tendons of the neck."""
        parts = list(ET.fromstring(NECK))  # noqa: S314
        self.urdf.extend(parts)
        self.joints += [part.get('name', '') for part in parts if part.tag == 'joint']
        for name, ends in NECK_WIRES.items():
            for side, prefix in ((1, 'left_'), (-1, 'right_')):
                places = [on_ring(side * angle, *rest) for angle, *rest in ends]
                route = [*zip(('torso', 'head'), places, strict=True)]
                self.muscles.append({'name': prefix + name, 'route': route})
                self.signs.append((prefix + name, 'neck_roll', '-' if side > 0 else '+'))
        self.end_effectors.append('head')

    def write(self, out: Path) -> None:
        """Write the three files of a robot directory."""
        out.mkdir(parents=True, exist_ok=True)
        ET.indent(self.urdf)
        head = (
            '<?xml version="1.0"?>\n<!-- SPDX-License-Identifier: Apache-2.0\n'
            '     Written by `python -m bench limbs`; all numbers are CHOSEN, see README.md. -->\n'
        )
        (out / 'robot.urdf').write_text(head + ET.tostring(self.urdf, 'unicode') + '\n')
        lines = ['# Written by `python -m bench limbs`; every number is CHOSEN, see README.md.',
                 f'joints: [{", ".join(self.joints)}]', 'muscles:']  # fmt: skip
        for muscle in self.muscles:
            lines += [f'  - name: {muscle["name"]}', '    route:']
            lines += [f'      - {{link: {link}, xyz: {xyz}}}' for link, xyz in muscle['route']]
        lines += self._of_all
        lines.append(f'end_effectors: [{", ".join(self.end_effectors)}]')
        (out / 'muscles.yaml').write_text('\n'.join(lines) + '\n')
        rows = ['muscle,joint,sign', *(','.join(sign) for sign in self.signs)]
        (out / 'moment_arms.csv').write_text('\n'.join(rows) + '\n')


def write_body(name: str, out: Path) -> Path:
    """Write one of BODIES as a robot directory, and return the path of the directory."""
    body, arms = Body(out.name, find_robot('musashi_left_arm')), 0
    for limb in BODIES[name]:
        if limb == 'neck':
            body.add_neck()
        else:
            body.add_arm(arms, limb)
            arms += 1
    body.write(out)
    return out


def main(argv: list[str]) -> None:
    """Write the body that the command line names as a robot directory."""
    parser = Parser('limbs', 'Writes a body of several limbs as a robot directory.')
    parser.add_argument('body', choices=BODIES, nargs='?', default='17x40')
    parser.add_argument('out', type=Path, metavar='DIR')
    args = parser.parse_args(argv)
    print(write_body(args.body, args.out))
