# SPDX-License-Identifier: Apache-2.0
"""The names of all presets, for options, parameters and files that only name one.

`registry.py` contains the presets themselves.
"""

DEFAULT = 'default'
#: name of the preset that follows the paper exactly, with which experiments compare other presets
PAPER_PRESET = 'paper'
PRESET_NAMES = DEFAULT, PAPER_PRESET
