"""One photograph of known points: the direct linear transform, Tsai's plane, their sigmas, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.one_view import (
    fit_view,
    inverse,
    resolution_sigma,
    slopes_aside,
    spread_of_curves,
)
from sfmapp.calibration.target import TargetFit, calibrate_target
from sfmapp.calibration.targets import calibrate_targets, located_views
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.geometry import dlt, rigid3
from sfmapp.geometry.radial_alignment import views_of_plane

SIZE = (1280, 720)
PINHOLE = Camera(CameraModel.PINHOLE, *SIZE, [900.0, 910.0, 630.0, 370.0])
OPENCV = Camera(CameraModel.OPENCV, *SIZE, [900.0, 910.0, 630.0, 370.0, -0.2, 0.05, 0.001, -0.002])


def picture(rng, num: int, camera: Camera, depth: float = 0.8, tilt_deg: float = 0.0):
    """Places and their pixels, all in the picture, and the pose; a flat target is tilted by at least so much."""
    while True:
        xyz = rng.uniform(-1.0, 1.0, (num, 3)) * [1.6, 1.0, depth]
        rotation = rigid3.exp_so3(0.5 * rng.normal(size=3))
        pose = rigid3.from_matrix(rotation, np.array([*0.1 * rng.normal(size=2), 3.5]))
        xy = project(camera, rigid3.apply(pose, xyz))
        is_inside = np.isfinite(xy).all() and (xy > 0).all() and (xy < SIZE).all()
        if is_inside and abs(rotation[2, 2]) <= np.cos(np.radians(tilt_deg)):
            return xyz, xy, pose


def errors(fit: TargetFit, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """(F + 6,) of the free parameters, the turn and the shift, as the covariance has them."""
    truth = dict(zip(PARAM_NAMES[camera.model], camera.params, strict=True))
    names = PARAM_NAMES[fit.view.camera.model]
    of_lens = [value - truth.get(name, 0.0) for name, value in zip(names, fit.view.camera.params, strict=True)]
    found = fit.view.cam_from_world
    turn = rigid3.log_so3(rigid3.rotation_matrix(found) @ rigid3.rotation_matrix(pose).T)
    return np.concatenate([of_lens, turn, found[4:] - rigid3.exp_so3(turn) @ pose[4:]])


# ------------------------------------------------------------------------------------------------- the linear solution


@pytest.mark.parametrize("is_inhomogeneous", [False, True])
def test_the_projection_matrix_gives_back_the_camera(is_inhomogeneous) -> None:
    rng = np.random.default_rng(0)
    k = np.array([[900.0, 3.0, 630.0], [0.0, 910.0, 370.0], [0.0, 0.0, 1.0]])
    # far from the origin, as surveys are, and in any unit
    for shift, scale in ((0.0, 1.0), (5e4, 1.0), (0.0, 1e-4)):
        xyz, _, pose = picture(rng, 9, PINHOLE)
        rays = rigid3.apply(pose, xyz) @ k.T
        places = scale * (xyz + shift)
        found = dlt.find_projection(places, rays[:, :2] / rays[:, 2:], is_inhomogeneous=is_inhomogeneous)
        assert found.rank == 11
        k_found, rotation, translation = dlt.decompose_projection(found.matrix)
        np.testing.assert_allclose(k_found, k, rtol=1e-6, atol=1e-3)
        np.testing.assert_allclose(rotation, rigid3.rotation_matrix(pose), atol=1e-6)
        expected = scale * (pose[4:] - rigid3.rotation_matrix(pose) @ np.full(3, shift))
        np.testing.assert_allclose(translation, expected, rtol=1e-6, atol=1e-6 * scale)


def test_the_parts_of_a_projection_have_the_right_signs() -> None:
    """K with a positive diagonal, a rotation that mirrors nothing, and points in front, whatever the matrix's sign."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        xyz, _, pose = picture(rng, 8, PINHOLE)
        matrix = PINHOLE.k_matrix @ np.c_[rigid3.rotation_matrix(pose), pose[4:]]
        for sign in (1.0, -7.0):
            k, rotation, translation = dlt.decompose_projection(sign * matrix)
            assert (np.diag(k) > 0).all()
            assert np.linalg.det(rotation) == pytest.approx(1.0)
            assert ((xyz @ rotation.T + translation)[:, 2] > 0).all()
    with pytest.raises(ValueError, match="at infinity"):
        dlt.decompose_projection(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))


