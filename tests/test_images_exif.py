"""EXIF and the focal priors that follow from it."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from sfmapp.images.exif import ExifFacts, focal_prior, read_exif
from sfmapp.images.tags import first_directory

PHOTO, GPS = 34665, 34853


def exif_bytes(
    first: dict[int, Any] | None = None, photo: dict[int, Any] | None = None, gps: dict[int, Any] | None = None
) -> bytes:
    """An EXIF block written by Pillow."""
    exif = Image.Exif()
    exif.update(first or {})
    exif.get_ifd(PHOTO).update(photo or {})
    exif.get_ifd(GPS).update(gps or {})
    return exif.tobytes().removeprefix(b"Exif\0\0")


def photo_bytes(entries: list[tuple[int, int, bytes]], order: str = "<") -> bytes:
    """An EXIF block with a photo directory of (tag, type, raw value), which may be anything."""
    data = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    data += struct.pack(order + "HHHIII", 1, PHOTO, 4, 1, 26, 0)
    places = len(data) + 2 + 12 * len(entries) + 4
    table, values = struct.pack(order + "H", len(entries)), b""
    sizes = {2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8, 11: 4, 12: 8}
    for tag, kind, raw in entries:
        table += struct.pack(order + "HHI", tag, kind, len(raw) // sizes[kind])
        if len(raw) <= 4:
            table += raw.ljust(4, b"\0")
        else:
            table += struct.pack(order + "I", places + len(values))
            values += raw
    return data + table + b"\0\0\0\0" + values


def test_all_facts_as_pillow_writes_them() -> None:
    facts = read_exif(
        exif_bytes(
            {271: "Canon ", 272: "Canon EOS 5D Mark II", 274: 8},
            {
                36867: "2010:05:29 10:30:22", 37521: "25", 36881: "+02:00", 37386: 24.5, 41989: 25, 42036: "EF 24-70",
                42033: "0042", 40962: 5616, 40963: 3744, 41486: 3848.0, 41488: 2,
            },
            {1: "S", 2: (33.0, 30.0, 36.0), 3: "W", 4: (70.0, 15.0, 0.0), 5: b"\x01", 6: 12.5},
        )
    )  # fmt: skip
    assert (facts.make, facts.model, facts.lens, facts.serial) == ("Canon", "Canon EOS 5D Mark II", "EF 24-70", "0042")
    assert facts.orientation == 8
    assert (facts.focal_mm, facts.focal_35mm) == (24.5, 25.0)
    assert facts.camera_size == (5616, 3744)
    assert facts.focal_plane_px_per_mm == pytest.approx(3848.0 / 25.4)
    assert facts.timestamp == 1275121822.25  # 08:30:22 UTC
    assert facts.position.gps == pytest.approx((-33.51, -70.25, -12.5))
    assert facts.problems == ()


def test_both_byte_orders_say_the_same() -> None:
    blocks = [
        photo_bytes([(37386, 5, struct.pack(o + "II", 35, 10)), (41989, 3, struct.pack(o + "H", 28))], o) for o in "<>"
    ]
    assert [(f.focal_mm, f.focal_35mm) for f in map(read_exif, blocks)] == [(3.5, 28.0)] * 2


@pytest.mark.parametrize(
    ("date", "zone", "expected"),
    [
        ("1970:01:02 00:00:00", "", 86400.0),
        ("1970:01:02 00:00:00", "-01:30", 86400.0 + 5400.0),
        ("0000:00:00 00:00:00", "", None),
        ("2020:13:45 99:99:99", "", None),
        ("    :  :     :  :  ", "", None),
        ("1970:01:02 00:00:00", "+99:99", None),
        ("yesterday", "", None),
    ],
)
def test_timestamps(date: str, zone: str, expected: float | None) -> None:
    assert read_exif(exif_bytes(photo={36867: date, 36881: zone})).timestamp == expected


@pytest.mark.parametrize(
    "gps",
    [
        {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)},
        {1: "N", 2: (91.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)},
        {1: "N", 2: (1.0, 0.0, 0.0)},
        {6: 12.0},
    ],
)
def test_positions_that_are_none(gps: dict[int, Any]) -> None:
    assert read_exif(exif_bytes(gps=gps)).position is None


def test_position_without_altitude() -> None:
    facts = read_exif(exif_bytes(gps={1: "N", 2: (45.0, 30.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.0)}))
    assert facts.position.gps == (45.5, 9.0, None)


# --------------------------------------------------------------------------------------------------- focal length


@pytest.mark.parametrize(("width", "height"), [(6000, 4000), (4000, 6000), (4000, 3000), (3000, 4000)])
def test_35mm_equivalent_keeps_the_diagonal_field_of_view(width: int, height: int) -> None:
    prior = focal_prior(ExifFacts(focal_35mm=28.0), width, height)
    film = 2 * math.atan(math.hypot(36.0, 24.0) / 2 / 28.0)
    assert 2 * math.atan(math.hypot(width, height) / 2 / prior.focal_px) == pytest.approx(film, rel=1e-4)
    assert prior.source == "exif_35mm"
    assert 0.04 < prior.sigma_px / prior.focal_px < 0.06


def test_35mm_equivalent_of_cut_frames_lies_within_its_sigma() -> None:
    """A 4:3 sensor of 4000x3000 behind a lens of 28 mm equivalent: the focal length in pixels survives any crop."""
    ground_truth = focal_prior(ExifFacts(focal_35mm=28.0), 4000, 3000).focal_px
    for width, height in ((4000, 2250), (3000, 3000), (4000, 2000)):
        prior = focal_prior(ExifFacts(focal_35mm=28.0), width, height)
        assert abs(prior.focal_px - ground_truth) < prior.sigma_px
        assert prior.sigma_px > 0.08 * prior.focal_px


def test_focal_prior_has_no_jump_at_the_aspect_ratios_where_the_rule_changes() -> None:
    for width, height in ((4000, 3000), (3000, 2000)):
        around = [focal_prior(ExifFacts(focal_35mm=35.0), width, height + d).focal_px for d in (-1, 1)]
        assert around[0] == pytest.approx(around[1], rel=2e-3)


def test_real_cameras() -> None:
    """Bundler's model of Balbianello (EOS 500D, 18 mm, shrunk to 640 pixels) has a focal length of 518.7 pixels."""
    shrunk = ExifFacts(
        "Canon", "Canon EOS REBEL T1i", focal_mm=18.0, focal_plane_px_per_mm=209.3, camera_size=(640, 427)
    )
    prior = focal_prior(shrunk, 640, 427)
    assert prior.source == "exif_sensor"
    assert abs(prior.focal_px - 518.7) < prior.sigma_px < 30


