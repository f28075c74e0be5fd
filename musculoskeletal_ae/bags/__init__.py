# SPDX-License-Identifier: Apache-2.0
"""Writes, reads, checks and plays bags of rosbag2. None of it needs ROS."""
