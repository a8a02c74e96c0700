"""Verification of pairs on scenes whose geometry is known, and against COLMAP."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.camera.camera import Camera, CameraModel, project, simple_camera
from sfmapp.geometry import epipolar, rigid3
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import plane_of_matches
from sfmapp.matching.second_motion import PLANE_SHARE
from sfmapp.matching.two_view import Ransac, TwoViewGeometry, error_threshold_px, is_significant, verify_pair
from sfmapp.scene.correspondences import TwoViewConfig

OPTIONS = MatchingOptions()
RANSAC = Ransac(5000, 7)
KNOWN = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 800, 900.0, 20.0, "exif_35mm")
UNKNOWN = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 800, 1200.0)
ROTATION = rigid3.exp_so3([0.05, -0.15, 0.04])
SIDEWAYS = np.concatenate([rigid3.quaternion(ROTATION), [0.98, 0.1, 0.17]])
SIDEWAYS[4:] /= np.linalg.norm(SIDEWAYS[4:])


def views(
    pose: np.ndarray,
    rng: np.random.Generator,
    num: int = 300,
    noise_px: float = 0.5,
    num_wrong: int = 100,
    plane: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of a cloud or a plane in two views, and which of the matches are right."""
    xy = rng.uniform([0, 0], [1000, 800], (num, 2))
    depth = 5.0 + 0.4 * xy[:, 0] / 1000 if plane else rng.uniform(4, 9, num)
    rays = np.concatenate([(xy - [500, 400]) / 900, np.ones((num, 1))], 1)
    if plane:  # n . X = 5
        depth = 5.0 / (rays @ np.array([0.2, -0.1, 0.97]))
    xy2 = project(KNOWN, rigid3.apply(pose, rays * depth[:, None]))
    is_right = ((xy2 > 0) & (xy2 < [1000, 800])).all(1)
    xy, xy2 = xy[is_right] + rng.normal(0, noise_px, (is_right.sum(), 2)), xy2[is_right]
    xy2 = xy2 + rng.normal(0, noise_px, xy2.shape)
    wrong = rng.uniform([0, 0], [1000, 800], (2, num_wrong, 2))
    ground_truth = np.arange(len(xy) + num_wrong) < len(xy)
    return np.concatenate([xy, wrong[0]]), np.concatenate([xy2, wrong[1]]), ground_truth


def rotation_error_deg(g: TwoViewGeometry, ground_truth: np.ndarray = SIDEWAYS) -> float:
    return float(
        rigid3.rotation_angle_deg(rigid3.rotation_matrix(g.cam2_from_cam1) @ rigid3.rotation_matrix(ground_truth).T)
    )


def translation_error_deg(g: TwoViewGeometry, ground_truth: np.ndarray = SIDEWAYS) -> float:
    return float(np.degrees(np.arccos(np.clip(g.cam2_from_cam1[4:] @ ground_truth[4:], -1, 1))))


def with_focal(factor: float) -> Camera:
    return simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 800, 900.0 * factor, 20.0, "exif_35mm")


def test_a_scene_with_known_focals_is_calibrated() -> None:
    xy1, xy2, ground_truth = views(SIDEWAYS, np.random.default_rng(0))
    g = verify_pair(xy1, xy2, KNOWN, KNOWN, OPTIONS, RANSAC)
    assert g.config == TwoViewConfig.CALIBRATED
    assert g.is_inlier[ground_truth].mean() > 0.97
    assert g.is_inlier[~ground_truth].mean() < 0.08
    # half a pixel over a focal of 900, by some 200 points, is 0.002 degrees times the trade with the translation
    assert rotation_error_deg(g) < 0.3
    assert translation_error_deg(g) < 1.5
    depths, angles = epipolar.ray_depths(
        SIDEWAYS, (xy1[ground_truth] - [500, 400]) / 900, (xy2[ground_truth] - [500, 400]) / 900
    )
    assert g.median_angle_deg == pytest.approx(np.degrees(np.median(angles)), rel=0.1)
    assert (depths > 0).all()
    assert epipolar.sampson_errors(g.fundamental, xy1, xy2)[g.is_inlier].max() < 16
    assert min(g.num_inliers_f, g.num_inliers_e) > 0.97 * ground_truth.sum()


