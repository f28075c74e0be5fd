# SPDX-License-Identifier: Apache-2.0
"""The names of all presets, for options, parameters and checks of files.

The names are separate, so that they can be imported without the presets, which `registry.py`
contains.
"""

DEFAULT = 'default'  # name of the preset with the most accurate methods of this project
#: name of the preset that follows the paper, with which experiments compare other presets
PAPER_PRESET = 'paper'
PRESET_NAMES = DEFAULT, PAPER_PRESET  # legal values of parameters and options that name a preset
