# SPDX-License-Identifier: Apache-2.0
"""The parameters of the node `learner` that are read once, at its start."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from musculoskeletal_ae.learning.rest import RestSettings
from musculoskeletal_ae.learning.store import Novelty
from musculoskeletal_ae.nodes.shell import Shell

SOURCES = {'sensor': 'joint_states', 'marker': 'vision_joint_states'}
AUTO = 'auto'


class LearnerSettings(NamedTuple):
    """What was given.

    Attributes:
        preset: How to learn.
        seed: Of everything random.
        steps: Of training per update.
        joint_topic: Where θ comes from.
        directory: Where samples and network are kept; None for nowhere.
        rest: What counts as rest.
        novelty: What counts as new.
    """

    preset: str
    seed: int
    steps: int
    joint_topic: str
    directory: Path | None
    rest: RestSettings
    novelty: Novelty


def read_settings(node: Shell) -> LearnerSettings:
    """Read them.

    Raises:
        MusculoskeletalError: If one is not legal.
    """
    value = node.parameter
    return LearnerSettings(
        value('preset'),
        value('seed'),
        value('update_steps'),
        SOURCES[value('joint_source')],
        _directory(node, value('state_directory')),
        RestSettings(value('rest_time'), value('rest_joint_rate'), value('rest_length_rate')),
        Novelty(value('new_joint_distance'), value('new_tension_distance')),
    )


def _directory(node: Shell, value: str) -> Path | None:
    if value != AUTO:
        return Path(value) if value else None
    home = os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state'
    place = Path(home) / 'musculoskeletal_ae' / node.robot.description.directory.name
    return place.joinpath(*node.get_namespace().strip('/').split('/'))
