# SPDX-License-Identifier: Apache-2.0
"""How the arm moves: from targets to the commands that `control/` checks.

`planner` turns targets and hand poses into trajectories, and `follower` follows them; begin there.
`methods` contains the equations from postures to commands. `ramps`, `torque`, `exploration` and
`calibrating` are the other activities.
"""
