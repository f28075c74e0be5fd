# SPDX-License-Identifier: Apache-2.0
"""Import of every format: equal lengths, chains that are cut out, and damaged files."""

import os
import re
from contextlib import suppress
from pathlib import Path

import bodies
import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.importing import convert
from musculoskeletal_ae.importing.convert import import_robot, read_source
from musculoskeletal_ae.importing.source import compare, cut, urdf
from musculoskeletal_ae.robot.description import TENSION_DEFAULT
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.import_robot import main

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'two_joint_arm.xml'
PULLEY = '<pulley divisor="2"/>'
BRANCH = f'{PULLEY}<site site="u2"/><site site="l2"/>{PULLEY}<site site="o3"/>'


def put(directory, name, text):
    directory.mkdir(exist_ok=True)
    (directory / name).write_text(text, encoding='utf-8')
    return directory / name


def comparison_of(imported):
    return compare(imported.source, imported.robot)


@pytest.fixture
def mjcf(tmp_path):
    return put(tmp_path, 'own.xml', bodies.MJCF)


@pytest.fixture
def cardsflow(tmp_path):
    put(tmp_path, 'model.urdf', bodies.URDF.format(mimic=''))
    return put(tmp_path, 'cardsflow.xml', bodies.CARDSFLOW)


def test_a_mujoco_model_keeps_its_lengths(mjcf, tmp_path):
    result = import_robot(mjcf, tmp_path / 'out')
    assert result.robot.joints == ('swing', 'lift', 'elbow')
    assert max(comparison_of(result).lengths.values()) < 1e-6
    assert len(result.robot.routes.wrapping) == 4
    assert result.robot.description.couplings['curl'].terms[1] == pytest.approx(0.5)
    assert result.robot.tension.limit[0] == pytest.approx(180.0)
    assert 'dropped: tendon none: it is a fixed tendon, which has no route' in result.source.notes
    assert 'dropped: actuator not: it does not act on a tendon' in result.source.notes


def test_the_example_model_imports_exactly_and_is_sound(tmp_path):
    result = import_robot(EXAMPLE, tmp_path / 'out')
    assert result.robot.joints == ('shoulder', 'elbow')
    assert len(result.robot.muscles) == 4
    assert not [note for note in result.source.notes if note.startswith('dropped')]
    lengths, _, flips = comparison_of(result)
    assert max(lengths.values()) < 1e-6
    assert not any(flips.values())
    check = check_robot(result.robot)
    assert not check.faults
    assert not check.warnings


CURVE = '0.1 0.5 0.1 -0.05 0.02'


@pytest.mark.parametrize(
    ('old', 'new'),
    [
        ('0.1 0.5 0 0 0', CURVE),
        ('<site site="o3"/>', BRANCH),
        ('sidesite="side"', 'sidesite="o2"'),
        ('sidesite="side"', 'sidesite="l1"'),
    ],
    ids=['polynomial', 'pulleys', 'side above', 'side below'],
)
def test_all_quantities_that_mujoco_uses_are_imported(mjcf, tmp_path, old, new):
    assert old in mjcf.read_text()
    mjcf.write_text(mjcf.read_text().replace(old, new))
    lengths, arms, flips = comparison_of(import_robot(mjcf, tmp_path / 'out'))
    assert max(lengths.values()) < 1e-6
    assert max(arms.values()) < 1e-5
    assert not any(flips.values())


def test_a_point_on_the_rim_of_a_wrapped_object_counts_as_outside_it(mjcf, tmp_path):
    """In MuJoCo, rounding decides whether the point is inside, differently in each posture."""
    drum = (
        '<geom name="pulley" type="cylinder" size="0.03" fromto="0 -0.02 0 0 0.02 0" mass="0.01"/>'
    )
    site = '<site name="rim" pos="0.018 0 -0.024"/>'  # 30 mm from the axis, which is the radius
    text = mjcf.read_text().replace('<site name="l1"', f'{drum}{site}<site name="l1"')
    route = '<site site="u1"/><geom geom="pulley"/><site site="rim"/>'
    text = text.replace('<site site="u1"/><site site="l1"/>', route)
    assert 'pulley' in text
    mjcf.write_text(text)
    result = import_robot(mjcf, tmp_path / 'out')
    site = 'muscle bend: a site on the rim of an object on lower counts as outside the object'
    assert f'chosen: {site}; in MuJoCo, rounding errors decide this' in result.source.notes
    assert max(comparison_of(result).lengths.values()) < 1e-6
    m, robot = result.robot.muscles.index('bend'), result.robot
    theta = np.zeros((400, 3))
    theta[:, 2] = np.linspace(robot.lower[2], robot.upper[2], 400)
    arms = robot.routes.muscle_jacobian(theta)[:, m, 2]
    assert np.abs(np.diff(arms)).max() < 1e-3


