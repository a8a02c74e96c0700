"""Synthetic scenes with known ground truth and noise knobs: for tests, benchmarks and trying things out.

Everything is drawn from a seed. Visibility is physical enough to give tracks of real shape: a point has a normal and is
seen from the front side only, inside the image, and detected with some probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, bearings, project, simple_camera
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig, RigImages
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]
Layout = Literal["ring", "grid", "forward", "inside"]

_DISTORTION = {
    "k1": -0.08, "k2": 0.02, "p1": 5e-4, "p2": -4e-4, "k3": -0.004, "k4": 0.001, "k5": 5e-4, "k6": 2e-4, "k0": -0.03,
    "p0": 3e-4, "s0": 2e-4, "s1": -3e-4, "s2": 2e-4, "s3": 1e-4, "s4": -2e-4, "sx1": 4e-4, "sy1": -3e-4, "k": -0.07,
    "omega": 0.6, "alpha": 0.55, "beta": 0.05, "s": 2.5,
}  # fmt: skip


@dataclass(frozen=True)
class SyntheticScene:
    """A scene and what was observed of it.

    Attributes:
        ground_truth: every image registered, every point triangulated, exact observations.
        observed: the same poses and points beside noisy observations, all of them marked as inliers; start from
            ``perturb(scene.observed, ...)`` or from ``Reconstruction.empty`` with its cameras and tracks.
        obs_is_outlier: (O,) bool, which observations were replaced by a random pixel.
    """

    ground_truth: Reconstruction
    observed: Reconstruction
    obs_is_outlier: NDArray[np.bool_]

    def keypoints(self, image_idx: int) -> Array:
        """(N, 2) float64 observed pixels of one image, by feature position."""
        tracks = self.observed.tracks
        obs = tracks.observations_of_image(image_idx)
        xy = np.empty((len(obs), 2))
        xy[tracks.obs_feature_idx[obs]] = tracks.obs_xy[obs]
        return xy


def synthetic_camera(
    model: CameraModel = CameraModel.SIMPLE_RADIAL, width: int = 1000, height: int = 750, focal: float = 900.0
) -> Camera:
    """A camera with mild distortion in every coefficient that the model has, and an off-centre principal point."""
    params = simple_camera(model, width, height, focal).params.copy()
    offset = {"fy": 3.0, "cx": 4.0, "cy": -3.0} | _DISTORTION
    for i, name in enumerate(PARAM_NAMES[model]):
        params[i] += offset.get(name, 0.0)
    return Camera(model, width, height, params)


def synthetic_rig(baseline: float = 0.3, model: CameraModel = CameraModel.PINHOLE) -> Rig:
    """Two cameras side by side, the right one ``baseline`` away in units of the scene and turned by a few degrees."""
    turn = rigid3.exp_so3([0.02, -0.04, 0.03])
    mount = rigid3.from_matrix(turn, turn @ [-baseline, 0.03 * baseline, -0.05 * baseline])
    cameras = (synthetic_camera(model), synthetic_camera(model, focal=880.0))
    return Rig(cameras, np.stack([rigid3.IDENTITY, mount]))


def make_scene(
    seed: int = 0,
    num_images: int = 10,
    num_points: int = 500,
    cameras: Camera | Sequence[Camera] | None = None,
    *,
    sigma_px: float = 0.5,
    outlier_ratio: float = 0.0,
    layout: Layout = "ring",
    detection: float = 0.9,
    rig: Rig | None = None,
) -> SyntheticScene:
    """Draw a scene.

    Args:
        seed: same seed, same scene.
        num_images, num_points: every point is seen by at least two images.
        cameras: one for all images, or several, dealt out in turn (as many as images: one each); None for a
            :func:`synthetic_camera`, or those of the rig.
        sigma_px: standard deviation of the pixel noise in each coordinate.
        outlier_ratio: share of the observations replaced by a random pixel of the image.
        layout: ``ring`` of inward cameras around an object, ``grid`` of aerial views, ``forward`` motion down a
            street, or ``inside`` a hollow, looking anywhere.
        detection: probability that a visible point is observed.
        rig: of S cameras, that takes S images at once, with constant places on it: image S k + s is that of sensor s
            at frame k. ``num_images``, a multiple of S, counts them all. None for images that are on no rig.

    The scene is a few units across; the mean distance from camera to point is 3 to 6.
    """
    rng = np.random.default_rng([seed, 0x5CE4E])
    if cameras is None:
        cameras = rig.cameras if rig is not None else synthetic_camera()
    camera_list = [cameras] if isinstance(cameras, Camera) else list(cameras)
    image_camera_idx = (np.arange(num_images) % len(camera_list)).astype(np.int32)
    mounted = _rig_images(rig, num_images) if rig is not None else None
    if mounted is None:
        poses = _poses(layout, num_images, rng)
    else:
        frames = _poses(layout, int(mounted.frame_idx[-1]) + 1, rng)
        poses = mounted.cam_from_world(np.arange(num_images), frames[mounted.frame_idx])
    views = _Views(camera_list, image_camera_idx, poses)
    xyz, visible = _points_and_visibility(layout, num_points, views, detection, rng)
    scene = _observe(seed, views, xyz, visible, rng, sigma_px=sigma_px, outlier_ratio=outlier_ratio)
    scene.ground_truth.rig = scene.observed.rig = mounted
    return scene


class _Views(NamedTuple):
    """Images (I) before they see anything: cameras, the position (I,) of each image's own, and poses (I, 7)."""

    cameras: list[Camera]
    camera_idx: NDArray[np.int32]
    poses: Array


