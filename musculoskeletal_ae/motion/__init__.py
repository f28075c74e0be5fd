# SPDX-License-Identifier: Apache-2.0
"""How the arm moves: from targets to the commands that `control/` checks.

`planner` turns targets and hand poses into trajectories, and `follower` follows them; begin there.
`tension_plan` chooses the tensions along a trajectory. `ramps`, `torque`, `exploration` and
`calibration_motion` are the other activities. `methods` describes methods that command
lengths, and has the equations of the joint stiffness.
"""
