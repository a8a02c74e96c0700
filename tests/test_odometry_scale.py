"""The unit of length of a map from markers, distances and the height of the camera, against synthetic ground truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized, project
from sfmapp.errors import UsageError
from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.markers import (
    _SQUARE,
    MarkerDetector,
    MarkerSightings,
    parse_marker,
    scale_from_markers,
)
from sfmapp.odometry.inertial.scale import (
    GroundOptions,
    Length,
    ScaleEstimate,
    ScaleRefusal,
    apply_scale,
    parse_distance,
    parse_length,
    scale_covariance,
    scale_from_camera_height,
    scale_from_distance,
    scale_from_path,
)
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import _look_at, make_scene, synthetic_camera
from sfmapp.scene.tracks import make_tracks

CAMERA = synthetic_camera(CameraModel.OPENCV, 640, 480, 500.0)
SMALL_CAMERA = synthetic_camera(CameraModel.OPENCV, 320, 240, 250.0)


def no_points(poses: np.ndarray, camera: Camera = CAMERA) -> Reconstruction:
    """A map of cameras alone."""
    none = np.zeros(0, np.int64)
    tracks = make_tracks(len(poses), 0, none, none, none, np.zeros((0, 2)))
    names = [f"{k:06d}" for k in range(len(poses))]
    model = Reconstruction.empty([camera], names, np.zeros(len(poses), np.int32), tracks)
    model.cam_from_world[:] = poses
    return model


# ---- lengths and distances


def test_lengths_are_as_certain_as_their_last_digit() -> None:
    assert parse_length("1.65").metres == 1.65
    assert parse_length("1.65").sigma_m == pytest.approx(0.005 / np.sqrt(3))
    assert parse_length("12").sigma_m == pytest.approx(0.5 / np.sqrt(3))
    assert parse_length("1.5e2").sigma_m == pytest.approx(5 / np.sqrt(3))
    for wrong in ("", "nan", "-1", "0", "1,5", "inf"):
        with pytest.raises(UsageError):
            parse_length(wrong)


def test_distances_are_parsed() -> None:
    known = parse_distance("000012, 000340 ,5.2")
    assert known.frames == ("000012", "000340")
    assert known.length.metres == 5.2
    assert parse_distance("path,120").frames is None
    for wrong in ("1,2", "1,2,3,4", "1,1,5.0", ",2,5", "1,2,x"):
        with pytest.raises(UsageError):
            parse_distance(wrong)


@settings(deadline=None, max_examples=30)
@given(scale=st.floats(0.01, 100.0), seed=st.integers(0, 1000))
def test_distance_gives_back_the_scale(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    metres = float(np.linalg.norm(np.diff(rigid3.center(poses), axis=0))) * scale
    found = scale_from_distance(poses[0], poses[1], Length(metres))
    assert isinstance(found, ScaleEstimate)
    assert found.scale == pytest.approx(scale)
    assert found.sigma_relative == 0.0


def test_sigma_of_a_distance_is_that_of_the_poses() -> None:
    rng = np.random.default_rng(1)
    poses = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)) * 4)
    roots = rng.normal(size=(2, 6, 6)) * 0.01
    covariances = roots @ roots.swapaxes(1, 2)
    metres = float(np.linalg.norm(np.diff(rigid3.center(poses), axis=0)))
    drawn = []
    for _ in range(2000):
        moved = []
        for pose, root in zip(poses, roots, strict=True):
            step = root @ rng.normal(size=6)
            moved.append(rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(step[:3]), step[3:]), pose))
        drawn.append(float(np.linalg.norm(rigid3.center(moved[0]) - rigid3.center(moved[1]))))
    found = scale_from_distance(poses[0], poses[1], Length(metres, 0.0), covariances[0], covariances[1])
    assert isinstance(found, ScaleEstimate)
    assert found.sigma_relative == pytest.approx(np.std(drawn) / metres, rel=0.06)
    assert isinstance(scale_from_distance(poses[0], poses[0], Length(1.0)), ScaleRefusal)
    assert isinstance(scale_from_distance(poses[0], np.full(7, np.nan), Length(1.0)), ScaleRefusal)


def test_path_length_and_what_its_sampling_costs() -> None:
    angle = np.linspace(0, np.pi, 41)
    poses = np.tile(rigid3.IDENTITY, (41, 1))
    poses[:, 4:] = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    found = scale_from_path(poses, Length(np.pi * 3))
    assert isinstance(found, ScaleEstimate)
    assert found.scale == pytest.approx(3.0, rel=1e-3)
    assert abs(found.scale / 3 - 1) < found.sigma_relative < 2e-3
    poses[7] = np.nan
    assert isinstance(scale_from_path(poses, Length(1.0)), ScaleRefusal)
    assert isinstance(scale_from_path(np.tile(rigid3.IDENTITY, (5, 1)), Length(1.0)), ScaleRefusal)


def test_scaling_a_map_changes_no_residual() -> None:
    scene = make_scene(3, 4, 50)
    scaled = apply_scale(scene.observed, 2.5)
    assert np.allclose(scaled.residuals_px(), scene.observed.residuals_px(), atol=1e-9)
    assert np.allclose(scaled.centers, 2.5 * scene.observed.centers)
    covariance = scale_covariance(np.full((2, 6, 6), 1.0), 2.0)
    assert covariance[0, 0, 0] == 1.0
    assert covariance[1, 0, 4] == 2.0
    assert covariance[1, 5, 5] == 4.0


# ---- markers


def marker_poses(rng: np.random.Generator, num: int, distance: float = 8.0) -> np.ndarray:
    """Cameras on an arc that look at the origin, the marker's side being about one unit."""
    angle = np.linspace(-0.5, 0.5, num)
    centers = distance * np.stack([np.sin(angle), 0.2 * np.cos(3 * angle), -np.cos(angle)], 1)
    return _look_at(centers, 0.2 * rng.normal(size=(num, 3)), np.array([0.0, 1.0, 0.0]))


