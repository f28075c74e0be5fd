# SPDX-License-Identifier: Apache-2.0
"""A ROS graph for each test, as for the nodes."""

from nodes.conftest import arm26, graph

__all__ = ['arm26', 'graph']