def test_a_scene_with_unknown_focal_is_uncalibrated_but_has_a_pose() -> None:
    xy1, xy2, ground_truth = views(SIDEWAYS, np.random.default_rng(1))
    g = verify_pair(xy1, xy2, UNKNOWN, UNKNOWN, OPTIONS, RANSAC)
    assert g.config == TwoViewConfig.UNCALIBRATED
    assert g.is_inlier[ground_truth].mean() > 0.97
    assert rotation_error_deg(g) < 8.0  # with a focal that is a third too long


@pytest.mark.parametrize("factor", [0.75, 1.3])
def test_a_wrong_focal_from_exif_loses_no_matches(factor: float) -> None:
    xy1, xy2, ground_truth = views(SIDEWAYS, np.random.default_rng(2), noise_px=0.3)
    g = verify_pair(xy1, xy2, with_focal(factor), with_focal(factor), OPTIONS, RANSAC)
    assert g.config in (TwoViewConfig.CALIBRATED, TwoViewConfig.UNCALIBRATED)
    assert g.is_inlier[ground_truth].mean() > 0.97
    assert rotation_error_deg(g) < 10.0


@pytest.mark.parametrize("camera", [KNOWN, UNKNOWN], ids=["known focal", "unknown focal"])
def test_a_plane_is_planar(camera: Camera) -> None:
    xy1, xy2, ground_truth = views(SIDEWAYS, np.random.default_rng(3), plane=True)
    g = verify_pair(xy1, xy2, camera, camera, OPTIONS, RANSAC)
    assert g.config == TwoViewConfig.PLANAR
    assert g.is_inlier[ground_truth].mean() > 0.97
    if camera is KNOWN:  # a plane allows two motions; ours may be the other
        assert np.isfinite(g.cam2_from_cam1).all()


@pytest.mark.parametrize(
    "camera", [KNOWN, with_focal(1.25), UNKNOWN], ids=["known focal", "wrong focal", "unknown focal"]
)
def test_a_rotation_is_panoramic(camera: Camera) -> None:
    turn = np.concatenate([rigid3.quaternion(rigid3.exp_so3([0.05, -0.3, 0.1])), np.zeros(3)])
    xy1, xy2, ground_truth = views(turn, np.random.default_rng(4))
    g = verify_pair(xy1, xy2, camera, camera, OPTIONS, RANSAC)
    assert g.config == TwoViewConfig.PANORAMIC
    assert g.is_inlier[ground_truth].mean() > 0.97
    assert g.median_angle_deg == 0.0
    np.testing.assert_array_equal(g.cam2_from_cam1[4:], 0.0)
    if camera is KNOWN:
        assert rotation_error_deg(g, turn) < 0.1


def test_a_caption_is_a_watermark() -> None:
    rng = np.random.default_rng(5)
    caption = rng.uniform([700, 720], [980, 790], (60, 2))
    wrong = rng.uniform([0, 0], [1000, 800], (2, 10, 2))
    xy1, xy2 = np.concatenate([caption, wrong[0]]), np.concatenate([caption + rng.normal(0, 0.3, (60, 2)), wrong[1]])
    assert verify_pair(xy1, xy2, KNOWN, KNOWN, OPTIONS, RANSAC).config == TwoViewConfig.WATERMARK
    # the same shift over the whole picture is none
    everywhere = rng.uniform([0, 0], [1000, 800], (200, 2))
    g = verify_pair(everywhere, everywhere + np.array([3.0, 1.0]), KNOWN, KNOWN, OPTIONS, RANSAC)
    assert g.config == TwoViewConfig.PANORAMIC


