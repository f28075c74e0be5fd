# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions out of other people's formats: what `import_robot` does.

`source` is what every format is read into, cut to the asked-for chain and written as a robot
directory; `mjcf`, `cardsflow` (with URDF and SDF) and `opensim` read the formats.
"""
