# SPDX-License-Identifier: Apache-2.0
"""A graph per test."""

from __future__ import annotations

import itertools
import os

import pytest
from graph import Graph

_counter = itertools.count(1)


@pytest.fixture(scope='session')
def trained(arm26_checkpoint) -> str:
    """Return a checkpoint file of arm26, trained for a few seconds."""
    return arm26_checkpoint


@pytest.fixture
def graph():
    """Return a graph whose topics no other test sees: a namespace of its own."""
    graph = Graph(f'/test_{os.getpid()}_{next(_counter)}')
    yield graph
    graph.close()
