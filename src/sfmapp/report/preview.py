"""Pictures of patches and meshes: a z-buffer and a lamp beside the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# dark enough for clay to stand out, on a light page and on a dark one
BACKGROUND = (34, 36, 40)
# the lamp, in the camera's axes: from the upper left, behind the camera
LAMP = np.array([-0.8, -0.8, -1.0]) / np.linalg.norm([-0.8, -0.8, -1.0])
# what no light reaches, of what it falls on squarely
AMBIENT = 0.18
CLAY = (214, 208, 198)
# larger discs on the screen are stray patches right before the eye
MAX_RADIUS_PX = 64.0


@dataclass(frozen=True)
class VirtualCamera:
    """A camera without distortion that looks at a result.

    Attributes:
        k: (4,) float64 ``fx, fy, cx, cy`` in pixels, the centre of the top-left one (0.5, 0.5).
        cam_from_world: (7,) float64.
        width, height: of the picture in pixels.
    """

    k: Array
    cam_from_world: Array
    width: int
    height: int

    def larger(self, factor: int) -> VirtualCamera:
        """The same with so many times the pixels each way."""
        return VirtualCamera(self.k * factor, self.cam_from_world, self.width * factor, self.height * factor)


@dataclass(frozen=True)
class Seen:
    """What each pixel (H, W) of a picture sees.

    Attributes:
        idx: (H, W) int32 position of the patch or triangle, -1 for nothing.
        depth: (H, W) float32 along the optical axis, world units; infinite for nothing.
        weight: (H, W, 2) float32 barycentric weights of a triangle's second and third corner; no entries for patches.
    """

    idx: NDArray[np.int32]
    depth: NDArray[np.float32]
    weight: NDArray[np.float32]


def see_patches(xyz: Array, normal: NDArray[np.float32], radius: NDArray[np.float32], eye: VirtualCamera) -> Seen:
    """Patches (N) as discs in their planes, the foremost in each pixel.

    Args:
        xyz: (N, 3) centres, world.
        normal: (N, 3) unit normals, world; discs that face away are seen, too.
        radius: (N,) world units. A disc of less than a pixel is one pixel.
        eye: who looks.
    """
    idx = np.full((eye.height, eye.width), -1, np.int32)
    depth = np.full((eye.height, eye.width), np.inf, np.float32)
    rotation = rigid3.rotation_matrix(eye.cam_from_world)
    places = xyz @ rotation.T + eye.cam_from_world[4:]
    _splat(places, normal.astype(np.float64) @ rotation.T, radius.astype(np.float64), eye.k, depth, idx)
    return Seen(idx, depth, np.zeros((eye.height, eye.width, 0), np.float32))


def see_mesh(xyz: Array, faces: NDArray[np.int32], eye: VirtualCamera) -> Seen:
    """Triangles (F, 3) of vertices (N, 3), world, from either side, the foremost in each pixel.

    A pixel sees the triangle that its centre is in. Triangles that reach behind the eye are left out.
    """
    idx = np.full((eye.height, eye.width), -1, np.int32)
    depth = np.full((eye.height, eye.width), np.inf, np.float32)
    weight = np.zeros((eye.height, eye.width, 2), np.float32)
    rotation = rigid3.rotation_matrix(eye.cam_from_world)
    _fill(xyz @ rotation.T + eye.cam_from_world[4:], faces, eye.k, depth, idx, weight)
    return Seen(idx, depth, weight)


def shaded(normal: NDArray[np.floating], eye: VirtualCamera, rgb: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Colours (..., 3) of surfaces in the light of the lamp (Lambert), of clay or of their own colour.

    Args:
        normal: (..., 3) unit normals, world; those that face away from the lamp's side of the surface are dark.
        eye: where the lamp goes along.
        rgb: (..., 3); None for clay.
    """
    lamp = rigid3.rotation_matrix(eye.cam_from_world).T @ LAMP
    light = AMBIENT + (1.0 - AMBIENT) * np.clip(normal @ lamp, 0.0, 1.0)
    color = np.asarray(CLAY if rgb is None else rgb, np.float64)
    # light adds up before the curve of sRGB: 2.2 is near enough for a picture
    return np.asarray(color * light[..., None] ** (1.0 / 2.2), np.float64).round().astype(np.uint8)