def _observe(
    seed: int, views: _Views, xyz: Array, visible: NDArray[np.bool_], rng: np.random.Generator, *, sigma_px: float,
    outlier_ratio: float = 0.0,
) -> SyntheticScene:  # fmt: skip
    """The scene of points (N, 3) that images see as ``visible`` (N, I) tells, with pixel noise and outliers."""
    camera_list, image_camera_idx, poses = views
    num_images, num_points = len(poses), len(xyz)
    point_idx, image_idx = np.nonzero(visible)
    exact = np.empty((len(point_idx), 2))
    for i in range(num_images):
        seen = image_idx == i
        exact[seen] = project(camera_list[image_camera_idx[i]], rigid3.apply(poses[i], xyz[point_idx[seen]]))
    feature_idx = _feature_positions(image_idx, num_images, rng)
    noisy = exact + rng.normal(0.0, sigma_px, exact.shape) if sigma_px > 0 else exact.copy()
    is_outlier = rng.random(len(exact)) < outlier_ratio
    sizes = np.array([(c.width, c.height) for c in camera_list], np.float64)[image_camera_idx[image_idx]]
    noisy[is_outlier] = (rng.random(exact.shape) * sizes)[is_outlier]
    models = []
    for xy in (exact, noisy):
        tracks = make_tracks(num_images, num_points, point_idx, image_idx, feature_idx, xy)
        names = [f"image{i:04d}.jpg" for i in range(num_images)]
        model = Reconstruction.empty(camera_list, names, image_camera_idx, tracks)
        model.cam_from_world[:] = poses
        model.point_xyz[:] = xyz
        model.obs_is_inlier[:] = True
        model.point_rgb[:] = np.random.default_rng([seed, 1]).integers(0, 256, (num_points, 3), np.uint8)
        models.append(model)
    # the observations come sorted by point and image from np.nonzero, the order that make_tracks keeps
    return SyntheticScene(models[0], models[1], is_outlier)


