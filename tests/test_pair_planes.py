"""Planes that two views see, against scenes whose planes are known."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.fundamental_refinement import polish_fundamental
from sfmapp.geometry.homography import motions_from_homography
from sfmapp.geometry.pair_plane import find_planes, fit_plane
from sfmapp.matching.search import Ransac, find_homography, find_relative_pose
from sfmapp.twoview.planes import look_of

Array = NDArray[np.float64]

FOCAL, NOISE_PX, THRESHOLD_PX = 1000.0, 0.4, 2.0
POSE = rigid3.from_matrix(rigid3.exp_so3(np.array([0.03, -0.12, 0.02])), np.array([0.95, 0.05, 0.3]))
POSE[4:] /= np.linalg.norm(POSE[4:])
# of a wall ahead and a floor: normals away from camera 1, and distances in baselines
WALL, FLOOR = (np.array([0.2, 0.0, 0.98]), 7.0), (np.array([0.0, 0.97, 0.24]), 2.2)


def on_plane(plane: tuple[Array, float], xn: Array) -> Array:
    normal, distance = plane
    rays = np.column_stack([xn, np.ones(len(xn))])
    return rays * (distance / (rays @ (normal / np.linalg.norm(normal))))[:, None]


def seen(xyz: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pixels about the principal point in both views, with noise."""
    moved = rigid3.apply(POSE, xyz)
    flat = [FOCAL * each[:, :2] / each[:, 2:] for each in (xyz, moved)]
    return flat[0] + rng.normal(0, NOISE_PX, flat[0].shape), flat[1] + rng.normal(0, NOISE_PX, flat[1].shape)


def search(a: Array, b: Array) -> Array | None:
    return find_homography(a, b, THRESHOLD_PX, Ransac(2000, 1))


def room(rng: np.random.Generator) -> tuple[Array, Array]:
    """500 points on the wall, 250 on the floor, 150 anywhere between: places, and whose they are."""
    wall = on_plane(WALL, rng.uniform([-0.5, -0.4], [0.5, 0.15], (500, 2)))
    floor = on_plane(FLOOR, rng.uniform([-0.5, 0.2], [0.5, 0.45], (250, 2)))
    xn = rng.uniform([-0.5, -0.4], [0.5, 0.2], (150, 2))
    clutter = np.column_stack([xn, np.ones(150)]) * rng.uniform(2.5, 6.0, (150, 1))
    return np.concatenate([wall, floor, clutter]), np.repeat([0, 1, -1], [500, 250, 150])


def test_two_planes_among_other_things() -> None:
    pulls = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        xyz, truth = room(rng)
        xy1, xy2 = seen(xyz, rng)
        found = list(find_planes(xy1, xy2, THRESHOLD_PX, search))
        assert len(found) == 2
        for n, ((_, mask), plane) in enumerate(zip(found, (WALL, FLOOR), strict=True)):
            assert mask[truth == n].mean() > 0.9
            assert (truth[mask] == n).mean() > 0.94  # of what stands before a wall, some is near it by chance
            right = mask & (truth == n)
            fit = fit_plane(POSE, xy1[right] / FOCAL, xy2[right] / FOCAL)
            assert fit is not None
            normal = plane[0] / np.linalg.norm(plane[0])
            off = math.acos(min(float(fit.normal @ normal), 1.0))
            pulls.append([off / fit.normal_sigma, (fit.distance - plane[1]) / fit.distance_sigma])
            # the noise of both pictures is left in one
            assert 0.8 * NOISE_PX * math.sqrt(2.0) < fit.rms * FOCAL < 2.0 * NOISE_PX * math.sqrt(2.0)
    of_normal, of_distance = np.array(pulls).T
    assert np.median(of_normal) < 2.0
    assert of_normal.max() < 4.0
    assert 0.4 < math.sqrt(np.mean(of_distance**2)) < 1.8


def test_no_plane_in_a_cloud() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        xn = rng.uniform(-0.5, 0.5, (600, 2))
        xyz = np.column_stack([xn, np.ones(600)]) * rng.uniform(2.5, 9.0, (600, 1))
        assert not list(find_planes(*seen(xyz, rng), THRESHOLD_PX, search))


def test_one_plane_allows_two_motions_and_a_second_decides() -> None:
    rng = np.random.default_rng(3)
    xyz, truth = room(rng)
    xy1, xy2 = seen(xyz, rng)
    k = np.diag([FOCAL, FOCAL, 1.0])
    allowed = []
    for h, mask in find_planes(xy1, xy2, THRESHOLD_PX, search):
        possible = motions_from_homography(h, k, k).possible(xy1[mask] / FOCAL)
        assert len(possible.poses) == 2
        allowed.append(possible.poses)
    gaps = [
        rigid3.rotation_angle_deg(rigid3.rotation_matrix(a) @ rigid3.rotation_matrix(b).T)
        for a in allowed[0] for b in allowed[1]
    ]  # fmt: skip
    best = allowed[0][int(np.argmin(gaps)) // 2]
    assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(best) @ rigid3.rotation_matrix(POSE).T) < 0.5
    assert sorted(gaps)[1] > 2.0  # the other combinations do not agree
    assert (truth >= -1).all()


