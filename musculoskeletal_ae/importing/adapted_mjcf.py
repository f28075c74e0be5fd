# SPDX-License-Identifier: Apache-2.0
"""The body of an imported MuJoCo model, adapted to its robot directory (`model.xml`).

The emulator loads this file as it is. It differs from the model that the user gave in these points:

- Joints, tendons and bodies have the names of the robot directory.
- Each ball joint is three hinges. Joints that the robot does not have are removed, in the position
  in which the import holds them.
- Each muscle has a motor; the actuators and sensors of the user's model are removed.
- A body at the end effector can carry a payload.

Everything else is that of the user's model, for example geometry, contacts, springs and friction.
"""

from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.importing.source import Source
from musculoskeletal_ae.robot.urdf import parse_xml

#: comment at the top of a file that the import has written
NOTE = ' written by import_robot for the robot directory in which it lies '
HAND = 'hand of the emulator'  # name of the body at the end effector
#: for each tag, the attributes by which other elements refer to an element of this kind
REFERENCES: dict[str, dict[str, tuple[str, ...]]] = {
    'joint': {'joint': ('joint', 'joint1', 'joint2')},
    'tendon': {'tendon': ('tendon1', 'tendon2')},
    'body': {
        **dict.fromkeys(('exclude', 'weld', 'connect'), ('body1', 'body2')),
        **dict.fromkeys(('camera', 'light'), ('target',)),
        'bone': ('body',),
    },
}
#: remove these elements and attributes, which belong to the user's actuators and sensors
OF_ACTUATORS = 'actuator', 'sensor', 'keyframe', 'tuple', 'general'
ACTUATION = 'actuatorfrclimited', 'actuatorfrcrange', 'actuatorgroupdisable', 'actuation'
#: remove these attributes of `size` beside `memory`, because MuJoCo rejects both together
OLDER_SIZES = 'njmax', 'nconmax', 'nstack'


