"""What a photograph says of where the object is: the signed distance of each pixel to its outline.

:func:`find_silhouettes` takes what there is: an alpha channel, mask files, photographs that are masks themselves, or
the background: as it is where the camera stands still, otherwise its colours, learned from all photographs together.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.background_search import MAX_LEARNED, Background, find_background, spread
from sfmapp.carve.backgrounds import edge_pieces, without_specks
from sfmapp.carve.consistency import compare
from sfmapp.carve.graph_cut import cut_by_rectangle
from sfmapp.carve.masks_report import MasksReport, PhotographMask
from sfmapp.carve.options import MaskOptions
from sfmapp.carve.outlines import Coverage, Silhouette, coverage_of_mask, refined_coverage, signed_distance
from sfmapp.carve.smooth_backgrounds import cut_from_smooth
from sfmapp.carve.views import View, project_points
from sfmapp.errors import InputError, listed
from sfmapp.images.pixels import read_mask_coverage, read_rgb, read_with_alpha

if TYPE_CHECKING:
    from sfmapp.events import Events
    from sfmapp.images.image_set import ImageRecord, ImageSet

__all__ = ["Silhouette", "find_silhouettes"]

STAGE = "masks"
T = TypeVar("T")

# standard deviations of outlines against exact ones: tests/test_carve_outlines.py
_SIGMA_PX = {"alpha": 0.1, "mask": 0.2, "background": 0.3, "dark background": 0.3}
# more of the edge of the picture than this inside, and more than of the whole: the mask is the background's
_INVERTED = 0.5
# what is seen of the object is at least this share of a photograph, for outlines to mean anything
_LEAST_SHARE = 1e-5
# share of pixels that are black or white to the last level, from which on a photograph is a mask itself
_TWO_VALUED = 0.98
_NAMES_SHOWN = 3
# share of the shorter side along the edges where GrabCut expects no object (benchmarks/masks.py)
_EDGE = 0.04
# points that tell where the object is
_FEW_POINTS = 16
# share of a silhouette above which a spill or a hole is told
_WORTH_A_LINE = 1e-3
# pieces of the object at the edges, which are background, in so many photographs say that colours do not tell it: none
# had any in 19 sets of good masks, 9 and 16 of 16 before clutter of the object's colours (IoU 0.85 and 0.78)
_AT_EDGES = 0.1
# from this share of a silhouette on a spill is large, and if so many have large ones masks are wrong where the others
# do not say so as well
_LARGE_SPILL, _MANY_SPILL = 0.01, 0.25


@dataclass(frozen=True)
class _Found:
    """What was found in one photograph: coverage (H, W), and what told it."""

    coverage: Coverage
    source: str


def find_silhouettes(
    images: ImageSet,
    views: Sequence[View] | None,
    options: MaskOptions,
    events: Events,
    *,
    points: NDArray[np.float64] | None = None,
    threads: int | None = None,
) -> tuple[list[Silhouette], MasksReport]:
    """The object's silhouette in each photograph.

    Args:
        images: the photographs, with their mask files.
        views: their cameras, in the same order; None: silhouettes are not compared with each other.
        options: see :class:`MaskOptions`.
        events: told of progress, of what was taken, and of silhouettes that cannot be right.
        points: (N, 3) points of a reconstruction: GrabCut looks for the object where they are.
        threads: photographs at a time; the result does not depend on it.

    Returns:
        Silhouettes in the order of the photographs, and the report. One that is empty, full or inverted is known
        nowhere, so that it carves nothing, and the report says so.

    Raises:
        InputError: a photograph or a mask cannot be read, what was asked for is not there, or no silhouette is usable.
    """
    start = time.monotonic()
    workers = threads or min(8, os.cpu_count() or 1)
    records = images.images
    if not records:
        raise InputError("silhouettes: expected photographs, found none")
    events.started(STAGE, f"silhouettes in {len(records)} photographs", total=len(records))
    source = _choose_source(records, options)
    warnings = _useless_alpha(records, source, options, events)
    background, color_error = None, None
    if source == "background":
        pictures = _each(read_rgb, spread(records, MAX_LEARNED), workers, lambda record: events.raise_if_cancelled())
        background, color_error, more = find_background(records, pictures, options.background, events)
        warnings += more
        if background is None:
            source = "grabcut"
    index = {record.name: i for i, record in enumerate(records)}

    def work(record: ImageRecord) -> tuple[Silhouette, PhotographMask]:
        view = None if views is None else views[index[record.name]]
        return _with_problem(record, _find(record, source, background, _rectangle(record, view, points)), source)

    found = _each(work, records, workers, lambda record: events.advanced(STAGE, message=record.name))
    warnings += _warn([entry for _, entry in found], events)
    if background is not None and background.colors is not None:
        warnings += _told_of_edges([silhouette for silhouette, _ in found], events)
    if views is not None:
        found, more = _compared(views, found, workers, events)
        warnings += more
    silhouettes, entries = [each for each, _ in found], [entry for _, entry in found]
    report = MasksReport(
        masks=entries, color_error=color_error, is_compared=views is not None, warnings=warnings,
        wall_s=round(time.monotonic() - start, 3),
    )  # fmt: skip
    events.finished(STAGE, f"{len(entries)} silhouettes by {source}", **report)
    return silhouettes, report


def _each(
    work: Callable[[ImageRecord], T], records: Sequence[ImageRecord], workers: int, done: Callable[[ImageRecord], None]
) -> list[T]:
    """Results in the order of the photographs, in several threads."""
    with ThreadPoolExecutor(max(1, workers)) as pool:
        jobs = [pool.submit(work, record) for record in records]
        results = []
        try:
            for record, job in zip(records, jobs, strict=True):
                results.append(job.result())
                done(record)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return results


def _choose_source(records: Sequence[ImageRecord], options: MaskOptions) -> str:
    """What tells the object, for all photographs alike."""
    if options.mask_source != "auto":
        return options.mask_source
    if options.background is not None:
        return "background"
    if any(_has_mask(record) for record in records):
        return "mask"
    # most often the first of three tells; all are read only where it never does
    asked = (*spread(records, 3), *records)
    if any(read_with_alpha(record)[1] is not None for record in asked if record.has_alpha):
        return "alpha"
    some = [read_rgb(record) for record in spread(records, 3)]
    # one that is empty or full is named then, and carves nothing
    if any(map(is_mask, some)) and all(is_mask(each) or (each == each[0, 0, 0]).all() for each in some):
        return "picture"
    return "background"


def _useless_alpha(records: Sequence[ImageRecord], source: str, options: MaskOptions, events: Events) -> list[str]:
    """Say that alpha channels are there which tell nothing, so that something weaker does."""
    num = sum(record.has_alpha for record in records)
    if options.mask_source != "auto" or source in ("alpha", "mask") or num < 0.5 * len(records):
        return []
    told = "their two colours" if source == "picture" else "the colours of their background"
    line = (
        f"the alpha channels of {num} photographs are the same everywhere and tell no object: it is told by {told}, "
        "and what of it looks like that is lost"
    )
    events.warned(STAGE, f"{line}: look at the outlines, or give masks (--mask-path)")
    return [line]


def _has_mask(record: ImageRecord) -> bool:
    return record.mask_path is not None or (record.source is not None and record.source.mask(record.name) is not None)


def is_mask(picture: NDArray[np.uint8]) -> bool:
    """Whether a photograph (H, W, 3) is a mask itself: grey, and nearly all of it black or white, with both in it."""
    gray = picture[..., 0]
    if (picture != gray[..., None]).any():
        return False
    white = int(gray.max())
    num_black, num_white = np.count_nonzero(gray == 0), np.count_nonzero(gray == white)
    return bool(min(num_black, num_white) > 0 and white > 0 and num_black + num_white >= _TWO_VALUED * gray.size)


def _find(
    record: ImageRecord, source: str, background: Background | None, rectangle: tuple[int, int, int, int]
) -> _Found | None:
    """What the source says of a photograph; None if it says nothing."""
    if source == "mask":
        levels = read_mask_coverage(record)
        return None if levels is None else _Found(_coverage(levels), "mask")
    if source == "picture":
        levels = read_rgb(record)[..., 0]
        return _Found(_coverage(np.where(levels >= max(1, levels.max() / 2), 255, 0).astype(np.uint8)), "mask")
    if source == "alpha":
        _, alpha = read_with_alpha(record)
        return None if alpha is None else _Found(_coverage(alpha), "alpha")
    picture = read_rgb(record)
    if source == "grabcut":
        mask = cut_from_smooth(picture, without_specks(cut_by_rectangle(picture, rectangle)))
        return _Found(refined_coverage(picture, mask), "grabcut")
    assert background is not None
    cut = background.cut(picture)
    return None if cut is None else _Found(refined_coverage(picture, cut), background.source)


def _rectangle(record: ImageRecord, view: View | None, points: NDArray[np.float64] | None) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what the object lies within: what most points span, or all but the edges."""
    edge = max(2, round(_EDGE * min(record.width, record.height)))
    left, top, right, bottom = edge, edge, record.width - edge, record.height - edge
    if view is not None and points is not None and len(points) >= _FEW_POINTS:
        seen = np.empty((len(points), 3))
        project_points(view.row, np.ascontiguousarray(points, np.float64), seen)
        shown = seen[(seen[:, 2] > 0.0) & np.isfinite(seen).all(axis=1), :2]
        if len(shown) >= _FEW_POINTS:
            (x0, y0), (x1, y1) = np.quantile(shown, (0.02, 0.98), axis=0)
            around = 0.1 * max(x1 - x0, y1 - y0)
            left, right = max(left, int(x0 - around)), min(right, int(x1 + around) + 1)
            top, bottom = max(top, int(y0 - around)), min(bottom, int(y1 + around) + 1)
    return left, top, right, bottom


