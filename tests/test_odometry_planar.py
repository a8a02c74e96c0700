"""A camera on wheels: the plane that it moves in, learned, held where it is one and dropped where it is not."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import G, X

import odometry_sequences as played
from sfmapp.adjust.factors import gtsam_pose
from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import project, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.odometry.initialize import MapInitializer, _is_on_wheels
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.refinement.final_adjustment import FinalAdjustment, adjust_finally
from sfmapp.odometry.refinement.motion_plane import fit_motion_plane, shared_factor
from sfmapp.odometry.refinement.planar_adjustment import PlaneFactor, hold_to_plane
from sfmapp.odometry.report import PlaneEvidence
from sfmapp.scene.rig import Rig

CAMERA = simple_camera(CameraModel.PINHOLE, 640, 480, 525.0)
PITCH_DEG, SWAY_DEG, BUMP = -3.0, 0.2, 0.005
NUM = 40


def drive(rng: np.random.Generator, kind: str, sway: float = 1.0) -> np.ndarray:
    """(K, 7) a car along an S; its camera looks down by three degrees, and springs sway it."""
    phase = np.arange(NUM) * 2.0 * np.pi / NUM
    yaw = 2.0 * np.sin(phase)
    place = np.cumsum(0.8 * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(NUM)], 1), 0)
    place[:, 2] = 1.5 + sway * rng.normal(0.0, BUMP, NUM)
    pitch = np.radians(PITCH_DEG + sway * rng.normal(0.0, SWAY_DEG, NUM))
    roll = np.radians(sway * rng.normal(0.0, SWAY_DEG, NUM))
    if kind == "ramp":
        place[:, 2] += 4.0 * np.clip(2.0 * np.arange(NUM) / NUM - 0.5, 0.0, 1.0)
    if kind == "leaning":
        roll += np.radians(2.0) * np.cos(phase)
    ahead = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], 1)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1)[:, None]
    level = np.stack([right, np.cross(ahead, right), ahead], 1)
    rotation = rigid3.exp_so3(roll[:, None] * [0.0, 0.0, 1.0]) @ level
    return rigid3.from_matrix(rotation, -np.einsum("kij,kj->ki", rotation, place))


def seen_map(seed: int, kind: str, sigma_px: float = 0.3) -> tuple[KeyframeMap, np.ndarray]:
    """A map of points around the way, each seen from up to eleven keyframes, and the true poses."""
    rng = np.random.default_rng([seed, 0xCA])
    poses, each = drive(rng, kind), 40
    pixels = rng.uniform(0.0, 1.0, (NUM, each, 2)) * [CAMERA.width, CAMERA.height]
    rays = np.concatenate([(pixels - [320.0, 240.0]) / CAMERA.focal, np.ones((NUM, each, 1))], 2)
    rays *= rng.uniform(3.0, 20.0, (NUM, each, 1))
    xyz = np.concatenate([rigid3.apply(rigid3.inverse(pose), part) for pose, part in zip(poses, rays, strict=True)])
    birth = np.repeat(np.arange(NUM), each)
    seen = []
    for k, pose in enumerate(poses):
        at = rigid3.apply(pose, xyz)
        xy = project(CAMERA, at)
        inside = (xy > 0.0).all(1) & (xy < [CAMERA.width, CAMERA.height]).all(1)
        ids = np.flatnonzero(inside & (at[:, 2] > 1.0) & (np.abs(birth - k) < 6))
        seen.append((ids, xy[ids] + rng.normal(0.0, sigma_px, (len(ids), 2))))
    often = np.bincount(np.concatenate([ids for ids, _ in seen]), minlength=len(xyz)) >= 2
    keyframes = KeyframeMap(Rig.single(CAMERA))
    keyframes.new_points(len(xyz))
    keyframes.point_xyz[: len(xyz)] = np.where(often[:, None], xyz + rng.normal(0.0, 0.01, xyz.shape), np.nan)
    for k, (ids, xy) in enumerate(seen):
        off = rigid3.from_matrix(rigid3.exp_so3(rng.normal(0.0, 1e-3, 3)), rng.normal(0.0, 0.01, 3))
        pose = poses[k] if k == 0 else rigid3.compose(off, poses[k])
        good = often[ids]
        inlier = np.ones((int(good.sum()), 1), bool)
        keyframes.append(Keyframe(k, float(k), f"{k:03d}.png", pose.copy(), ids[good], xy[good][:, None], inlier))
    return keyframes, poses


def adjusted(seed: int, kind: str, options: OdometryOptions) -> tuple[FinalAdjustment, np.ndarray]:
    """The end of a map, and the errors (K, 6) of its keyframes."""
    keyframes, poses = seen_map(seed, kind)
    final = adjust_finally(keyframes, replace(options, refine_camera=False), Events())
    return final, played.gauge_errors(np.array([k.rig_from_world for k in keyframes.keyframes]), poses, 7)


def test_an_exact_plane_is_found() -> None:
    poses = drive(np.random.default_rng(0), "level", sway=0.0)
    turn = rigid3.from_matrix(rigid3.exp_so3([0.4, -1.0, 2.0]), [3.0, 1.0, -2.0])
    plane = fit_motion_plane(rigid3.compose(poses, rigid3.inverse(turn)))
    assert plane is not None
    assert np.allclose(plane.normal, rigid3.rotation_matrix(turn) @ [0.0, 0.0, 1.0], atol=1e-6)
    assert np.abs(plane.deviations).max() < 1e-6
    assert np.degrees(np.arcsin(plane.up_in_cam[2])) == pytest.approx(PITCH_DEG, abs=1e-5)
    assert plane.looks_level
    assert fit_motion_plane(poses[:2]) is None
    assert fit_motion_plane(np.repeat(poses[:1], 5, 0)) is None


def test_a_hand_is_no_vehicle_and_a_straight_way_tells_no_plane() -> None:
    rng = np.random.default_rng(1)
    swaying = fit_motion_plane(drive(rng, "level", sway=10.0))
    assert swaying is not None
    assert not swaying.looks_level
    straight = np.tile(rigid3.IDENTITY, (20, 1))
    straight[:, 6] = np.arange(20.0)
    plane = fit_motion_plane(straight)
    assert plane is not None
    assert not plane.looks_level
    assert plane.up_in_cam == pytest.approx([0.0, -1.0, 0.0], abs=1e-6)  # as cameras on wheels are mounted


def test_a_straight_way_holds_no_map() -> None:
    model, _ = seen_map(0, "level")[0].reconstruction(np.arange(NUM))
    model.cam_from_world = np.tile(rigid3.IDENTITY, (NUM, 1))
    model.cam_from_world[:, 6] = -np.arange(float(NUM))
    found = hold_to_plane(model, AdjustOptions(), 0.3, 1)
    assert isinstance(found, PlaneEvidence)
    assert found.state == "dropped"
    assert found.reason == "turns of 0 degrees tell no plane, 30 are asked for"


def test_deviations_that_hang_together_count_as_one() -> None:
    rng = np.random.default_rng(2)
    independent = rng.normal(size=(400, 20))
    assert 0.95 < shared_factor(independent).mean() < 1.25
    # an autoregression of 0.8: (1 + 0.8) / (1 - 0.8) = 9
    series = np.zeros((4000, 8))
    for k in range(1, len(series)):
        series[k] = 0.8 * series[k - 1] + rng.normal(size=8)
    assert 7.0 < shared_factor(series).mean() < 11.0
    assert (shared_factor(np.ones((10, 2))) == 1.0).all()


def test_slopes_of_the_factor_are_those_of_differences() -> None:
    poses = drive(np.random.default_rng(3), "leaning")
    plane = fit_motion_plane(poses)
    assert plane is not None
    factor = PlaneFactor(plane)
    values, ground = gtsam.Values(), np.array([0.1, -0.2, 0.3, 0.05, -0.04])
    values.insert(X(0), gtsam_pose(poses[7]))
    values.insert(G(0), ground)
    both = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [X(0), G(0)], factor.error)
    matrix, _ = both.linearize(values).jacobian()
    pose, step = values.atPose3(X(0)), 1e-6
    for column in range(11):
        sides = []
        for sign in (step, -step):
            moved, delta = gtsam.Values(), sign * np.eye(11)[column]
            moved.insert(X(0), pose.retract(delta[:6]))
            moved.insert(G(0), ground + delta[6:])
            sides.append(both.unwhitenedError(moved))
        assert np.allclose(matrix[:, column], (sides[0] - sides[1]) / (2.0 * step), atol=1e-7)


def test_a_level_drive_is_held_as_well_as_it_keeps_to_the_plane() -> None:
    scores, pitches, across = [], [], []
    for seed in range(3):
        final, errors = adjusted(seed, "level", OdometryOptions(motion="planar"))
        plane = final.report.plane
        assert plane is not None
        assert plane.state == "held"
        assert plane.sigma_deg is not None
        assert plane.sigma_height is not None
        assert 0.5 * SWAY_DEG < min(plane.sigma_deg) <= max(plane.sigma_deg) < 2.5 * SWAY_DEG
        assert 0.5 * BUMP < plane.sigma_height < 2.5 * BUMP
        assert final.covariance is not None
        scores.append(played.normalized_errors(errors, final.covariance).mean())
        assert plane.camera_pitch_deg is not None
        assert plane.camera_pitch_sigma_deg is not None
        pitches.append((plane.camera_pitch_deg - PITCH_DEG) / plane.camera_pitch_sigma_deg)
        free, _ = adjusted(seed, "level", OdometryOptions())
        assert free.report.plane is not None
        assert free.report.plane.state == "offered"
        assert free.covariance is not None
        across.append(np.median(final.covariance[:, 4, 4] / free.covariance[:, 4, 4]))
    assert 0.5 < np.mean(scores) < 2.0
    assert 0.2 < np.sqrt(np.mean(np.square(pitches))) < 2.2
    # heights are what a plane tells
    assert max(across) < 0.8


def test_a_ramp_breaks_it_and_the_map_is_that_of_the_images() -> None:
    final, errors = adjusted(0, "ramp", OdometryOptions(motion="planar"))
    free, free_errors = adjusted(0, "ramp", OdometryOptions())
    assert final.report.plane is not None
    assert final.report.plane.state == "dropped"
    assert "height by up to" in final.report.plane.reason
    assert free.report.plane is None
    assert np.allclose(errors, free_errors, atol=1e-12)
    assert final.covariance is not None
    assert free.covariance is not None
    assert np.allclose(final.covariance, free.covariance)


def test_a_leaning_car_is_not_held_upright() -> None:
    """Two degrees of roll in curves are one deviation each, and no noise of keyframes: sigmas have to say so."""
    scores = []
    for seed in range(3):
        final, errors = adjusted(seed, "leaning", OdometryOptions(motion="planar"))
        plane = final.report.plane
        assert plane is not None
        assert plane.state == "held"
        assert plane.sigma_deg is not None
        assert plane.sigma_deg[1] > 3.0 > 0.6 > plane.sigma_deg[0]
        assert final.covariance is not None
        scores.append(played.normalized_errors(errors, final.covariance).mean())
    assert 0.4 < np.mean(scores) < 2.0


def followed(seed: int, share: float, num_frames: int = 7) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Corners that a level camera going ahead has followed, a share of them on pieces that move on their own, the true
    pose of the last view from the first, and which are wrong."""
    rng = np.random.default_rng([seed, 0xF0])
    num = 300
    corners = rng.uniform(0.0, 1.0, (num, 2)) * [CAMERA.width, CAMERA.height]
    rays = np.column_stack([(corners - [320.0, 240.0]) / CAMERA.focal, np.ones(num)])
    xyz, is_wrong = rays * rng.uniform(4.0, 25.0, (num, 1)), rng.random(num) < share
    speed, seen, pose = rng.normal(0.0, 4.0, (num, 2)), [], rigid3.IDENTITY
    for k in range(num_frames):
        way = rigid3.exp_so3([0.0, 0.004 * k, 0.0]) @ [0.0, 0.0, 1.0]
        pose = rigid3.from_matrix(rigid3.exp_so3([0.001 * k, 0.008 * k, 0.0]), -0.25 * k * way)
        right = project(CAMERA, rigid3.apply(pose, xyz))
        xy = np.where(is_wrong[:, None], corners + k * speed, right) + rng.normal(0.0, 0.15, (num, 2))
        inside = (xy > 0.0).all(1) & (xy < [CAMERA.width, CAMERA.height]).all(1)
        seen.append(np.where(inside[:, None], xy, np.nan))
    return seen, pose, is_wrong


