# SPDX-License-Identifier: Apache-2.0
"""Emulator model `foreign`: nominal without effects; each effect does what its name states."""

from dataclasses import fields, replace

import bodies
import mujoco
import numpy as np
import pytest
from robots import read_muscles, write_muscles, write_robot

from emulator.commands import to_mid_range
from musculoskeletal_ae.emulator.foreign import arm as foreign
from musculoskeletal_ae.emulator.foreign import mujoco_model
from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
from musculoskeletal_ae.emulator.foreign.effects import NONE, Effects
from musculoskeletal_ae.emulator.foreign.tendons import law
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.robot import Robot

WRAP = {'wrap': 'cylinder', 'link': 'upper', 'xyz': [0, 0, -0.3], 'axis': [0, 1, 0], 'radius': 0.02}
EFFECTS = {field.name: getattr(Effects(), field.name) or 1.0 for field in fields(Effects)}


@pytest.fixture(scope='module')
def coupled(tmp_path_factory):
    """Return an arm with a coupled joint and with a muscle that wraps around an object."""
    directory = write_robot(tmp_path_factory.mktemp('coupled'), finger=True)
    document = read_muscles(directory)
    document['couplings'] = [{'joint': 'finger', 'master': 'bend', 'ratio': -0.5, 'offset': 0.2}]
    document['muscles'][4]['route'].append({'link': 'fingertip', 'xyz': [0.02, 0.01, 0.0]})
    route = next(m['route'] for m in document['muscles'] if m['route'][-1]['link'] == 'lower')
    route.insert(len(route) - 1, WRAP)
    return Robot.load(write_muscles(directory, document))


@pytest.fixture(scope='module')
def imported(tmp_path_factory):
    """Return the model.xml and the robot that `import_robot` creates from a user's MJCF file."""
    robot = import_text(tmp_path_factory.mktemp('imported'), bodies.MJCF, end='finger')
    return model_of(robot), robot


def import_text(folder, text, **chain):
    """Write an MJCF file into a folder, import it, and return the robot."""
    file = folder / 'own.xml'
    file.write_text(text, encoding='utf-8')
    return import_robot(file, folder / 'own', **chain).robot


def model_of(robot):
    return robot.description.directory / 'model.xml'


def drive(arm, seconds=0.3, tension=80.0):
    """Drive an arm to mid-range and return the states on the way, (N, 2D + 3M)."""
    robot, rows = arm.robot, []
    command = to_mid_range(robot, tension)
    for _ in range(round(seconds / 0.02)):
        arm.command_length(command)
        arm.step(0.02)
        read = arm.sense()
        rows.append(
            np.concatenate(
                [arm.theta, arm.tension, read.theta, read.muscles.length, read.muscles.tension]
            )
        )
    return np.array(rows)


def test_a_foreign_body_without_effects_is_the_described_body(robot, coupled, imported):
    for model in (robot, Robot.load('musashi_left_arm'), coupled, imported[1]):
        true = ForeignArm(model, 0, NONE).individual
        theta = model.random_postures(20, np.random.default_rng(0))
        lengths, jacobian = true.absolute_lengths(theta), true.muscle_jacobian(theta)
        np.testing.assert_allclose(lengths, model.routes.absolute_lengths(theta), atol=1e-9)
        if not model.kinematics.tree.is_geared or model is coupled:
            slopes = model.routes.muscle_jacobian(theta)
            np.testing.assert_allclose(jacobian, slopes, atol=1e-6)
        tension = np.broadcast_to(model.tension.limit, lengths.shape)
        off = true.muscle_lengths(theta, tension) - model.muscle_lengths(theta, tension)
        # In every posture, the foreign body stretches its tendons as at θ = 0. The geometric model
        # stretches them in proportion to their present length.
        stretch = model.series_elastic.wire_stretch * tension * (lengths - true.length_at_zero)
        np.testing.assert_allclose(off, stretch, atol=2e-5)


def test_a_coupled_joint_follows_its_master(coupled):
    arm = ForeignArm(coupled, 0, NONE)
    drive(arm, 1.5)
    names = list(coupled.kinematics.model.names[1:])
    finger, bend = (arm._data.joint(name).qpos[0] for name in ('finger', 'bend'))
    assert {'finger', 'bend'} <= set(names)
    assert finger == pytest.approx(-0.5 * bend + 0.2, abs=0.02)