class AdaptedModel:
    """The text of `model.xml`, adapted from the user's model.

    Attributes:
        root: Root element of the XML tree.
    """

    def __init__(
        self,
        source: Source,
        spec: Any,
        model: Any,
        names: dict[str, list[str]],
        balls: dict[int, list[str]],
    ) -> None:
        """Adapt a model.

        Args:
            source: The robot, after `cut`.
            spec: The user's model as an MjSpec.
            model: The MjModel that was compiled from `spec`.
            names: The names in the robot directory of all elements of a kind ('body', 'joint' and
                'tendon').
            balls: The names of the three hinges of each ball joint.
        """
        self._source, self._model, self._names, self._balls = source, model, names, balls
        # MuJoCo writes a model without includes and replicated elements. It gives each place in the
        # frame of a body, and keeps elements of a kind in the order of their indices.
        self.root = parse_xml(Path('model.xml'), spec.to_xml())
        world = self._section('worldbody')
        self._bodies = [world, *world.iter('body')]
        self._joints = [each for each in world.iter() if each.tag in ('joint', 'freejoint')]
        self._tendons = [*self._section('tendon')]
        kept = set(source.model.names[1:])
        self._is_held: Bools = np.array(
            [kept.isdisjoint(balls.get(j, [name])) for j, name in enumerate(names['joint'])],
            dtype=bool,
        )
        self._rename()
        self._place_bodies()
        self._place_routes()
        self._remove_held_joints()
        self._split_balls(kept)
        self._exclude_parents()
        self._replace_actuators()
        self._add_hand()
        self._unify_size()
        compiler, folder = self._section('compiler'), Path(spec.modelfiledir).absolute()
        compiler.set('meshdir', str(folder / spec.compiler.meshdir))
        compiler.set('texturedir', str(folder / spec.compiler.texturedir))

    def text(self) -> str:
        """Return the adapted model as the text of an MJCF file."""
        self.root.insert(0, ET.Comment(NOTE))
        ET.indent(self.root)
        return ET.tostring(self.root, encoding='unicode') + '\n'

    def _section(self, tag: str) -> ET.Element:
        """Return the section of the file with a tag; add it if there is none."""
        section = self.root.find(tag)
        return ET.SubElement(self.root, tag) if section is None else section

    def _remove(self, is_removed: Callable[[ET.Element], bool]) -> None:
        for parent in [*self.root.iter()]:
            for child in [each for each in parent if is_removed(each)]:
                parent.remove(child)

    def _unify_size(self) -> None:
        """Remove the older limits of memory from a file that also states `memory`.

        MuJoCo writes both if different included files state them, but does not read such a file.
        """
        size = self._section('size')
        if size.get('memory'):
            for older in OLDER_SIZES:
                size.attrib.pop(older, None)

    def _rename(self) -> None:
        """Give all bodies, joints and tendons the names that they have in the robot directory."""
        elements = {'body': self._bodies, 'joint': self._joints, 'tendon': self._tendons}
        for kind, named in elements.items():
            new = dict[str, str]()
            for element, name in zip(named, self._names[kind], strict=True):
                if old := element.get('name'):
                    new[old] = name
                if element.tag != 'worldbody':
                    element.set('name', name)
            for element in self.root.iter():
                for key in REFERENCES[kind].get(element.tag, ()):
                    if (old := element.get(key)) and old in new:
                        element.set(key, new[old])

    def _place_bodies(self) -> None:
        """Write the places of bodies and joints, with all held joints in their positions."""
        model, data, source = self._model, mujoco.MjData(self._model), self._source
        for j in np.flatnonzero(self._is_held).tolist():
            if model.jnt_type[j] in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                data.qpos[model.jnt_qposadr[j]] = source.rest[self._names['joint'][j]]
        mujoco.mj_kinematics(model, data)
        poses = [pin.SE3(turn.reshape(3, 3), at) for turn, at in zip(data.xmat, data.xpos)]
        for i in range(1, model.nbody):
            place = poses[model.body_parentid[i]].actInv(poses[i])
            self._bodies[i].set('pos', _text(place.translation))
            turn = pin.Quaternion(place.rotation).coeffs()
            self._bodies[i].set('quat', _text(np.roll(turn, 1)))
        for j in np.flatnonzero(~self._is_held).tolist():
            # If a joint of the same body is held, its position moves the body's other joints.
            pose = poses[model.jnt_bodyid[j]]
            self._joints[j].set('pos', _text(pose.actInv(data.xanchor[j])))
            self._joints[j].set('axis', _text(pose.rotation.T @ data.xaxis[j]))

    def _place_routes(self) -> None:
        """Place sites and wrapped objects exactly.

        MuJoCo writes positions with six digits. Such an error could move a site from the surface
        of an object into the object.
        """
        model, world = self._model, self._section('worldbody')
        sites = {site.get('name'): site for site in world.iter('site')}
        geoms = {geom.get('name'): geom for geom in world.iter('geom')}
        for item in self.root.iterfind('tendon/spatial/*'):
            for name in {item.get('site'), item.get('sidesite')} - {None}:
                sites[name].set('pos', _text(model.site(name).pos))
            if name := item.get('geom'):
                geom, element = model.geom(name), geoms[name]
                sizes = 1 if geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE else 2
                element.attrib.pop('mesh', None)  # replaced by the size of the fitted primitive
                element.set('size', _text(geom.size[:sizes]))
                element.set('pos', _text(geom.pos))
                element.set('quat', _text(geom.quat))

    def _remove_held_joints(self) -> None:
        """Remove held joints, elements that name them, and contact pairs of two immobile bodies."""
        model = self._model
        held = {self._names['joint'][j] for j in np.flatnonzero(self._is_held)}
        moves = np.zeros(model.nbody, dtype=bool)
        for i in range(1, model.nbody):
            own = slice(model.body_jntadr[i], model.body_jntadr[i] + model.body_jntnum[i])
            moves[i] = moves[model.body_parentid[i]] or not self._is_held[own].all()
        tendons = {
            tendon.get('name')
            for tendon in self.root.iterfind('tendon/fixed')
            if any(joint.get('joint') in held for joint in tendon)
        }

        def is_removed(element: ET.Element) -> bool:
            if element.tag == 'pair':
                geoms = [model.geom(element.get(key)) for key in ('geom1', 'geom2')]
                return not any(moves[geom.bodyid[0]] for geom in geoms)
            named = {element.get(key) for key in ('joint1', 'joint2')}
            of_tendons = {element.get(key) for key in ('name', 'tendon1', 'tendon2')}
            return (
                (element.tag in ('joint', 'freejoint') and element.get('name') in held)
                or (element.tag in ('fixed', 'tendon') and not of_tendons.isdisjoint(tendons))
                or not named.isdisjoint(held)
            )

        self._remove(is_removed)

    def _split_balls(self, kept: set[str]) -> None:
        """Replace each ball joint by those of its three hinges whose names are in `kept`."""
        model = self._model
        parents = {child: parent for parent in self.root.iter() for child in parent}
        for j, parts in self._balls.items():
            if self._is_held[j]:
                continue
            ball, dof = self._joints[j], model.jnt_dofadr[j]
            parent = parents[ball]
            at = [*parent].index(ball)
            parent.remove(ball)
            same = {
                'pos': ball.attrib['pos'], 'ref': '0', 'springref': '0',
                'limited': 'false',  # the file may have defaults for the ranges of other joints
                'stiffness': _text(model.jnt_stiffness[j]),
                'damping': _text(model.dof_damping[dof]),
                'armature': _text(model.dof_armature[dof]),
                'frictionloss': _text(model.dof_frictionloss[dof]),
            }  # fmt: skip
            for name, axis in reversed([*zip(parts, np.eye(3), strict=True)]):
                if name in kept:
                    hinge = {'name': name, 'type': 'hinge', 'axis': _text(axis), **same}
                    parent.insert(at, ET.Element('joint', hinge))

    def _exclude_parents(self) -> None:
        """Write which bodies do not collide because one is the parent of the other.

        MuJoCo regards bodies without joints between them as one, and then excludes contacts between
        parent and child, except if the parent is immobile. The removal of held joints changes both.
        The pairs are therefore those of the user's model, and MuJoCo's own rule is disabled.
        """
        model, parent_filter = self._model, mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
        option = self._section('option')
        flag = option.find('flag')
        flag = ET.SubElement(option, 'flag') if flag is None else flag
        flag.set('filterparent', 'disable')
        if model.opt.disableflags & parent_filter:
            return
        contact, whole, names = self._section('contact'), model.body_weldid, self._names['body']
        parent = whole[model.body_parentid[whole]]
        shaped = [i for i in range(model.nbody) if model.body_geomnum[i] and whole[i] != 0]
        for i, k in combinations(shaped, 2):
            if parent[i] == whole[k] or parent[k] == whole[i]:
                ET.SubElement(contact, 'exclude', body1=names[i], body2=names[k])

    def _replace_actuators(self) -> None:
        """Replace the actuators and sensors of the user's model by a motor for each muscle."""
        self._remove(lambda element: element.tag in OF_ACTUATORS)
        for element in self.root.iter():
            for name in ACTUATION:
                element.attrib.pop(name, None)
        section = self._section('actuator')
        for muscle in self._source.routes:
            ET.SubElement(section, 'motor', name=muscle, tendon=muscle)

    def _add_hand(self) -> None:
        """Add a body at the end effector, which is a body or a point of a body."""
        source, names = self._source, self._names['body']
        link, point = source.end_effector, np.zeros(3)
        if link not in names:
            link, point = source.points[link]
        ET.SubElement(self._bodies[names.index(link)], 'body', name=HAND, pos=_text(point))


def _text(values: Any) -> str:
    return ' '.join(f'{value + 0.0:.15g}' for value in np.round(np.ravel(values), 12).tolist())
