# SPDX-License-Identifier: Apache-2.0
"""The node `sim` on the graph, beside a robot or instead of one."""

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from robots import write_robot
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from visualization_msgs.msg import MarkerArray

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.motion.methods import first_command
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.sim import SimNode
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.message_building import LATCHED, array_message
from musculoskeletal_ae.signals.muscle_states import QUANTITIES, read_muscle_states
from musculoskeletal_ae.simulation.simulation import Simulation


@pytest.fixture
def arm(graph, trained_file):
    graph.listen(JointState, 'sim/joint_states')
    graph.listen(Float64MultiArray, 'sim/muscle_states')
    graph.listen(DiagnosticArray, '/diagnostics')
    graph.simulator = graph.host(SimNode, robot='arm26', checkpoint=trained_file)
    graph.next('sim/muscle_states')
    return graph


@pytest.fixture
def mae(arm26, trained_file):
    return checkpoint.load(trained_file, arm26)


@pytest.fixture
def core(arm26, mae):
    """Return the simulated arm without ROS."""
    core = Simulation(arm26, mae)
    core.settle()
    return core


def posture(graph, topic='sim/joint_states'):
    return np.array(graph.next(topic).position)


def wait_for_posture(graph, theta, what):
    graph.wait(lambda: np.abs(posture(graph) - theta).max() < 0.01, what)


def held_command(mae, arm26):
    theta = 0.5 * (arm26.lower + arm26.upper)
    return first_command(arm26, mae, theta, np.full(arm26.muscle_count, 60.0))


def test_the_simulator_rests_at_the_tension_bias_before_a_command(arm, arm26, core):
    message = arm.next('sim/muscle_states')
    assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [
        ('quantity', len(QUANTITIES), 6 * len(QUANTITIES)),
        ('muscle', 6, 6),
    ]
    read = read_muscle_states(message, arm26)
    np.testing.assert_array_equal(read.tension, arm26.tension.bias)
    np.testing.assert_array_equal(read.temperature, 25.0)
    assert tuple(arm.next('sim/joint_states').name) == arm26.joints
    np.testing.assert_allclose(posture(arm), core.state.theta[0], atol=1e-3)
    markers = arm.listen(MarkerArray, 'sim/markers')
    arm.wait(lambda: markers, 'markers')
    muscles = [m for m in markers[-1].markers if m.ns == 'muscles']
    assert len(muscles) == 6
    assert all((m.color.r, m.color.g) == (0.0, 1.0) for m in muscles)  # green at T_bias
    assert {m.header.frame_id for m in markers[-1].markers} == {arm26.root_link}
    assert arm.node.count_publishers('joint_states') == 0


def test_the_simulator_follows_the_command_of_the_hardware(arm, arm26, mae, core):
    command = held_command(mae, arm26)
    core.command = command[None]
    arm.publisher(Float64MultiArray, 'muscle_length_command').publish(
        array_message(command, 'muscle')
    )
    wait_for_posture(arm, core.settle().theta[0], 'the posture of the core')
    arm.wait(lambda: arm.report('sim').message == 'following commands', 'the report')


def test_beside_a_fast_robot_the_simulator_publishes_at_100_hz(graph, trained_file):
    states = graph.listen(JointState, 'sim/joint_states')
    graph.host(SimNode, robot='arm26', checkpoint=trained_file, rate=1000.0)
    graph.next('sim/joint_states', 50)
    stamps = [message.header.stamp for message in states]
    times = [stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]
    assert (times[-1] - times[0]) / (len(times) - 1) > 0.009


def test_a_push_acts_until_it_is_zero(arm, arm26, core):
    rest = posture(arm)
    push = arm.publisher(WrenchStamped, 'sim/external_wrench')
    message = WrenchStamped()
    message.wrench.force.x = 8.0
    push.publish(message)
    core.wrench[0, 0] = 8.0
    pushed = core.settle().theta[0]
    assert np.abs(pushed - rest).max() > 0.1
    wait_for_posture(arm, pushed, 'the push')
    message.header.frame_id = 'camera'
    message.wrench.force.x = 0.0
    push.publish(message)
    arm.wait(lambda: 'wrong frame' in str(arm.simulator.rejected), 'the rejection')
    message.header.frame_id = arm26.root_link
    push.publish(message)
    wait_for_posture(arm, rest, 'the release')


def test_joints_are_forced_and_released(arm, core):
    rest = posture(arm)
    force = arm.publisher(JointState, 'sim/fixed_joint_states')
    force.publish(JointState(name=['elbow'], position=[-0.8]))
    core.fixed[0] = [np.nan, -0.8]
    wait_for_posture(arm, core.settle().theta[0], 'the forced posture')
    arm.wait(lambda: 'forced joints' in str(arm.simulator.report().values), 'the report')
    for names, extra, reason in (
        (['knee'], {}, 'unknown joint'),
        (['elbow'] * 2, {}, 'duplicate joint'),
        ([], {'effort': [1.0]}, 'empty'),  # only an entirely empty message releases the joints
    ):
        force.publish(JointState(name=names, position=[0.0] * len(names), **extra))
        arm.wait(lambda reason=reason: reason in str(arm.simulator.rejected), reason)
    assert abs(posture(arm)[1] + 0.8) < 0.01
    force.publish(JointState())
    wait_for_posture(arm, rest, 'the release')


