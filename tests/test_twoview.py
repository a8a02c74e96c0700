"""The story of two photographs: every kind of pair, whose truth is known, and the command."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfmapp
from schemas import check_schema
from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.mapping.options import MappingOptions
from sfmapp.matching.descriptors import match_sift, neighbor_steps
from sfmapp.matching.options import MatchingOptions
from sfmapp.report.pair_words import step_lines
from sfmapp.scene.features import Features
from sfmapp.twoview.drawing import clip_lines, spread_points
from sfmapp.twoview.story import Story, tell_story
from sfmapp.twoview.view import View

Array = np.ndarray
CAMERA = simple_camera(CameraModel.PINHOLE, 1000, 750, 900.0, 9.0, "user")
TURN = rigid3.exp_so3([0.02, -0.15, 0.03])


def random_descriptors(num: int, rng: np.random.Generator) -> Array:
    """(N, 128) uint8 of norm 512, no two alike."""
    raw = rng.exponential(size=(num, 128))
    return np.rint(512 * np.sqrt(raw / raw.sum(1, keepdims=True))).astype(np.uint8)


def story(xyz: Array, rotation: Array, t: Array, num_wrong: int = 60, camera: Camera = CAMERA) -> Story:
    """Of points (N, 3) in the frame of camera 1, with half a pixel of noise, and keypoints that match wrongly."""
    rng = np.random.default_rng(0)
    first, second = pixels(xyz), pixels(xyz @ rotation.T + t)
    return told(first + rng.normal(0, 0.5, first.shape), second + rng.normal(0, 0.5, first.shape), num_wrong, camera)


def told(first: Array, second: Array, num_wrong: int, camera: Camera = CAMERA) -> Story:
    rng = np.random.default_rng(1)
    wrong = rng.uniform([0, 0], [1000, 750], (2, num_wrong, 2))
    descriptors = random_descriptors(len(first) + num_wrong, rng)
    rgb = np.zeros((len(descriptors), 3), np.uint8)
    views = []
    for xy, other in ((first, wrong[0]), (second, wrong[1])):
        keypoints = np.zeros((len(descriptors), 4), np.float32)
        keypoints[:, :2], keypoints[:, 2] = np.concatenate([xy, other]), 2.0
        views.append(View(f"{len(views)}.jpg", camera, Features(keypoints, descriptors, rgb)))
    return tell_story((views[0], views[1]), MatchingOptions(), MappingOptions(), seed=0, events=Events())


def pixels(xyz: Array) -> Array:
    return 900.0 * xyz[:, :2] / xyz[:, 2:] + [500.0, 375.0]


def cloud(num: int, depth: tuple[float, float] = (4.0, 9.0)) -> Array:
    rng = np.random.default_rng(2)
    z = rng.uniform(*depth, num)
    return np.column_stack([rng.uniform(-0.4, 0.4, num) * z, rng.uniform(-0.3, 0.3, num) * z, z])


def test_a_scene_with_depth_is_told_to_its_end() -> None:
    t = np.array([-1.5, 0.1, 0.2])
    found = story(cloud(400), TURN, t)
    said = found.report
    assert (said.kind, said.ended) == ("general", "")
    assert said.start is not None
    assert said.start.would_begin
    near = story(cloud(400), TURN, 0.4 * t).report.start
    assert near is not None
    assert not near.would_begin
    assert "too nearly from one place" in near.reason
    assert "then it would begin with it" in near.fallback
    assert said.ransac is not None
    assert said.choice is not None
    assert said.eight_point is not None
    assert said.homography is not None
    assert 380 <= said.ransac.num_inliers <= 415
    assert said.ransac.num_common > 380
    assert said.eight_point.num_free == 1
    assert said.eight_point.condition_raw > 1e3 * said.eight_point.condition
    assert said.eight_point.rms_refined_px <= said.eight_point.rms_px <= said.eight_point.rms_raw_px
    assert 0.4 < said.eight_point.sigma_px < 0.6
    assert not said.choice.reason
    best = said.choice.poses[said.choice.best]
    assert best.num_in_front > 0.98 * said.choice.num_points
    assert rigid3.rotation_angle_deg(np.array(best.rotation) @ TURN.T) < 0.5
    assert np.array(best.translation) @ t / np.linalg.norm(t) > 0.999
    assert said.choice.rotation_sigma_deg is not None
    assert 0.0 < said.choice.rotation_sigma_deg < 0.3
    assert said.homography.gric_f < said.homography.gric_h
    assert [one.method for one in said.triangulation] == [
        "homogeneous",
        "inhomogeneous",
        "midpoint",
        "optimal",
        "nonlinear",
    ]
    lines = list(step_lines(said))
    assert sum(line[0].isdigit() for line in lines) == 10
    assert any("chosen: pose" in line for line in lines)


def test_every_kind_of_pair_has_its_name() -> None:
    still = np.zeros(3)
    turned = story(cloud(400), TURN, still).report
    assert turned.kind == "rotation"
    assert turned.choice is not None
    assert turned.choice.reason
    assert turned.eight_point is not None
    assert turned.eight_point.num_free == 3
    assert turned.start is not None
    assert "shows no depth" in turned.start.reason
    wall = cloud(400)
    wall *= (6.0 / (wall @ [0.3, 0.1, 0.95]))[:, None]
    plane = story(wall, TURN, np.array([-0.9, 0.1, 0.2])).report
    assert plane.kind == "plane"
    assert plane.homography is not None
    assert plane.homography.gric_h < plane.homography.gric_f
    assert sum(one.is_possible for one in plane.homography.motions) == 2
    forward = story(cloud(400), np.eye(3), np.array([0.02, 0.0, -1.0])).report
    assert forward.kind == "forward"
    assert forward.epipoles is not None
    assert forward.epipoles.is_inside == [True, True]
    rng = np.random.default_rng(3)
    first = rng.uniform([0, 0], [1000, 750], (300, 2))
    assert told(first, first, 0).report.kind == "identical"
    stamp = rng.uniform([700, 700], [990, 745], (200, 2))
    assert told(stamp, stamp - [3.0, 5.0], 20).report.kind == "watermark"
    nothing = told(rng.uniform(0, 700, (80, 2)), rng.uniform(0, 700, (80, 2)), 0).report
    assert nothing.kind == "unknown"
    assert "do not overlap" in nothing.ended
    assert nothing.start is not None
    assert not nothing.start.would_begin
    few = told(first[:4], first[:4], 0).report
    assert "0.jpg has 4 keypoints" in few.ended


def test_a_lens_without_a_fundamental_matrix_is_refused() -> None:
    wide = simple_camera(CameraModel.OPENCV_FISHEYE, 1000, 750, 250.0)
    with pytest.raises(InputError, match="no fundamental matrix"):
        story(cloud(20), TURN, np.zeros(3), camera=wide)


def test_the_steps_of_matching_end_where_matching_does() -> None:
    rng = np.random.default_rng(4)
    first = random_descriptors(200, rng)
    second = np.concatenate([first[:120], random_descriptors(90, rng)])
    steps = neighbor_steps(first, second, 0.8, 0.7)
    np.testing.assert_array_equal(steps.mutual, match_sift(first, second, 0.8, 0.7))
    assert len(steps.nearest) == 200
    assert {tuple(m) for m in steps.mutual.tolist()} <= {tuple(m) for m in steps.ratio.tolist()}
    np.testing.assert_array_equal(steps.mutual, np.column_stack([np.arange(120)] * 2))


def test_lines_are_cut_where_the_picture_ends() -> None:
    lines = np.array([[0.0, 1, -50], [1, -1, 0], [0, 1, 200], [1, 0, 0]])
    ends = clip_lines(lines, (100, 80))
    assert {tuple(p) for p in ends[0]} == {(0.0, 50.0), (100.0, 50.0)}
    assert {tuple(p) for p in ends[1]} == {(0.0, 0.0), (80.0, 80.0)}
    assert np.isnan(ends[2]).all()
    assert {tuple(p) for p in ends[3]} == {(0.0, 0.0), (0.0, 80.0)}
    assert len(spread_points(np.zeros((0, 2)), 5)) == 0
    assert len(set(spread_points(np.random.default_rng(5).normal(size=(50, 2)), 8).tolist())) == 8


def test_the_command_writes_a_page_that_needs_nothing_else(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = []
    for path in sorted(photos.iterdir())[:2]:
        small.append(str(tmp_path / path.name))
        cv2.imwrite(small[-1], cv2.resize(cv2.imread(str(path)), (640, 480), interpolation=cv2.INTER_AREA))
    out = tmp_path / "out"
    assert main(["pair", *small, "-o", str(out), "--steps"]) == 0
    printed = capsys.readouterr().out
    assert "7. Four poses" in printed
    assert "general: a scene with depth" in printed
    report = json.loads((out / "report.json").read_text())
    check_schema("pair", report)
    page = (out / "report.html").read_text()
    assert len(page) < 5e6
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert not re.search(r"https?://", page)
    data = json.loads(re.search(r'id="pair-data">(.*?)</script>', page)[1])  # type: ignore[index]
    assert len(data["poses"]) == 4
    assert len(data["lines"]) == 14
    assert (out / "recording.rrd").is_file()
    assert main(["pair", small[0], "-o", str(out)]) == 2
    assert main(["pair", *small]) == 2
    assert main(["pair", small[0], str(tmp_path / "no.jpg"), "-o", str(tmp_path / "no")]) == 3
    assert "expected a photograph, found no such file" in capsys.readouterr().err


def test_a_workspace_lends_its_matches(reconstructed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = sorted(image["name"] for image in json.loads((reconstructed / "report.json").read_text())["images"])
    assert (
        main(["pair", str(reconstructed), names[1], names[0], "-o", str(reconstructed / "pairs" / "one"), "--json"])
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    told = report["story"]
    assert [one["name"] for one in told["keypoints"]] == names[:2]
    assert told["essential"]["focal_sources"] == ["file", "file"]
    pairs = json.loads((reconstructed / "report.json").read_text())["stages"]["matching"]["pairs"]
    stored = next(pair for pair in pairs if pair["image_idx"] == [0, 1])
    assert told["num_verified"] == stored["num_verified"]
    assert main(["pair", str(reconstructed), names[0], "nobody.jpg"]) == 3
    assert "expected the name of one image" in capsys.readouterr().err
    with pytest.raises(sfmapp.InputError, match="are one image"):
        sfmapp.explain_pair([reconstructed, names[0], names[0]])


def test_a_missing_kind_of_descriptor_leaves_the_neighbours_out() -> None:
    found = story(cloud(60), TURN, np.array([-0.9, 0.1, 0.2]), 0)
    views = [
        replace(view, features=Features.from_arrays(view.xy, view.features.descriptors.astype(np.float32)))
        for view in found.views
    ]
    said = tell_story((views[0], views[1]), MatchingOptions(), MappingOptions(), seed=0, events=Events()).report
    assert said.neighbors is None
    assert said.num_verified > 50
    assert said.kind == "general"
