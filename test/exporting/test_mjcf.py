# SPDX-License-Identifier: Apache-2.0
"""Export of a learned body as MJCF: import, learn, export, load."""

import bodies
import mujoco
import numpy as np
import pytest

from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.exporting.mjcf import export
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.tools.export_mjcf import main


@pytest.fixture(scope='module')
def imported(tmp_path_factory):
    folder = tmp_path_factory.mktemp('round_trip')
    file = folder / 'own.xml'
    file.write_text(bodies.MJCF, encoding='utf-8')
    robot = import_robot(file, folder / 'robot').robot
    return robot, initial_mae(robot, steps=900).mae, folder


def test_an_exported_model_loads_and_is_as_close_to_the_network_as_reported(imported, capsys):
    robot, mae, folder = imported
    checkpoint.save(mae, folder / 'mae.safetensors')
    out = folder / 'model'
    options = ['--robot', str(robot.description.directory), '--out', str(out)]
    assert main([str(folder / 'mae.safetensors'), *options]) == 0
    printed = capsys.readouterr().out
    assert 'warnings of MuJoCo: none' in printed
    model = mujoco.MjModel.from_xml_path(str(out / 'model.xml'))
    assert [model.tendon(i).name for i in range(model.ntendon)] == [*robot.muscles]
    limits = [model.joint(name).range for name in robot.joints]
    np.testing.assert_allclose(limits, np.stack([robot.lower, robot.upper], axis=1))
    again = import_robot(out / 'model.xml', folder / 'again').robot
    theta = robot.random_postures(200, np.random.default_rng(5))
    tension = np.broadcast_to(0.5 * (robot.tension.bias + robot.tension.limit), (200, 7))
    network = mae.muscle_jacobian(theta, tension)
    off = np.sqrt(((again.routes.muscle_jacobian(theta) - network) ** 2).sum(axis=2).mean(axis=0))
    size = np.sqrt((network**2).sum(axis=2).mean(axis=0))
    assert (off < 0.15 * size).all()
    holding = again.kinematics.holding_torque(theta), robot.kinematics.holding_torque(theta)
    np.testing.assert_allclose(*holding, atol=1e-3)


def test_points_that_a_network_has_learned_are_those_of_the_model(imported):
    """The exported model has the moment arms of the individual that the network describes."""
    robot, _, folder = imported
    individual = make_arm(robot, 3, str(folder / 'own.xml'), deviates=True).individual
    other = import_robot(folder / 'own.xml', folder / 'other').robot
    other.routes.absolute_lengths = individual.absolute_lengths
    other.routes.length_at_zero = individual.length_at_zero
    mae = initial_mae(other, steps=900).mae
    report = export(robot, mae, folder / 'individual')
    theta = robot.random_postures(200, np.random.default_rng(5))
    true, nominal = individual.muscle_jacobian(theta), robot.routes.muscle_jacobian(theta)
    before = np.sqrt(((nominal - true) ** 2).sum(axis=2).mean(axis=0))
    model = import_robot(folder / 'individual' / 'model.xml', folder / 'learned').robot
    after = np.sqrt(((model.routes.muscle_jacobian(theta) - true) ** 2).sum(axis=2).mean(axis=0))
    assert np.median(after) < 0.1 * np.median(before)
    assert after.max() < 0.2 * before.max()
    assert report.lengths.max() < 5e-4
    assert report.warnings == ()


def test_a_directory_in_use_is_refused(imported):
    robot, mae, folder = imported
    with pytest.raises(MusculoskeletalError, match='expected a new or empty directory'):
        export(robot, mae, folder)
