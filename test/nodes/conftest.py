# SPDX-License-Identifier: Apache-2.0
"""A graph per test, and one quickly trained network for all of them."""

from __future__ import annotations

import itertools
import os

import pytest
from graph import Graph

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot

_counter = itertools.count(1)


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def trained(trained, tmp_path_factory) -> str:
    """Return a checkpoint file of arm26."""
    path = tmp_path_factory.mktemp('checkpoint') / 'arm26.safetensors'
    checkpoint.save(trained['default'], path)
    return str(path)


@pytest.fixture
def graph():
    """Return a graph whose topics no other test sees: a namespace of its own."""
    graph = Graph(f'/test_{os.getpid()}_{next(_counter)}')
    yield graph
    graph.close()