def test_what_planes_look_like() -> None:
    assert look_of(WALL[0] / np.linalg.norm(WALL[0])) == "facing the camera"
    assert look_of(FLOOR[0]) == "floor"
    assert look_of(np.array([0.95, 0.1, 0.3])) == "wall on the right"
    # what grows to the right comes nearer to the right
    xyz = on_plane((np.array([0.6, 0.0, 0.8]), 5.0), np.array([[-0.3, 0.0], [0.3, 0.0]]))
    assert xyz[0, 2] > xyz[1, 2]
    assert look_of(np.array([0.6, 0.0, 0.8])) == "slanting, farther at the left"


def test_a_plane_alone_leaves_one_of_its_two_motions() -> None:
    """Half of the matches wrong, all right ones on a plane: F is open, the pose one of two."""
    rng = np.random.default_rng(5)
    xyz = on_plane(WALL, rng.uniform(-0.5, 0.5, (400, 2)))
    xy1, xy2 = seen(xyz, rng)
    xy2[:200] = rng.uniform(-500.0, 500.0, (200, 2))
    pose = find_relative_pose(xy1 / FOCAL, xy2 / FOCAL, THRESHOLD_PX / FOCAL, Ransac(5000, 0))
    assert pose is not None
    normal = WALL[0] / np.linalg.norm(WALL[0])
    h = rigid3.rotation_matrix(POSE) + np.outer(POSE[4:], normal) / WALL[1]
    possible = motions_from_homography(h, np.eye(3), np.eye(3)).possible(xy1[200:] / FOCAL).poses
    turns = [rigid3.rotation_angle_deg(rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(p).T) for p in possible]
    assert min(turns) < 1.0


def test_polishing_loses_an_inlier_for_a_better_fit() -> None:
    """The sum of truncated errors never grows, and F comes nearer to exact points than its eight were."""
    from sfmapp.geometry import epipolar
    from sfmapp.geometry.fundamental import fundamental_from_points

    gains = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        xyz, _ = room(rng)
        xy1, xy2 = seen(xyz, rng)
        exact = FOCAL * xyz[:, :2] / xyz[:, 2:], FOCAL * (m := rigid3.apply(POSE, xyz))[:, :2] / m[:, 2:]
        few = rng.choice(len(xyz), 30, replace=False)
        start = fundamental_from_points(xy1[few], xy2[few])
        f, inlier = polish_fundamental(start, xy1, xy2, THRESHOLD_PX)
        sums = [np.minimum(epipolar.sampson_errors(e, xy1, xy2), THRESHOLD_PX**2).sum() for e in (start, f)]
        assert sums[1] <= sums[0]
        assert (inlier == (epipolar.sampson_errors(f, xy1, xy2) < THRESHOLD_PX**2)).all()
        before, after = (np.sqrt(epipolar.sampson_errors(e, *exact).mean()) for e in (start, f))
        gains.append(after / before)
    assert np.median(gains) < 0.6


def test_the_kernel_refines_f_as_the_algebra_does() -> None:
    from sfmapp.geometry import epipolar
    from sfmapp.geometry.fundamental import fundamental_from_points, refine_fundamental
    from sfmapp.geometry.fundamental_refinement import refine_fundamental_on_inliers

    rng = np.random.default_rng(3)
    xyz, _ = room(rng)
    xy1, xy2 = seen(xyz[:200], rng)
    start = fundamental_from_points(xy1, xy2)
    theirs, _ = refine_fundamental(start, xy1, xy2)
    ours, cost = refine_fundamental_on_inliers(start, xy1, xy2, 1e4, rounds=2)
    # along the valley it stops a millionth above the bottom
    errors = epipolar.sampson_errors(theirs, xy1, xy2)
    assert 1.0 - 1e-9 < cost / errors.sum() < 1.0 + 1e-5
    np.testing.assert_allclose(epipolar.sampson_errors(ours, xy1, xy2), errors, atol=0.02)


