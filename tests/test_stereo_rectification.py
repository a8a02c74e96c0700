"""Rectification of two calibrated cameras: against the definition, and against OpenCV."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from dense_scenes import CAMERA, poses, wall_with_box_and_bars
from rendered_worlds.rendering import Optics, Renderer
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.prepare import PairCameras, prepare_pair
from sfmapp.stereo.rectification import plan_rectification, rectified_as_is, rectify

PINHOLE = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 500.0, 322.0, 238.0]))
BROWN = Camera(CameraModel.OPENCV, 800, 600, np.array([700.0, 690.0, 410.0, 290.0, -0.2, 0.05, 1e-3, -5e-4]))
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 640, 640, np.array([260.0, 262.0, 318.0, 322.0, 0.02, -0.01, 2e-3, -4e-4]))


def rig_of(
    left: Camera, right: Camera, turn_deg: tuple[float, float, float], center: tuple[float, float, float]
) -> Rig:
    """The right camera turned by a rotation vector and placed in the frame of the left one."""
    rotation = rigid3.exp_so3(np.radians(turn_deg))
    pose = rigid3.from_matrix(rotation, -rotation @ np.array(center))
    return Rig((left, right), np.array([rigid3.IDENTITY, pose]))


RIGS = {
    "converging, two lenses": rig_of(PINHOLE, BROWN, (1.0, -12.0, 2.0), (0.3, 0.01, -0.02)),
    "fisheye and pinhole": rig_of(FISHEYE, PINHOLE, (-2.0, 5.0, 0.5), (0.12, -0.005, 0.01)),
    "one above the other": rig_of(BROWN, BROWN, (3.0, 0.5, 0.0), (0.01, 0.2, 0.0)),
}


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
def test_points_lie_on_one_row_at_the_disparity_of_their_depth(rig: Rig) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-1.0, -1.0, 2.0), (1.0, 1.0, 6.0), (500, 3))
    plan = plan_rectification(rig)
    g = plan.geometry
    seen = [project(rig.cameras[n], rigid3.apply(rig.cam_from_rig[n], points)) for n in (0, 1)]
    left, right = (plan.points(n, seen[n]) for n in (0, 1))
    inside = np.isfinite(left).all(1) & np.isfinite(right).all(1)
    assert inside.sum() > 100
    np.testing.assert_allclose(left[inside, 1], right[inside, 1], atol=1e-6)
    depth = (points @ plan.left_from_camera.T)[inside, 2]
    assert g.baseline is not None
    np.testing.assert_allclose(
        left[inside, 0] - right[inside, 0], g.focal * g.baseline / depth - g.doffs, rtol=0, atol=1e-6
    )


def test_what_both_see_is_kept_and_what_neither_can_is_not() -> None:
    rig = RIGS["converging, two lenses"]
    plan = plan_rectification(rig)
    g = plan.geometry
    rng = np.random.default_rng(1)
    points = rng.uniform((-2.0, -1.5, 0.8), (2.0, 1.5, 20.0), (4000, 3))
    seen = [project(rig.cameras[n], rigid3.apply(rig.cam_from_rig[n], points)) for n in (0, 1)]
    by_both = np.ones(len(points), bool)
    for camera, xy in zip(rig.cameras, seen, strict=True):
        by_both &= ((xy > 0.0) & (xy < [camera.width, camera.height])).all(1)
    flat = [plan.points(n, seen[n])[by_both] for n in (0, 1)]
    kept = [((xy >= 0.0) & (xy <= [g.width, g.height])).all(1) for xy in flat]
    assert by_both.sum() > 300
    assert min(one.mean() for one in kept) > 0.95  # what bends out of the straight border is cut
    assert 0.3 < min(plan.kept) < 1.0
    assert math.prod(plan.scale) == pytest.approx(1.0)  # as much as the one gains the other loses


def test_a_rectified_rig_stays_as_it_is() -> None:
    shifted = dataclasses.replace(PINHOLE, params=np.add(PINHOLE.params, [0.0, 0.0, 31.0, 0.0]))
    rig = rig_of(PINHOLE, shifted, (0.0, 0.0, 0.0), (0.2, 0.0, 0.0))
    plan = plan_rectification(rig)
    assert plan.is_identity
    g = plan.geometry
    assert (g.focal, g.doffs, g.baseline, g.width) == (500.0, 31.0, 0.2, 640)
    picture = np.random.default_rng(2).integers(0, 256, (480, 640), np.uint8)
    pair = rectify(plan, picture, picture[::-1].copy())
    assert np.array_equal(pair.left, picture)
    assert pair.left_shown.all()
    for turn, center in (((0.0, 0.01, 0.0), (0.2, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.2, 0.001, 0.0))):
        assert rectified_as_is(rig_of(PINHOLE, shifted, turn, center)) is None


def test_pictures_agree_with_opencv() -> None:
    """Maps of cv2.initUndistortRectifyMap, given our rotations and projections."""
    rig = RIGS["converging, two lenses"]
    plan = plan_rectification(rig)
    g = plan.geometry
    for side, camera in enumerate(rig.cameras):
        k, new = camera.k_matrix, plan.camera_matrix(side)
        for matrix in (k, new):
            matrix[:2, 2] -= 0.5  # pixel centres at whole numbers
        coefficients = camera.canonical[4:8]
        maps = cv2.initUndistortRectifyMap(
            k, coefficients, plan.rotation(side), new, (g.width, g.height), cv2.CV_32FC1
        )  # fmt: skip
        np.testing.assert_allclose(plan.sampling_map(side), np.stack(maps, -1) + 0.5, atol=2e-3)


def test_rigs_that_cannot_be_rectified_are_named() -> None:
    with pytest.raises(InputError, match="epipole is inside"):
        plan_rectification(rig_of(PINHOLE, PINHOLE, (0.0, 0.0, 0.0), (0.02, 0.01, 1.0)))
    with pytest.raises(InputError, match="at one"):
        plan_rectification(rig_of(PINHOLE, PINHOLE, (0.0, 5.0, 0.0), (0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="swapped"):
        plan_rectification(rig_of(PINHOLE, PINHOLE, (0.0, 1.0, 0.0), (-0.2, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"nothing in common|too far apart"):
        plan_rectification(rig_of(PINHOLE, PINHOLE, (60.0, 0.0, 0.0), (0.2, 0.0, 0.0)))
    with pytest.raises(InputError, match="has 10 x 10"):
        rectify(plan_rectification(RIGS["one above the other"]), *[np.zeros((10, 10), np.uint8)] * 2)


def test_photographs_of_unknown_cameras_far_from_rectified_and_in_either_order() -> None:
    """Rows 30 px apart are no rows of a rectified pair, and nobody said which photograph is the left one."""
    first = poses(5)[2]
    tilt = rigid3.from_matrix(rigid3.exp_so3(np.radians([6.0, 2.0, 3.0])), np.array([-0.5, 0.05, 0.0]))
    photographs = [
        Renderer(wall_with_box_and_bars(), CAMERA).photograph(pose, Optics(noise_sigma=1.0), [7, side])
        for side, pose in enumerate((first, rigid3.compose(tilt, first)))
    ]
    for order in ((0, 1), (1, 0)):
        left, right = (photographs[side] for side in order)
        made = prepare_pair(left, right, PairCameras(), ("a.png", "b.png"))
        assert made.report.is_swapped == (order == (1, 0))
        assert made.report.rows is not None
        assert made.report.rows.rms_px < 1.0
        assert not made.report.is_as_given
        assert any("not rectified" in warning for warning in made.report.warnings)
        assert any("b.png was taken to the left of a.png" in warning for warning in made.report.warnings) == order[0]
