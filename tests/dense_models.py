"""Small models with known surfaces: cameras in a row before a wall, a COLMAP model and the photographs of it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized, project
from sfmapp.formats.colmap import write_model, write_model_text
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]

PINHOLE = Camera(CameraModel.PINHOLE, 200, 140, np.array([180.0, 181.0, 101.3, 68.6]))
DEPTH, STEP = 4.0, 0.35
# texels for a unit of the world
TEXELS = 100.0


@cache
def texture(seed: int = 0, size: int = 1600) -> NDArray[np.uint8]:
    """(size, size, 3) coloured noise without detail below two or three texels."""
    rng = np.random.default_rng(seed)
    image = sum(
        cv2.resize(rng.normal(0.0, 22.0, (size // step, size // step, 3)), (size, size), interpolation=cv2.INTER_CUBIC)
        for step in (4, 8, 16, 32)
    )
    return np.clip(np.rint(128.0 + np.asarray(image)), 0, 255).astype(np.uint8)


def row_of_poses(count: int, step: float = STEP) -> Array:
    """(count, 7) cameras along x that turn towards the middle of the wall, the world's axes those of the middle one."""
    poses = []
    for x in step * (np.arange(count) - (count - 1) / 2):
        rotation = rigid3.exp_so3(np.array([0.0, np.arctan2(x, DEPTH), 0.0]))
        poses.append(rigid3.from_matrix(rotation, -rotation @ [x, 0.02 * np.sin(5 * x), 0.0]))
    return np.array(poses)


def see_wall(camera: Camera, pose: Array, wall: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) photograph of the plane z = DEPTH, exact but for the sampling of its texture."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    flat = pixels_to_normalized(camera, np.stack([u.ravel(), v.ravel()], axis=1))
    rays = np.nan_to_num(np.concatenate([flat, np.ones((len(flat), 1))], axis=1)) @ rigid3.rotation_matrix(pose)
    center = rigid3.center(pose)
    hit = center + rays * ((DEPTH - center[2]) / rays[:, 2])[:, None]
    place = (hit[:, :2] * TEXELS + wall.shape[0] / 2 - 0.5).astype(np.float32).reshape(camera.height, camera.width, 2)
    return cv2.remap(wall, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def make_model(cameras: Sequence[Camera], poses: Array, num_points: int = 120, suffix: str = "png") -> Reconstruction:
    """Cameras with points on the wall that they see."""
    rng = np.random.default_rng(1)
    xyz = np.stack([*rng.uniform([[-2.0], [-1.2]], [[2.0], [1.2]], (2, num_points)), np.full(num_points, DEPTH)], 1)
    rows = []
    for m, (camera, pose) in enumerate(zip(cameras, poses, strict=True)):
        xy = project(camera, rigid3.apply(pose, xyz))
        inside = (xy > 0).all(axis=1) & (xy < [camera.width, camera.height]).all(axis=1)
        rows += [(p, m, *xy[p]) for p in np.flatnonzero(inside)]
    table = np.array(rows).reshape(-1, 4)
    track, image = table[:, 0].astype(int), table[:, 1].astype(int)
    feature = np.zeros(len(table), int)
    for m in range(len(poses)):
        feature[image == m] = np.arange((image == m).sum())
    counts = np.bincount(track, minlength=num_points)
    kept = counts[track] >= 2
    number = np.cumsum(counts >= 2) - 1
    tracks = make_tracks(
        len(poses), int((counts >= 2).sum()), number[track[kept]], image[kept], feature[kept], table[kept, 2:]
    )
    names = [f"view_{m}.{suffix}" for m in range(len(poses))]
    model = Reconstruction.empty(list(cameras), names, np.arange(len(poses), dtype=np.int32), tracks)
    model.cam_from_world, model.point_xyz = poses.copy(), xyz[counts >= 2]
    model.obs_is_inlier[:] = True
    return model


def write_wall(
    folder: Path, count: int = 5, camera: Camera = PINHOLE, *, step: float = STEP, num_points: int = 120,
    wall: NDArray[np.uint8] | None = None, text: bool = False,
) -> Reconstruction:  # fmt: skip
    """Write ``folder/sparse/0`` and ``folder/images``; returns the model."""
    poses = row_of_poses(count, step)
    model = make_model([camera] * count, poses, num_points)
    wall = texture() if wall is None else wall
    (folder / "images").mkdir(parents=True)
    for name, pose in zip(model.image_names, poses, strict=True):
        cv2.imwrite(str(folder / "images" / name), see_wall(camera, pose, wall)[:, :, ::-1])
    (write_model_text if text else write_model)(folder / "sparse" / "0", model)
    return model
