# SPDX-License-Identifier: Apache-2.0
"""The emulated arm: body, dynamics, muscle modules, heat and faults.

`reality.py` makes an arm of one of two emulator models: `kin/` (the described body with random
deviations) or `foreign/` (a body in MuJoCo with unmodelled effects). Both share the muscle modules
(`modules.py`), their faults (`faults.py`) and the joint sensors (`sensors.py`).
"""
