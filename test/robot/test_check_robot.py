# SPDX-License-Identifier: Apache-2.0
import re
import subprocess
import sys

import numpy as np
import pytest
from graph import executable
from robots import copy_robot, read_muscles, write_muscles, write_platform, write_robot
from scipy.linalg import eigh

from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.design.holding_remedies import remedies
from musculoskeletal_ae.design.robot_report import plot
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.figures import save_figure
from musculoskeletal_ae.robot.joint_units import RACK
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import joint_stiffness, muscle_hessian
from musculoskeletal_ae.tools.check_robot import main

#: a route on a single link, which crosses no joint
IDLE = [{'link': 'upper', 'xyz': [0.0, 0.03, z]} for z in (-0.1, -0.2)]
POSTURES = 20  # enough for tests that expect no exact share of postures
OTHER_SEEDS = [pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2)]
SHIPPED = ['musashi_left_arm', 'musashi_upper_body', 'arm26']


def change(directory, edit):
    document = read_muscles(directory)
    edit(document)
    return write_muscles(directory, document)


def mirror(muscle):
    """Return an edit of muscles.yaml that mirrors the route of a muscle, x becoming −x.

    The muscle then lies on the other side of every joint axis that is parallel to y.
    """

    def edit(document):
        (entry,) = (m for m in document['muscles'] if m['name'] == muscle)
        for point in entry['route']:
            point['xyz'][0] *= -1.0

    return edit


def kinds(directory):
    return {fault.kind for fault in check_robot(Robot.load(directory), POSTURES).faults}


def verdict(capsys, directory):
    status = main([str(directory), '--postures', str(POSTURES)])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def in_millimetres(document):
    for muscle in document['muscles']:
        for point in muscle['route']:
            point['xyz'] = [1e3 * v for v in point['xyz']]


def test_routes_in_millimetres_are_the_only_fault(tmp_path, capsys):
    """Other problems would only follow from the wrong unit, and their remedies would mislead."""
    directory = change(write_robot(tmp_path / 'arm'), in_millimetres)
    status, out, _ = verdict(capsys, directory)
    assert status == 1 and 'in metres, not millimetres' in out
    assert kinds(directory) == {'other_units'}


@pytest.mark.parametrize(
    ('low', 'high', 'expected'),
    [
        ('-1.6', '-0.2', ''),
        ('-90', '-12', "joint 'bend' has limits of -90 to -12 rad; give them in radians"),
    ],
)
def test_limits_in_degrees_are_suspected(tmp_path, capsys, low, high, expected):
    urdf = write_robot(tmp_path / 'arm') / 'robot.urdf'
    old = 'lower="-1.6" upper="-0.2"'
    urdf.write_text(urdf.read_text().replace(old, f'lower="{low}" upper="{high}"'))
    _, out, _ = verdict(capsys, urdf.parent)
    assert ('not degrees' in out) == bool(expected)
    assert expected in out


@pytest.mark.parametrize('name', SHIPPED)
@pytest.mark.parametrize('seed', [0, *OTHER_SEEDS])
def test_the_shipped_arms_are_sound_with_margin(name, seed):
    result = check_robot(Robot.load(name), seed=seed)
    assert result.faults == ()
    assert result.warnings == ()
    assert result.held.mean() >= 0.99
    assert result.stiff.mean() >= 0.98
    singular = np.linalg.svd(result.moment_arms, compute_uv=False)[:, -1]
    assert np.percentile(singular, 5) >= 0.03
    # The neck of the upper body has the longest moment arms.
    longest = 0.1 if name == 'musashi_upper_body' else 0.07
    assert np.abs(result.moment_arms).max() <= longest


def test_muscles_2_3_and_7_move_shoulder_pitch_most_and_6_only_the_elbow():
    robot = Robot.load('musashi_left_arm')
    arms = np.median(np.abs(check_robot(robot).moment_arms), axis=0)
    pitch = arms[:, robot.joints.index('shoulder_pitch')]
    assert set(np.argsort(pitch)[-3:] + 1) == {2, 3, 7}
    assert arms[5, :3].max() < 1e-9 < 0.02 < arms[5, robot.joints.index('elbow_pitch')]


