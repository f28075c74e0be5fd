# SPDX-License-Identifier: Apache-2.0
"""Code that every node and tool of ROS may use: running, parameters, diagnostics, publishers."""
