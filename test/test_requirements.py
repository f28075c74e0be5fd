# SPDX-License-Identifier: Apache-2.0
"""The tested versions in requirements.txt lie in the declared ranges of setup.cfg."""

from configparser import ConfigParser
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mujoco_version import RANGE, check_mujoco

ROOT = Path(__file__).parents[1]
BUILD_TOOLS = {'colcon-common-extensions'}  # pinned, but only needed to build the package


def ranges():
    config = ConfigParser()
    config.read(ROOT / 'setup.cfg', encoding='utf-8')
    lines = config['options']['install_requires'].split('\n')
    return {r.name: r.specifier for r in map(Requirement, filter(None, lines))}


def pins():
    lines = (ROOT / 'requirements.txt').read_text(encoding='utf-8').splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith('#')]


def test_every_requirement_has_a_range_and_a_pin_within_it():
    declared = ranges()
    assert {pin.name for pin in pins()} - BUILD_TOOLS == set(declared)
    for pin in pins():
        (exactly,) = pin.specifier
        assert exactly.operator == '==' and '*' not in exactly.version
        assert pin.name in BUILD_TOOLS or declared[pin.name].contains(exactly.version), pin


def test_a_mujoco_outside_the_range_is_refused_with_the_range():
    specifier = ranges()['mujoco']
    first, end = ('.'.join(map(str, bound)) for bound in RANGE)
    assert str(specifier) == f'<{end},>={first}'
    for version in ('3.10.0', '3.17.0'):
        check_mujoco(version)
    for version in ('3.9.9', '4.0.0', '4.0.0rc1'):
        with pytest.raises(MusculoskeletalError, match=rf'{version}.*>=3\.10,<4'):
            check_mujoco(version)
