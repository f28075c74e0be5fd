# SPDX-License-Identifier: Apache-2.0
"""Processes of one machine discover each other, also if there are more than 32."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from graph import Process

REPOSITORY = Path(__file__).resolve().parents[2]
DOMAIN = '101'  # the other tests use domains up to 100
#: sets the variables of an emulated arm, as bringup.sh does, and prints the file of the profile
PROFILE = """
repository=$0
. "$repository/.ci/environment.sh"
. "$repository/.ci/udp.sh"
discover_many "$1"
printf '%s' "$FASTRTPS_DEFAULT_PROFILES_FILE"
"""
#: ends once the other node has been discovered
SEARCH = """
import sys, time, rclpy
rclpy.init()
node = rclpy.create_node(sys.argv[1])
while sys.argv[2] not in node.get_node_names():
    time.sleep(0.1)
time.sleep(1.0)  # let the other node discover this one
"""
LONGEST = 60.0  # wait at most this long for the end of a search on a busy machine [s]


@pytest.mark.thorough
@pytest.mark.skipif(
    os.environ.get('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp') != 'rmw_fastrtps_cpp',
    reason='the profile is one of Fast DDS',
)
def test_the_processes_41_and_42_of_a_machine_discover_each_other(tmp_path):
    variables = {'ROS_DOMAIN_ID': DOMAIN, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    environment = {
        name: value
        for name, value in {**os.environ, **variables}.items()
        if name != 'FASTRTPS_DEFAULT_PROFILES_FILE'
    }
    script = ['bash', '-c', PROFILE, str(REPOSITORY), str(tmp_path / 'udp.xml')]
    file = subprocess.run(script, env=environment, capture_output=True, text=True, check=True)
    profile = Path(file.stdout).read_text('utf-8')
    searches = []
    for number, other in (41, 42), (42, 41):
        own = tmp_path / f'{number}.xml'
        identifier = f'<participantID>{number - 1}</participantID>'
        own.write_text(profile.replace('</rtps>', f'{identifier}</rtps>'), encoding='utf-8')
        searches.append(
            Process(
                f'search_{number}',
                [sys.executable, '-c', SEARCH, f'number_{number}', f'number_{other}'],
                env={**environment, 'FASTRTPS_DEFAULT_PROFILES_FILE': str(own)},
            )
        )
    end = time.monotonic() + LONGEST
    while any(search.alive() for search in searches) and time.monotonic() < end:
        time.sleep(0.1)
    assert [search.end()[0] for search in searches] == [0, 0]
