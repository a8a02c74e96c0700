"""Positions from EXIF, from drones' XMP and from files beside photographs; and what of them is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from sfmapp.errors import InputError
from sfmapp.formats.safe_xml import read_xml
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.sources import read_positions, with_positions
from sfmapp.images.headers import read_header
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.position import Position
from sfmapp.images.xmp import with_xmp

EXIF = Position(47.0, 8.0, 400.0)
DJI = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>"""


def dji(**values: object) -> bytes:
    return DJI.format(attributes=" ".join(f'drone-dji:{name}="{value}"' for name, value in values.items())).encode()


def records(*names: str, time: float | None = None) -> ImageSet:
    images = [ImageRecord(n, Path(n), 9, 9, timestamp=None if time is None else time + k) for k, n in enumerate(names)]
    return ImageSet(tuple(images), ())


def test_a_drone_with_rtk() -> None:
    problems: list[str] = []
    packet = dji(
        GpsLatitude="+47.1234567", GpsLongitude="+8.7654321", AbsoluteAltitude="+512.34", RtkFlag=50, RtkStdLon=0.011,
        RtkStdLat=0.013, RtkStdHgt=0.027, GimbalYawDegree="-12.5", GimbalPitchDegree="-90.0", GimbalRollDegree="+0.0",
    )  # fmt: skip
    found = with_xmp(EXIF, packet, problems)
    assert found is not None
    assert found.gps == (47.1234567, 8.7654321, 512.34)
    assert found.sigma_m == pytest.approx(0.01204, abs=1e-5)
    assert (found.sigma_up_m, found.is_stated, found.source) == (0.027, True, "XMP")
    assert found.attitude_deg == (-12.5, -90.0, 0.0)
    assert not problems


def test_xmp_of_older_programs_and_without_rtk() -> None:
    found = with_xmp(EXIF, dji(GpsLatitude=47.1, GpsLongtitude=8.7, RtkFlag=0, RtkStdLat=0.0), [])
    assert found is not None
    assert found.gps == (47.1, 8.7, 400.0)
    assert found.sigma_m is None
    assert with_xmp(EXIF, dji(RelativeAltitude=30.0), []) == EXIF
    assert with_xmp(None, b"", []) is None


BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'
    b'<x xmlns:d="http://www.dji.com/drone-dji/1.0/" d:GpsLatitude="1" d:GpsLongitude="2">&b;</x>'
)


@pytest.mark.parametrize(
    "packet", [BOMB, b"<x>", b"no XML", b"\xff\xfe\x00", b"<a>" * 200 + b"</a>" * 200, b"x" * (1 << 21)]
)
def test_xmp_that_is_hostile_or_damaged_is_left_out_and_named(packet: bytes) -> None:
    problems: list[str] = []
    assert with_xmp(EXIF, packet, problems) == EXIF
    assert len(problems) == 1


def test_external_entities_are_not_fetched() -> None:
    with pytest.raises(InputError, match="document type"):
        read_xml('<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><x>&e;</x>', "a.gpx")


def test_xmp_is_found_in_a_jpeg() -> None:
    packet = dji(GpsLatitude=1.0)
    body = b"http://ns.adobe.com/xap/1.0/\0" + packet
    segment = b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body
    frame = b"\xff\xc0\x00\x0b\x08\x00\x10\x00\x10\x01\x01\x11\x00"
    assert read_header(b"\xff\xd8" + segment + frame + b"\xff\xda\x00\x02" + b"\xff\xd9").xmp == packet


def test_geo_txt_in_a_projection_and_in_degrees(tmp_path: Path) -> None:
    path = tmp_path / "geo.txt"
    path.write_text("EPSG:32632\na.jpg 500000 5205000 410.5 0 -90 0 0.02 0.03\nb.jpg 500010 5205000\n")
    found = with_positions(records("a.jpg", "sub/b.jpg"), GpsOptions(source=str(path)))
    a, b = (record.position for record in found.images)
    assert a is not None
    assert b is not None
    assert (a.longitude_deg, a.height_m) == pytest.approx((9.0, 410.5), abs=1e-9)
    assert (a.sigma_m, a.sigma_up_m, a.is_stated, a.attitude_deg) == (0.02, 0.03, True, (0.0, -90.0, 0.0))
    assert a.source == "geo.txt:2"
    assert (b.height_m, b.sigma_m) == (None, None)
    path.write_text("# ours\nEPSG:4326\na.jpg 9.0 47.0 410.5\n")
    assert read_positions(path).by_name["a.jpg"].gps == (47.0, 9.0, 410.5)


