# SPDX-License-Identifier: Apache-2.0
"""Thin rclpy shells: declare parameters, convert messages, call the core, publish."""

import sys

# With its first message every process would load a parser of message definitions, which nobody here
# needs and rosidl_generator_py does without.
sys.modules.setdefault('rosidl_generator_py.generate_py_impl', None)  # type: ignore[arg-type]
