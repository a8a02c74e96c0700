"""Casts a camera's rays in a process of its own: ``python -m sfmapp.surface.raycast_child INPUT OUTPUT WIDTH HEIGHT``.

The files are npz (see :mod:`sfmapp.surface.shade`).
"""

from __future__ import annotations

import sys


def main(source: str, target: str, width: str, height: str) -> None:
    """The first face that each pixel's ray meets, and where."""
    import numpy as np

    from sfmapp.surface.open3d_library import load_open3d

    with np.load(source, allow_pickle=False) as data:
        xyz, faces, (fx, fy, cx, cy) = data["xyz"], data["faces"], data["k"]
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.core.Tensor(xyz), open3d.core.Tensor(faces.astype(np.uint32)))
    x, y = np.meshgrid(np.arange(int(width)) + 0.5, np.arange(int(height)) + 0.5)
    rays = np.zeros((int(height), int(width), 6), np.float32)
    rays[..., 3], rays[..., 4], rays[..., 5] = (x - cx) / fx, (y - cy) / fy, 1.0
    hits = scene.cast_rays(open3d.core.Tensor(rays), nthreads=1)
    met = hits["primitive_ids"].numpy()
    numbers = np.where(met == scene.INVALID_ID, -1, met.astype(np.int64)).astype(np.int32)
    np.savez(target, allow_pickle=False, faces=numbers, uv=hits["primitive_uvs"].numpy())


if __name__ == "__main__":
    main(*sys.argv[1:])
