"""Photographs of unknown cameras: projective models from tracks, third views, synthesised photographs, the commands."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfmapp
from schemas import check_schema
from sfmapp.cli.main import main
from sfmapp.errors import NoReconstructionError
from sfmapp.geometry.projective import dehomogenized, project
from sfmapp.geometry.projective_adjustment import sightings_of
from sfmapp.geometry.upgrade import find_space_homography, place_covariances
from sfmapp.uncalibrated.known_places import upgrade_by_known_points
from sfmapp.uncalibrated.new_view import correlation, synthesise
from sfmapp.uncalibrated.projective_model import reconstruct_projective
from sfmapp.uncalibrated.three_views import find_three_views, judge_transfer, transferred_pairs
from uncalibrated_scenes import scene


def _patchy(num_views: int, num_points: int, seed: int, *, noise: float, wrong: float) -> tuple[np.ndarray, np.ndarray]:
    """A turntable's points (N, 3) and pixels (N, V, 2): each seen in up to six neighbouring views, some wrongly."""
    one = scene(num_views, num_points, seed=seed, noise=noise, turntable=True)
    rng = np.random.default_rng(seed)
    xy = one.xy.copy()
    first = rng.integers(-3, num_views - 2, num_points)
    views = np.arange(num_views)
    xy[(views < first[:, None]) | (views >= first[:, None] + 6)] = np.nan
    bad = rng.random(xy.shape[:2]) < wrong
    xy[bad] += rng.uniform(-60.0, 60.0, (bad.sum(), 2))
    return one.xyz, xy


def test_a_model_grows_from_tracks_that_no_view_sees_all_of() -> None:
    xyz, xy = _patchy(12, 500, 0, noise=0.3, wrong=0.03)
    found = reconstruct_projective(sightings_of(xy), 12)
    assert len(found.view_idx) == 12
    assert len(found.point_idx) > 400
    assert 0.25 < found.info.sigma_px < 0.36
    assert 0.02 < found.share_dropped < 0.06
    # one map of space brings all of it to the truth; the noise of 0.3 px is 0.0017 at five units
    known = np.arange(0, len(found.point_idx), 40)
    points = found.model.points
    frame, _ = find_space_homography(points[known], xyz[found.point_idx[known]], is_robust=True)
    gap = np.linalg.norm(dehomogenized(points @ frame.T) - xyz[found.point_idx], axis=1)
    assert np.median(gap) < 0.01


def test_what_makes_no_projective_model_is_said() -> None:
    one = scene(3, 60, noise=0.2)
    with pytest.raises(NoReconstructionError, match="no two photographs"):
        reconstruct_projective(sightings_of(one.xy[:20]), 3)
    with pytest.raises(NoReconstructionError, match="copies of one picture"):
        reconstruct_projective(sightings_of(np.repeat(one.xy[:, :1], 3, axis=1)), 3)
    flat = one.points * [1, 1, 0, 1] + [0, 0, 0.2, 0]
    with pytest.raises(NoReconstructionError, match="one plane"):
        reconstruct_projective(sightings_of(project(one.cameras, flat)), 3)
    turned = np.array([p[:, :3] @ np.column_stack([np.eye(3), [0, 0, 5.0]]) for p in one.cameras])
    with pytest.raises(NoReconstructionError, match="turned without moving"):
        reconstruct_projective(sightings_of(project(turned, one.points)), 3)
    rng = np.random.default_rng(0)
    with pytest.raises(NoReconstructionError):
        reconstruct_projective(sightings_of(rng.uniform(0, 1000, (100, 3, 2))), 3)
    with pytest.raises(NoReconstructionError, match="40 points in common"):
        find_three_views(one.xy[:30])


def test_points_that_had_no_part_are_transferred_within_what_is_said() -> None:
    one = scene(3, 200, seed=1, noise=0.3)
    xy = one.xy.copy()
    xy[::17, 2] += 25.0
    lines, tensor = judge_transfer(xy)
    # noise of the keypoint itself (two coordinates) and of the transfer
    for way in (lines, tensor):
        assert 0.3 < way.median_px < 1.2
        assert way.num_points > 150
    assert tensor.num_refused == 0
    assert tensor.median_px <= lines.median_px
    assert abs(find_three_views(xy).noise_px / 0.3 - 1.0) < 0.2