@pytest.mark.parametrize(
    ("make", "model", "sensor_mm"),
    [
        ("Canon", "Canon EOS 5D Mark II", 36.0), ("Canon", "Canon EOS 5DS R", 36.0), ("Canon", "Canon EOS 60D", 22.3),
        ("Canon", "Canon EOS-1D X Mark II", 36.0), ("Canon", "Canon EOS-1D Mark IV", 28.1),
        ("Canon", "Canon EOS R6", 36.0), ("Canon", "Canon EOS R5m2", 36.0), ("Canon", "Canon EOS R7", 22.3),
        ("Canon", "Canon EOS R10", 22.3), ("Canon", "Canon EOS R", 36.0), ("Canon", "Canon EOS M50", 22.3),
        ("NIKON CORPORATION", "NIKON D60", 23.6), ("NIKON CORPORATION", "NIKON D600", 35.9),
        ("NIKON CORPORATION", "NIKON D500", 23.6), ("NIKON CORPORATION", "NIKON D850", 35.9),
        ("NIKON CORPORATION", "NIKON Z 6_2", 35.9), ("NIKON CORPORATION", "NIKON Z 50", 23.6),
        ("SONY", "ILCE-7M3", 35.8), ("SONY", "ILCE-6400", 23.5), ("SONY", "DSC-RX100M3", 13.2),
        ("SONY", "DSC-RX1RM2", 35.8), ("OLYMPUS IMAGING CORP.", "E-M5", 17.3), ("Panasonic", "DC-GH5", 17.3),
        ("FUJIFILM", "X-T3", 23.5), ("FUJIFILM", "X100F", 23.5), ("FUJIFILM", "X-S1", None), ("FUJIFILM", "X10", None),
        ("RICOH IMAGING COMPANY, LTD.", "PENTAX K-1", 35.9), ("PENTAX", "PENTAX K-5", 23.5),
        ("DJI", "FC6310", 13.2), ("Hasselblad", "L1D-20c", 13.2), ("DJI", "FC330", 6.2),
        ("NIKON", "COOLPIX P900", None), ("Canon", "Canon PowerShot G9", None), ("Apple", "iPhone 6", None),
        ("", "", None),
    ],
)  # fmt: skip
def test_sensors_that_are_known(make: str, model: str, sensor_mm: float | None) -> None:
    prior = focal_prior(ExifFacts(make, model, focal_mm=20.0), 3600, 2400)
    if sensor_mm is None:
        assert prior.source == "default"
    else:
        assert prior.focal_px == pytest.approx(20.0 / sensor_mm * 3600)


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0), (None, 25.4)])
def test_focal_plane_resolution_in_every_unit(unit: int | None, mm: float) -> None:
    photo = {37386: 8.0, 41486: 4000 / 7.2 * mm, 40962: 4000, 40963: 3000}
    prior = focal_prior(read_exif(exif_bytes(photo=photo if unit is None else photo | {41488: unit})), 2000, 1500)
    assert prior.source == "exif_sensor"
    assert prior.focal_px == pytest.approx(8.0 / 7.2 * 2000, rel=1e-4)


