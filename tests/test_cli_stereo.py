"""``sfmapp stereo`` from the command line, on small pairs whose disparities are known."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from schemas import check_schema
from sfmapp.camera_files.reading import read_calibration
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.formats.middlebury_calibration import MiddleburyCalibration, write_middlebury

Pixels = NDArray[np.uint8]
NEAR, FAR = 24, 12
CALIBRATION = MiddleburyCalibration(200.0, 119.5, 79.5, 0.0, 0.1, 240, 160)


def texture(rng: np.random.Generator, shape: tuple[int, int]) -> Pixels:
    noise = cv2.GaussianBlur(rng.normal(0.0, 1.0, shape), (0, 0), 1.2)
    return np.clip(128.0 + 200.0 * noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A square at a disparity of 24 px before a wall at 12 px."""
    folder, rng = tmp_path_factory.mktemp("pair"), np.random.default_rng(3)
    wall, square = texture(rng, (160, 300)), texture(rng, (70, 80))
    left, right = (wall[:, 30 - shift : 270 - shift].copy() for shift in (0, -FAR))
    left[45:115, 100:180] = square
    right[45:115, 100 - NEAR : 180 - NEAR] = square
    for name, picture in (("left.png", left), ("right.png", right)):
        cv2.imwrite(str(folder / name), picture)
    write_middlebury(folder / "calib.txt", CALIBRATION)
    return folder / "left.png", folder / "right.png"


def run(*args: object) -> int:
    return main(["stereo", *map(str, args), "-q"])


def test_a_calibrated_pair_becomes_depths(pair: tuple[Path, Path], tmp_path: Path) -> None:
    assert run(*pair, "--camera", pair[0].parent / "calib.txt", "-o", tmp_path / "out") == 0
    disparity, depth = (np.load(tmp_path / "out" / name) for name in ("disparity.npy", "depth.npy"))
    assert np.nanmedian(disparity[60:100, 120:160]) == pytest.approx(NEAR, abs=0.2)
    assert np.nanmedian(disparity[:30, 60:]) == pytest.approx(FAR, abs=0.2)
    assert np.nanmedian(depth[60:100, 120:160]) == pytest.approx(200.0 * 0.1 / NEAR, rel=0.01)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    check_schema("stereo", report)
    (told,) = report["pairs"]
    assert told["rectification"]["is_as_given"]
    assert told["rectification"]["rows"]["rms_px"] < 0.3
    assert told["disparity"]["density"] > 0.7
    assert told["disparity"]["searched"][0] <= FAR <= NEAR <= told["disparity"]["searched"][1]


def test_folders_of_pairs(pair: tuple[Path, Path], tmp_path: Path) -> None:
    for side, path in zip(("l", "r"), pair, strict=True):
        (tmp_path / side).mkdir()
        for name in ("a.png", "b.png"):
            (tmp_path / side / name).write_bytes(path.read_bytes())
    (tmp_path / "r" / "b.png").write_bytes((tmp_path / "l" / "b.png").read_bytes())  # one photograph twice
    assert run(tmp_path / "l", tmp_path / "r", "-o", tmp_path / "out") == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [told["name"] for told in report["pairs"]] == ["a"]
    assert report["failed"][0]["name"] == "b"
    assert "same picture" in report["failed"][0]["reason"]
    assert (tmp_path / "out" / "a" / "disparity.npy").is_file()
    assert not (tmp_path / "out" / "a" / "depth.npy").exists()  # no baseline


def test_bad_input_is_named(pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = pair
    blank, small = tmp_path / "blank.png", tmp_path / "small.png"
    cv2.imwrite(str(blank), np.full((160, 240), 90, np.uint8))
    cv2.imwrite(str(small), cv2.imread(str(right), 0)[:100])
    calibration = left.parent / "calib.txt"
    cases: list[tuple[list[object], int, str]] = [
        ([right, left], 3, "left and right are swapped"),
        ([right, left, "--camera", calibration], 3, "left and right are swapped"),
        ([left, left], 3, "same picture"),
        ([left, blank], 3, "one brightness"),
        ([left, small], 0, "have different sizes"),
        ([left, small, "--camera", calibration], 3, "240"),
        ([left], 2, "expected two photographs"),
        ([left, tmp_path], 2, "expected two photographs"),
        ([left, tmp_path / "gone.png"], 3, "found nothing there"),
        ([left, right, "--baseline", "0.1"], 2, "need the focal length"),
        ([left, right, "--focal", "-3"], 2, "expected more than 0"),
        ([left, right, "--camera", calibration, "--focal", "3"], 2, "both say"),
        ([left, right, "--window", "4"], 2, "odd"),
    ]
    for n, (args, code, message) in enumerate(cases):
        assert run(*args, "-o", tmp_path / f"out{n}") == code, args
        assert message in capsys.readouterr().err, args


def test_middlebury_calibration_comes_back(tmp_path: Path) -> None:
    write_middlebury(tmp_path / "calib.txt", MiddleburyCalibration(995.0, 311.2, 254.9, 31.1, 0.193, 741, 500, 70))
    rig = read_calibration(tmp_path / "calib.txt", [(741, 500)] * 2).rig
    assert rig.cameras[0].canonical[:4].tolist() == [995.0, 995.0, 311.7, 255.4]
    assert rig.cameras[1].canonical[2] == pytest.approx(342.8)
    assert rig.cam_from_rig[1, 4:].tolist() == [-0.193, 0.0, 0.0]
    text = (tmp_path / "calib.txt").read_text()
    for bad in (text.replace("baseline", "base"), text.replace("doffs=31.1", "doffs=5"), text.replace("0 0 1]", "1]")):
        (tmp_path / "bad.txt").write_text(bad)
        with pytest.raises(InputError, match=r"bad\.txt"):
            read_calibration(tmp_path / "bad.txt", [(741, 500)] * 2)