@pytest.mark.parametrize("motion", ["planar", "ackermann"])
def test_a_map_on_wheels_begins_among_wrong_corners_and_begins_right(motion: Literal["planar", "ackermann"]) -> None:
    begun = 0
    for seed in range(4):
        seen, pose, is_wrong = followed(seed, 0.65)
        free, wheeled = (
            MapInitializer(CAMERA, OdometryOptions(motion=way), 0, corners=seen[0], seen=seen)._two_views(
                np.flatnonzero(np.isfinite(seen[-1][:, 0]))
            )
            for way in ("free", motion)
        )
        assert free is None
        if wheeled is not None:
            begun += 1
            centers = [rigid3.center(p) for p in (wheeled.last_from_first, pose)]
            cosine = centers[0] @ centers[1] / np.linalg.norm(centers[0]) / np.linalg.norm(centers[1])
            assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) < 5.0
            assert is_wrong[wheeled.track].mean() < 0.2
    assert begun >= 3


def test_what_a_vehicle_cannot_do_is_told() -> None:
    for yaw in (-0.4, 0.0, 0.3):
        turn = rigid3.exp_so3([0.01, yaw, -0.01])
        for side, is_car_like in ((-0.5 * yaw, True), (-yaw, True), (0.7, False), (-0.7 - abs(yaw), False)):
            for sign in (1.0, -1.0):
                pose = rigid3.from_matrix(turn, -sign * turn @ [np.sin(side), 0.05, np.cos(side)])
                assert _is_on_wheels(pose, is_car=False)
                assert _is_on_wheels(pose, is_car=True) == is_car_like
    rising = rigid3.from_matrix(np.eye(3), np.array([0.0, -0.4, 1.0]))
    rolling = rigid3.from_matrix(rigid3.exp_so3([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]))
    assert not _is_on_wheels(rising, is_car=False)
    assert not _is_on_wheels(rolling, is_car=False)