def perturb(
    reconstruction: Reconstruction,
    *,
    rotation_deg: float = 0.0,
    translation_fraction: float = 0.0,
    point_fraction: float = 0.0,
    focal_fraction: float = 0.0,
    seed: int = 0,
) -> Reconstruction:
    """A copy with Gaussian noise on its state.

    Args:
        rotation_deg: standard deviation of each camera's rotation about each axis, degrees; the centre stays. A rig
            moves as one, about the centre of its sensor 0.
        translation_fraction, point_fraction: standard deviation of each coordinate of the centres and of the points, as
            a share of the scene's size (the rms distance of the centres from their mean).
        focal_fraction: standard deviation of each camera's focal lengths, as a share.
    """
    rng = np.random.default_rng([seed, 0x9E47])
    out = reconstruction.copy()
    registered = out.registered_idx
    poses, pose_of_image = out.distinct_poses(registered)
    centers = rigid3.center(poses)
    size = np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean()) if len(registered) else 0.0
    turn = rigid3.exp_so3(np.radians(rotation_deg) * rng.normal(size=(len(poses), 3)))
    rotation = turn @ rigid3.rotation_matrix(poses)
    centers = centers + translation_fraction * size * rng.normal(size=centers.shape)
    poses = rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))
    out.move_images(registered, poses[pose_of_image])
    out.point_xyz += point_fraction * size * rng.normal(size=out.point_xyz.shape)
    for c, camera in enumerate(out.cameras):
        is_focal = np.array([kind_of(name) == "focal" for name in PARAM_NAMES[camera.model]])
        factor = 1.0 + focal_fraction * rng.normal()
        out.cameras[c] = camera.with_params(np.where(is_focal, camera.params * factor, camera.params))
    return out


def true_correspondences(scene: SyntheticScene, min_matches: int = 15) -> Correspondences:
    """What a perfect matcher would find: for every pair of images the shared tracks (outliers left out), with the true
    two-view geometry. Pairs with fewer than ``min_matches`` stay in as failures.

    Feature positions are those of ``scene.observed.tracks.obs_feature_idx``.
    """
    tracks, ground_truth = scene.observed.tracks, scene.ground_truth
    feature = np.full((tracks.num_images, tracks.num_tracks), -1, np.int32)
    good = ~scene.obs_is_outlier
    feature[tracks.obs_image_idx[good], tracks.obs_track_idx[good]] = tracks.obs_feature_idx[good]
    pairs = np.stack(np.triu_indices(tracks.num_images, 1), 1).astype(np.int32)
    num = len(pairs)
    matrices = {name: np.full((num, 3, 3), np.nan) for name in ("fundamental", "essential", "homography")}
    relative = np.full((num, 7), np.nan)
    angle = np.full(num, np.nan)
    config = np.zeros(num, np.int8)
    matches: list[NDArray[np.int32]] = []
    putative = np.zeros(num, np.int32)
    centers = ground_truth.centers
    for p, (i, j) in enumerate(pairs):
        shared = np.flatnonzero((feature[i] >= 0) & (feature[j] >= 0))
        putative[p] = len(shared)
        if len(shared) < min_matches:
            matches.append(np.zeros((0, 2), np.int32))
            continue
        matches.append(np.stack([feature[i, shared], feature[j, shared]], 1))
        config[p] = TwoViewConfig.CALIBRATED
        pose = rigid3.compose(ground_truth.cam_from_world[j], rigid3.inverse(ground_truth.cam_from_world[i]))
        pose[4:] /= np.linalg.norm(pose[4:])
        relative[p] = pose
        essential = rigid3.skew(pose[4:]) @ rigid3.rotation_matrix(pose)
        k_i, k_j = (ground_truth.cameras[ground_truth.image_camera_idx[a]].k_matrix for a in (i, j))
        matrices["essential"][p] = essential
        matrices["fundamental"][p] = np.linalg.inv(k_j).T @ essential @ np.linalg.inv(k_i)
        rays = [_unit(ground_truth.point_xyz[shared] - centers[a]) for a in (i, j)]
        angle[p] = np.degrees(np.median(np.arccos(np.clip((rays[0] * rays[1]).sum(1), -1, 1))))
    counts = np.array([len(m) for m in matches], np.int64)
    found = counts.astype(np.int32)
    return Correspondences(
        pairs, np.concatenate([[0], np.cumsum(counts)]), np.concatenate([*matches, np.zeros((0, 2), np.int32)]), config,
        **matrices, cam2_from_cam1=relative, median_angle_deg=angle, num_putative=putative,
        num_inliers_f=found, num_inliers_e=found.copy(), num_inliers_h=np.zeros(num, np.int32),
    )  # fmt: skip