def test_the_report_judges_moment_arms_and_their_signs(mjcf, tmp_path, capsys):
    assert main([str(mjcf), '--out', str(tmp_path / 'right')]) == 0
    verdict = 'largest moment arm error over 200 postures: 0.000 mm; all signs agree'
    assert verdict in capsys.readouterr().out
    wrong = convert.Comparison({'bend': 0.3}, {'bend': 0.04}, {'bend': 0.1})
    verdict = 'largest moment arm error over 200 postures: 40.000 mm; worst [mm]: bend 40.00; '
    assert convert.arm_verdict(wrong) == f'{verdict}wrong sign: bend in 10 % of postures'


def test_the_hand_is_the_tip_of_the_last_geometry_or_a_site(mjcf, tmp_path, capsys):
    result = import_robot(mjcf, tmp_path / 'tip')
    assert result.robot.description.end_effector == 'finger_tip'
    theta = np.array([0.2, 0.0, -0.5])
    pose, tip = (result.robot.kinematics.link_pose(theta, n) for n in ('finger', 'finger_tip'))
    np.testing.assert_allclose(pose.actInv(tip.translation), [0.0, 0.0, -0.06], atol=1e-9)
    (chosen,) = [note for note in result.source.notes if 'end effector' in note]
    assert chosen.startswith(
        'chosen: end effector finger_tip (choose another with --end; others: finger, f2, hole, f1)'
    )
    import_robot(mjcf, tmp_path / 'site', end='f1')
    assert Robot.load(tmp_path / 'site').description.end_effector == 'f1'
    assert main([str(mjcf), '--out', str(tmp_path / 'none'), '--end', 'thumb']) == 1
    assert '--end: unknown link or point' in capsys.readouterr().err


def test_muscles_are_left_out_by_name(mjcf, tmp_path):
    result = import_robot(mjcf, tmp_path / 'out', without=['front', 'back'])
    assert result.robot.muscles == ('out', 'in', 'bend', 'stretch', 'curler')


@pytest.mark.parametrize('names', [('a', 'b'), ('b', 'a')])
def test_the_end_effector_is_the_tip_of_the_chain_whatever_its_name(mjcf, tmp_path, names):
    inner, tip = (f'<body name="{name}" pos="0 0 -0.05">' for name in names)
    beside = '<body name="zz" pos="0.01 0 0"/>'
    more = f'{inner}{tip}</body></body>{beside}<site name="hole"'
    mjcf.write_text(mjcf.read_text().replace('<site name="hole"', more))
    out = tmp_path / 'out'
    notes = import_robot(mjcf, out).source.notes
    assert any(note.startswith(f'chosen: end effector {names[1]} ') for note in notes)
    assert f'\nend_effector: {names[1]}\n' in (out / 'muscles.yaml').read_text()
    assert Robot.load(out).description.end_effector == names[1]


RANGE = 'tendon="out" ctrllimited="true" ctrlrange='
FORCES = 'forcelimited="true" forcerange="-100 500"'


@pytest.mark.parametrize(
    ('actuators', 'limit'),
    [
        (f'<motor gear="-2" {RANGE}"-50 100"/>', 200.0),
        (f'<motor {RANGE}"-250 0"/><motor gear="-1" {RANGE}"0 100"/>', 350.0),
        (f'<muscle tendon="out" force="150" {FORCES}/>', 100.0),
        (f'<position kp="100" {RANGE}"0 0.1"/>', 18.1),  # kp × the largest position error, 0.181 m
        (f'<motor {RANGE}"0 250"/>', None),
    ],
)
def test_only_actuators_that_pull_contribute_strength(mjcf, tmp_path, actuators, limit):
    muscle = '<muscle name="m3" tendon="out" force="150"/>'
    mjcf.write_text(mjcf.read_text().replace(muscle, actuators))
    result = import_robot(mjcf, tmp_path / 'out')
    actual = result.robot.tension.limit[result.robot.muscles.index('out')]
    assert actual == pytest.approx(limit or TENSION_DEFAULT['limit'], rel=0.01)
    assert any('it can only push' in note for note in result.source.notes) == (limit is None)


