# SPDX-License-Identifier: Apache-2.0
"""Whether the driver of a real arm keeps its contract (doc/howto/your_robot.md, without ROS)."""
