# SPDX-License-Identifier: Apache-2.0
"""Command-line tools on the ROS graph: view, replay, record, render, check_driver."""