def test_a_limit_is_never_above_what_the_tendon_is_allowed_to_pull(mjcf, tmp_path):
    ranged = 'actuatorfrclimited="true" actuatorfrcrange="-80 0" armature="0.01" name="out"'
    mjcf.write_text(mjcf.read_text().replace('name="out"', ranged))
    result = import_robot(mjcf, tmp_path / 'out')
    assert result.robot.tension.limit[result.robot.muscles.index('out')] == pytest.approx(80.0)
    assert 'only in model.xml: armature: tendon out' in result.source.notes


def test_muscles_have_the_tensions_that_the_model_asks_for_and_tendons_hardly_stretch(
    mjcf, tmp_path
):
    muscle = '<muscle name="m3" tendon="out" force="150"/>'
    always = f'<motor {RANGE}"-200 -25"/>'
    mjcf.write_text(mjcf.read_text().replace(muscle, always))
    result = import_robot(mjcf, tmp_path / 'out')
    robot, out = result.robot, result.robot.muscles.index('out')
    assert robot.tension.bias[out] == pytest.approx(25.0)
    assert robot.tension.bias[0] == pytest.approx(0.01 * robot.tension.limit[0])
    limit = robot.tension.limit
    stretch = robot.series_elastic.elongation(robot.routes.length_at_zero, limit)
    assert np.all(stretch < 1.8e-5 * limit + 4e-4)
    for constant in ('tension.limit', 'series_elastic', 'stiffness'):
        assert any(note.startswith(f'chosen: {constant}') for note in result.source.notes)


def test_a_joint_that_a_spring_takes_past_its_muscles_keeps_the_range_that_they_can_hold(tmp_path):
    result = import_robot(put(tmp_path, 'snap.xml', bodies.SNAPPING), tmp_path / 'out')
    note = [note for note in result.source.notes if note.startswith('chosen: limits of joint mcp')]
    assert 'instead of 0 to 1.5' in note[0]
    assert result.robot.lower[0] == 0.0
    # At 0.927 rad, the flexor passes over the axis.
    assert 0.2 < result.robot.upper[0] < 0.927
    assert check_robot(result.robot).held.mean() > 0.95


def test_mujoco_decides_what_it_reads(mjcf, tmp_path):
    """MuJoCo accepts XML in which the space between two attributes is missing.

    One file of MyoHub contains this error.
    """
    expected = import_robot(mjcf, tmp_path / 'sound')
    mjcf.write_text('<!-- own -->\n' + mjcf.read_text().replace('ball" type=', 'ball"type='))
    result = import_robot(mjcf, tmp_path / 'loose')
    assert result.robot.muscles == expected.robot.muscles
    other = put(tmp_path, 'other.xml', '<robot name="a"type="b"/>')
    with pytest.raises(MusculoskeletalError, match='not valid XML'):
        import_robot(other, tmp_path / 'other')


def test_what_is_included_must_be_a_regular_file(mjcf, tmp_path):
    os.mkfifo(tmp_path / 'more.xml')
    mjcf.write_text(
        mjcf.read_text().replace('<worldbody>', '<include file="more.xml"/><worldbody>')
    )
    with pytest.raises(MusculoskeletalError, match=r"'more.xml' is not a regular file"):
        import_robot(mjcf, tmp_path / 'out')


def test_forces_that_only_the_emulated_arm_has_are_reported(mjcf, tmp_path):
    joint = '<joint name="elbow" damping="5" frictionloss="2" stiffness="2" armature="1" '
    tendon = 'limited="true" range="0 9" damping="1" frictionloss="2" stiffness="3" name="out"'
    text = mjcf.read_text().replace('<joint name="elbow" ', joint, 1)
    mjcf.write_text(
        text.replace('name="out"', tendon).replace('name="upper"', 'name="upper" gravcomp="1"')
    )
    notes = import_robot(mjcf, tmp_path / 'out').source.notes
    for effect in ('friction', 'armature'):
        assert f'only in model.xml: {effect}: joint elbow' in notes
    for effect in ('friction', 'limits'):
        assert f'only in model.xml: {effect}: tendon out' in notes
    assert 'only in model.xml: compensated weight: body upper' in notes
    assert any(re.match(r'only in model.xml: contacts: \d+ geoms', note) for note in notes)


def test_names_that_clash_here_lose_nothing(mjcf, tmp_path):
    text = mjcf.read_text()
    for old, new in {
        'front': 'a/b', 'back': 'a b', 'swing': 'to_base', 'lift': 'universe',
        'finger': 'swing_link', 'upper': 'elbow',
    }.items():  # fmt: skip
        text = text.replace(f'"{old}"', f'"{new}"')
    mjcf.write_text(text)
    result = import_robot(mjcf, tmp_path / 'out')
    assert result.robot.muscles == ('a_b', 'a_b_', 'out', 'in', 'bend', 'stretch', 'curler')
    assert result.robot.joints == ('to_base', 'universe_', 'elbow')
    assert 'renamed: tendon a b is a_b_ here' in result.source.notes
    assert max(comparison_of(result).lengths.values()) < 1e-6


