# SPDX-License-Identifier: Apache-2.0
"""Online learning: collects samples, and updates body and network.

`learner` connects the parts; begin there. `body_model/` has the body that an update fits.
"""
