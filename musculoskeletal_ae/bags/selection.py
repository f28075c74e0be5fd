# SPDX-License-Identifier: Apache-2.0
"""Which of a bag's topics are meant, and what they are called without the recorded namespace."""

from __future__ import annotations

from collections.abc import Sequence

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import (
    SENT,
    TOPICS,
    interface_name,
    recorded_namespace,
    relative_name,
)
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError

DEFAULT, ALL = 'default', 'all'


def interface_topics(bag: Bag, namespace: str | None = None) -> dict[str, str]:
    """Return the recorded name of each topic of the interface, by its relative name.

    Args:
        bag: An opened bag.
        namespace: The one that is meant where the bag has several.

    Raises:
        BagError: If there are several, or a topic has a type other than the interface's.
    """
    names = _stripped(bag, namespace)
    found = {relative: name for name, relative in names.items() if relative in TOPICS}
    for relative, name in found.items():
        _compare_type(bag, name, relative)
    return found


def select(
    bag: Bag, wanted: Sequence[str], namespace: str | None, keep_names: bool
) -> dict[str, str]:
    """Return the name to publish each wanted topic on, by its recorded name.

    Args:
        bag: An opened bag.
        wanted: `default` (what hardware, vision, user and controller sent), `all` (every topic of
            the interface), or relative or recorded names; these may be foreign to the interface.
        namespace: The one that is meant where the bag has several.
        keep_names: Publish under the recorded names.

    Raises:
        BagError: If nothing is left, or a wanted topic is not there or cannot be used.
    """
    if keep_names and namespace is None:
        # Several namespaces are no problem when all names stay as they are.
        relative = {name: interface_name(name) for name in bag.topics}
    else:
        relative = _stripped(bag, namespace)
    has = f'it has: {", ".join(sorted(bag.topics))[:500] or "no topics"}'
    if list(wanted) in ([DEFAULT], [ALL]):
        relevant = SENT if list(wanted) == [DEFAULT] else list(TOPICS)
        chosen = [name for name in bag.topics if relative[name] in relevant]
        if not chosen:
            problem = f'has no topic to replay by default; {has}'
            raise BagError(bag.path, None, problem, 'choose with --topics all or --topics NAME,…')
    else:
        chosen = []
        for name in wanted:
            found = [key for key in bag.topics if name in (key, relative[key])]
            if not found:
                raise BagError(bag.path, None, f'topic {name} is not in the bag', has)
            chosen += found
    for name in chosen:
        _compare_type(bag, name, relative[name])
    return {name: name if keep_names else relative[name] for name in chosen}


def _stripped(bag: Bag, namespace: str | None) -> dict[str, str]:
    try:
        namespace = recorded_namespace(bag.topics, namespace)
    except MusculoskeletalError as error:
        raise BagError(bag.path, None, *str(error).split('; ', 1)) from error
    return {name: relative_name(name, namespace) for name in bag.topics}


def _compare_type(bag: Bag, name: str, relative: str) -> None:
    topic = bag.topics[name]
    expected = TOPICS[relative].type if relative in TOPICS else topic.type
    if topic.type != expected:
        problem = f'topic {name} has the type {topic.type[:80]!r}, not {expected!r}'
        raise BagError(bag.path, None, problem, 'rename the topic where it is recorded')
    if topic.refused:
        raise BagError(bag.path, None, f'topic {name} {topic.refused}', 'leave it out')