def test_tensions_hold_the_arm_within_limits_and_unheld_postures_lack_torque(tmp_path):
    robot = Robot.load(write_robot(tmp_path, tension={'limit': 45.0}))
    result = check_robot(robot)
    held = result.held
    assert 0 < held.sum() < len(held)
    torque = robot.kinematics.holding_torque(result.setting.theta)
    made = np.einsum('nmd,nm->nd', result.moment_arms, np.nan_to_num(result.tension))
    np.testing.assert_allclose(made[held], torque[held], atol=1e-8)
    assert result.tension[held].max() <= 45.0 + 1e-8
    assert (result.missing_torque[held] == 0.0).all()
    assert (np.abs(result.missing_torque[~held]).max(axis=1) > 0.0).all()
    assert not result.stiff[~held].any()


def test_the_same_seed_gives_the_same_postures_and_another_seed_others():
    robot = Robot.load('arm26')
    one, two, three = (check_robot(robot, 20, seed).setting.theta for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, three)


def test_a_joint_that_slides_is_drawn_in_millimetres(tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    panels = plot(robot, check_robot(robot, 5)).axes
    labels = [panel.get_xlabel() for panel in panels[:4]]
    assert labels == ['joint angle [deg]'] * 3 + ['position [mm]']
    assert [panel.get_ylabel() for panel in panels[2:4]] == [
        'moment arm −G [mm]',
        'force share −G [%]',
    ]


def test_a_prismatic_joint_has_the_stiffness_of_a_pinion_that_moves_it(tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True, stiffness=2000.0))
    result = check_robot(robot, 20)
    held = result.held
    assert held.any()  # premise of this test: the muscles can hold some postures
    theta, tension = result.setting.theta[held], result.tension[held]
    raw, k = robot.routes.muscle_jacobian, robot.muscle_stiffness(theta, tension)
    stiffness = joint_stiffness(raw(theta), muscle_hessian(raw, theta), k, tension)
    scale = np.array([1.0, 1.0, 1.0, RACK])
    mixed = stiffness / scale / scale[:, None]  # in the units of the joints
    lowest = [eigh(each, np.diag(scale**-2), eigvals_only=True)[0] for each in mixed]
    np.testing.assert_allclose(result.stiffness[held], lowest, rtol=1e-6)


def test_prismatic_joints_are_reported_in_newtons_and_shares_of_the_tension(tmp_path, capsys):
    def back(document):
        (entry,) = (m for m in document['muscles'] if m['name'] == 'slider_out')
        entry['route'][0]['xyz'] = [0.0, -0.02, -0.1]

    directory = change(write_robot(tmp_path, slider=True), back)
    (directory / 'moment_arms.csv').write_text('muscle,joint,sign\nslider_out,wrist,+\n')
    urdf = directory / 'robot.urdf'
    urdf.write_text(
        urdf.read_text().replace('"0.25"', '"9"').replace('lower="0.0"', 'lower="0.02"')
    )
    status, printed, _ = verdict(capsys, directory)
    assert status == 1
    assert re.search(r'wrist \(in \d+, up to [\d.]+ N\)', printed)
    assert re.search(r"share of the wrong sign at joint 'wrist'.*\(median -\d+\.\d %\)", printed)
    assert re.search(r'act on it: .*slider_in \(-\d+ %\)', printed)
    assert 'prismatic joints (wrist): share of the tension along the axis [%]' in printed
    assert '5 N·m/rad (1389 N/m for prismatic joints)' in printed


def test_the_tool_says_sound_prints_tables_and_draws(tmp_path, capsys):
    file, name = tmp_path / 'plot.png', 'arm26'
    assert main([name, '--plot', str(file), '--postures', '40']) == 0
    printed = capsys.readouterr().out
    robot = Robot.load(name)
    for word in [*robot.joints, *robot.muscles, 'held', 'one-sided', f'{name}: sound']:
        assert word in printed
    assert file.read_bytes().startswith(b'\x89PNG')


def test_a_foreign_arm_without_declared_actions_is_judged_too(tmp_path, capsys):
    status, printed, _ = verdict(capsys, write_robot(tmp_path, finger=True))
    assert status == 0
    assert 'sound' in printed


