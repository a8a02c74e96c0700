"""Ground control from the command line on: rendered photographs whose cameras are known, marks with known noise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from schemas import check_schema
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.cli.main import main
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ground_truth import GroundTruth, read_ground_truth
from sfmapp.geometry import rigid3
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.coordinate_systems import coordinate_system
from sfmapp.georeference.world_frame import read_georeference

# the courtyard's own axes, in metres, taken for east, north and up of this place
PLACE = LocalFrame(48.2, 16.4, 170.0)
MARK_PX, SURVEY_M = 0.5, 0.005


def half_size(truth: GroundTruth) -> tuple[list[Path], np.ndarray, list[Camera]]:
    """Names, poses and cameras of the photographs of the fixture."""
    cameras = []
    for camera in truth.cameras or ():
        is_length = np.array([kind_of(name) in ("focal", "center") for name in PARAM_NAMES[camera.model]])
        params = np.where(is_length, camera.params / 2, camera.params)
        cameras.append(Camera(camera.model, camera.width // 2, camera.height // 2, params))
    return [Path(name) for name in truth.names], truth.cam_from_world, cameras


def write_list(path: Path, sample: Path, photos: Path, seed: int = 0) -> np.ndarray:
    """A list of ODM's for seven places within the courtyard; returns these (7, 3) in its own axes."""
    rng = np.random.default_rng(seed)
    names, poses, cameras = half_size(read_ground_truth(sample / "cameras.json"))
    used = [n for n, name in enumerate(names) if (photos / f"{name.stem}.png").exists()]
    forward = rigid3.rotation_matrix(poses[used])[:, 2].mean(0)
    middle = rigid3.center(poses[used]).mean(0) + 6.0 * forward
    places = middle + rng.uniform(-1.5, 1.5, (7, 3))
    utm = coordinate_system("EPSG:32633", "test").coordinates(
        PLACE.geodetic_from_enu(places + rng.normal(0.0, SURVEY_M, places.shape))
    )
    lines = ["EPSG:32633"]
    for p, place in enumerate(utm):
        for n in used:
            local = rigid3.apply(poses[n], places[p])
            pixel = project(cameras[n], local[None])[0] + rng.normal(0.0, MARK_PX, 2)
            inside = (
                local[2] > 0.5 and (pixel > 2).all() and (pixel < [cameras[n].width - 2, cameras[n].height - 2]).all()
            )
            if inside:
                x, y = pixel - 0.5  # as OpenSfM counts
                lines.append(" ".join(map(repr, place.tolist())) + f" {x:.3f} {y:.3f} {names[n].stem}.png G{p}")
    path.write_text("\n".join(lines) + "\n")
    return places


def test_a_model_comes_to_its_control_points(
    sample: Path, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_list(tmp_path / "gcp_list.txt", sample, photos)
    out = tmp_path / "out"
    command = ["reconstruct", str(photos), "-o", str(out), "--gcp", str(tmp_path / "gcp_list.txt"), "--no-recording"]
    settings = [f"control.sigma_m={SURVEY_M}", f"control.sigma_up_m={SURVEY_M}", f"control.sigma_px={MARK_PX}"]
    command += [part for setting in settings for part in ("--set", setting)]
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert "left out in turn" in shown
    assert "G3" in shown
    report = json.loads((out / "report.json").read_text())
    check_schema("reconstruct", report)
    (model,) = report["stages"]["control"]["models"]
    assert [point["role"] for point in model["points"]] == ["control"] * 7
    assert model["findings"] == []
    assert model["summary"]["num_points"] == 7
    # centres against the truth, by way of the frame's place on Earth
    found = read_model(out / "sparse" / "0")[0]
    where = read_georeference(out)
    assert where is not None
    assert where.models[0].source == "control points"
    names, poses, _ = half_size(read_ground_truth(sample / "cameras.json"))
    truth = {name.stem: rigid3.center(pose) for name, pose in zip(names, poses, strict=True)}
    wanted = np.array([truth[Path(name).stem] for name in found.image_names])
    centers = PLACE.enu_from_geodetic(where.frame.geodetic_from_enu(found.centers))
    # cameras are farther from the middle of the points than these are apart: a few times what a point is known by
    assert np.linalg.norm(centers - wanted, axis=1).max() < 0.06
    page = (out / "report.html").read_text()
    assert "Ground control" in page
    assert "times as long as the ground" in page
    assert main(command) == 0
    assert "up to date" in capsys.readouterr().out
    # one point, beside positions of 2 cm whose base was put down a metre off
    kept = [
        line
        for line in (tmp_path / "gcp_list.txt").read_text().splitlines()
        if line.split()[-1] in ("EPSG:32633", "G0")
    ]
    (tmp_path / "gcp_list.txt").write_text("\n".join(kept) + "\n")
    rng, rows = np.random.default_rng(1), ["image,latitude,longitude,height,sigma,sigma_up"]
    for name in found.image_names:
        place = PLACE.geodetic_from_enu(truth[Path(name).stem] + [0.6, -0.8, 0.3] + 0.02 * rng.normal(size=3))
        rows.append(f"{name},{place[0]:.9f},{place[1]:.9f},{place[2]:.3f},0.02,0.02")
    (tmp_path / "geo.csv").write_text("\n".join(rows) + "\n")
    assert main([*command, "--gps", str(tmp_path / "geo.csv"), "-q"]) == 0
    report = json.loads((out / "report.json").read_text())
    check_schema("reconstruct", report)
    (model,) = report["stages"]["control"]["models"]
    assert [point["role"] for point in model["points"]] == ["control"]
    residual = np.array([image["residual_m"] for image in report["stages"]["georeference"]["images"]])
    # cameras a metre or two apart leave half a degree, on points six metres away
    np.testing.assert_allclose(residual.mean(0), [-0.6, 0.8, -0.3], atol=0.2)
    found, where = read_model(out / "sparse" / "0")[0], read_georeference(out)
    assert where is not None
    centers = PLACE.enu_from_geodetic(where.frame.geodetic_from_enu(found.centers))
    assert np.linalg.norm(centers - wanted, axis=1).max() < 0.25


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("EPSG:32633", "EPSG:99999"), "line 1: expected a coordinate system"),
        (("EPSG:32633", "EPSG:2229"), "in US survey feet"),
        ((" G0", " G0 \nnonsense"), "line 3: expected at least 6 words"),
    ],
)
def test_what_is_wrong_ends_the_run_before_it_begins(
    sample: Path,
    photos: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: tuple[str, str],
    expected: str,
) -> None:
    path = tmp_path / "gcp_list.txt"
    write_list(path, sample, photos)
    path.write_text(path.read_text().replace(*change, 1))
    assert main(["reconstruct", str(photos), "-o", str(tmp_path / "out"), "--gcp", str(path)]) == 3
    error = capsys.readouterr().err
    assert expected in error
    assert "gcp_list.txt" in error
    assert not (tmp_path / "out" / "sparse").exists()
