# SPDX-License-Identifier: Apache-2.0
"""The emulator model `kin`: the described body with random deviations, and its dynamics.

`arm.py` simulates the motion and the friction of the arm, `individual.py` draws the deviations, and
`wrapping.py` leads the tendons around bones.
"""
