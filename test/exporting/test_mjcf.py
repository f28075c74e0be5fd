# SPDX-License-Identifier: Apache-2.0
"""Export of a learned body as MJCF: import, learn, export, load."""

from pathlib import Path
from typing import Any, NamedTuple

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
    return Learned(robot, individual, initial_mae(displaced, steps=150).mae, folder)


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


def test_a_directory_in_use_is_refused(learned):
    robot, _, mae, folder = learned
    with pytest.raises(MusculoskeletalError, match='expected a new or empty directory'):
        export(robot, mae, folder)
