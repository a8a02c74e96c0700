"""Projective models made metric: by known points, and by one camera for all photographs."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.errors import NoReconstructionError
from sfmapp.geometry import similarity
from sfmapp.geometry.absolute_conic import NoMetricFrameError
from sfmapp.geometry.projective import dehomogenized
from sfmapp.geometry.projective_adjustment import sightings_of
from sfmapp.uncalibrated.known_places import upgrade_by_known_points
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
    sigmas = frame.sigmas_of(found.model.points)
    assert sigmas is not None
    assert 0.0 < np.median(sigmas) < 0.03


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
