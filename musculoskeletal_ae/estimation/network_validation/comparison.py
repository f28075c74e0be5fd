# SPDX-License-Identifier: Apache-2.0
"""A quantity of a network compared with a reference, with the limit of each error."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from musculoskeletal_ae.arrays import Array


class Comparison(NamedTuple):
    """How much one quantity of a network differs from its reference."""

    name: str  # name of the quantity for users, such as 'θ'
    owners: tuple[str, ...]  # joint or muscle of each error
    error: Array  # error of each joint or muscle, or one error of all
    limit: Array  # largest permitted value of each error
    reference: str  # where the error comes from, such as 'from joint sensors'

    @property
    def worst(self) -> int | None:
        """Index of the error that exceeds its limit most; None if none does."""
        excess = self.error / self.limit
        return None if excess.max() <= 1.0 else int(excess.argmax())

    def faults(self) -> Iterator[str]:
        """Yield a text for users on the error that exceeds its limit most; nothing if none does."""
        if (worst := self.worst) is not None:
            yield (
                f'{self.name}, {self.owners[worst]}: error {self.error[worst]:.3g} '
                f'{self.reference}, limit {self.limit[worst]:.3g}'
            )