def test_a_prismatic_joint_coupled_to_a_revolute_one_does_not_lag(tmp_path):
    document = read_muscles(write_robot(tmp_path, slider=True))
    document['joints'].remove('wrist')
    document['couplings'] = [{'joint': 'wrist', 'master': 'bend', 'ratio': -0.03}]
    arm = ForeignArm(Robot.load(write_muscles(tmp_path, document)), 0, NONE)
    drive(arm, 1.0)
    wrist, bend = (arm._data.joint(name).qpos[0] for name in ('wrist', 'bend'))
    assert wrist == pytest.approx(-0.03 * bend, abs=5e-4)


@pytest.mark.parametrize('name', EFFECTS)
def test_each_effect_alone_changes_the_motion(robot, name, monkeypatch):
    sprung = JointElasticity(np.eye(2), np.zeros(2), np.zeros(2))
    robot = robot.with_elasticity(sprung)  # without joint springs, their effects change nothing
    monkeypatch.setattr(foreign, 'SLIP_TIME', 0.01)
    monkeypatch.setattr(foreign, 'HOUR', 0.1)
    size = EFFECTS[name] if name != 'dropouts' else 0.5
    # Two effects change nothing alone: stiction needs tendon friction, and jitter needs a delay.
    others = {'stiction': {'guide_friction': 0.25}, 'jitter': {'delay': 0.0125}}.get(name, {})
    bare = replace(NONE, **others)
    lives = [drive(ForeignArm(robot, 1, e)) for e in (bare, replace(bare, **{name: size}))]
    assert np.abs(lives[1] - lives[0]).max() > 1e-6


def test_switching_one_effect_off_keeps_the_random_draws_of_the_others(robot):
    whole, part = (
        ForeignArm(robot, 1, effects) for effects in (Effects(), replace(Effects(), hysteresis=0.0))
    )
    for name, values in whole.tendons._asdict().items():
        if name != 'hysteresis':
            np.testing.assert_array_equal(values, getattr(part.tendons, name))
    np.testing.assert_array_equal(whole._model.site_pos, part._model.site_pos)


def test_hysteresis_raises_tension_while_stretching_and_lowers_it_while_shortening(robot):
    arm = ForeignArm(robot, 1, replace(NONE, hysteresis=0.15))
    memory, tension = arm._memory, arm._muscle.end_tension
    for tensions, side in ((np.linspace(30.0, 200.0, 60), 1.0), (np.linspace(200.0, 40.0, 30), -1)):
        for each in tensions:
            arm.command_tension(np.full(robot.muscle_count, each))
            arm.step(0.02)
        middle = [law(arm.tendons, m, x) for m, x in enumerate(memory.elongation)]
        assert np.all(side * memory.loop > 0.5)
        assert np.all(side * (tension - middle) > 0.5)


def test_creep_is_the_same_in_every_decade_of_time(robot):
    arm, crept = ForeignArm(robot, 1, replace(NONE, creep=0.04)), []
    arm.command_timeout = np.inf
    arm.command_tension(np.full(robot.muscle_count, 150.0))
    for seconds in (0.3, 2.7, 12.0):
        arm.step(seconds)
        crept.append(arm._memory.slow[:, :4].sum(axis=1) / arm._memory.elongation)
    decades = np.diff(crept, axis=0) / [[1.0], [np.log10(5.0)]]
    # An individual creeps by 2/3 to 4/3 of 4 % of the elongation per decade. The model approximates
    # the logarithm of time by four exponentials, so the creep may be 0.5 to 1.5 times as large.
    assert np.all((decades > 0.5 * 0.04 * 2.0 / 3.0) & (decades < 1.5 * 0.04 * 4.0 / 3.0))


