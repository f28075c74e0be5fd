# SPDX-License-Identifier: Apache-2.0
"""The web page that shows an arm; independent of ROS."""