def sightings_of(
    poses: np.ndarray, squares: dict[int, np.ndarray], sigma_px: float, rng: np.random.Generator
) -> MarkerSightings:
    rows = [
        (k, m, project(CAMERA, rigid3.apply(pose, xyz)) + rng.normal(0.0, sigma_px, (4, 2)))
        for k, pose in enumerate(poses)
        for m, xyz in squares.items()
    ]
    return MarkerSightings(
        np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), np.array([r[2] for r in rows])
    )


def square_at(rng: np.random.Generator, side: float) -> np.ndarray:
    turn = rigid3.exp_so3(0.4 * rng.normal(size=3))
    return side * _SQUARE @ turn.T + 0.8 * rng.normal(size=3)


def test_marker_scale_is_right_and_its_sigma_honest() -> None:
    """Noise on corners, a wrong detection, a turned one, an id that is another size: errors over sigma are of rms 1."""
    scores, sigmas = [], []
    for seed in range(24):
        rng = np.random.default_rng([seed, 7])
        poses = marker_poses(rng, 12)
        sightings = sightings_of(poses, {m: square_at(rng, 1.0) for m in range(3)}, 0.3, rng)
        sightings.corners[4] += 25.0  # somewhere else
        sightings.corners[10] = np.roll(sightings.corners[10], 1, axis=0)  # its corners in another order
        found = scale_from_markers(no_points(poses), sightings, Length(0.16))
        assert isinstance(found, ScaleEstimate)
        scores.append((found.scale / 0.16 - 1.0) / found.sigma_relative)
        sigmas.append(found.sigma_relative)
    # 24 draws: within 30 % at two sigma
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3
    # 0.3 px over some 62 px and 3 x 12 x 4 sides' worth of corners: a few parts in ten thousand to a few in a thousand
    assert 3e-4 < np.median(sigmas) < 3e-3
    assert found.evidence["num_sightings"] == 36


def test_one_marker_of_another_size_among_several_is_left_out() -> None:
    rng = np.random.default_rng(2)
    poses = marker_poses(rng, 10)
    squares = {m: square_at(rng, 1.5 if m == 3 else 1.0) for m in range(5)}
    found = scale_from_markers(no_points(poses), sightings_of(poses, squares, 0.2, rng), Length(1.0))
    assert isinstance(found, ScaleEstimate)
    assert found.scale == pytest.approx(1.0, abs=0.01)


