"""The trifocal tensor, and transfer to a third view with and without it."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import rigid3
from sfmapp.geometry.fundamental import eight_point, refine_fundamental
from sfmapp.geometry.projective import project
from sfmapp.geometry.trifocal import (
    cameras_of,
    crossing_angles,
    epipoles_of,
    fit_trifocal,
    fundamentals_of,
    refine_trifocal,
    transfer_by_lines,
    transfer_by_tensor,
    transfer_line,
    trifocal_of,
)
from sfmapp.geometry.two_rays import fundamental_of
from uncalibrated_scenes import K, distance, scene


def test_the_tensor_knows_cameras_epipoles_and_fundamental_matrices() -> None:
    one = scene(3)
    tensor = trifocal_of(one.cameras)
    f21, f31 = fundamentals_of(tensor)
    assert distance(f21, fundamental_of(one.cameras[0], one.cameras[1])) < 1e-9
    assert distance(f31, fundamental_of(one.cameras[0], one.cameras[2])) < 1e-9
    center = np.linalg.svd(one.cameras[0])[2][3]
    for e, p in zip(epipoles_of(tensor), one.cameras[1:], strict=True):
        assert distance(e, p @ center) < 1e-9
    again = cameras_of(tensor)
    assert distance(trifocal_of(again), tensor) < 1e-9
    assert distance(fundamental_of(again[1], again[2]), fundamental_of(one.cameras[1], one.cameras[2])) < 1e-8
    # incidences of a point and of a line
    x = one.points @ one.cameras[0].T
    line2, line3 = (np.cross(a, b) for a, b in ((one.points[:1] @ p.T, one.points[1:2] @ p.T) for p in one.cameras[1:]))
    assert abs(np.einsum("i,j,k,ijk", x[0], line2[0], line3[0], tensor)) < 1e-9 * np.linalg.norm(x[0]) * np.linalg.norm(
        line2
    ) * np.linalg.norm(line3)
    line1 = transfer_line(tensor, line2, line3)
    assert np.abs(line1 @ (x[:2] / x[:2, 2:]).T).max() < 1e-6


def test_seven_points_are_enough_and_noise_is_held_by_what_is_told() -> None:
    exact = scene(3, 7)
    tensor, info = fit_trifocal(*exact.xy.swapaxes(0, 1))
    assert info.num_free == 1
    assert distance(tensor, trifocal_of(exact.cameras)) < 1e-7
    errors = []
    for seed in range(8):
        noisy, true = scene(3, 40, seed=seed, noise=0.5), scene(3, 40, seed=seed)
        linear, _ = fit_trifocal(*noisy.xy.swapaxes(0, 1))
        best, told = refine_trifocal(linear, *noisy.xy.swapaxes(0, 1))
        assert 0.35 < told.sigma_px < 0.65
        errors.append([
            np.sqrt(((transfer_by_tensor(t, true.xy[:, 0], true.xy[:, 1]).xy - true.xy[:, 2]) ** 2).mean())
            for t in (linear, best)
        ])  # fmt: skip
    rms = np.sqrt((np.array(errors) ** 2).mean(0))
    # 40 points times two coordinates bear on 18 numbers
    assert rms[1] < rms[0]
    assert 0.5 * 0.5 * np.sqrt(18 / 120) < rms[1] < 2.5 * 0.5 * np.sqrt(18 / 120)


def test_covariance_of_a_transfer_is_what_noise_does() -> None:
    true, noisy = scene(3, 400, seed=2), scene(3, 400, seed=2, noise=0.4)
    tensor = trifocal_of(true.cameras)
    f31, f32 = (fundamental_of(true.cameras[n], true.cameras[2]) for n in (0, 1))
    for told in (
        transfer_by_tensor(tensor, noisy.xy[:, 0], noisy.xy[:, 1], noise_px=0.4),
        transfer_by_lines(f31, f32, noisy.xy[:, 0], noisy.xy[:, 1], noise_px=0.4),
    ):
        gap = (told.xy - true.xy[:, 2])[told.is_told]
        nees = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(told.covariance[told.is_told]), gap).mean() / 2.0
        assert 0.85 < nees < 1.2


def test_covariance_of_fundamental_matrices_is_in_that_of_the_lines() -> None:
    ratios = []
    for seed in range(6):
        true, noisy = scene(3, 60, seed=seed), scene(3, 60, seed=seed, noise=0.4)
        fits = [
            refine_fundamental(eight_point(noisy.xy[:, n], noisy.xy[:, 2])[0], noisy.xy[:, n], noisy.xy[:, 2])
            for n in (0, 1)
        ]
        covariances = tuple(info.covariance for _, info in fits)
        # exact pixels: what is left is the error of both F alone
        told = transfer_by_lines(
            fits[0][0], fits[1][0], true.xy[:, 0], true.xy[:, 1], covariances=covariances, noise_px=1e-3,  # type: ignore[arg-type]
            limit_sigmas=1e4,
        )  # fmt: skip
        gap = (told.xy - true.xy[:, 2])[told.is_told]
        ratios.append(np.einsum("ni,nij,nj->n", gap, np.linalg.inv(told.covariance[told.is_told]), gap).mean() / 2.0)
    assert 0.4 < np.mean(ratios) < 1.8


def _collinear_centers() -> tuple[np.ndarray, np.ndarray]:
    """Three cameras that moved along a line without turning: every point is in a trifocal plane."""
    cameras = np.array([K @ np.column_stack([np.eye(3), [-0.4 * v, -0.1 * v, 5.0]]) for v in range(3)])
    return cameras, project(cameras, scene(3).points)


def test_the_trifocal_plane_is_refused_by_lines_and_not_by_the_tensor() -> None:
    cameras, xy = _collinear_centers()
    f31, f32 = (fundamental_of(cameras[n], cameras[2]) for n in (0, 1))
    told = transfer_by_lines(f31, f32, xy[:, 0], xy[:, 1])
    assert not told.is_told.any()
    assert crossing_angles(f31, f32, xy[:, 0], xy[:, 1]).max() < 1e-6
    tensor, _ = fit_trifocal(*xy.swapaxes(0, 1))
    told = transfer_by_tensor(tensor, xy[:, 0], xy[:, 1])
    assert told.is_told.all()
    assert np.abs(told.xy - xy[:, 2]).max() < 1e-6


def test_what_lies_in_the_trifocal_plane_of_a_general_triple_is_named() -> None:
    turns = [rigid3.exp_so3(w) for w in ([0, -0.46, 0], [0, 0.46, 0], [0, 0, 0])]
    centers = np.array([[-2.0, 0, -4], [2.0, 0, -4], [0.0, 0, -6]])
    cameras = np.array([K @ np.column_stack([r, -r @ c]) for r, c in zip(turns, centers, strict=True)])
    points = scene(3, 200).points
    xy = project(cameras, points)
    f31, f32 = (fundamental_of(cameras[n], cameras[2]) for n in (0, 1))
    told = transfer_by_lines(f31, f32, xy[:, 0], xy[:, 1])
    angles = crossing_angles(f31, f32, xy[:, 0], xy[:, 1])
    # the plane y = 0 has all three centres: below it and above points are told, on it they are not
    assert not told.is_told[np.abs(points[:, 1]) < 0.03].any()
    assert told.is_told[np.abs(points[:, 1]) > 0.6].all()
    assert angles[told.is_told].min() > angles[~told.is_told].min()
    assert np.abs(told.xy - xy[:, 2])[told.is_told].max() < 1e-6


def test_the_formula_of_the_literature_is_ours_with_its_indices_read_from_right_to_left() -> None:
    # m'' ~ F13 m x F23 m': their F13 is what takes a point of picture 1 to picture 3, which is written F31 here
    one = scene(3)
    f31, f32 = (fundamental_of(one.cameras[n], one.cameras[2]) for n in (0, 1))
    m1, m2 = (np.append(one.xy[5, n], 1.0) for n in (0, 1))
    m3 = np.cross(f31 @ m1, f32 @ m2)
    assert np.allclose(m3[:2] / m3[2], one.xy[5, 2])
    assert np.allclose(transfer_by_lines(f31, f32, one.xy[5:6, 0], one.xy[5:6, 1]).xy, one.xy[5:6, 2])


def test_bad_input_is_answered() -> None:
    one = scene(3, 20)
    a, b, c = one.xy.swapaxes(0, 1)
    with pytest.raises(ValueError, match="at least 7"):
        fit_trifocal(a[:6], b[:6], c[:6])
    with pytest.raises(ValueError, match="three arrays"):
        fit_trifocal(a, b, c[:5])
    bad = b.copy()
    bad[2, 0] = np.nan
    with pytest.raises(ValueError, match="the first is 2"):
        fit_trifocal(a, bad, c)
    flat = one.points.copy()
    flat[:, 2] = 0.2
    assert fit_trifocal(*project(one.cameras, flat).swapaxes(0, 1))[1].num_free > 1
    on_line = np.c_[np.outer(np.linspace(-1, 1, 20), [1, 1, 1]), np.ones(20)]
    assert fit_trifocal(*project(one.cameras, on_line).swapaxes(0, 1))[1].num_free > 1
    # one picture three times
    assert fit_trifocal(a, a, a)[1].num_free > 1
    with pytest.raises(ValueError, match="three finite cameras"):
        trifocal_of(one.cameras[:2])