def test_a_view_of_a_slanted_plane_and_what_stands_before_it_is_drawn_where_it_is() -> None:
    """A checked picture on a plane, seen by three cameras: the third is synthesised from matches alone."""
    from sfmapp.geometry import rigid3

    size = (320, 240)
    k = np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])
    cameras = np.array([
        k @ np.column_stack([rigid3.exp_so3([0, a, 0]), t])
        for a, t in ((0.1, [0.5, 0.1, 4]), (-0.1, [-0.5, -0.1, 4]), (0.0, [0.0, 0.2, 3.8]))
    ])  # fmt: skip
    rng = np.random.default_rng(0)
    texture = cv2.resize(rng.integers(0, 255, (40, 40, 3), np.uint8), (400, 400), interpolation=cv2.INTER_CUBIC)
    # plane z = 0.3 x, texture over [-2, 2]^2
    corner = np.array([[-2, -2, -0.6, 1], [2, -2, 0.6, 1], [2, 2, 0.6, 1], [-2, 2, -0.6, 1]])
    source = np.float32([[0, 0], [400, 0], [400, 400], [0, 400]])
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    pictures = []
    for p in cameras:
        to_view = cv2.getPerspectiveTransform(source, project(p[None], corner)[:, 0].astype(np.float32))
        pictures.append(cv2.warpPerspective(texture, half @ to_view @ np.linalg.inv(half), size))
    # matches: on the plane, and a few before it for the geometry
    xy_plane = rng.uniform(-1.9, 1.9, (600, 2))
    on_plane = np.c_[xy_plane, 0.3 * xy_plane[:, 0], np.ones(600)]
    pixels = project(cameras, on_plane)
    on_plane = on_plane[((pixels > 1) & (pixels < np.array(size) - 1)).all((1, 2))]
    before = np.c_[rng.uniform(-1, 1, (60, 2)), rng.uniform(-1.5, -0.6, 60), np.ones(60)]
    views = find_three_views(project(cameras, np.r_[on_plane, before]))
    matches, target, depth = transferred_pairs(views, project(cameras[:2], on_plane))
    assert np.abs(target - project(cameras, on_plane)[:, 2]).max() < 0.01
    # order: what stands before the plane is nearer
    nearer = transferred_pairs(views, project(cameras[:2], on_plane - [0, 0, 0.5, 0]))[2]
    assert np.isfinite(depth).all()
    assert np.isfinite(nearer).all()
    drawn = synthesise((pictures[0], pictures[1]), (matches[:, 0], matches[:, 1]), target, depth, size)
    assert 0.3 < drawn.is_filled.mean() < 1.0
    assert correlation(drawn.pixels, pictures[2], drawn.is_filled) > 0.97
    assert correlation(drawn.pixels, pictures[0], drawn.is_filled) < 0.5