def test_markers_that_say_nothing_are_refused() -> None:
    rng = np.random.default_rng(2)
    poses = marker_poses(rng, 10)
    model = no_points(poses)
    none = MarkerSightings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    refusal = scale_from_markers(model, none, Length(0.1))
    assert isinstance(refusal, ScaleRefusal)
    assert "no marker was seen" in refusal.reason
    once = sightings_of(poses[:1], {0: square_at(rng, 1.0)}, 0.2, rng)
    assert isinstance(scale_from_markers(model, once, Length(0.1)), ScaleRefusal)
    # a baseline of a thousandth of the distance
    still = np.tile(poses[:1], (10, 1))
    still[:, 4] += 0.002 * np.arange(10)
    nearly = sightings_of(still, {0: square_at(rng, 1.0)}, 0.3, rng)
    assert isinstance(scale_from_markers(no_points(still), nearly, Length(0.1)), ScaleRefusal)
    # random corners
    nearly.corners[:] = rng.uniform(0, 480, nearly.corners.shape)
    assert isinstance(scale_from_markers(model, nearly, Length(0.1)), ScaleRefusal)


def render_marker(pose: np.ndarray, xyz: np.ndarray, dictionary: int, marker_id: int) -> np.ndarray:
    """A marker on grey, by the rays of 4 x 4 samples a pixel, pixel centres at halves."""
    import cv2

    texture = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(dictionary), marker_id, 80)
    grid = (np.arange(320 * 4) + 0.5) / 4, (np.arange(240 * 4) + 0.5) / 4
    xy = np.stack(np.meshgrid(*grid), -1).reshape(-1, 2)
    rays = np.column_stack([pixels_to_normalized(SMALL_CAMERA, xy), np.ones(len(xy))]) @ rigid3.rotation_matrix(pose)
    origin, center = rigid3.center(pose), xyz.mean(0)
    right, down = xyz[1] - xyz[0], xyz[3] - xyz[0]
    normal = np.cross(right, down)
    hit = origin + rays * ((center - origin) @ normal / (rays @ normal))[:, None] - xyz[0]
    u, v = hit @ right / (right @ right), hit @ down / (down @ down)
    value = np.full(len(xy), 200.0)
    inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    value[inside] = texture[(v[inside] * 80).astype(int), (u[inside] * 80).astype(int)]
    return value.reshape(240, 4, 320, 4).mean((1, 3)).round().astype(np.uint8)


@pytest.mark.parametrize(("text", "marker_id"), [("DICT_4X4_50:0.15", 7), ("APRILTAG_36h11:0.15", 3)])
def test_corners_of_rendered_markers_follow_the_half_pixel_rule(text: str, marker_id: int) -> None:
    import cv2

    rng = np.random.default_rng(5)
    kind = parse_marker(text)
    poses, xyz = marker_poses(rng, 4, distance=5.0), 1.2 * _SQUARE @ rigid3.exp_so3([0.2, -0.1, 0.3]).T
    code = cv2.aruco.DICT_4X4_50 if "4X4" in text else cv2.aruco.DICT_APRILTAG_36h11
    detector, errors, found = MarkerDetector(kind.dictionary), [], []
    for k, pose in enumerate(poses):
        ids, corners = detector.detect(render_marker(pose, xyz, code, marker_id))
        assert ids.tolist() == [marker_id]
        errors.append(corners[0] - project(SMALL_CAMERA, rigid3.apply(pose, xyz)))
        found.append((k, corners[0]))
    # a missing half pixel would be a mean of 0.5; sub-pixel corners are good to a tenth or two
    assert np.abs(np.mean(errors, (0, 1))).max() < 0.1
    assert np.sqrt(np.mean(np.square(errors))) < 0.25
    sightings = MarkerSightings(np.array([f[0] for f in found]), np.full(4, marker_id), np.array([f[1] for f in found]))
    scale = scale_from_markers(no_points(poses, SMALL_CAMERA), sightings, kind.side)
    assert isinstance(scale, ScaleEstimate)
    assert scale.scale == pytest.approx(0.15 / 1.2, rel=0.01)


def test_marker_options_are_parsed() -> None:
    assert parse_marker("apriltag_36H11:0.08").dictionary == "APRILTAG_36H11"
    for wrong in ("4X4_50", "DICT_9X9:0.1", "4X4_50:x", "4X4_50:0"):
        with pytest.raises(UsageError):
            parse_marker(wrong)
    assert MarkerDetector("4X4_50").detect(np.full((50, 60), 128, np.uint8))[1].shape == (0, 4, 2)


# ---- the ground


