"""Pixels of a photograph as they are stored, 8 bits deep, whatever the file holds.

Grey is OpenCV's, 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601) of the 8-bit colours, rounded; :func:`read_gray` and
:func:`read_picture` give the same bytes. Values deeper than 8 bits are scaled, never clipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.geometry.orientation import INVERSE, upright_pixels, upright_size
from sfmapp.images.headers import Header, UnusableImage, read_header
from sfmapp.images.tags import byte_order, first_directory
from sfmapp.images.tiff import decode_samples, tiff_layout

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord, ImageSource

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Picture:
    """All that one decoding of a file gives.

    Attributes:
        rgb: (H, W, 3) uint8.
        gray: (H, W) uint8.
        mask: (H, W) bool, True where the picture may be used; None for everywhere. Mask file and alpha combined.
    """

    rgb: Pixels
    gray: Pixels
    mask: NDArray[np.bool_] | None


def read_picture(record: ImageRecord) -> Picture:
    """Colour, grey and mask of a photograph, from one decoding.

    Raises:
        InputError: the file is gone, was changed since it was listed, or cannot be decoded.
    """
    color, alpha = _decode(record)
    mask = _alpha_mask(alpha) if record.has_alpha else None
    return Picture(as_rgb(color), as_gray(color), _combine(read_mask_file(record), mask))


def read_on_white(record: ImageRecord) -> tuple[Pixels, NDArray[np.bool_] | None]:
    """(H, W, 3) uint8 colours, transparent parts blended with white, and the mask (H, W) as in :class:`Picture`.

    Raises:
        InputError: as :func:`read_picture`.
    """
    color, alpha = _decode(record)
    rgb, mask = as_rgb(color), _alpha_mask(alpha) if record.has_alpha else None
    if alpha is not None and mask is not None:
        opacity = alpha[..., None].astype(np.uint16)
        rgb = ((rgb * opacity + 255 * (255 - opacity) + 127) // 255).astype(np.uint8)
    return rgb, _combine(read_mask_file(record), mask)


def read_rgb(record: ImageRecord) -> Pixels:
    """(H, W, 3) uint8 colours of a photograph. Raises InputError as :func:`read_picture` does."""
    return as_rgb(_decode(record)[0])


def read_gray(record: ImageRecord) -> Pixels:
    """(H, W) uint8 grey values of a photograph. Raises InputError as :func:`read_picture` does."""
    return as_gray(_decode(record)[0])


def read_rgb_and_gray(record: ImageRecord) -> tuple[Pixels, Pixels]:
    """(H, W, 3) and (H, W) uint8 from one decoding. Raises InputError as :func:`read_picture` does."""
    color = _decode(record)[0]
    return as_rgb(color), as_gray(color)


def read_with_alpha(record: ImageRecord) -> tuple[Pixels, Pixels | None]:
    """(H, W, 3) uint8 colours as they are stored and the alpha channel (H, W) uint8, None where the file has none or
    it says the same everywhere.

    Raises:
        InputError: as :func:`read_picture`.
    """
    color, alpha = _decode(record)
    return as_rgb(color), None if _alpha_mask(alpha) is None else alpha


def read_mask(record: ImageRecord) -> NDArray[np.bool_] | None:
    """(H, W) bool, True where the picture may be used, from its mask file and its alpha channel; None for everywhere.

    Raises:
        InputError: the image or its mask cannot be read.
    """
    alpha = _decode(record)[1] if record.has_alpha else None
    return _combine(read_mask_file(record), _alpha_mask(alpha))


def as_rgb(pixels: Pixels) -> Pixels:
    """(H, W, 3) of pixels that may be grey."""
    import cv2

    return cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB) if pixels.ndim == 2 else pixels


def as_gray(pixels: Pixels) -> Pixels:
    """(H, W) of pixels that may be RGB."""
    import cv2

    return pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)


def _decode(record: ImageRecord) -> tuple[Pixels, Pixels | None]:
    """((H, W) or (H, W, 3) RGB, alpha (H, W) or None) uint8."""
    raw = decode_file(record, *read_file(record)) if record.source is None else _given(record, record.source)
    pixels = to_8_bits(raw)
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    return pixels, None


def _given(record: ImageRecord, source: ImageSource) -> NDArray[Any]:
    """Pixels of a photograph that is no file. Raises InputError if they are not what they were at first."""
    raw = checked_pixels(record.name, source.pixels(record.name))
    if raw.shape[:2] != (record.height, record.width):
        size = f"{raw.shape[1]}x{raw.shape[0]}"
        raise InputError(f"{record.name} was changed while in use: {size} pixels, was {record.width}x{record.height}")
    return raw


def checked_pixels(name: str, raw: Any) -> NDArray[Any]:
    """An array that somebody gives as a photograph. Raises InputError if it has not the form of one."""
    pixels = np.asarray(raw)
    is_picture = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (3, 4))
    if not is_picture or not pixels.size or pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{name}: expected pixels (H, W), (H, W, 3) or (H, W, 4) of uint8 or uint16, found {pixels.dtype} "
            f"{pixels.shape}"
        )
    return np.ascontiguousarray(pixels)


def read_file(record: ImageRecord) -> tuple[bytes, Header]:
    """Bytes and header of a photograph. Raises InputError if it is gone or was changed since it was listed."""
    data = _read_bytes(record)
    try:
        header = read_header(data)
    except UnusableImage as reason:
        raise InputError(f"{record.name}: {reason}") from reason
    size = (header.width, header.height)
    expected = upright_size(INVERSE[record.turn], record.width, record.height)
    # also the guard against a header that was swapped for one that claims gigapixels
    if size != expected:
        raise InputError(
            f"{record.name} was changed while in use: {size[0]}x{size[1]} pixels, was {expected[0]}x{expected[1]}"
        )
    return data, header


def decode_file(record: ImageRecord, data: bytes, header: Header) -> NDArray[Any]:
    """Pixels of what :func:`read_file` gave, as :func:`decode_bytes` gives them, turned as the record has it.

    Raises:
        InputError: the data are damaged.
    """
    raw = decode_bytes(data, header)
    if raw is None or raw.shape[:2] != (header.height, header.width):
        raise InputError(
            f"{record.name} cannot be decoded: its data are damaged", "copy it again from its source, or leave it out"
        )
    pixels: NDArray[Any] = upright_pixels(raw, record.turn)
    return pixels


def _read_bytes(record: ImageRecord) -> bytes:
    try:
        return record.path.read_bytes()
    except OSError as error:
        raise InputError(f"{record.name} cannot be read: {error.strerror or error}") from error


def decode_bytes(data: bytes, header: Header) -> NDArray[Any] | None:
    """(H, W), (H, W, 3) RGB or (H, W, 4) RGBA uint8 or uint16 as stored in the file; None if it cannot be decoded."""
    import cv2

    if header.format == "tiff":
        layout = tiff_layout(data)
        if not layout.is_read_by_opencv:
            return decode_samples(data, layout)
        data = without_orientation(data)
    # IMREAD_UNCHANGED keeps depth, grey and alpha, but does not convert CMYK
    is_plain = header.kind in ("rgb", "palette", "cmyk") and header.bits <= 8 and not header.has_alpha
    flags = cv2.IMREAD_COLOR_RGB if is_plain else cv2.IMREAD_UNCHANGED
    try:
        raw: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except (cv2.error, MemoryError):
        return None
    if raw is None or raw.dtype not in (np.uint8, np.uint16):
        return None
    if is_plain or raw.ndim == 2:
        return raw
    gray: NDArray[Any] = raw[..., 0]
    if raw.shape[2] == 1:
        return gray
    color: NDArray[Any] = cv2.cvtColor(raw, cv2.COLOR_BGRA2RGBA if raw.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    return color


def without_orientation(data: bytes) -> bytes:
    """The same TIFF, or block of EXIF, with orientation 1: OpenCV turns TIFFs whatever it is told."""
    place = first_directory(data).value_offset.get(274)
    if place is None:
        return data
    one = b"\1\0" if byte_order(data) == "<" else b"\0\1"
    return data[:place] + one + data[place + 2 :]


def to_8_bits(raw: NDArray[Any]) -> Pixels:
    """uint16 values scaled to uint8 with rounding; uint8 as it is.

    :func:`white_of` is the largest of them, so that pictures of fewer bits do not come out black.
    """
    if raw.dtype == np.uint8:
        return raw
    white = white_of(raw)
    table = ((np.arange(65536, dtype=np.int64) * 510 + white) // (2 * white)).clip(0, 255).astype(np.uint8)
    scaled: Pixels = table[raw]
    if raw.ndim == 3 and raw.shape[2] == 4:
        scaled[..., 3] = raw[..., 3] >> 8
    return scaled


def white_of(raw: NDArray[Any]) -> int:
    """The value of white in pixels as stored: cameras write 10, 12 and 14 bits into 16, and the smallest of these
    depths that holds the largest value is taken."""
    if raw.dtype == np.uint8:
        return 255
    color = raw[..., :3] if raw.ndim == 3 else raw
    largest = int(color.max(initial=0))
    return next(value for bits in (8, 10, 12, 14, 16) if largest <= (value := (1 << bits) - 1))


def _alpha_mask(alpha: Pixels | None) -> NDArray[np.bool_] | None:
    """More than half opaque; None where the channel says the same everywhere, as it does in most files."""
    if alpha is None:
        return None
    mask = alpha > 127
    return None if mask.all() or not mask.any() else mask


def read_mask_file(record: ImageRecord) -> NDArray[np.bool_] | None:
    """(H, W) bool, True where the picture may be used, from its mask file alone; None if it has none.

    Raises:
        InputError: the mask cannot be read.
    """
    levels = _mask_levels(record)
    if levels is None:
        return None
    mask = (levels > 0).astype(np.uint8)
    if mask.shape != (record.height, record.width):
        import cv2

        mask = cv2.resize(mask, (record.width, record.height), interpolation=cv2.INTER_NEAREST)
    return mask.astype(bool)


def read_mask_coverage(record: ImageRecord) -> Pixels | None:
    """(H, W) uint8 share of each pixel that the mask file leaves open, 255 for all of it; None if there is no file.

    Masks of two values are 0 and 255, whichever they are; those of another size are scaled, shares of pixels kept.

    Raises:
        InputError: the mask cannot be read.
    """
    levels = _mask_levels(record)
    if levels is None:
        return None
    # what never comes to half of white has labels in it, and not shares
    if levels.max(initial=0) < 128:
        levels = np.where(levels > 0, 255, 0).astype(np.uint8)
    if levels.shape != (record.height, record.width):
        import cv2

        shrinks = levels.shape[0] > record.height
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        levels = cv2.resize(levels, (record.width, record.height), interpolation=method)
    return levels


def _mask_levels(record: ImageRecord) -> Pixels | None:
    """(H, W) uint8 of the mask as its file has it, turned like the photograph, of its own size; None without a mask.

    Raises:
        InputError: the mask cannot be read.
    """
    if record.source is not None:
        return _given_mask(record, record.source)
    if record.mask_path is None:
        return None
    try:
        data = record.mask_path.read_bytes()
        header = read_header(data)
    except OSError as error:
        raise InputError(f"mask of {record.name} cannot be read: {error.strerror or error}") from error
    except UnusableImage as reason:
        raise InputError(f"mask of {record.name}: {reason}") from reason
    fit = mask_fit(header, record)
    raw = decode_bytes(data, header) if fit is not None else None
    if raw is None:
        raise InputError(f"mask {record.mask_path} of {record.name} cannot be decoded or has another shape")
    gray = raw[..., :3].max(axis=2) if raw.ndim == 3 else raw
    # what is open at all stays so in eight bits
    levels = np.maximum(to_8_bits(gray), gray > 0)
    if fit == "turned":
        levels = upright_pixels(levels, INVERSE[record.orientation] if record.turn == 1 else record.turn)
    return levels


def _given_mask(record: ImageRecord, source: ImageSource) -> Pixels | None:
    given = source.mask(record.name)
    if given is None:
        return None
    mask = np.asarray(given)
    if mask.shape != (record.height, record.width):
        raise InputError(
            f"mask of {record.name}: expected an array of shape ({record.height}, {record.width}), found {mask.shape}"
        )
    return mask if mask.dtype == np.uint8 else (mask != 0).astype(np.uint8)


def mask_fit(header: Header, record: ImageRecord) -> str | None:
    """How a mask lies on its image: ``straight``, ``turned`` (by 90 degrees, as EXIF says), or None if it does not fit.

    Masks fit the pixels of the file, as COLMAP has it; where only the turned picture has its shape, it was made for
    that. A mask of another size fits if its shape is the same to a pixel: it was made for a smaller or larger version.
    """
    if min(header.width, header.height) < 16:  # too coarse for its shape to mean anything
        return None
    is_sideways = max(record.orientation, record.turn) >= 5
    for fit, width, height in (("straight", record.width, record.height), ("turned", record.height, record.width)):
        if fit == "turned" and not is_sideways:
            break
        scale = max(header.width / width, header.height / height)
        if abs(header.width - width * scale) <= 1.0 and abs(header.height - height * scale) <= 1.0:
            return fit
    return None


def _combine(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    if a is None or b is None:
        return b if a is None else a
    return a & b
