"""TIFF: which of its many forms are read, and the samples of those that OpenCV misreads or refuses.

OpenCV takes a fourth band for alpha whatever the file says of it, multiplies colours with alpha, refuses more bands,
muddles 16-bit planes, and reads 16 bits where white is zero as a negative. Its decompression is as good as any: a
picture of C interleaved samples is, row by row, a grey picture C times as wide. So the file gets a directory that says
so, OpenCV unpacks it, and the samples are interpreted here. (TIFF 6.0; ExtraSamples in section 18.)
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.tags import Directory, byte_order, first_directory

ASSOCIATED_ALPHA, UNASSOCIATED_ALPHA = 1, 2
WHITE_IS_ZERO = 0
# kind and number of colours of each PhotometricInterpretation
_COLORS = {0: ("gray", 1), 1: ("gray", 1), 2: ("rgb", 3), 3: ("palette", 1), 5: ("cmyk", 4), 6: ("rgb", 3)}
_COMPRESSION = {
    1: "none", 2: "CCITT", 3: "CCITT", 4: "CCITT", 5: "LZW", 6: "JPEG", 7: "JPEG", 8: "deflate", 32773: "PackBits",
    32946: "deflate",
}  # fmt: skip
# those that give back bytes, whatever these stand for
_OF_BYTES = frozenset({1, 5, 8, 32773, 32946})
_WITH_PREDICTOR = frozenset({5, 8, 32946})
_HORIZONTAL_DIFFERENCES = 2


class UnreadTiffError(ValueError):
    """A form of TIFF that is not read; says what was found, what is expected, and the remedy, as a phrase."""


@dataclass(frozen=True)
class TiffLayout:
    """How the samples of a TIFF lie in it.

    Attributes:
        directory: the first.
        width, height: pixels.
        bits: of each sample, all alike.
        kind: ``gray``, ``rgb``, ``palette`` or ``cmyk``. num_colors: samples of it; others follow.
        num_samples: of a pixel.
        alpha: position of the sample that the file calls alpha, None for none. is_associated: colours are multiplied
            with it.
        is_white_zero: grey values count from white to black.
        is_planar: each sample has a plane of its own.
    """

    directory: Directory
    width: int
    height: int
    bits: int
    kind: str
    num_colors: int
    num_samples: int
    alpha: int | None
    is_associated: bool
    is_white_zero: bool
    is_planar: bool
    compression: int

    @property
    def is_read_by_opencv(self) -> bool:
        """OpenCV gives the right colours."""
        if self.compression not in _OF_BYTES:
            return True
        is_muddled = self.bits > 8 and (self.is_planar or self.is_white_zero or self.kind == "cmyk")
        return self.num_samples == self.num_colors and not is_muddled


def tiff_layout(data: bytes) -> TiffLayout:
    """The layout of a TIFF's first picture.

    Raises:
        UnreadTiffError: it is in a form that is not read.
    """
    first = first_directory(data)
    width, height = first.number(256), first.number(257)
    if width is None or height is None:
        raise UnreadTiffError("truncated or a broken header")
    all_bits = set(first.numbers(258) or (1,))
    if set(first.numbers(339)) - {1}:
        raise UnreadTiffError("floating-point or signed values, which are not read: convert it to 16 bits")
    photometric = int(first.number(262) or 0)
    if photometric not in _COLORS or (photometric == 5 and first.number(332) not in (None, 1.0)):
        raise UnreadTiffError(
            f"neither grey, RGB, palette nor CMYK (PhotometricInterpretation {photometric}): convert it to RGB"
        )
    if len(all_bits) > 1 or not all_bits <= {1, 2, 4, 8, 16}:
        found = ", ".join(f"{bits:g}" for bits in sorted(all_bits))
        raise UnreadTiffError(f"a TIFF of {found} bits a sample: convert it to 8 or 16 bits")
    kind, num_colors = _COLORS[photometric]
    num_samples = int(first.number(277) or len(first.numbers(258)) or 1)
    if num_samples < num_colors:
        raise UnreadTiffError("broken header")
    extra = [int(value) for value in first.numbers(338)][: num_samples - num_colors]
    of_alpha = [k for k, value in enumerate(extra) if value in (ASSOCIATED_ALPHA, UNASSOCIATED_ALPHA)]
    layout = TiffLayout(
        first, int(width), int(height), int(all_bits.pop()), kind, num_colors, num_samples,
        num_colors + of_alpha[0] if of_alpha and kind != "cmyk" else None,
        bool(of_alpha) and extra[of_alpha[0]] == ASSOCIATED_ALPHA,
        photometric == WHITE_IS_ZERO, first.number(284) == 2.0, int(first.number(259) or 1),
    )  # fmt: skip
    _check_can_be_read(layout, photometric)
    return layout


def _check_can_be_read(layout: TiffLayout, photometric: int) -> None:
    name = _COMPRESSION.get(layout.compression)
    if name is None:
        raise UnreadTiffError(
            f"a TIFF with compression {layout.compression}, which is not read: save it with LZW or deflate"
        )
    if layout.num_samples == layout.num_colors:
        return
    found = f"a TIFF of {layout.num_samples} bands of {layout.bits} bits, compression {name}"
    if layout.kind == "palette" or photometric == 6 or layout.bits < 8:
        raise UnreadTiffError(f"{found}, which is not read: save it as RGB of 8 or 16 bits")
    if layout.compression not in _OF_BYTES and layout.num_samples > 4:
        raise UnreadTiffError(f"{found}, which is not read: save it with LZW or deflate, or only its first three bands")


def decode_samples(data: bytes, layout: TiffLayout) -> NDArray[Any] | None:
    """(H, W), (H, W, 3) RGB or (H, W, 4) RGBA of 8 or 16 bits as stored, for layouts that OpenCV does not read right.

    Bands that are neither colour nor alpha are left out. None if the data are damaged.
    """
    samples = _unpacked(data, layout)
    if samples is None:
        return None
    alpha = samples[..., layout.alpha] if layout.alpha is not None else None
    color = samples[..., : layout.num_colors]
    if layout.kind == "cmyk":
        color = _rgb_of_cmyk(color)
    if alpha is not None and layout.is_associated:
        color = _divided(color, alpha)
    if layout.is_white_zero:
        color = _white(color) - color
    if alpha is not None:
        color = np.repeat(color, 3, axis=2) if color.shape[2] == 1 else color
        return np.dstack([color, alpha])
    return np.ascontiguousarray(color[..., 0] if color.shape[2] == 1 else color)


def _white(values: NDArray[Any]) -> Any:
    """The value of white: cameras write 10, 12 and 14 bits into 16, see :func:`sfmapp.images.pixels.to_8_bits`."""
    largest = int(values.max(initial=0))
    depths = (8,) if values.dtype == np.uint8 else (8, 10, 12, 14, 16)
    return values.dtype.type(next(white for bits in depths if largest <= (white := (1 << bits) - 1)))


def _rgb_of_cmyk(cmyk: NDArray[Any]) -> NDArray[Any]:
    """As libtiff does it, without a profile: what each ink and black leave of white."""
    white = np.iinfo(cmyk.dtype).max
    left = white - cmyk.astype(np.uint32)
    return (left[..., :3] * left[..., 3:] // white).astype(cmyk.dtype)


def _divided(color: NDArray[Any], alpha: NDArray[Any]) -> NDArray[Any]:
    """Colours that were multiplied with alpha as they were before; black where nothing is left of them."""
    white = np.iinfo(color.dtype).max
    opaque = np.maximum(alpha, 1).astype(np.uint32)[..., None]
    divided: NDArray[Any] = np.minimum((color.astype(np.uint32) * white + opaque // 2) // opaque, white)
    return divided.astype(color.dtype)


# -------------------------------------------------------------------------------------------------------- unpacking


def _unpacked(data: bytes, layout: TiffLayout) -> NDArray[Any] | None:
    """(H, W, C) samples as they are written, uint8 or uint16."""
    if not layout.is_planar:
        grey = _unpacked_grey(data, layout, layout.num_samples, slice(None))
        shape = (layout.height, layout.width, layout.num_samples)
        return None if grey is None else _summed(grey.reshape(shape), layout)
    first = layout.directory
    per_plane = len(first.numbers(273) or first.numbers(324)) // layout.num_samples
    planes = []
    for k in range(layout.num_samples):
        plane = _unpacked_grey(data, layout, 1, slice(k * per_plane, (k + 1) * per_plane))
        if plane is None:
            return None
        planes.append(_summed(plane[..., None], layout)[..., 0])
    return np.stack(planes, axis=2)


def _unpacked_grey(data: bytes, layout: TiffLayout, wide: int, parts: slice) -> NDArray[Any] | None:
    """(H, wide W) of some strips or tiles, by OpenCV."""
    import cv2

    try:
        grey = cv2.imdecode(np.frombuffer(_as_grey(data, layout, wide, parts), np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError, struct.error):
        return None
    is_whole = grey is not None and grey.shape == (layout.height, wide * layout.width)
    return grey if is_whole and grey.dtype == (np.uint8 if layout.bits == 8 else np.uint16) else None


def _as_grey(data: bytes, layout: TiffLayout, wide: int, parts: slice) -> bytes:
    """The same file with a directory behind it that makes a grey picture of it, ``wide`` times as wide."""
    first, order = layout.directory, byte_order(data) or "<"
    entries: dict[int, tuple[int, ...]] = {
        256: (layout.width * wide,), 257: (layout.height,), 258: (layout.bits,), 259: (layout.compression,), 262: (1,),
        277: (1,), 284: (1,), 339: (1,),
    }  # fmt: skip
    for tag in (266, 278, 323):
        if first.numbers(tag):
            entries[tag] = (int(first.numbers(tag)[0]),)
    if first.numbers(322):
        entries[322] = (int(first.numbers(322)[0]) * wide,)
    for tag in (273, 279, 324, 325):
        if first.numbers(tag):
            entries[tag] = tuple(int(value) for value in first.numbers(tag)[parts])
    values = bytearray()
    start = len(data) + len(data) % 2
    directory = struct.pack(order + "H", len(entries))
    after = start + 2 + 12 * len(entries) + 4
    for tag, numbers in sorted(entries.items()):
        packed = struct.pack(f"{order}{len(numbers)}I", *numbers)
        if len(numbers) > 1:
            packed, values = struct.pack(order + "I", after + len(values)), values + packed
        directory += struct.pack(order + "HHI", tag, 4, len(numbers)) + packed
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", start)
    return b"".join([head, data[8:], b"\0" * (len(data) % 2), directory, b"\0\0\0\0", bytes(values)])


def _summed(samples: NDArray[Any], layout: TiffLayout) -> NDArray[Any]:
    """Samples (H, W, C) of which each is written as its difference from the one to its left, in its strip or tile."""
    if layout.directory.number(317) != _HORIZONTAL_DIFFERENCES or layout.compression not in _WITH_PREDICTOR:
        return samples
    step = int(layout.directory.number(322) or layout.width)
    runs = [samples[:, x : x + step] for x in range(0, layout.width, step)]
    return np.concatenate([np.cumsum(run, axis=1, dtype=run.dtype) for run in runs], axis=1)
