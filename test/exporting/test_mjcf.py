# SPDX-License-Identifier: Apache-2.0
"""Export of a learned body as MJCF: import, learn, export, load."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import bodies
import mujoco
import numpy as np
import pytest

from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.fit import fit_to_network
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.exporting import learned_routes
from musculoskeletal_ae.exporting.exported_mjcf import export, export_into
from musculoskeletal_ae.exporting.user_file import UserFile
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.export_mjcf import main


class Learned(NamedTuple):
    """An individual with displaced points, and a network that has learned it."""

    robot: Robot  # without the displacements
    individual: Any
    mae: Mae
    folder: Path


@pytest.fixture(scope='module')
def learned(tmp_path_factory):
    folder = tmp_path_factory.mktemp('round_trip')
    file = folder / 'own.xml'
    file.write_text(bodies.MJCF, encoding='utf-8')
    robot = import_robot(file, folder / 'robot').robot
    individual = make_arm(robot, 3, str(folder / 'robot' / 'model.xml'), deviates=True).individual
    displaced = import_robot(file, folder / 'displaced').robot
    displaced.routes.absolute_lengths = individual.absolute_lengths
    displaced.routes.length_at_zero = individual.length_at_zero
    return Learned(robot, individual, initial_mae(displaced, steps=150), folder)


def differences(one, other):
    """Return by how much two muscle Jacobians (N, M, D) differ, for each muscle (M,).

    The difference is the norm over the joints, as a root mean square over N postures.
    """
    return np.sqrt(((one - other) ** 2).sum(axis=2).mean(axis=0))


def test_an_exported_model_loads_and_is_as_close_to_the_network_as_reported(learned, capsys):
    robot, individual, mae, folder = learned
    checkpoint.save(mae, folder / 'mae.safetensors')
    out = folder / 'model'
    options = ['--robot', str(robot.description.directory), '--out', str(out)]
    assert main([str(folder / 'mae.safetensors'), *options]) == 0
    printed = capsys.readouterr().out
    assert 'warnings of MuJoCo: none' in printed
    rows = [line.split() for line in printed.splitlines() if line.startswith(robot.muscles)]
    assert len(rows) == robot.muscle_count
    assert all(float(length) < 0.5 for _, length, *_ in rows)  # [mm]
    model = mujoco.MjModel.from_xml_path(str(out / 'model.xml'))
    assert [model.tendon(i).name for i in range(model.ntendon)] == [*robot.muscles]
    limits = [model.joint(name).range for name in robot.joints]
    np.testing.assert_allclose(limits, np.stack([robot.lower, robot.upper], axis=1))
    again = import_robot(out / 'model.xml', folder / 'again').robot
    theta = robot.random_postures(200, np.random.default_rng(5))
    tension = np.broadcast_to(0.5 * (robot.tension.bias + robot.tension.limit), (200, 7))
    network, exported = mae.muscle_jacobian(theta, tension), again.routes.muscle_jacobian(theta)
    assert (differences(exported, network) < 0.15 * differences(network, 0.0)).all()
    holding = again.kinematics.holding_torque(theta), robot.kinematics.holding_torque(theta)
    np.testing.assert_allclose(*holding, atol=1e-3)
    # The moment arms are those of the individual, not those of the robot.
    true, nominal = individual.muscle_jacobian(theta), robot.routes.muscle_jacobian(theta)
    before, after = differences(nominal, true), differences(exported, true)
    assert np.median(after) < 0.1 * np.median(before)
    assert after.max() < 0.2 * before.max()


def without_sites(text):
    """Return a text without the positions of its sites."""
    return re.sub(r'(<site [^>]*?)\s*pos="[^"]*"', r'\1', text)


def test_learned_points_are_written_into_the_users_file_and_all_else_stays(learned, capsys):
    robot, individual, mae, folder = learned
    checkpoint.save(mae, folder / 'into.safetensors')
    text = (folder / 'own.xml').read_text().replace('<worldbody>', '<!-- mine --><worldbody>', 1)
    body = re.search(r'<tendon>.*?</tendon>', text, re.DOTALL)[0]
    (folder / 'tendons.xml').write_text(f'<mujocoinclude>{body}</mujocoinclude>')
    mine = folder / 'mine.xml'
    mine.write_text(text.replace(body, '<include file="tendons.xml"/>'))
    options = ['--robot', str(robot.description.directory), '--into', str(mine)]
    assert main([str(folder / 'into.safetensors'), *options, '--out', str(folder / 'into')]) == 0
    printed = capsys.readouterr().out
    assert 'muscles that keep their points: none' in printed
    written = (folder / 'into' / 'mine.xml').read_text()
    assert '<!-- mine -->' in written
    assert without_sites(written) == without_sites(mine.read_text())
    assert (folder / 'into' / 'tendons.xml').read_text() == (folder / 'tendons.xml').read_text()
    again = import_robot(folder / 'into' / 'mine.xml', folder / 'again_into').robot
    theta = robot.random_postures(200, np.random.default_rng(5))
    true = individual.muscle_jacobian(theta)
    before = differences(robot.routes.muscle_jacobian(theta), true)
    after = differences(again.routes.muscle_jacobian(theta), true)
    assert np.median(after) < 0.2 * np.median(before)


CUBE = 'v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n'
MESHES = """<mujoco>
  <include file="shared.xml"/><include file="bones/assets.xml"/>
  <include file="../outside/site.xml"/>
  <worldbody><body><geom type="mesh" mesh="tip"/><geom type="mesh" mesh="own"/></body></worldbody>
