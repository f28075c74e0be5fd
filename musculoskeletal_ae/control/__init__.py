# SPDX-License-Identifier: Apache-2.0
"""From a target to a command that the arm can follow safely.

`controller` connects the parts. `supervisor` decides what the arm does, and `stops` declares why it
stops; `watchdog` finds the causes that are present. `planner` makes trajectories of targets and
poses, and `follower` follows them. `methods` holds the equations that make commands of a posture,
`ramps`, `torque`, `exploration` and `calibrating` are the other activities, and `stopping` is what
a stopped arm does. `limiter` is the last thing that every command passes. `status` reports to
people and programs.
"""
