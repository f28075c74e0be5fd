# SPDX-License-Identifier: Apache-2.0
"""Recordings of rosbag2: written, read, checked and played without ROS."""
