# SPDX-License-Identifier: Apache-2.0
"""Keeps length offsets and isolated muscles on disk, for the next start of the estimator.

An estimator that finds the file `estimator.offsets` isolates the muscles that the file names. It
uses the saved length offsets, so that estimates and commands change little at the restart. It
considers these offsets unknown until the next length calibration, because the modules may have lost
their counts meanwhile. The file contains no offsets if all are known to be zero, as with absolute
sensors that were never calibrated. No file is created as long as, in addition, no muscle is
isolated.

Without this file, a restarted estimator would publish a healthy body with offsets of zero, and the
other nodes would have to find out by themselves that this is wrong.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from musculoskeletal_ae.remembered_text import RememberedText
from musculoskeletal_ae.signals.body_state import MOST_OFFSET, BodyState, LengthOffsets

FILE = 'estimator.offsets'  # name of the file, in the directory that the user chooses
LOST = (
    'length offsets and isolated muscles cannot be saved, so a restarted estimator will not know '
    'them'
)


class BodyMemory:
    """Reads and writes the file of length offsets and isolated muscles.

    Attributes:
        found: The body state that the previous estimator saved; None if there is no file. Its
            offsets are known only if the file states that all are zero. Otherwise they are unknown:
            the saved values, or 0 for muscles that the file does not name.
    """

    def __init__(self, directory: Path | None, muscles: Sequence[str]) -> None:
        """Read the file of the previous estimator.

        Args:
            directory: Directory of the file. With None, nothing is read or saved.
            muscles: Names of all muscles.
        """
        self._muscles = muscles
        self._file: RememberedText | None = None
        self._was_decided = True  # whether the last offsets were known or revoked, not provisional
        self._saved: tuple[LengthOffsets, tuple[int, ...]] | None = None  # what the file contains
        self.found: BodyState | None = None
        # A NUL in the path raises a ValueError, and an unknown home directory a RuntimeError.
        with suppress(OSError, ValueError, RuntimeError):
            if directory is not None:
                self._file = RememberedText(directory.expanduser() / FILE, LOST)
                if (text := self._file.read()) is not None:
                    self.found = self._parse(text)

    @property
    def problem(self) -> str:
        """Why the present body state could not be saved, as a text for users; '' if it was."""
        return '' if self._file is None else self._file.problem

    def _parse(self, text: str) -> BodyState:
        """Return the body state that the text of the file states.

        If the text is damaged, all length offsets are unknown, and no muscle is isolated.
        """
        unknown = LengthOffsets.unknown(len(self._muscles))
        with suppress(ValueError, TypeError, KeyError, AttributeError):
            content = json.loads(text)
            names, generation = content.get('isolated', []), int(content['generation'])
            isolated = tuple(m for m, name in enumerate(self._muscles) if name in names)
            saved = content['offset']
            if saved is None and generation >= 0:
                known = LengthOffsets.none(len(self._muscles))
                return BodyState(known, isolated, generation=generation)
            offset = np.array([float(saved.get(name, 0.0)) for name in self._muscles])
            if (np.abs(offset) <= MOST_OFFSET).all() and generation >= 0:
                offsets = LengthOffsets(offset, unknown.deviation)
                return BodyState(offsets, isolated, generation=generation)
        return BodyState(unknown)

    def note(self, body: BodyState) -> None:
        """Note the present body state, and save it if it has changed.

        Provisional offsets of a calibration are not saved. If writing fails, `problem` states the
        reason, and a later call tries again.
        """
        if self._file is None:
            return
        offsets = body.offsets
        is_decided = offsets.known or bool(offsets.revoked)
        if self._saved is not None and not (is_decided or self._was_decided):
            offsets, _ = self._saved
        is_healthy = _are_zero(offsets) and not body.isolated
        has_file = self.found is not None or self._saved is not None
        if self._saved == (offsets, body.isolated) or (is_healthy and not has_file):
            self._file.keep()  # an attempt to save another body state may have failed
        elif self._file.write(self._text(offsets, body)):
            self._saved = offsets, body.isolated
        else:  # a later call tries again
            return
        self._was_decided = is_decided

    def _text(self, offsets: LengthOffsets, body: BodyState) -> str:
        by_name = dict(zip(self._muscles, offsets.offset.tolist(), strict=True))
        content = {
            'generation': body.generation,
            'offset': None if _are_zero(offsets) else by_name,
            'isolated': [self._muscles[muscle] for muscle in body.isolated],
        }
        return json.dumps(content)


def _are_zero(offsets: LengthOffsets) -> bool:
    """Return whether all offsets are known to be zero."""
    return offsets.known and not offsets.offset.any()
