"""The page of masks: each outline over its photograph, and what speaks against it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.masks_report import MasksReport, PhotographMask
from sfmapp.carve.outlines import Silhouette, outline_pieces
from sfmapp.report.drawing import jpeg_url
from sfmapp.report.model import LogLine, RunFacts
from sfmapp.report.page import log_table, render_page, table, usage_table
from sfmapp.reporting import Report, Usage

Pixels = NDArray[np.uint8]

# photographs that are shown: all of a few, of many evenly spread ones and whatever something speaks against
_NUM_SHOWN = 36
_SHOWN_PX, _QUALITY = 560, 85
# outline and its rim, for dark and bright photographs alike
_LINE, _RIM = (90, 255, 120), (10, 30, 15)
# parts of a pixel that ends of lines are drawn to, as bits
_SHIFT = 4
_STYLE = """<style>.sheet{display:grid;grid-template-columns:repeat(auto-fill,minmax(17rem,1fr));gap:.8rem}
.sheet figure.bad img{outline:3px solid #eb3c28}</style>"""


class MaskFilesReport(Report):
    """The report of ``sfmapp masks``.

    Attributes:
        cameras: what they are, in words.
        files: what was written, in the folder of the run.
        usage: of each step.
    """

    run: RunFacts
    cameras: str
    masks: MasksReport
    files: Sequence[str]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
    decisions: Sequence[LogLine]


def masks_page(report: MaskFilesReport, silhouettes: Sequence[Silhouette], read: Callable[[int], Pixels]) -> str:
    """The page, self-contained, its pictures in it; ``read`` gives a photograph by its position."""
    return render_page(f"Masks of {len(silhouettes)} photographs", _body(report, silhouettes, read))


def outlined(photograph: Pixels, silhouette: Silhouette, longest: int) -> Pixels:
    """A photograph (H, W, 3) no longer than ``longest``, its outline drawn over it, all else a little dimmed."""
    import cv2

    height, width = silhouette.distance.shape
    scale = min(1.0, longest / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    picture = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA)
    shown = cv2.resize(silhouette.inside.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    picture = (picture * (0.55 + 0.45 * shown[..., None])).astype(np.uint8)
    pieces = outline_pieces(np.clip(0.5 + silhouette.distance, 0.0, 1.0)) * np.float32(scale)
    ends = np.round((pieces.reshape(-1, 2, 2) - 0.5) * (1 << _SHIFT)).astype(np.int32)
    for color, thickness in ((_RIM, 3), (_LINE, 1)):
        cv2.polylines(picture, list(ends), False, color, thickness, cv2.LINE_AA, _SHIFT)
    return np.asarray(picture, np.uint8)


def _body(report: MaskFilesReport, silhouettes: Sequence[Silhouette], read: Callable[[int], Pixels]) -> Iterator[str]:
    entries = report.masks.masks
    yield _STYLE
    for line in report.warnings:
        yield f'<div class="failure"><p>{escape(line.message or "")}</p></div>'
    yield f"<p>{_summary(report)}</p>"
    chosen = _chosen(entries)
    more = "" if len(chosen) == len(entries) else f" ({len(chosen)} of {len(entries)})"
    yield f'<h2>Outlines over the photographs{more}</h2><div class="sheet">'
    for i in chosen:
        url = jpeg_url(outlined(read(i), silhouettes[i], _SHOWN_PX), _SHOWN_PX, _QUALITY)
        kind = ' class="bad"' if entries[i].problem else ""
        yield f'<figure{kind}><img src="{url}" alt=""><figcaption>{escape(_caption(entries[i]))}</figcaption></figure>'
    yield "</div>"
    yield _all(entries)
    yield log_table("Decisions", report.decisions)
    yield usage_table(report.usage, report.run)


def _summary(report: MaskFilesReport) -> str:
    entries, masks = report.masks.masks, report.masks
    sources = sorted({entry.source for entry in entries})
    text = f"The object in {len(entries)} photographs, told by {escape(' and '.join(sources))}; {len(report.files)} "
    text += "masks written, white where it is. "
    if masks.color_error is not None:
        text += f"Colours of object and background overlap by {masks.color_error:.1%}. "
    if not masks.is_compared:
        return text + "Cameras are not known, so that nothing is said of whether silhouettes fit each other."
    odd = sum(bool(entry.problem) for entry in entries)
    changed = sum(entry.spilled > 0.0 or entry.filled > 0.0 for entry in entries)
    return text + f"Held against each other, {odd} cannot be right and {changed} contradict the others in parts."


def _chosen(entries: Sequence[PhotographMask]) -> list[int]:
    spread = np.linspace(0, len(entries) - 1, min(_NUM_SHOWN, len(entries))).round().astype(int).tolist()
    against = sorted(range(len(entries)), key=lambda i: -_against(entries[i]))[:_NUM_SHOWN]
    return sorted({*spread, *(i for i in against if _against(entries[i]) > 0.0)})


def _against(entry: PhotographMask) -> float:
    return 1.0 if entry.problem else entry.spilled + entry.filled + entry.doubtful


def _caption(entry: PhotographMask) -> str:
    shares = {"spill taken away": entry.spilled, "holes filled": entry.filled, "doubtful holes": entry.doubtful}
    said = [entry.problem] if entry.problem else []
    said += [f"{what} {share:.1%}" for what, share in shares.items() if share >= 1e-3]
    return f"{entry.name}: {', '.join(said) or f'{entry.share:.1%} of the picture'}"


def _all(entries: Sequence[PhotographMask]) -> str:
    head = [
        ("t", "photograph"), ("t", "told by"), ("", "of the picture"), ("", "outline sigma px"),
        ("", "spill"), ("", "holes filled"), ("", "doubtful"), ("t", "problem"),
    ]  # fmt: skip
    rows = [
        [
            ("t", entry.name), ("t", entry.source), ("", f"{entry.share:.1%}"),
            ("", f"{entry.outline_sigma_px:.2f}"), ("", f"{entry.spilled:.2%}"), ("", f"{entry.filled:.2%}"),
            ("", f"{entry.doubtful:.2%}"), ("w", entry.problem),
        ]
        for entry in entries
    ]  # fmt: skip
    return f"<details><summary>All {len(rows)} photographs</summary>{table(head, rows)}</details>"