def test_an_unreachable_command_is_reported_and_bad_commands_change_nothing(arm, arm26):
    commands = arm.publisher(Float64MultiArray, 'muscle_length_command')
    before = posture(arm)
    for data in ([float('nan')] * 6, [-0.05] * 5, [], [0.0] * 1_300_000):
        commands.publish(Float64MultiArray(data=data))
    arm.next('sim/joint_states', 30)
    np.testing.assert_allclose(posture(arm), before, atol=1e-3)
    assert sum(arm.simulator.rejected.values()) == 4
    commands.publish(array_message(np.full(6, -1.0), 'muscle'))
    arm.wait(lambda: 'at the limit: ' in arm.simulator.report().message, 'the report')
    tension = read_muscle_states(arm.next('sim/muscle_states'), arm26).tension
    assert tension.max() <= arm26.tension.max[0]
    theta = posture(arm)
    assert np.all((theta >= arm26.lower) & (theta <= arm26.upper))


def test_the_simulator_waits_for_a_checkpoint_and_refuses_unfit_ones(graph, mae, trained_file):
    graph.listen(JointState, 'sim/joint_states')
    sim = graph.host(SimNode, robot='arm26')
    graph.wait(lambda: 'no network' in sim.report().message, 'the report')
    assert not graph.received['sim/joint_states']
    graph.send_network(b'not a network', 'accepted_checkpoint')
    graph.wait(lambda: 'accepted_checkpoint' in str(sim.rejected), 'the refusal')
    for version in (41, 42):
        data = checkpoint.to_bytes(replace(mae, version=version))
        graph.send_network(data, 'accepted_checkpoint')
        graph.wait(
            lambda version=version: sim.arm is not None and sim.arm.mae.version == version,
            f'{version}',
        )
    graph.next('sim/joint_states', 3)
    assert not graph.set_parameter('sim', 'checkpoint', '/nowhere')[0]
    # Once the estimator has published a network, it decides which network all nodes use.
    done, reason = graph.set_parameter('sim', 'checkpoint', trained_file)
    assert not done
    assert 'of the estimator' in reason


def test_the_simulator_as_robot_closes_the_loop_with_estimator_and_controller(
    graph, arm26, trained_file
):
    graph.listen(JointState, 'joint_states')
    graph.listen(Float64MultiArray, 'muscle_states')
    graph.listen(String, 'robot_description', LATCHED)
    common = {'robot': 'arm26', 'checkpoint': trained_file}
    graph.host(SimNode, **common, as_robot=True)
    graph.host(EstimatorNode, **common)
    # On a loaded machine messages arrive late. A large max_age avoids stops.
    graph.host(ControllerNode, **common, first_duration=1.0, max_age=10.0)
    graph.next('muscle_states')
    graph.wait(lambda: graph.received['robot_description'], 'the description')
    assert graph.received['robot_description'][0].data == arm26.description.urdf
    target = graph.publisher(JointState, 'target_joint_states')
    for theta in (np.array([-0.5, -1.2]), np.array([0.1, -0.5])):
        target.publish(JointState(name=arm26.joints, position=theta.tolist()))
        graph.wait(
            lambda theta=theta: np.abs(posture(graph, 'joint_states') - theta).max() < 0.15,
            f'{theta}',
        )
    assert graph.node.count_publishers('sim/joint_states') == 0


def test_the_simulator_as_robot_uses_neither_length_offsets_nor_isolation(graph, trained_file):
    shell = graph.host(SimNode, robot='arm26', checkpoint=trained_file, as_robot=True, rate=2.0)
    assert shell.longest_step == 1.0  # two periods of the rate of 2 Hz [s]
    topics = {subscription.topic_name for subscription in shell.subscriptions}
    assert f'{graph.namespace}/muscle_length_command' in topics
    assert f'{graph.namespace}/body_state' not in topics


def test_preset_paper_runs_and_an_unknown_one_is_refused(graph, arm26, trained_file):
    graph.listen(JointState, 'sim/joint_states')
    graph.host(SimNode, robot='arm26', checkpoint=trained_file, preset='paper')
    theta = np.array(graph.next('sim/joint_states', 20).position)
    assert np.all((theta >= arm26.lower) & (theta <= arm26.upper))
    with pytest.raises(MusculoskeletalError, match=r'parameter preset: .*default, paper'):
        graph.host(SimNode, robot='arm26', preset='magic')


def test_a_prismatic_joint_is_fixed_and_published_in_metres(graph, tmp_path):
    robot = Robot.load(write_robot(tmp_path / 'slider', slider=True))
    file = tmp_path / 'mae.safetensors'
    checkpoint.save(initial_mae(robot, steps=300), file)
    graph.listen(JointState, 'sim/joint_states')
    graph.host(SimNode, robot=str(tmp_path / 'slider'), checkpoint=str(file))
    fixed = JointState(name=['wrist'], position=[0.03])
    publisher = graph.publisher(JointState, 'sim/fixed_joint_states')

    def is_there():
        publisher.publish(fixed)
        return abs(posture(graph)[-1] - 0.03) < 1e-3

    graph.wait(is_there, 'the wrist at 30 mm')