def test_tendon_friction_grows_with_the_bends_of_the_tendon(robot):
    arm = ForeignArm(robot, 1, replace(NONE, kinks=0.0065, guide_friction=0.25))
    bends, losses = [], []
    for theta in (robot.lower, robot.upper):
        arm.reset(theta)
        for _ in range(20):  # wind in all muscles, so that friction acts in every tendon
            arm.command_tension(np.full(robot.muscle_count, 150.0))
            arm.step(0.01)
        muscle = arm._muscle
        bends.append(arm._memory.bend.copy())
        losses.append(np.log(muscle.tension / muscle.end_tension) / muscle.sliding)
    bends, losses = np.array(bends), np.array(losses)
    bent = np.abs(bends[1] - bends[0]) > 0.2
    assert bent.any()
    steeper = (losses[1] - losses[0]) * (bends[1] - bends[0])
    assert np.all(steeper[bent] > 0.0)


def test_kinks_lengthen_some_routes_by_about_their_size():
    robot = Robot.load('musashi_left_arm')
    theta = robot.random_postures(400, np.random.default_rng(2))
    straight, kinked = (
        ForeignArm(robot, 3, replace(NONE, kinks=kinks)).individual.absolute_lengths(theta)
        for kinks in (0.0, 0.01)
    )
    longer = kinked - straight
    assert longer.min() > -1e-9
    most = longer.max(axis=0)
    # A route with several segments has several kinks, so it may lengthen by more than 0.01 m. Short
    # segments cannot have such a large kink.
    assert np.median(most) > 0.004
    assert np.all(most < 0.035)
    assert np.mean(longer < 1e-6) > 0.3  # where a tendon touches no obstacle, it stays straight


def test_joint_friction_follows_the_load_of_each_joint():
    robot = Robot.load('musashi_left_arm')
    arm = ForeignArm(robot, 1, replace(NONE, joint_friction=0.02))
    friction = np.array([arm._model.joint(name).frictionloss[0] for name in robot.joints])
    theta = robot.random_postures(500, np.random.default_rng(3))
    weight = np.abs(robot.kinematics.holding_torque(theta)).max(axis=0)
    assert np.all(friction > 0.01 * weight)
    assert friction[4] < 0.5 * friction[:2].min()  # elbow_yaw carries much less than the shoulder


def test_a_users_mjcf_file_moves_as_the_robot_imported_from_it(imported):
    file, robot = imported
    arm = make_arm(robot, 0, str(file))
    described = ForeignArm(robot, 0, NONE)
    theta = robot.random_postures(5, np.random.default_rng(0))
    lengths = arm.individual.absolute_lengths(theta)
    np.testing.assert_allclose(lengths, described.individual.absolute_lengths(theta), atol=1e-6)
    motions = [drive(each, 1.0)[:, : robot.joint_count] for each in (arm, described)]
    assert np.ptp(motions[0], axis=0).max() > 0.1
    assert np.isfinite(motions[0]).all()
    hand = robot.kinematics.end_effector_pose(arm.theta).translation
    # MuJoCo's pose of the hand is that before the last step, hence the tolerance.
    np.testing.assert_allclose(arm.hand.translation, hand, atol=1e-3)
    assert arm.route_points().shape == robot.routes.points(arm.theta[None])[0].shape


def test_a_step_of_the_emulated_body_is_that_of_mujoco_with_the_users_file(tmp_path):
    dynamics = '<joint name="elbow" armature=".2" damping=".3" frictionloss=".1" '
    text = bodies.MJCF.replace('<joint name="elbow" ', dynamics)
    robot, rng = import_text(tmp_path, text), np.random.default_rng(0)
    models = [
        mujoco.MjModel.from_xml_path(str(tmp_path / 'own.xml')),
        mujoco_model.from_file(robot, model_of(robot)),
    ]
    for theta in 0.9 * robot.random_postures(5, rng):
        speed, torque = rng.normal(size=(2, models[0].nv))
        after = []
        for model in models:
            mujoco_model.set_options(model)
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
            data = mujoco.MjData(model)
            for name, q in zip(
                robot.kinematics.model.names[1:], robot.kinematics.tree.angles(theta)
            ):
                data.joint(name).qpos[:] = q
            data.qvel[:], data.qfrc_applied[:] = speed, torque
            mujoco.mj_step(model, data)
            after.append(data.qvel)
        np.testing.assert_allclose(after[1], after[0], rtol=1e-6, atol=1e-9)
        assert np.abs(after[0] - speed).max() > 1e-3


