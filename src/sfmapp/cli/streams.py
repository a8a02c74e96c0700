"""Standard streams that cannot end a run: they may be closed, full, or left by whoever read them."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO


class Stream:
    """A text stream whose first failure is remembered and whose later text is dropped; else the stream itself.

    Attributes:
        error: what went wrong; None so far.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | None = None

    @property
    def has_lost_text(self) -> bool:
        """Something could not be written, though somebody may have waited for it: a pipe that was closed is no loss."""
        return self.error is not None and not isinstance(self.error, BrokenPipeError)

    def write(self, text: str) -> int:
        try:
            if self.error is None:
                self._stream.write(text)
        except UnicodeEncodeError:  # a file name that is no text, or a terminal that lacks a letter
            encoding = self._stream.encoding or "ascii"
            return self.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except OSError as error:
            self._give_up(error)
        return len(text)

    def flush(self) -> None:
        try:
            if self.error is None:
                self._stream.flush()
        except OSError as error:
            self._give_up(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _give_up(self, error: OSError) -> None:
        self.error = error
        # the interpreter writes at its end what still waits in the stream, and would complain once more
        with contextlib.suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)


@contextlib.contextmanager
def standard_streams() -> Iterator[Stream]:
    """Guard the output and error streams of this process while a command runs; gives the former."""
    _open_closed_descriptors()
    before = sys.stdout, sys.stderr
    with open(os.devnull, "w", encoding="utf-8") as null:  # Python gives none for a closed one
        out, errors = (Stream(stream or null) for stream in before)
        sys.stdout, sys.stderr = out, errors
        try:
            yield out
        finally:
            out.flush()
            errors.flush()
            sys.stdout, sys.stderr = before


def _open_closed_descriptors() -> None:
    """A file that is opened where a standard stream was closed would get its number, and what libraries print."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError as error:
            if error.errno == errno.EBADF:
                null = os.open(os.devnull, os.O_RDWR)
                if null != descriptor:
                    os.dup2(null, descriptor)
                    os.close(null)
