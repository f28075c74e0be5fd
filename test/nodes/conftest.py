# SPDX-License-Identifier: Apache-2.0
"""A graph per test, and one quickly trained network for all of them."""

from __future__ import annotations

import itertools
import os

import pytest
from graph import Graph

from musculoskeletal_ae.mae import checkpoint, evaluation
from musculoskeletal_ae.mae.network import to_mae
from musculoskeletal_ae.mae.training import initial_training
from musculoskeletal_ae.robot.robot import Robot

_counter = itertools.count(1)


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def trained(arm26, tmp_path_factory) -> str:
    """Return a checkpoint file of arm26, trained for a few seconds."""
    from dataclasses import replace

    network, _ = initial_training(arm26, 'default', steps=600)
    mae = to_mae(network, arm26.joints, arm26.muscles, 'default', 'briefly, for a test')
    mae = replace(mae, anomaly=evaluation.geometric_anomaly(mae, arm26, seed=0))
    path = tmp_path_factory.mktemp('checkpoint') / 'arm26.safetensors'
    checkpoint.save(mae, path)
    return str(path)


@pytest.fixture
def graph():
    """Return a graph whose topics no other test sees: a namespace of its own."""
    graph = Graph(f'/test_{os.getpid()}_{next(_counter)}')
    yield graph
    graph.close()
