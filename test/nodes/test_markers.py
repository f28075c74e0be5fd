# SPDX-License-Identifier: Apache-2.0
"""Topics for RViz, Foxglove and PlotJuggler: distinguishable arms and names."""

import json
from pathlib import Path

import pytest
import yaml
from geometry_msgs.msg import Point
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from visualization_msgs.msg import Marker, MarkerArray

from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.ros_tools import render

CONFIG = Path(__file__).parents[2] / 'config'


def test_markers_of_estimate_and_hardware_differ_and_have_names_and_prefixed_frames(
    graph, arm26, trained_file
):
    options = {'robot': 'arm26', 'frame_prefix': 'left/'}
    graph.host(EstimatorNode, **options, checkpoint=trained_file, mirror_muscles=True)
    graph.host(HardwareEmulatorNode, **options)
    arms = ('estimated', 'hardware_emulator')
    for arm in arms:
        graph.listen(MarkerArray, f'{arm}/markers')
    mirrored = graph.listen(JointState, 'muscle_joint_states')
    read = graph.listen(Float64MultiArray, 'muscle_states')
    drawn = {}
    for arm in arms:
        messages = graph.received[f'{arm}/markers']
        markers = graph.wait(lambda m=messages: m and m[-1].markers, f'markers of {arm}')
        assert {marker.header.frame_id for marker in markers} == {f'left/{arm26.root_link}'}
        assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)
        names = [m.text for m in markers if m.type == Marker.TEXT_VIEW_FACING]
        assert tuple(names) == arm26.muscles
        bone = next(m.color for m in markers if m.ns == 'bones')
        drawn[arm] = bone.r, bone.g, bone.b, bone.a
    assert drawn['estimated'][3] < 1.0 == drawn['hardware_emulator'][3]
    assert drawn['estimated'][:3] != drawn['hardware_emulator'][:3]
    rows = {(*message.data[: 2 * arm26.muscle_count],) for message in read}
    mine = graph.wait(
        lambda: next((m for m in mirrored if (*m.position, *m.effort) in rows), None), 'a mirror'
    )
    assert tuple(mine.name) == arm26.muscles
    assert mine.header.stamp.sec > 0


@pytest.mark.parametrize(
    ('topic', 'emulated'), [('hardware_emulator/markers', True), ('estimated/markers', False)]
)
def test_render_draws_the_emulated_arm_or_without_an_emulator_the_estimate(
    graph, tmp_path, capsys, topic, emulated
):
    """With a physical arm there is no emulator, and without a network there are no markers."""
    publisher = graph.node.create_publisher(MarkerArray, 'estimated/markers', 10)
    bone = Marker(type=Marker.LINE_STRIP, points=[Point(), Point(z=0.3)])

    def publish():
        for markers in ([], [bone]):
            publisher.publish(MarkerArray(markers=markers))

    graph.node.create_timer(0.1, publish)
    if emulated:
        graph.host(HardwareEmulatorNode, robot='arm26')
    out = tmp_path / 'arm.png'
    with graph.spinning():
        status = render.main(
            ['--out', str(out), '--ros-args', '-r', f'__ns:={graph.namespace}'],
        )
    assert (status, out.exists()) == (0, True)
    assert topic in capsys.readouterr().out


def test_render_refuses_an_unknown_file_type(capsys):
    with pytest.raises(SystemExit, match='2'):
        render.main(['--out', 'arm.foo'])
    refusal = capsys.readouterr().err
    assert 'arm.foo' in refusal and '.png' in refusal


def test_the_layouts_for_rviz_and_foxglove_show_existing_topics():
    topics = {'hardware_emulator/markers', 'estimated/markers', 'sim/markers'}
    rviz = yaml.safe_load((CONFIG / 'rviz.rviz').read_text('utf-8'))['Visualization Manager']
    shown = {d['Topic']['Value'] for d in rviz['Displays'] if d['Class'].endswith('/MarkerArray')}
    assert shown == topics
    foxglove = json.loads((CONFIG / 'foxglove.json').read_text('utf-8'))['configById']
    assert {topic.lstrip('/') for topic in foxglove['3D!arms']['topics']} == topics
