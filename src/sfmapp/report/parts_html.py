"""How a large set was mapped in parts, for the page of its report."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from sfmapp.mapping.report import MIN_SHARED, FailedPartReport, PartsReport, SeamReport, SubmapReport
from sfmapp.report.page import table

_ABOUT = (
    "A set of this size is divided where few matches are lost. Each part is mapped by itself, parts that share images "
    "are held against each other in these, and what agrees is adjusted as one model. Images of a part that is left out "
    "are registered one by one from where their neighbours are."
)


def parts_section(report: PartsReport) -> str:
    """Parts with their sizes, and the seams between them; nothing for a set that was mapped as a whole."""
    submaps, seams, failed = report.submaps or (), report.seams or (), report.failed or ()
    if not submaps and not failed:
        return ""
    given_up = f"<p><b>All was mapped as a whole after all: {escape(report.given_up)}.</b></p>"
    return (
        f"<h2>Parts</h2>{given_up if report.given_up else ''}<p class=dim>{_ABOUT}</p>"
        f"{_parts(submaps, failed)}{_seams(seams, submaps) if seams else ''}"
    )


def _parts(submaps: Sequence[SubmapReport], failed: Sequence[FailedPartReport]) -> str:
    rows = [
        [
            ("t red" if one.reason else "t green", f"{n}: {one.first_image} ..."), ("", one.num_images_of_part),
            ("", one.num_images), ("w", one.reason),
        ]
        for n, one in enumerate(submaps)
    ]  # fmt: skip
    rows += [[("t red", f"{one.first_image} ..."), ("", one.num_images), ("", 0), ("w", one.reason)] for one in failed]
    head = [
        ("t", "part, by its first image"),
        ("", "images"),
        ("", "registered by itself"),
        ("t", "why it is left out"),
    ]
    return table(head, rows)


def _seams(seams: Sequence[SeamReport], submaps: Sequence[SubmapReport]) -> str:
    rows = []
    for seam in seams:
        names = " and ".join(f"{n}: {submaps[n].first_image} ..." for n in seam.submaps)
        light = "red" if seam.reason else "green"
        if seam.reason and seam.num_images < MIN_SHARED:
            light = "grey"
        rows.append([
            (f"t {light}", names), ("", seam.num_images), ("", seam.num_elsewhere or None),
            ("", f"{seam.num_points_agreeing} of {seam.num_points}" if seam.num_points else None),
            ("", None if seam.sigmas is None else f"{seam.sigmas:.2f}"), ("w", seam.reason),
        ])  # fmt: skip
    head = [
        ("t", "parts that share images"), ("", "images of both"), ("", "of these elsewhere"),
        ("", "points of both that agree"), ("", "rms difference, sigmas"), ("t", "why they are not joined by it"),
    ]  # fmt: skip
    return f"<details open><summary>Seams ({len(rows)})</summary>{table(head, rows)}</details>"