def _coverage(levels: NDArray[np.uint8]) -> Coverage:
    """Shares of pixels in eight bits as coverage; those of whole pixels with their steps smoothed."""
    if np.isin(levels, (0, levels.max())).all():
        return coverage_of_mask(levels > 0)
    return np.asarray(levels, np.float32) / np.float32(255.0)


def _with_problem(record: ImageRecord, found: _Found | None, wanted: str) -> tuple[Silhouette, PhotographMask]:
    """The silhouette of what was found, known nowhere if it cannot be right; ``wanted``: where it was looked for."""
    if found is None:
        found = _Found(np.zeros((record.height, record.width), np.float32), "none")
    inside = found.coverage > 0.5
    edge = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    share, border_share = float(inside.mean()), float(edge.mean())
    problem = ""
    if found.source == "none":
        problem = {
            "alpha": "has no alpha channel that tells the object",
            "background": "does not show the background of the others, or of the photograph of it",
        }.get(wanted, "has no mask")
    elif share < _LEAST_SHARE:
        problem = "is empty"
    elif share > 1.0 - _LEAST_SHARE:
        problem = "is full"
    elif border_share > _INVERTED and border_share > share:
        problem = "is inverted: the object is what it leaves out"
    silhouette = Silhouette(
        signed_distance(found.coverage), np.zeros(inside.shape, bool) if problem else None,
        _SIGMA_PX.get(found.source, 0.5), found.source,
    )  # fmt: skip
    entry = PhotographMask(
        name=record.name, source=found.source, share=share, border_share=border_share,
        outline_sigma_px=silhouette.outline_sigma_px, problem=problem,
        is_usable=not problem, spilled=0.0, filled=0.0, doubtful=0.0,
    )  # fmt: skip
    return silhouette, entry