@pytest.mark.parametrize(
    ('name', 'muscle', 'joint'),
    [
        ('arm26', 'brachialis', 'elbow'),
        ('musashi_left_arm', 'deltoid_posterior', 'shoulder_pitch'),
        ('musashi_left_arm', 'brachialis', 'elbow_pitch'),
    ],
)
def test_a_moment_arm_of_wrong_sign_is_named(tmp_path, capsys, name, muscle, joint):
    directory = change(copy_robot(name, tmp_path), mirror(muscle))
    status, printed, _ = verdict(capsys, directory)
    assert status == 1
    (line,) = [row for row in printed.splitlines() if 'wrong sign' in row]
    for fragment in (f"muscle '{muscle}'", f"joint '{joint}'", 'expected', 'found'):
        assert fragment in line


def test_without_declared_actions_a_joint_pulled_one_way_only_is_named(tmp_path, capsys):
    status, printed, _ = verdict(capsys, change(write_robot(tmp_path), drop_straighteners))
    assert status == 1
    (line,) = [row for row in printed.splitlines() if 'no muscle that pulls' in row]
    for fragment in ("joint 'bend'", 'direction + (in 100 %', 'bender (-', 'bender_long (-'):
        assert fragment in line


def test_a_joint_that_no_muscle_moves_is_to_be_left_out(tmp_path, capsys):
    directory = write_robot(tmp_path, joints=['swing', 'lift', 'bend', 'finger'], finger=True)
    _, printed, _ = verdict(capsys, directory)
    (line,) = [row for row in printed.splitlines() if 'muscles that act on it: none' in row]
    remedy = printed[printed.index(line) :]
    assert 'remove it from `joints` in muscles.yaml' in remedy


def test_columns_of_large_numbers_stay_apart(tmp_path, capsys):
    directory = change(write_robot(tmp_path), in_millimetres)
    _, printed, _ = verdict(capsys, directory)
    assert re.search(r'[-+]\d{5,}', printed)
    assert not re.search(r'\d[-+]\d', printed[printed.index('moment arms [mm]') :])


def test_an_arm_too_heavy_for_its_muscles_is_named_with_the_joint_that_lacks_torque(
    tmp_path, capsys
):
    directory = copy_robot('arm26', tmp_path)
    file = directory / 'robot.urdf'
    for mass in ('1.2', '0.8', '0.3'):
        heavy = f'<mass value="{10 * float(mass):.1f}"/>'
        file.write_text(file.read_text().replace(f'<mass value="{mass}"/>', heavy))
    status, printed, _ = verdict(capsys, directory)
    assert status == 1
    assert 'fault: the arm is not held' in printed
    assert 'missing torque is largest at shoulder (in' in printed


def test_muscles_too_weak_to_hold_the_arm_are_a_fault(tmp_path):
    def weaken(document):
        document['tension']['limit'] = 35.0

    assert 'not_held' in kinds(change(copy_robot('musashi_left_arm', tmp_path), weaken))


def test_soft_muscles_are_a_fault_naming_the_softest_joint(tmp_path, capsys):
    status, printed, _ = verdict(capsys, write_robot(tmp_path, stiffness=500.0))
    assert status == 1
    assert 'and not stiff: ' in printed and 'remedy: stiffness 2500 → 100 % stiff' in printed
    assert 'lift (' in printed or 'bend (' in printed or 'swing (' in printed


def test_a_muscle_that_crosses_no_joint_never_matters(tmp_path, capsys):
    def idle(document):
        document['muscles'].append({'name': 'idler', 'route': IDLE})

    status, printed, _ = verdict(capsys, change(write_robot(tmp_path), idle))
    assert status == 1
    assert "muscle 'idler' has no effect" in printed


def test_a_main_action_that_changes_sign_is_a_warning_not_a_fault(tmp_path):
    def cross(document):
        document['muscles'].append(
            {
                'name': 'crosser',
                'route': [
                    {'link': 'pillar', 'xyz': [0.02, 0.0, 0.06]},
                    {'link': 'upper', 'xyz': [0.0, 0.0, -0.1]},
                ],
            }
        )

    result = check_robot(Robot.load(change(write_robot(tmp_path), cross)))
    assert [warning.kind for warning in result.warnings] == ['flipping_muscle']
    assert "'crosser'" in result.warnings[0].text
    assert '`wrap: cylinder`' in result.warnings[0].remedy
    assert result.faults == ()


