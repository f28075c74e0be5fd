# SPDX-License-Identifier: Apache-2.0
"""A graph per test."""

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
    """Return a graph whose topics no other test sees: a namespace of its own."""
    graph = Graph(f'/test_{os.getpid()}_{next(_counter)}')
    yield graph
    graph.close()
