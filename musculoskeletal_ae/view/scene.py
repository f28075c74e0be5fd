# SPDX-License-Identifier: Apache-2.0
"""The scene of the page: three arms, coloured muscles with their names, floor, light and camera."""

import math
from typing import Any

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.view import body
from musculoskeletal_ae.view.body import MARKS, DrawnState
from musculoskeletal_ae.view.readings import ARMS, LEFT_PANEL

CAMERA_FOV = 0.8  # vertical field of view [rad]
FILLED = 0.95  # let the arm fill at most this share of the visible width and height
#: unit vector from the arm to the initial camera
VIEW_DIRECTION = np.array([1.25, 1.15, 0.35]) / np.linalg.norm([1.25, 1.15, 0.35])
RIGHT_PANEL = 330  # width of the right panel [pixels]
#: place the initial camera for a window of this width and height [pixels]
WINDOW = 1280, 800


class Scene:
    """Draws arms and muscles.

    Attributes:
        notes: Problems of the robot's meshes, as texts for users.
        posture: The drawn θ [rad] (D,) of each arm that is known.
        kinds: The drawn `body.DrawnState` of each muscle, (M,).
        size: Half of the diagonal of the space that the arm can reach [m].
        tubes: Handle of the drawn muscles.
    """

    def __init__(self, server: viser.ViserServer, robot: Robot) -> None:
        self._server, self._robot = server, robot
        self.posture: dict[str, Array] = {}
        self.kinds: Ints = np.zeros(robot.muscle_count, dtype=int)
        self._picked = ''  # name of the muscle that a visitor picked
        solids, self.notes = body.link_solids(robot)
        self._space = body.space(robot, solids)
        diagonal = self._space.max(axis=0) - self._space.min(axis=0)
        self.size = 0.5 * float(np.linalg.norm(diagonal))
        self._build_arms(solids)
        self._build_muscles()
        self._build_surroundings()
        with server.gui.add_folder('Show', order=50.0):
            self._names = server.gui.add_checkbox('muscle names', False)
            self._names.on_update(lambda _: self._mark())
            self._wanted = {arm: server.gui.add_checkbox(f'{arm} arm', True) for arm in ARMS}

    def _build_arms(self, solids: Any) -> None:
        scene, kin = self._server.scene, self._robot.kinematics
        self._arms: dict[str, list[Any]] = {}  # by arm: its root frame, then its joint frames
        for arm, colour in ARMS.items():
            frames = self._arms[arm] = [scene.add_frame(f'/{arm}', show_axes=False, visible=False)]
            for i, parent in enumerate(kin.tree.parent[1:], 1):
                name = f'{frames[parent].name}/{kin.model.names[i]}'
                at = kin.tree.placement_translation[i]
                frames.append(scene.add_frame(name, show_axes=False, position=at))
            opacity = None if arm == 'measured' else 0.4
            for number, (joint, mesh) in enumerate(solids):
                name = f'{frames[joint].name}/solid_{number}'
                look: dict[str, Any] = {'color': colour, 'opacity': opacity, 'cast_shadow': False}
                scene.add_mesh_simple(name, mesh.vertices, mesh.faces, **look)

    def _build_muscles(self) -> None:
        robot, scene = self._robot, self._server.scene
        tube = trimesh.creation.cylinder(1.0, 1.0, sections=12)
        # Remove the end caps, which would show as seams between tubes.
        tube.update_faces(np.abs(tube.face_normals[:, 2]) < 0.5)
        middle = 0.5 * (robot.lower + robot.upper)
        tubes: Any = body.muscle_tubes(robot, middle, np.zeros(robot.muscle_count), self.kinds)
        look: dict[str, Any] = {'lod': 'off', 'side': 'double'}
        look |= {'cast_shadow': False, 'visible': False}
        self.tubes: Any = scene.add_batched_meshes_simple(
            '/muscles', tube.vertices, tube.faces, **tubes, **look
        )
        self._labels = [
            scene.add_label(f'/names/{name}', name, visible=False, anchor='center-left')
            for name in robot.muscles
        ]
        self._owner = body.pieces(robot).repeat(body.DASHES)
        own = [np.flatnonzero(self._owner == m) for m in range(robot.muscle_count)]
        self._middles = [each[len(each) // 2] for each in own]

    def _build_surroundings(self) -> None:
        scene, camera = self._server.scene, self._server.initial_camera
        look_at, position = self.viewpoint(*WINDOW, False)
        floor, width = (*look_at[:2], self._space[:, 2].min() - 0.1 * self.size), 8.0 * self.size
        scene.add_grid('/floor', width, width, position=floor, cell_size=body.grid_cell(self.size))
        # Replace the default lights, which tint colours.
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_ambient('/light', intensity=1.5)
        scene.add_light_directional('/lamp', intensity=1.0, position=(2.0, -1.0, 3.0))
        camera.look_at, camera.position, camera.fov = look_at, position, CAMERA_FOV
        distance = float(np.linalg.norm(position - look_at))
        camera.near, camera.far = 0.01 * distance, 100.0 * distance

    def viewpoint(self, width: int, height: int, is_narrow: bool) -> tuple[Array, Array]:
        """Return the target and the position [m] of a camera that sees the whole arm.

        Args:
            width: Width of the visitor's window [pixels].
            height: Height of the visitor's window [pixels].
            is_narrow: Whether there is no panel on the left.
        """
        free = width - RIGHT_PANEL - (0 if is_narrow else LEFT_PANEL)
        up = math.tan(0.5 * CAMERA_FOV)
        side = up * max(free, 1) / max(height, 1)
        return body.viewpoint(self._space, VIEW_DIRECTION, (FILLED * side, FILLED * up))

    def draw(self, posture: dict[str, Array], tension: Array | None, kinds: Ints) -> Array | None:
        """Draw arms and muscles.

        Args:
            posture: Joint angles θ [rad], (D,), of each arm to draw, by name of the arm.
            tension: Tensions T [N] (M,); None hides the muscles.
            kinds: The `body.DrawnState` of each muscle, (M,).

        Returns:
            θ at which the muscles are drawn; None if they are not drawn.
        """
        kin, self.posture = self._robot.kinematics, posture
        with self._server.atomic():
            for arm, (root, *joints) in self._arms.items():
                root.visible = arm in posture and self._wanted[arm].value
                if not root.visible:
                    continue
                poses = kin.tree.in_parents(posture[arm][None])[0]
                turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
                for i, joint in enumerate(joints, 1):
                    joint.wxyz = turns[i]
                    if kin.tree.prismatic[i]:
                        joint.position = poses[i, :3, 3]
            theta = posture.get('measured', posture.get('estimated'))
            self.tubes.visible = theta is not None and tension is not None
            if theta is None or tension is None:
                return None
            tubes = body.muscle_tubes(self._robot, theta, tension, kinds)
            for name, value in tubes.items():
                setattr(self.tubes, name, value)
            if (kinds != self.kinds).any():
                self.kinds = kinds.copy()
                self._mark()
            for m, label in enumerate(self._labels):
                if label.visible:
                    label.position = tubes['batched_positions'][self._middles[m]]
        return theta

    def muscle_of(self, tube: int) -> str:
        """Return the name of the muscle to which one of the drawn tubes belongs."""
        return self._robot.muscles[self._owner[tube]]

    def pick(self, muscle: str) -> None:
        """Label the muscle of this name, which a visitor has picked."""
        self._picked = muscle
        self._mark()

    def _mark(self) -> None:
        """Label muscles: all if requested, else those that are picked or faulty."""
        for name, kind, label in zip(self._robot.muscles, self.kinds.tolist(), self._labels):
            label.visible = self._names.value or kind > DrawnState.SOUND or name == self._picked
            label.text = MARKS[kind] + name + (f' {DrawnState(kind).name.lower()}' if kind else '')
