# SPDX-License-Identifier: Apache-2.0
"""The parameters that the node `learner` reads once, at its start."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning.online import STEPS
from musculoskeletal_ae.learning.rest import RestSettings
from musculoskeletal_ae.learning.store import Novelty
from musculoskeletal_ae.nodes.parameters import declare_preset, number, text, whole
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


def declare_settings(node: Shell) -> LearnerSettings:
    """Declare and read them.

    Raises:
        MusculoskeletalError: If the preset or the source of θ is unknown.
    """

    def positive(name: str, default: float, meaning: str, most: float) -> float:
        value = node.declare_parameter(name, default, number(meaning, 0.0, most, True)).value
        return float(value)

    preset = declare_preset(node, 'how to learn')
    seed = node.declare_parameter('seed', 0, whole('of everything random'))
    meaning = f'where θ comes from: {tuple(SOURCES)}'
    source = node.declare_parameter('joint_source', 'sensor', text(meaning, True)).value
    if source not in SOURCES:
        legal = ', '.join(SOURCES)
        raise MusculoskeletalError(f'parameter joint_source: {source!r}; legal: {legal}')
    meaning = "for samples and network; 'auto': below XDG_STATE_HOME; '': nothing kept"
    place = node.declare_parameter('state_directory', AUTO, text(meaning, True))
    meaning = 'steps of training per update, preset default'
    steps = node.declare_parameter('update_steps', STEPS, text(meaning, True))
    rest, novelty = RestSettings(), Novelty()
    return LearnerSettings(
        preset,
        seed.value,
        steps.value,
        SOURCES[source],
        _directory(node, place.value),
        RestSettings(
            positive('rest_time', rest.window, 'how long the arm has to be still [s]', 10.0),
            positive('rest_joint_rate', rest.joint_rate, 'fastest joint at rest [rad/s]', 1.0),
            positive('rest_length_rate', rest.length_rate, 'fastest l at rest [m/s]', 1.0),
        ),
        Novelty(
            positive('new_joint_distance', novelty.joint, 'to stored samples [rad]', 3.0),
            positive('new_tension_distance', novelty.tension, 'to stored ones [N]', 500.0),
        ),
    )


def _directory(node: Shell, value: str) -> Path | None:
    if value != AUTO:
        return Path(value) if value else None
    home = os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state'
    place = Path(home) / 'musculoskeletal_ae' / node.robot.description.directory.name
    return place.joinpath(*node.get_namespace().strip('/').split('/'))