@pytest.mark.parametrize(("flatten", "rank"), [([1, 1, 1], 11), ([1, 1, 0], 8), ([1, 0, 0], 5)])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_the_rank_says_what_the_points_tell(flatten, rank, noise) -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        xyz, _, pose = picture(rng, 12, PINHOLE)
        xyz = xyz * flatten
        xy = project(PINHOLE, rigid3.apply(pose, xyz)) + noise * rng.normal(size=(12, 2))
        assert dlt.find_projection(xyz, xy, noise_px=noise).rank == rank


def test_kernels_for_small_systems_agree_with_lapack() -> None:
    rng = np.random.default_rng(15)
    plane = rng.uniform(-1.0, 1.0, (50, 4, 2))
    h = np.array([[1.1, 0.2, 3.0], [-0.1, 0.9, 2.0], [0.05, 0.1, 1.0]])
    mapped = dlt.homogeneous(plane) @ h.T
    found = dlt.find_homographies(plane, mapped[..., :2] / mapped[..., 2:])
    np.testing.assert_allclose(found, np.broadcast_to(h / np.linalg.norm(h), found.shape), atol=1e-11)
    xyz, xy, _ = picture(rng, 12, PINHOLE)
    noisy = xy + 0.5 * rng.normal(size=xy.shape)
    ours = dlt.find_projections(xyz[None], noisy[None])[0]
    np.testing.assert_allclose(ours, dlt.find_projection(xyz, noisy).matrix, rtol=1e-6, atol=1e-6)
    # symmetric matrices of any scale of their unknowns, and those that are open
    rows = rng.normal(size=(40, 9)) * np.logspace(-4, 4, 9)
    expected = np.linalg.inv(rows.T @ rows / np.logspace(-4, 4, 9) / np.logspace(-4, 4, 9)[:, None])
    expected = expected / np.logspace(-4, 4, 9) / np.logspace(-4, 4, 9)[:, None]
    np.testing.assert_allclose(inverse(rows.T @ rows), expected, rtol=1e-8, atol=1e-12 * np.abs(expected).max())
    rows[:, 8] = rows[:, 7]
    assert inverse(rows.T @ rows) is None
    assert inverse(np.full((3, 3), np.nan)) is None


def test_a_plane_is_told_from_directions_alone() -> None:
    """Tsai's constraint, also where he divides by zero, and under a distortion that he does not know."""
    rng = np.random.default_rng(3)
    for n in range(20):
        rotation = rigid3.exp_so3(0.6 * rng.normal(size=3))
        translation = np.array([0.3 * rng.normal(), 0.0 if n % 3 == 0 else 0.3 * rng.normal(), 5.0])
        flat = rng.uniform(-1.0, 1.0, (12, 2))
        seen = flat @ rotation[:, :2].T + translation
        normalized = seen[:, :2] / seen[:, 2:]
        found = views_of_plane(flat, 900.0 * normalized)[0]
        assert found.focal_px == pytest.approx(900.0, rel=1e-6)
        np.testing.assert_allclose(found.rotation, rotation, atol=1e-7)
        bent = 900.0 * normalized * (1.0 - 0.3 * (normalized**2).sum(1, keepdims=True))
        np.testing.assert_allclose(views_of_plane(flat, bent)[0].rotation, rotation, atol=1e-7)


# ---------------------------------------------------------------------------------------------------------- whole fits


