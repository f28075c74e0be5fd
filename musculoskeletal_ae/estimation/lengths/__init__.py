# SPDX-License-Identifier: Apache-2.0
"""Length offsets: how they are found, checked, trusted and remembered.

`length_trust` decides which offsets are known; begin there. The other files provide evidence.
"""
