"""Cameras from points of boards: exact cases, OpenCV as an oracle, and sigmas that hold."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from board_views import board_poses, board_views
from sfmapp.calibration.adjustment import Fit, TargetView, normal_at, observations_of, refine, residuals_of
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.lens_choice import Candidate, try_models
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.solve import inlier_fit, solve_views
from sfmapp.calibration.start import first_fit, to_model
from sfmapp.calibration.uncertainty import frame_covariance, image_grid, projection_covariance
from sfmapp.calibration.zhang import closed_form, plane_poses
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import find_homography

BOARD = parse_board("chessboard:9x6:0.025")
SIZE = (1280, 960)
CAMERA = Camera(CameraModel.OPENCV, *SIZE, np.array([1000.0, 1010.0, 630.0, 490.0, -0.2, 0.05, 1e-3, -5e-4]))


def seen(camera: Camera, num: int, noise_px: float, seed: int, bend: float = 0.0) -> list[TargetView]:
    rng = np.random.default_rng(seed)
    return board_views(camera, BOARD, board_poses(rng, BOARD, num, camera), noise_px, rng, bend)


@pytest.mark.parametrize("num", [4, 12])
def test_a_homography_is_exact(num: int) -> None:
    rng = np.random.default_rng(0)
    h = np.array([[1.2, 0.1, 300.0], [-0.2, 0.9, 200.0], [1e-4, -2e-4, 1.0]])
    xy = rng.uniform(0, 9, (num, 2))
    mapped = np.concatenate([xy, np.ones((num, 1))], 1) @ h.T
    np.testing.assert_allclose(find_homography(xy, mapped[:, :2] / mapped[:, 2:]), h, rtol=1e-9)


def test_zhangs_closed_form_is_exact() -> None:
    camera = Camera(CameraModel.PINHOLE_SKEW, *SIZE, np.array([1000.0, 1010.0, 630.0, 490.0, 3.0]))
    views = seen(camera, 5, 0.0, 1)
    k = closed_form(views, SIZE, has_skew=True).k_matrix
    np.testing.assert_allclose(k, [[1000.0, 3.0, 630.0], [0.0, 1010.0, 490.0], [0.0, 0.0, 1.0]], atol=1e-6)
    square = Camera(CameraModel.PINHOLE, *SIZE, np.array([1000.0, 1010.0, 630.0, 490.0]))
    found = closed_form(seen(square, 3, 0.0, 1), SIZE)
    np.testing.assert_allclose(found.k_matrix, square.k_matrix, atol=1e-6)
    assert found.rank == 5
    parallel = [np.array([0.0, 0.0, 0.0, 1.0, -0.1, -0.06, z]) for z in (0.3, 0.4, 0.5, 0.6)]
    flat = board_views(square, BOARD, np.array(parallel), 0.0, np.random.default_rng(0))
    assert closed_form(flat, SIZE).rank < 5


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        Camera(CameraModel.OPENCV_FISHEYE, *SIZE, np.array([420.0, 425.0, 630.0, 490.0, -0.02, 0.004, -1e-3, 2e-4])),
        Camera(CameraModel.DIVISION, *SIZE, np.array([600.0, 605.0, 630.0, 490.0, -0.25])),
        Camera(CameraModel.EUCM, *SIZE, np.array([450.0, 455.0, 630.0, 490.0, 0.6, 1.1])),
    ],
    ids=lambda camera: camera.model.name,
)
def test_exact_points_give_the_exact_camera(camera: Camera) -> None:
    views = seen(camera, 8, 0.0, 2)
    base = first_fit(views, SIZE, closed_form(views, SIZE).k_matrix)
    fit = refine(to_model(base, camera.model, views), observations_of(views))
    np.testing.assert_allclose(fit.camera.params, camera.params, rtol=1e-6, atol=1e-6)


def test_a_plane_behind_nothing_is_posed_by_its_rays() -> None:
    camera = Camera(CameraModel.OPENCV_FISHEYE, *SIZE, np.array([300.0, 300.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0]))
    pose = rigid3.from_matrix(rigid3.exp_so3(np.array([0.2, 1.2, 0.1])), np.array([0.25, -0.05, 0.03]))
    xy = project(camera, rigid3.apply(pose, BOARD.points))
    # a view that has no pose, and one that is turned the other way, do not disturb it
    turned = project(camera, rigid3.apply(pose, BOARD.points) * [-1.0, -1.0, 1.0])
    views = [
        TargetView("a", BOARD.points[:3], xy[:3]), TargetView("b", BOARD.points, xy),
        TargetView("c", BOARD.points, turned),
    ]  # fmt: skip
    none, found, other = plane_poses(camera, views)
    assert np.isnan(none).all()
    np.testing.assert_allclose(rigid3.apply(other, BOARD.points)[:, 2], rigid3.apply(pose, BOARD.points)[:, 2])
    np.testing.assert_allclose(rigid3.apply(found, BOARD.points), rigid3.apply(pose, BOARD.points), atol=1e-9)


def test_opencv_comes_to_the_same() -> None:
    views = seen(CAMERA, 10, 0.2, 3)
    solution = solve_views(views, SIZE, CameraModel.OPENCV, bends=False)
    objects = [view.xyz.astype(np.float32) for view in views]
    pixels = [(view.xy - 0.5).astype(np.float32)[:, None] for view in views]
    rms, matrix, coefficients, *_ = cv2.calibrateCamera(objects, pixels, SIZE, None, None, flags=cv2.CALIB_FIX_K3)
    made = solution.calibration
    # OpenCV takes points and pixels as float32
    assert made.rms_px == pytest.approx(rms, rel=1e-5)
    theirs = [*matrix[[0, 1, 0, 1], [0, 1, 2, 2]] + [0, 0, 0.5, 0.5], *coefficients.ravel()[:4]]
    np.testing.assert_allclose(made.camera.params, theirs, rtol=1e-4, atol=1e-5)
    assert made.noise_px == pytest.approx(0.2, rel=0.06)


def test_sigmas_hold_for_parameters_and_for_projections() -> None:
    """Trials with noise: squared errors in sigmas follow the chi-squared distribution, two-sided, and the sigma of a
    projection covers its error in 95 per cent of image places."""
    rng = np.random.default_rng(4)
    poses = board_poses(rng, BOARD, 10, CAMERA)
    trials, num_params = 60, len(CAMERA.params)
    nees, worst, covered = [], [], []
    grid = image_grid(CAMERA, (7, 5))
    distance = 0.35
    points = distance * pixels_to_rays(CAMERA, grid)
    for _ in range(trials):
        views = board_views(CAMERA, BOARD, poses, 0.3, rng)
        obs = observations_of(views)
        fit = refine(Fit(CAMERA, poses, np.zeros(0), np.inf), obs)
        dof = 2 * len(obs.xy) - num_params - 6 * len(views)
        variance = float((residuals_of(fit, obs) ** 2).sum()) / dof
        joint = frame_covariance(normal_at(fit, obs), num_params, variance)
        assert joint is not None
        made = CameraCalibration(
            fit.camera, joint[:num_params, :num_params], "board", variance**0.5, dof, frame_covariance=joint
        )
        error = fit.camera.params - CAMERA.params
        nees.append(error @ np.linalg.solve(made.covariance, error) / num_params)
        worst.append(np.abs(error / made.sigmas).max())
        # the motion of the frame, as the boards tell it: every point of each, weighted by what it was measured with
        moved = [motion_between(poses[v], fit.cam_from_target[v]) for v in range(len(poses))]
        own = normal_at(fit, obs).own
        motion = np.linalg.solve(own.sum(0), np.einsum("vij,vj->i", own, np.array(moved)))
        turned = points + np.cross(motion[:3], points) + motion[3:]
        off = project(fit.camera, turned) - grid
        squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(projection_covariance(made, grid, distance)), off)
        covered.append((squared < chi2.ppf(0.95, 2)).mean())
    assert 0.85 < np.mean(nees) < 1.15
    assert np.mean(np.array(worst) < 3.0) > 0.9
    assert 0.90 < np.mean(covered) < 0.985


def motion_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(6,) small turn and shift that take the camera's points of one pose to those of another."""
    motion = rigid3.compose(after, rigid3.inverse(before))
    return np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(motion)), motion[4:]])


