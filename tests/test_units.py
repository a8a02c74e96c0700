"""Known lengths and the vertical: on scenes whose metres and up are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from control_surveys import make_survey
from schemas import check_schema
from sfmapp.camera.camera import project
from sfmapp.cli.main import main
from sfmapp.errors import UsageError
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3, similarity
from sfmapp.georeference.control.scale_bars import ScaleBar, scale_by_bars
from sfmapp.georeference.leveling import level_rotation, up_of_ground, up_of_markers, up_of_photographs
from sfmapp.odometry.inertial.markers import MarkerSightings
from sfmapp.pipelines.sparse.known_lengths import parse_known_lengths
from sfmapp.pipelines.sparse.units import marker_corners


def bars(seed: int, num: int, scale: float = 7.0) -> list[ScaleBar]:
    """Bars of metres to ten, measured to 2 mm in a model that knows them to half a per cent."""
    rng = np.random.default_rng(seed)
    metres = rng.uniform(1.0, 10.0, num)
    length = metres / scale
    return [
        ScaleBar(f"bar{n}", m + rng.normal(0, 0.002), 0.002, one * (1 + rng.normal(0, 0.005)), 0.005 * one)
        for n, (m, one) in enumerate(zip(metres, length, strict=True))
    ]


def test_the_scale_is_as_sure_as_it_says() -> None:
    rows = [scale_by_bars(0, bars(seed, 4), []) for seed in range(400)]
    ratio = np.array([np.log(row.metres_per_unit / 7.0) / row.sigma_share for row in rows])
    # a sum of 400 squares of normal numbers, two-sided at one in a thousand: 400 +- 93
    assert 307 < (ratio**2).sum() < 493
    left_out = np.array([bar.left_out_m / bar.left_out_sigma_m for row in rows for bar in row.bars])
    assert 0.93 < (np.abs(left_out) < 1.96).mean() < 0.97
    assert sum(bool(row.findings) for row in rows) <= 4  # one in a thousand is asked for


def test_a_wrong_bar_is_named_and_bends_nothing() -> None:
    good = bars(1, 5)
    wrong = [*good[:2], replace(good[2], metres=good[2].metres * 1.1), *good[3:]]
    row = scale_by_bars(0, wrong, [])
    assert [bar.is_used for bar in row.bars] == [True, True, False, True, True]
    assert "bar2" in row.findings[0]
    assert abs(np.log(row.metres_per_unit / 7.0)) < 4 * row.sigma_share
    assert row.bars[2].left_out_m == pytest.approx(-0.1 / 1.1 * wrong[2].metres, rel=0.2)


def test_two_that_contradict_each_other_are_both_named_and_widen_the_sigma() -> None:
    good = bars(2, 2)
    row = scale_by_bars(0, [good[0], replace(good[1], metres=good[1].metres * 1.2)], [])
    assert all(bar.is_used for bar in row.bars)
    assert "bar0, bar1" in row.findings[0]
    assert row.sigma_share > 0.05
    assert scale_by_bars(0, [good[0]], []).bars[0].left_out_m is None
    assert scale_by_bars(0, [], ["no marker was seen"]).reason == "no marker was seen"


def test_known_lengths_as_they_are_written() -> None:
    names = ["a/x.jpg", "b/x.jpg", "c/y.jpg"]
    (one,) = parse_known_lengths("distance:a/x.jpg:y:2.50", names)
    assert one.images == (0, 2)
    assert (one.length.metres, one.length.sigma_m) == (2.5, pytest.approx(0.005 / np.sqrt(3)))
    two = parse_known_lengths("marker:DICT_4X4_50:0.16; pair:APRILTAG_36h11:3:17:4.000", names)
    assert (two[0].dictionary, two[0].ids) == ("4X4_50", None)
    assert (two[1].dictionary, two[1].ids) == ("APRILTAG_36H11", (3, 17))
    for text in (
        "distance:x.jpg:y:2",
        "distance:y:y:1",
        "distance:y:z:1",
        "marker:4X4_50:-1",
        "pair:4X4_50:1:1:2",
        "7",
    ):
        with pytest.raises(UsageError):
            parse_known_lengths(text, names)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))


def test_the_ground_is_level() -> None:
    """Of a tower that is walked round: to three of the standard deviations that are said. Not of a flight."""
    for layout in ("grid", "orbit"):
        for seed in range(2):
            survey = make_survey(seed, layout)
            model, away = survey.truth.copy(), rigid3.exp_so3(np.random.default_rng(seed).normal(size=3))
            moved = similarity.from_parts(away, np.array([1.0, 2.0, 3.0]), 0.1)
            model.cam_from_world[:] = similarity.transform_poses(moved, model.cam_from_world)
            model.point_xyz[:] = similarity.apply(moved, model.point_xyz)
            up = away @ [0.0, 0.0, 1.0]
            held = up_of_photographs(model, [1] * len(model.image_names))
            ground = up_of_ground(model, held)
            if layout == "grid":  # straight down, the tops of photographs say nothing of up
                assert "cannot be told" in held.problem
                assert "cannot be told" in ground.problem
            else:
                assert angle(held.direction, up) < 3 * held.sigma_rad
                assert ground.problem or angle(ground.direction, up) < 3 * ground.sigma_rad
            turned = level_rotation(held.direction)
            np.testing.assert_allclose(turned @ held.direction, [0, 0, 1], atol=1e-12)
            assert np.linalg.det(turned) == pytest.approx(1.0)


def squares(centers: np.ndarray, rotation: np.ndarray, side: float) -> np.ndarray:
    """Corners (M, 4, 3) of markers, clockwise from their own top left as who looks at them sees them."""
    flat = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]]) * side
    return centers[:, None] + flat @ rotation.T


def test_markers_that_lie_on_the_ground_tell_up_and_their_distance() -> None:
    survey = make_survey(2, "orbit")
    model = survey.truth
    rng = np.random.default_rng(0)
    placed = squares(
        np.array([[14.0, 0.0, 0.0], [0.0, 15.0, 0.0], [-13.0, 2.0, 0.0]]), rigid3.exp_so3([0, 0, 0.4]), 2.0
    )
    rows = []
    for i, pose in enumerate(model.cam_from_world):
        for m, corners in enumerate(placed):
            pixels = project(model.cameras[0], rigid3.apply(pose, corners))
            if ((pixels > 0) & (pixels < [1200, 900])).all():
                rows.append((i, m, pixels + rng.normal(0, 0.3, (4, 2))))
    sightings = MarkerSightings(*(np.array([row[k] for row in rows]) for k in range(3)))
    places, variances = marker_corners(model, sightings)
    assert sorted(places) == [0, 1, 2]
    for m, found in places.items():
        sigma = np.sqrt(np.diagonal(variances[m], axis1=1, axis2=2))
        assert (np.abs(found - placed[m]) < 5 * sigma).all()
    up = up_of_markers(np.array([places[m] for m in (0, 1, 2)]))
    assert not up.problem
    assert np.arccos(up.direction[2]) < 3 * up.sigma_rad
    standing = squares(np.zeros((1, 3)), rigid3.exp_so3([np.pi / 2, 0, 0]), 1.0)
    assert "some stand" in up_of_markers(np.concatenate([placed[:1], standing])).problem


def test_metres_and_up_from_the_command_line(
    sample: Path, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = read_ground_truth(sample / "cameras.json")
    centers = {Path(n).stem: rigid3.center(p) for n, p in zip(truth.names, truth.cam_from_world, strict=True)}
    names = sorted(path.name for path in photos.iterdir())
    pairs = [(names[0], names[6]), (names[1], names[4])]
    lengths = [np.linalg.norm(centers[Path(a).stem] - centers[Path(b).stem]) for a, b in pairs]
    out = tmp_path / "out"
    command = ["reconstruct", str(photos), "-o", str(out), "--no-recording", "--up", "exif"]
    for (a, b), length in zip(pairs, lengths, strict=True):
        command += ["--scale", f"distance:{a}:{b}:{length:.3f}"]
    assert main(command) == 0
    assert "in metres" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    check_schema("reconstruct", report)
    (scale,) = report["stages"]["units"]["scales"]
    (level,) = report["stages"]["units"]["levels"]
    assert scale["findings"] == []
    assert "Metres and up" in (out / "report.html").read_text()
    model = read_model(out / "sparse" / "0")[0]
    wanted = np.array([centers[Path(name).stem] for name in model.image_names])
    found = similarity.umeyama(model.centers, wanted)
    assert abs(np.log(found[7])) < 4 * scale["sigma_share"]
    tilt = np.degrees(np.arccos(rigid3.rotation_matrix(found)[2, 2]))
    assert tilt < 3 * level["sigma_deg"]
    assert main([*command[:-1], "distance:nobody.jpg:there.jpg:2"]) == 2
    assert "no photograph 'nobody.jpg'" in capsys.readouterr().err


SIDE_M = 0.8


def put_up_markers(sample: Path, photos: Path, folder: Path) -> dict[str, np.ndarray]:
    """Photographs of the courtyard with four markers on a plane before the cameras, drawn by their known cameras at
    sixteen samples a pixel; returns the centres of the cameras in metres."""
    truth = read_ground_truth(sample / "cameras.json")
    assert truth.cameras is not None
    pose_of = {Path(name).stem: (pose, camera) for name, pose, camera in zip(
        truth.names, truth.cam_from_world, truth.cameras, strict=True)}  # fmt: skip
    shown = [pose_of[path.stem][0] for path in sorted(photos.iterdir())]
    forward = rigid3.rotation_matrix(np.array(shown))[:, 2].mean(0)
    middle = rigid3.center(np.array(shown)).mean(0) + 4.0 * forward
    aside, up = np.cross(forward, [0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    board = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    folder.mkdir()
    for path in sorted(photos.iterdir()):
        pose, camera = pose_of[path.stem]
        large = cv2.resize(cv2.imread(str(path)), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
        for marker in range(4):
            corner = middle + (1.4 * (marker % 2) - 1.1) * aside + (1.2 * (marker // 2) - 1.0) * up
            places = np.array([corner, corner + SIDE_M * aside, corner + SIDE_M * (aside - up), corner - SIDE_M * up])
            # at half size, and at four times that; OpenCV's first pixel has its centre at 0
            pixels = 4 * project(camera, rigid3.apply(pose, places)) / 2 - 0.5
            # a white rim of one of the six modules all round; corners go where the lens puts them
            drawn = np.pad(cv2.aruco.generateImageMarker(board, marker, 240), 40, constant_values=255)
            low, high = 39.5, 279.5
            from_corners = np.array([(low, low), (high, low), (high, high), (low, high)], np.float32)
            onto = cv2.getPerspectiveTransform(from_corners, pixels.astype(np.float32))
            size = (large.shape[1], large.shape[0])
            mask = cv2.warpPerspective(np.full_like(drawn, 255), onto, size)
            large[mask > 127] = cv2.warpPerspective(drawn, onto, size)[mask > 127, None]
        small = cv2.resize(large, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / path.name), small)
    return {name: rigid3.center(pose) for name, (pose, _) in pose_of.items()}


def test_metres_by_markers_in_pictures(sample: Path, photos: Path, tmp_path: Path) -> None:
    centers = put_up_markers(sample, photos, tmp_path / "photos")
    out = tmp_path / "out"
    command = ["reconstruct", str(tmp_path / "photos"), "-o", str(out), "--no-recording", "-q"]
    known = [f"marker:DICT_4X4_50:{SIDE_M:.3f}", "pair:DICT_4X4_50:0:1:1.400"]
    assert main([*command, *(part for one in known for part in ("--scale", one))]) == 0
    (scale,) = json.loads((out / "report.json").read_text())["stages"]["units"]["scales"]
    assert scale["findings"] == []
    assert [bar["is_used"] for bar in scale["bars"]] == [True, True]
    model = read_model(out / "sparse" / "0")[0]
    wanted = np.array([centers[Path(name).stem] for name in model.image_names])
    found = similarity.umeyama(model.centers, wanted)
    assert abs(np.log(found[7])) < 3 * scale["sigma_share"] < 0.015