def test_a_touch_does_not_throw_a_finger_whose_centre_of_mass_is_on_its_axes(tmp_path):
    robot = import_text(tmp_path, bodies.TOUCHING)
    arm, rng = make_arm(robot, 1, str(model_of(robot)), deviates=True), np.random.default_rng(0)
    arm.set_payload(0.0)
    for tension in robot.tension.bias + rng.uniform(0.0, 40.0, (20, robot.muscle_count)):
        for _ in range(10):
            arm.command_tension(tension)
            arm.step(0.02)
            assert np.abs(arm.velocity).max() < 20.0


@pytest.mark.parametrize(
    ('old', 'new', 'base', 'root'),
    [
        ('', '', '', 'world'),
        ('', '', 'base', 'base_upright'),
        ('<worldbody>', '<option gravity="0 -9.81 0"/><worldbody>', '', 'world_upright'),
    ],
)
def test_a_users_mjcf_file_stands_at_the_root_of_the_robot(tmp_path, old, new, base, root):
    push = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    robot = import_text(tmp_path, bodies.MJCF.replace(old, new), base=base)
    assert robot.root_link == root
    arm = make_arm(robot, 0, str(model_of(robot)))
    theta = robot.random_postures(1, np.random.default_rng(0))[0]
    arm.reset(theta)
    hand = robot.kinematics.end_effector_pose(arm.theta)
    np.testing.assert_allclose(arm.hand.homogeneous, hand.homogeneous, atol=1e-6)
    points = robot.routes.points(theta[None])[0]
    np.testing.assert_allclose(arm.route_points(), points, atol=1e-6)
    arm.set_wrench(push)
    arm.step(0.001)
    applied = arm._data.qfrc_applied[arm._order]
    due = robot.kinematics.end_effector_jacobian(theta).T @ push
    np.testing.assert_allclose(applied[:2], due[:2], atol=0.01)  # the third joint is coupled


def test_actuator_settings_of_a_users_mjcf_file_do_not_act_on_the_modules(imported, tmp_path):
    file, robot = imported
    tendon = '<spatial name="front"'
    limits = 'ctrllimited="true" ctrlrange="0 1" forcelimited="true" forcerange="-2 2"'
    default = f'<default><general gear="7" dyntype="filter" biastype="affine" {limits}/></default>'
    off = '<option actuatorgroupdisable="0"><flag actuation="disable"/></option>'
    text = bodies.MJCF.replace('<worldbody>', f'{default}{off}<worldbody>')
    joint = '<joint name="lift"'
    text = text.replace(joint, f'{joint} actuatorfrclimited="true" actuatorfrcrange="-1 1"')
    text = text.replace(tendon, f'{tendon} actuatorfrclimited="true" actuatorfrcrange="0 1"')
    other = model_of(import_text(tmp_path, text, end='finger'))
    played = [
        drive(make_arm(robot, 0, str(each)))[:, : robot.joint_count] for each in (file, other)
    ]
    np.testing.assert_allclose(*played, atol=1e-9)


def changed(imported, tmp_path, old, new):
    """Return a copy of model.xml with a change of its text."""
    other, text = tmp_path / 'model.xml', imported[0].read_text()
    assert old in text
    other.write_text(text.replace(old, new, 1), encoding='utf-8')
    return str(other)


def test_the_emulated_arm_stops_at_the_limits_of_the_robot(imported, tmp_path):
    file, robot = changed(imported, tmp_path, 'range="-1.8 0.2"', 'range="-3 3"'), imported[1]
    arm = make_arm(robot, 0, file)
    arm.reset(robot.upper + [0.0, 0.0, 0.3])
    arm.step(1.0)
    assert robot.lower[2] - 0.02 < arm.theta[2] < robot.upper[2] + 0.02


PATH = '<site site="u1" />\n      <site site="l1" />'


@pytest.mark.parametrize(
    ('old', 'new', 'problem'),
    [
        ('name="swing"', 'name="swung"', "joint 'swing' is missing"),
        ('<site name="f1"', '<joint name="more" /><site name="f1"', "joint 'more' is not a joint"),
        ('name="lift"', 'type="slide" name="lift"', "joint 'lift' has another type"),
        ('<motor name="front"', '<motor name="ahead"', "motor 'front' is missing"),
        ('name="hand of the emulator"', 'name="hand"', "body 'hand of the emulator' is missing"),
        (PATH, f'<pulley divisor="4" />{PATH}', "'bend' typically differs by [0-9]+ mm"),
        ('<mujoco', '<mujoko', 'MuJoCo cannot load it'),
    ],
)
def test_a_model_that_is_not_that_of_the_robot_is_refused(imported, tmp_path, old, new, problem):
    other = changed(imported, tmp_path, old, new)
    with pytest.raises(MusculoskeletalError, match=problem) as error:
        make_arm(imported[1], 0, other)
    assert 'import the MuJoCo model again' in str(error.value) or 'cannot load' in problem


