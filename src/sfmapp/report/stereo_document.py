"""The report of ``sfmapp stereo``, as a type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.report.model import LogLine, RunFacts
from sfmapp.reporting import NamedReason, Report, Usage
from sfmapp.stereo.report import StereoPairReport
from sfmapp.stereo.temporal import FilmReport


class StereoReport(Report):
    """The report of ``sfmapp stereo``.

    Attributes:
        pairs: what became of each. failed: pairs that could not be used, and why.
        film: of a film, whether depths stay where nothing moves; absent of others.
        usage: of each step.
    """

    run: RunFacts
    pairs: Sequence[StereoPairReport]
    failed: Sequence[NamedReason]
    film: FilmReport | None = None
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
