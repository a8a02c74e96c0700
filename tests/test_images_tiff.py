"""TIFF in the forms that cameras, drones and editors write: bands, alpha, depths, planes, tiles, both byte orders.

The files are written here sample by sample after TIFF 6.0, or by Pillow, whose own reader is the oracle then.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sfmapp.events import Event, Events
from sfmapp.images.folder import ImageOptions, ImageRecord, load_images
from sfmapp.images.headers import UnusableImage, read_header
from sfmapp.images.pixels import decode_bytes, read_mask, read_on_white, read_rgb

W, H = 40, 24
NONE, DEFLATE = 1, 8
Samples = NDArray[Any]


def samples(count: int, bits: int, seed: int = 0) -> Samples:
    dtype = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(seed).integers(0, 1 << bits, (H, W, count), dtype)


def differences(block: Samples) -> Samples:
    out = block.copy()
    out[:, 1:] -= block[:, :-1]
    return out


def tiff(
    pixels: Samples, photometric: int, extra: tuple[int, ...] = (), *, compression: int = NONE, planar: bool = False,
    predictor: bool = False, tile: int = 0, order: str = "<", changed: dict[int, tuple[int, ...]] | None = None,
) -> bytes:  # fmt: skip
    """A file of samples (H, W, C), in strips of some rows or in square tiles."""
    rows, (height, width, count) = 7, pixels.shape
    planes = [pixels[..., k : k + 1] for k in range(count)] if planar else [pixels]
    blocks = []
    for plane in planes:
        if tile:
            padded = np.pad(plane, ((0, -height % tile), (0, -width % tile), (0, 0)), mode="edge")
            starts = [(y, x) for y in range(0, padded.shape[0], tile) for x in range(0, padded.shape[1], tile)]
            blocks += [padded[y : y + tile, x : x + tile] for y, x in starts]
        else:
            blocks += [plane[y : y + rows] for y in range(0, height, rows)]
    written = [(differences(b) if predictor else b).astype(b.dtype.newbyteorder(order)).tobytes() for b in blocks]
    written = [zlib.compress(b) for b in written] if compression == DEFLATE else written
    data = bytearray((b"II*\0" if order == "<" else b"MM\0*") + b"\0" * 4)
    offsets = []
    for block in written:
        offsets.append(len(data))
        data += block + b"\0" * (len(block) % 2)
    tags: dict[int, tuple[int, ...]] = {
        256: (width,), 257: (height,), 258: (8 * pixels.itemsize,) * count, 259: (compression,), 262: (photometric,),
        277: (count,), 284: (2 if planar else 1,),
    }  # fmt: skip
    sizes = tuple(map(len, written))
    if tile:
        tags |= {322: (tile,), 323: (tile,), 324: tuple(offsets), 325: sizes}
    else:
        tags |= {273: tuple(offsets), 278: (rows,), 279: sizes}
    tags |= ({317: (2,)} if predictor else {}) | ({338: extra} if extra else {}) | (changed or {})
    entries = b""
    for tag, values in sorted(tags.items()):
        is_long = tag in (273, 279, 324, 325)
        packed = struct.pack(f"{order}{len(values)}{'I' if is_long else 'H'}", *values)
        if len(packed) > 4:
            place = len(data)
            data += packed + b"\0" * (len(packed) % 2)
            packed = struct.pack(order + "I", place)
        entries += struct.pack(order + "HHI", tag, 4 if is_long else 3, len(values)) + packed.ljust(4, b"\0")
    data[4:8] = struct.pack(order + "I", len(data))
    return bytes(data) + struct.pack(order + "H", len(tags)) + entries + b"\0\0\0\0"


def decoded(data: bytes) -> tuple[Samples, bool]:
    header = read_header(data)
    raw = decode_bytes(data, header)
    assert raw is not None
    assert raw.shape[:2] == (header.height, header.width)
    return raw, header.has_alpha


FORMS = [
    {}, {"compression": DEFLATE}, {"compression": DEFLATE, "predictor": True}, {"planar": True},
    {"planar": True, "compression": DEFLATE, "predictor": True}, {"tile": 32},
    {"tile": 32, "compression": DEFLATE, "predictor": True}, {"tile": 32, "planar": True}, {"order": ">"},
    {"order": ">", "compression": DEFLATE, "predictor": True},
]  # fmt: skip


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("extra", [(), (0,), (2,), (0, 0), (0, 2), (2, 0), (0,) * 7], ids=str)
def test_colours_are_the_first_bands_and_alpha_is_what_is_called_so(
    form: dict[str, Any], bits: int, extra: tuple[int, ...]
) -> None:
    pixels = samples(3 + len(extra), bits)
    raw, has_alpha = decoded(tiff(pixels, 2, extra, **form))
    np.testing.assert_array_equal(raw[..., :3], pixels[..., :3])
    assert has_alpha == (2 in extra)
    if has_alpha:
        np.testing.assert_array_equal(raw[..., 3], pixels[..., 3 + extra.index(2)])
    else:
        assert raw.shape[2] == 3


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("is_white_zero", [False, True])
@pytest.mark.parametrize("extra", [(), (0,), (2,), (0, 0, 0, 0)], ids=str)
def test_grey_is_dark_where_it_is_dark(
    form: dict[str, Any], bits: int, is_white_zero: bool, extra: tuple[int, ...]
) -> None:
    pixels = samples(1 + len(extra), bits)
    raw, has_alpha = decoded(tiff(pixels, 0 if is_white_zero else 1, extra, **form))
    expected = (1 << bits) - 1 - pixels[..., 0] if is_white_zero else pixels[..., 0]
    assert has_alpha == (2 in extra)
    if not has_alpha:
        np.testing.assert_array_equal(raw, expected)
        return
    np.testing.assert_array_equal(raw[..., :3], np.repeat(expected[..., None], 3, axis=2))
    np.testing.assert_array_equal(raw[..., 3], pixels[..., 1])


def test_twelve_bits_in_sixteen_are_a_negative_of_twelve_bits() -> None:
    pixels = samples(1, 16) >> 4
    raw, _ = decoded(tiff(pixels, 0))
    np.testing.assert_array_equal(raw, 4095 - pixels[..., 0])


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("extra", [(), (0,)], ids=str)
def test_inks_take_from_white(bits: int, extra: tuple[int, ...]) -> None:
    pixels, white = samples(4 + len(extra), bits), (1 << bits) - 1
    raw, has_alpha = decoded(tiff(pixels, 5, extra))
    left = 1.0 - pixels.astype(float) / white
    assert not has_alpha
    np.testing.assert_allclose(raw / white, left[..., :3] * left[..., 3:4], atol=1.5 / white)


@pytest.mark.parametrize("bits", [8, 16])
def test_colours_that_were_multiplied_with_alpha_are_divided_again(bits: int) -> None:
    white = (1 << bits) - 1
    color, alpha = samples(3, bits), samples(1, bits, seed=1) | (1 << (bits - 2))
    alpha[:4] = 0
    multiplied = np.rint(color.astype(float) * alpha / white).astype(color.dtype)
    raw, has_alpha = decoded(tiff(np.dstack([multiplied, alpha]), 2, (1,)))
    assert has_alpha
    assert np.abs(raw[4:, :, :3].astype(int) - color[4:]).max() <= 3  # a quarter of full alpha leaves two bits less
    assert not raw[:4, :, :3].any()
    np.testing.assert_array_equal(raw[..., 3:], alpha)


# ----------------------------------------------------------------------------------------------------- as photographs


def load(folder: Path, data: bytes) -> ImageRecord:
    (folder / "a.tif").write_bytes(data)
    image_set, _ = load_images(folder, ImageOptions(), Events())
    assert len(image_set.images) == 1, image_set.skipped
    return image_set.images[0]


def test_near_infrared_is_no_mask(tmp_path: Path) -> None:
    pixels = samples(4, 8)
    pixels[: H // 2, :, 3] = 0  # water, say: it would all be masked away
    record = load(tmp_path, tiff(pixels, 2, (0,)))
    assert read_mask(record) is None
    told: list[Event] = []
    load_images(tmp_path, ImageOptions(), Events(told.append))
    assert sum("near infrared" in event.message for event in told) == 1
    np.testing.assert_array_equal(read_rgb(record), pixels[..., :3])
    np.testing.assert_array_equal(read_on_white(record)[0], pixels[..., :3])


@pytest.mark.parametrize("photometric", [1, 2])
def test_alpha_masks_and_does_not_darken(tmp_path: Path, photometric: int) -> None:
    colors = 3 if photometric == 2 else 1
    pixels = samples(colors + 1, 8)
    pixels[..., -1] = 255
    pixels[: H // 2, :, -1] = 40
    record = load(tmp_path, tiff(pixels, photometric, (2,)))
    np.testing.assert_array_equal(read_mask(record), pixels[..., -1] > 127)
    np.testing.assert_array_equal(read_rgb(record), np.broadcast_to(pixels[..., :colors], (H, W, 3)))


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "RGBX", "LA", "P", "1", "CMYK", "I;16"])
@pytest.mark.parametrize("compression", ["raw", "big", "tiff_lzw", "tiff_adobe_deflate", "packbits"])
def test_what_pillow_writes_is_what_it_reads(tmp_path: Path, mode: str, compression: str) -> None:
    is_big = compression == "big"  # with 8 bytes for an offset; Pillow writes none of these compressed
    compression = "raw" if is_big else compression
    count = {"RGB": 3, "RGBA": 4, "RGBX": 4, "CMYK": 4, "LA": 2}.get(mode, 1)
    pixels = samples(count, 16 if mode == "I;16" else 8)
    if mode in ("P", "1"):
        image = Image.fromarray(samples(3, 8)).convert(mode)
    else:
        image = Image.frombytes(mode, (W, H), pixels.tobytes())
    predictor = {317: 2} if compression in ("tiff_lzw", "tiff_adobe_deflate") and mode not in ("1", "P") else {}
    image.save(tmp_path / "p.tif", compression=compression, tiffinfo=predictor, big_tiff=is_big)
    data = (tmp_path / "p.tif").read_bytes()
    assert data[2:4] == (b"+\0" if is_big else b"*\0")
    raw, has_alpha = decoded(data)
    with Image.open(tmp_path / "p.tif") as read:
        assert has_alpha == (mode in ("RGBA", "LA"))
        if mode == "I;16":
            np.testing.assert_array_equal(raw, np.asarray(read))
            return
        expected = np.asarray(read.convert("RGBA" if has_alpha else "RGB"))
    found = raw if raw.ndim == 3 else np.repeat(raw[..., None], 3, axis=2)
    np.testing.assert_allclose(found.astype(int), expected.astype(int), atol=1 if mode == "CMYK" else 0)


def test_jpeg_in_tiff_drops_its_fourth_band(tmp_path: Path) -> None:
    smooth = np.asarray(Image.fromarray(samples(4, 8)[:4, :4]).resize((W, H)))
    Image.frombytes("RGBX", (W, H), smooth.tobytes()).save(tmp_path / "p.tif", compression="jpeg", quality=95)
    raw, has_alpha = decoded((tmp_path / "p.tif").read_bytes())
    assert not has_alpha
    assert np.abs(raw.astype(int) - smooth[..., :3]).mean() < 8


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (tiff(samples(1, 16), 1, changed={339: (3,)}), "floating-point or signed"),
        (tiff(samples(3, 8), 8), "PhotometricInterpretation 8"),
        (tiff(samples(1, 16), 32803), "PhotometricInterpretation 32803"),
        (tiff(samples(4, 8), 5, changed={332: (2,)}), "PhotometricInterpretation 5"),
        (tiff(samples(1, 16), 1, changed={258: (12,)}), "12 bits a sample"),
        (tiff(samples(3, 8), 2, changed={258: (8, 8, 16)}), "8, 16 bits a sample"),
        (tiff(samples(3, 8), 2, changed={259: (50000,)}), "compression 50000"),
        (tiff(samples(5, 8), 2, (0, 0), changed={259: (7,)}), "5 bands of 8 bits, compression JPEG"),
        (tiff(samples(2, 8), 3, (0,)), "2 bands of 8 bits"),
        (tiff(samples(2, 8), 2), "broken header"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_what_is_not_read_is_named(data: bytes, found: str) -> None:
    with pytest.raises(UnusableImage) as caught:
        read_header(data)
    assert found in str(caught.value)


def test_damaged_bands_are_damaged() -> None:
    data = bytearray(tiff(samples(5, 16), 2, (0, 0), compression=DEFLATE))
    data[20:600] = bytes(580)
    header = read_header(bytes(data))
    assert decode_bytes(bytes(data), header) is None


@pytest.mark.parametrize("cut", range(0, 400, 7))
def test_no_cut_or_scrambled_directory_is_a_crash(cut: int) -> None:
    whole = tiff(samples(5, 16), 2, (2, 0), predictor=True, compression=DEFLATE)
    rng = np.random.default_rng(cut)
    broken = bytearray(whole)
    for place in rng.integers(len(whole) - 200, len(whole), 4):
        broken[place] = rng.integers(0, 256)
    for data in (whole[: len(whole) - cut], bytes(broken)):
        try:
            header = read_header(data)
        except UnusableImage:
            continue
        if header.width * header.height < 1e6:
            decode_bytes(data, header)
