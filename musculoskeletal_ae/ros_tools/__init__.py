# SPDX-License-Identifier: Apache-2.0
"""Tools and services on the ROS graph: view, replay, record, render, check_driver."""