def test_heavy_tails_bend_the_loss() -> None:
    """A fifth of the keypoints four times as far off: F is nearer to exact points than squares take it; where noise is
    normal, squares it is, to the last digit."""
    from sfmapp.geometry import epipolar
    from sfmapp.geometry.fundamental import fundamental_from_points
    from sfmapp.geometry.fundamental_refinement import refine_fundamental_on_inliers

    gains = []
    for seed in range(12):
        rng = np.random.default_rng(200 + seed)
        xyz, _ = room(rng)
        xy1, xy2 = seen(xyz, rng)
        exact = FOCAL * xyz[:, :2] / xyz[:, 2:], FOCAL * (m := rigid3.apply(POSE, xyz))[:, :2] / m[:, 2:]
        start = fundamental_from_points(*exact)
        for is_far in (np.zeros(len(xyz), np.bool_), rng.permutation(len(xyz)) < len(xyz) // 5):
            far1, far2 = (x + (1.0 + 3.0 * is_far)[:, None] * (xy - x) for x, xy in zip(exact, (xy1, xy2), strict=True))
            polished, _ = polish_fundamental(start, far1, far2, 4.0 * THRESHOLD_PX, seed)
            squares, _ = refine_fundamental_on_inliers(start, far1, far2, 4.0 * THRESHOLD_PX, rounds=8)
            errors = [np.sqrt(epipolar.sampson_errors(e, *exact).mean()) for e in (polished, squares)]
            if is_far.any():
                gains.append(errors[0] / errors[1])
            else:
                assert abs(errors[0] / errors[1] - 1.0) < 0.02
    # of noise that is four times as large in a fifth, Cauchy's loss at 2.4 sigmas keeps 0.6 to 0.7 of the error
    assert 0.45 < np.exp(np.mean(np.log(gains))) < 0.85


def test_samples_lead_past_the_wrong_matches_that_an_f_was_bent_by() -> None:
    """Half of the matches wrong, a start that fits a few of them: no worse than from the best that can be known."""
    from sfmapp.geometry import epipolar
    from sfmapp.geometry.fundamental import fundamental_from_points, refine_fundamental

    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        xyz, _ = room(rng)
        xy1, xy2 = seen(xyz, rng)
        exact = FOCAL * xyz[:, :2] / xyz[:, 2:], FOCAL * (m := rigid3.apply(POSE, xyz))[:, :2] / m[:, 2:]
        right = rng.permutation(len(xyz)) < len(xyz) // 2
        xy2[~right] = rng.uniform(-400.0, 400.0, (int((~right).sum()), 2))
        bent = np.concatenate([rng.choice(np.flatnonzero(right), 20), rng.choice(np.flatnonzero(~right), 2)])
        start = fundamental_from_points(xy1[right], xy2[right])
        near = np.concatenate([np.flatnonzero(right)[:60], bent])
        f, _ = polish_fundamental(fundamental_from_points(xy1[near], xy2[near]), xy1, xy2, THRESHOLD_PX, seed)
        best, _ = refine_fundamental(start, xy1[right], xy2[right])
        errors = [np.sqrt(epipolar.sampson_errors(e, *exact).mean()) for e in (f, best)]
        ratios.append(errors[0] / errors[1])
    assert 0.8 < np.median(ratios) < 1.6


def test_f_tells_a_focal_length_that_nothing_is_known_of() -> None:
    """Within its sigma, principal points off by five pixels; a focal length that is known stays."""
    from dataclasses import replace

    from sfmapp.camera.camera import simple_camera
    from sfmapp.camera.names import CameraModel
    from sfmapp.geometry.fundamental import fundamental_from_points
    from sfmapp.scene.features import Features
    from sfmapp.twoview.focal import with_told_focal
    from sfmapp.twoview.view import View

    pulls = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        xyz, _ = room(rng)
        turned = rigid3.from_matrix(rigid3.exp_so3(np.array([0.2, -0.25, 0.1])), POSE[4:] * 2.0)
        moved = rigid3.apply(turned, xyz)
        center = np.array([600.0, 450.0]) + rng.uniform(-5.0, 5.0, 2)
        sides = [FOCAL * each[:, :2] / each[:, 2:] + center + rng.normal(0, 0.2, (900, 2)) for each in (xyz, moved)]
        guess = simple_camera(CameraModel.SIMPLE_RADIAL, 1200, 900, 1440.0, 720.0, "default")
        views = tuple(
            View(
                name,
                guess,
                Features(
                    np.column_stack([xy, np.ones((900, 2))]),
                    np.zeros((900, 128), np.uint8),
                    np.zeros((900, 3), np.uint8),
                ),
            )
            for name, xy in zip("ab", sides, strict=True)
        )
        matches = np.column_stack([np.arange(900, dtype=np.int32)] * 2)
        f = fundamental_from_points(*(np.asarray(view.xy, np.float64) for view in views))
        told = with_told_focal((views[0], views[1]), matches, f)[0].camera
        assert told.focal_source == "photographs"
        assert told.focal_sigma is not None
        pulls.append((told.focal - FOCAL) / told.focal_sigma)
        known = tuple(replace(view, camera=replace(guess, focal_source="user")) for view in views)
        assert with_told_focal((known[0], known[1]), matches, f)[0].camera.focal == 1440.0
    assert max(map(abs, pulls)) < 3.0
    assert told.focal_sigma < 0.15 * FOCAL
