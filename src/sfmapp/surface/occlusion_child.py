"""Asks what is hidden, in a process of its own: ``python -m sfmapp.surface.occlusion_child INPUT OUTPUT``.

The files are npz (see :mod:`sfmapp.surface.view_choice`).
"""

from __future__ import annotations

import sys

CHUNK = 1_000_000


def main(source: str, target: str) -> None:
    """For pairs of a face and a camera: whether another face stands between the face's centre and the camera."""
    import numpy as np

    from sfmapp.surface.open3d_library import load_open3d

    with np.load(source, allow_pickle=False) as data:
        xyz, faces, cameras, lift = data["xyz"], data["faces"], data["cameras"], data["lift"]
        face_idx, view_ptr = data["face_idx"], data["view_ptr"]
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.core.Tensor(xyz), open3d.core.Tensor(faces.astype(np.uint32)))
    centers = xyz[faces].mean(axis=1)
    hidden = np.empty(len(face_idx), np.bool_)
    for m, camera in enumerate(cameras):
        for start in range(view_ptr[m], view_ptr[m + 1], CHUNK):
            part = slice(start, min(start + CHUNK, view_ptr[m + 1]))
            origin = centers[face_idx[part]]
            ray = camera - origin
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            rays = np.concatenate([origin + ray * lift[face_idx[part], None], ray], axis=1).astype(np.float32)
            hidden[part] = scene.test_occlusions(open3d.core.Tensor(rays), nthreads=1).numpy()
    np.savez(target, allow_pickle=False, hidden=hidden)


if __name__ == "__main__":
    main(*sys.argv[1:])
