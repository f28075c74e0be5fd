# SPDX-License-Identifier: Apache-2.0
"""Converts raw messages of muscle modules and joint sensors to checked samples for all other parts.

`muscle_stream` checks the messages of the muscles, and `joint_stream` those of the joint sensors;
begin there. `body_state` is what the nodes know about the body: trusted lengths, isolated muscles.
"""
