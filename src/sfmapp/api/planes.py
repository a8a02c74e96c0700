"""One call: a picture onto a plane of a photograph, a plane out of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from sfmapp.api.jobs import FilePath
from sfmapp.events import Events

if TYPE_CHECKING:
    from sfmapp.pipelines.planes import PlaneSource, RectifyResult, WarpResult

Corners = Sequence[tuple[float, float]]


def warp_picture(
    picture: FilePath,
    photograph: FilePath,
    output: FilePath,
    plane: Corners | PlaneSource,
    *,
    blend: Literal["over", "multiply"] = "over",
    opacity: float = 1.0,
    mask: FilePath | None = None,
    events: Events | None = None,
) -> WarpResult:
    """Put a picture onto a plane of a photograph.

    Args:
        picture: a file of 8 or 16 bits, with alpha or without, taken as it is looked at.
        photograph: a file, whose depth and format the result has.
        output: a new folder, an empty one, or that of an earlier call.
        plane: four corners, pixels x, y of the file as it is stored, clockwise from the picture's own top left; or a
            :class:`sfmapp.pipelines.planes.PlaneSource`, which knows markers, lenses and other conventions of pixels.
        blend: ``over`` covers what was there, ``multiply`` lets its light and shade through. opacity: from 0 to 1.
        mask: a file of the photograph's shape, black where something stands in front of the plane.
        events: told of everything that happens, and can ask the run to stop.

    Returns:
        ``pixels`` (H, W), (H, W, 3) or (H, W, 4) RGB(A) of the photograph with the picture, in its depth; the report
        with shape and pose of the plane; the folder.

    Raises:
        UsageError: corners that no rectangle has, or an output that holds something else.
        InputError: a file that cannot be read, or a marker that is not there once.

    Example:
        >>> corners = [(512, 203), (871, 240), (866, 655), (505, 690)]
        >>> made = sfmapp.warp_picture("poster.png", "street.jpg", "ad/", corners)
    """
    from sfmapp.pipelines import planes
    from sfmapp.planes.warp import Look

    return planes.warp(
        picture, photograph, output, _source(plane), look=Look(blend, opacity), mask=mask, events=events
    )  # fmt: skip


def rectify(
    photograph: FilePath,
    output: FilePath,
    plane: Corners | PlaneSource,
    *,
    size: str | None = None,
    width: str | None = None,
    margin: float = 0.0,
    max_size: int | None = None,
    events: Events | None = None,
) -> RectifyResult:
    """Take a plane out of a photograph, as it looks straight on.

    Args:
        photograph: a file. output: a new folder, an empty one, or that of an earlier call.
        plane: a rectangle of it, as of :func:`warp_picture`.
        size: ``"1200x800"`` in pixels of the result, or with a unit the true size of the rectangle, ``"2.4x1.2m"``;
            None: width over height is told by the corners and the focal length, with its sigma.
        width: true width of the rectangle with its unit, ``"2.4m"``, in place of a size.
        margin: how much of the plane round the rectangle is shown, in shares of its longer side.
        max_size: limit of the longer side of the result, pixels.
        events: told of everything that happens, and can ask the run to stop.

    Returns:
        ``pixels`` (h, w), (h, w, 3) or (h, w, 4) of the plane, in the photograph's depth; the report with
        ``plane.size`` (metres, or shares of the width), ``units_per_pixel``, shape and pose; the folder.

    Raises:
        UsageError: corners that no rectangle has, a result too large, or an output that holds something else.
        InputError: a file that cannot be read, or a marker that is not there once.

    Example:
        >>> corners = [(512, 203), (871, 240), (866, 655), (505, 690)]
        >>> made = sfmapp.rectify("facade.jpg", "front/", corners, width="2.4m")
        >>> print(made.pixels.shape, made.report.units_per_pixel)
    """
    from sfmapp.pipelines import planes

    wanted = planes.Wanted(size, width, margin, max_size)
    return planes.rectify(photograph, output, _source(plane), wanted=wanted, events=events)


def _source(plane: Corners | PlaneSource) -> PlaneSource:
    from sfmapp.pipelines.planes import PlaneSource

    if isinstance(plane, PlaneSource):
        return plane
    return PlaneSource(tuple((float(x), float(y)) for x, y in plane))
