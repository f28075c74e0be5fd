# SPDX-License-Identifier: Apache-2.0
"""Standard output and standard error that never raise an error.

The reader of a pipe may have closed it (`| head`), the disk may be full, the terminal may be gone,
or the process may have been started without standard streams. None of this may keep a node or a
tool from its work: text that cannot be written is discarded. A tool reports the loss by its exit
status (`options.exit_status`).
"""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from typing_extensions import Buffer

_DESCRIPTORS = range(3)  # file descriptors of standard input, output and error
#: wait at most this long until a terminal in non-blocking mode takes more text [s]
_LONGEST_WAIT = 1.0


class _Output(io.FileIO):
    """An output file that discards what it cannot write.

    Attributes:
        problem: The last error; None if everything was written.
    """

    problem: OSError | None = None

    def write(self, data: Buffer, /) -> int:
        try:
            written = super().write(data)
            if written is None:  # another program has set the terminal to non-blocking mode
                select.select([], [self], [], _LONGEST_WAIT)
                written = super().write(data)
        except OSError as error:
            self.problem = error
            written = None
        return memoryview(data).nbytes if written is None else written


def secure_output() -> None:
    """Secure stdout and stderr, so that writing to them never raises an error.

    Characters that the encoding of the terminal lacks are shown as "?". A descriptor that was
    closed when the process started leads to /dev/null from now on. Otherwise, the next file that is
    opened would get the number of this descriptor, and the output would be written into that file.
    """
    for number in _DESCRIPTORS:
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free, which is this one
    sys.stdout = _secured(sys.stdout, 1)
    sys.stderr = _secured(sys.stderr, 2)


def _secured(stream: TextIO | None, number: int) -> TextIO:
    """Return a stream that replaces `stream`, which Python has opened for descriptor `number`."""
    if stream is not None and not isinstance(stream, io.TextIOWrapper):
        return stream  # other code has replaced the stream that Python opened
    if stream is not None:
        stream.flush()
    file: io.RawIOBase = _Output(number, 'w', closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(file),
        encoding=stream.encoding if stream else 'utf-8',
        errors='replace',
        line_buffering=stream.line_buffering if stream else False,
        write_through=stream.write_through if stream else False,
    )


def output_problem() -> OSError | None:
    """Return why a part of stdout could not be written; None if everything was written."""
    sys.stdout.flush()
    file = getattr(getattr(sys.stdout, 'buffer', None), 'raw', None)
    return file.problem if isinstance(file, _Output) else None


def is_reader_gone() -> bool:
    """Return whether the reader of stdout has closed it, so that nobody sees any further text."""
    problem = output_problem()
    return problem is not None and problem.errno == errno.EPIPE
