"""Makes the pictures of these pages with sfmapp's own renderer, from workspaces of the commands in the tour.

python docs/make_pictures.py FOUNTAIN TRACK     # OUT of reconstruct, dense and mesh; OUT of odometry
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.files import read_patches
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry import rigid3
from sfmapp.geometry.upright import up_direction
from sfmapp.report.preview import VirtualCamera, picture_of_mesh, picture_of_patches
from sfmapp.scene.mesh import vertex_normals
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

PICTURES = Path(__file__).resolve().parent / "pictures"
SIZE = (960, 600)
RED = (228, 62, 48)


def main(fountain: Path, track: Path) -> None:
    """Everything, into ``docs/pictures``."""
    PICTURES.mkdir(exist_ok=True)
    model = read_model(fountain / "sparse" / "0")[0]
    patches, _ = read_patches(fountain / "dense" / "patches.npz")
    mesh = read_ply_geometry(fountain / "mesh" / "mesh.ply")
    assert mesh.triangles is not None
    eye = beside_and_above(model, patches.xyz, (1.75, 0.55, 0.45))
    radius = np.float32(1.4) * patches.size
    faces = mesh.triangles.astype(np.int32)
    normal = vertex_normals(mesh.xyz, faces)
    points = sparse_picture(model, beside_and_above(model, patches.xyz, (2.5, 1.2, 1.3), aim=0.4))
    dense = picture_of_patches(patches.xyz, patches.normal, patches.rgb, radius, eye)[0]
    clay = picture_of_mesh(mesh.xyz, faces, normal, eye)
    save("points.jpg", points)
    save("patches.jpg", dense)
    save("mesh.jpg", clay)
    third = SIZE[0] // 2, SIZE[1] // 2
    save("overview.jpg", np.hstack([cv2.resize(p, third, interpolation=cv2.INTER_AREA) for p in (points, dense, clay)]))
    near = closer(eye, 2.2)
    save("mesh-near.jpg", picture_of_mesh(mesh.xyz, faces, normal, near))
    (PICTURES / "from-above.svg").write_text(svg_of(fountain / "report.html"), encoding="utf-8")
    (PICTURES / "odometry-path.svg").write_text(svg_of(track / "report.html"), encoding="utf-8")


def beside_and_above(model: Reconstruction, xyz: Array, at: tuple[float, ...], aim: float = 0.0) -> VirtualCamera:
    """A camera that looks at what the cameras of a model see, from behind them, beside and above.

    Args:
        model, xyz: cameras, and points (N, 3) of what they see.
        at: where it stands, back, to the side and up, in distances of the cameras from the points.
        aim: where it looks, from 0, the points, to 1, the cameras.
    """
    up, centers = up_direction(model.cam_from_world), model.centers[model.is_registered]
    target = np.median(xyz, axis=0)
    back = centers.mean(0) - target
    side = np.cross(up, back / np.linalg.norm(back))
    position = target + at[0] * back + np.linalg.norm(back) * (at[1] * side + at[2] * up)
    forward = target + aim * back - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.asarray(rigid3.from_matrix(rotation, -rotation @ position))
    width, height = SIZE
    return VirtualCamera(np.array([1.15 * width, 1.15 * width, width / 2, height / 2]), pose, width, height)


def closer(eye: VirtualCamera, zoom: float) -> VirtualCamera:
    """The same camera with a longer lens."""
    k = eye.k.copy()
    k[:2] *= zoom
    return VirtualCamera(k, eye.cam_from_world, eye.width, eye.height)


def sparse_picture(model: Reconstruction, eye: VirtualCamera) -> NDArray[np.uint8]:
    """The points of a model in their colours, and its cameras as red pyramids."""
    kept = np.flatnonzero(model.is_triangulated)
    forward = rigid3.rotation_matrix(eye.cam_from_world)[2]
    spread = float(np.linalg.norm(model.centers[model.is_registered].std(0)))
    edges = np.concatenate([pyramid(model, i, 0.22 * spread) for i in model.registered_idx])
    xyz = np.concatenate([model.point_xyz[kept], edges])
    rgb = np.concatenate([model.point_rgb[kept], np.full((len(edges), 3), RED, np.uint8)])
    radius = np.full(len(xyz), 0.006 * spread, np.float32)
    normal = np.tile(-forward, (len(xyz), 1)).astype(np.float32)
    return picture_of_patches(xyz, normal, rgb, radius, eye)[0]


def pyramid(model: Reconstruction, image_idx: int, length: float) -> Array:
    """Points along the edges of a camera's pyramid, world."""
    camera = model.cameras[model.image_camera_idx[image_idx]]
    x, y = 0.5 * length * camera.width / camera.focal, 0.5 * length * camera.height / camera.focal
    corners = np.array([[-x, -y, length], [x, -y, length], [x, y, length], [-x, y, length]])
    steps = np.linspace(0, 1, 120)[:, None]
    lines = [steps * corner for corner in corners]
    lines += [corners[k - 1] + steps * (corners[k] - corners[k - 1]) for k in range(4)]
    pose = model.cam_from_world[image_idx]
    return np.asarray((np.concatenate(lines) - pose[4:]) @ rigid3.rotation_matrix(pose))


def svg_of(report: Path) -> str:
    """The view from above out of a report, on a page of its own."""
    found = re.search(r"<svg.*?</svg>", report.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    svg = found[0].replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" style="background:#fff;color:#333" ', 1)
    return (
        svg.replace("currentColor", "#555").replace("<text ", '<text font-family="sans-serif" font-size="14" ') + "\n"
    )


def save(name: str, rgb: NDArray[np.uint8]) -> None:
    """Write a JPEG of moderate size."""
    cv2.imwrite(str(PICTURES / name), rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
