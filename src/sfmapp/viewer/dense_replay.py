"""What the recording of a dense result shows, as plain arrays that travel to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import ROTATION_OF, upright_pinhole, upright_pixels, upright_poses
from sfmapp.geometry.upright import up_direction
from sfmapp.scene.mesh import Mesh
from sfmapp.viewer.handover import HandedOver
from sfmapp.viewer.photos import shrunk_jpeg

Ints = NDArray[np.int64]
Float32 = NDArray[np.float32]

# steps of the timeline; more waves are shown several at a time
MAX_STEPS = 40
# in single precision that much farther from the origin than the scene is large, a millionth of its size is lost
_FAR = 100.0
# photographs in the cameras: about 10 MB for any number of views
_PHOTO_SIDE_PX, _PHOTO_BUDGET, _PHOTO_QUALITY = (160, 640), 120, 80
_SPACING_SAMPLE = 2000


@dataclass(frozen=True)
class DenseReplay(HandedOver):
    """Views (V), the shown ones (N) of the patches, waves in steps (S), and a mesh if there is one.

    Attributes:
        title: of the recording.
        num_patches: of the result, shown or not.
        origin: (3,) float64, what was taken off all places; zero unless the scene is far from the world's origin.
        up: (3,) float64 direction in the world that is up.
        view_names: V names.
        cam_from_world: (V, 7) float64, in the world that begins at ``origin``, rolled until the pictures are upright.
        view_k: (V, 4) float64 and view_size: (V, 2) int64, of the small photographs, which are upright.
        photo: (B,) uint8 JPEG files one after the other; photo_ptr: (V + 1,) their limits.
        xyz: (N, 3) float32, ordered by wave. rgb: (N, 3) uint8. radius: (N,) float32, world units.
        num_views: (N,) int64. score: (N,) float32. sigma_px: (N,) float32, in pixels of the reference image on the
            surface.
        step_wave: (S,) the last wave of each step; step_ptr: (S + 1,) the patches of step s are
            ``step_ptr[s]:step_ptr[s + 1]``.
        step_total: (S,) number of patches of the result up to the step, shown or not.
        mesh_xyz, mesh_normal: (M, 3) float32; mesh_faces: (F, 3) int32; mesh_rgb: (M, 3) uint8; no rows without a mesh.
        mesh_uv: (M, 2) float32 and mesh_texture: (H, W, 3) uint8; no rows without a texture.
    """

    title: str
    num_patches: int
    origin: NDArray[np.float64]
    up: NDArray[np.float64]
    view_names: list[str]
    cam_from_world: NDArray[np.float64]
    view_k: NDArray[np.float64]
    view_size: Ints
    photo: NDArray[np.uint8]
    photo_ptr: Ints
    xyz: Float32
    rgb: NDArray[np.uint8]
    radius: Float32
    num_views: Ints
    score: Float32
    sigma_px: Float32
    step_wave: Ints
    step_ptr: Ints
    step_total: Ints
    mesh_xyz: Float32
    mesh_normal: Float32
    mesh_faces: NDArray[np.int32]
    mesh_rgb: NDArray[np.uint8]
    mesh_uv: Float32
    mesh_texture: NDArray[np.uint8]


def make_dense_replay(
    scene: DenseScene,
    patches: Patches,
    *,
    mesh: Mesh | None = None,
    title: str = "",
    up: NDArray[np.float64] | None = None,
    max_points: int = 500_000,
) -> DenseReplay:
    """Put a dense result together for the screen.

    Args:
        scene: the views.
        patches: of them more than ``max_points`` are thinned, the same ones every time.
        mesh: made of the patches; None for none.
        title: shown on the recording.
        up: (3,) direction in the world that is up; None: judged from the cameras.
        max_points: to show.
    """
    poses, upright = scene.cam_from_world, scene.upright_cam_from_world
    origin = _origin(patches.xyz if len(patches) else scene.centers)
    shifted = poses.copy()
    # x_cam = R (x - origin) + (R origin + t)
    shifted[:, 4:] += _rotated(poses, origin)
    shown = patches.subset(thinned(len(patches), max_points))
    shown = shown.subset(np.argsort(shown.wave, kind="stable"))
    step_wave = wave_steps(patches.wave)
    places = (shown.xyz - origin).astype(np.float32)
    return DenseReplay(
        title=title, num_patches=len(patches), origin=origin,
        up=np.asarray(up, np.float64) if up is not None else up_direction(upright if len(poses) else None),
        cam_from_world=upright_poses(shifted, [view.orientation for view in scene.views]), **_photos(scene),
        xyz=places, rgb=shown.rgb, radius=_radii(places, shown.size),
        num_views=shown.num_views.astype(np.int64), score=shown.score, sigma_px=shown.sigma / shown.size,
        step_wave=step_wave,
        step_ptr=np.concatenate([[0], np.searchsorted(shown.wave, step_wave, side="right")]).astype(np.int64),
        step_total=np.searchsorted(np.sort(patches.wave), step_wave, side="right").astype(np.int64),
        **_mesh_arrays(mesh, origin),
    )  # fmt: skip


def thinned(count: int, limit: int) -> Ints:
    """Ascending positions of no more than ``limit`` of ``count`` things, without a pattern, the same every time."""
    if count <= limit:
        return np.arange(count, dtype=np.int64)
    return np.sort(np.random.default_rng(0).permutation(count)[:limit]).astype(np.int64)


def wave_steps(wave: NDArray[np.integer]) -> Ints:
    """The last wave of each step of the timeline, from the waves (N,) of the patches.

    Each wave that made patches is a step if they are few enough; else small ones, mostly the late ones, are taken
    together: steps have about the same sum of square roots of the waves' patches.
    """
    counts = np.bincount(wave)
    waves = np.flatnonzero(counts)
    if len(waves) <= MAX_STEPS:
        return waves.astype(np.int64)
    weight = np.cumsum(np.sqrt(counts[waves]))
    step = np.minimum((weight - 1e-9 * weight[-1]) / weight[-1] * MAX_STEPS, MAX_STEPS - 1).astype(np.int64)
    shown: Ints = waves[np.append(np.diff(step) > 0, True)].astype(np.int64)
    return shown


def _origin(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zero where single precision will do for the places (N, 3), so that they are shown as they are in the world."""
    if not len(xyz):
        return np.zeros(3)
    middle = np.median(xyz, axis=0)
    extent = float(np.median(np.abs(xyz - middle), axis=0).max())
    return middle if np.abs(middle).max() > _FAR * extent else np.zeros(3)