def test_order_of_the_sources() -> None:
    everything = ExifFacts("Canon", "Canon EOS 60D", focal_mm=20.0, focal_35mm=32.0, focal_plane_px_per_mm=233.0)
    assert focal_prior(everything, 5184, 3456).source == "exif_35mm"
    assert focal_prior(ExifFacts("Canon", "Canon EOS 60D", focal_mm=20.0), 5184, 3456).source == "exif_sensor"
    default = focal_prior(ExifFacts(), 5184, 3456)
    assert (default.source, default.focal_px, default.sigma_px) == ("default", 1.2 * 5184, 0.6 * 5184)


def test_shrunk_picture_with_its_old_resolution_is_not_believed() -> None:
    prior = focal_prior(
        ExifFacts("X", "Y", focal_mm=18.0, focal_plane_px_per_mm=209.0, camera_size=(640, 427)), 640, 427
    )
    assert prior.source == "default"
    assert "resized" in prior.problems[0]


def test_cropped_picture_widens_the_sigma() -> None:
    prior = focal_prior(ExifFacts(focal_35mm=28.0, camera_size=(4000, 3000)), 1500, 1500)
    assert prior.sigma_px == pytest.approx(0.2 * prior.focal_px)


@pytest.mark.parametrize("tag", [37386, 41989, 41486])
@pytest.mark.parametrize(
    ("kind", "raw"),
    [
        (5, struct.pack("<II", 0, 1)),
        (5, struct.pack("<II", 35, 0)),
        (5, struct.pack("<II", 0, 0)),
        (5, struct.pack("<II", 2**32 - 1, 1)),
        (10, struct.pack("<ii", -35, 1)),
        (10, struct.pack("<ii", -35, 0)),
        (9, struct.pack("<i", -1)),
        (12, struct.pack("<d", math.inf)),
        (12, struct.pack("<d", math.nan)),
        (12, struct.pack("<d", 5e-324)),
        (12, struct.pack("<d", 1.7e308)),
        (11, struct.pack("<f", -0.0)),
    ],
)
def test_absurd_values_are_left_out_and_named(tag: int, kind: int, raw: bytes) -> None:
    facts = read_exif(photo_bytes([(tag, kind, raw)]))
    assert len(facts.problems) == 1
    assert (facts.focal_mm, facts.focal_35mm, facts.focal_plane_px_per_mm) == (None, None, None)
    assert focal_prior(facts, 4000, 3000).source == "default"


@pytest.mark.parametrize("text", [b"35 mm\0\0\0", b"\xff\xfe\xfd\xfc\xfb"])
def test_text_where_a_number_should_be_counts_as_nothing(text: bytes) -> None:
    facts = read_exif(photo_bytes([(37386, 2, text), (41989, 7, text)]))
    assert (facts.focal_mm, facts.focal_35mm) == (None, None)


