# SPDX-License-Identifier: Apache-2.0
"""ROS nodes, as thin rclpy shells around the core modules; `shell` has their common code.

A node declares parameters, converts messages, calls the core, and publishes the results.
"""