@pytest.mark.parametrize('tie', ['joint1="more" joint2="swing"'])
def test_joints_held_by_an_equality_stay_where_import_robot_holds_them(tmp_path, tie):
    text = bodies.MJCF
    axis = 'axis="1 0 0.2" range="-1 1" limited="true" pos="0 0.02 0" ref="0.1"'
    for name, place in {'more': '<joint name="elbow"', 'other': '<site name="l1"'}.items():
        text = text.replace(place, f'<joint name="{name}" {axis}/>{place}')
        tied = tie.replace('more', name)
        equality = f'<equality><joint {tied} polycoef="0.4 0.3 0.1 0 0"/>'
        text = text.replace('<equality>', equality)
    chain = {'joints': ['lift', 'elbow'], 'muscles': ['out', 'in', 'bend', 'stretch', 'curler']}
    robot = import_text(tmp_path, text, **chain)
    arm = make_arm(robot, 0, str(model_of(robot)))
    theta = robot.random_postures(5, np.random.default_rng(0))
    arm.reset(theta[0])
    hand = robot.kinematics.end_effector_pose(arm.theta)
    np.testing.assert_allclose(arm.hand.homogeneous, hand.homogeneous, atol=1e-6)
    lengths = robot.routes.absolute_lengths(theta)
    np.testing.assert_allclose(arm.individual.absolute_lengths(theta), lengths, atol=1e-6)


def test_a_ball_joint_becomes_the_three_hinges_that_it_is_imported_as(tmp_path):
    end = ' ref="0.2" limited="true"/>'
    first = '<joint name="swing" axis="0 1 0" range="-1 1.2" pos="0 0 0.01"'
    second = '<joint name="lift" axis="1 0.1 0" range="-0.6 0.6" limited="true"/>'
    text = bodies.MJCF.replace(f'{first}{end}', '<joint name="ball" type="ball" range="0 0.6"/>')
    robot = import_text(tmp_path, text.replace(second, ''))
    arm = make_arm(robot, 0, str(model_of(robot)))
    assert robot.joints == ('ball_x', 'ball_y', 'ball_z', 'elbow')
    theta = robot.random_postures(20, np.random.default_rng(0))
    lengths = arm.individual.absolute_lengths(theta)
    np.testing.assert_allclose(lengths, robot.routes.absolute_lengths(theta), atol=1e-9)


def test_a_ball_joint_does_not_get_the_default_range_of_other_joints(tmp_path):
    end = ' ref="0.2" limited="true"/>'
    first = '<joint name="swing" axis="0 1 0" range="-1 1.2" pos="0 0 0.01"'
    second = '<joint name="lift" axis="1 0.1 0" range="-0.6 0.6" limited="true"/>'
    text = bodies.MJCF.replace(f'{first}{end}', '<joint name="ball" type="ball" range="0 0.6"/>')
    default = '<default><joint range="-0.1 0.1"/></default><worldbody>'
    robot = import_text(tmp_path, text.replace(second, '').replace('<worldbody>', default))
    model = mujoco.MjModel.from_xml_path(str(model_of(robot)))
    hinges = [model.joint(name).id for name in ('ball_x', 'ball_y', 'ball_z')]
    assert not model.jnt_limited[hinges].any()


#: MJCF file for <include>, whose bodies and joints have no names
PART = """<mujoco><site name="o" pos=".05 0 1"/><site name="o2" pos="-.05 0 1"/>
  <body pos="0 0 1"><joint axis="0 1 0" range="-60 60"/><geom size=".02" fromto="0 0 0 0 0 -.2"
    type="capsule"/><site name="i" pos=".03 0 -.1"/><site name="i2" pos="-.03 0 -.1"/>
    <body pos="0 0 -.2"><joint axis="0 1 0" range="-60 60"/><geom size=".02"/></body></body>
</mujoco>"""
WHOLE = """<mujoco><worldbody><include file="part.xml"/></worldbody>
  <tendon><spatial {first}><site site="o"/><site site="i"/></spatial>
    <spatial {second}><site site="o2"/><site site="i2"/></spatial></tendon>
  <actuator>{actuators}</actuator></mujoco>"""
