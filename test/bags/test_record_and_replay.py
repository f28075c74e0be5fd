# SPDX-License-Identifier: Apache-2.0
"""The tools `record` and `replay`: their options, and real processes on a real graph."""

import re
import signal
import time
from array import array

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from bags import bag_samples as samples
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.messages.message_reading import read_array
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.learner import LearnerNode
from musculoskeletal_ae.ros.message_building import SENSOR
from musculoskeletal_ae.ros_tools import record as record_tool
from musculoskeletal_ae.ros_tools import replay as replay_tool

from .arm_bag import JOINTS, joints

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def ros(graph, *remaps):
    return ['--ros-args', '-r', f'__ns:={graph.namespace}', *remaps]


def record(tool, graph, out, *options):
    recorder = tool('record', out, *options, *ros(graph))
    recorder.wait_for('recording to')
    return recorder


def messages(path, namespace):
    """Return topic and data of all messages, except reports of the node `replay`."""
    every = ((m.topic.removeprefix(namespace), m.data) for m in Bag.open(path).messages())
    return [(topic, data) for topic, data in every if b'/replay: state' not in data]


def test_a_replay_is_recorded_as_it_was(tool, graph, tmp_path):
    content = samples.samples(126, '/left_arm')
    samples.write_ours(tmp_path / 'first', content, 'zstd', finish=True)
    recorder = record(tool, graph, tmp_path / 'second')
    replay = tool('replay', tmp_path / 'first', '--topics', 'all', '--wait', '20', *ros(graph))
    output = replay.output()
    assert replay.process.returncode == 0, output
    output = recorder.end(signal.SIGINT)
    assert recorder.process.returncode == 0, output
    assert 'Traceback' not in output
    first = messages(tmp_path / 'first', '/left_arm')
    second = messages(tmp_path / 'second', graph.namespace)
    # DDS pads serialized messages with zeros to a multiple of four bytes.
    assert second == [(topic, data + bytes(-len(data) % 4)) for topic, data in first]


def test_a_killed_recorder_loses_at_most_the_last_second(tool, graph, tmp_path, capsys):
    recorder = record(tool, graph, tmp_path / 'bag')
    latched = graph.publisher(String, 'robot_description', LATCHED)
    latched.publish(String(data='<robot/>'))
    publisher = graph.publisher(Float64MultiArray, 'muscle_states')
    sent, begin = [], time.monotonic()
    while time.monotonic() - begin < 2.5:
        sent.append(time.time_ns())
        publisher.publish(Float64MultiArray(data=array('d', [1.0] * 18)))
        graph.spin(0.01)
    recorder.end(signal.SIGKILL)
    bag = Bag.open(tmp_path / 'bag')
    assert bag.unfinished
    recorded = list(bag.messages([f'{graph.namespace}/muscle_states']))
    assert sent[-1] - recorded[-1].publish_time < 1e9
    assert bag.topics[f'{graph.namespace}/robot_description'].message_count == 1
    assert replay_tool._work(replay_tool.parse(['--check', str(tmp_path / 'bag')]), []) == 1
    assert 'fault: unfinished: ' in capsys.readouterr().out


def test_what_comes_before_a_simulated_clock_has_no_time(tool, graph, tmp_path):
    recorder = record(tool, graph, tmp_path / 'bag', '--ros-args', '-p', 'use_sim_time:=true')
    graph.publisher(String, 'controller_mode', LATCHED).publish(String(data='holding'))
    publisher = graph.publisher(Float64MultiArray, 'muscle_states')
    message = Float64MultiArray(data=array('d', [1.0] * 18))
    clock = graph.publisher(Clock, '/clock')
    for n in range(30):
        publisher.publish(message)
        if n == 9:
            clock.publish(Clock(clock=Time(sec=1000)))
        graph.spin(0.1)
    output = recorder.end(signal.SIGINT)
    match = re.search(r'(\d+) messages came before the first /clock', output)
    assert match, output
    bag = Bag.open(tmp_path / 'bag')
    assert bag.start == bag.end == 1000 * 10**9
    # 31 messages were sent. A busy recorder may receive /clock late, or miss some messages.
    assert 2 <= bag.message_count <= 31 - int(match[1]), output