@pytest.mark.parametrize(("camera", "num"), [(PINHOLE, 6), (PINHOLE, 12), (OPENCV, 40)])
def test_exact_points_give_the_camera_exactly(camera, num) -> None:
    xyz, xy, pose = picture(np.random.default_rng(num), num, camera)
    fit = calibrate_target(xyz, xy, SIZE)
    np.testing.assert_allclose(fit.view.camera.params, camera.params, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(fit.view.cam_from_world, pose, atol=1e-7)
    assert not fit.wrong
    assert (np.diag(fit.covariance) > 0).all()


def test_the_skew_comes_as_it_is() -> None:
    skewed = Camera(CameraModel.PINHOLE_SKEW, *SIZE, [900.0, 910.0, 630.0, 370.0, 4.0])
    xyz, xy, _ = picture(np.random.default_rng(4), 10, skewed)
    fit = calibrate_target(xyz, xy, SIZE, camera_model=CameraModel.PINHOLE_SKEW)
    np.testing.assert_allclose(fit.view.camera.params, skewed.params, rtol=1e-6)


def test_a_fisheye_is_known_by_the_points_that_it_foretells() -> None:
    rng = np.random.default_rng(5)
    camera = Camera(CameraModel.OPENCV_FISHEYE, *SIZE, [420.0, 425.0, 630.0, 370.0, 0.02, -0.01, 0.003, -0.001])
    xyz = rng.uniform(-1.0, 1.0, (60, 3)) * [3.0, 2.0, 1.0]
    pose = rigid3.from_matrix(rigid3.exp_so3([0.1, -0.2, 0.3]), np.array([0.1, 0.1, 1.8]))
    xy = project(camera, rigid3.apply(pose, xyz))
    inside = np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < SIZE).all(1)
    noisy = xy[inside] + 0.3 * rng.normal(size=(int(inside.sum()), 2))
    fit = calibrate_target(xyz[inside], noisy, SIZE)
    assert fit.view.camera.model == CameraModel.OPENCV_FISHEYE
    assert [trial.is_chosen for trial in fit.trials] == [False, True]
    assert np.abs(errors(fit, camera, pose) / np.sqrt(np.diag(fit.covariance))).max() < 4.0


@pytest.mark.parametrize("camera", [PINHOLE, OPENCV])
def test_the_covariance_holds(camera) -> None:
    """NEES two-sided, and every parameter inside three sigmas in 99 of 100; with wrong points among the right ones."""
    nees, sigmas, num_false, num_missed, num_trials = [], [], 0, 0, 36
    for trial in range(num_trials):
        rng = np.random.default_rng([6, trial])
        xyz, xy, pose = picture(rng, 40, camera)
        xy = xy + 0.5 * rng.normal(size=xy.shape)
        wrong = rng.choice(40, trial % 5, replace=False)
        turn = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
        xy[wrong] += rng.uniform(10.0, 60.0, (len(wrong), 1)) * np.stack([np.cos(turn), np.sin(turn)], 1)
        fit = calibrate_target(xyz, xy, SIZE, camera_model=camera.model)
        error = errors(fit, camera, pose)
        nees.append(error @ np.linalg.solve(fit.covariance, error))
        sigmas.append(error / np.sqrt(np.diag(fit.covariance)))
        named = {point.index for point in fit.wrong}
        num_false, num_missed = num_false + len(named - set(wrong)), num_missed + len(set(wrong) - named)
    degrees = num_trials * len(sigmas[0])
    assert chi2.ppf(1e-3, degrees) < sum(nees) < chi2.ppf(1.0 - 1e-3, degrees)
    assert (np.abs(sigmas) < 3.0).mean() > 0.99
    assert (num_false, num_missed) == (0, 0)


