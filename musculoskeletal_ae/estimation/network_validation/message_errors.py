# SPDX-License-Identifier: Apache-2.0
"""Checks how exactly a candidate network reconstructs the readings of recent messages.

Three errors are compared. With mask ②, the network estimates joint angles from tensions and
lengths, and reconstructs the tensions (first error) and the lengths (second error). With mask ①, it
computes the lengths at these joint angles (third error). The median error of each muscle over the
messages must be below WORSE times that of the network in use, or below FLOOR.
"""

from collections.abc import Iterable

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.network_validation.comparison import Comparison
from musculoskeletal_ae.estimation.network_validation.recent_messages import RecentMessages
from musculoskeletal_ae.mae.mae import Mae

#: reject a network whose error exceeds that of the network in use by this factor
WORSE = 2.0
#: never reject a network for errors of tensions T [N] and lengths l [m] smaller than these; ① and ②
#: are the masks with which the network computes them
FLOOR = {'T by ②': 40.0, 'l by ②': 0.06, 'l by ① at θ of ②': 0.06}
#: warn that a network chosen by a user is worse than the one in use only if its error of a length
#: exceeds this [m]
CLEAR = 0.01


def message_errors(mae: Mae, messages: RecentMessages, isolated: Iterable[int]) -> dict[str, Array]:
    """Return the median errors with which a network reconstructs the readings of recent messages.

    Returns:
        By each name in FLOOR, such as 'T by ②', the error of every muscle [N] or [m], (M,). The
        errors of isolated muscles are 0. The result is empty if there are too few messages.
    """
    if not messages.are_enough:
        return {}
    tension, length = messages.readings(mae)
    muscle_count = tension.shape[1]
    reconstructed = mae.estimate(tension, length)
    used = np.delete(np.arange(muscle_count), tuple(isolated))
    parts = (
        reconstructed.tension - tension,
        reconstructed.length - length,
        mae.lengths(reconstructed.theta, tension) - length,
    )
    errors = {name: np.zeros(muscle_count) for name in FLOOR}
    for error, part in zip(errors.values(), parts, strict=True):
        error[used] = np.median(np.abs(part[:, used]), axis=0)
    return errors


def comparisons(
    errors: dict[str, Array], in_use: dict[str, Array], muscles: tuple[str, ...]
) -> list[Comparison]:
    """Return comparisons of the errors of a candidate with those of the network in use.

    Args:
        errors: Errors of the candidate.
        in_use: Errors of the network in use.
        muscles: Names of the muscles.
    """
    return [
        _compared(name, muscles, error, FLOOR[name], in_use[name]) for name, error in errors.items()
    ]


def worse_length(
    errors: dict[str, Array], in_use: dict[str, Array], muscles: tuple[str, ...]
) -> str:
    """Return a text on the muscle whose length a network computes clearly worse than that in use.

    The arguments are those of `comparisons`.

    Returns:
        The muscle with both errors; '' if no error is above CLEAR and WORSE times that of the
        network in use.
    """
    name = 'l by ① at θ of ②'
    error, before = errors[name], in_use[name]
    worst = _compared(name, muscles, error, CLEAR, before).worst
    if worst is None:
        return ''
    return (
        f'its error of the length of {muscles[worst]} is {1e3 * error[worst]:.0f} mm, that of the '
        f'network before was {1e3 * before[worst]:.0f} mm'
    )


def _compared(
    name: str, muscles: tuple[str, ...], error: Array, least: float, before: Array
) -> Comparison:
    """Compare errors with `least` and with WORSE times the errors before, whichever is larger."""
    limit = np.fmax(least, WORSE * before)
    return Comparison(name, muscles, error, limit, 'on recent messages')
