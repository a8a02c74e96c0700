"""The report of ``sfmapp stereo``, as a type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.report.model import LogLine, RunFacts
from sfmapp.reporting import NamedReason, Report, Usage
from sfmapp.stereo.report import StereoPairReport


class StereoReport(Report):
    """The report of ``sfmapp stereo``.

    Attributes:
        pairs: what became of each. failed: pairs that could not be used, and why.
        usage: of each step.
    """

    run: RunFacts
    pairs: Sequence[StereoPairReport]
    failed: Sequence[NamedReason]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
