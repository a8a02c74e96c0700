"""Questioning the given calibration: what a motion tells is found, what it cannot tell stays, and sigmas say which."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.adjust.calibration import RAW, reduce_to_calibration
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.early_calibration import EarlyCalibration
from sfmapp.odometry.live_shutter import LiveShutter
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.refinement import calibration_check
from sfmapp.odometry.refinement.calibration_check import Unknowns, _changed
from sfmapp.odometry.refinement.final_adjustment import FinalAdjustment, adjust_finally
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

FOCAL, BASELINE, NOISE_PX = 700.0, 0.5, 0.15
NOTHING = (0.0, 0.0, 0.0, 0.0)
OPTIONS = OdometryOptions(covariance=False)


def lens(stretch: float = 1.0, distortion: tuple[float, ...] = NOTHING) -> Camera:
    params = np.array([FOCAL * stretch, FOCAL * stretch, 600.0, 200.0, *distortion])
    return Camera(CameraModel.OPENCV, 1200, 400, params)


def rig_of(left: Camera, right: Camera | None = None, turn_deg: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Rig:
    if right is None:
        return Rig.single(left)
    turned = rigid3.from_matrix(rigid3.exp_so3(np.radians(turn_deg)), np.array([-BASELINE, 0.0, 0.0]))
    return Rig((left, right), np.stack([rigid3.IDENTITY, turned]))


def path(num: int, bend: float) -> Array:
    """(num, 7) rig_from_world of a drive that turns by ``bend`` radians and goes 1.2 m a keyframe."""
    rng, pose, out = np.random.default_rng(7), np.eye(3), []
    center = np.zeros(3)
    for _ in range(num):
        sway = rigid3.exp_so3(rng.normal(0, 5e-4, 3))
        rotation = sway @ pose.T
        out.append(rigid3.from_matrix(rotation, -rotation @ center))
        center = center + pose @ [0.0, 0.0, 1.2] + rng.normal(0, 0.005, 3)
        pose = pose @ rigid3.exp_so3(np.array([0.0, bend, 0.0]))
    return np.array(out)


def drive(
    ground_truth: Rig, given: Rig, *, bend: float = 0.0, num: int = 16, seed: int = 0, field_px: float = 0.0
) -> tuple[KeyframeMap, Array]:
    """A map of what a true rig saw, held with the given one, and the true poses.

    Args:
        field_px: amplitude at the border of a smooth displacement that no lens model has.
    """
    rng, poses = np.random.default_rng(seed), path(num, bend)
    at = rng.integers(0, num, 900)
    local = rng.uniform([-18, -4, 4], [18, 4, 70], (len(at), 3))
    xyz = np.array([rigid3.apply(rigid3.inverse(poses[k]), p[None])[0] for k, p in zip(at, local, strict=True)])
    keyframes = KeyframeMap(given)
    keyframes.new_points(len(xyz))
    for k, pose in enumerate(poses):
        xy = np.empty((len(xyz), len(ground_truth.cameras), 2))
        for s, camera in enumerate(ground_truth.cameras):
            in_camera = rigid3.apply(rigid3.compose(ground_truth.cam_from_rig[s], pose), xyz)
            xy[:, s] = project(camera, in_camera)
            u, v = ((xy[:, s] - [600, 200]) / [600, 200]).T
            xy[:, s] += field_px * np.column_stack([u * v, u**2 - v**2])
        xy += rng.normal(0, NOISE_PX, xy.shape)
        good = ((xy > 0) & (xy < (1200, 400))).all((1, 2)) & (rigid3.apply(pose, xyz)[:, 2] > 2) & (np.abs(at - k) < 9)
        seen = np.flatnonzero(good)
        flags = np.ones((len(seen), len(ground_truth.cameras)), bool)
        keyframes.append(Keyframe(k, 0.1 * k, f"{k:06d}.png", pose.copy(), seen, xy[seen], flags))
    keyframes.point_xyz[: len(xyz)] = xyz
    few = keyframes.num_observations(np.arange(len(xyz))) < 4
    keyframes.point_xyz[: len(xyz)][few] = np.nan
    return keyframes, poses


def errors(keyframes: KeyframeMap, poses: Array) -> tuple[float, float]:
    """Estimated over true scale, and rms error in metres after the best similarity."""
    ours, true = (rigid3.center(p) for p in (np.array([k.rig_from_world for k in keyframes.keyframes]), poses))
    found = similarity.umeyama(ours, true)
    return 1 / float(found[7]), float(np.sqrt(((similarity.apply(found, ours) - true) ** 2).sum(1).mean()))


def concluded(
    ground_truth: Rig, given: Rig, refine: bool = True, **drive_options: float
) -> tuple[FinalAdjustment, float, float, Rig]:
    keyframes, poses = drive(ground_truth, given, **drive_options)  # type: ignore[arg-type]
    final = adjust_finally(keyframes, replace(OPTIONS, refine_camera=refine), Events())
    return final, *errors(keyframes, poses), keyframes.rig


def test_the_reduced_cost_is_that_of_adjusting_again() -> None:
    ground_truth = rig_of(lens(), lens())
    keyframes, _ = drive(ground_truth, ground_truth, bend=0.02, num=8)
    model, _ = keyframes.reconstruction(np.arange(8))
    variable = np.arange(16) > 1
    options = AdjustOptions(refine_focal=False, refine_distortion=False, relative_cost_tolerance=1e-12)
    before = adjust_bundle(model, options, varying=Varying(images=variable)).final_cost
    unknowns = Unknowns.of(model)
    system = reduce_to_calibration(model, unknowns.directions(model), 1.0, lambda tracks: tracks % 7, "trivial")
    assert system.gradient.shape == (7, len(unknowns.names))
    for name, size in (("focal", 2e-3), ("distortion_1_0", 2e-3), ("turn_y", 1e-4), ("turn_z", 1e-4)):
        step = np.where([n == name for n in unknowns.names], size, 0.0)
        changed = _changed(model, unknowns.directions(model) @ step)
        after = adjust_bundle(changed, options, varying=Varying(images=variable)).final_cost
        predicted = step @ system.gradient.sum(0) + 0.5 * step @ system.information.sum(0) @ step
        assert after - before == pytest.approx(predicted, rel=0.05), name
        ratio = np.linalg.norm(changed.centers[::2] - changed.centers[::2].mean(0))
        ratio /= np.linalg.norm(model.centers[::2] - model.centers[::2].mean(0))
        assert np.log(ratio) == pytest.approx(system.log_scale @ step, rel=0.05, abs=2e-5), name
    assert unknowns.directions(model).shape == (2, RAW, len(unknowns.names))


def test_a_straight_drive_leaves_the_focal_length_to_its_prior_and_says_so() -> None:
    ground_truth, given = rig_of(lens(1.01), lens(1.01)), rig_of(lens(), lens())
    straight, scale, _, rig = concluded(ground_truth, given)
    sigma = straight.report["camera"]["sigma"]["focal"]
    assert sigma > 0.007
    assert rig.cameras == given.cameras
    assert straight.scale_sigma is not None
    assert 0.5 < (1 - scale) / straight.scale_sigma < 2  # off by what it says
    bent, scale, _, rig = concluded(ground_truth, given, bend=0.06)
    assert bent.report["camera"]["sigma"]["focal"] < sigma / 2
    assert rig.cameras[0].focal == pytest.approx(1.01 * FOCAL, rel=3e-3)
    assert bent.scale_sigma is not None
    assert bent.scale_sigma < straight.scale_sigma / 2
    assert abs(scale - 1) < 3 * bent.scale_sigma


VARIANTS = {
    "right": rig_of(lens(), lens()),
    "turned": rig_of(lens(), lens(), (0.01, 0.05, -0.02)),
    "tangential": rig_of(lens(1, (0, 0, -0.002, 0.002)), lens(1, (0, 0, -0.002, -0.002))),
    "radial": rig_of(lens(1, (-0.03, 0.01, 0, 0)), lens(1, (-0.025, 0.01, 0, 0)), (0.0, -0.03, 0.0)),
    "unequal": rig_of(lens(1.001, (0.01, 0, 0, 0)), lens(0.999)),
}


@pytest.mark.parametrize("name", list(VARIANTS))
def test_refining_a_straight_drive_makes_nothing_worse(name: str) -> None:
    given = rig_of(lens(), lens())
    off, scale_off, shape_off, _ = concluded(VARIANTS[name], given, refine=False, field_px=0.05)
    on, scale_on, shape_on, rig = concluded(VARIANTS[name], given, field_px=0.05)
    assert on.report["camera"]["is_refined"] is (name != "right")
    assert abs(scale_on - 1) < 1.1 * abs(scale_off - 1) + 1e-3
    assert shape_on < 1.1 * shape_off + 2e-3
    for final, scale in ((off, scale_off), (on, scale_on)):
        assert final.scale_sigma is not None
        assert 0.002 <= final.scale_sigma < 0.06
        assert abs(scale - 1) < 3 * final.scale_sigma
        assert final.contradictions == []
    for camera in rig.cameras:
        assert camera.canonical[0] / camera.canonical[1] == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("factor", [0.9, 1.1, 1.3])
@pytest.mark.parametrize("num_sensors", [1, 2])
def test_a_focal_length_that_is_far_off_is_found_where_the_drive_bends(factor: float, num_sensors: int) -> None:
    right, wrong = lens(), lens(factor)
    ground_truth, given = (rig_of(c, c if num_sensors == 2 else None) for c in (right, wrong))
    final, scale, _, rig = concluded(ground_truth, given, bend=0.03, seed=3)
    if not final.contradictions:
        assert rig.cameras[0].focal == pytest.approx(FOCAL, rel=0.01)
    else:
        assert final.contradictions[0].subject == "given calibration"
    if num_sensors == 2:
        assert final.scale_sigma is not None
        sigma = np.hypot(final.scale_sigma, sum(c.scale_sigma for c in final.contradictions))
        assert abs(scale - 1) < 3 * sigma


def test_a_contradiction_stands_where_refining_is_not_allowed() -> None:
    ground_truth, given = rig_of(lens()), rig_of(lens(1.1))
    final, _, shape, rig = concluded(ground_truth, given, refine=False, bend=0.06)
    assert rig.cameras == given.cameras
    (found,) = final.contradictions
    assert found.subject == "given calibration"
    spread = np.sqrt(((rigid3.center(path(16, 0.06)) - rigid3.center(path(16, 0.06)).mean(0)) ** 2).sum(1).mean())
    assert shape < 3 * np.sqrt(3) * found.position_sigma_share * spread
    assert found.position_sigma_share < 0.2


@pytest.mark.parametrize("stretch", [0.7, 1.3])
@pytest.mark.parametrize("is_stereo", [False, True])
def test_a_map_that_was_made_with_a_refined_camera_is_not_torn_by_the_given_one(
    stretch: float, is_stereo: bool
) -> None:
    ground_truth = rig_of(lens(), lens()) if is_stereo else rig_of(lens())
    given = rig_of(lens(stretch), lens(stretch)) if is_stereo else rig_of(lens(stretch))
    refined_before = rig_of(lens(1.01), lens(1.01)) if is_stereo else rig_of(lens(1.01))
    keyframes, poses = drive(ground_truth, refined_before, bend=0.03)
    final = adjust_finally(keyframes, OPTIONS, Events(), given)
    report = final.report["camera"]
    assert report["is_refined"]
    assert np.allclose(report["given"][0], given.cameras[0].params)
    assert keyframes.rig.cameras[0].focal == pytest.approx(FOCAL, rel=5e-3)
    scale, error = errors(keyframes, poses)
    assert error < 0.05
    if is_stereo:
        assert scale == pytest.approx(1.0, abs=3 * final.scale_sigma)


def test_what_a_camera_differs_by_is_what_it_was_changed_by() -> None:
    given = drive(rig_of(lens(), lens()), rig_of(lens(), lens()), num=4)[0].reconstruction(np.arange(4))[0]
    unknowns = Unknowns.of(given)
    x = np.random.default_rng(3).normal(0, 1e-4, len(unknowns.names))
    found = _changed(given, unknowns.directions(given) @ x)
    # the focal length of a pixel's shape and of a difference are those of first order
    assert np.allclose(unknowns.between(given, found), x, atol=1e-7)


def test_where_nothing_makes_a_wrong_calibration_better_the_map_is_red_and_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(calibration_check, "_go", lambda *_: None)
    final, *_ = concluded(rig_of(lens()), rig_of(lens(0.7)), bend=0.03)
    assert not final.report["camera"]["is_refined"]
    [contradiction] = final.contradictions
    assert contradiction.subject == "given calibration"
    assert contradiction.position_sigma_share >= 1.0
    assert contradiction.rotation_sigma_deg >= 180.0


def test_what_a_map_gains_while_its_calibration_is_questioned_is_brought_along() -> None:
    ground_truth, given = rig_of(lens()), rig_of(lens(1.02))
    keyframes, poses = drive(ground_truth, given, bend=0.04, num=21)
    adjust_finally(keyframes, replace(OPTIONS, refine_camera=False), Events())
    later = [keyframes.remove(18) for _ in range(3)]
    local = LocalMap(given, OPTIONS, None, 0)
    local.keyframes = keyframes
    with ThreadPoolExecutor(1) as executor:
        calibration = EarlyCalibration(True, LiveShutter(False, []), executor)
        assert not calibration.refines(local, 18)
        assert calibration.is_asking
        for number, keyframe in enumerate(later, 19):
            keyframes.append(keyframe)
            assert not calibration.refines(local, number)  # answered or not
        assert local.rig is given
        assert calibration.refines(local, 18 + 10)
    assert not calibration.is_open
    assert not calibration.is_asking
    assert keyframes.rig is local.rig
    assert local.rig.cameras[0].focal == pytest.approx(FOCAL, rel=5e-3)
    assert errors(keyframes, poses)[1] < 0.05
    model, _ = keyframes.reconstruction(np.arange(21))
    off = np.linalg.norm(model.residuals_px(), axis=1)[model.obs_is_inlier & (model.tracks.obs_image_idx >= 18)]
    assert np.median(off) < 2 * NOISE_PX


def test_a_question_is_forgotten_with_the_map_that_it_was_asked_of() -> None:
    given = rig_of(lens(1.02))
    local = LocalMap(given, OPTIONS, None, 0)
    local.keyframes, _ = drive(rig_of(lens()), given, bend=0.04, num=18)
    adjust_finally(local.keyframes, replace(OPTIONS, refine_camera=False), Events())
    calibration = EarlyCalibration(True, LiveShutter(False, []), None)
    calibration.refines(local, 18)
    calibration.forget()
    assert not calibration.refines(local, 40)
    assert local.rig is given
