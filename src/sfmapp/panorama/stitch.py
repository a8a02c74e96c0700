"""The stage that draws a panorama: rotations in, one picture out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.panorama.canvas import Canvas, Projection, View, choose_canvas, lenses_of
from sfmapp.panorama.compose import Plan, compose
from sfmapp.panorama.pictures import Pictures
from sfmapp.panorama.preview import find_gains, show_all, small_canvas
from sfmapp.panorama.report import PictureReport
from sfmapp.panorama.seams import find_seams
from sfmapp.panorama.turned_photographs import TurnedPhotographs

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet


@dataclass(frozen=True)
class StitchedPicture:
    """A panorama.

    Attributes:
        pixels: (H, W, 3) uint8. inside: (H, W) where photographs show something.
        canvas: where its pixels lie.
    """

    pixels: NDArray[np.uint8]
    inside: NDArray[np.bool_]
    canvas: Canvas


def stitch(
    image_set: ImageSet, turned: TurnedPhotographs, *, projection: Projection | None, max_size: int | None,
    events: Events,
) -> tuple[StitchedPicture, PictureReport]:  # fmt: skip
    """Draw the panorama of photographs whose rotations are known.

    Args:
        image_set: the photographs, read again as they are needed.
        projection, max_size: see :func:`~sfmapp.panorama.canvas.choose_canvas`.

    Returns:
        The picture, and the report, in which ``file`` is still empty.

    Raises:
        InputError: a photograph cannot be read any more.
    """
    records = [image_set.images[i] for i in turned.image_idx]
    views = [
        View.of(turned.cameras[c], rotation) for c, rotation in zip(turned.camera_idx, turned.rotations, strict=True)
    ]
    canvas = choose_canvas(views, projection, max_size)
    pictures = Pictures(records)
    small = small_canvas(canvas, len(views))
    shown = show_all(views, pictures, small, events)
    gains, apart = find_gains(shown)
    label = find_seams(shown, gains, small)
    del shown
    pixels, inside = compose(Plan(canvas, lenses_of(views), gains, small, label), pictures, events)
    report = PictureReport(
        file="", projection=canvas.projection, width=canvas.width, height=canvas.height, scale=canvas.scale,
        span_deg=_span_deg(canvas), is_closed=canvas.is_closed, shown_share=float(inside.mean()),
        gains=_by_name([record.name for record in records], gains), worst_overlap=math.expm1(float(apart.max())),
    )  # fmt: skip
    return StitchedPicture(pixels, inside, canvas), report


def _by_name(names: Sequence[str], gains: NDArray[np.float64]) -> dict[str, list[float]]:
    return {name: [round(value, 4) for value in gain.tolist()] for name, gain in zip(names, gains, strict=True)}


def _span_deg(canvas: Canvas) -> float:
    if canvas.projection != "planar":
        return math.degrees(canvas.width / canvas.scale)
    sides = (canvas.left / canvas.scale, (canvas.left + canvas.width) / canvas.scale)
    return math.degrees(math.atan(sides[1]) - math.atan(sides[0]))