def make_look_alike(
    seed: int = 0, num_images: int = 24, num_points: int = 2400, *, sides: int = 2, background: float = 0.5
) -> tuple[SyntheticScene, Correspondences]:
    """A ring of cameras round a thing whose sides look alike, and what a good matcher finds, which takes sides for
    one another.

    A keypoint is matched where one point in the other image looks like it, rarer the more the view has changed; of the
    matches of a pair, those are verified that most others agree with, be they of the same side or of another one.

    Args:
        sides: how often the thing looks the same as it turns once.
        background: share of the points that lie behind it all round and look like no other.
    """
    rng = np.random.default_rng([seed, 0xA11CE])
    camera = synthetic_camera()
    poses = _poses("ring", num_images, rng)
    turns = rigid3.exp_so3(np.outer(np.arange(sides), [0.0, 0.0, 2 * np.pi / sides]))
    num_alike = round((1.0 - background) * num_points / sides)
    one_side, normals = _surface("ring", num_alike, poses, rng)
    num_behind = num_points - sides * num_alike
    angle = rng.uniform(0.0, 2 * np.pi, num_behind)
    inward = -np.stack([np.cos(angle), np.sin(angle), np.zeros(num_behind)], 1)
    behind = -rng.uniform(5.0, 7.0, (num_behind, 1)) * inward
    behind[:, 2] = rng.uniform(-3.0, 3.0, num_behind)
    xyz = np.concatenate([*(one_side @ turn.T for turn in turns), behind])
    normals = np.concatenate([*(normals @ turn.T for turn in turns), inward])
    looks_like = np.concatenate([np.tile(np.arange(num_alike), sides), np.arange(num_behind) + num_alike])
    visible = rng.random((len(xyz), num_images)) < 0.9
    for i, pose in enumerate(poses):
        view = _unit(xyz - rigid3.center(pose))
        passes_by = np.linalg.norm(np.cross(np.broadcast_to(rigid3.center(pose), view.shape), view), axis=1) > 1.0
        visible[:, i] &= _sees(camera, pose, xyz, normals) & (passes_by | (np.arange(len(xyz)) < sides * num_alike))
    kept = visible.sum(1) >= 2
    xyz, visible, looks_like = xyz[kept], visible[kept], looks_like[kept]
    side = np.where(kept, np.minimum(np.arange(len(kept)) // max(num_alike, 1), sides), 0)[kept]
    scene = _observe(seed, _Views([camera], np.zeros(num_images, np.int32), poses), xyz, visible, rng, sigma_px=0.5)
    return scene, _alike_correspondences(scene, looks_like, side, turns, rng)


def _alike_correspondences(
    scene: SyntheticScene, looks_like: NDArray[np.int64], side: NDArray[np.int64], turns: Array,
    rng: np.random.Generator,
) -> Correspondences:  # fmt: skip
    """Verified matches between points that look alike: of each pair those of the turn that most agree with."""
    tracks, poses, sides = scene.observed.tracks, scene.ground_truth.cam_from_world, len(turns)
    # what each image sees of what looks the same: the observation if it is one, else none
    obs_of = np.full((tracks.num_images, looks_like.max() + 1), -1)
    count = np.zeros(obs_of.shape, np.int64)
    kind = looks_like[tracks.obs_track_idx]
    obs_of[tracks.obs_image_idx, kind] = np.arange(tracks.num_observations)
    np.add.at(count, (tracks.obs_image_idx, kind), 1)
    obs_of[count != 1] = -1
    found = true_correspondences(scene, min_matches=1)
    matches: list[NDArray[np.int32]] = []
    for p, (i, j) in enumerate(found.pair_image_idx):
        both = np.flatnonzero((obs_of[i] >= 0) & (obs_of[j] >= 0))
        one, other = (side[tracks.obs_track_idx[obs_of[a, both]]] for a in (i, j))
        turn = (other - one) % sides
        is_behind = one == sides  # what looks like nothing else is matched with itself
        turn[is_behind] = 0
        centers = [rigid3.center(poses[a]) for a in (i, j)]
        kept = np.zeros(0, np.int64)
        for t in range(sides):
            # the other camera as it would stand if both saw the same side
            cosine = float(_unit(centers[0]) @ _unit(turns[t].T @ centers[1]))
            share = 0.5 ** (np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) / 15.0)
            agree = both[(turn == t) & (rng.random(len(both)) < share)]
            if len(agree) > len(kept):
                kept = agree
                turned = rigid3.from_matrix(turns[t], np.zeros(3))
                pose = rigid3.compose(rigid3.compose(poses[j], turned), rigid3.inverse(poses[i]))
                baseline = float(np.linalg.norm(pose[4:]))
                found.cam2_from_cam1[p] = np.append(pose[:4], pose[4:] / max(baseline, 1e-9))
        kept = kept if len(kept) >= 15 else kept[:0]
        found.config[p] = TwoViewConfig.CALIBRATED if len(kept) else TwoViewConfig.UNDEFINED
        pair = np.stack([tracks.obs_feature_idx[obs_of[a, kept]] for a in (i, j)], 1)
        matches.append(pair.astype(np.int32))
    counts = np.array([len(m) for m in matches])
    return replace(found, pair_ptr=np.concatenate([[0], np.cumsum(counts)]), matches=np.concatenate(matches))


def _rig_images(rig: Rig, num_images: int) -> RigImages:
    frame, sensor = np.divmod(np.arange(num_images, dtype=np.int32), len(rig.cameras))
    if num_images % len(rig.cameras):
        raise ValueError(
            f"expected a multiple of {len(rig.cameras)} images, one for each camera of the rig, got {num_images}"
        )
    return RigImages(frame, sensor, rig.cam_from_rig)


def _unit(v: Array) -> Array:
    unit: Array = v / np.linalg.norm(v, axis=-1, keepdims=True)
    return unit


def _look_at(centers: Array, targets: Array, down: Array) -> Array:
    """Poses (I, 7) of cameras that look from centres to targets with the image's y axis along ``down``."""
    z = _unit(targets - centers)
    x = _unit(np.cross(np.broadcast_to(down, z.shape), z))
    rotation = np.stack([x, np.cross(z, x), z], -2)
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def _poses(layout: Layout, num: int, rng: np.random.Generator) -> Array:
    jitter = rng.normal(0.0, 0.1, (num, 3))
    if layout == "ring":
        angle = np.arange(num) * min(2 * np.pi / num, np.radians(36))  # few images make an arc, not a thin ring
        centers = np.stack([4 * np.cos(angle), 4 * np.sin(angle), 0.8 + 0.4 * np.sin(3 * angle)], 1) + jitter
        return _look_at(centers, rng.normal(0.0, 0.15, (num, 3)), np.array([0.0, 0.0, -1.0]))
    if layout == "grid":
        columns = int(np.ceil(np.sqrt(num)))
        row, column = np.divmod(np.arange(num), columns)
        centers = np.stack([column - (columns - 1) / 2, row - (columns - 1) / 2, np.full(num, 3.0)], 1) + jitter
        targets = centers * [1.0, 1.0, 0.0] + rng.normal(0.0, 0.3, (num, 3)) * [1.0, 1.0, 0.0]
        return _look_at(centers, targets, np.array([0.0, -1.0, 0.0]))
    if layout == "inside":
        centers = rng.uniform(-1.0, 1.0, (num, 3))
        return _look_at(centers, centers + rng.normal(size=(num, 3)), np.array([0.0, 0.0, -1.0]))
    if layout != "forward":
        raise ValueError(f"layout must be ring, grid, forward or inside, got {layout!r}")
    centers = np.stack([np.zeros(num), np.zeros(num), 0.6 * np.arange(num)], 1) + jitter
    return _look_at(centers, centers + [0.0, 0.0, 5.0] + 3 * jitter, np.array([0.0, 1.0, 0.0]))


def _surface(layout: Layout, num: int, poses: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (num, 3) on the scene's surface and their unit normals."""
    if layout == "ring":
        normals = _unit(rng.normal(size=(num, 3)))
        return normals * rng.uniform(0.7, 1.3, (num, 1)), normals
    if layout == "inside":
        outward = _unit(rng.normal(size=(num, 3)))
        return outward * rng.uniform(2.5, 4.0, (num, 1)), -outward
    centers = rigid3.center(poses)
    low, high = centers.min(0), centers.max(0)
    if layout == "grid":
        xy = rng.uniform(low[:2] - 1.0, high[:2] + 1.0, (num, 2))
        z = 0.5 * np.sin(1.7 * xy[:, 0]) * np.cos(1.3 * xy[:, 1]) + rng.normal(0.0, 0.1, num)
        return np.column_stack([xy, z]), np.tile([0.0, 0.0, 1.0], (num, 1))
    depth = rng.uniform(low[2] + 1.0, high[2] + 8.0, num)
    side = rng.integers(0, 3, num)  # left wall, right wall, ground
    across = rng.uniform(-1.5, 1.5, num)
    x = np.where(side == 2, across, np.where(side == 0, -1.5, 1.5)) + rng.normal(0.0, 0.1, num)
    y = np.where(side == 2, 1.0, across - 0.5) + rng.normal(0.0, 0.1, num)
    normals = np.array([[1.0, 0.0, -0.5], [-1.0, 0.0, -0.5], [0.0, -1.0, -0.5]])[side]
    return np.stack([x, y, depth], 1), _unit(normals)


def _points_and_visibility(
    layout: Layout, num: int, views: _Views, detection: float, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]]:
    """Points that at least two images see, and (num, I) bool which do."""
    cameras, camera_idx, poses = views
    kept: list[tuple[Array, NDArray[np.bool_]]] = []
    missing = num
    for _ in range(100):
        if missing <= 0:
            break
        xyz, normals = _surface(layout, max(missing, 64), poses, rng)
        visible = rng.random((len(xyz), len(poses))) < detection
        for i, pose in enumerate(poses):
            visible[:, i] &= _sees(cameras[camera_idx[i]], pose, xyz, normals)
        good = np.flatnonzero(visible.sum(1) >= 2)[:missing]
        kept.append((xyz[good], visible[good]))
        missing -= len(good)
    if missing > 0:
        raise ValueError(f"too few points are seen by two of the {len(poses)} images; use more images or a wider lens")
    return np.concatenate([k[0] for k in kept]), np.concatenate([k[1] for k in kept])


def _sees(camera: Camera, pose: Array, xyz: Array, normals: Array) -> NDArray[np.bool_]:
    """(N,) bool: in front (or anywhere, of a wide lens), inside the image, on the front side of the surface, and where
    the lens is one to one."""
    xyz_cam = rigid3.apply(pose, xyz)
    depth = np.linalg.norm(xyz_cam, axis=1) if camera.is_wide else xyz_cam[:, 2]
    # 75 degrees off the normal is about where detectors lose a patch
    facing = (_unit(rigid3.center(pose) - xyz) * normals).sum(1) > np.cos(np.radians(75))
    near = (depth > 0.3) & (depth < 12.0)
    pixels = project(camera, xyz_cam)
    inside = (pixels > 0).all(1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    seen: NDArray[np.bool_] = near & facing & inside
    (back,) = bearings([camera], [pixels[seen]])
    there = xyz_cam[seen, : back.shape[1]] / depth[seen, None]
    seen[seen] = np.abs(back - there).max(1, initial=0.0) < 1e-6  # False for NaN
    return seen


def _feature_positions(image_idx: NDArray[np.int64], num_images: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """A random numbering of the observations within each image."""
    feature_idx = np.empty(len(image_idx), np.int64)
    for i in range(num_images):
        obs = np.flatnonzero(image_idx == i)
        feature_idx[obs] = rng.permutation(len(obs))
    return feature_idx
