# SPDX-License-Identifier: Apache-2.0
"""The emulator model `kin`: the described body with other sizes, in own rigid-body dynamics.

`arm.py` moves the arm and rubs its tendons, `individual.py` draws the sizes, and `wrapping.py`
leads the tendons around bones.
"""
