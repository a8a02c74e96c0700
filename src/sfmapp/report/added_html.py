"""What became of photographs that were added to a finished reconstruction, for its page."""

from __future__ import annotations

from html import escape

from sfmapp.report.model import AddedReport
from sfmapp.report.page import table


def added_section(report: AddedReport) -> str:
    """For the page of a reconstruction."""
    rows = [
        [("t green" if one.model is not None else "t red", one.name), ("", one.model), ("w", one.reason)]
        for one in report.photographs
    ]
    rows += [[("t grey", one.name), ("", None), ("w", one.reason)] for one in report.known]
    pairs = f"{report.num_pairs} pairs, of which {report.num_known_pairs} had been compared before"
    return (
        f"<h2>Added</h2><p>{escape(report.text)}. <span class=dim>{pairs}; they are blue in the view from above.</span>"
        f"</p>{table([('t', 'photograph'), ('', 'model'), ('t', '')], rows)}"
    )
