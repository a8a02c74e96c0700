"""Exports into the world: read by other programs, or from the bytes that the specifications describe."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pyproj
import pytest

from sfmapp.cli.main import main
from sfmapp.errors import UsageError
from sfmapp.formats.colmap import read_model, write_model
from sfmapp.formats.ply import write_ply
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry import rigid3
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.coordinate_systems import coordinate_system, utm_code
from sfmapp.georeference.world_frame import Georeference, ModelPlace, read_georeference, write_georeference
from sfmapp.pipelines.export import export_model
from test_formats_exchange import centered_camera, scene

FRAME = LocalFrame(48.2, 16.4, 170.0)
IN_ITS_PLACE = ModelPlace(
    model=0, source="gps", scale=1.0, rotation=(0.0, 0.0, 0.0, 1.0), translation_m=(0.0, 0.0, 0.0),
    scale_sigma_share=0.01, rotation_sigma_deg=(0.1, 0.1, 0.1), position_sigma_m=(1.0, 1.0, 2.0),
    common_offset_sigma_m=(0.0, 0.0, 0.0),
)  # fmt: skip


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run whose model lies in the frame, a few hundred metres across."""
    folder = tmp_path / "out"
    model = scene([centered_camera()])
    model.point_xyz *= 100.0
    model.cam_from_world[:, 4:] *= 100.0
    write_model(folder / "sparse" / "0", model)
    manifest = {"format": "sfmapp workspace 1", "source": str(tmp_path), "stages": {}, "inputs": {}}
    (folder / "run.json").write_text(json.dumps(manifest))
    write_georeference(folder, Georeference.about(FRAME, "ellipsoidal", [IN_ITS_PLACE]))
    return folder


def utm_by_proj(enu: np.ndarray) -> np.ndarray:
    """Easting, northing, height of zone 33 by PROJ alone, from the frame on."""
    by_proj = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0=16.4 +lat_0=48.2 +h_0=170 "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=33 +ellps=WGS84"
    )
    return np.column_stack(by_proj.transform(*enu.T))


