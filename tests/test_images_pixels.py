"""Pixels: as stored, 8 bits, the same as Pillow's; masks where they belong."""

from __future__ import annotations

import io
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from sfmapp.errors import InputError, UsageError
from sfmapp.events import Event, Events
from sfmapp.geometry.orientation import upright_pixels, upright_size
from sfmapp.images.folder import ImageOptions, ImageRecord, load_images
from sfmapp.images.pixels import (
    read_gray,
    read_mask,
    read_picture,
    read_rgb,
    read_rgb_and_gray,
    to_8_bits,
)

W, H = 48, 32


def picture(seed: int = 0, width: int = W, height: int = H) -> np.ndarray:
    """A smooth colour picture without any symmetry."""
    small = np.random.default_rng(seed).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


def load_one(folder: Path, **options: Any) -> ImageRecord:
    image_set, _ = load_images(folder, ImageOptions(**options), Events())
    assert len(image_set.images) == 1, image_set.skipped
    return image_set.images[0]


def warnings_of(folder: Path, **options: Any) -> list[str]:
    log: list[Event] = []
    load_images(folder, ImageOptions(**options), Events(log.append))
    return [event.message for event in log if event.kind == "warned"]


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "webp"])
def test_pixels_are_those_of_the_file_and_turned_as_pillow_does(tmp_path: Path, ending: str, orientation: int) -> None:
    path = tmp_path / f"a.{ending}"
    exif = Image.Exif()
    exif[274] = orientation
    lossless = {"lossless": True} if ending == "webp" else {}
    Image.fromarray(picture()).save(path, exif=exif, **lossless)
    record = load_one(tmp_path)
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if ending == "tif":  # which OpenCV turns whatever it is told
        stored = picture()
    upright = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB"))
    assert record.orientation == orientation
    assert (record.height, record.width) == (H, W)
    np.testing.assert_array_equal(read_rgb(record), stored)
    np.testing.assert_array_equal(upright_pixels(read_rgb(record), orientation), upright)
    assert upright_size(orientation, W, H) == upright.shape[1::-1]
    turned = replace(record, turn=orientation, width=upright.shape[1], height=upright.shape[0])
    np.testing.assert_array_equal(read_rgb(turned), upright)
    assert read_rgb(turned).flags.c_contiguous


@pytest.mark.parametrize("orientation", range(1, 9))
def test_big_endian_tiff_is_not_turned(tmp_path: Path, orientation: int) -> None:
    pixels = picture()[..., 0]
    entries = [
        (256, 3, W), (257, 3, H), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8),
        (274, 3, orientation), (277, 3, 1), (278, 3, H), (279, 4, W * H),
    ]  # fmt: skip
    ifd = struct.pack(">H", len(entries))
    for tag, kind, value in entries:
        ifd += struct.pack(">HHI", tag, kind, 1) + (
            struct.pack(">HH", value, 0) if kind == 3 else struct.pack(">I", value)
        )
    data = b"MM\0*" + struct.pack(">I", 8 + W * H) + pixels.tobytes() + ifd + b"\0\0\0\0"
    (tmp_path / "a.tif").write_bytes(data)
    record = load_one(tmp_path)
    assert record.orientation == orientation
    np.testing.assert_array_equal(read_gray(record), pixels)


MODES_OF = {
    "jpg": ["RGB", "L", "1", "CMYK"],
    "png": ["RGB", "L", "1", "P", "RGBA", "LA"],
    "tif": ["RGB", "L", "1", "P", "RGBA", "LA", "CMYK"],
    "bmp": ["RGB", "L", "1", "P", "RGBA"],
    "webp": ["RGB", "RGBA"],
    "ppm": ["RGB", "L"],
    "pgm": ["RGB", "L", "1"],
}


@pytest.mark.parametrize(("ending", "mode"), [(ending, mode) for ending, modes in MODES_OF.items() for mode in modes])
def test_every_mode_of_every_format_gives_pillows_colours(tmp_path: Path, ending: str, mode: str) -> None:
    path = tmp_path / f"a.{ending}"
    Image.fromarray(picture()).convert(mode).save(path)
    record = load_one(tmp_path)
    rgb, gray = read_rgb_and_gray(record)
    expected = np.asarray(Image.open(path).convert("RGB")).astype(int)
    assert rgb.shape == (H, W, 3)
    assert gray.shape == (H, W)
    # CMYK has as many roads to RGB as there are programs: these two differ by rounding
    assert np.abs(rgb - expected).max() <= (1 if mode == "CMYK" else 0)
    assert read_mask(record) is None


