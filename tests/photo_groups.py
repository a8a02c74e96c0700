"""Groups of photographs along one facade that overlap weakly: cameras, points and what a matcher would find.

No images: matches are drawn from the ground truth, thinned between groups, with mismatches that lie near the epipolar
    lines,
as those do that pass a verification.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from sfmapp.camera.camera import CameraModel, project, simple_camera
from sfmapp.geometry import rigid3
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene, true_correspondences
from sfmapp.scene.tracks import make_tracks

WIDTH, HEIGHT = 1200, 900


@dataclass(frozen=True)
class Place:
    """Groups of one place: the scene, the group of each image, and what mapping is given."""

    scene: SyntheticScene
    group: np.ndarray
    image_set: SimpleNamespace
    features: list[Features]
    correspondences: Correspondences

    def of_images(self, chosen: np.ndarray) -> Correspondences:
        """The correspondences with the pairs of other images emptied."""
        return thinned(self.correspondences, lambda p, matches: chosen[self.correspondences.pair_image_idx[p]].all())


def make_place(
    seed: int, num_groups: int, *, images: int = 6, points: int = 500, overlap: float = 0.25, between: float = 0.3,
    depth: float = 1.5,
) -> Place:  # fmt: skip
    """Draw a place.

    Args:
        seed: same seed, same place.
        num_groups: along the facade, each with a camera of its own that nobody knows.
        images: of each group, a metre and a half apart.
        points: on the piece of the facade that a group looks at.
        overlap: share of the width of its pictures that a group shares with the next.
        between: share of the true matches that are found between groups.
        depth: of the facade, in metres to either side.
    """
    rng = np.random.default_rng([seed, 0x6509])
    cameras, poses, group, centers_x, x0 = [], [], [], [], 0.0
    for g in range(num_groups):
        focal, distance = rng.uniform(0.8, 1.5) * WIDTH, rng.uniform(7.0, 11.0)
        half = 0.5 * distance * WIDTH / focal
        x0 = half if g == 0 else centers_x[-1][1] + half - overlap * 2 * half
        centers_x.append((x0, x0 + half))
        cameras.append(simple_camera(CameraModel.SIMPLE_RADIAL, WIDTH, HEIGHT, focal))
        offsets = 1.5 * (np.arange(images) - 0.5 * (images - 1))
        eye = np.stack([x0 + offsets, rng.normal(0, 0.3, images), -distance + rng.normal(0, 0.5, images)], 1)
        look = np.stack([x0 + rng.normal(0, 0.3, images), rng.normal(0, 0.2, images), np.zeros(images)], 1)
        poses += [_look_at(e, target) for e, target in zip(eye, look, strict=True)]
        group += [g] * images
    low, high = -1.0, centers_x[-1][1] + 1.0
    num = int(points * (high - low) / (2 * np.mean([b - a for a, b in centers_x])))
    xyz = np.stack([rng.uniform(low, high, num), rng.uniform(-3, 3, num), rng.uniform(-depth, depth, num)], 1)
    scene = _observe(cameras, np.array(poses), np.array(group, np.int32), xyz, rng)
    return _place(scene, np.array(group), between, rng)


def _look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return rigid3.from_matrix(rotation, -rotation @ eye)


def _observe(cameras, poses, camera_idx, xyz, rng, sigma_px=0.4, detection=0.8) -> SyntheticScene:
    point_idx, image_idx, exact = [], [], []
    for i, pose in enumerate(poses):
        xy = project(cameras[camera_idx[i]], rigid3.apply(pose, xyz))
        seen = np.flatnonzero(
            (xy > 0).all(1) & (xy < [WIDTH, HEIGHT]).all(1) & (rng.random(len(xyz)) < detection)  # NaN sees nothing
        )
        point_idx.append(seen)
        image_idx.append(np.full(len(seen), i))
        exact.append(xy[seen])
    feature_idx = np.concatenate([rng.permutation(len(seen)) for seen in point_idx])
    point_idx, image_idx, exact = (np.concatenate(a) for a in (point_idx, image_idx, exact))
    models = []
    for xy in (exact, exact + rng.normal(0.0, sigma_px, exact.shape)):
        tracks = make_tracks(len(poses), len(xyz), point_idx, image_idx, feature_idx, xy)
        model = Reconstruction.empty(cameras, [f"{i:03d}.jpg" for i in range(len(poses))], camera_idx, tracks)
        model.cam_from_world[:], model.point_xyz[:], model.obs_is_inlier[:] = poses, xyz, True
        models.append(model)
    return SyntheticScene(models[0], models[1], np.zeros(len(point_idx), bool))


def _place(scene: SyntheticScene, group: np.ndarray, between: float, rng: np.random.Generator) -> Place:
    found = true_correspondences(scene)
    pairs = found.pair_image_idx
    same = group[pairs[:, 0]] == group[pairs[:, 1]]
    keep = rng.random(len(found.matches)) < np.where(same, 0.9, between).repeat(found.num_inliers)
    found = thinned(found, lambda p, matches: keep[found.pair_ptr[p] : found.pair_ptr[p + 1]], min_matches=15)
    keypoints = [scene.keypoints(i) for i in range(len(group))]
    matches = []
    for p, (i, j) in enumerate(pairs):
        true = found.matches_of_pair(p)
        share = 0.03 if same[p] else 0.2
        wrong = _mismatches(found.fundamental[p], keypoints[i], keypoints[j], int(share * len(true)), rng)
        matches.append(np.concatenate([true, wrong]).astype(np.int32))
    counts = np.array([len(m) for m in matches], np.int64)
    found = replace(
        found, matches=np.concatenate(matches), pair_ptr=np.concatenate([[0], np.cumsum(counts)]),
        num_inliers_f=counts.astype(np.int32),
    )  # fmt: skip
    unknown = [simple_camera(CameraModel.SIMPLE_RADIAL, WIDTH, HEIGHT, 1.2 * WIDTH, 0.6 * WIDTH)] * (max(group) + 1)
    records = [SimpleNamespace(name=f"{i:03d}.jpg", camera_idx=int(g)) for i, g in enumerate(group)]
    features = [
        Features(
            np.concatenate([xy, np.ones_like(xy)], 1).astype(np.float32), np.zeros((len(xy), 128), np.uint8),
            np.full((len(xy), 3), 7, np.uint8),
        )
        for xy in keypoints
    ]  # fmt: skip
    image_set = SimpleNamespace(images=records, cameras=tuple(unknown), skipped=())
    return Place(scene, group, image_set, features, found)


def _mismatches(f, xy1, xy2, count, rng) -> np.ndarray:
    """Matches (K, 2) of keypoints that lie within a pixel of each other's epipolar line by chance."""
    if count == 0 or not np.isfinite(f).all():
        return np.zeros((0, 2), int)
    first = rng.choice(len(xy1), min(4 * count, len(xy1)), replace=False)
    lines = np.concatenate([xy1[first], np.ones((len(first), 1))], 1) @ f.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    near = np.abs(lines[:, :2] @ xy2.T + lines[:, 2:]) < 1.0
    rows = np.flatnonzero(near.any(1))[:count]
    return np.array([(first[r], rng.choice(np.flatnonzero(near[r]))) for r in rows], int).reshape(-1, 2)


def thinned(found: Correspondences, keep, min_matches: int = 1) -> Correspondences:
    """Correspondences with the matches that keep(p, matches) (bool or (K,) bool) leaves; small pairs are emptied."""
    matches, config = [], found.config.copy()
    for p in range(found.num_pairs):
        own = found.matches_of_pair(p)
        own = own[np.broadcast_to(keep(p, own), len(own))]
        if len(own) < min_matches:
            own, config[p] = own[:0], 0
        matches.append(own)
    counts = [len(m) for m in matches]
    return replace(
        found, matches=np.concatenate(matches), pair_ptr=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        config=config,
    )  # fmt: skip