def poster(rng: np.random.Generator, num: int, shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Matches on something flat that lies over both pictures, at another place in each."""
    xy = rng.uniform([100, 100], [500, 500], (num, 2))
    return xy + rng.normal(0, 0.3, xy.shape), xy + shift + rng.normal(0, 0.3, xy.shape)


@pytest.mark.parametrize("camera", [KNOWN, UNKNOWN], ids=["known focal", "unknown focal"])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (60.0, 170.0)], ids=["at its place", "moved"])
def test_the_scene_is_found_behind_a_poster_that_most_matches_lie_on(
    camera: Camera, shift: tuple[float, float]
) -> None:
    rng = np.random.default_rng(11)
    xy1, xy2, ground_truth = views(SIDEWAYS, rng, num_wrong=60)
    flat1, flat2 = poster(rng, 2 * int(ground_truth.sum()), shift)
    g = verify_pair(np.concatenate([xy1, flat1]), np.concatenate([xy2, flat2]), camera, camera, OPTIONS, RANSAC)
    assert g.config in (TwoViewConfig.CALIBRATED, TwoViewConfig.UNCALIBRATED)
    assert g.is_inlier[: len(xy1)][ground_truth].mean() > 0.95
    assert g.is_inlier[len(xy1) :].mean() < 0.05
    assert g.num_moving_alone > 0.9 * len(flat1)
    assert rotation_error_deg(g) < (0.3 if camera is KNOWN else 8.0)


def test_a_wall_with_a_passer_by_stays_the_scene() -> None:
    rng = np.random.default_rng(12)
    wall1, wall2, _ = views(SIDEWAYS, rng, num=400, num_wrong=0, plane=True)
    depth1, depth2, in_depth = views(SIDEWAYS, rng, num=150, num_wrong=40)
    walker1, walker2 = poster(rng, 120, (40.0, 3.0))
    xy1, xy2 = (np.concatenate(parts) for parts in ((wall1, depth1, walker1), (wall2, depth2, walker2)))
    g = verify_pair(xy1, xy2, KNOWN, KNOWN, OPTIONS, RANSAC)
    assert g.num_moving_alone == 0
    assert g.is_inlier[: len(wall1) + int(in_depth.sum())].mean() > 0.95
    assert rotation_error_deg(g) < 0.3


@pytest.mark.parametrize("num", [20, 60, 200, 1000])
def test_random_matches_are_degenerate(num: int) -> None:
    for seed in range(5):
        xy1, xy2 = np.random.default_rng(seed).uniform([0, 0], [1000, 800], (2, num, 2))
        g = verify_pair(xy1, xy2, KNOWN, KNOWN, OPTIONS, RANSAC)
        assert g.config == TwoViewConfig.DEGENERATE
        assert not g.is_inlier.any()
        assert np.isnan(g.cam2_from_cam1).all()


@pytest.mark.parametrize("num", [0, 1, 7, 14])
def test_too_few_matches_are_undefined(num: int) -> None:
    xy1, xy2, _ = views(SIDEWAYS, np.random.default_rng(6), num_wrong=0)
    g = verify_pair(xy1[:num], xy2[:num], KNOWN, KNOWN, OPTIONS, RANSAC)
    assert g.config == TwoViewConfig.UNDEFINED
    assert g.is_inlier.shape == (num,)


def test_coincident_and_collinear_points_do_no_harm() -> None:
    same = np.tile([[300.0, 200.0]], (50, 1))
    line = np.stack([np.linspace(0, 900, 50), np.linspace(0, 700, 50)], 1)
    for xy1, xy2 in ((same, same), (same, line), (line, line), (line, line[::-1].copy())):
        g = verify_pair(xy1, xy2, KNOWN, UNKNOWN, OPTIONS, RANSAC)
        assert isinstance(g.config, TwoViewConfig)
        assert g.is_inlier.shape == (50,)


def test_the_same_seed_gives_the_same_answer() -> None:
    xy1, xy2, _ = views(SIDEWAYS, np.random.default_rng(7))
    first, second = (verify_pair(xy1, xy2, KNOWN, KNOWN, OPTIONS, Ransac(5000, 3)) for _ in range(2))
    for name in ("is_inlier", "fundamental", "essential", "homography", "cam2_from_cam1"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@pytest.mark.parametrize(("share", "size"), [(0.5, 4), (0.7, 7), (0.75, 5)])
def test_a_search_draws_no_more_samples_than_the_least_share_asks_for(share: float, size: int) -> None:
    trials = RANSAC.trials(share, size)
    is_right = np.random.default_rng(1).random((2000, trials, size)) < share
    missed = 1.0 - is_right.all(2).any(1).mean()
    assert missed <= 0.001  # twice as many as find a clean one with a probability of 0.999
    assert 1.0 - is_right[:, : trials // 20].all(2).any(1).mean() > 0.1
    assert RANSAC.trials(0.0, size) == RANSAC.trials(0.01, size) == RANSAC.max_trials
    assert RANSAC.trials(1.0, size) == 1


def test_a_plane_of_half_of_the_matches_is_found_from_every_seed() -> None:
    rng = np.random.default_rng(5)
    xy1, xy2, _ = views(SIDEWAYS, rng)
    h = np.array([[0.9, 0.05, 30.0], [-0.04, 1.1, -20.0], [1e-5, 2e-5, 1.0]])
    num = len(xy1)
    plane = rng.uniform(100, 700, (num, 2))
    mapped = np.c_[plane, np.ones(num)] @ h.T
    both1, both2 = np.r_[xy1, plane], np.r_[xy2, mapped[:, :2] / mapped[:, 2:]]
    for seed in range(20):
        _, inlier = plane_of_matches(both1, both2, np.ones(2 * num, bool), 2.0, Ransac(5000, seed), PLANE_SHARE)
        assert inlier[num:].all()


def test_threshold_scales_with_the_image_within_bounds() -> None:
    def threshold(width: int, height: int) -> float:
        camera = simple_camera(CameraModel.PINHOLE, width, height, 1.2 * width)
        return error_threshold_px(camera, camera, OPTIONS)

    assert threshold(320, 240) == 2.0
    assert threshold(1600, 1200) == 4.0  # COLMAP's, at two megapixels
    assert threshold(8000, 6000) == 8.0
    assert error_threshold_px(KNOWN, KNOWN, MatchingOptions(max_error_px=1.5)) == 1.5


def test_significance_asks_more_of_more_matches() -> None:
    def fewest(num: int) -> int:
        return next(k for k in range(8, num + 1) if is_significant(np.arange(num) < k, 3.0, (1000, 800)))

    assert fewest(20) < fewest(60) < fewest(200) < fewest(1000)
    assert fewest(1000) < 100
    assert not is_significant(np.ones(7, bool), 3.0, (1000, 800))


@pytest.mark.parametrize("num_wrong", [30, 150, 400])
def test_it_finds_what_colmap_finds(num_wrong: int) -> None:
    import pycolmap

    kinds = {
        pycolmap.TwoViewGeometryConfiguration.CALIBRATED: TwoViewConfig.CALIBRATED,
        pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC: TwoViewConfig.PLANAR,
    }
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=[900, 500, 400, 0])
    camera.has_prior_focal_length = True
    for plane in (False, True):
        xy1, xy2, ground_truth = views(SIDEWAYS, np.random.default_rng(8), num_wrong=num_wrong, plane=plane)
        index = np.stack([np.arange(len(xy1))] * 2, 1).astype(np.uint32)
        theirs = pycolmap.estimate_calibrated_two_view_geometry(camera, xy1, camera, xy2, index)
        ours = verify_pair(xy1, xy2, KNOWN, KNOWN, OPTIONS, RANSAC)
        assert kinds[theirs.config] == ours.config
        mask = np.zeros(len(xy1), bool)
        mask[theirs.inlier_matches[:, 0]] = True
        assert ours.is_inlier[ground_truth].sum() >= 0.97 * mask[ground_truth].sum()
        # chance inliers: no more than COLMAP lets in, give or take a few
        assert ours.is_inlier[~ground_truth].sum() <= mask[~ground_truth].sum() + 0.03 * num_wrong + 2
