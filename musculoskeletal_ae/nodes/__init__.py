# SPDX-License-Identifier: Apache-2.0
"""ROS nodes and tools, as thin rclpy shells around the core modules.

A node declares parameters, converts messages, calls the core, and publishes the results.
"""
