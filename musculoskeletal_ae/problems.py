# SPDX-License-Identifier: Apache-2.0
"""Declares what a tool reports about a robot description, a driver or a recording.

Each tool has a table of its problems, a YAML file beside its code. A row of it is a problem with
placeholders, `KIND: [text, remedy, check, subjects]`; the last two may be missing. What can be
wrong with a running arm is declared in `conditions.py` instead.
"""

from __future__ import annotations

from msgspec.structs import replace

from musculoskeletal_ae.files import read_table
from musculoskeletal_ae.schema import Strict


class Problem(Strict, frozen=True, array_like=True):
    """A fault or a warning that a tool reports, with its remedy."""

    text: str  # what was observed
    remedy: str  # what to do; '' if the tool computes it
    check: str = ''  # the check that finds it, if the tool has several checks
    #: names of what is affected, such as muscles: stated by the table, or by the tool (`filled`)
    subjects: tuple[str, ...] = ()
    kind: str = ''  # an identifier, such as 'wrong_sign'

    def filled(self, *subjects: str, **values: object) -> Problem:
        """Return this row of a table as a problem, with values in place of the placeholders.

        `subjects` are affected, unless the table states other ones.
        """
        return replace(
            self,
            text=self.text.format(**values),
            remedy=self.remedy.format(**values),
            subjects=self.subjects or subjects,
        )


def read_problems(code: str, name: str) -> dict[str, Problem]:
    """Return a table of problems that lies in the folder of a Python file.

    A part of a key after a comma names a variant of the kind, with texts of its own.

    Args:
        code: Path of the Python file.
        name: Name of the YAML file.
    """
    table = read_table(code, name, dict[str, Problem])
    return {key: replace(row, kind=key.partition(',')[0]) for key, row in table.items()}