def test_a_recording_without_a_topic_that_was_asked_for_says_so(tool, graph, tmp_path):
    wanted = 'anomaly,muscle_states'
    recorder = record(tool, graph, tmp_path / 'bag', '--topics', wanted)
    graph.publisher(Float64MultiArray, 'muscle_states')  # returns when the recorder has subscribed
    graph.spin(1.0)
    output, ns = recorder.end(signal.SIGINT), graph.namespace
    assert re.search('^0 messages recorded to .*, 0 lost$', output, re.MULTILINE)
    silent = f'{ns}/anomaly, which has no publisher; {ns}/muscle_states, which sent nothing'
    assert f'no message was recorded of {silent}' in output
    assert recorder.process.returncode == 1
    assert Bag.open(tmp_path / 'bag').message_count == 0


@pytest.mark.parametrize(
    'early', ['muscle_states', pytest.param('controller_mode', marks=pytest.mark.thorough)]
)
def test_publishers_that_offer_less_than_usual_are_recorded(tool, graph, tmp_path, early):
    """One publisher exists before the recorder, the other one does not."""
    topics = {'muscle_states': Float64MultiArray, 'controller_mode': String}
    qos = {  # the usual publishers are reliable, and that of controller_mode is latched
        'muscle_states': QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT),
        'controller_mode': QoSProfile(depth=5),
    }

    publishers = {early: graph.node.create_publisher(topics[early], early, qos[early])}
    recorder = record(tool, graph, tmp_path / 'bag', '--topics', ','.join(topics))
    for name in topics.keys() - publishers.keys():
        publishers[name] = graph.node.create_publisher(topics[name], name, qos[name])
    content = {
        'muscle_states': Float64MultiArray(data=array('d', [1.0] * 18)),
        'controller_mode': String(data='holding'),
    }
    for name, publisher in publishers.items():
        graph.wait(publisher.get_subscription_count, f'a subscriber of {name}')

    def is_recorded():
        for name, publisher in publishers.items():
            publisher.publish(content[name])
        graph.spin(0.1)
        return (tmp_path / 'bag').exists() and Bag.open(tmp_path / 'bag').topics.keys() >= {
            f'{graph.namespace}/{name}' for name in topics
        }

    graph.wait(is_recorded, 'messages of both topics in the bag')
    recorder.end(signal.SIGINT)
    assert recorder.process.returncode == 0
    recorded = Bag.open(tmp_path / 'bag').topics[f'{graph.namespace}/{early}'].qos
    assert [(profile.reliability.value, profile.durability.value) for profile in recorded] == [
        (qos[early].reliability.value, qos[early].durability.value)
    ]


def test_messages_that_a_recorder_misses_are_counted(tool, graph, tmp_path):
    recorder = record(tool, graph, tmp_path / 'bag', '--topics', 'muscle_states')
    publisher = graph.publisher(Float64MultiArray, 'muscle_states', QoSProfile(depth=1))
    topic, count = f'{graph.namespace}/muscle_states', 0
    # A burst of 200 of these messages overflows the buffer of a socket.
    large = Float64MultiArray(data=array('d', bytes(8 * 6000)))

    def publish():
        nonlocal count
        count += 1
        publisher.publish(large)
        graph.spin(0.002)

    def recorded():
        topics = Bag.open(tmp_path / 'bag').topics
        return topics[topic].message_count if topic in topics else 0

    graph.wait(lambda: publish() or recorded(), 'the first message')
    recorder.process.send_signal(signal.SIGSTOP)
    for _ in range(200):
        publish()
    recorder.process.send_signal(signal.SIGCONT)
    before = recorded()
    graph.wait(lambda: publish() or recorded() > before + 20, 'messages after the pause')
    output = recorder.end(signal.SIGINT)
    match = re.search(rf'warning: messages were lost .*: {topic} (\d+) of (\d+);', output)
    assert match, output
    lost, kept = int(match[1]), recorded()
    assert int(match[2]) == lost + kept <= count
    assert f', {lost} lost' in output
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    assert f"lost messages of {topic}: '{lost}'" in text
    with AnyReader([tmp_path / 'bag']) as reader:  # the reader of the library rosbags
        assert reader.message_count == kept