@pytest.mark.parametrize('turn', ['0', '3'])
def test_a_side_site_on_the_axis_has_the_same_effect_as_in_mujoco(mjcf, tmp_path, turn):
    text = mjcf.read_text().replace('euler="1.57 0 0.1"', f'euler="0 0 {turn}"')
    mjcf.write_text(text.replace('pos="-0.06 0 -0.3"', 'pos="0 0 -0.5"'))
    assert max(comparison_of(import_robot(mjcf, tmp_path / 'out')).lengths.values()) < 1e-6


COUPLED = '<joint joint1="curl" joint2="elbow"/><joint joint1="elbow" joint2="curl"/>'


@pytest.mark.parametrize(
    ('old', 'new', 'expected'),
    [
        (
            '<equality>',
            f'<equality>{COUPLED}',
            'equality equality_1: joint elbow is coupled already',
        ),
        (
            '<worldbody>',
            '<option gravity="0 0 -1.6"/><worldbody>',
            'gravity: 9.81 m/s², although the source',
        ),
        ('<site name="o1"', '<site user="nan" name="o1"', 'MuJoCo warns: XML contains a'),
        ('force="150"', 'force="0"', 'tension of 1 muscles: the default'),
        ('force="50"', 'force="0.004"', 'tension.limit is the largest tension in the source'),
    ],
)
def test_what_differs_from_the_source_is_reported(mjcf, tmp_path, monkeypatch, old, new, expected):
    monkeypatch.chdir(tmp_path)
    mjcf.write_text(mjcf.read_text().replace(old, new, 1))
    assert any(expected in note for note in import_robot(mjcf, tmp_path / 'out').source.notes)
    assert not (tmp_path / 'MUJOCO_LOG.TXT').exists()


def test_cardsflow_points_are_measured_from_the_centre_of_mass(cardsflow, tmp_path):
    result = import_robot(cardsflow, tmp_path / 'out')
    assert result.robot.muscles == ('front', 'back')
    point = result.robot.description.routes[0][0]
    np.testing.assert_allclose(point.xyz, [0.05, 0.01, 0.2])
    # The source computes no lengths of muscles that wrap, so only the straight one is compared.
    assert comparison_of(result).lengths == pytest.approx({'front': 0.0}, abs=1e-9)
    assert any('muscle still: it moves no joint' in note for note in result.source.notes)


def test_a_cardsflow_cylinder_has_the_axis_z_of_its_link(cardsflow, tmp_path):
    cardsflow.write_text(bodies.CARDSFLOW.replace('SPHERICAL', 'CYLINDRICAL'))
    _, wrap, _ = import_robot(cardsflow, tmp_path / 'out').robot.description.routes[1]
    np.testing.assert_allclose(wrap.axis, [0.0, 0.0, 1.0], atol=1e-9)


def test_an_sdf_is_the_same_arm_as_its_urdf(cardsflow, tmp_path):
    text = re.sub(r' rpy="[^"]*"', '', (tmp_path / 'model.urdf').read_text())
    endless = text.replace('lower="-1" upper="1"', 'lower="-1e16" upper="1e16"', 1)
    put(tmp_path, 'model.urdf', endless.replace('0.01 0 -0.15', '0 0 -0.1'))
    first = import_robot(cardsflow, tmp_path / 'two', end='arm').robot
    (tmp_path / 'model.urdf').unlink()
    put(tmp_path, 'model.sdf', bodies.SDF.replace('<lower>-1', '<lower>-1e16'))
    second = import_robot(cardsflow, tmp_path / 'three').robot
    assert second.joints == first.joints == ('shoulder',)
    assert second.lower == first.lower == pytest.approx(-np.pi)
    theta = np.linspace(-1.0, 1.0, 9)[:, None]
    expected = first.routes.absolute_lengths(theta)
    np.testing.assert_allclose(second.routes.absolute_lengths(theta), expected, atol=1e-9)


def test_cardsflow_muscles_with_the_same_name_are_distinguished(cardsflow, tmp_path):
    cardsflow.write_text(bodies.CARDSFLOW.replace('"back"', '"front"'))
    result = import_robot(cardsflow, tmp_path / 'out')
    assert result.robot.muscles == ('front', 'front_')
    assert 'renamed: muscle front is front_ here' in result.source.notes


