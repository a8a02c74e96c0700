"""Options of silhouettes, and of the volume that they leave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sfmapp.errors import UsageError
from sfmapp.option_checks import Range, check_options

# levels of an octree whose codes fit: three bits a level, in 63 bits
MAX_DEPTH = 21
# cells along the side, at most, of which no number is asked for
MOST_CELLS = 256
_RANGES = {"cells": Range(2, 2.0**MAX_DEPTH), "min_views": Range(1), "misses": Range(0, 64)}


@dataclass(frozen=True)
class MaskOptions:
    """Options of the stage ``masks``.

    Attributes:
        mask_source: Where the object is told from: alpha, mask files, or the colours of the background; auto takes the
            first that is there. grabcut, which has to be asked for, cuts it out of each photograph by itself, within
            what the points of a reconstruction span, or all of the picture but its edges.
        background: A photograph of the background without the object, from where all photographs were taken; what
            differs from it is the object. None, and a background that stands still is found in the photographs.
    """

    mask_source: Literal["auto", "alpha", "mask", "background", "grabcut"] = "auto"
    background: str | None = None

    def __post_init__(self) -> None:
        check_options("masks", self, {})
        if self.background is not None and self.mask_source not in ("auto", "background"):
            raise UsageError(
                f"masks: a photograph of the background tells nothing where mask_source is {self.mask_source}",
                "leave one of both out",
            )


@dataclass(frozen=True)
class CarveOptions:
    """Options of space carving.

    Attributes:
        cells: finest cells along the side of the cube, rounded up to a power of two; None: as fine as outlines are
            told, see :func:`~sfmapp.carve.space_carving.told_cells`, and 256 at most.
        min_views: photographs that have to look at a place for anything to be left there; None: half of them. Where
            fewer look, as beyond the pictures of most, their cones would be left standing; how much was taken away for
            that is in the report.
        misses: silhouettes that may miss a place that is kept. Each makes the hull larger.
        doubts_holes: carve nothing through holes of masks that no other photograph shows, and name them, see
            :mod:`sfmapp.carve.tolerance`. A gap of the object that one photograph alone looks through is filled.
    """

    cells: int | None = None
    min_views: int | None = None
    misses: int = 0
    doubts_holes: bool = True

    def __post_init__(self) -> None:
        check_options("carve", self, _RANGES)

    @property
    def depth(self) -> int:
        """Level of the finest cells, the most where their number is not given."""
        return int((self.cells or MOST_CELLS) - 1).bit_length()
