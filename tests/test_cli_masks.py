"""``sfmapp masks`` from the command line: photographs before a background, with and without cameras."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfmapp
from carving_photographs import coverage_of, photograph
from carving_scenes import around, ball, both, box
from schemas import check_schema
from sfmapp.cli.main import main
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.load import load_images
from sfmapp.images.pixels import read_mask

SOLID = both(ball(0.5, (0.5, 0.2, 0.1)), box((0.3, 0.4, 0.6), (-0.4, 0.0, 0.0)))
VIEWS = around(6, width=96, height=72)
TRUE = [coverage_of(view, SOLID, 5) > 0.5 for view in VIEWS]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs with their projection matrices."""
    folder = tmp_path_factory.mktemp("turntable")
    (folder / "images").mkdir()
    matrices = []
    for seed, (view, mask) in enumerate(zip(VIEWS, TRUE, strict=True)):
        assert view.camera is not None
        cv2.imwrite(str(folder / "images" / view.name), photograph(mask.astype(np.float32), seed)[..., ::-1])
        # of pixels counted from the centre of the first
        matrices.append(view.camera.k_matrix @ view.outer - 0.5 * np.outer([1, 1, 0], view.outer[2]))
    np.save(folder / "cameras.npy", np.array(matrices))
    return folder


def agreement(path: Path, true: np.ndarray) -> float:
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0
    return float((mask & true).sum() / (mask | true).sum())


@pytest.mark.parametrize("with_cameras", [True, False])
def test_masks_are_written_that_others_take(folder: Path, tmp_path: Path, with_cameras: bool) -> None:
    source = folder if with_cameras else folder / "images"
    assert main(["masks", str(source), "-o", str(tmp_path / "out"), "-q"]) == 0
    paths = [tmp_path / "out" / "masks" / f"{view.name}.png" for view in VIEWS]
    assert min(agreement(path, true) for path, true in zip(paths, TRUE, strict=True)) > 0.97
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    check_schema("masks", report)
    assert report["masks"]["is_compared"] == with_cameras
    assert not report["warnings"]
    assert "Outlines over the photographs" in (tmp_path / "out" / "report.html").read_text()
    options = ImageOptions(mask_path=str(tmp_path / "out" / "masks"))
    images, _ = load_images(folder / "images", options, sfmapp.Events())
    read = read_mask(images.images[0])
    assert read is not None
    assert 0.5 < read.sum() / TRUE[0].sum() < 2.0


def test_a_wrong_mask_is_named_and_not_written(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rough").mkdir()
    for i, (view, mask) in enumerate(zip(VIEWS, TRUE, strict=True)):
        cv2.imwrite(str(tmp_path / "rough" / f"{view.name}.png"), 255 * (mask ^ (i == 2)).astype(np.uint8))
    out = tmp_path / "out"
    assert main(["masks", str(folder), "-o", str(out), "--mask-path", str(tmp_path / "rough"), "-q"]) == 0
    written = sorted(path.name for path in (out / "masks").iterdir())
    assert written == sorted(f"{view.name}.png" for i, view in enumerate(VIEWS) if i != 2)
    assert "inverted" in (out / "report.html").read_text()


def test_without_photographs_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["masks", str(tmp_path / "empty"), "-o", str(tmp_path / "out"), "-q"]) == 3
    assert "expected" in capsys.readouterr().err


def test_an_unknown_source_of_masks_is_refused(folder: Path, tmp_path: Path) -> None:
    assert main(["masks", str(folder), "-o", str(tmp_path / "out"), "--mask-source", "magic", "-q"]) == 2