def _rotated(poses: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(V, 3) the vector x (3,) as the cameras' axes have it."""
    return np.asarray(rigid3.rotation_matrix(poses) @ x)


def _radii(xyz: Float32, size: Float32) -> Float32:
    """(N,) radii with which the points just close up, from what a pixel measures at each: median spacing over that."""
    if len(xyz) < 2:
        return size.copy()
    from scipy.spatial import cKDTree

    sample = thinned(len(xyz), _SPACING_SAMPLE)
    spacing = cKDTree(xyz).query(xyz[sample], k=2)[0][:, 1]
    return (float(np.median(spacing / size[sample])) * size).astype(np.float32)


def _photos(scene: DenseScene) -> dict[str, Any]:
    count = max(1, len(scene.views))
    side = int(np.clip(_PHOTO_SIDE_PX[1] * np.sqrt(_PHOTO_BUDGET / count), *_PHOTO_SIDE_PX))
    # a mirror stays: it is in the world, too
    turns = [ROTATION_OF[view.orientation] for view in scene.views]
    upright = [upright_pixels(view.rgb, turn) for view, turn in zip(scene.views, turns, strict=True)]
    shown = [shrunk_jpeg(rgb[:, :, ::-1], side, _PHOTO_QUALITY) for rgb in upright]
    size = np.array([s for _, s in shown], np.int64).reshape(-1, 2)
    full = np.array([rgb.shape[1::-1] for rgb in upright], np.float64).reshape(-1, 2)
    k = np.array([upright_pinhole(v.orientation, v.k, v.width, v.height) for v in scene.views]).reshape(-1, 4)
    return {
        "view_names": [view.name for view in scene.views],
        "view_k": k * np.tile(size / full, 2),
        "view_size": size,
        "photo": np.frombuffer(b"".join(jpeg for jpeg, _ in shown), np.uint8),
        "photo_ptr": np.concatenate([[0], np.cumsum([len(jpeg) for jpeg, _ in shown])]).astype(np.int64),
    }


def _mesh_arrays(mesh: Mesh | None, origin: NDArray[np.float64]) -> dict[str, Any]:
    if mesh is None:
        none = np.zeros((0, 3), np.float32)
        mesh = Mesh(none.astype(np.float64), none.astype(np.int32), none, none.astype(np.uint8))
    has_texture = mesh.uv is not None and mesh.texture is not None
    return {
        "mesh_xyz": (mesh.xyz - origin).astype(np.float32),
        "mesh_normal": mesh.normal,
        "mesh_faces": mesh.faces,
        "mesh_rgb": mesh.rgb,
        "mesh_uv": mesh.uv if has_texture else np.zeros((0, 2), np.float32),
        "mesh_texture": mesh.texture if has_texture else np.zeros((0, 0, 3), np.uint8),
    }
