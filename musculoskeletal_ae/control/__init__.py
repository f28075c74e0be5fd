# SPDX-License-Identifier: Apache-2.0
"""From a target to a command that the arm can follow safely.

`controller` tells the whole story. `methods` holds the equations that make commands of a posture.
`posture` leads smoothly from goal to goal and corrects what is left at rest, `exploration` invents
the goals, `watch` says why the arm must not move, `safety` has the last word, and
`status` says it to people.
"""
