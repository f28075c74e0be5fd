# SPDX-License-Identifier: Apache-2.0
"""Control: turns targets into commands that the arm can follow safely.

`controller` connects the parts. `supervisor` decides what the arm does. `stops` declares the stop
causes, and `watchdog` detects them. `planner` turns targets and poses into trajectories, and
`follower` follows them. `methods` contains the equations from postures to commands. `ramps`,
`torque`, `exploration` and `calibrating` implement the other activities, and `stopping` computes
the commands while the arm is stopped. Every command finally passes the `limiter`. `status` reports
to users and programs.
"""
