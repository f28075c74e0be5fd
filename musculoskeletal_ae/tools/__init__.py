# SPDX-License-Identifier: Apache-2.0
"""Command-line tools; none needs a ROS graph."""
