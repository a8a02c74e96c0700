"""The failures that sfmapp knows by name.

Library code raises these and nothing else on purpose; only the command line turns them into a message, advice and an
exit code. A message names the file or option, what was expected and what was found.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sfmapp.reporting import Report

_NO_SPACE = "free some space, or choose another place, and run the same command again"
_NOT_ALLOWED = "check the permissions, or choose another place"
_BROKEN = "check the disk or the network that it lies on"
# what the system refuses that is no fault of the program, and what to do about it
_REMEDIES = {
    errno.ENOSPC: _NO_SPACE,
    errno.EDQUOT: _NO_SPACE,
    errno.EFBIG: "write to a file system that holds larger files, or raise the limit: ulimit -f",
    errno.EACCES: _NOT_ALLOWED,
    errno.EPERM: _NOT_ALLOWED,
    errno.EROFS: "choose a place that can be written",
    errno.ENOENT: "check that it exists",
    errno.EEXIST: "choose another place",
    errno.EISDIR: "it is a folder: give a file",
    errno.ENOTDIR: "a part of the path is a file: give a folder",
    errno.ENOTEMPTY: "choose another place",
    errno.ENAMETOOLONG: "give it a shorter name",
    errno.ELOOP: "its symbolic links lead in a circle: give the file itself",
    errno.EMFILE: "allow more open files: ulimit -n 4096",
    errno.ENFILE: "close other programs: the system has no more open files to give",
    errno.EAGAIN: "close other programs, or use fewer --threads: the system has no more processes to give",
    errno.ENODEV: "give a file: it is a device that cannot be read so",
    errno.ENXIO: "give a file: it is a device or a socket that cannot be read so",
    errno.ENOLCK: "choose a place on a disk of this machine",
    errno.EOPNOTSUPP: "choose a place on a disk of this machine",
    errno.EBUSY: "close other programs that use it",
    errno.ETXTBSY: "close other programs that use it",
    errno.EXDEV: "choose a place on one file system",
    errno.EIO: _BROKEN,
    errno.ESTALE: _BROKEN,
    errno.ENOTCONN: _BROKEN,
    errno.ETIMEDOUT: _BROKEN,
}


class SfmError(Exception):
    """Base of all expected failures.

    Args:
        message: what went wrong: the file or option, what was expected, what was found.
        advice: what the user can do about it, or None.
    """

    exit_code = 1

    def __init__(self, message: str, advice: str | None = None) -> None:
        super().__init__(message)
        self.advice = advice


class UsageError(SfmError):
    """An option, preset or argument that cannot be obeyed."""

    exit_code = 2


class InputError(SfmError):
    """A file or folder from outside that is missing, unreadable or not what it claims to be."""

    exit_code = 3


class EpipoleInPictureError(InputError):
    """Two photographs of which one camera sees the other, or would: no plane shows epipolar lines as rows."""


class NoReconstructionError(SfmError):
    """The photographs were read but hold no reconstruction. The report is still written.

    Attributes:
        report: of the stage that found no way, as it would have returned it; None if none was reached.
    """

    exit_code = 4
    report: Report | None = None


class TooFewImagesError(SfmError):
    """Fewer images were registered than the user asked for. The results are still written."""

    exit_code = 5


class InterruptedRunError(SfmError):
    """The user asked to stop. The same command resumes."""

    exit_code = 130


def is_full(error: BaseException | None) -> bool:
    """Whether an exception, or one that it was raised from, says that the disk or the user's share of it is full."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__
    return False


def remedy(error: OSError) -> str | None:
    """What to do about a refusal of the system; None for one that is a fault of the program."""
    return _REMEDIES.get(error.errno or 0)


def refusal(error: OSError) -> InputError | None:
    """A refusal of the system as a failure with a name; None for one that is a fault of the program."""
    advice = remedy(error)
    if advice is None:
        return None
    places = [str(name) for name in (error.filename, error.filename2) if name is not None]
    if places:
        return InputError(f"{' to '.join(places)}: {error.strerror}", advice)
    if is_full(error):
        where = "on the disk of the results, of temporary files or of compiled kernels"
        return InputError(f"{error.strerror}, {where}", "free some; TMPDIR and NUMBA_CACHE_DIR name other places")
    if "temporary directory" in str(error.strerror):  # of tempfile
        advice = "set TMPDIR to a folder that you can write to"
    return InputError(str(error.strerror), advice)


def listed(names: Sequence[str], most: int = 3) -> str:
    """The first names of a list, for a message, and how many more there are."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
