"""The failures that sfmapp knows by name.

Library code raises these and nothing else on purpose; only the command line turns them into a message, advice and an
exit code. A message names the file or option, what was expected and what was found.
"""

from __future__ import annotations

from typing import Any


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


class NoReconstructionError(SfmError):
    """The photographs were read but hold no reconstruction. The report is still written.

    Attributes:
        report: of the stage that found no way, as it would have returned it; None if none was reached.
    """

    exit_code = 4
    report: dict[str, Any] | None = None


class TooFewImagesError(SfmError):
    """Fewer images were registered than the user asked for. The results are still written."""

    exit_code = 5


class InterruptedRunError(SfmError):
    """The user asked to stop. The same command resumes."""

    exit_code = 130
