# SPDX-License-Identifier: Apache-2.0
"""Code that nodes and ROS tools share: running, parameters, diagnostics, publishers."""
