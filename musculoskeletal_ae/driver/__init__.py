# SPDX-License-Identifier: Apache-2.0
"""Check the driver of a real arm against its contract (doc/howto/your_driver.md), without ROS.

First, `listening` judges the messages of the resting arm. Then the arm moves one muscle after the
other: `stiffness_motion_test` for modules with muscle stiffness control, `position_motion_test` for
modules that follow positions. All of them report to `verdict`.
"""