def test_a_paused_replay_steps_resumes_and_loops_its_clock(tool, graph, tmp_path):
    content = [s for s in samples.samples(1200, '/l') if s.topic == '/l/muscle_states'][:30]
    samples.write_ours(tmp_path / 'bag', content, 'none', finish=True)
    received = graph.listen(Float64MultiArray, 'muscle_states')
    clock = graph.listen(Clock, '/clock')
    replay = tool(
        'replay', tmp_path / 'bag', '--paused', '--clock', '--rate', '20', '--loop', *ros(graph)
    )

    def now():
        return clock[-1].clock.sec * 10**9 + clock[-1].clock.nanosec

    graph.wait(lambda: clock, 'a clock')
    assert not received
    assert graph.call(Trigger, 'replay/step').success
    graph.wait(lambda: received, 'the first step')
    answer = graph.call(Trigger, 'replay/step')
    second = (content[1].log_time - content[0].log_time) / 1e9
    assert (answer.success, answer.message) == (True, f'stepped at {second:.6f} s')
    graph.wait(lambda: len(received) == 2, 'the second step')
    graph.wait(lambda: now() == content[1].log_time, 'the time of the second step')
    assert graph.call(Trigger, 'replay/resume').success
    graph.wait(lambda: len(received) > len(content), 'the second lap')
    assert not graph.call(Trigger, 'replay/step').success
    length = content[-1].log_time - content[0].log_time

    # The clock need not go back by the whole length, because on a busy machine its first or last
    # messages of a lap may be missing.
    def has_looped():
        times = [c.clock.sec * 10**9 + c.clock.nanosec for c in clock]
        return np.diff(times).min() < -0.9 * length

    graph.wait(has_looped, 'the clock to return to the start')
    output = replay.end(signal.SIGINT)
    assert replay.process.returncode == 0
    assert 'Traceback' not in output


def test_a_replay_publishes_its_position_and_follows_requests_until_sigterm(tool, graph, tmp_path):
    start = 0.25  # start of the replay, as a share of the recording
    samples.write_ours(tmp_path / 'bag', samples.samples(252, ''), 'zstd', finish=True)
    length = (Bag.open(tmp_path / 'bag').end - Bag.open(tmp_path / 'bag').start) / 1e9
    positions = graph.listen(Float64MultiArray, 'replay/position')
    graph.listen(DiagnosticArray, '/diagnostics')
    received = graph.listen(Float64MultiArray, 'muscle_states')
    options = '--wait', '0', '--paused', '--loop', '--start', str(start * length)
    replay = tool('replay', tmp_path / 'bag', *options, *ros(graph))
    graph.wait(lambda: positions, 'the position of the replay')
    where, whole = read_array(positions[-1], 1, 2)  # the timeline of the page reads it like this
    assert where == pytest.approx(start * length, abs=1e-6) and whole == pytest.approx(length)
    graph.wait(
        lambda: 'replay_stands' in graph.report('replay').identifiers, 'the report of the replay'
    )
    good, reason = graph.set_parameter('replay', 'position', 0.5 * length)
    assert good, reason
    graph.wait(
        lambda: positions[-1].data[0] == pytest.approx(0.5 * length, abs=1e-3),
        'the middle of the recording',
    )
    assert not graph.set_parameter('replay', 'position', length + 1.0)[0]
    assert graph.call(Trigger, 'replay/resume').success
    graph.wait(lambda: received, 'a message')
    output = replay.end(signal.SIGTERM)
    assert replay.process.returncode == 0
    assert 'Traceback' not in output
    assert 'add --clock' in output


def stream(count):
    """Return messages of muscle_states, one every PERIOD."""
    first = next(s for s in samples.samples(63, '') if s.topic == '/muscle_states')
    times = [samples.START + n * samples.PERIOD for n in range(count)]
    return [first._replace(log_time=time, publish_time=time) for time in times]


def test_a_slow_node_misses_nothing_of_a_replay_that_waits_for_it(tool, graph, tmp_path):
    content = stream(160)
    samples.write_ours(tmp_path / 'bag', content, 'none', finish=True)
    clock, received = graph.listen(Clock, '/clock', QoSProfile(depth=1)), []

    def take(_):
        seconds = clock[-1].clock
        received.append(seconds.sec * 10**9 + seconds.nanosec)
        if len(received) % 100 == 50:
            time.sleep(0.5)  # the queue holds only 10 messages

    graph.node.create_subscription(Float64MultiArray, 'muscle_states', take, SENSOR)
    replay = tool('replay', tmp_path / 'bag', '--clock', '--wait-for', 'test', *ros(graph))
    graph.wait(lambda: replay.process.poll() is not None, 'the end of the replay')
    assert replay.process.returncode == 0, replay.output()
    assert len(received) == len(content)
    late = np.array(received) - [message.log_time for message in content]
    assert np.abs(late).max() < samples.PERIOD, late


