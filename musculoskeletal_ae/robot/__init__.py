# SPDX-License-Identifier: Apache-2.0
"""The geometric model of an arm, read from a robot directory.

`description` reads the directory. `robot` builds the model from it: `kinematics` (poses, gravity),
`routes` (muscle lengths and G), `series_elastic` and `stiffness`. `tension` solves for muscle
tensions. `design/` tests whether the muscles can hold the arm.
"""
