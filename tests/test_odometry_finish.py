"""The last word on a map: covariances that are as large as the errors, and calibrations that are questioned."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import odometry_sequences as played
from inertial_flights import CAMERA as FLIGHT_CAMERA
from inertial_flights import SCALE, Flight, seen_map, true_map
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.scale import ScaleEstimate, ScaleRefusal
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.refinement.final_adjustment import _left_open, adjust_finally
from sfmapp.scene.rig import Rig
from sfmapp.scene.synthetic import make_scene, synthetic_rig

OPTIONS = OdometryOptions()
CAMERA = simple_camera(CameraModel.PINHOLE, 640, 480, 525.0)


def small_map(seed: int, rig: Rig, *, num_keyframes: int = 8, num_points: int = 150, sigma_px: float = 0.3,
              outlier_ratio: float = 0.0) -> tuple[KeyframeMap, np.ndarray]:  # fmt: skip
    """A map with independent noise, and the true poses of its keyframes."""
    num_sensors = len(rig.cameras)
    arguments = {"rig": rig} if num_sensors > 1 else {"cameras": rig.cameras[0]}
    scene = make_scene(
        seed, num_sensors * num_keyframes, num_points, sigma_px=sigma_px, layout="forward",
        outlier_ratio=outlier_ratio, **arguments,
    )  # fmt: skip
    return played.keyframe_map(scene, rig), scene.ground_truth.cam_from_world[::num_sensors]


@pytest.mark.parametrize(("num_sensors", "num_freedoms"), [(1, 7), (2, 6)])
def test_normalised_errors_are_one_under_independent_noise(num_sensors: int, num_freedoms: int) -> None:
    rig = Rig.single(CAMERA) if num_sensors == 1 else synthetic_rig()
    options, values = replace(OPTIONS, refine_camera=False), []
    for seed in range(40):
        keyframes, ground_truth = small_map(seed, rig)
        final = adjust_finally(keyframes, options, Events())
        assert final.covariance is not None
        ours = np.array([k.rig_from_world for k in keyframes.keyframes])
        errors = played.gauge_errors(ours, ground_truth, num_freedoms)
        values.append(played.normalized_errors(errors, final.covariance).mean())
    assert 0.8 < np.mean(values) < 1.25
    assert final.gauge == "centroid, mean rotation" + (" and spread" if num_sensors == 1 else "")


def test_noise_and_covariance_have_the_size_of_what_was_drawn() -> None:
    small, large = (small_map(0, Rig.single(CAMERA), sigma_px=sigma)[0] for sigma in (0.2, 0.6))
    options = replace(OPTIONS, refine_camera=False)
    one, other = adjust_finally(small, options, Events()), adjust_finally(large, options, Events())
    assert 0.15 < one.report["sigma_px"] < 0.22
    assert 0.45 < other.report["sigma_px"] < 0.66
    assert one.covariance is not None
    assert other.covariance is not None
    traces = [np.trace(c.covariance, axis1=1, axis2=2).mean() for c in (one, other)]
    assert 6.0 < traces[1] / traces[0] < 13.0


def test_a_keyframe_without_points_has_no_covariance_and_the_others_keep_theirs() -> None:
    keyframes, _ = small_map(1, Rig.single(CAMERA), num_keyframes=8)
    whole = adjust_finally(small_map(1, Rig.single(CAMERA), num_keyframes=8)[0], OPTIONS, Events()).covariance
    blind = keyframes.keyframes[4]
    blind.is_inlier[:] = False
    blind.xy[:] = 1e6  # nowhere near: the last word must not take them back
    found = adjust_finally(keyframes, OPTIONS, Events()).covariance
    assert whole is not None
    assert found is not None
    assert np.isnan(found[4]).all()
    others = np.arange(8) != 4
    assert np.isfinite(found[others]).all()
    ratio = np.trace(found[others], axis1=1, axis2=2) / np.trace(whole[others], axis1=1, axis2=2)
    assert (ratio > 0.3).all()  # each in its own place, about as sure as before
    assert (ratio < 30).all()


@pytest.mark.parametrize(("num_sensors", "sigma_px"), [(1, 0.1), (2, 0.3)])
def test_a_wrong_focal_length_is_found_and_corrected(num_sensors: int, sigma_px: float) -> None:
    rig = Rig.single(CAMERA) if num_sensors == 1 else synthetic_rig()
    keyframes, _ = small_map(3, rig, num_keyframes=14, num_points=600, sigma_px=sigma_px)
    wrong = tuple(replace(c, params=c.params * [1.02, 1.02, 1, 1]) for c in rig.cameras)
    keyframes.rig = Rig(wrong, rig.cam_from_rig)
    report = adjust_finally(keyframes, OPTIONS, Events()).report["camera"]
    assert report["is_refined"]
    # a rig may turn as well: so few keyframes leave more to the prior, which sits at the wrong focal length
    limit = 0.004 if num_sensors == 1 else 0.006
    for camera, right, change in zip(keyframes.rig.cameras, rig.cameras, report["focal_change"], strict=True):
        assert camera.focal == pytest.approx(right.focal, rel=limit)
        assert change == pytest.approx(1 / 1.02 - 1, abs=limit)


@pytest.mark.parametrize("seed", range(4))
def test_a_right_calibration_is_left_alone(seed: int) -> None:
    rig = Rig.single(CAMERA) if seed % 2 else synthetic_rig()
    keyframes, _ = small_map(seed, rig, num_keyframes=10, num_points=400, outlier_ratio=0.02)
    report = adjust_finally(keyframes, OPTIONS, Events()).report["camera"]
    assert not report["is_refined"]
    assert keyframes.rig.cameras == rig.cameras
    assert report["surprise"] < report["max_surprise"] / 3  # far from the bound


def test_outliers_are_told_from_points() -> None:
    keyframes, ground_truth = small_map(5, Rig.single(CAMERA), num_points=300, outlier_ratio=0.05)
    clean, _ = small_map(5, Rig.single(CAMERA), num_points=300)
    adjust_finally(keyframes, OPTIONS, Events())
    wrong, marked = 0, 0
    for ours, right in zip(keyframes.keyframes, clean.keyframes, strict=True):
        is_outlier = np.abs(ours.xy - right.xy).max((1, 2)) > 20
        wrong += int(is_outlier.sum())
        marked += int((is_outlier & ~ours.is_inlier[:, 0]).sum())
    assert wrong > 30
    assert marked > 0.95 * wrong
    ours = np.array([k.rig_from_world for k in keyframes.keyframes])
    errors = played.gauge_errors(ours, ground_truth, 7)
    assert np.degrees(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.2


def test_the_first_keyframe_stays_and_the_rest_is_at_a_minimum() -> None:
    keyframes, _ = small_map(6, synthetic_rig())
    first = keyframes.keyframes[0].rig_from_world.copy()
    report = adjust_finally(keyframes, replace(OPTIONS, refine_camera=False, covariance=False), Events()).report
    np.testing.assert_array_equal(keyframes.keyframes[0].rig_from_world, first)
    model, _ = keyframes.reconstruction(np.arange(8))
    again = adjust_bundle(
        model,
        AdjustOptions(
            loss="cauchy", loss_scale_px=2 * report["sigma_px"], refine_focal=False, refine_distortion=False,
            relative_cost_tolerance=1e-10,
        ),
    )  # fmt: skip
    assert again.final_cost > 0.98 * again.initial_cost


def test_a_stopped_run_is_interrupted() -> None:
    keyframes, _ = small_map(7, Rig.single(CAMERA))
    events = Events()
    events.cancel()
    with pytest.raises(InterruptedRunError):
        adjust_finally(keyframes, OPTIONS, events)


def test_a_refined_calibration_widens_what_it_moved() -> None:
    """Sigmas of a map whose calibration had to be refined hold half of the way that this has moved it."""
    rig = Rig.single(CAMERA)
    right, _ = small_map(3, rig, num_keyframes=14, num_points=600, sigma_px=0.1)
    wrong, _ = small_map(3, rig, num_keyframes=14, num_points=600, sigma_px=0.1)
    wrong.rig = Rig((replace(CAMERA, params=CAMERA.params * [1.02, 1.02, 1, 1]),), rig.cam_from_rig)
    found = [adjust_finally(keyframes, OPTIONS, Events()) for keyframes in (right, wrong)]
    assert [c.report["camera"]["is_refined"] for c in found] == [False, True]
    sigmas = [np.sqrt(np.einsum("kii->ki", c.covariance)).mean() for c in found if c.covariance is not None]
    assert 2.0 < sigmas[1] / sigmas[0] < 200.0


def test_a_refined_calibration_that_leaves_the_positions_open_is_a_contradiction() -> None:
    told = Events()
    covariance = np.eye(6)[None].repeat(5, 0) * 0.3**2
    covariance[4] = np.nan
    (found,) = _left_open(covariance, 2.0, told)
    assert found.evidence["position_sigma_share"] == pytest.approx(3**0.5 * 0.3 / 2.0)
    assert "26%" in found.message
    assert _left_open(covariance, 20.0, told) == []
    assert len(_left_open(np.full((2, 6, 6), np.nan), 2.0, told)) == 1


# ---- beside an inertial sensor


def flown_map(flight: Flight, times: np.ndarray, sigma_px: float) -> tuple[KeyframeMap, np.ndarray]:
    """Keyframes of a flight, and their true poses, in the map's own unit."""
    seen = seen_map(flight, times, 1, sigma_px, num_points=200)
    keyframes = played.keyframe_map(SimpleNamespace(observed=seen.model), Rig.single(FLIGHT_CAMERA))  # type: ignore[arg-type]
    for keyframe, time_s in zip(keyframes.keyframes, times, strict=True):
        keyframe.timestamp_s = float(time_s)
    return keyframes, true_map(flight, times)


