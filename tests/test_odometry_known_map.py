"""A sequence in a map that was there before: localised there, kept apart where it contradicts it, and elsewhere."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from odometry_sequences import PINHOLE, Played, Told, absolute_error, keyframe_map, play, room, room_walk, run, run_room
from rendered_worlds.worlds import gallery_world
from sfmapp.adjust.pose import refine_pose
from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized, project, simple_camera
from sfmapp.errors import InputError, UsageError
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry import known_map_check
from sfmapp.odometry.loops.pose_graph import apply_corrections
from sfmapp.odometry.map.backend import make_job, run_job, take_over
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.map.known_map import PREFIX, KnownMap, as_seen_by, known_keyframes
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.report import KnownMapReport
from sfmapp.odometry.result import OdometryResult
from sfmapp.odometry.run import run_odometry
from sfmapp.pipelines.odometry.known_map import check_observations
from sfmapp.scene.rig import Rig
from sfmapp.scene.synthetic import make_scene

Array = NDArray[np.float64]
NUM_FRAMES = 80


def first_run() -> OdometryResult:
    return run_room(NUM_FRAMES)


@cache
def known_map() -> KnownMap:
    """What the first run has made, with the pictures of its keyframes, in metres that somebody has told to 1 %."""
    entry = first_run().maps[0]
    pictures = {
        int(image): room(NUM_FRAMES).images[frame][0]
        for image, frame in zip(entry.keyframe_image_idx, entry.keyframe_frame_idx, strict=True)
    }
    images = np.arange(len(entry.reconstruction.image_names), dtype=np.int64)[:, None]
    return KnownMap("OUT", entry.reconstruction, images, pictures, "marker", 0.01)


def backwards() -> Played:
    """The same way on another day: backwards, with other noise."""
    walk = room_walk(NUM_FRAMES)
    return play(replace(walk, seed=7)).taken(np.arange(NUM_FRAMES)[::-1], mirrored=True)


def localised(sequence: Played, known: KnownMap, told: Told | None = None) -> tuple[OdometryResult, KnownMapReport]:
    events = None if told is None else told.events
    found = run_odometry(sequence, OdometryOptions(), threads=2, events=events, known=known)  # type: ignore[arg-type]
    assert found.report is not None
    assert found.report.known_map is not None
    return found, found.report.known_map


def test_a_second_run_is_localised_from_its_first_frame_and_better_than_without_the_map() -> None:
    sequence = backwards()
    found, report = localised(sequence, known_map())
    assert (report.is_found, report.num_localised, report.num_elsewhere) == (True, NUM_FRAMES, 0)
    assert report.position_sigmas is not None
    assert report.rotation_sigmas is not None
    assert 0.1 < report.position_sigmas < known_map_check.MAX_SIGMAS
    assert 0.1 < report.rotation_sigmas < known_map_check.MAX_SIGMAS
    (entry,) = found.maps
    assert not entry.contradictions
    # its unit of length, and how well that is known, come along
    assert (entry.scale_source, entry.scale_sigma) == ("marker", 0.01)
    # frames of this run alone are frames of the trajectory; the known ones are in the model under their own names
    assert set(entry.keyframe_frame_idx.tolist()) <= set(range(NUM_FRAMES))
    known = [name for name in entry.reconstruction.image_names if name.startswith(PREFIX)]
    assert len(known) == len(known_map().model.image_names)
    assert entry.covariance is not None
    assert len(entry.covariance) == len(entry.keyframe_frame_idx)
    error, metres_per_unit = absolute_error(found, sequence)
    first = first_run()
    first_error = absolute_error(first, room(NUM_FRAMES))[0]
    alone = run_odometry(sequence, OdometryOptions(), threads=2)  # type: ignore[arg-type]
    assert error < 0.6 * absolute_error(alone, sequence)[0]
    # in the frame and the unit of the first: its poses of the same places, without any alignment
    between = rigid3.center(found.cam_from_world) - rigid3.center(first.cam_from_world[::-1])
    assert metres_per_unit * np.sqrt((between**2).sum(1).mean()) < 2.0 * (error + first_error)


def street(seed: int, drift_deg: float) -> known_map_check.Disagreement:
    """A way with images at two times: those of the first are a map, which has drifted round by some degrees along the
    way and agrees with itself; those of the second are held against it."""
    camera = simple_camera(CameraModel.PINHOLE, 640, 480, 525.0)
    scene = make_scene(seed, 24, 900, camera, sigma_px=0.4, layout="forward")
    whole, known = keyframe_map(scene, Rig.single(camera)), KeyframeMap(Rig.single(camera))
    known.new_points(whole.num_points)
    for k, keyframe in enumerate(whole.keyframes[::2]):
        known.append(replace(keyframe, frame_idx=k - 12))
    ids = np.arange(whole.num_points)
    known.point_xyz[ids] = np.where(known.num_observations(ids)[:, None] > 1, whole.point_xyz[ids], np.nan)
    every = np.arange(12)
    job = make_job(known, every, every > 0)
    take_over(run_job(job), known)
    if drift_deg:
        offset = [k.xy[:, 0] - seen_at(known, k) for k in known.keyframes]
        pivot = rigid3.center(known.keyframes[0].rig_from_world)
        turns = rigid3.exp_so3(np.radians(drift_deg) * np.outer(every / 11, [0.0, 1.0, 0.0]))
        apply_corrections(known, np.array([similarity.from_parts(t, pivot - t @ pivot, 1.0) for t in turns]))
        for keyframe, off in zip(known.keyframes, offset, strict=True):
            keyframe.xy[:, 0] = seen_at(known, keyframe) + off
            keyframe.is_inlier &= np.isfinite(keyframe.xy[:, :, 0])
    known.hold_known()
    check = known_map_check.KnownMapCheck(replace(known_map(), source="OUT"), known, 0, 0)
    for k, keyframe in enumerate(whole.keyframes[1::2]):
        known.append(replace(keyframe, frame_idx=k))
    found = check.compare(known)
    assert found is not None
    return found


def seen_at(keyframes: KeyframeMap, keyframe: Keyframe) -> Array:
    xyz = keyframes.point_xyz[keyframe.point_id]
    return project(keyframes.rig.cameras[0], rigid3.apply(keyframe.rig_from_world, xyz))


def test_a_right_map_differs_by_what_both_are_unsure_of_and_a_bent_one_by_more() -> None:
    right = [street(seed, 0.0) for seed in range(5)]
    assert not any(found.is_contradiction for found in right)
    for sigmas in ([f.position_sigmas for f in right], [f.rotation_sigmas for f in right]):
        assert 0.5 < np.sqrt(np.mean(np.square(sigmas))) < 1.5
    assert all(street(seed, 4.0).is_contradiction for seed in range(5))


def test_a_map_that_is_contradicted_is_kept_apart_and_not_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_map_check, "MAX_SIGMAS", 0.0)
    told, sequence = Told(), backwards()
    found, report = localised(sequence, known_map(), told)
    (entry,) = found.maps
    (against,) = [c for c in entry.contradictions if c.subject == "known map"]
    assert (report.is_found, report.num_localised, report.max_sigmas) == (True, NUM_FRAMES, 0.0)
    assert "contradicts OUT" in against.message
    assert any("contradicts OUT" in text for text in told.messages("warned"))
    # none of the known keyframes is left in it, and what differs is in the sigma of its unit of length
    assert not [n for n in entry.reconstruction.image_names if n.startswith(PREFIX)]
    assert entry.scale_sigma is not None
    assert entry.scale_sigma > 0.01
    error, metres_per_unit = absolute_error(found, sequence)
    alone = absolute_error(run(sequence), sequence)[0]
    assert error < 1.5 * alone
    first = first_run()
    between = rigid3.center(found.cam_from_world) - rigid3.center(first.cam_from_world[::-1])
    assert metres_per_unit * np.sqrt((between**2).sum(1).mean()) < 2.0 * (
        error + absolute_error(first, room(NUM_FRAMES))[0]
    )


def test_another_place_is_not_in_the_map_and_goes_on_as_its_own() -> None:
    elsewhere = play(replace(room_walk(50), worlds=(gallery_world(3),)))
    told = Told()
    found, report = localised(elsewhere, known_map(), told)
    assert (report.is_found, report.num_localised, report.position_sigmas) == (False, 0, None)
    assert len(found.maps) == 1
    assert report.num_elsewhere == int(np.isfinite(found.cam_from_world[:, 0]).sum()) > 40
    assert found.maps[0].scale_source == "none"
    assert any("no frame was found in the known map" in text for text in told.messages("warned"))


def test_what_another_camera_has_taken_is_what_ours_would_have() -> None:
    """A wider lens with distortion: pixels of points by projection, and the picture of a smooth pattern by the same."""
    wide = Camera(CameraModel.OPENCV, 640, 480, np.array([300.0, 310.0, 318.0, 243.0, -0.08, 0.01, 1e-3, -5e-4]))
    model = known_map().model.copy()
    model.cameras = [wide]
    image = int(known_map().image_idx[3, 0])
    obs = model.tracks.observations_of_image(image)
    ray = pixels_to_normalized(PINHOLE, model.tracks.obs_xy[obs])
    xy = model.tracks.obs_xy.copy()
    xy[obs] = project(wide, np.column_stack([ray, np.ones(len(ray))]))
    model.tracks = replace(model.tracks, obs_xy=xy)
    keyframes, _ = known_keyframes(replace(known_map(), model=model, pictures={}), Rig.single(PINHOLE))
    given, _ = known_keyframes(replace(known_map(), pictures={}), Rig.single(PINHOLE))
    assert np.abs(keyframes.keyframes[3].xy - given.keyframes[3].xy).max() < 1e-3  # observations are float32
    assert (keyframes.num_known, keyframes.keyframes[0].frame_idx) == (len(given.keyframes), -len(given.keyframes))

    def shown(camera: Camera) -> Array:
        """Waves over the directions of sight."""
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        x, y = pixels_to_normalized(camera, np.column_stack([column.ravel(), row.ravel()])).T
        return (128 + 60 * np.sin(9 * x + 1) * np.cos(7 * y)).reshape(camera.height, camera.width)

    picture = as_seen_by(np.rint(shown(wide)).astype(np.uint8), wide, PINHOLE)
    assert np.abs(picture - shown(PINHOLE))[2:-2, 2:-2].max() < 2.0


def test_a_map_that_contradicts_its_own_images_is_refused() -> None:
    """One keyframe that is turned is what a map may bear; when all have drifted away from their points it is none."""
    known = known_map()
    check_observations(known)
    model = known.model.copy()
    worst = int(known.image_idx[2, 0])
    turned = rigid3.from_matrix(rigid3.exp_so3(np.array([0.0, 0.1, 0.0])), np.zeros(3))
    model.move_images(np.array([worst]), rigid3.compose(turned, model.cam_from_world[[worst]]))
    check_observations(replace(known, model=model))
    others = np.setdiff1d(known.image_idx[:, 0], worst)
    slightly = rigid3.from_matrix(rigid3.exp_so3(np.array([0.0, 0.03, 0.0])), np.zeros(3))
    model.move_images(others, rigid3.compose(slightly, model.cam_from_world[others]))
    # 0.03 radians of 262 pixels in the middle of the picture, and 1.4 times as much at its sides
    with pytest.raises(
        InputError, match=rf"OUT: .* more than (8|9)\.\d px off, those of {model.image_names[worst]} most"
    ):
        check_observations(replace(known, model=model))


def test_two_cameras_have_no_use_for_a_map_of_one() -> None:
    with pytest.raises(UsageError, match="a map of one camera"):
        known_keyframes(known_map(), Rig((PINHOLE, PINHOLE), np.stack([rigid3.IDENTITY, rigid3.IDENTITY])))


def test_a_pose_by_landmarks_is_as_unsure_as_they_are() -> None:
    """Landmarks with errors of their own: normalised errors of the pose are one a degree of freedom, where those of the
    pose by landmarks taken for the truth are far more; sure ones give what the house's own refinement gives."""
    rng = np.random.default_rng(3)
    pose = rigid3.from_matrix(rigid3.exp_so3(np.array([0.1, -0.2, 0.05])), np.array([0.2, 0.1, 0.3]))
    ours, theirs = [], []
    for _ in range(150):
        in_camera = np.column_stack([rng.uniform(-1, 1, (60, 2)), np.ones(60)]) * rng.uniform(2, 6, (60, 1))
        in_camera[:, :2] *= 0.5
        xyz = rigid3.apply(rigid3.inverse(pose), in_camera)
        root = rng.normal(size=(60, 3, 3)) * rng.uniform(0.002, 0.04, (60, 1, 1))
        covariance = root @ root.transpose(0, 2, 1)
        seen = project(PINHOLE, in_camera) + 0.3 * rng.normal(size=(60, 2))
        landmarks = xyz + np.einsum("nij,nj->ni", root, rng.normal(size=(60, 3)))
        start = refine_pose(PINHOLE.canonical, pose, landmarks, seen, inlier_px=1e3)
        found, of_pose = known_map_check.weighted_pose(PINHOLE, start.cam_from_world, landmarks, seen, covariance, 0.3)
        for rows, (p, c) in ((ours, (found, of_pose)), (theirs, (start.cam_from_world, start.covariance))):
            delta = rigid3.compose(p, rigid3.inverse(pose))
            error = np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(delta)), delta[4:]])
            rows.append(error @ np.linalg.solve(c, error) / 6)
    # 900 degrees of freedom: 1 +- 4 standard deviations of 0.047
    assert 0.81 < np.mean(ours) < 1.19
    sure, of_sure = known_map_check.weighted_pose(PINHOLE, pose, xyz, seen, np.zeros((60, 3, 3)), 0.3)
    plain = refine_pose(PINHOLE.canonical, pose, xyz, seen, scale_px=1e3, inlier_px=1e3)
    assert np.abs(sure - plain.cam_from_world).max() < 1e-5
    assert np.isfinite(of_sure).all()