def test_a_replay_begins_when_the_nodes_run_that_it_waits_for(tool, graph, tmp_path):
    content = [s for s in samples.samples(100, '') if s.topic == '/muscle_states']
    samples.write_ours(tmp_path / 'bag', content, 'none', finish=True)
    clock = graph.listen(Clock, '/clock', 1000)
    graph.listen(DiagnosticArray, '/diagnostics')
    received = graph.listen(Float64MultiArray, 'muscle_states')
    options = ['--clock', '--wait', '0.2', '--wait-for', 'test,late']
    replay = tool('replay', tmp_path / 'bag', *options, *ros(graph))
    graph.wait(lambda: 'late' in graph.report('replay').message, 'the replay to wait for `late`')
    assert graph.report('replay').values['state'] == 'waiting'
    graph.spin(0.5)
    assert not received
    late = rclpy.create_node('late', context=graph.context, namespace=graph.namespace)
    graph.hosted.append(late)
    graph.executor.add_node(late)
    graph.wait(lambda: replay.process.poll() is not None, 'the end of the replay')
    assert replay.process.returncode == 0 and len(received) == len(content)
    # The clock ticks a hundred times in each recorded second.
    times = np.array([c.clock.sec * 10**9 + c.clock.nanosec for c in clock])
    assert (np.diff(times) >= 0).all()
    assert np.median(np.diff(times[times > content[0].log_time])) <= 1e7
    assert times[0] < content[1].log_time
    assert times[-1] > content[-2].log_time


def test_a_replay_beside_nodes_of_another_robot_says_so(tool, graph, tmp_path):
    content = stream(500)
    samples.write_ours(tmp_path / 'bag', content, 'none', finish=True)
    graph.host(LearnerNode, robot='arm26', state_directory='')
    replay = tool('replay', tmp_path / 'bag', *ros(graph))
    graph.wait(lambda: replay.process.poll() is not None, 'the end of the replay')
    output = replay.output()
    assert replay.process.returncode == 0, output
    warnings = [line for line in output.splitlines() if line.startswith('warning: ')]
    assert len(warnings) == 1, output
    for part in f'{graph.namespace}/learner', 'arm26', 'muscle_states', '--check --robot arm26':
        assert part in warnings[0]


def test_an_impossible_request_is_reported_in_one_line(tool, bag):
    cases = [
        (('replay', bag, '--start', '100'), 1, 'is only 0.620 s long; choose a smaller --start'),
        (('replay', bag, '--ros-args', '-r', 'bad'), 2, "Couldn't parse remap rule"),
    ]
    started = [(tool(*arguments), *rest) for arguments, *rest in cases]
    for one, status, problem in started:
        lines = [line for line in one.output().splitlines() if '[rcl]' not in line]
        assert one.process.returncode == status
        assert len(lines) == 1, lines
        assert problem in lines[0]


