"""A block of aerial photographs that look straight down, with known ground truth."""

from __future__ import annotations

import numpy as np

from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene
from sfmapp.scene.tracks import make_tracks


def nadir_block(
    seed: int, camera: Camera, *, relief: float, tilt_deg: float, jitter: float = 1.0, num_points: int = 2500
) -> SyntheticScene:
    """4 x 5 photographs from 60 m with 70 % overlap, half a pixel of noise.

    Args:
        relief: standard deviation of the heights of the ground in metres.
        tilt_deg: of the optical axes about each axis; jitter: of the centres in metres.
    """
    rng = np.random.default_rng([seed, 0x4AD1])
    height, num = 60.0, 20
    seen = np.array([camera.width, camera.height]) / camera.focal * height
    grid = np.stack([np.arange(num) % 5, np.arange(num) // 5], 1) * 0.3 * seen
    centers = np.column_stack([grid, np.full(num, height)]) + rng.normal(0.0, jitter, (num, 3))
    rotation = rigid3.exp_so3(np.radians(tilt_deg) * rng.normal(size=(num, 3))) @ np.diag([1.0, -1.0, -1.0])
    poses = rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))
    xy = rng.uniform(grid.min(0) - 0.4 * seen, grid.max(0) + 0.4 * seen, (num_points, 2))
    xyz = np.column_stack([xy, rng.normal(0.0, relief, num_points)])
    pixels = np.array([project(camera, rigid3.apply(pose, xyz)) for pose in poses]).transpose(1, 0, 2)
    visible = ((pixels > 5) & (pixels < [camera.width - 5, camera.height - 5])).all(2)
    visible &= rng.random(visible.shape) < 0.8
    kept = visible.sum(1) >= 2
    xyz, pixels = xyz[kept], pixels[kept]
    point_idx, image_idx = np.nonzero(visible[kept])
    feature_idx = np.concatenate([np.arange(n) for n in np.bincount(image_idx, minlength=num)])
    feature_idx = feature_idx[np.argsort(np.argsort(image_idx, kind="stable"))]
    exact = pixels[point_idx, image_idx]
    models = []
    for observed in (exact, exact + rng.normal(0.0, 0.5, exact.shape)):
        tracks = make_tracks(num, len(xyz), point_idx, image_idx, feature_idx, observed)
        names = [f"image{i:04d}.jpg" for i in range(num)]
        model = Reconstruction.empty([camera], names, np.zeros(num, np.int32), tracks)
        model.cam_from_world[:], model.point_xyz[:], model.obs_is_inlier[:] = poses, xyz, True
        models.append(model)
    return SyntheticScene(models[0], models[1], np.zeros(len(exact), bool))
