"""Depth and normal maps of the views, drawn from the patches that each of them trusts."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.prepare import DensePlan
from sfmapp.dense.scene import Patches
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file, write_array, write_bytes
from sfmapp.geometry import rigid3

STAGE = "maps"


def splat_view(
    k: NDArray[np.float64],
    cam_from_world: NDArray[np.float64],
    width: int,
    height: int,
    xyz: NDArray[np.float64],
    normal: NDArray[np.floating],
    reach_px: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Draw patches into a view: each pixel shows the plane of the patch nearest to it, of several the one in front.

    Args:
        k: (4,) pixels.
        cam_from_world: (7,).
        width, height: pixels.
        xyz, normal: (N, 3) patches, world.
        reach_px: how far a patch is drawn from its centre, a side.

    Returns:
        (H, W) depth in units of the world, NaN where there is none, and (H, W, 3) normals in the frame of the camera
        (x right, y down, z forward), 0 where there is none; float32.
    """
    rotation = rigid3.rotation_matrix(cam_from_world)
    seen = np.asarray(xyz @ rotation.T + cam_from_world[4:])
    turned = np.asarray(np.asarray(normal, np.float64) @ rotation.T)
    depth = np.full((height, width), np.nan, np.float32)
    normals = np.zeros((height, width, 3), np.float32)
    gap = np.full((height, width), np.inf, np.float32)
    _splat(np.ascontiguousarray(seen), np.ascontiguousarray(turned), k, reach_px, depth, normals, gap)
    return depth, normals


@numba.njit(cache=True, nogil=True)
def _splat(
    seen: NDArray[np.float64], normal: NDArray[np.float64], k: NDArray[np.float64], reach: float,
    depth: NDArray[np.float32], normals: NDArray[np.float32], gap: NDArray[np.float32],
) -> None:  # fmt: skip
    height, width = depth.shape
    for p in range(seen.shape[0]):
        z = seen[p, 2]
        if z <= 0.0:
            continue
        x = seen[p, 0] / z * k[0] + k[2]
        y = seen[p, 1] / z * k[1] + k[3]
        facing = normal[p, 0] * seen[p, 0] + normal[p, 1] * seen[p, 1] + normal[p, 2] * z
        if not (-reach <= x <= width + reach and -reach <= y <= height + reach) or facing >= 0.0:
            continue
        for v in range(max(int(np.ceil(y - reach - 0.5)), 0), min(int(np.floor(y + reach - 0.5)), height - 1) + 1):
            for u in range(max(int(np.ceil(x - reach - 0.5)), 0), min(int(np.floor(x + reach - 0.5)), width - 1) + 1):
                rx, ry = (u + 0.5 - k[2]) / k[0], (v + 0.5 - k[3]) / k[1]
                slant = normal[p, 0] * rx + normal[p, 1] * ry + normal[p, 2]
                here = facing / slant if slant < 0.0 else z
                # a plane seen at a slant runs away from its patch faster than it is known
                here = min(max(here, 0.97 * z), 1.03 * z)
                off = max(abs(u + 0.5 - x), abs(v + 0.5 - y))
                old = depth[v, u]
                is_in_front = old > 1.02 * here
                is_behind = here > 1.02 * old
                if is_in_front or (not is_behind and off < gap[v, u]):
                    depth[v, u], gap[v, u] = here, off
                    normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = normal[p, 0], normal[p, 1], normal[p, 2]


def write_maps(folder: Path, plan: DensePlan, patches: Patches, cell_px: int, events: Events | None = None) -> None:
    """Write ``NAME.depth.npy`` (H, W) and ``NAME.normal.npy`` (H, W, 3), float32, and pictures of both as PNG.

    Sizes are those of the undistorted views at working resolution; ``views.json`` holds their cameras.

    Raises:
        InputError: a file cannot be written.
        InterruptedRunError: ``events`` was asked to stop.
    """
    events = events or Events()
    events.started(STAGE, "depth and normal maps", total=len(plan.records))
    patch_idx = np.repeat(np.arange(len(patches)), patches.num_views)
    for m, canvas in enumerate(plan.canvases):
        mine = patch_idx[patches.view_idx == m]
        depth, normals = splat_view(
            canvas.k, plan.cam_from_world[m], *canvas.working_size, patches.xyz[mine], patches.normal[mine],
            max(0.75 * cell_px, 1.0),
        )  # fmt: skip
        base = folder / plan.names[m]
        write_array(base.with_name(f"{base.name}.depth.npy"), depth)
        write_array(base.with_name(f"{base.name}.normal.npy"), normals)
        write_picture(base.with_name(f"{base.name}.depth.png"), depth_picture(depth))
        write_picture(base.with_name(f"{base.name}.normal.png"), normal_picture(normals))
        events.advanced(STAGE)
    write_cameras(folder / "views.json", plan)
    events.finished(STAGE, f"{len(plan.records)} views")


def depth_picture(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) RGB: near is bright; black where there is no depth. Even steps of inverse depth, from 1 to 99 %."""
    import cv2

    known = np.isfinite(depth)
    picture = np.zeros((*depth.shape, 3), np.uint8)
    if known.any():
        inverse = 1.0 / depth[known]
        low, high = np.quantile(inverse, [0.01, 0.99])
        level = np.clip((inverse - low) / max(high - low, 1e-30), 0.0, 1.0)
        colors = cv2.applyColorMap(np.rint(level * 255).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)
        picture[known] = colors[:, 0, ::-1]
    return picture


def normal_picture(normals: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) RGB: x right, y up and z towards the camera, from -1 to 1, as red, green and blue; black for none."""
    turned = normals * np.array([1.0, -1.0, -1.0], np.float32)
    shown: NDArray[np.uint8] = np.rint((turned + 1.0) * 127.5).astype(np.uint8)
    shown[(normals == 0.0).all(axis=2)] = 0
    return shown


def write_picture(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write a PNG of (H, W, 3) RGB."""
    import cv2

    _, data = cv2.imencode(".png", rgb[:, :, ::-1])
    write_bytes(path, bytes(data))


def write_cameras(path: Path, plan: DensePlan) -> None:
    """Write names, sizes, calibrations and poses of the undistorted views at working resolution as JSON."""
    import json

    rows = [
        {"name": name, "width": canvas.working_size[0], "height": canvas.working_size[1], "k": canvas.k.tolist(),
         "cam_from_world": pose.tolist()}
        for name, canvas, pose in zip(plan.names, plan.canvases, plan.cam_from_world, strict=True)
    ]  # fmt: skip
    with replaced_file(path) as beside:
        beside.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
