"""What is made of few patches: chance or surface, and whose fault it is; and photographs that are there twice."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.dense.outcome import check, confirmed_share
from sfmapp.dense.photographs import find_photographs
from sfmapp.dense.prepare import DensePlan
from sfmapp.dense.report import SharesReport
from sfmapp.dense.scene import Patches, Region
from sfmapp.dense.undistort import make_canvas
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.images.image_set import ImageOptions, ImageRecord
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

CAMERA = Camera(CameraModel.PINHOLE, 200, 100, np.array([100.0, 100.0, 100.0, 50.0]))
NUM_VIEWS = 5


def row_of_cameras(step: float) -> np.ndarray:
    """(V, 7) cam_from_world of cameras side by side that look along z."""
    poses = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (NUM_VIEWS, 1))
    poses[:, 4] = -step * np.arange(NUM_VIEWS)
    return poses


def plan_of(step: float = 0.05, region: Region | None = None) -> DensePlan:
    records = tuple(ImageRecord(f"{m}.png", Path(f"{m}.png"), 200, 100) for m in range(NUM_VIEWS))
    others = np.array([[s for s in range(NUM_VIEWS) if s != m] for m in range(NUM_VIEWS)], np.int32)
    canvases = tuple(make_canvas(CAMERA, 1.0) for _ in range(NUM_VIEWS))
    nothing = np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32)
    return DensePlan(records, canvases, row_of_cameras(step), others, *nothing, region)


def patches_of(num_views: list[int], depth: float = 1.0) -> Patches:
    """Patches before the first view, trusted by so many views each."""
    count = len(num_views)
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), np.full(count, depth)])
    ones = np.ones(count, np.float32)
    ptr = np.concatenate([[0], np.cumsum(num_views)]).astype(np.int64)
    idx = np.concatenate([np.arange(n) for n in num_views]).astype(np.int32) if count else np.zeros(0, np.int32)
    normal = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (count, 1))
    wave = np.zeros(count, np.int32)
    return Patches(xyz, normal, np.zeros((count, 3), np.uint8), ones, ones, ones, wave, ptr, idx)


def test_patches_are_confirmed_by_views_that_they_do_not_need() -> None:
    assert confirmed_share(patches_of([3] * 600 + [4] * 200), plan_of(), 3) == pytest.approx(0.25)


def test_where_no_other_view_has_them_in_its_picture_nothing_is_said() -> None:
    # two steps away everything is out of the picture
    assert confirmed_share(patches_of([3] * 800), plan_of(step=0.9), 3) is None
    assert confirmed_share(patches_of([3] * 20), plan_of(), 3) is None
    assert confirmed_share(patches_of([]), plan_of(), 3) is None


def test_patches_of_chance_are_refused_and_few_good_ones_are_not() -> None:
    shares = SharesReport(textured=0.8, covered=0.12, points=None)
    with pytest.raises(NoReconstructionError, match="10 % of them agree with more than 3 views: the poses contradict"):
        check(patches_of([3] * 900 + [4] * 100), shares, plan_of(), 3)
    assert check(patches_of([5] * 800), shares, plan_of(), 3) is None
    warning = check(patches_of([5] * 800), dataclasses.replace(shares, covered=0.05), plan_of(), 3)
    assert warning is not None
    assert "are the poses exact" in warning


def test_next_to_nothing_is_refused_with_the_reason() -> None:
    with pytest.raises(NoReconstructionError, match="no texture"):
        check(patches_of([]), SharesReport(textured=0.001, covered=0.0, points=None), plan_of(), 3)
    with pytest.raises(NoReconstructionError, match="poses contradict"):
        check(patches_of([]), SharesReport(textured=0.8, covered=0.0, points=None), plan_of(), 3)


def test_of_a_region_no_more_is_asked_than_that_it_holds_something() -> None:
    plan = plan_of(region=Region(np.zeros(3), np.array([1.0, 2.0, 3.5])))
    shares = SharesReport(textured=0.8, covered=0.0001, points=None)
    assert check(patches_of([3] * 10), shares, plan, 3) is None
    with pytest.raises(NoReconstructionError, match=r"region from \(0, 0, 0\) to \(1, 2, 3\.5\)"):
        check(patches_of([]), shares, plan, 3)


@pytest.fixture
def photographs_in(tmp_path: Path) -> Path:
    """Five pictures of noise, no two alike."""
    from PIL import Image

    for m in range(NUM_VIEWS):
        noise = np.random.default_rng(m).integers(0, 256, (100, 200, 3)).astype(np.uint8)
        Image.fromarray(noise).save(tmp_path / f"{m}.png")
    return tmp_path


def model_of(poses: np.ndarray) -> Reconstruction:
    none = np.zeros(0, np.int64)
    names = [f"{m}.png" for m in range(len(poses))]
    tracks = make_tracks(len(poses), 0, none, none, none, np.zeros((0, 2)))
    model = Reconstruction.empty([CAMERA], names, np.zeros(len(poses), np.int32), tracks)
    return replace(model, cam_from_world=poses)


def test_photographs_from_the_same_place_are_copies_whatever_their_pixels(photographs_in: Path) -> None:
    poses = row_of_cameras(1.0)
    poses[3] = poses[0] + [0.0, 0.0, 0.0, 0.0, 1e-5, 0.0, 0.0]
    turned = poses[4].copy()
    turned[:4], turned[4:] = [0.0, np.sin(np.radians(20)), 0.0, np.cos(np.radians(20))], 0.0
    poses[4] = turned  # in the same place, looking elsewhere
    found = find_photographs(model_of(poses), photographs_in, ImageOptions(), is_upright=False, events=Events())
    assert found.copies == ("3.png",)
    assert found.image_idx.tolist() == [0, 1, 2, 4]


def test_equal_files_are_copies_if_their_poses_say_so_too(photographs_in: Path) -> None:
    (photographs_in / "1.png").write_bytes((photographs_in / "0.png").read_bytes())
    (photographs_in / "3.png").write_bytes((photographs_in / "2.png").read_bytes())
    poses = row_of_cameras(1.0)
    poses[1, 4] = 0.03  # of an extent of four
    found = find_photographs(model_of(poses), photographs_in, ImageOptions(), is_upright=False, events=Events())
    assert found.copies == ("1.png",)
