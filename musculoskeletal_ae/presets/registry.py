# SPDX-License-Identifier: Apache-2.0
"""All presets by name. A new one is a class with the methods of `Preset`, and an entry here."""

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.presets.default import DefaultPreset
from musculoskeletal_ae.presets.paper import PaperPreset
from musculoskeletal_ae.presets.preset import Preset

DEFAULT = DefaultPreset.name
#: the preset that does everything as printed; experiments show it beside the one they measure
AS_PRINTED = PaperPreset.name

PRESETS: dict[str, Preset] = {preset.name: preset for preset in (DefaultPreset(), PaperPreset())}


def preset_named(name: str) -> Preset:
    """Return the preset of that name.

    Raises:
        MusculoskeletalError: If there is none.
    """
    if name not in PRESETS:
        raise MusculoskeletalError(f'preset {name!r} is unknown; legal: {", ".join(PRESETS)}')
    return PRESETS[name]
