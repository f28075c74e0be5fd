# SPDX-License-Identifier: Apache-2.0
"""The arms on which every claim about the geometric model is tested."""

import pytest
from robots import write_robot

from musculoskeletal_ae.robot.robot import Robot

ARMS = ['musashi_left_arm', 'arm26', 'other', 'finger', 'slider']


@pytest.fixture(scope='session', params=ARMS)
def robot(request, tmp_path_factory) -> Robot:
    """Shipped arms, and arms with permuted joints, a locked joint or a prismatic joint."""
    name = request.param
    if name in ('musashi_left_arm', 'arm26'):
        return Robot.load(name)
    directory = tmp_path_factory.mktemp(name)
    return Robot.load(write_robot(directory, finger=name == 'finger', slider=name == 'slider'))