def test_a_joint_that_moves_no_mass_is_a_fault(tmp_path):
    directory = write_robot(tmp_path)
    file = directory / 'robot.urdf'
    text = file.read_text()
    for mass in ('0.25', '0.6'):
        text = text.replace(f'<mass value="{mass}"/>', '<mass value="0"/>')
    for entry in ('ixx', 'iyy', 'izz'):
        for value in ('0.0005', '0.0004', '0.003', '0.001'):
            text = text.replace(f'{entry}="{value}"', f'{entry}="0"')
    file.write_text(text)
    (fault,) = (f for f in check_robot(Robot.load(directory)).faults if f.kind == 'no_inertia')
    assert "'bend'" in fault.text


FINGER = """<robot name="finger"><link name="palm"/>
  <link name="phalanx"><inertial><origin xyz="0 0 -0.012"/><mass value="0.004"/>
    <inertia ixx="3e-7" ixy="0" ixz="0" iyy="3e-7" iyz="0" izz="3e-7"/></inertial></link>
  <joint name="knuckle" type="revolute"><parent link="palm"/><child link="phalanx"/>
    <axis xyz="0 1 0"/><limit lower="-0.5" upper="0.5" effort="1" velocity="5"/></joint></robot>
"""


def finger(directory, **top):
    """Write the robot directory of a finger: tensions up to 5 N, moment arms of 3 to 5 mm."""
    directory.mkdir()
    (directory / 'robot.urdf').write_text(FINGER)
    muscles = [
        {
            'name': name,
            'route': [
                {'link': 'palm', 'xyz': [x, 0.0, 0.015]},
                {'link': 'phalanx', 'xyz': [x, 0.0, -0.015]},
            ],
        }
        for name, x in (('flexor', 0.005), ('extensor', -0.005))
    ]
    document = {
        'joints': ['knuckle'],
        'muscles': muscles,
        'end_effector': 'phalanx',
        'tension': {'bias': 0.5, 'limit': 5.0, 'max': 8.0},
        'series_elastic': {'force': 3.0, 'rate': 800.0, 'wire_stretch': 1.0e-4},
        'stiffness': 2000.0,
        **top,
    }
    return write_muscles(directory, document)


def test_the_check_scales_with_the_size_of_a_finger_and_warns_that_it_is_small(tmp_path, capsys):
    status, printed, _ = verdict(capsys, finger(tmp_path / 'arm'))
    assert status == 0, printed
    assert 'nearest to 1.5 N' in printed and 'stiffness >= 0.0' in printed
    (warning,) = (line for line in printed.splitlines() if line.startswith('warning: '))
    assert 'moment arms are short at knuckle (' in warning and 'human size' in warning
    (row,) = (line for line in printed.splitlines() if line.startswith('flexor '))
    assert re.fullmatch(r'flexor( +-\d\.\d){3}', row)


def test_the_report_states_how_soft_or_weak_a_finger_is(tmp_path, capsys):
    _, printed, _ = verdict(capsys, finger(tmp_path / 'soft', stiffness=20.0))
    assert 'fault: the arm is' in printed and 'not stiff' in printed
    assert '-0.0 N·m' not in printed
    tension = {'bias': 0.01, 'limit': 0.02, 'max': 0.02}
    _, printed, _ = verdict(capsys, finger(tmp_path / 'weak', tension=tension))
    (most,) = re.findall(r'knuckle \(in \d+, up to (\S+) N·m\)', printed)
    assert 0.0 < float(most) < 0.001


@pytest.mark.parametrize('name', SHIPPED)
def test_arms_of_human_size_are_judged_by_the_round_figures(name):
    result = check_robot(Robot.load(name), 20)
    assert result.required == 5.0
    np.testing.assert_array_equal(result.matters, 0.003)


def test_a_description_error_is_one_line_and_status_1(tmp_path, capsys):
    directory = change(copy_robot('arm26', tmp_path), lambda d: d.update(colour=1.0))
    status, printed, error = verdict(capsys, directory)
    assert status == 1
    assert printed == ''
    assert error.startswith('error: ') and error.count('\n') == 1
    assert 'muscles.yaml' in error and "'colour'" in error


