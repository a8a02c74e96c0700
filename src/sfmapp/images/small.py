"""Photographs in small: JPEGs are decoded at a half, a quarter or an eighth, which takes a fraction of the time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.geometry.orientation import upright_pixels
from sfmapp.images.pixels import Pixels, as_gray, read_file, read_gray

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord


def read_small_gray(record: ImageRecord, side_px: int) -> Pixels:
    """(h, w) uint8 grey values of a photograph whose longer side is scaled down to ``side_px`` where it is longer.

    Raises:
        InputError: the file is gone, was changed since it was listed, or cannot be decoded.
    """
    shrink = max(record.width, record.height) / side_px
    pixels = _read_reduced(record, shrink) if record.source is None and shrink >= 2.0 else None
    return small_picture(read_gray(record) if pixels is None else pixels, side_px)


def _read_reduced(record: ImageRecord, shrink: float) -> Pixels | None:
    """Grey values (h, w) of a JPEG at a half, a quarter or an eighth; None of another kind of file."""
    data, header = read_file(record)
    if header.format != "jpeg" or header.kind not in ("gray", "rgb"):
        return None
    raw = decode_reduced_jpeg(data, shrink, is_gray=header.kind == "gray")
    if raw is None:
        raise InputError(
            f"{record.name} cannot be decoded: its data are damaged", "copy it again from its source, or leave it out"
        )
    rgb = raw if raw.ndim == 2 else np.ascontiguousarray(raw[..., ::-1])
    pixels: Pixels = upright_pixels(as_gray(rgb), record.turn)
    return pixels


def decode_reduced_jpeg(data: bytes, shrink: float, *, is_gray: bool = False) -> NDArray[Any] | None:
    """Pixels of a JPEG as stored, reduced by the largest of 1, 2, 4 and 8 that is not above ``shrink``.

    Returns:
        (h, w, 3) BGR uint8, or (h, w) where ``is_gray``; None if it is damaged.
    """
    import cv2

    if is_gray:
        flags = (cv2.IMREAD_GRAYSCALE, cv2.IMREAD_REDUCED_GRAYSCALE_2, cv2.IMREAD_REDUCED_GRAYSCALE_4,
                 cv2.IMREAD_REDUCED_GRAYSCALE_8)  # fmt: skip
    else:
        flags = (cv2.IMREAD_COLOR, cv2.IMREAD_REDUCED_COLOR_2, cv2.IMREAD_REDUCED_COLOR_4, cv2.IMREAD_REDUCED_COLOR_8)
    flag = flags[sum(shrink >= factor for factor in (2, 4, 8))]
    try:
        pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    return pixels


def small_picture(pixels: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    """A picture (H, W) or (H, W, C) whose longer side is at most ``side_px``; itself if it is no longer."""
    import cv2

    scale = side_px / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    small: NDArray[np.uint8] = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return small
