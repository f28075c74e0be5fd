# SPDX-License-Identifier: Apache-2.0
"""Thin rclpy shells: declare parameters, convert messages, call the core, publish."""
