# SPDX-License-Identifier: Apache-2.0
"""What the arm is: the nominal body of a robot directory.

`description` reads it, `robot` puts together what follows from it: `kinematics` (poses, gravity),
`routes` (muscle lengths and G), `series_elastic` and `stiffness`. `tension` solves for muscle
tensions, `checks` judges whether the arm can be held.
"""
