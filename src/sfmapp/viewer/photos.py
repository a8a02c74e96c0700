"""Photographs for a screen: upright, small, as JPEG bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.orientation import MIRRORED, upright_pixels
from sfmapp.images.headers import UnusableImage, read_header
from sfmapp.images.pixels import decode_bytes, to_8_bits
from sfmapp.images.small import decode_reduced_jpeg, small_picture

# Photographs get smaller when there are many: about 40 MB for any number up to 1000, of about 100 KB at 1000 px.
_SIDE_PX = (360, 1000)
_BUDGET = 120
# A JPEG this small goes in as it is: encoding it again would cost time and quality.
_KEEP_BYTES = 400_000
SCREEN_QUALITY = 82
_THUMBNAIL_QUALITY = 75


def screen_side_px(count: int) -> int:
    """Largest side of the photographs of a recording that holds so many of them."""
    return int(np.clip(_SIDE_PX[1] * np.sqrt(_BUDGET / max(1, count)), *_SIDE_PX))


@dataclass(frozen=True)
class ScreenPhoto:
    """An upright photograph and its thumbnail as JPEG bytes, and their sizes (width, height).

    The thumbnail stands among points: of a file that is a mirror image it remains one, as those of its model are.
    """

    photo: bytes
    size: tuple[int, int]
    thumbnail: bytes
    thumbnail_size: tuple[int, int]


def load_screen_photo(path: Path, orientation: int, max_side_px: int, thumbnail_px: int) -> ScreenPhoto | None:
    """Read and shrink a photograph; large JPEGs are decoded at a half, a quarter or an eighth right away.

    None if it cannot be read: a recording with a photograph missing is better than none.
    """
    try:
        data = path.read_bytes()
        header = read_header(data)
    except (OSError, UnusableImage):
        return None
    is_jpeg = header.format == "jpeg"
    if is_jpeg:
        pixels = decode_reduced_jpeg(data, max(header.width, header.height) / max_side_px)
    else:
        raw = decode_bytes(data, header)
        pixels = None if raw is None else _as_bgr(to_8_bits(raw))
    if pixels is None:
        return None
    pixels = upright_pixels(pixels, orientation)
    is_fit = is_jpeg and orientation == 1 and max(pixels.shape[:2]) <= max_side_px and len(data) <= _KEEP_BYTES
    # a reduced decode may have made it fit: the file itself has not changed
    is_fit = is_fit and (header.height, header.width) == pixels.shape[:2]
    pixels = small_picture(pixels, max_side_px)
    photo = data if is_fit else _jpeg(pixels, SCREEN_QUALITY)
    thumbnail = small_picture(pixels, thumbnail_px)
    if orientation in MIRRORED:
        thumbnail = np.ascontiguousarray(thumbnail[:, ::-1])
    return ScreenPhoto(photo, pixels.shape[1::-1], _jpeg(thumbnail, _THUMBNAIL_QUALITY), thumbnail.shape[1::-1])


def shrunk_jpeg(pixels: Any, max_side_px: int, quality: int) -> tuple[bytes, tuple[int, int]]:
    """uint8 pixels (H, W) or (H, W, 3) BGR as JPEG bytes, shrunk to fit, and the size (width, height) of that."""
    small = small_picture(pixels, max_side_px)
    return _jpeg(small, quality), small.shape[1::-1]


def _as_bgr(pixels: Any) -> Any:
    import cv2

    if pixels.ndim == 2:
        return cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGR if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR)


def shrunk(pixels: NDArray[np.uint8], max_side_px: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A picture (H, W, 3) for a screen, and the factors (2,) of its pixels."""
    small = small_picture(pixels, max_side_px)
    return small, np.divide(small.shape[1::-1], pixels.shape[1::-1])


def _jpeg(pixels: Any, quality: int) -> bytes:
    import cv2

    return bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