def test_bad_points_and_a_wrong_view_are_left_aside() -> None:
    views = seen(CAMERA, 10, 0.15, 5)
    rng = np.random.default_rng(6)
    views[2].xy[[3, 17, 40]] += [[4.0, 0.0], [0.0, -6.0], [30.0, 12.0]]
    views[7] = replace(views[7], xy=rng.permutation(views[7].xy))
    made = solve_views(views, SIZE, CameraModel.OPENCV, bends=False).calibration
    by_name = {view.name: view for view in made.views}
    assert np.flatnonzero(~by_name["02.png"].is_used).tolist() == [3, 17, 40]
    assert not by_name["07.png"].is_used.any()
    assert "left out" in str(by_name["07.png"].problem)
    assert (np.abs(made.camera.params - CAMERA.params) < 4.5 * made.sigmas).all()
    assert made.noise_px == pytest.approx(0.15, rel=0.08)


def test_a_bent_board_is_seen_and_a_flat_one_is_left_flat() -> None:
    bent = solve_views(seen(CAMERA, 12, 0.15, 7, bend=0.001), SIZE, CameraModel.OPENCV)
    assert bent.bend is not None
    assert bent.bend.coefficients[0] == pytest.approx(0.001, abs=4.0 * bent.bend.sigmas[0])
    made = bent.calibration
    assert (np.abs(made.camera.params - CAMERA.params) < 4.5 * made.sigmas).all()
    assert any("bent" in warning for warning in made.warnings)
    flat = solve_views(seen(CAMERA, 12, 0.15, 7), SIZE, CameraModel.OPENCV)
    assert flat.bend is None
    assert "flat" in flat.bend_note


