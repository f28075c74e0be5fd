# SPDX-License-Identifier: Apache-2.0
"""The names of all presets, for options, parameters and checks of files.

These need no preset itself. `registry.py` contains the presets.
"""

DEFAULT = 'default'
#: name of the preset that follows the paper, with which experiments compare other presets
PAPER_PRESET = 'paper'
PRESET_NAMES = DEFAULT, PAPER_PRESET