def _warn(entries: Sequence[PhotographMask], events: Events) -> list[str]:
    """Name the silhouettes that carve nothing.

    Raises:
        InputError: none is left.
    """
    bad = [entry for entry in entries if entry.problem]
    warnings = [
        f"{entry.name} {entry.problem}" if entry.source == "none" else f"the mask of {entry.name} {entry.problem}"
        for entry in bad
    ]
    if len(bad) == len(entries):
        raise InputError(
            f"no silhouette is usable: {'; '.join(warnings[:_NAMES_SHOWN])}",
            "masks are white where the object is, and black elsewhere; `sfmapp masks` draws what is found",
        )
    for line in warnings:
        events.warned(STAGE, f"{line}: it carves nothing")
    return warnings


def _compared(
    views: Sequence[View], found: Sequence[tuple[Silhouette, PhotographMask]], workers: int, events: Events
) -> tuple[list[tuple[Silhouette, PhotographMask]], list[str]]:
    """Silhouettes after what the others say of them, and lines for the user."""
    # an alpha channel was rendered or cut by hand: it is told what speaks against it, and left as it is
    repairs = any(silhouette.source != "alpha" for silhouette, _ in found)
    verdicts = compare(views, [each for each, _ in found], repairs=repairs, workers=workers, events=events)
    result, warnings = [], []
    for (_, entry), verdict in zip(found, verdicts, strict=True):
        told = replace(
            entry, spilled=verdict.spilled, filled=verdict.filled, doubtful=verdict.doubtful,
            turned_deg=verdict.turned_deg, turned_sigma_deg=verdict.turned_sigma_deg,
            problem=entry.problem or verdict.problem,
        )  # fmt: skip
        if verdict.problem:
            warnings.append(f"{entry.name} {verdict.problem}")
            events.warned(STAGE, f"{warnings[-1]}; it carves nothing")
        result.append((verdict.silhouette, told))
    return result, warnings + told_of_repairs([entry for _, entry in result], repairs, events)


