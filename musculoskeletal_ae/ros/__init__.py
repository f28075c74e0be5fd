# SPDX-License-Identifier: Apache-2.0
"""What any node or tool of ROS needs, whatever it does."""