def test_the_command_transfers_photographs(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [str(path) for path in sorted(photos.iterdir())[:3]]
    out = tmp_path / "out"
    assert main(["transfer", given[0], given[2], given[1], "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "by the trifocal tensor" in printed
    report = json.loads((out / "report.json").read_text())
    check_schema("transfer", report)
    told = report["transfer"]
    assert told["ways"][1]["median_px"] < 1.0
    assert told["new_view"]["correlation"] > 0.7
    assert (out / "synthesised.jpg").is_file()
    assert (out / "recording.rrd").is_file()
    page = (out / "report.html").read_text()
    assert len(page) < 5e6
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert not re.search(r"https?://", page)
    with pytest.raises(sfmapp.UsageError, match="three different photographs"):
        sfmapp.transfer_views([given[0], given[0], given[1]], tmp_path / "b")
    assert main(["transfer", given[0], str(tmp_path / "no.jpg"), given[1], "-o", str(tmp_path / "c")]) == 3
    assert "no such file" in capsys.readouterr().err


def test_the_command_reconstructs_without_a_calibration(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["uncalibrated", str(photos), "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "projective: 7 of 7 photographs" in printed
    report = json.loads((out / "report.json").read_text())
    check_schema("uncalibrated", report)
    told = report["projective"]
    assert told["rms_px"] < 1.0
    assert told["ambiguity_rms_px"] == pytest.approx(told["rms_px"], rel=1e-3)
    assert told["ambiguity_ratio"] > 1.05
    assert len(json.loads((out / "cameras_projective.json").read_text())["images"]) == 7
    camera = report["self_calibration"]
    if camera is None:
        assert report["refused"]
    else:
        assert (out / "sparse" / "0" / "cameras.bin").is_file()
        assert camera["focal_sigma_px"] < 0.1 * camera["focal_px"]
    page = (out / "report.html").read_text()
    assert len(page) < 5e6
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert not re.search(r"https?://", page)
    assert (out / "recording.rrd").is_file()
    points = tmp_path / "known.csv"
    points.write_text("# crs: local\nname,x,y,z,image,px,py\na,0,0,0,nobody.jpg,1,1\n")
    assert main(["uncalibrated", str(photos), "-o", str(tmp_path / "b"), "--points", str(points)]) == 3


def test_known_points_make_it_metric(reconstructed: Path, tmp_path: Path) -> None:
    straight = tmp_path / "straight"  # no projective camera has the distortion of these photographs
    sfmapp.undistort(reconstructed, straight)
    model = sfmapp.load(straight)
    many = np.flatnonzero(np.bincount(model.tracks.obs_track_idx[model.obs_is_inlier]) >= 5)
    choices = [many[first :: len(many) // 24][:24] for first in range(12)]
    points = tmp_path / "known.csv"
    points.write_text("\n".join(_rows_of(model, choices[0])) + "\n")
    found = sfmapp.reconstruct_uncalibrated(straight / "images", tmp_path / "out", points=points)
    assert found.known is not None
    assert found.metric is None
    projective, names = found.projective, sorted(model.image_names)
    true = np.array([model.image(name).cam_from_world.center for name in names])[projective.view_idx]
    centers = np.linalg.svd(projective.model.cameras)[2][:, 3]
    away, squared = [], []
    for chosen in choices:
        xy = np.full((24, len(names), 2), np.nan)
        for row, track in enumerate(chosen):
            seen = model.observations_of_track(int(track))
            xy[row, [names.index(name) for name in seen.image_names]] = seen.xy
        known = upgrade_by_known_points(projective, [str(track) for track in chosen], model.point_xyz[chosen], xy)
        if chosen is choices[0]:
            # the file has four digits of a pixel
            assert known.frame == pytest.approx(found.known.frame, abs=1e-4)
        left = dehomogenized(centers @ known.frame.T) - true
        distances = np.linalg.norm(true - np.median(model.point_xyz[chosen], axis=0), axis=1)
        away.append(np.linalg.norm(left, axis=1) / distances)
        assert known.covariance is not None
        of_frame = place_covariances(known.frame, known.covariance, centers)
        squared.append(np.einsum("ni,nij,nj->n", left, np.linalg.inv(of_frame), left).mean() / 3.0)
    assert np.median(away) < 0.0006
    # no choice is surely wrong; below one, because these places are of the very pixels that mark them
    assert max(squared) < 2.0
    assert 0.2 < np.mean(squared) < 1.0


def _rows_of(model: sfmapp.Reconstruction, chosen: np.ndarray) -> list[str]:
    """A file of known points that are tracks of a model."""
    rows = ["# crs: local", "name,x,y,z,image,px,py"]
    for track in chosen:
        seen = model.observations_of_track(int(track))
        place = ",".join(f"{value:.9f}" for value in model.point_xyz[track])
        rows += [
            f"p{track},{place},{name},{x:.4f},{y:.4f}" for name, (x, y) in zip(seen.image_names, seen.xy, strict=True)
        ]
    return rows
