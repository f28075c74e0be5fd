# SPDX-License-Identifier: Apache-2.0
"""The choice of the release from which a ROS package is built; see bench/ros_sources.py."""

import subprocess

import pytest

from bench import ros_sources
from musculoskeletal_ae.exceptions import MusculoskeletalError


@pytest.fixture
def builder(tmp_path, monkeypatch):
    """Return a builder for which a local repository takes the place of GitHub."""
    repository = tmp_path / 'repository'
    identity = ('-c', 'user.name=a', '-c', 'user.email=a@b')
    git = ('git', *identity, '-C', str(repository))
    subprocess.run(['git', 'init', '-q', repository], check=True)
    subprocess.run([*git, 'commit', '-q', '--allow-empty', '-m', 'release'], check=True)
    for version in ('0.36.2-1', '0.36.2-2', '0.36.2-10', '0.36.10-1'):
        subprocess.run([*git, 'tag', f'release/jazzy/control_msgs/{version}'], check=True)
    url = ros_sources.RELEASES['control_msgs'].url()
    monkeypatch.setenv('GIT_CONFIG_COUNT', '1')
    monkeypatch.setenv('GIT_CONFIG_KEY_0', f'url.file://{repository}.insteadOf')
    monkeypatch.setenv('GIT_CONFIG_VALUE_0', url)
    return ros_sources.Builder(tmp_path)


def test_the_last_increment_of_a_release_is_built(builder):
    assert builder.tag('control_msgs', '0.36.2') == 'release/jazzy/control_msgs/0.36.2-10'


def test_a_version_that_was_not_released_is_refused_with_the_released_ones(builder):
    with pytest.raises(MusculoskeletalError, match=r'legal: 0\.36\.2, 0\.36\.10$'):
        builder.tag('control_msgs', '0.36.3')


def test_an_unknown_package_is_refused_with_the_known_ones(capsys):
    with pytest.raises(SystemExit) as ended:
        ros_sources.main(['rviz2'])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert 'rviz2' in error and 'control_msgs, rclpy' in error