@pytest.mark.parametrize(
    ('rows', 'fragments'),
    [
        ('muscle,joint\n', ['muscle,joint,sign']),
        ('muscle,joint,sign\nbicep,elbow,+\n', ['line 2', "'bicep'", 'brachialis']),
        ('muscle,joint,sign\nbrachialis,knee,+\n', ['line 2', "'knee'", 'shoulder, elbow']),
        ('# x\nmuscle,joint,sign\nbrachialis,elbow,1\n', ['line 3', "'1'", '+, -']),
        ('muscle,joint,sign\nbrachialis,elbow\n', ['line 2', '3 values']),
        ('muscle,joint,sign\nbrachialis,elbow,-\nbrachialis,elbow,+\n', ['line 3', 'twice']),
    ],
)
def test_a_bad_declaration_is_refused_naming_the_line(tmp_path, capsys, rows, fragments):
    directory = copy_robot('arm26', tmp_path)
    (directory / 'moment_arms.csv').write_text(rows)
    status, _, error = verdict(capsys, directory)
    assert status == 1
    for fragment in ['moment_arms.csv', *fragments]:
        assert fragment in error


def test_as_a_program_it_exits_1_without_a_traceback(tmp_path):
    command = [*executable('check_robot'), str(tmp_path / 'none')]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert 'none' in done.stderr
    assert 'Traceback' not in done.stderr


