"""Screened Poisson in a process of its own, ``python -m sfmapp.surface.poisson_child`` with the arguments of its main.

open3d's Poisson has ended its whole process for some inputs; here that is an exit code. The files are npz (see
:mod:`sfmapp.surface.poisson`).
"""

from __future__ import annotations

import sys


def main(source: str, target: str, depth: str, scale: str, threads: str) -> None:
    """From oriented points to a surface, whole and untrimmed."""
    import numpy as np

    from sfmapp.surface.open3d_library import load_open3d

    with np.load(source, allow_pickle=False) as data:
        xyz, normal = data["xyz"], data["normal"]
    open3d = load_open3d()
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(np.asarray(xyz, np.float64))
    cloud.normals = open3d.utility.Vector3dVector(np.asarray(normal, np.float64))
    del xyz, normal
    surface, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=int(depth), scale=float(scale), n_threads=int(threads)
    )
    np.savez(
        target, allow_pickle=False, xyz=np.asarray(surface.vertices), faces=np.asarray(surface.triangles, np.int32),
        density=np.asarray(density, np.float32),
    )  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