def test_the_curvature_of_the_projection_is_in_the_covariance() -> None:
    """With x(t) = x0 + A t + 1/2 B t t for data that are moved by J A t, 1/2 sum B_ab B_ab^T is what it adds."""
    xyz, xy, pose = picture(np.random.default_rng(13), 9, PINHOLE)
    used, free = np.ones(9, bool), np.ones(4, bool)
    view = fit_view(PINHOLE, pose, (xyz, xy), used, is_free=free)
    covariance = np.linalg.inv(view.point_information) * 0.3**2
    root = np.linalg.cholesky(covariance)

    def bend(t: np.ndarray) -> np.ndarray:
        """B t t, from the sum of both ways."""
        total = 0.0
        for sign in (1.0, -1.0):
            moved = xy + sign * (view.slope @ root @ t)
            found = fit_view(view.camera, view.cam_from_world, (xyz, moved), used, is_free=free)
            turn = rigid3.log_so3(
                rigid3.rotation_matrix(found.cam_from_world) @ rigid3.rotation_matrix(view.cam_from_world).T
            )
            shift = found.cam_from_world[4:] - rigid3.exp_so3(turn) @ view.cam_from_world[4:]
            total = total + np.concatenate([found.camera.params - view.camera.params, turn, shift])
        return total

    step, num = 0.1, len(root)
    axes = np.eye(num) * step
    squares = np.array([bend(axis) for axis in axes])
    added = 0.5 * squares.T @ squares
    for a in range(num):
        for b in range(a):
            both = 0.5 * (bend(axes[a] + axes[b]) - squares[a] - squares[b])
            added += np.outer(both, both)
    added /= step**4
    ahead, back = (slopes_aside(view, (xyz, xy), sign * root) for sign in (0.01, -0.01))
    found = spread_of_curves(view, 100.0 * ahead, 100.0 * back, root)
    scale = np.sqrt(np.diag(added))
    np.testing.assert_allclose(found / scale / scale[:, None], added / scale / scale[:, None], atol=0.01)
    assert (np.diag(added) > 1e-4 * np.diag(covariance)).any()


def test_sigmas_of_fourteen_points_hold_on_average() -> None:
    """Fourteen unknowns and as many degrees of freedom: NEES was 1.3, and 1.6 in the first order; its mean over three
    hundred pictures has a standard deviation of 0.05."""
    nees = []
    for trial in range(300):
        rng = np.random.default_rng([14, trial])
        xyz, xy, pose = picture(rng, 14, OPENCV)
        fit = calibrate_target(xyz, xy + 0.5 * rng.normal(size=xy.shape), SIZE, camera_model=CameraModel.OPENCV)
        error = errors(fit, OPENCV, pose)
        nees.append(error @ np.linalg.solve(fit.covariance, error) / len(error))
    assert 0.85 < np.mean(nees) < 1.17


def test_two_points_that_changed_places_are_named() -> None:
    rng = np.random.default_rng(7)
    xyz, xy, _ = picture(rng, 20, PINHOLE)
    xy = np.round(xy)  # as a hand types them
    xy[[4, 9]] = xy[[9, 4]]
    fit = calibrate_target(xyz, xy, SIZE, camera_model=CameraModel.PINHOLE)
    assert {(point.index, point.swapped_with) for point in fit.wrong} == {(4, 9), (9, 4)}


def test_a_wrong_point_does_not_take_the_place_of_those_that_the_distortion_moved() -> None:
    """Of 500 such pictures of the benchmark the one whose start, without distortion, left five good points aside."""
    rng = np.random.default_rng([1, 40, 4, 486])
    size = (1280, 720)
    camera = Camera(CameraModel.OPENCV, *size, np.array([900.0, 910.0, 630.0, 370.0, -0.2, 0.05, 0.001, -0.002]))
    while True:
        xyz = rng.uniform(-1.0, 1.0, (40, 3)) * [1.6, 1.0, 0.8]
        pose = rigid3.from_matrix(rigid3.exp_so3(0.5 * rng.normal(size=3)), np.array([*0.1 * rng.normal(size=2), 3.5]))
        xy = project(camera, rigid3.apply(pose, xyz))
        if np.isfinite(xy).all() and (xy > 0).all() and (xy < size).all():
            break
    xy = xy + 0.5 * rng.normal(size=xy.shape)
    wrong, turn = rng.choice(40, 4, replace=False), rng.uniform(0.0, 2.0 * np.pi, 4)
    xy[wrong] += rng.uniform(10.0, 60.0, (4, 1)) * np.stack([np.cos(turn), np.sin(turn)], 1)
    fit = calibrate_target(xyz, xy, size, camera_model=CameraModel.OPENCV)
    assert sorted(one.index for one in fit.wrong) == sorted(wrong)
    off = errors(fit, camera, pose)
    assert float(off @ np.linalg.solve(fit.covariance, off)) / len(off) < 2.5


