# SPDX-License-Identifier: Apache-2.0
"""Check the driver of a real arm against its contract (doc/howto/your_driver.md), without ROS."""
