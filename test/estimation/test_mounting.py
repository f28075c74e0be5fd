# SPDX-License-Identifier: Apache-2.0
"""Another mounting than that of robot.urdf is found, and payloads, pushes and errors are none."""

import numpy as np
import pinocchio as pin
import pytest
from exact_mae import ExactMae

from musculoskeletal_ae.estimation.contact import Contact
from musculoskeletal_ae.estimation.detectors.mounting import MountingCheck
from musculoskeletal_ae.experiments.detection import observe
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme

ARM = Robot.load('musashi_left_arm')
DOWN = np.array([0.0, 0.0, -9.81])


class Exploring:
    """An arm at rest in one random posture after the other, with errors of its tensions."""

    def __init__(self, gravity, payload=0.0, push=0.0, seed=0):
        self.gravity, self.payload, self.push = gravity, payload, push
        self.mae, self.rng = ExactMae(ARM), np.random.default_rng(seed)
        self.mae.is_calibrated, self.mae.isolated = True, ()
        self.model = pin.Model(ARM.kinematics.model)
        self.model.gravity.linear = gravity
        self.dt = 1.0  # time between two messages [s]
        self.gain = 1.0 + 0.1 * self.rng.standard_normal(ARM.muscle_count)
        self.check = MountingCheck(ARM)
        self.check.use(self.mae)

    def rest(self, times=1):
        kinematics = ARM.kinematics
        theta = ARM.random_postures(1, self.rng)[0]
        weight = pin.computeGeneralizedGravity(
            self.model, self.model.createData(), kinematics.tree.angles(theta)
        )
        force = self.payload * self.gravity + self.push * self.rng.standard_normal(3)
        weight = weight - kinematics.end_effector_jacobian(theta)[:3].T @ force
        jacobian = self.mae.muscle_jacobian(theta, np.full(ARM.muscle_count, 60.0))
        tension = TensionProgramme(jacobian, weight, 10.0, 400.0).nearest(60.0)
        if not np.allclose(-tension @ jacobian, weight, atol=0.1):  # the muscles cannot hold it
            return
        read = tension * self.gain + self.rng.normal(0.0, 5.0, len(tension))
        torque = kinematics.holding_torque(theta) + read @ jacobian
        length = self.mae.lengths(theta, read)
        state = State(theta, read, length)
        observation = observe(self.mae, length, read, read, self.dt, state=state)
        load = Contact(torque, lambda: np.zeros(3), np.nan, False)
        for _ in range(times):
            self.check.step_healthy(observation, load)


@pytest.mark.parametrize(
    ('axis', 'angle'),
    [
        (0, 45.0),
        (1, 180.0),
        *(
            pytest.param(*case, marks=pytest.mark.thorough)
            for case in ((0, 90.0), (0, 180.0), (1, 45.0), (1, 90.0))
        ),
    ],
)
def test_a_turned_base_is_found_with_the_direction_of_gravity(angle, axis):
    gravity = pin.exp3(np.radians(angle) * np.eye(3)[axis]).T @ DOWN
    arm = Exploring(gravity)
    for _ in range(60):
        arm.rest()
    tilt = arm.check.tilt
    assert tilt.angle == pytest.approx(angle, abs=20.0)
    assert tilt.direction @ gravity / 9.81 > np.cos(np.radians(25.0))
    (condition,) = arm.check.conditions()
    assert condition.identifier == 'other_mounting' and 'robot.urdf' in condition.text
    arm.check.accept()
    assert not [*arm.check.conditions()]


def test_a_base_that_is_turned_while_the_arm_works_is_found_and_so_is_its_return():
    arm = Exploring(DOWN)
    for _ in range(120):
        arm.rest()
    arm.gravity = arm.model.gravity.linear = -DOWN
    for _ in range(60):
        arm.rest()
    assert arm.check.tilt.angle == pytest.approx(180.0, abs=20.0)
    arm.gravity = arm.model.gravity.linear = DOWN
    for _ in range(60):
        arm.rest()
    assert arm.check.tilt is None


def test_postures_that_follow_each_other_faster_than_an_arm_moves_add_no_evidence():
    arm = Exploring(-DOWN)
    arm.dt = 0.005
    for _ in range(300):
        arm.rest()
    assert arm.check.tilt is None


@pytest.mark.parametrize(('payload', 'push'), [(0.0, 0.0), (3.6, 0.0), (0.0, 15.0)])
@pytest.mark.parametrize(
    'seed', [0, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2))]
)
def test_neither_a_payload_nor_pushes_are_another_mounting(payload, push, seed):
    arm = Exploring(DOWN, payload, push, seed)
    for _ in range(150):
        arm.rest()
        assert arm.check.tilt is None


def test_an_arm_that_stands_still_adds_no_evidence():
    arm = Exploring(-DOWN)
    for _ in range(5):
        arm.rest(times=500)
    assert arm.check.tilt is None