PULLS = '<motor tendon="a" ctrllimited="true" ctrlrange="-90 0"/>' * 2
PULLS += '<motor tendon="b" ctrllimited="true" ctrlrange="-70 0"/>'


@pytest.mark.parametrize(
    ('names', 'actuators', 'muscles', 'limit'),
    [
        (('', ''), '', ('tendon_0', 'tendon_1'), None),
        (('name="a"', 'name="b"'), PULLS, ('a', 'b'), [180.0, 70.0]),
    ],
    ids=['tendons without names', 'two actuators on a tendon'],
)
def test_a_model_without_names_in_several_files_is_imported_and_played(
    tmp_path, names, actuators, muscles, limit
):
    (tmp_path / 'part.xml').write_text(PART, encoding='utf-8')
    parts = dict(zip(('first', 'second'), names), actuators=actuators)
    robot = import_text(tmp_path, WHOLE.format(**parts))
    assert robot.joints == ('joint_0', 'joint_1')
    assert robot.muscles == muscles
    if limit is not None:
        np.testing.assert_allclose(robot.tension.limit, limit)
    arm = make_arm(robot, 0, str(model_of(robot)))
    arm.step(0.1)
    theta = robot.random_postures(3, np.random.default_rng(0))
    lengths = arm.individual.absolute_lengths(theta)
    np.testing.assert_allclose(lengths, robot.routes.absolute_lengths(theta), atol=1e-9)


def test_an_unknown_reality_is_refused_with_the_legal_ones(robot):
    with pytest.raises(MusculoskeletalError, match='kin, foreign or the model'):
        make_arm(robot, 0, 'dream')


#: MJCF template of an elbow with two tendons; the fields are filled by variants and faults
ELBOW = """<mujoco>{options}<worldbody>
  <site name="o" pos=".05 0 0"/><site name="o2" pos="-.05 0 0"/>
  <body name="mount" pos="0 0 1">{held}<geom name="g1" size=".02"/>
    <body name="arm"><joint name="elbow" {anchor}axis="0 1 0" range="-60 60"/>
      <geom type="capsule" size=".02 .1" pos="0 0 -.1"/>
      <site name="i" pos=".03 0 -.1"/><site name="i2" pos="-.03 0 -.1"/>
      <body {hand}pos="0 0 -.2"><geom size=".02"/></body></body></body>
  <body name="beside" pos="0 0 1.01"><geom name="g2" size=".02"/></body></worldbody>
  <contact><pair geom1="g1" geom2="g2"/></contact>
  <tendon><spatial name="front"><site site="o"/><site site="i"/></spatial>
    <spatial name="back"><site site="o2"/><site site="i2"/></spatial></tendon></mujoco>"""
AS_IT_IS = {'options': '', 'held': '', 'anchor': '', 'hand': 'name="hand" '}
HINGE = '<joint name="held" axis="1 0 0" range="-60 60"/>'


@pytest.mark.parametrize(
    'change',
    [
        {'options': '<compiler fusestatic="true"/>'},
        {'options': '<compiler fusestatic="true"/>', 'hand': ''},
        {'hand': ''},
        {'held': HINGE},  # a joint that the import leaves out, so that its body is fixed
        {'anchor': 'pos="0 0 .03" ', 'hand': ''},  # a joint beside the origin of its body
    ],
)
def test_an_mjcf_file_has_the_lengths_of_the_robot_imported_from_it(tmp_path, change):
    robot = import_text(tmp_path, ELBOW.format(**AS_IT_IS | change), joints=['elbow'])
    arm = make_arm(robot, 0, str(model_of(robot)))
    arm.step(0.1)
    theta = np.array([[0.3]])
    lengths = arm.individual.absolute_lengths(theta)
    np.testing.assert_allclose(lengths, robot.routes.absolute_lengths(theta), atol=1e-9)