</mujoco>"""


def test_meshes_are_found_wherever_an_included_file_places_them(tmp_path):
    files = {
        'home/mine.xml': MESHES,
        'home/shared.xml': '<mujoco><compiler meshdir="meshes"/></mujoco>',
        'home/bones/assets.xml': '<mujoco><asset><mesh name="tip" file="tip.obj"/>'
        '<mesh name="own" file="own.obj"/></asset></mujoco>',
        'outside/site.xml': '<mujoco><worldbody><site name="s" pos="1 2 3"/></worldbody></mujoco>',
        'home/meshes/tip.obj': CUBE,
        'home/bones/own.obj': CUBE,
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    user = UserFile(tmp_path / 'home' / 'mine.xml')
    user.move('s', np.array([3.0, 2.0, 1.0]))
    (tmp_path / 'copy').mkdir()
    model = mujoco.MjModel.from_xml_path(str(user.write(tmp_path / 'copy')))
    assert model.nmesh == 2
    np.testing.assert_allclose(model.site('s').pos, [3.0, 2.0, 1.0])
    written = (tmp_path / 'copy' / 'mine.xml').read_text()
    assert written == MESHES.replace('../outside/site.xml', 'site.xml')


def test_meshes_beside_a_file_that_states_another_folder_for_textures_only_are_found(tmp_path):
    text = (
        '<mujoco>\r\n  <compiler texturedir="textures"/>\r\n  <asset>\r\n'
        '    <mesh name="tip" file="tip.obj"/>\r\n  </asset>\r\n'
        '  <worldbody><body><geom type="mesh" mesh="tip"/></body></worldbody>\r\n</mujoco>\r\n'
    )
    home, copy = tmp_path / 'home', tmp_path / 'copy'
    for folder in (home, copy):
        folder.mkdir()
    (home / 'mine.xml').write_bytes(text.encode())
    (home / 'tip.obj').write_text(CUBE)
    written = UserFile(home / 'mine.xml').write(copy)
    assert mujoco.MjModel.from_xml_path(str(written)).nmesh == 1
    content = written.read_bytes().decode()
    assert content.count('\r\n') == content.count('\n') == text.count('\n') + 1


def test_another_file_is_refused(learned):
    robot, _, mae, folder = learned
    (folder / 'other.xml').write_text('<mujoco><worldbody/></mujoco>')
    with pytest.raises(MusculoskeletalError, match='no tendon with the name and the sites'):
        export_into(robot, mae, folder / 'other.xml', folder / 'refused')


def test_a_muscle_keeps_points_if_learned_ones_are_worse_or_make_its_length_jump(
    learned, monkeypatch
):
    robot, _, mae, _ = learned
    body, rng = CalibratedBody(robot), np.random.default_rng(0)
    fit_to_network(body, mae, with_remainder=False)
    layout = body.layouts[0]
    body.parameters[0][layout.attachment] += 0.05 * rng.normal(size=3 * len(layout.points))

    def jumping(*_):
        return np.arange(robot.muscle_count) == 1

    monkeypatch.setattr(learned_routes, 'newly_jumping', jumping)
    found = learned_routes.learned_routes(robot, body, mae)
    assert found.kept == {
        robot.muscles[0]: 'learned points are not closer to the network',
        robot.muscles[1]: 'its length would jump',
    }
    for m in (0, 1):
        assert found.routes[m] is robot.description.routes[m]
    assert np.all(found.after.lengths <= found.before.lengths)
    assert np.all(found.after.arms <= found.before.arms)


@pytest.mark.parametrize('worse', learned_routes.Errors._fields)
def test_learned_points_must_be_closer_in_lengths_and_in_moment_arms(learned, monkeypatch, worse):
    robot, _, mae, _ = learned
    body, ones = CalibratedBody(robot), np.ones(robot.muscle_count)
    fit_to_network(body, mae, with_remainder=False)
    before, half = learned_routes.Errors(ones, ones), 0.5 * ones
    of_first = np.where(np.arange(robot.muscle_count) == 0, 2.0, 0.5)
    after = learned_routes.Errors(half, half)._replace(**{worse: of_first})
    monkeypatch.setattr(
        learned_routes, 'errors', lambda moved, *_: before if moved is robot else after
    )
    monkeypatch.setattr(learned_routes, 'newly_jumping', lambda *_: ones < 0.0)
    found = learned_routes.learned_routes(robot, body, mae)
    assert found.kept == {robot.muscles[0]: 'learned points are not closer to the network'}


def test_a_muscle_keeps_its_points_if_samples_leave_open_how_it_differs(learned):
    robot, _, mae, _ = learned
    body = CalibratedBody(robot)
    fit_to_network(body, mae, with_remainder=False)
    open_one = np.zeros(robot.muscle_count)
    open_one[2] = 1.0
    found = learned_routes.learned_routes(robot, body, replace(mae, length_spread=open_one))
    assert found.kept == {robot.muscles[2]: 'too few samples to tell how it differs'}
    assert found.routes[2] is robot.description.routes[2]


def test_a_directory_in_use_is_refused(learned):
    robot, _, mae, folder = learned
    with pytest.raises(MusculoskeletalError, match='expected a new or empty directory'):
        export(robot, mae, folder)


TWINS = """<mujoco><compiler autolimits="true"/><worldbody>
  <site pos=".03 0 .1" name="a0"/><site pos=".03 0 .1" name="b0"/><site pos="-.03 0 .1" name="c0"/>
  <body><joint axis="0 1 0" range="-60 60"/><geom size=".01" pos="0 0 -.1" mass=".1"/>
    <site pos=".03 0 -.1" name="a1"/><site pos=".03 0 -.1" name="b1"/>
    <site pos="-.03 0 -.1" name="c1"/>
  </body></worldbody>
  <tendon><spatial><site site="a0"/><site site="a1"/></spatial>
    <spatial><site site="b0"/><site site="b1"/></spatial>
    <spatial><site site="c0"/><site site="c1"/></spatial></tendon></mujoco>"""


def test_each_of_two_sites_in_one_place_is_moved_for_its_own_tendon(tmp_path, monkeypatch):
    file = tmp_path / 'twins.xml'
    file.write_text(TWINS)
    robot = import_robot(file, tmp_path / 'robot').robot
    shifts = np.array([[[0.0, 0.0, 0.001 * (2 * m + k)] for k in range(2)] for m in range(3)])
    monkeypatch.setattr(CalibratedBody, 'link_shifts', lambda _, m: list(shifts[m]))
    never = np.zeros(robot.muscle_count, dtype=bool)
    monkeypatch.setattr(learned_routes, 'newly_jumping', lambda *_: never)
    exact = learned_routes.Errors(np.zeros(3), np.zeros(3))
    monkeypatch.setattr(learned_routes, 'errors', lambda *_: exact)
    export_into(robot, initial_mae(robot, steps=1), file, tmp_path / 'out')
    again = mujoco.MjModel.from_xml_path(str(tmp_path / 'out' / 'twins.xml'))
    heights = [again.site(f'{name}{k}').pos[2] for name in 'abc' for k in range(2)]
    np.testing.assert_allclose(heights, [0.1, -0.099, 0.102, -0.097, 0.104, -0.095], atol=1e-9)
