# SPDX-License-Identifier: Apache-2.0
"""Arms that every claim about the geometric model is tested on."""

import pytest
from robots import write_robot

from musculoskeletal_ae.robot.robot import Robot

ARMS = ['musashi_left_arm', 'arm26', 'other', 'finger', 'slider']


@pytest.fixture(scope='session', params=ARMS)
def robot(request, tmp_path_factory) -> Robot:
    """Shipped arms; a permuted one; with a joint to lock; with a prismatic joint."""
    name = request.param
    if name in ('musashi_left_arm', 'arm26'):
        return Robot.load(name)
    directory = tmp_path_factory.mktemp(name)
    return Robot.load(write_robot(directory, finger=name == 'finger', slider=name == 'slider'))