def test_cardsflow_wraps_that_stand_between_no_points_are_left_out(cardsflow, tmp_path):
    wrap = '<viaPoint type="SPHERICAL" radius="0.02">0 -0.01 0.1</viaPoint>'
    text = bodies.CARDSFLOW.replace('<viaPoint type', f'{wrap}<viaPoint type')
    cardsflow.write_text(text.replace('</viaPoint></link></myo', f'</viaPoint>{wrap}</link></myo'))
    result = import_robot(cardsflow, tmp_path / 'out')
    assert (result.robot.muscles, comparison_of(result)) == (('front', 'back'), ({}, {}, {}))
    assert (
        'dropped: last wrap of the route of front, because no fixed point follows it'
        in result.source.notes
    )
    assert (
        'dropped: SPHERICAL via point in the route of front, because no fixed point directly '
        'precedes it' in result.source.notes
    )
    with pytest.raises(
        MusculoskeletalError, match=r'no muscle remains; dropped: muscle still: .*joint$'
    ):
        import_robot(cardsflow, tmp_path / 'none', without=('front', 'back'))
    cardsflow.write_text('<cardsflow/>')
    with pytest.raises(MusculoskeletalError, match=r'has no muscle with a route$'):
        read_source(cardsflow)


def test_a_model_without_routes_is_refused_with_the_dropped_muscles(tmp_path):
    text = re.sub('<spatial .*?</spatial>', '', bodies.MJCF, flags=re.DOTALL)
    file = put(tmp_path, 'own.xml', re.sub('<muscle [^>]*>', '', text))
    with pytest.raises(
        MusculoskeletalError, match=r'no muscle with a route; .*tendon none: it is a fixed'
    ):
        read_source(file)


def test_a_model_without_tendons_is_refused_because_it_has_none(tmp_path):
    file = put(tmp_path, 'none.xml', '<mujoco><worldbody><body><joint/><geom size=".1"/></body>'
               '</worldbody></mujoco>')  # fmt: skip
    with pytest.raises(MusculoskeletalError, match='it has no tendon'):
        read_source(file)


def test_sizes_of_included_files_do_not_prevent_the_import(tmp_path):
    put(tmp_path, 'part.xml', '<mujoco><size njmax="500" nconmax="200"/></mujoco>')
    sized = '<include file="part.xml"/><size memory="2M"/><worldbody>'
    file = put(tmp_path, 'whole.xml', LINKS.replace('<worldbody>', sized, 1))
    put(tmp_path / 'parts', 'tip.obj', TIP)
    assert import_robot(file, tmp_path / 'out').robot.muscles == ('out', 'in')


def wires_and_weight(tmp_path, name, text):
    """Return the muscle lengths of an imported SDF (N, M), and its holding torques (N, D)."""
    put(tmp_path, 'model.sdf', text)
    robot = import_robot(tmp_path / 'cardsflow.xml', tmp_path / name).robot
    theta = np.linspace(-1.0, 1.0, 5)[:, None]
    return robot.routes.absolute_lengths(theta), robot.kinematics.holding_torque(theta)


def same_arm(tmp_path, first, second):
    (tmp_path / 'model.urdf').unlink()
    one, other = wires_and_weight(tmp_path, 'a', first), wires_and_weight(tmp_path, 'b', second)
    return all(np.allclose(*pair, atol=1e-9) for pair in zip(one, other))


@pytest.mark.usefixtures('cardsflow')
def test_the_pose_of_an_sdf_s_model_is_one_of_all_its_links(tmp_path):
    lift, at = '0 0 0.5 0.4 0 0', np.array([0.0, -np.sin(0.4), np.cos(0.4)]) * 0.1
    arm = f'0 {at[1]} {0.5 + at[2]} 0.4 0 0'
    posed = bodies.SDF.replace('name="own">', f'name="own"><pose>{lift}</pose>')
    links = bodies.SDF.replace('<pose>0 0 0 0 0 0', f'<pose>{lift}', 1)
    assert same_arm(tmp_path, posed, links.replace('<pose>0 0 0.1 0 0 0', f'<pose>{arm}', 1))


@pytest.mark.usefixtures('cardsflow')
def test_before_version_1_5_of_sdf_an_axis_stood_in_the_model_s_frame(tmp_path):
    turned = '<pose>0 0 0.1 0 0 0.5</pose>\n    <axis>'
    early = bodies.SDF.replace('<pose>0 0 0.1 0 0 0</pose>\n    <axis>', turned)
    assert early != bodies.SDF
    assert same_arm(tmp_path, early.replace('"1.6"', '"1.4"'), bodies.SDF)


