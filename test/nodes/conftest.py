# SPDX-License-Identifier: Apache-2.0
"""A ROS graph for each test."""

import itertools
import os

import pytest
from graph import Graph

from musculoskeletal_ae.robot.robot import Robot

_counter = itertools.count(1)


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')


@pytest.fixture
def graph():
    """Return a graph with a private namespace."""
    graph = Graph(f'/test_{os.getpid()}_{next(_counter)}')
    yield graph
    graph.close()