def test_its_help_names_the_robots_and_loads_nothing_heavy():
    code = """
import sys
from musculoskeletal_ae.tools.check_robot import main
try:
    main(['--help'])
finally:
    print(sorted({'numpy', 'pinocchio', 'matplotlib'} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith('[]\n')
    for name in SHIPPED:
        assert name in done.stdout


@pytest.mark.parametrize('file', ['no/such/plot.png', 'plot.foo', 'plot'])
def test_a_plot_that_cannot_be_is_refused_before_the_work(file, tmp_path, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['arm26', '--plot', str(tmp_path / file)])
    assert "plot': expected a file" in capsys.readouterr().err.replace('.png', '').replace(
        '.foo', ''
    )


def test_a_plot_that_cannot_be_written_is_an_error(tmp_path):
    from matplotlib.figure import Figure

    file = tmp_path / 'plot.png'
    file.mkdir()
    with pytest.raises(MusculoskeletalError, match='cannot be written'):
        save_figure(Figure(), file)


@pytest.mark.parametrize(
    'change', [{'radius': 30.0}, {'xyz': [0.0, 0.0, 300.0]}, {'radius': 0.045}]
)
def test_an_object_that_no_tendon_touches_is_reported(change, tmp_path):
    folder = copy_robot('arm26', tmp_path)
    document = read_muscles(folder)
    (route,) = (m['route'] for m in document['muscles'] if m['name'] == 'triceps_lateral')
    place = next(n for n, item in enumerate(route) if item['link'] == 'forearm')
    wrap = {'wrap': 'cylinder', 'link': 'forearm', 'xyz': [0, 0, 0], 'axis': [0, 1, 0]}
    for change_of_wrap, kinds in (({}, []), (change, ['idle_object'])):
        document['muscles'][3]['route'] = [
            *route[:place],
            wrap | {'radius': 0.03} | change_of_wrap,
            *route[place:],
        ]
        warnings = check_robot(Robot.load(write_muscles(folder, document)), 60).warnings
        assert [warning.kind for warning in warnings] == kinds
    assert 'triceps_lateral (cylinder of' in warnings[0].text


def remedies_of(directory, kind, postures=30):
    """Return the remedies that check_robot suggests for a kind of fault, and the whole check."""
    check = check_robot(Robot.load(directory), postures)
    (fault,) = (fault for fault in check.faults if fault.kind == kind)
    return remedies(check, fault), check


def drop_straighteners(document):
    document['muscles'] = [m for m in document['muscles'] if 'straight' not in m['name']]


SOFT = {'force': 100.0, 'rate': 1.5}
FAULTY = {
    'weak': ('not_held', {'tension': {'limit': 45.0}}),
    'tense': ('not_held', {'tension': {'bias': 120.0, 'limit': 130.0}}),
    'soft modules': ('not_stiff', {'stiffness': 500.0}),
    'soft elastic unit': ('not_stiff', {'series_elastic': SOFT}),
    'soft in both': ('not_stiff', {'series_elastic': SOFT, 'stiffness': 300.0}),
}


@pytest.mark.parametrize('case', FAULTY)
def test_a_remedy_written_into_muscles_yaml_does_what_it_says(tmp_path, case):
    kind, top = FAULTY[case]
    lines, before = remedies_of(write_robot(tmp_path / 'before', **top), kind)
    tried = 0
    number = re.compile(r'(series_elastic|tension)?\.?(\w+) ([\d.e-]+)(?: \(and max\))?(?=,| →)')
    for line in lines:
        if '→' not in line:
            continue
        stated_share = float(re.search(r'→ ([\d.]+) %', line)[1])
        changed = {key: dict(v) if isinstance(v, dict) else v for key, v in top.items()}
        changes = number.findall(line)
        if len(changes) != line.split('→')[0].count(',') + 1:
            # The remedy also changes masses, moment arms or joint limits, which no number in
            # muscles.yaml states.
            continue
        for owner, name, value in changes:
            (changed.setdefault(owner, {}) if owner else changed)[name] = float(value)
        changed.setdefault('tension', {})['max'] = 2000.0
        after = check_robot(Robot.load(write_robot(tmp_path / 'after', **changed)), 30)
        share = getattr(after, kind.removeprefix('not_')).mean()
        assert 100.0 * share == pytest.approx(stated_share, abs=0.06), line
        assert share > getattr(before, kind.removeprefix('not_')).mean()
        assert (share >= 0.95) == ('not enough' not in line)
        tried += 1
    assert tried


def test_a_limit_is_no_remedy_where_no_limit_holds_the_arm(tmp_path):
    directory = change(write_robot(tmp_path), drop_straighteners)
    lines, _ = remedies_of(directory, 'not_held')
    change(directory, lambda d: d.update(tension={'limit': 10000.0, 'max': 10000.0}))
    # Premise of this test: even huge limits do not hold the arm.
    assert check_robot(Robot.load(directory), 30).held.mean() < 0.95
    assert all('not enough' in line for line in lines[:-1])
    assert lines[-1] == 'other routes may help: try `check_robot --suggest`'


def test_the_report_states_if_no_remedy_helps(tmp_path):
    def idle(document):
        for muscle in document['muscles']:
            muscle['route'] = IDLE

    lines, _ = remedies_of(change(write_robot(tmp_path), idle), 'not_held', 10)
    assert lines[0].startswith('none of these helps: limits, moment arms, mass, series_elastic')
    assert lines[1:] == ['other routes may help: try `check_robot --suggest`']


def test_stiffness_is_no_remedy_if_the_elastic_element_is_too_soft(tmp_path):
    directory = write_robot(tmp_path, series_elastic=SOFT)
    lines, _ = remedies_of(directory, 'not_stiff')
    change(directory, lambda d: d.update(stiffness=1e8))
    assert 'not_stiff' in kinds(directory)  # premise of this test: stiff modules are not enough
    (remedy,) = lines
    assert remedy.startswith('series_elastic.rate ')


def test_changes_that_suffice_only_together_are_reported_together(tmp_path):
    lines, _ = remedies_of(write_robot(tmp_path, **FAULTY['soft in both'][1]), 'not_stiff')
    assert lines[-1].startswith('together: stiffness ')
    assert 'series_elastic.rate' in lines[-1]


def test_a_negative_stiffness_is_called_unstable(tmp_path, capsys):
    directory = write_robot(tmp_path, stiffness=300.0)
    lowest = np.nanmin(check_robot(Robot.load(directory), POSTURES).stiffness)
    assert lowest < 0.0  # premise of this test: the arm is unstable in a posture
    _, printed, _ = verdict(capsys, directory)
    assert 'fault: the arm is unstable in' in printed
    assert f'down to {lowest:.1f} N·m/rad' in printed


def test_no_picture_is_drawn_unless_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(['arm26', '--quiet', '--postures', '5']) == 0
    assert not list(tmp_path.iterdir())


def test_a_platform_that_hangs_on_four_tendons_is_judged_in_its_equilibria(tmp_path):
    check = check_robot(Robot.load(write_platform(tmp_path / 'platform')), 40)
    assert check.faults == () and check.held.all() and check.stiff.all()
    assert 'suspended' in {warning.kind for warning in check.warnings}
    torque = check.setting.torque + np.einsum('nmd,nm->nd', check.setting.jacobian, check.tension)
    assert np.abs(torque).max() < 0.01 * np.abs(check.setting.torque).max()


def test_a_platform_that_would_turn_over_is_unstable(tmp_path):
    check = check_robot(Robot.load(write_platform(tmp_path / 'platform', height=-0.4)), 40)
    assert {fault.kind for fault in check.faults} & {'unstable', 'no_equilibrium'}
