"""Two groups of photographs that share nothing, from the command line on: two models in one frame of the world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from schemas import check_schema
from sfmapp.cli.main import main
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.world_frame import read_georeference

PLACE = LocalFrame(48.2, 16.4, 170.0)
SIGMA_M = 0.02
# of the second group from the first, in metres
APART = np.array([35.0, -20.0, 2.0])


def two_groups(sample: Path, photos: Path, folder: Path, num: int) -> dict[str, np.ndarray]:
    """Photographs of a courtyard, and of the negative of its mirror image, in which no keypoint looks the same; returns
    where each was taken, in metres east, north and up."""
    truth = read_ground_truth(sample / "cameras.json")
    centers = {Path(name).stem: rigid3.center(p) for name, p in zip(truth.names, truth.cam_from_world, strict=True)}
    places = {}
    folder.mkdir()
    for path in sorted(photos.iterdir())[:num]:
        with Image.open(path) as image:
            image.save(folder / path.name)
            ImageOps.invert(ImageOps.mirror(image.convert("RGB"))).save(folder / f"mirror-{path.name}")
        places[path.name] = centers[path.stem]
        places[f"mirror-{path.name}"] = centers[path.stem] * [-1.0, 1.0, 1.0] + APART
    return places


def test_two_models_lie_in_one_frame(
    sample: Path, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = two_groups(sample, photos, tmp_path / "photos", 5)
    rng, rows = np.random.default_rng(0), ["image,latitude,longitude,height,sigma,sigma_up"]
    for name, place in places.items():
        at = PLACE.geodetic_from_enu(place + SIGMA_M * rng.normal(size=3))
        rows.append(f"{name},{at[0]:.9f},{at[1]:.9f},{at[2]:.3f},{SIGMA_M},{SIGMA_M}")
    (tmp_path / "geo.csv").write_text("\n".join(rows) + "\n")
    out = tmp_path / "out"
    command = ["reconstruct", str(tmp_path / "photos"), "-o", str(out), "--gps", str(tmp_path / "geo.csv")]
    assert main([*command, "--no-recording"]) == 0
    shown = capsys.readouterr().out
    assert "model 0 is in metres, z up" in shown
    assert "model 1 is in metres, z up" in shown
    report = json.loads((out / "report.json").read_text())
    check_schema("reconstruct", report)
    assert [model["reason"] for model in report["stages"]["georeference"]["models"]] == ["", ""]
    where = read_georeference(out)
    assert where is not None
    check_schema("georeference", json.loads((out / "georeference.json").read_text()))
    assert [place.model for place in where.models] == [0, 1]
    groups = []
    for number in (0, 1):
        model = read_model(out / "sparse" / str(number))[0]
        groups.append({name.startswith("mirror-") for name in model.image_names})
        centers = PLACE.enu_from_geodetic(where.frame.geodetic_from_enu(model.centers[model.is_registered]))
        names = [name for name, known in zip(model.image_names, model.is_registered, strict=True) if known]
        off = centers - np.array([places[name] for name in names])
        sigma = np.linalg.norm(where.models[number].position_sigma_m)
        assert np.linalg.norm(off.mean(0)) < 3 * sigma
        assert np.linalg.norm(off, axis=1).max() < 4 * SIGMA_M
        # the ground of the courtyard is flat, and that of its mirror image as high
        turn = np.array(where.models[number].rotation_sigma_deg)
        assert turn.max() < 3.0
    assert groups in ([{False}, {True}], [{True}, {False}])
