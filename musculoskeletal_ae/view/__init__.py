# SPDX-License-Identifier: Apache-2.0
"""The page in the browser: what it shows of an arm, without ROS."""
