# SPDX-License-Identifier: Apache-2.0
"""Keeps length offsets on disk, so that an estimator that is started again knows of them.

The file `estimator.offsets` exists unless the offsets are known to be zero, as those of absolute
sensors that were never calibrated. An estimator that finds it considers its length offsets unknown
until the next length calibration, because the modules may have lost their counts meanwhile. It uses
the saved offsets until then, so that estimates and commands change little.

Without this file, an estimator that has restarted would assume offsets of zero. The other nodes
would have to conclude from the change that these are wrong.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.signals.body_state import MOST_OFFSET, LengthOffsets

FILE = 'estimator.offsets'
LARGEST = 1_000_000  # size limit of the file [bytes]


class SavedOffsets(NamedTuple):
    """What the previous estimator has left behind."""

    offset: Array  # [m], (M,); 0 for muscles that the file does not name
    generation: int


class OffsetMemory:
    """Reads and writes the file.

    Attributes:
        found: The offsets that the previous estimator has left behind, or None.
        problem: Why the present offsets are not saved, as a text for users, or ''.
    """

    def __init__(self, directory: Path | None, muscles: Sequence[str]) -> None:
        """Read the file.

        Args:
            directory: Directory of the file. With None, nothing is read or saved.
            muscles: Names of all muscles.
        """
        self._muscles = muscles
        self._file: Path | None = None
        self._was_decided = True  # whether the last offsets were known or revoked
        self.found: SavedOffsets | None = None
        self.problem = ''
        # A NUL in the path raises a ValueError, and an unknown home directory a RuntimeError.
        with suppress(OSError, ValueError, RuntimeError):
            if directory is not None:
                self._file = directory.expanduser() / FILE
                if self._file.exists():
                    self.found = self._read(self._file)

    def _read(self, file: Path) -> SavedOffsets:
        """Return the content of the file; offsets of 0 if it is damaged."""
        nothing = SavedOffsets(np.zeros(len(self._muscles)), 0)
        with suppress(MusculoskeletalError, ValueError, TypeError, KeyError, AttributeError):
            content = json.loads(
                read_text(file, lambda _, problem: MusculoskeletalError(problem), LARGEST)
            )
            offset = np.array([float(content['offset'].get(name, 0.0)) for name in self._muscles])
            generation = int(content['generation'])
            if (np.abs(offset) <= MOST_OFFSET).all() and generation >= 0:
                return SavedOffsets(offset, generation)
        return nothing

    def note(self, offsets: LengthOffsets) -> None:
        """Save the offsets that hold from now on, or delete the file if they are zero.

        Provisional offsets of a calibration are not saved.
        """
        is_decided = offsets.known or bool(offsets.revoked)
        if self._file is None or not (is_decided or self._was_decided):
            return
        self._was_decided = is_decided
        try:
            self._save(self._file, offsets)
            self.problem = ''
        except OSError as error:
            self.problem = (
                'the length offsets cannot be saved, so a restarted estimator will not know them: '
                f'{error}'
            )

    def _save(self, file: Path, offsets: LengthOffsets) -> None:
        if offsets.known and not offsets.offset.any():
            file.unlink(missing_ok=True)
            return
        content = {
            'generation': offsets.generation,
            'offset': dict(zip(self._muscles, offsets.offset.tolist(), strict=True)),
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        # Write without fsync, which could delay an estimate by 0.1 s. If the process is killed,
        # nothing that was written is lost. A power failure may leave an empty file; it has the same
        # effect, with offsets of 0.
        new = file.with_name(f'.{FILE}')
        new.write_text(json.dumps(content), encoding='utf-8')
        new.replace(file)