def test_a_table_and_none(tmp_path: Path) -> None:
    path = tmp_path / "gps.csv"
    path.write_text('file,lat,lon,alt,accuracy\n"a.jpg",47.0,8.0,400,4.5\nb.jpg,47.1,8.1,,\n')
    found = with_positions(records("a.jpg", "b.jpg", "c.jpg"), GpsOptions(source=str(path)))
    a, b, c = (record.position for record in found.images)
    assert a == Position(47.0, 8.0, 400.0, "unknown", 4.5, None, True, "gps.csv:2")
    assert b == Position(47.1, 8.1, None, "unknown", None, None, False, "gps.csv:3")
    assert c is None
    assert all(r.position is None for r in with_positions(found, GpsOptions(source="none")).images)
    assert with_positions(found, GpsOptions()) == found


GPX = (
    '<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    '<trkpt lat="47.0" lon="8.0"><ele>400</ele><time>2026-05-01T10:00:00Z</time></trkpt>'
    '<trkpt lat="47.001" lon="8.002"><ele>410</ele><time>2026-05-01T10:00:10Z</time></trkpt>'
    '<trkpt lat="47.1" lon="8.1"><time>2026-05-01T11:00:00Z</time></trkpt></trkseg></trk></gpx>'
)
AT_10 = 1777629600.0


@pytest.mark.parametrize("kind", ["gpx", "csv"])
def test_a_track_is_matched_by_time(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"track.{kind}"
    table = (
        "time,latitude,longitude,height\n2026-05-01T10:00:00Z,47,8,400\n"
        "1777629610,47.001,8.002,410\n1777633200,47.1,8.1,\n"
    )
    path.write_text(GPX if kind == "gpx" else table)
    # two hours of summer time and four seconds, between fixes and in a gap
    options = GpsOptions(source=str(path), time_offset_s=-7200.0)
    found = with_positions(records("a.jpg", time=AT_10 + 7204.0), options).images[0].position
    assert found is not None
    assert found.gps == pytest.approx((47.0004, 8.0008, 404.0))
    with pytest.raises(InputError, match=r"track is from 2026-05-01 10:00:00 to .*none falls into it"):
        with_positions(records("a.jpg", time=AT_10 + 7600.0), options)
    with pytest.raises(InputError, match="no photograph has a time"):
        with_positions(records("a.jpg"), options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:999999\na.jpg 1 2 3\n", "geo.txt:1: expected a coordinate system"),
        ("EPSG:4326\na.jpg 1\n", "geo.txt:2: expected image x y"),
        ("EPSG:4326\na.jpg 1 two 3\n", "geo.txt:2: expected numbers, found"),
        ("EPSG:4326\na.jpg 8 147 3\n", "geo.txt:2: expected longitude, latitude"),
        ("EPSG:4326\na.jpg 8 47 3\na.jpg 8 47 3\n", "geo.txt:3: expected every image once"),
        ("EPSG:4326\na.jpg 8 47 3 0 0 0 0.0 0.1\n", "geo.txt:2: expected a standard deviation above 0"),
        ("EPSG:4326\na.jpg 8 47 3 0 0 0 0.1 -2\n", "geo.txt:2: expected a standard deviation above 0"),
        ("EPSG:4326\n", "found no image"),
        ("EPSG:4326\nother.jpg 8 47 3\n", "expected positions of photographs such as a.jpg"),
        ("image,latitude,height\na.jpg,1,2\n", "geo.txt:1: expected titles"),
        ("image,latitude,longitude\na.jpg,47\n", "geo.txt:2: expected 3 fields"),
        ("image,latitude,longitude\na.jpg,500000,8\n", "geo.txt:2: expected latitude and longitude in degrees"),
        ("time,latitude,longitude\nyesterday,47,8\n", "geo.txt:2: expected a time"),
        ("<gpx><trkpt lat='1' lon='2'/></gpx>", "found no such point"),
        ("<gpx>", "expected XML"),
        ("image,latitude,longitude\na.jpg,nan,8\n", "geo.txt:2: expected numbers"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "geo.txt"
    path.write_text(text)
    with pytest.raises(InputError) as failure:
        with_positions(records("a.jpg", time=0.0), GpsOptions(source=str(path)))
    assert message in str(failure.value)
    assert str(path) in str(failure.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.csv: cannot be read"):
        with_positions(records("a.jpg"), GpsOptions(source=str(tmp_path / "nothing.csv")))