def street(
    seed: int,
    *,
    with_ground: bool = True,
    depth_noise: float = 0.02,
    pitch_deg: float = 0.0,
    indoors: bool = False,
) -> Reconstruction:
    """A camera 1.65 m over a street with walls, kerbs and parked boxes, in a map of unit 2.5 m; or a table 0.75 m high.

    The points' errors are along their rays and grow with the distance, as those of triangulation do.
    """
    rng = np.random.default_rng([seed, 3])
    num = 24
    x = 0.3 * np.sin(np.arange(num) / 6)
    nod = rigid3.exp_so3(np.radians(pitch_deg + rng.normal(0, 0.5, num))[:, None] * np.array([1.0, 0.0, 0.0]))
    centers = np.stack([x, rng.normal(0, 0.01, num), 1.0 * np.arange(num)], 1)
    poses = rigid3.from_matrix(nod, -np.einsum("nij,nj->ni", nod, centers))
    n = 3000
    z, side = rng.uniform(0, 60, n), rng.choice([-1, 1], n)
    walls = np.stack([side * rng.uniform(5, 6, n), rng.uniform(-3, 1.6, n), z], 1)
    boxes = np.stack([side * rng.uniform(2.5, 4, n), rng.uniform(0.2, 1.6, n), z], 1)
    ground = np.stack([rng.uniform(-5, 5, n), 1.65 + rng.normal(0, 0.01, n), z], 1)
    table = np.stack([rng.uniform(-5, 0, n), 0.9 + rng.normal(0, 0.003, n), z], 1)
    share = [walls[:1200], boxes[:600]]
    share += [ground[:500]] if with_ground else []
    share += [table[:400]] if indoors else []
    xyz = np.concatenate(share)
    image, point, xy = [], [], []
    for k, pose in enumerate(poses):
        local = rigid3.apply(pose, xyz)
        pixel = project(CAMERA, local)
        seen = (local[:, 2] > 1) & (local[:, 2] < 25) & (pixel > 0).all(1) & (pixel < [640, 480]).all(1)
        image.append(np.full(seen.sum(), k))
        point.append(np.flatnonzero(seen))
        xy.append(pixel[seen])
    point_idx = np.concatenate(point)
    tracks = make_tracks(num, len(xyz), point_idx, np.concatenate(image), point_idx, np.concatenate(xy))
    model = Reconstruction.empty([CAMERA], [f"{k}" for k in range(num)], np.zeros(num, np.int32), tracks)
    model.cam_from_world[:] = poses
    # each point along the ray of the keyframe that first came near it
    anchor = centers[np.clip(np.searchsorted(centers[:, 2], xyz[:, 2]) - 6, 0, num - 1)]
    away = xyz - anchor
    factor = np.exp(depth_noise * np.linalg.norm(away, axis=1) / 10 * rng.normal(size=len(xyz)))
    model.point_xyz[:] = anchor + away * factor[:, None]
    model.obs_is_inlier[:] = True
    return apply_scale(model, 1 / 2.5)


@pytest.mark.parametrize("case", [{}, {"pitch_deg": 8.0}, {"indoors": True}, {"depth_noise": 0.05}])
def test_camera_height_gives_the_scale(case: dict[str, float]) -> None:
    scores, errors = [], []
    for seed in range(6):
        model = street(seed, **case)
        found = scale_from_camera_height(model, np.arange(24), Length(1.65))
        assert isinstance(found, ScaleEstimate), found
        errors.append(found.scale / 2.5 - 1)
        scores.append(errors[-1] / found.sigma_relative)
        assert found.evidence["num_keyframes_with_ground"] >= 12
    assert np.abs(errors).max() < 0.03
    assert 0.05 < np.sqrt(np.mean(np.square(scores))) < 2.0


def test_no_ground_no_scale() -> None:
    for seed in range(4):
        refusal = scale_from_camera_height(street(seed, with_ground=False), np.arange(24), Length(1.65))
        assert isinstance(refusal, ScaleRefusal), refusal
        assert refusal.evidence["num_keyframes"] == 24
    # there is nothing above the camera
    wrong = GroundOptions(down_in_cam=(0.0, -1.0, 0.0))
    assert isinstance(scale_from_camera_height(street(0), np.arange(24), Length(1.65), wrong), ScaleRefusal)
    assert isinstance(scale_from_camera_height(street(0), np.arange(3), Length(1.65)), ScaleRefusal)


def test_same_map_same_scale() -> None:
    first, second = (scale_from_camera_height(street(1), np.arange(24), Length(1.65)) for _ in range(2))
    assert first == second