@pytest.mark.parametrize(
    ('parse', 'arguments', 'problem'),
    [
        (replay_tool.parse, [], 'BAG'),
        (replay_tool.parse, ['bag', '--wait-for', 'a'], '--wait-for needs --clock'),
        (replay_tool.parse, ['bag', '--rate', '2'], '--rate other than 1 needs --clock'),
        (replay_tool.parse, ['bag', '--rate', '0', '--clock'], 'expected 0.001 to 1000'),
        (replay_tool.parse, ['bag', '--rate', 'nan', '--clock'], 'expected 0.001 to 1000'),
        (replay_tool.parse, ['bag', '--rate', '1e305', '--clock'], 'expected 0.001 to 1000'),
        (replay_tool.parse, ['bag', '--check', '--loop'], 'plays nothing: remove --loop'),
        (replay_tool.parse, ['bag', '--check', '--start', '5'], 'plays nothing: remove --start'),
        (replay_tool.parse, ['bag', '--start', '-1'], 'expected a number of at least 0'),
        (replay_tool.parse, ['bag', '--duration', 'inf'], 'expected a number above 0'),
        (replay_tool.parse, ['bag', '--topics', ','], "',': expected a name"),
        (
            replay_tool.parse,
            ['bag', '--as-trajectory', '--topics', 'joint_states,imu'],
            '--as-trajectory sends the motion of estimated_joint_states: remove --topics joint_',
        ),
        (replay_tool.parse, ['bag', '--nonsense'], 'unrecognized arguments: --nonsense'),
        (
            record_tool.parse,
            ['--topics', 'muscle_states,nothing'],
            "unknown topic 'nothing'; legal: joint_",
        ),
        (record_tool.parse, ['--duration', '0'], 'expected a number above 0'),
        (record_tool.parse, ['--robot', 'nobody'], "--robot: robot 'nobody' is neither"),
        (record_tool.parse, ['a', '-o', 'b'], 'DIR is given twice'),
        (record_tool.parse, ['--compression', 'rar'], 'invalid choice'),
    ],
)
def test_every_mistake_is_one_clear_line_and_status_2(parse, arguments, problem, capsys):
    with pytest.raises(SystemExit) as ended:
        parse(arguments)
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert problem in message
    assert message.count('\n') == 1


def test_a_demonstration_is_replayed_as_one_trajectory(tool, graph, tmp_path):
    names, content = ('elbow', 'shoulder'), []
    for n in range(300):
        now = samples.START + n * 10_000_000
        theta = [0.5 * np.sin(0.01 * n), -0.3]
        data = joints(names, theta)
        content.append(samples.Sample('/l/estimated_joint_states', JOINTS, now, now, data))
    samples.write_ours(tmp_path / 'bag', content, 'none', finish=True)
    received = graph.listen(JointTrajectory, 'joint_trajectory')
    replay = tool('replay', tmp_path / 'bag', '--as-trajectory', '--wait', '20', *ros(graph))
    output = replay.output()
    assert replay.process.returncode == 0, output
    assert 'joint_trajectory: 31 points' in output
    message = graph.wait(lambda: received, 'the trajectory')[0]
    assert tuple(message.joint_names) == names
    seconds = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points]
    assert seconds[0] > 1.0 and (np.diff(seconds) > 0.05).all()
    shown = np.array([point.positions for point in message.points])
    wanted = 0.5 * np.sin(np.array(seconds) - seconds[0])
    np.testing.assert_allclose(shown[2:-2, 0], wanted[2:-2], atol=0.02)
    np.testing.assert_allclose(shown[:, 1], -0.3)
    np.testing.assert_array_equal(message.points[-1].velocities, 0.0)


@pytest.mark.parametrize('takes', [pytest.param(True, marks=pytest.mark.thorough), False])
def test_the_result_of_a_replayed_demonstration_is_reported(tool, graph, tmp_path, takes):
    controller = graph.host(ControllerNode, robot='arm26')
    names = controller.robot.joints
    if takes:
        controller.core.trajectory = lambda *_: None
    content = []
    for n in range(300):
        now = samples.START + n * 10_000_000
        data = joints(names, [0.1 * np.sin(0.01 * n), -1.0])
        content.append(samples.Sample('/estimated_joint_states', JOINTS, now, now, data))
    samples.write_ours(tmp_path / 'bag', content, 'none', finish=True)
    replay = tool('replay', tmp_path / 'bag', '--as-trajectory', '--wait', '20', *ros(graph))
    graph.wait(lambda: replay.process.poll() is not None, 'the end of the replay')
    output = replay.output()
    assert replay.process.returncode == (0 if takes else 1), output
    why = 'the controller refused the trajectory: joint_trajectory: no posture estimated yet'
    assert ('joint_trajectory: 31 points' if takes else why) in output


def test_of_two_arms_that_were_shown_a_motion_one_is_asked_for(tmp_path):
    data = joints(['elbow'], [0.0])
    content = [
        samples.Sample(f'/{arm}/estimated_joint_states', JOINTS, samples.START, 0, data)
        for arm in 'lr'
    ]
    samples.write_ours(tmp_path / 'bag', content, 'none', finish=True)
    both = ['--as-trajectory', '--keep-names']
    with pytest.raises(BagError, match=r'several arms: /l/.*, /r/.*; choose .* --from-namespace'):
        replay_tool._work(replay_tool.parse([str(tmp_path / 'bag'), *both]), [])