def test_points_of_the_world_stay_where_they_are_if_the_root_link_stands_elsewhere(
    cardsflow, tmp_path
):
    (tmp_path / 'model.urdf').unlink()
    cardsflow.write_text(
        bodies.CARDSFLOW.replace('"base"><viaPoint type', '"world"><viaPoint type')
    )
    text = bodies.SDF.replace('<pose>0 0 0 0 0 0', '<pose>0 0 0.5 0 0 0')
    put(tmp_path, 'model.sdf', text)
    (point, *_), *_ = import_robot(cardsflow, tmp_path / 'out').robot.description.routes
    np.testing.assert_allclose(point.xyz, [0.05, 0.0, -0.4])


def test_a_limit_with_one_end_is_none_and_a_joint_of_the_root_link_is_reported(cardsflow, tmp_path):
    (tmp_path / 'model.urdf').unlink()
    turntable = '<joint name="t" type="revolute"><parent>world</parent><child>base</child></joint>'
    text = bodies.SDF.replace('<lower>-1</lower>', '').replace('</model>', f'{turntable}</model>')
    put(tmp_path, 'model.sdf', text)
    result = import_robot(cardsflow, tmp_path / 'out')
    assert result.robot.lower == pytest.approx(-np.pi)
    assert 'held fixed: joint t (revolute), which carries the root link' in result.source.notes


LIMITS = 'shoulder: [0.3, -0.2, -0.7, 0.9]\nwrist: [[0.1, -0.1], [0.0, 0.2]]\nneck: [-1, 1]\n'


def test_cardsflow_limits_beside_the_model_are_read(cardsflow, tmp_path):
    put(tmp_path, 'joint_limits.yaml', LIMITS)
    result = import_robot(cardsflow, tmp_path / 'out')
    assert result.robot.lower == pytest.approx([-0.7, -0.1])
    assert result.robot.upper == pytest.approx([0.9, 0.2])
    assert 'chosen: limits of joints from joint_limits.yaml: shoulder, wrist' in result.source.notes
    assert 'dropped: limits of unknown joints in joint_limits.yaml: neck' in result.source.notes


@pytest.mark.parametrize(
    'text', ['shoulder: [1, 1]', 'shoulder: [.nan, 1]', 'shoulder: x', '[1]', 'a: {b: 1}']
)
def test_cardsflow_limits_that_are_none_are_refused(cardsflow, tmp_path, text):
    put(tmp_path, 'joint_limits.yaml', text)
    with pytest.raises(
        MusculoskeletalError, match=r'joint_limits\.yaml: .*expected a list of at least 2'
    ):
        read_source(cardsflow)


def test_missing_limits_are_named_with_the_remedy(cardsflow, tmp_path):
    text = (tmp_path / 'model.urdf').read_text().replace('lower="-1" upper="1"', '', 1)
    put(tmp_path, 'model.urdf', text)
    notes = import_robot(cardsflow, tmp_path / 'out').source.notes
    expected = (
        'chosen: joint shoulder: limits ±3.142, because the source has no range; give it a range in'
    )
    assert f'{expected} joint_limits.yaml' in notes


def test_an_import_that_is_interrupted_leaves_nothing(mjcf, tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Robot, 'load', interrupted)
    with pytest.raises(KeyboardInterrupt):
        import_robot(mjcf, tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    ('old', 'new', 'expected'),
    [
        ('<pose>0 0 0.1', '<pose relative_to="base">0 0 0.1', 'only SDF 1.6 is supported'),
        ('type="revolute"', 'type="ball"', 'remains; held fixed: joint shoulder: its type ball'),
        ('<joint', '<link name="arm"/><joint', "link 'arm' is listed twice; expected unique names"),
        ('</model>', '<model name="palm"/></model>', 'expected a single <model>'),
    ],
)
def test_an_sdf_that_would_be_read_wrongly_is_refused(cardsflow, tmp_path, old, new, expected):
    (tmp_path / 'model.urdf').unlink()
    put(tmp_path, 'model.sdf', bodies.SDF.replace(old, new, 1))
    with pytest.raises(MusculoskeletalError, match=re.escape(expected)):
        import_robot(cardsflow, tmp_path / 'out')


