"""Ellipsoid, geocentric coordinates, local frames and coordinate systems, against PROJ and closed forms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest

from schemas import check_schema
from sfmapp.errors import InputError
from sfmapp.geometry.geodesy import SEMI_MAJOR_M, SEMI_MINOR_M, LocalFrame, ecef_from_geodetic, geodetic_from_ecef
from sfmapp.georeference.coordinate_systems import coordinate_system
from sfmapp.georeference.world_frame import (
    GEOREFERENCE,
    Georeference,
    ModelPlace,
    read_georeference,
    write_georeference,
)

# one unit in the last place of a coordinate at the Earth's radius; a conversion rounds a few times
ULP_M = 9.4e-10


def places(num: int = 2000, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-90, 90, num), rng.uniform(-180, 180, num), rng.uniform(-5e3, 4e5, num)])


def test_geocentric_coordinates_are_those_of_proj() -> None:
    geodetic = places()
    transformer = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    wanted = np.column_stack(transformer.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]))
    np.testing.assert_allclose(ecef_from_geodetic(geodetic), wanted, rtol=0, atol=4 * ULP_M)
    found = geodetic_from_ecef(wanted)
    np.testing.assert_allclose(found[:, :2], geodetic[:, :2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found[:, 2], geodetic[:, 2], rtol=0, atol=4 * ULP_M)


def test_round_trips_cost_the_rounding_of_doubles() -> None:
    ecef = ecef_from_geodetic(places(seed=1))
    np.testing.assert_allclose(ecef_from_geodetic(geodetic_from_ecef(ecef)), ecef, rtol=0, atol=5 * ULP_M)
    enu = np.random.default_rng(2).uniform(-2e4, 2e4, (1000, 3))
    for frame in (LocalFrame(55.7, 13.2, 40.0), LocalFrame(-33.9, 151.2, 10.0), LocalFrame(90.0, 0.0, 0.0)):
        back = frame.enu_from_geodetic(frame.geodetic_from_enu(enu))
        np.testing.assert_allclose(back, enu, rtol=0, atol=8 * ULP_M)


def test_poles_and_the_equator() -> None:
    np.testing.assert_allclose(ecef_from_geodetic([0.0, 0.0, 0.0]), [SEMI_MAJOR_M, 0.0, 0.0], atol=ULP_M)
    np.testing.assert_allclose(ecef_from_geodetic([-90.0, 5.0, 7.0]), [0.0, 0.0, -SEMI_MINOR_M - 7.0], atol=ULP_M)
    np.testing.assert_allclose(geodetic_from_ecef([0.0, 0.0, SEMI_MINOR_M + 100.0]), [90.0, 0.0, 100.0], atol=ULP_M)


def test_a_frame_is_east_north_up() -> None:
    """Against PROJ's own, which is another program's reading of the same axes."""
    frame = LocalFrame(48.2, 16.4, 170.0)
    rng = np.random.default_rng(3)
    geodetic = np.array([48.2, 16.4, 170.0]) + rng.uniform(-1, 1, (500, 3)) * [0.05, 0.05, 300.0]
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=16.4 +lat_0=48.2 +h_0=170"
    )
    wanted = np.column_stack(pipeline.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]))
    np.testing.assert_allclose(frame.enu_from_geodetic(geodetic), wanted, rtol=0, atol=8 * ULP_M)
    assert np.linalg.det(frame.enu_from_ecef) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("text", ["EPSG:32633", "32633", "WGS84 UTM 33N", "+proj=utm +zone=33 +datum=WGS84 +units=m"])
def test_a_utm_zone_by_all_its_names(text: str) -> None:
    system = coordinate_system(text, "--crs")
    geodetic = np.array([[48.2, 16.4, 170.0], [48.3, 14.1, -3.0]])
    coordinates = system.coordinates(geodetic)
    # the scale on the central meridian, 15 degrees east, is 0.9996 and easting 500 km
    assert system.coordinates([[48.2, 15.0, 0.0]])[0, 0] == pytest.approx(500_000.0, abs=1e-6)
    np.testing.assert_allclose(system.geodetic(coordinates), geodetic, rtol=0, atol=1e-9)
    assert (system.heights, system.unit) == ("unknown", "metre")
    system.check_metres("--crs")


def test_heights_are_named_for_what_they_are() -> None:
    assert coordinate_system("EPSG:4979", "x").heights == "ellipsoidal"
    assert coordinate_system("EPSG:4326", "x").heights == "unknown"
    assert coordinate_system("EPSG:25833+7837", "x").heights == "orthometric"
    # without its geoid's grid an orthometric height is refused, not taken for an ellipsoidal one
    with pytest.raises(InputError, match="no transformation from"):
        coordinate_system("EPSG:25833+7837", "x").geodetic([[412000.0, 5658000.0, 120.0]])


@pytest.mark.parametrize(
    ("text", "unit"), [("EPSG:2263", "US survey feet"), ("EPSG:4326", "degree"), ("EPSG:4258", "degree")]
)
def test_feet_and_degrees_are_refused_where_metres_are_needed(text: str, unit: str) -> None:
    with pytest.raises(InputError, match=f"gcp.txt:1: expected a coordinate system in metres.*{unit}") as failure:
        coordinate_system(text, "gcp.txt:1").check_metres("gcp.txt:1")
    assert "UTM" in str(failure.value.advice)


@pytest.mark.parametrize("text", ["EPSG:999999", "nonsense", "", "WGS84 UTM 61N", "EPSG:4978", "EPSG:7837"])
def test_what_is_no_coordinate_system_is_named(text: str) -> None:
    with pytest.raises(InputError, match=r"geo\.txt:1: expected") as failure:
        coordinate_system(text, "geo.txt:1")
    assert "EPSG" in str(failure.value.advice)


def test_coordinates_off_the_earth_are_named() -> None:
    with pytest.raises(InputError, match=r"geo.txt, row 2: expected longitude, latitude in degrees"):
        coordinate_system("EPSG:4326", "x").geodetic([[13.0, 55.0, 0.0], [55.0, 113.0, 0.0]], "geo.txt")


def georeference() -> Georeference:
    place = ModelPlace(
        model=0, source="gps", scale=2.5, rotation=(0.0, 0.0, 0.6, 0.8), translation_m=(1.0, -2.0, 3.0),
        scale_sigma_share=0.01, rotation_sigma_deg=(1.0, 1.0, 0.5), position_sigma_m=(0.3, 0.3, 0.6),
        common_offset_sigma_m=(3.0, 3.0, 6.0),
    )  # fmt: skip
    return Georeference.about(LocalFrame(55.7, 13.2, 40.0), "orthometric", [place])


def test_a_georeference_is_read_back(tmp_path: Path) -> None:
    assert read_georeference(tmp_path) is None
    write_georeference(tmp_path, georeference())
    document = json.loads((tmp_path / GEOREFERENCE).read_text())
    check_schema("georeference", document)
    found = read_georeference(tmp_path)
    assert found == georeference()
    assert found is not None
    assert found.frame == LocalFrame(55.7, 13.2, 40.0)
    place = found.place_of(0)
    assert place is not None
    assert place.scale == 2.5
    assert found.place_of(1) is None


@pytest.mark.parametrize("name", ["scale_sigma_share", "rotation_sigma_deg", "position_sigma_m"])
def test_a_place_that_is_said_to_be_exact_is_refused(tmp_path: Path, name: str) -> None:
    write_georeference(tmp_path, georeference())
    path = tmp_path / GEOREFERENCE
    document = json.loads(path.read_text())
    value = document["models"][0][name]
    document["models"][0][name] = 0.0 if isinstance(value, float) else [0.0, *value[1:]]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"model 0: expected sigmas above zero, found 0"):
        read_georeference(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"latitude_deg": 91.0}, "origin on Earth"),
        ({"format": "sfmapp georeference 2"}, "expected format"),
        ({"axes": "east up north"}, "axes"),
        ({"models": [{"model": 0}]}, "missing"),
        ({"latitude_deg": "55"}, "latitude_deg"),
    ],
)
def test_a_damaged_georeference_is_named(tmp_path: Path, change: dict, message: str) -> None:
    write_georeference(tmp_path, georeference())
    path = tmp_path / GEOREFERENCE
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=f"{GEOREFERENCE}.*{message}"):
        read_georeference(tmp_path)


@pytest.mark.parametrize(("name", "value"), [("scale", -1.0), ("rotation", [0, 0, 0, 2.0]), ("scale_sigma_share", -1)])
def test_a_place_that_cannot_be_is_named(tmp_path: Path, name: str, value: object) -> None:
    write_georeference(tmp_path, georeference())
    path = tmp_path / GEOREFERENCE
    document = json.loads(path.read_text())
    document["models"][0][name] = value
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="model 0: expected"):
        read_georeference(tmp_path)
