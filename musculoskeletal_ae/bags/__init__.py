# SPDX-License-Identifier: Apache-2.0
"""Write, read, check and play rosbag2 bags without ROS."""
