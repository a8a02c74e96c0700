"""Photographs written again, in the format that they were in, and without an orientation that would turn them."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.images.exif import read_exif
from sfmapp.images.headers import Header, read_header
from sfmapp.images.pixels import without_orientation

# of the quantisation that 97 stands for nothing is to be seen; colours are kept at full resolution
JPEG_QUALITY = 97


def encode(pixels: NDArray[Any], file_format: str) -> bytes:
    """The bytes of a file without any tags.

    Args:
        pixels: (H, W), (H, W, 3) RGB or (H, W, 4) RGBA, uint8 or uint16.
        file_format: as in :class:`Header`. JPEG is written with high quality, all others without loss.

    Raises:
        InputError: the format cannot hold such a picture.
    """
    import cv2

    flags: dict[str, list[int]] = {
        "jpeg": [
            cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
        ],
        "webp": [cv2.IMWRITE_WEBP_QUALITY, 101],
    }  # fmt: skip
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR)
    ending = {"jpeg": ".jpg", "pnm": ".pgm" if pixels.ndim == 2 else ".ppm"}.get(file_format, f".{file_format}")
    height, width = pixels.shape[:2]
    try:
        is_done, data = cv2.imencode(ending, pixels, flags.get(file_format, []))
    except cv2.error as error:
        raise InputError(f"{width}x{height} pixels cannot be written as {file_format}: {error.err}") from error
    if not is_done:
        raise InputError(f"{width}x{height} pixels cannot be written as {file_format}")
    return bytes(data)


def without_turn(data: bytes, header: Header) -> bytes | None:
    """The same file, pixel for pixel, with EXIF orientation 1; None if its tag is where it cannot be changed."""
    if read_exif(header.exif).orientation == 1:
        return data
    place = 0 if header.format == "tiff" else data.find(header.exif)
    if place < 0:
        return None
    block = without_orientation(header.exif)
    end = place + len(block)
    tail = data[end:]
    if header.format == "png":  # its chunks end with a checksum of their name and content
        tail = struct.pack(">I", zlib.crc32(b"eXIf" + block)) + tail[4:]
    changed = data[:place] + block + tail
    return changed if read_exif(read_header(changed).exif).orientation == 1 else None


def encode_mask(mask: NDArray[np.bool_]) -> bytes:
    """A PNG of a mask (H, W), white where it is True."""
    return encode(mask.astype(np.uint8) * 255, "png")