def picture_of_patches(
    xyz: Array, normal: NDArray[np.float32], rgb: NDArray[np.uint8], radius: NDArray[np.float32], eye: VirtualCamera
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two pictures (H, W, 3) RGB of patches (N): in their colours, and as clay in the light of a lamp."""
    seen = see_patches(xyz, normal, radius, eye.larger(2))
    return _picture(seen, rgb), _picture(seen, shaded(normal.astype(np.float64), eye))


def picture_of_mesh(
    xyz: Array, faces: NDArray[np.int32], normal: NDArray[np.float32], eye: VirtualCamera
) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of a mesh as clay in the light of a lamp, with normals (N, 3) of its vertices."""
    seen = see_mesh(xyz, faces, eye.larger(2))
    rows = seen.idx >= 0
    corners = faces[seen.idx[rows]]
    second, third = seen.weight[rows].astype(np.float64).T[..., None]
    smooth = (1.0 - second - third) * normal[corners[:, 0]] + second * normal[corners[:, 1]]
    smooth += third * normal[corners[:, 2]]
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    image = np.empty((*seen.idx.shape, 3), np.uint8)
    image[:] = BACKGROUND
    image[rows] = shaded(smooth, eye)
    return _halved(image)


def _picture(seen: Seen, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = np.empty((*seen.idx.shape, 3), np.uint8)
    image[:] = BACKGROUND
    rows = seen.idx >= 0
    image[rows] = rgb[seen.idx[rows]]
    return _halved(image)


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Means of two by two pixels: smooth edges."""
    import cv2

    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


@numba.njit(cache=True, nogil=True)
def _splat(
    xyz: NDArray[np.float64], normal: NDArray[np.float64], radius: NDArray[np.float64], k: NDArray[np.float64],
    depth: NDArray[np.float32], idx: NDArray[np.int32],
) -> None:  # fmt: skip
    """Draw discs, all in the camera's axes."""
    height, width = depth.shape
    fx, fy, cx, cy = k
    for p in range(xyz.shape[0]):
        x, y, z = xyz[p]
        reach = radius[p]
        if z <= 2.0 * reach:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        ru, rv = fx * reach / (z - reach), fy * reach / (z - reach)
        if max(ru, rv) > MAX_RADIUS_PX:
            continue
        nx, ny, nz = normal[p]
        level = nx * x + ny * y + nz * z
        # the pixel of the centre belongs to the disc however small that is
        home_x, home_y = int(np.floor(u)), int(np.floor(v))
        for py in range(max(int(np.floor(v - rv)), 0), min(int(np.floor(v + rv)) + 1, height)):
            for px in range(max(int(np.floor(u - ru)), 0), min(int(np.floor(u + ru)) + 1, width)):
                rx, ry = (px + 0.5 - cx) / fx, (py + 0.5 - cy) / fy
                facing = nx * rx + ny * ry + nz
                d = level / facing if abs(facing) > 1e-9 else -1.0
                dx, dy, dz = d * rx - x, d * ry - y, d - z
                if d <= 0.0 or dx * dx + dy * dy + dz * dz > reach * reach:
                    if px != home_x or py != home_y:
                        continue
                    # still in its plane, unless that is seen almost edge on
                    d = d if abs(d - z) <= reach else z
                if d < depth[py, px]:
                    depth[py, px] = d
                    idx[py, px] = p


@numba.njit(cache=True, nogil=True)
def _fill(
    xyz: NDArray[np.float64], faces: NDArray[np.integer], k: NDArray[np.float64], depth: NDArray[np.float32],
    idx: NDArray[np.int32], weight: NDArray[np.float32],
) -> None:  # fmt: skip
    """Draw triangles of vertices in the camera's axes; inverse depth is linear on the screen."""
    height, width = depth.shape
    fx, fy, cx, cy = k
    for f in range(faces.shape[0]):
        a, b, c = faces[f]
        za, zb, zc = xyz[a, 2], xyz[b, 2], xyz[c, 2]
        if min(za, zb, zc) <= 0.0:
            continue
        ua, va = fx * xyz[a, 0] / za + cx, fy * xyz[a, 1] / za + cy
        ub, vb = fx * xyz[b, 0] / zb + cx, fy * xyz[b, 1] / zb + cy
        uc, vc = fx * xyz[c, 0] / zc + cx, fy * xyz[c, 1] / zc + cy
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0.0:
            continue
        first_y = max(int(np.ceil(min(va, vb, vc) - 0.5)), 0)
        last_y = min(int(np.floor(max(va, vb, vc) - 0.5)), height - 1)
        first_x = max(int(np.ceil(min(ua, ub, uc) - 0.5)), 0)
        last_x = min(int(np.floor(max(ua, ub, uc) - 0.5)), width - 1)
        for py in range(first_y, last_y + 1):
            for px in range(first_x, last_x + 1):
                du, dv = px + 0.5 - ua, py + 0.5 - va
                wb = (du * (vc - va) - dv * (uc - ua)) / area
                wc = (dv * (ub - ua) - du * (vb - va)) / area
                wa = 1.0 - wb - wc
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                d = 1.0 / (wa / za + wb / zb + wc / zc)
                if d < depth[py, px]:
                    depth[py, px] = d
                    idx[py, px] = f
                    weight[py, px, 0] = wb * d / zb
                    weight[py, px, 1] = wc * d / zc