def test_a_urdf_becomes_a_skeleton_and_its_mimic_a_coupling(tmp_path, capsys):
    mimic = '<mimic joint="shoulder" multiplier="-0.5" offset="0.1"/>'
    file = put(tmp_path, 'arm.urdf', bodies.URDF.format(mimic=mimic))
    assert main([str(file), '--out', str(tmp_path / 'out')]) == 0
    assert 'wrist = -0.5 · shoulder +0.1' in capsys.readouterr().out
    robot = Robot.load(tmp_path / 'out')
    assert robot.joints == ('shoulder',)
    assert robot.description.couplings['wrist'] == ('shoulder', (0.1, -0.5))
    assert robot.muscles == ('muscle_of_shoulder', 'muscle_of_wrist')
    put(tmp_path, 'arm.urdf', bodies.URDF.format(mimic='<mimic joint="moon"/>'))
    with pytest.raises(
        MusculoskeletalError, match="a joint mimics 'moon', but there is no such joint"
    ):
        read_source(file)


def test_an_opensim_model_is_refused_with_the_way_to_convert_it(tmp_path):
    # Tags such as <A::B/> occur in files of OpenSim, although they are not valid XML.
    text = '<?xml version="1.0"?><OpenSimDocument Version="40000"><A::B/></OpenSimDocument>'
    with pytest.raises(MusculoskeletalError, match='convert this model to MJCF with MyoConverter'):
        read_source(put(tmp_path, 'own.osim', text))


def test_a_chain_is_cut_out_and_what_is_held_is_named(mjcf, tmp_path, capsys):
    out = tmp_path / 'out'
    options = ['--base', 'upper', '--end', 'lower', '--out', str(out)]
    assert main([str(mjcf), *options]) == 0
    robot, output = Robot.load(out), capsys.readouterr().out
    assert (robot.root_link, robot.description.end_effector) == ('upper_upright', 'lower')
    assert robot.joints == ('elbow',)
    assert set(robot.muscles) == {'bend', 'stretch', 'curler'}
    assert 'dropped: muscle front: attached to base, which is left out' in output
    assert 'largest length error over 1000 postures: 0.000 mm' in output
    assert 'check_robot: no faults' in output


def test_a_floating_base_is_held_and_named_unless_it_is_asked_for(mjcf, tmp_path):
    base = '<body name="base" pos="0 0.1 1" euler="0.2 0 0.1">'
    slide = '<joint name="root_z" type="slide" axis="0 0 1" range="-1 1" limited="true"/>'
    mjcf.write_text(mjcf.read_text().replace(base, f'{base}{slide}'))
    result = import_robot(mjcf, tmp_path / 'held')
    assert result.robot.joints == ('swing', 'lift', 'elbow')
    (note,) = [note for note in result.source.notes if 'root_z' in note]
    assert re.match(r'held fixed: joint root_z at 0, because .* no muscle moves it', note)
    joints = 'root_z', 'swing', 'lift', 'elbow'
    assert import_robot(mjcf, tmp_path / 'kept', joints=joints).robot.joints == joints


def test_weight_pulls_in_the_same_direction_on_a_chain_that_was_cut_out(mjcf, tmp_path):
    whole = import_robot(mjcf, tmp_path / 'whole').robot
    part = import_robot(mjcf, tmp_path / 'part', base='upper').robot
    rest = np.array([0.2, 0.0])  # angles in the MJCF file of the joints that the part leaves out
    for elbow in (-1.0, 0.1):
        torque = whole.kinematics.holding_torque(np.append(rest, elbow))[2]
        np.testing.assert_allclose(part.kinematics.holding_torque(np.array([elbow])), torque)


def test_joints_that_are_left_out_stand_where_the_source_rests_them(mjcf, tmp_path):
    result = import_robot(mjcf, tmp_path / 'out', joints=['elbow'], muscles=['bend', 'stretch'])
    assert result.robot.joints == ('elbow',)
    assert 'held fixed: joint swing at 0.2' in result.source.notes
    assert max(comparison_of(result).lengths.values()) < 1e-6


@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        ({'joints': ['knee']}, "--joints: unknown joint 'knee'; joints: swing, lift, elbow"),
        ({'muscles': ['psoas']}, "--muscles: unknown muscle 'psoas'"),
        ({'base': 'lower', 'end': 'upper'}, "does not descend from --base 'lower'"),
    ],
)
def test_a_wrong_option_names_what_is_legal(mjcf, options, expected):
    with pytest.raises(MusculoskeletalError, match=re.escape(expected)):
        cut(read_source(mjcf), **options)