def las_by_hand(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Points, colours and coordinate system from the bytes of a LAS 1.4 file, by the tables of its specification."""
    data = path.read_bytes()
    assert data[:4] == b"LASF"
    assert data[24:26] == bytes([1, 4])
    (encoding,) = struct.unpack_from("<H", data, 6)
    assert encoding & 16  # WKT
    header_size, at, num_vlrs, kind, size = struct.unpack_from("<HIIBH", data, 94)
    assert kind == 7
    scale, offset = np.array(struct.unpack_from("<6d", data, 131)).reshape(2, 3)
    (count,) = struct.unpack_from("<Q", data, 247)
    wkt, place = "", header_size
    for _ in range(num_vlrs):
        _, user, record, length = struct.unpack_from("<H16sHH", data, place)
        if user.rstrip(b"\0") == b"LASF_Projection" and record == 2112:
            wkt = data[place + 54 : place + 54 + length].rstrip(b"\0").decode()
        place += 54 + length
    rows = [struct.unpack_from("<3i", data, at + n * size) for n in range(count)]
    colors = [struct.unpack_from("<3H", data, at + n * size + 30) for n in range(count)]
    return np.array(rows) * scale + offset, np.array(colors) >> 8, wkt


def test_las_is_what_its_specification_says(run: Path, tmp_path: Path) -> None:
    model = read_model(run / "sparse" / "0")[0]
    report = export_model(run, "las", tmp_path / "a.las")
    xyz, rgb, wkt = las_by_hand(tmp_path / "a.las")
    wanted = utm_by_proj(model.point_xyz)
    step = 1e-5  # of some hundred metres
    np.testing.assert_allclose(xyz, wanted, rtol=0, atol=0.5 * step + 1e-8)
    np.testing.assert_array_equal(rgb, model.point_rgb)
    assert pyproj.CRS.from_wkt(wkt).to_epsg() == 32633
    assert report.max_coordinate < step
    assert "EPSG:32633" in report.notes[0]
    assert "above the ellipsoid" in report.notes[0]


def test_laz_holds_what_las_does(run: Path, tmp_path: Path) -> None:
    for target in ("las", "laz"):
        export_model(run, target, tmp_path / f"a.{target}", crs="EPSG:25833")
    packed, plain = (laspy.read(tmp_path / f"a.{target}") for target in ("laz", "las"))
    assert (tmp_path / "a.laz").stat().st_size < (tmp_path / "a.las").stat().st_size
    assert packed.header.are_points_compressed
    np.testing.assert_array_equal(packed.points.array, plain.points.array)
    assert packed.header.parse_crs().to_epsg() == 25833


def test_ply_far_from_its_origin_is_double(run: Path, tmp_path: Path) -> None:
    model = read_model(run / "sparse" / "0")[0]
    report = export_model(run, "ply", tmp_path / "frame.ply")
    assert Path(report.files[1]).name == "georeference.json"
    assert b"property float x" in (tmp_path / "frame.ply").read_bytes()[:200]
    report = export_model(run, "ply", tmp_path / "utm.ply", crs="EPSG:32633")
    found = read_ply_geometry(tmp_path / "utm.ply").xyz
    # rounded to single precision a northing of 5,300 km would be off by a quarter of a metre
    np.testing.assert_allclose(found, utm_by_proj(model.point_xyz), rtol=0, atol=1e-7)
    assert "double precision" in report.notes[0]


def test_dense_points_of_a_run(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no dense points"):
        export_model(run, "laz", tmp_path / "a.laz", is_dense=True)
    rng = np.random.default_rng(3)
    xyz, rgb = rng.uniform(-200, 200, (500, 3)), rng.integers(0, 256, (500, 3), np.uint8)
    write_ply(run / "dense" / "fused.ply", xyz, rgb)
    report = export_model(run, "laz", tmp_path / "a.laz", is_dense=True)
    assert report.num_points == 500
    found = laspy.read(tmp_path / "a.laz")
    np.testing.assert_allclose(found.xyz, utm_by_proj(xyz.astype(np.float32)), rtol=0, atol=1e-5)


def test_maps_of_the_photographs(run: Path, tmp_path: Path) -> None:
    model = read_model(run / "sparse" / "0")[0]
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    wanted = (FRAME.origin_ecef + model.centers @ FRAME.enu_from_ecef)[model.is_registered]
    export_model(run, "geojson", tmp_path / "map.geojson")
    features = json.loads((tmp_path / "map.geojson").read_text())["features"]
    places = np.array([feature["geometry"]["coordinates"] for feature in features])
    np.testing.assert_allclose(np.column_stack(to_ecef.transform(*places.T)), wanted, rtol=0, atol=2e-4)
    assert [feature["properties"]["name"] for feature in features] == model.image_names
    report = export_model(run, "kml", tmp_path / "map.kml")
    space = "{http://www.opengis.net/kml/2.2}"
    texts = [node.text for node in ElementTree.parse(tmp_path / "map.kml").iter(f"{space}coordinates")]
    np.testing.assert_array_equal(np.array([text.split(",") for text in texts], float), places)
    assert "too high" in report.notes[0]


def test_headings_turn_from_north_to_east(run: Path, tmp_path: Path) -> None:
    model = read_model(run / "sparse" / "0")[0]
    # looks east and level: right of it is south
    model.cam_from_world[0] = rigid3.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.0, 0.0, 0.0])
    write_model(run / "sparse" / "0", model)
    export_model(run, "geojson", tmp_path / "map.geojson")
    own = json.loads((tmp_path / "map.geojson").read_text())["features"][0]["properties"]
    assert (own["heading_deg"], own["pitch_deg"]) == (90.0, 0.0)


@pytest.mark.parametrize("target", ["colmap-bin", "nerfstudio"])
def test_the_frame_lies_beside_models(run: Path, tmp_path: Path, target: str) -> None:
    export_model(run, target, tmp_path / "copy")
    assert read_georeference(tmp_path / "copy") == read_georeference(run)


def test_what_cannot_be(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*arguments: str) -> str:
        assert main(["export", str(run), *arguments, "-o", str(tmp_path / "x")]) in (2, 3)
        return capsys.readouterr().err

    assert "US survey feet" in refused("--to", "laz", "--crs", "EPSG:2229")
    assert "degree" in refused("--to", "laz", "--crs", "EPSG:4326")
    assert "--crs" in refused("--to", "laz", "--crs", "EPSG:999999")
    assert "does not go with colmap-bin" in refused("--to", "colmap-bin", "--crs", "EPSG:32633")
    (run / "georeference.json").unlink()
    assert "in no frame of the world" in refused("--to", "kml")
    assert "in no frame of the world" in refused("--to", "ply", "--crs", "EPSG:32633")
    report = export_model(run, "las", tmp_path / "a.las")
    assert "in no frame of the world" in report.notes[0]
    assert laspy.read(tmp_path / "a.las").header.parse_crs() is None


@pytest.mark.parametrize(
    ("latitude", "longitude", "code"),
    [(48.2, 16.4, 32633), (-33.9, 151.2, 32756), (0.0, -180.0, 32601), (10.0, 180.0, 32601), (1.0, 179.9, 32660)],
)
def test_utm_zones(latitude: float, longitude: float, code: int) -> None:
    assert utm_code(latitude, longitude) == f"EPSG:{code}"
    middle = coordinate_system(f"EPSG:{code}", "test").coordinates([[latitude, longitude, 0.0]])[0, 0]
    assert abs(middle - 500_000.0) < 334_000.0  # three degrees of the equator
