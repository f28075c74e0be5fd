# SPDX-License-Identifier: Apache-2.0
"""Keeps what the next start of the estimator has to know: offsets, isolated muscles and doubts.

An estimator that finds the file `estimator.offsets` isolates the muscles that the file names, and
doubts the joint sensors that it names. It uses the saved length offsets, so that estimates and
commands change little at the restart. It considers these offsets unknown until the next length
calibration, because the modules may have lost their counts meanwhile. The file contains no offsets
if all are known to be zero, as with absolute sensors that were never calibrated. No file is created
as long as, in addition, no muscle is isolated and no joint sensor is in doubt.

Without this file, a restarted estimator would publish a healthy body with offsets of zero, and the
other nodes would have to find out by themselves that this is wrong. It would also take the readings
of a slipped joint sensor for usual.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from musculoskeletal_ae.estimation.detectors.joint_sensor_trust import SensorDoubt
from musculoskeletal_ae.remembered_text import RememberedText
from musculoskeletal_ae.signals.body_state import (
    MOST_OFFSET,
    UNKNOWN,
    BodyState,
    LengthOffsets,
    Trust,
)

FILE = 'estimator.offsets'  # name of the file, in the directory that the user chooses
LOST = (
    'length offsets, isolated muscles and joint sensors in doubt cannot be saved, so a restarted '
    'estimator will not know them'
)


class BodyMemory:
    """Reads and writes the file of length offsets, isolated muscles and joint sensors in doubt.

    Attributes:
        found: The body state that the previous estimator saved; None if there is no file. Its
            offsets are known only if the file states that all are zero. Otherwise they are unknown:
            the saved values, or 0 for muscles that the file does not name.
        doubts: The joint sensors that the previous estimator doubted, by index of the joint.
    """

    def __init__(
        self, directory: Path | None, muscles: Sequence[str], joints: Sequence[str] = ()
    ) -> None:
        """Read the file of the previous estimator.

        Args:
            directory: Directory of the file. With None, nothing is read or saved.
            muscles: Names of all muscles.
            joints: Names of all joints.
        """
        self._muscles, self._joints = muscles, joints
        self.doubts: dict[int, SensorDoubt] = {}
        self._file: RememberedText | None = None
        self._was_decided = True  # whether the last offsets were known or revoked, not provisional
        #: what the file contains: offsets, isolated muscles, and joints whose sensors are in doubt
        self._saved: tuple[LengthOffsets, tuple[int, ...], tuple[int, ...]] | None = None
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

        The doubts that it states become `doubts`. If the text is damaged, all length offsets are
        unknown, and no muscle is isolated.
        """
        with suppress(ValueError, TypeError, KeyError, AttributeError):
            content = json.loads(text)
            names, generation = content.get('isolated', []), int(content['generation'])
            isolated = tuple(m for m, name in enumerate(self._muscles) if name in names)
            saved, doubts = content['offset'], content.get('doubted', {})
            self.doubts = {
                j: _doubt(doubts[name]) for j, name in enumerate(self._joints) if name in doubts
            }
            if saved is None and generation >= 0:
                known = LengthOffsets.none(len(self._muscles))
                return BodyState(known, isolated, generation=generation)
            offset = np.array([float(saved.get(name, 0.0)) for name in self._muscles])
            if (np.abs(offset) <= MOST_OFFSET).all() and generation >= 0:
                offsets = LengthOffsets.of(offset, UNKNOWN, Trust.UNKNOWN)
                return BodyState(offsets, isolated, generation=generation)
        return BodyState(LengthOffsets.unknown(len(self._muscles)))

    def note(self, body: BodyState, doubts: Mapping[int, SensorDoubt] | None = None) -> None:
        """Note what the next estimator has to know, and save it if it has changed.

        Provisional offsets of a calibration are not saved. If writing fails, `problem` states the
        reason, and a later call tries again.

        Args:
            body: The present body state.
            doubts: The joint sensors in doubt, by index of the joint; None if there are none.
        """
        if self._file is None:
            return
        offsets, doubts = body.offsets, {} if doubts is None else doubts
        is_decided = offsets.known or bool(offsets.revoked)
        if self._saved is not None and not (is_decided or self._was_decided):
            offsets = self._saved[0]
        is_healthy = _are_zero(offsets) and not body.isolated and not doubts
        has_file = self.found is not None or self._saved is not None
        content = offsets, body.isolated, tuple(doubts)
        if self._saved == content or (is_healthy and not has_file):
            self._file.keep()  # an attempt to save another body state may have failed
        elif self._file.write(self._text(offsets, body, doubts)):
            self._saved = content
        else:  # a later call tries again
            return
        self._was_decided = is_decided

    def _text(
        self, offsets: LengthOffsets, body: BodyState, doubts: Mapping[int, SensorDoubt]
    ) -> str:
        by_name = dict(zip(self._muscles, offsets.offset.tolist(), strict=True))
        content = {
            'generation': body.generation,
            'offset': None if _are_zero(offsets) else by_name,
            'isolated': [self._muscles[muscle] for muscle in body.isolated],
            'doubted': {
                self._joints[j]: [value if math.isfinite(value) else None for value in doubt]
                for j, doubt in doubts.items()
            },
        }
        return json.dumps(content)


def _doubt(values: Sequence[float | None]) -> SensorDoubt:
    """Return the doubt with these values, as the file states them; null stands for NaN."""
    deviation, usual, spread = (math.nan if value is None else float(value) for value in values)
    if not math.isfinite(deviation) or math.isinf(usual) or math.isinf(spread):
        raise ValueError(values)
    return SensorDoubt(deviation, usual, spread)


def _are_zero(offsets: LengthOffsets) -> bool:
    """Return whether all offsets are known to be zero."""
    return offsets.known and not offsets.offset.any()