def test_views_that_leave_the_camera_open_are_refused() -> None:
    with pytest.raises(InputError, match="at least 3 photographs"):
        solve_views(seen(CAMERA, 2, 0.1, 8), SIZE)
    rng = np.random.default_rng(9)
    poses = [np.array([0.0, 0.0, 0.0, 1.0, x, -0.06, z]) for x, z in ((-0.1, 0.35), (-0.12, 0.4), (-0.08, 0.5))] * 2
    with pytest.raises(InputError, match=r"rank \d, five are needed"):
        solve_views(board_views(CAMERA, BOARD, np.array(poses), 0.1, rng), SIZE)


def test_the_lens_is_chosen_by_views_held_out() -> None:
    views = seen(CAMERA, 8, 0.1, 10)
    base = first_fit(views, SIZE, closed_form(views, SIZE).k_matrix)

    def fit_model(model: CameraModel) -> Candidate:
        fit, is_used = inlier_fit(to_model(base, model, views), views)
        if model == CameraModel.SIMPLE_RADIAL:
            # one that looks at the middle of the picture alone, where it fits, gains nothing by it
            is_used = np.linalg.norm(observations_of(views).xy - np.array(SIZE) / 2.0, axis=1) < 250.0
            fit = refine(fit, observations_of(views)._replace(weight=is_used.astype(float)))
        worst_px = 9000.0 if model == CameraModel.FULL_OPENCV else 0.1
        return Candidate(fit, is_used, worst_px)

    models = (CameraModel.PINHOLE, CameraModel.SIMPLE_RADIAL, CameraModel.OPENCV, CameraModel.FULL_OPENCV)
    one, two = (try_models(models, views, fit_model, threads) for threads in (1, 2))
    assert [trial.model for trial in one] == [trial.model for trial in two]
    # without decentering there is more left than chance leaves, without distortion it is hopeless
    assert one[0].model == CameraModel.OPENCV
    reasons = {trial.model: trial.reason for trial in one}
    assert "times the best's" in reasons[CameraModel.PINHOLE]
    assert "times the best's" in reasons[CameraModel.SIMPLE_RADIAL]
    assert "leave it open: sigmas of up to 9e+03 px" in reasons[CameraModel.FULL_OPENCV]
    held_out = {trial.model: trial.held_out_px for trial in one}
    # the noise of two coordinates, and what poses and parameters take of it
    assert held_out[CameraModel.OPENCV] == pytest.approx(0.1 * np.sqrt(2.0), rel=0.1)


