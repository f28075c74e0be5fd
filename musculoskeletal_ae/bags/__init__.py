# SPDX-License-Identifier: Apache-2.0
"""Recordings: rosbag2 directories with one mcap file, written, checked and read without ROS."""