def test_gray_is_bt601_of_the_colours_and_the_same_by_every_road(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.jpg", quality=95)
    record = load_one(tmp_path)
    rgb, gray = read_rgb_and_gray(record)
    whole = read_picture(record)
    assert np.abs(rgb @ np.array([0.299, 0.587, 0.114]) - gray).max() <= 0.51
    for other in (read_gray(record), whole.gray):
        np.testing.assert_array_equal(gray, other)
    for other in (read_rgb(record), whole.rgb):
        np.testing.assert_array_equal(rgb, other)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("ending", ["png", "tif", "pgm"])
def test_deep_images_are_scaled_not_clipped(tmp_path: Path, bits: int, ending: str) -> None:
    ramp = np.linspace(0, (1 << bits) - 1, W * H).round().astype(np.uint16).reshape(H, W)
    Image.fromarray(ramp).save(tmp_path / f"a.{ending}")
    gray = read_gray(load_one(tmp_path))
    assert gray.dtype == np.uint8
    np.testing.assert_allclose(gray, np.linspace(0, 255, W * H).reshape(H, W), atol=0.76)


def test_16_bits_are_mentioned_once(tmp_path: Path) -> None:
    for i in range(3):
        Image.fromarray(np.full((H, W), 40000 + i, np.uint16)).save(tmp_path / f"{i}.png")
    log: list[Event] = []
    load_images(tmp_path, ImageOptions(), Events(log.append))
    assert [e.data["names"] for e in log if "16 bits" in e.message] == [["0.png", "1.png", "2.png"]]


def test_scaling_rounds_half_up() -> None:
    values = np.array([[0, 128, 129, 65535]], np.uint16)
    np.testing.assert_array_equal(to_8_bits(values), [[0, 0, 1, 255]])


def test_transparent_palette_and_gray_are_masked(tmp_path: Path) -> None:
    indices = np.zeros((H, W), np.uint8)
    indices[:, W // 2 :] = 1
    image = Image.fromarray(indices, "P")
    image.putpalette([200, 10, 10, 10, 200, 10])
    image.save(tmp_path / "p.png", transparency=1)
    mask = read_mask(load_one(tmp_path))
    assert mask is not None
    np.testing.assert_array_equal(mask, indices == 0)


@pytest.mark.parametrize("ending", ["png", "webp", "tif"])
def test_alpha_is_a_mask_where_it_varies(tmp_path: Path, ending: str) -> None:
    rgba = np.dstack([picture(), np.full((H, W), 255, np.uint8)])
    rgba[: H // 2, :, 3] = 0
    rgba[: H // 2, :, :3] = 0  # lossless WebP may blank what cannot be seen
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(rgba).save(tmp_path / f"a.{ending}", exif=exif, **({"lossless": True} if ending == "webp" else {}))
    record = load_one(tmp_path)
    mask = read_mask(record)
    assert mask is not None
    assert mask.shape == (record.height, record.width) == (H, W)
    np.testing.assert_array_equal(mask, rgba[..., 3] > 0)
    np.testing.assert_array_equal(mask, read_picture(record).mask)
    np.testing.assert_array_equal(read_rgb(record), rgba[..., :3])
    turned = replace(record, orientation=1, turn=6, width=H, height=W)
    np.testing.assert_array_equal(read_mask(turned), np.rot90(rgba[..., 3] > 0, -1))
    np.testing.assert_array_equal(read_rgb(turned), np.rot90(rgba[..., :3], -1))
    assert read_mask(load_one(tmp_path, use_alpha=False)) is None


@pytest.mark.parametrize("alpha", [0, 255, "noise"])
def test_alpha_that_says_nothing_is_no_mask(tmp_path: Path, alpha: int | str) -> None:
    channel = np.random.default_rng(0).integers(250, 256, (H, W)) if alpha == "noise" else np.full((H, W), alpha)
    Image.fromarray(np.dstack([picture(), channel.astype(np.uint8)])).save(tmp_path / "a.png")
    assert read_mask(load_one(tmp_path)) is None


def half_mask(width: int, height: int) -> np.ndarray:
    mask = np.zeros((height, width), np.uint8)
    mask[:, : width // 2] = 255
    return mask


@pytest.mark.parametrize("naming", ["sub/a.jpg.png", "sub/a.png"])
def test_masks_are_found_by_both_names(tmp_path: Path, naming: str) -> None:
    images, masks = tmp_path / "images", tmp_path / "masks"
    (images / "sub").mkdir(parents=True)
    (masks / "sub").mkdir(parents=True)
    Image.fromarray(picture()).save(images / "sub/a.jpg")
    Image.fromarray(half_mask(W, H)).save(masks / naming)
    mask = read_mask(load_one(images, mask_path=str(masks)))
    assert mask is not None
    np.testing.assert_array_equal(mask, half_mask(W, H) > 0)
    assert warnings_of(images, mask_path=str(masks)) == []


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "I;16"])
def test_masks_of_any_mode_are_black_and_not_black(tmp_path: Path, mode: str) -> None:
    (tmp_path / "m").mkdir()
    Image.fromarray(picture()).save(tmp_path / "a.png")
    mask = half_mask(W, H)
    image = Image.fromarray((mask > 0).astype(np.uint16)) if mode == "I;16" else Image.fromarray(mask).convert(mode)
    image.save(tmp_path / "m/a.png.png")
    read = read_mask(load_one(tmp_path, mask_path=str(tmp_path / "m")))
    assert read is not None
    np.testing.assert_array_equal(read, mask > 0)


@pytest.mark.parametrize("is_upright", [False, True])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_mask_fits_the_file_or_by_its_shape_the_upright_picture(
    tmp_path: Path, orientation: int, is_upright: bool
) -> None:
    (tmp_path / "m").mkdir()
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(picture()).save(tmp_path / "a.jpg", exif=exif)
    mask = picture(1)[..., 0] > 128
    # of other orientations the shape does not tell: it is taken as COLMAP takes it
    is_turned = is_upright and orientation >= 5
    Image.fromarray(upright_pixels(mask, orientation) if is_turned else mask).save(tmp_path / "m/a.jpg.png")
    options = {"mask_path": str(tmp_path / "m")}
    record = load_one(tmp_path, **options)
    np.testing.assert_array_equal(read_mask(record), mask)
    assert sum("turned back" in text for text in warnings_of(tmp_path, **options)) == is_turned
    if orientation >= 5:
        turned = replace(record, orientation=1, turn=orientation, width=H, height=W)
        np.testing.assert_array_equal(read_mask(turned), upright_pixels(mask, orientation))


def test_mask_and_alpha_both_count(tmp_path: Path) -> None:
    (tmp_path / "m").mkdir()
    rgba = np.dstack([picture(), np.full((H, W), 255, np.uint8)])
    rgba[: H // 2, :, 3] = 0
    Image.fromarray(rgba).save(tmp_path / "a.png")
    Image.fromarray(half_mask(W, H)).save(tmp_path / "m/a.png.png")
    mask = read_mask(load_one(tmp_path, mask_path=str(tmp_path / "m")))
    assert mask is not None
    np.testing.assert_array_equal(mask, (rgba[..., 3] > 0) & (half_mask(W, H) > 0))


def test_mask_of_another_size_is_scaled_or_left_out_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "m").mkdir()
    for name in "abc":
        Image.fromarray(picture()).save(tmp_path / f"{name}.png")
    Image.fromarray(half_mask(W, H)).save(tmp_path / "m/a.png.png")
    Image.fromarray(half_mask(2 * W, 2 * H)).save(tmp_path / "m/b.png.png")
    Image.fromarray(half_mask(W + 9, H)).save(tmp_path / "m/c.png.png")
    image_set, _ = load_images(tmp_path, ImageOptions(mask_path=str(tmp_path / "m")), Events())
    a, b, c = image_set.images
    assert read_mask(c) is None
    for record in (a, b):
        mask = read_mask(record)
        assert mask is not None
        np.testing.assert_array_equal(mask, half_mask(W, H) > 0)
    told = warnings_of(tmp_path, mask_path=str(tmp_path / "m"))
    assert any(m.startswith("b.png: its mask is scaled: 96x64") for m in told)
    assert any(m.startswith("c.png: its mask is not used: 57x32 pixels, the image has 48x32") for m in told)


def test_broken_mask_is_a_warning_and_the_image_stays(tmp_path: Path) -> None:
    (tmp_path / "m").mkdir()
    for name in "ab":
        Image.fromarray(picture()).save(tmp_path / f"{name}.png")
    (tmp_path / "m/a.png.png").write_bytes(b"")
    Image.fromarray(half_mask(W, H)).save(tmp_path / "m/b.png.png")
    assert any(
        "a.png: its mask a.png.png is not used: empty" in m
        for m in warnings_of(tmp_path, mask_path=str(tmp_path / "m"))
    )


def test_masks_beside_the_images_are_no_images(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.jpg")
    Image.fromarray(half_mask(W, H)).save(tmp_path / "a.jpg.png")
    record = load_one(tmp_path, mask_path=str(tmp_path))
    assert record.name == "a.jpg"
    assert read_mask(record) is not None


def test_mask_folder_that_is_absent_or_fits_nothing_is_an_error(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.jpg")
    (tmp_path / "m").mkdir()
    with pytest.raises(InputError, match="no mask") as caught:
        load_one(tmp_path, mask_path=str(tmp_path / "m"))
    assert "a.jpg.png" in str(caught.value.advice)
    with pytest.raises(InputError, match="not a folder"):
        load_one(tmp_path, mask_path=str(tmp_path / "nothing"))


def test_damaged_data_are_an_input_error(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.png")
    record = load_one(tmp_path)
    data = bytearray(record.path.read_bytes())
    record.path.write_bytes(data[:-20])
    for read in (read_rgb, read_gray, read_picture, read_rgb_and_gray):
        with pytest.raises(InputError, match=r"a\.png"):
            read(record)
    Image.fromarray(picture(width=64)).save(record.path)
    with pytest.raises(InputError, match="changed while in use: 64x32 pixels, was 48x32"):
        read_rgb(record)
    record.path.unlink()
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_rgb(record)


def test_data_that_do_not_inflate_are_an_input_error(tmp_path: Path) -> None:
    """Every checksum of this PNG is right, only its compressed stream is not one."""
    import zlib

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", W, H, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", b"nonsense") + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match="cannot be decoded"):
        read_rgb(load_one(tmp_path))


def test_thumbnail_end_marker_does_not_hide_a_truncation(tmp_path: Path) -> None:
    thumb = io.BytesIO()
    Image.fromarray(picture()).resize((16, 16)).save(thumb, "JPEG")
    exif = b"Exif\0\0II*\0\x08\0\0\0\0\0\0\0\0\0" + thumb.getvalue()
    Image.fromarray(picture(width=320, height=240)).save(tmp_path / "a.jpg", exif=exif)
    data = (tmp_path / "a.jpg").read_bytes()
    assert load_one(tmp_path).name == "a.jpg"
    (tmp_path / "a.jpg").write_bytes(data[: len(data) * 2 // 3])
    image_set, _ = load_images(tmp_path, ImageOptions(), Events())
    assert image_set.skipped == (("a.jpg", "truncated: the end of the picture is missing"),)


def test_what_stands_behind_the_picture_is_of_no_interest(tmp_path: Path) -> None:
    first = Image.fromarray(picture())
    first.save(tmp_path / "two.jpg", format="MPO", save_all=True, append_images=[Image.fromarray(picture(1))])
    np.testing.assert_array_equal(read_rgb(load_one(tmp_path)), np.asarray(Image.open(tmp_path / "two.jpg")))
    with open(tmp_path / "two.jpg", "ab") as file:
        file.write(b"\0" * 100 + b"a video of the moment before")
    assert read_rgb(load_one(tmp_path)).shape == (H, W, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera_model": "PINHOL"}, "camera_model"),
        ({"camera_sharing": "some"}, "camera_sharing"),
        ({"focal_px": -3.0}, "focal_px"),
        ({"focal_px": float("nan")}, "focal_px"),
        ({"camera_params": (100.0, 24.0)}, "SIMPLE_RADIAL takes 4"),
        ({"camera_params": (-100.0, 24.0, 16.0, 0.0)}, "positive"),
        ({"camera_params": (float("inf"), 24.0, 16.0, 0.0)}, "finite"),
        ({"camera_params": (100.0, 24.0, 16.0, 0.0), "focal_px": 3.0}, "both"),
        ({"max_pixels": 0}, "max_pixels"),
    ],
)
def test_impossible_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ImageOptions(**options)