def poses_of(keyframes: KeyframeMap) -> np.ndarray:
    return np.array([k.rig_from_world for k in keyframes.keyframes])


def test_an_inertial_sensor_holds_the_keyframes_and_tells_their_unit() -> None:
    flight, times = Flight(1), np.arange(0, 5, 0.25)
    options = replace(OPTIONS, refine_camera=False)
    alone, truth = flown_map(flight, times, 1.0)
    both, _ = flown_map(flight, times, 1.0)
    told = played.Told()
    before = adjust_finally(alone, options, Events())
    final = adjust_finally(both, options, told.events, imu=flight.imu(1, 5.0))
    assert isinstance(final.inertial, ScaleEstimate), final.inertial
    assert final.covariance is not None
    assert before.covariance is not None
    lengths = rigid3.spread(poses_of(both)) / rigid3.spread(truth)
    assert abs(np.log(final.inertial.scale * lengths / SCALE)) < 3.5 * final.inertial.sigma_relative < 0.1
    errors = [played.gauge_errors(poses_of(k), truth, 7)[:, 3:] for k in (both, alone)]
    assert (errors[0] ** 2).sum() < 0.5 * (errors[1] ** 2).sum()
    variances = [np.trace(f.covariance[:, 3:, 3:], axis1=1, axis2=2).mean() for f in (final, before)]
    assert variances[0] < 0.6 * variances[1]
    assert 0.3 < (errors[0] ** 2).sum(1).mean() / variances[0] < 2.5
    assert any("with inertial measurements" in message for message in told.messages("decided"))
    assert final.adjustment is not None
    assert "inertial" in {f.kind for f in final.adjustment.factors}
    assert final.report.inertial == final.inertial.evidence


def test_a_sensor_that_contradicts_the_keyframes_leaves_them_alone() -> None:
    flight, times = Flight(1), np.arange(0, 4, 0.25)
    options, imu = replace(OPTIONS, refine_camera=False), flight.imu(1, 4.0)
    (alone, _), (both, _) = (flown_map(flight, times, 0.5) for _ in range(2))
    before = adjust_finally(alone, options, Events())
    final = adjust_finally(both, options, Events(), imu=replace(imu, accel=imu.accel[:, [1, 2, 0]]))
    assert isinstance(final.inertial, ScaleRefusal)
    assert final.inertial.contradiction is not None
    assert "accelerometer has other axes" in final.inertial.reason
    assert poses_of(both).tobytes() == poses_of(alone).tobytes()
    assert final.covariance is not None
    assert before.covariance is not None
    assert final.covariance.tobytes() == before.covariance.tobytes()