def test_a_tilted_plane_tells_the_focal_length_through_the_distortion() -> None:
    inside = []
    for trial in range(20):
        rng = np.random.default_rng([8, trial])
        center = np.array(SIZE) / 2.0 + 0.01 * 1280 * rng.normal(size=2)
        camera = Camera(CameraModel.SIMPLE_RADIAL, *SIZE, [900.0, *center, -0.2])
        xyz, xy, _ = picture(rng, 40, camera, depth=0.0, tilt_deg=30.0)
        # the axes of the world are no axes of the plane
        turn = rigid3.exp_so3(rng.normal(size=3))
        fit = calibrate_target(xyz @ turn.T, xy + 0.3 * rng.normal(size=xy.shape), SIZE)
        assert fit.is_plane
        assert fit.tilt_deg >= 25.0
        inside.append(abs(fit.view.camera.focal - 900.0) < 3.0 * fit.focal_sigma_px)
        assert fit.focal_sigma_px < 0.1 * 900.0
    assert np.mean(inside) > 0.95


# --------------------------------------------------------------------------------------------------------- refused


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_plane_seen_frontally_is_refused(noise) -> None:
    rng = np.random.default_rng(9)
    xyz = rng.uniform(-1.0, 1.0, (30, 3)) * [1.6, 1.0, 0.0]
    xy = project(PINHOLE, xyz + np.array([0.0, 0.0, 4.0])) + noise * rng.normal(size=(30, 2))
    with pytest.raises(NoReconstructionError, match="seen frontally"):
        calibrate_target(xyz, xy, SIZE)


def test_a_target_that_is_too_flat_for_its_noise_is_refused() -> None:
    rng = np.random.default_rng(10)
    for _ in range(5):
        xyz, xy, _ = picture(rng, 15, PINHOLE, depth=0.0005)
        with pytest.raises(NoReconstructionError, match="focal length is open"):
            calibrate_target(xyz, xy + 0.5 * rng.normal(size=xy.shape), SIZE)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda xyz, xy: (xyz * [1, 0, 0], xy), "one line"),
        (lambda xyz, xy: (xyz[[0, *range(11)]], xy), "points 1 and 2"),
        (lambda xyz, xy: (np.where(xyz == xyz[3, 1], np.inf, xyz), xy), "point 4"),
        (lambda xyz, xy: (xyz, np.where(xy == xy[2, 0], np.nan, xy)), "point 3"),
        (lambda xyz, xy: (xyz[:5], xy[:5]), "at least 6"),
        (lambda xyz, xy: (xyz * [1, 1, -1], xy), "mirror"),
    ],
)
def test_points_that_tell_no_camera_are_refused_with_the_reason(spoil, message) -> None:
    xyz, xy, _ = picture(np.random.default_rng(11), 12, PINHOLE)
    with pytest.raises(InputError, match=message):
        calibrate_target(*spoil(xyz, xy), SIZE)


def test_few_points_are_never_surer_than_a_hand() -> None:
    xyz, xy, _ = picture(np.random.default_rng(12), 6, PINHOLE)
    fit = calibrate_target(xyz, xy, SIZE)
    assert fit.noise.sigma_px == 1.0
    assert any("barely enough" in warning for warning in fit.warnings)
    # and whole pixels are no surer than their rounding
    assert resolution_sigma(np.round(xy)) == pytest.approx(12.0**-0.5)
    assert resolution_sigma(np.round(xy) + 0.5) == pytest.approx(12.0**-0.5)
    assert resolution_sigma(np.round(xy, 2)) == pytest.approx(0.01 * 12.0**-0.5)