def _told_of_edges(silhouettes: Sequence[Silhouette], events: Events) -> list[str]:
    """Say that what was learned as background is taken for the object."""
    num = sum(edge_pieces(silhouette.inside) > _WORTH_A_LINE for silhouette in silhouettes)
    if num < 2 or num < _AT_EDGES * len(silhouettes):
        return []
    line = (
        f"pieces at the edges of {num} of {len(silhouettes)} photographs, apart from the object, have its colours: "
        "the background is not told from it by colours, and masks are wrong near it as well"
    )
    events.warned(STAGE, f"{line}: look at the outlines, or give masks (--mask-path)")
    return [line]


def told_of_repairs(entries: Sequence[PhotographMask], repairs: bool, events: Events) -> list[str]:
    """Lines on spills and holes that the other silhouettes speak against."""
    lines = []
    done = {"spilled": "taken away", "filled": "filled"} if repairs else {}
    kinds = {
        "spilled": "spill over what the others hold",
        "filled": "have holes where all others hold something",
        "doubtful": "have narrow holes that no other looks through",
    }
    if not repairs:
        del kinds["doubtful"]
    for share, what in kinds.items():
        which = sorted((entry for entry in entries if entry[share] > _WORTH_A_LINE), key=lambda entry: -entry[share])
        if which:
            named = listed([f"{entry.name} ({100 * entry[share]:.1f} %)" for entry in which])
            lines.append(f"{len(which)} silhouettes {what}, {done.get(share, 'left as they are')}: {named}")
            events.decided(STAGE, lines[-1])
    large = sum(entry.spilled > _LARGE_SPILL for entry in entries)
    if large >= max(2, _MANY_SPILL * len(entries)):
        lines.append(
            f"{large} of {len(entries)} silhouettes spill over what the others hold by more than "
            f"{100 * _LARGE_SPILL:.0f} %: masks are bad, and what spills in most of them alike stays"
        )
        events.warned(STAGE, f"{lines[-1]}: look at the outlines, or give masks (--mask-path)")
    return lines