def test_a_small_bias_is_seen_by_all_views_where_one_held_out_does_not_show_it() -> None:
    """A fisheye lens that another family nearly has: 0.4 px off over the picture, 2 per cent of the residuals."""
    camera = Camera(CameraModel.OPENCV_FISHEYE, *SIZE, np.array([420.0, 425.0, 630.0, 490.0, -0.02, 4e-3, -1e-3, 2e-4]))
    views = seen(camera, 15, 0.2, 200)
    base = first_fit(views, SIZE, closed_form(views, SIZE).k_matrix)

    def fit_model(model: CameraModel) -> Candidate:
        return Candidate(*inlier_fit(to_model(base, model, views), views), 0.1)

    trials = try_models(
        (CameraModel.FOV, CameraModel.OPENCV_FISHEYE, CameraModel.THIN_PRISM_FISHEYE), views, fit_model, 1
    )
    assert trials[0].model == CameraModel.OPENCV_FISHEYE
    reasons = {trial.model: trial.reason for trial in trials[1:]}
    assert "leaves residuals" in reasons[CameraModel.FOV] or "worse on views" in reasons[CameraModel.FOV]
    assert "do not need" in reasons[CameraModel.THIN_PRISM_FISHEYE]


def test_a_view_of_which_two_points_are_good_goes_whole() -> None:
    """Two points agree with many a pose: kept, they left the covariance singular, and no camera was told."""
    rng = np.random.default_rng(4)
    poses = board_poses(rng, BOARD, 8, CAMERA)
    views = board_views(CAMERA, BOARD, poses, 0.05, rng)
    off = rng.uniform(1.0, 2.0, views[3].xy.shape) * rng.choice([-1.0, 1.0], views[3].xy.shape)
    off[[10, 30]] = 0.0
    views[3] = replace(views[3], xy=views[3].xy + off)
    _, is_used = inlier_fit(Fit(CAMERA, poses, np.zeros(0), np.inf), views)
    counts = is_used.reshape(8, -1).sum(1)
    assert counts[3] == 0
    assert np.delete(counts, 3).min() >= 52
    made = solve_views(views, SIZE, CAMERA.model, bends=False).calibration
    assert np.abs((made.camera.params - CAMERA.params) / made.sigmas).max() < 4.0


def test_a_pinhole_is_no_lens_that_is_better_by_luck() -> None:
    """Of seventeen models one is better on views held out by more than two standard errors of itself."""
    camera = Camera(CameraModel.PINHOLE, *SIZE, np.array([1000.0, 1015.0, 630.0, 490.0]))
    made = solve_views(seen(camera, 15, 0.2, 304), SIZE, bends=False).calibration
    assert made.camera.model == CameraModel.PINHOLE


def test_a_lens_that_fits_as_well_and_differs_where_no_board_was_is_told() -> None:
    """The simpler lens explains all points, and is 3 px off in the corners, at six sigmas: it has to say so."""
    camera = Camera(CameraModel.OPENCV_FISHEYE, *SIZE, np.array([420.0, 425.0, 630.0, 490.0, -0.02, 4e-3, -1e-3, 2e-4]))
    made = solve_views(seen(camera, 15, 0.2, 302), SIZE, bends=False).calibration
    told = [warning for warning in made.warnings if "do not tell" in warning]
    assert made.camera.model == CameraModel.EUCM
    assert len(told) == 1
    assert "EUCM from OPENCV_FISHEYE, which differ by up to" in told[0]
