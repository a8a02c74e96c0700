"""Which photograph each triangle is painted from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.events import Events
from sfmapp.scene.mesh import Mesh, face_vectors, flat_areas
from sfmapp.surface.child import run_child

# what lies so near the border of an image is not looked up in it
MARGIN_PX = 1.0
# a view may see a face this much from the side
SMALLEST_COSINE = 0.1
# mean difference of the channels, of 255, beyond what exposure and gloss do
ANOTHER_COLOR = 40.0
# how far the wish for the same view reaches, in faces about; and rounds in which stray faces join their neighbours
REACH, ROUNDS = 30, 8


@dataclass(frozen=True)
class ViewChoice:
    """The photograph of each face, F of them.

    Attributes:
        view_idx: (F,) int32 position of the view; -1 where no view shows the face.
        num_candidates: pairs of face and view that were looked at.
    """

    view_idx: NDArray[np.int32]
    num_candidates: int


def neighbor_pairs(faces: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces that share an edge with another one: (P,) and (P,) positions; where more than two meet, in a chain."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    key = edges[:, 0].astype(np.int64) << 32 | edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    return order[same] // 3, order[same + 1] // 3


def choose_views(mesh: Mesh, scene: DenseScene, events: Events) -> ViewChoice:
    """Choose for each face the view that shows it largest, but the same one all over a neighbourhood.

    As Lempitsky and Ivanov (CVPR 2007) a face wants many pixels and the view of its neighbours. In place of their
    labelling by graph cuts, what a view is worth to a face is first spread over the faces around (which moves the
    borders between views to where both are worth the same, and clear of what hides the surface), then the best one is
    taken, and stray faces join their neighbours.

    Raises:
        NoReconstructionError: the child process that casts rays ended without a result.
        InterruptedRunError: ``events`` was asked to stop.
    """
    from scipy.sparse import coo_array, csr_array

    worth, hidden = _worth(mesh, scene, events)
    a, b = neighbor_pairs(mesh.faces)
    num_faces = len(mesh.faces)
    links = csr_array(coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), (num_faces, num_faces)))
    degree = 1.0 + links.sum(axis=1)
    best, view_idx = np.zeros(num_faces), np.full(num_faces, -1, np.int32)
    visible = np.zeros((num_faces, len(scene.views)), np.bool_)
    for m, ((face_idx, pixels), behind) in enumerate(zip(worth, hidden, strict=True)):
        value: NDArray[np.float64] = np.zeros(num_faces)
        value[face_idx[~behind]] = pixels[~behind]
        visible[:, m] = value > 0.0
        for _ in range(REACH):
            value = (value + links @ value) / degree
        better = np.flatnonzero(visible[:, m] & (value > best))
        best[better], view_idx[better] = value[better], m
        events.raise_if_cancelled()
    for _ in range(ROUNDS):
        _join_neighbors(view_idx, visible, a, b)
    return ViewChoice(view_idx, sum(len(face_idx) for face_idx, _ in worth))


def _worth(
    mesh: Mesh, scene: DenseScene, events: Events
) -> tuple[list[tuple[NDArray[np.int64], NDArray[np.float64]]], list[NDArray[np.bool_]]]:
    """For each view the faces that it may show, with what it is worth to them (pixels for a unit of area, fewer where
    it shows something else), and which of them are hidden."""
    vectors = face_vectors(mesh.xyz, mesh.faces)
    area = np.linalg.norm(vectors, axis=1)
    centers = mesh.xyz[mesh.faces].mean(axis=1)
    color = mesh.rgb[mesh.faces].mean(axis=1)
    worth = []
    for view, camera in zip(scene.views, scene.centers, strict=True):
        pixel, _ = view.project(mesh.xyz)
        limit = np.array([view.width, view.height]) - MARGIN_PX
        inside = np.asarray(((pixel >= MARGIN_PX) & (pixel <= limit)).all(axis=1))
        ray = camera - centers
        facing = np.einsum("fc,fc->f", ray, vectors) > SMALLEST_COSINE * np.linalg.norm(ray, axis=1) * area
        face_idx = np.flatnonzero(facing & inside[mesh.faces].all(axis=1))
        pixels = flat_areas(pixel, mesh.faces[face_idx])
        worth.append((face_idx, pixels / area[face_idx] * _likeness(view, centers[face_idx], color[face_idx])))
    view_ptr = np.cumsum([0, *(len(face_idx) for face_idx, _ in worth)])
    middle, extent = mesh.xyz.mean(axis=0), float(np.ptp(mesh.xyz, axis=0).max())
    arrays: dict[str, NDArray[Any]] = {
        "xyz": ((mesh.xyz - middle) / extent).astype(np.float32),
        "faces": mesh.faces,
        "cameras": (scene.centers - middle) / extent,
        "lift": (np.sqrt(area) / extent).astype(np.float32),
        "face_idx": np.concatenate([face_idx for face_idx, _ in worth]),
        "view_ptr": view_ptr,
    }
    module, advice = "sfmapp.surface.occlusion_child", "try a smaller surface.depth"
    found = run_child(module, "finding what is hidden", arrays, (), advice, events)
    return worth, np.split(found["hidden"], view_ptr[1:-1])


def _likeness(view: DenseView, xyz: NDArray[np.float64], color: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) near 1 where a view shows points (N, 3) in about their colour (N, 3), near 0 where it shows something else:
    what stands before them without being in the mesh, or the background beside an edge."""
    x, y = view.project(xyz)[0].astype(np.int64).T
    shown = view.rgb[y.clip(0, view.height - 1), x.clip(0, view.width - 1)]
    return np.asarray(1.0 / (1.0 + (np.abs(shown - color).mean(axis=1) / ANOTHER_COLOR) ** 4))


def _join_neighbors(
    view_idx: NDArray[np.int32], visible: NDArray[np.bool_], a: NDArray[np.int64], b: NDArray[np.int64]
) -> None:
    """Give faces (in place) the view that at least two of their neighbours have, if it shows them."""
    to, wanted = np.r_[a, b], view_idx[np.r_[b, a]].astype(np.int64)
    useful = wanted >= 0
    num_views = visible.shape[1]
    key, counts = np.unique(to[useful] * num_views + wanted[useful], return_counts=True)
    key = key[counts >= 2]
    face_idx, view = key // num_views, key % num_views
    shown = visible[face_idx, view]
    view_idx[face_idx[shown]] = view[shown]