def test_a_directory_in_use_and_a_foreign_file_are_refused(mjcf, tmp_path, capsys):
    assert main([str(mjcf), '--out', str(tmp_path)]) == 1
    (tmp_path / 'link').symlink_to('/nowhere')
    assert main([str(mjcf), '--out', str(tmp_path / 'link')]) == 1
    assert capsys.readouterr().err.count('expected a new or empty directory') == 2
    other = put(tmp_path, 'other.xml', '<html/>')
    assert main([str(other), '--out', str(tmp_path / 'out')]) == 1
    assert 'is unknown; legal: mujoco, cardsflow' in capsys.readouterr().err
    xacro = '<robot xmlns:x="http://www.ros.org/wiki/xacro"><x:arg name="side"/></robot>'
    assert main([str(put(tmp_path, 'arm.xacro', xacro)), '--out', str(tmp_path / 'out')]) == 1
    assert 'expand it to a new file first:  xacro FILE' in capsys.readouterr().err
    bomb = '<!DOCTYPE x [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><mujoco>&b;</mujoco>'
    assert main([str(put(tmp_path, 'bomb.xml', bomb)), '--out', str(tmp_path / 'out')]) == 1
    assert 'no DOCTYPE is allowed' in capsys.readouterr().err


@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(st.sampled_from(['CARDSFLOW', 'URDF', 'SDF']), st.data())
def test_a_damaged_file_is_refused_or_read_but_nothing_else(tmp_path_factory, format_, data):
    """The test replaces or omits words of a file, and removes elements."""
    text = getattr(bodies, format_).format(mimic='<mimic joint="shoulder" multiplier="2"/>')
    words = re.split(r'(?<=[ >"])|(?=[<"])', text)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(words) - 1))
        legal = ['', '1e999', 'nan', '-1', 'x', '<a/>', '0', words[place] * 2]
        words[place] = data.draw(st.sampled_from(legal))
    folder = tmp_path_factory.mktemp('damaged')
    file = put(folder, 'cardsflow.xml', bodies.CARDSFLOW)
    if format_ == 'CARDSFLOW':
        put(folder, 'model.urdf', bodies.URDF.format(mimic=''))
    names = {'CARDSFLOW': file.name, 'URDF': 'model.urdf', 'SDF': 'model.sdf'}
    put(folder, names[format_], ''.join(words))
    with suppress(MusculoskeletalError):
        source = read_source(file)
        cut(source)
        assert urdf(source)


#: a palm and a finger, whose capsules overlap; MuJoCo excludes contacts of parent and child
LINKS = """<mujoco><compiler meshdir="parts"/><asset><mesh name="tip" file="tip.obj"/></asset>
  <worldbody><body name="palm"><joint name="wrist" axis="0 1 0" range="-30 30"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".05"/>
    <site name="a" pos=".06 0 -.2"/><site name="b" pos="-.06 0 -.2"/>
    <body name="finger" pos="0 0 -.3"><joint name="knuckle" axis="0 1 0" range="-45 45"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".05"/>
      <site name="c" pos=".06 0 -.1"/><site name="d" pos="-.06 0 -.1"/>
      <body name="nail" pos="0 0 -.2"><joint name="last" axis="0 1 0" range="-9 9"/>
        <geom type="mesh" mesh="tip"/><geom size=".05" pos="0 0 .2"/></body></body></body>
  </worldbody>
  <tendon><spatial name="out"><site site="a"/><site site="c"/></spatial>
    <spatial name="in"><site site="b"/><site site="d"/></spatial></tendon></mujoco>"""
TIP = 'v 0 0 0\nv .01 0 0\nv 0 .01 0\nv 0 0 .01\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n'


@pytest.mark.parametrize('joints', [('wrist', 'knuckle', 'last'), ('knuckle',)])
def test_the_model_beside_the_robot_keeps_contacts_and_meshes(tmp_path, monkeypatch, joints):
    put(tmp_path / 'parts', 'tip.obj', TIP)
    file = put(tmp_path, 'links.xml', LINKS)
    monkeypatch.chdir(tmp_path)
    import_robot(Path('links.xml'), tmp_path / 'out', joints=joints)
    monkeypatch.chdir('/')
    whole = mujoco.MjModel.from_xml_path(str(file))
    adapted = mujoco.MjModel.from_xml_path(str(tmp_path / 'out' / 'model.xml'))
    assert adapted.njnt == len(joints)
    assert adapted.nmesh == 1

    def touching(model):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return {
            frozenset(model.body(model.geom_bodyid[geom]).name for geom in pair)
            for pair in data.contact.geom
        }

    # The nail touches the palm, which is not its parent. MuJoCo has no contacts between two bodies
    # that cannot move against each other.
    assert touching(adapted) == touching(whole) == {frozenset(('palm', 'nail'))}