def test_several_photographs_tell_one_camera_within_their_sigmas() -> None:
    rng = np.random.default_rng(8)
    nees, alone, of_poses = [], [], []
    for _ in range(12):
        views, poses = [], []
        for name in ("a", "b", "c"):
            xyz, xy, pose = picture(rng, 30, OPENCV)
            xy = xy + 0.5 * rng.normal(size=xy.shape)
            xy[:2] += rng.uniform(15, 40, (2, 2))
            views.append(TargetView(name, xyz, xy))
            poses.append(pose)
        # a few points more, which tell no camera by themselves
        xyz, xy, pose = picture(rng, 5, OPENCV)
        poses.append(pose)
        views.append(TargetView("few", xyz, xy + 0.5 * rng.normal(size=xy.shape)))
        made = calibrate_targets(views, SIZE, camera_model=OPENCV.model)
        assert [view.name for view in made.views] == ["a", "b", "c", "few"]
        assert not any(view.is_used[:2].any() for view in made.views[:3])
        off = made.camera.params - OPENCV.params
        nees.append(float(off @ np.linalg.solve(made.covariance, off)))
        alone.append(calibrate_target(views[0].xyz, views[0].xy, SIZE, camera_model=OPENCV.model).focal_sigma_px)
        assert made.sigmas[0] < alone[-1]
        for found, pose in zip(located_views(made, views), poses, strict=True):
            turn = rigid3.log_so3(rigid3.rotation_matrix(found.view.cam_from_world) @ rigid3.rotation_matrix(pose).T)
            error = np.r_[off, turn, found.view.cam_from_world[4:] - rigid3.exp_so3(turn) @ pose[4:]]
            of_poses.append(float(error @ np.linalg.solve(found.covariance, error)))
    num = 12 * len(OPENCV.params)
    # four poses of a trial share its camera: their mean is held, whose spread is below that of independent ones
    assert chi2.ppf(1e-3, 12 * 14) < sum(of_poses) / 4 < chi2.ppf(1.0 - 1e-3, 12 * 14)
    assert chi2.ppf(1e-4, num) < sum(nees) < chi2.ppf(1.0 - 1e-4, num)
    with pytest.raises(InputError, match="found none"):
        calibrate_targets([], SIZE)
    with pytest.raises(InputError, match="at least 6"):
        calibrate_targets(views[3:], SIZE)


def test_opencv_finds_the_same_minimum() -> None:
    """cv2.calibrateCamera, which wants a guess for points in space, minimises the same squares."""
    import cv2

    rng = np.random.default_rng(13)
    xyz, xy, _ = picture(rng, 40, OPENCV)
    xy = xy + 0.5 * rng.normal(size=xy.shape)
    fit = calibrate_target(xyz, xy, SIZE, camera_model=CameraModel.OPENCV)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-15)
    rms, k, distortion, *_ = cv2.calibrateCamera(
        [xyz.astype(np.float32)], [(xy - 0.5).astype(np.float32)], SIZE, PINHOLE.k_matrix.copy(), np.zeros(5),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3, criteria=criteria,
    )  # fmt: skip
    assert np.sqrt(fit.view.squares / 40) == pytest.approx(rms, rel=1e-5)
    theirs = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *distortion.ravel()[:4]]
    sigmas = np.sqrt(np.diag(fit.covariance))[:8]
    assert (np.abs(fit.view.camera.params - theirs) < 0.01 * sigmas).all()


@pytest.mark.real
def test_single_photographs_of_a_chessboard_tell_the_focal_length_within_their_sigmas(data_root) -> None:
    """26 photographs of OpenCV's board by two cameras, beside cv2.calibrateCamera over all of them."""
    import cv2

    board = np.zeros((54, 3))
    board[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2)
    away = []
    for side in ("left", "right"):
        views = []
        for path in sorted((data_root / "opencv-doc-samples" / "calib").glob(f"{side}[0-9]*.jpg")):
            gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            found, corners = cv2.findChessboardCorners(gray, (9, 6))
            if found:
                views.append(cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2))
        _, k, *_ = cv2.calibrateCamera([board.astype(np.float32)] * len(views), views, (640, 480), None, None)
        for corners in views:
            fit = calibrate_target(board, corners.astype(np.float64) + 0.5, (640, 480))
            away.append((fit.view.camera.focal - 0.5 * (k[0, 0] + k[1, 1])) / fit.focal_sigma_px)
    assert len(away) >= 24
    # of one view of a board that is not quite flat, a little beyond three sigmas is no wonder
    assert (np.abs(away) < 3.0).sum() >= len(away) - 1
    assert np.abs(away).max() < 4.5
