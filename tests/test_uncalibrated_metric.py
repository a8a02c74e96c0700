"""Projective models made metric: by known points, and by one camera for all photographs."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.errors import NoReconstructionError
from sfmapp.geometry import similarity
from sfmapp.geometry.absolute_conic import NoMetricFrameError
from sfmapp.geometry.projective import dehomogenized, project
from sfmapp.geometry.projective_adjustment import sightings_of
from sfmapp.geometry.upgrade import place_covariances
from sfmapp.uncalibrated.known_places import KnownFrame, upgrade_by_known_points
from sfmapp.uncalibrated.metric import upgrade_by_self_calibration
from sfmapp.uncalibrated.projective_model import ProjectiveReconstruction, reconstruct_projective
from uncalibrated_scenes import K, Scene, scene

SIZE = (1024, 768)


def _projective(one: Scene) -> ProjectiveReconstruction:
    return reconstruct_projective(sightings_of(one.xy), one.xy.shape[1])


def test_one_camera_makes_the_model_metric_with_a_sigma_that_holds() -> None:
    z = []
    for seed in range(6):
        one = scene(8, 80, seed=seed, noise=0.5)
        found = _projective(one)
        metric = upgrade_by_self_calibration(found, [f"{n}.jpg" for n in range(8)], SIZE)
        z.append((metric.focal_px - K[0, 0]) / metric.focal_sigma_px)
        assert metric.focal_sigma_px < 5.0
        assert metric.motion == ""
        assert metric.warnings == ()
        assert 0.4 < metric.rms_px < 0.55
        xyz, true = metric.reconstruction.point_xyz, one.xyz[found.point_idx]
        to_true = similarity.umeyama(xyz, true)
        assert np.sqrt(((similarity.apply(to_true, xyz) - true) ** 2).mean()) < 0.01
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 2.0


def test_a_turntable_is_warned_of_and_no_turns_are_refused() -> None:
    table = upgrade_by_self_calibration(
        _projective(scene(8, 80, noise=0.3, turntable=True)), [f"{n}.jpg" for n in range(8)], SIZE
    )
    assert "one axis" in table.motion
    assert any("neither can be checked" in warning for warning in table.warnings)
    with pytest.raises(NoMetricFrameError, match="without turning"):
        upgrade_by_self_calibration(
            _projective(scene(6, 80, turn=1e-9, noise=0.3)), [f"{n}.jpg" for n in range(6)], SIZE
        )


def test_known_points_bring_the_model_to_the_world_and_wrong_ones_are_named() -> None:
    one = scene(6, 80, seed=2, noise=0.3)
    found = _projective(one)
    known = np.arange(10)
    xyz = 3.0 * one.xyz[known] + [10.0, 20.0, 5.0]
    xyz[4] += [0.0, 2.0, 0.0]
    xy = one.xy[known].copy()
    xy[3, 1:] = np.nan
    names = [f"p{n}" for n in known]
    frame = upgrade_by_known_points(found, names, xyz, xy)
    used = [point.is_used for point in frame.points]
    assert used == [n not in (3, 4) for n in known]
    assert frame.points[3].num_images == 1
    assert frame.points[4].distance == pytest.approx(2.0, rel=0.1)
    gap = dehomogenized(found.model.points @ frame.frame.T) - (3.0 * one.xyz[found.point_idx] + [10.0, 20.0, 5.0])
    assert np.sqrt((gap**2).mean()) < 0.03
    assert 0.0 < np.median(np.sqrt(np.linalg.eigvalsh(_covariances(frame, found))[:, -1])) < 0.03


def _covariances(frame: KnownFrame, found: ProjectiveReconstruction) -> np.ndarray:
    covariances = frame.covariances_of(found)
    assert covariances is not None
    return covariances


@pytest.mark.parametrize(("num_known", "sigma"), [(8, 0.0), (12, 0.0), (24, 0.0), (24, 0.004)])
def test_what_is_said_of_places_and_cameras_by_known_points_holds(num_known: int, sigma: float) -> None:
    """Squared errors over what is said, per coordinate: one where it is right. Points of the model have the noise of
    their own pixels beside what the frame leaves open: without it they would be 2.0 to 6.0."""
    of_points, of_cameras, told = [], [], []
    for seed in range(12):
        one = scene(6, 120, seed=seed, noise=0.3)
        found = _projective(one)
        known = np.arange(num_known)
        given = one.xyz[known] + sigma * np.random.default_rng(seed).standard_normal((num_known, 3))
        frame = upgrade_by_known_points(found, [str(n) for n in known], given, one.xy[known])
        other = found.point_idx >= num_known
        gap = (dehomogenized(found.model.points @ frame.frame.T) - one.xyz[found.point_idx])[other]
        of_points.append(_normalised(gap, _covariances(frame, found)[other]))
        centers = np.linalg.svd(found.model.cameras)[2][:, 3]
        true = dehomogenized(np.linalg.svd(one.cameras[found.view_idx])[2][:, 3])
        assert frame.covariance is not None
        of_frame = place_covariances(frame.frame, frame.covariance, centers)
        of_cameras.append(_normalised(dehomogenized(centers @ frame.frame.T) - true, of_frame))
        told.append(frame.sigma)
    assert 0.7 < np.mean(of_points) < 1.4
    # twelve frames of fifteen numbers; the noise of the cameras themselves is not in it
    assert 0.6 < np.mean(of_cameras) < 2.0
    # beyond the marks, which a quarter of the noise of 0.3 px in a space of five units over 900 px may be taken for
    assert np.median(told) == pytest.approx(sigma, rel=0.15, abs=0.0004)


def _normalised(left: np.ndarray, covariances: np.ndarray) -> float:
    """Mean squared error (N, 3) over its covariance, per coordinate."""
    return float(np.einsum("ni,nij,nj->n", left, np.linalg.inv(covariances), left).mean()) / 3.0


def test_known_points_far_behind_the_others_count_as_firmly_as_they_stand() -> None:
    """Noise along the rays grows by the square of the distance: it makes no point wrong, and a wrong one is found."""
    num_right = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        one = scene(6, 120, seed=seed)
        xyz = one.xyz.copy()
        xyz[:8] = xyz[:8] * [3.0, 3.0, 2.0] + [0.0, 0.0, 14.0]
        xy = project(one.cameras, np.c_[xyz, np.ones(len(xyz))])
        xy += 0.3 * rng.standard_normal(xy.shape)
        found = reconstruct_projective(sightings_of(xy), 6)
        known = np.arange(24)
        given = xyz[known].copy()
        given[20] += [0.0, 0.05, 0.0]
        frame = upgrade_by_known_points(found, [str(n) for n in known], given, xy[known])
        used = np.array([point.is_used for point in frame.points])
        assert not used[20]
        num_right += int(used.sum())
    # 1.2 in 100 right ones are lost
    assert num_right >= 0.95 * 8 * 23


def test_too_few_known_points_and_those_of_a_plane_are_refused() -> None:
    one = scene(4, 80, noise=0.3)
    found = _projective(one)
    with pytest.raises(NoReconstructionError, match="found 4 of 4"):
        upgrade_by_known_points(found, list("abcd"), one.xyz[:4], one.xy[:4])
    # on one plane, to a hundredth of its size
    flat = one.xyz[np.argsort(np.abs(one.xyz[:, 2]))[:8]]
    xy = one.xy[np.argsort(np.abs(one.xyz[:, 2]))[:8]]
    with pytest.raises(NoReconstructionError, match="one plane"):
        upgrade_by_known_points(found, list("abcdefgh"), flat * [1, 1, 0], xy)
