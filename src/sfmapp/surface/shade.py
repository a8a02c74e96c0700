"""Pictures of a mesh without any graphics driver, for reports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.child import run_child

AMBIENT = 0.25
BACKGROUND = 255


def shade(
    mesh: Mesh,
    k: NDArray[np.float64],
    cam_from_world: NDArray[np.float64],
    width: int,
    height: int,
    *,
    colored: bool = False,
    events: Events | None = None,
) -> NDArray[np.uint8]:
    """What a camera would see of a plaster cast of the mesh, with the light over its left shoulder, on white.

    Rays are cast in a child process (open3d's RaycastingScene, which needs no GL).

    Args:
        mesh: what to show.
        k: (4,) ``fx, fy, cx, cy`` in pixels, the centre of the top-left one (0.5, 0.5).
        cam_from_world: (7,).
        width, height: of the picture.
        colored: by the colours of the vertices instead, unlit.
        events: cancellation.

    Returns:
        (height, width, 3) uint8.

    Raises:
        NoReconstructionError: the child ended without a result.
        InterruptedRunError: ``events`` was asked to stop.
    """
    faces, uv = cast(mesh, k, cam_from_world, width, height, events or Events())
    out = np.full((height, width, 3), BACKGROUND, np.uint8)
    hit = faces >= 0
    corners = mesh.faces[faces[hit]]
    weight = np.stack([1.0 - uv[hit].sum(axis=1), uv[hit, 0], uv[hit, 1]], axis=1)
    if colored:
        out[hit] = np.rint(np.einsum("pk,pkc->pc", weight, mesh.rgb[corners])).astype(np.uint8)
        return out
    normal = np.einsum("pk,pkc->pc", weight, mesh.normal[corners]) @ rigid3.rotation_matrix(cam_from_world).T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = np.array([-0.5, -0.6, -1.0])
    lit = AMBIENT + (1.0 - AMBIENT) * np.maximum(normal @ (light / np.linalg.norm(light)), 0.0)
    out[hit] = np.rint(235.0 * lit).astype(np.uint8)[:, None]
    return out


def cast(
    mesh: Mesh, k: NDArray[np.float64], cam_from_world: NDArray[np.float64], width: int, height: int, events: Events
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The face that each pixel's ray meets first, (H, W), -1 for none, and where: (H, W, 2) weights of its second and
    third corner."""
    if not len(mesh.faces):
        raise NoReconstructionError("shading: expected a mesh, found no triangles")
    # in the frame of the camera: single precision holds what is far from the world's origin
    xyz = rigid3.apply(cam_from_world, mesh.xyz)
    arrays: dict[str, NDArray] = {"xyz": xyz.astype(np.float32), "faces": mesh.faces, "k": np.asarray(k, np.float64)}
    found, _ = run_child(
        "sfmapp.surface.raycast_child", "shading", arrays, (width, height), "try a mesh of fewer triangles", events
    )
    return found["faces"], found["uv"]
