# SPDX-License-Identifier: Apache-2.0
"""The emulator model `foreign`: a body in MuJoCo with effects that no part of the package models.

Begin with `arm.py`. `effects.py` lists the unmodelled effects and draws their sizes, `deviation.py`
and `mujoco_model.py` build the body, and `tendons.py` moves its tendons.
"""