@pytest.mark.parametrize("value", [0, 9, 255, 65535])
def test_orientation_that_is_none(value: int) -> None:
    facts = read_exif(exif_bytes({274: value}))
    assert facts.orientation == 1
    assert "orientation" in facts.problems[0]


numbers = st.one_of(
    st.tuples(st.just(5), st.binary(min_size=8, max_size=24).map(lambda b: b[: len(b) // 8 * 8])),
    st.tuples(st.just(10), st.binary(min_size=8, max_size=8)),
    st.tuples(st.just(12), st.floats().map(lambda v: struct.pack("<d", v))),
    st.tuples(st.just(11), st.binary(min_size=4, max_size=4)),
    st.tuples(st.just(3), st.binary(min_size=2, max_size=2)),
    st.tuples(st.just(9), st.binary(min_size=4, max_size=4)),
    st.tuples(st.just(2), st.binary(min_size=1, max_size=30)),
)
tags = st.sampled_from([37386, 41989, 41486, 41488, 40962, 40963, 36867, 37521, 36881, 42036, 42033])


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(tags, numbers), max_size=8),
    st.integers(16, 60000),
    st.integers(16, 60000),
    st.sampled_from(["", "Canon EOS 60D"]),
)
def test_whatever_the_numbers_are_the_prior_is_believable(
    entries: list[tuple[int, tuple[int, bytes]]], width: int, height: int, model: str
) -> None:
    facts = read_exif(photo_bytes([(tag, kind, raw) for tag, (kind, raw) in entries]))
    facts = ExifFacts(**{**facts.__dict__, "model": model, "make": "Canon"})
    prior = focal_prior(facts, width, height)
    assert 0.18 <= prior.focal_px / max(width, height) <= 15.0
    assert 0.02 < prior.sigma_px / prior.focal_px < 4.0
    assert prior.source in ("exif_35mm", "exif_sensor", "default")
    for value in (facts.focal_mm, facts.focal_35mm, facts.focal_plane_px_per_mm):
        assert value is None or (math.isfinite(value) and value > 0)
    assert facts.timestamp is None or math.isfinite(facts.timestamp)


@settings(max_examples=300, deadline=None)
@given(st.integers(1, 2**32 - 1), st.integers(1, 2**32 - 1))
def test_rationals_are_read_exactly(top: int, bottom: int) -> None:
    directory = first_directory(b"II*\0" + struct.pack("<IHHHIIIII", 8, 1, 37386, 5, 1, 26, 0, top, bottom))
    assert directory.number(37386) == top / bottom


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_any_bytes_are_read_without_complaint(data: st.DataObject) -> None:
    block = bytearray(
        exif_bytes({271: "Make", 274: 6}, {37386: 24.5, 36867: "2010:05:29 10:30:22"}, {1: "S", 2: (33.0, 30.0, 36.0)})
    )
    for _ in range(data.draw(st.integers(0, 12))):
        block[data.draw(st.integers(0, len(block) - 1))] = data.draw(st.integers(0, 255))
    focal_prior(read_exif(bytes(block)), 4000, 3000)
    read_exif(bytes(block[: data.draw(st.integers(0, len(block)))]))
    read_exif(data.draw(st.sampled_from([b"", b"II*\0", b"MM\0*"])) + data.draw(st.binary(max_size=200)))


@pytest.mark.parametrize(
    ("tags", "height", "kind", "sigma", "is_stated"),
    [
        ({5: b"\x01", 6: 12.5, 31: 7.55}, -12.5, "unknown", 5.0, True),
        ({5: b"\x02", 6: 12.5}, 12.5, "orthometric", None, False),
        ({5: b"\x03", 6: 12.5, 11: 10.0}, -12.5, "orthometric", 10.0, False),
        ({11: 1.2}, None, "unknown", 3.0, False),
    ],
)
def test_errors_and_the_reference_of_heights(
    tags: dict, height: float | None, kind: str, sigma: float | None, is_stated: bool
) -> None:
    position = read_exif(exif_bytes(gps={1: "N", 2: (45.0, 30.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.0)} | tags)).position
    assert position is not None
    assert (position.height_m, position.heights, position.is_stated) == (height, kind, is_stated)
    assert position.sigma_m == (None if sigma is None else pytest.approx(sigma))
