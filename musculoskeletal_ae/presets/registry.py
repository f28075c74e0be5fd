# SPDX-License-Identifier: Apache-2.0
"""All presets by name.

To add a preset, name it in `preset.py`, implement the methods of `Preset` in a class, and add an
instance to `PRESETS`.
"""

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.presets.default import DefaultPreset
from musculoskeletal_ae.presets.paper import PaperPreset
from musculoskeletal_ae.presets.preset import PRESET_NAMES, Preset

#: presets by name; the instances are in the order of `PRESET_NAMES`
PRESETS: dict[str, Preset] = dict(zip(PRESET_NAMES, (DefaultPreset(), PaperPreset()), strict=True))


def preset_named(name: str) -> Preset:
    """Return the preset of this name.

    Raises:
        MusculoskeletalError: If no preset has this name.
    """
    if name not in PRESETS:
        raise MusculoskeletalError(f'preset {name!r} is unknown; legal: {", ".join(PRESETS)}')
    return PRESETS[name]
