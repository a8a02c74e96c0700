"""Colours that agree where two photographs meet (Lempitsky and Ivanov, "Seamless mosaicing of image-based texture
maps", CVPR 2007; Waechter, Moehrle and Goesele, "Let there be color!", ECCV 2014)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# how much offsets may differ along an edge of a chart, against how much they may leave of a seam
SMOOTHNESS = 0.1
# keeps offsets small where nothing asks for any
PULL = 1e-3
# a difference of so many levels, of 255, counts half: larger ones are of different things, not of different exposures
FOREIGN = 30.0
TOLERANCE, MOST_STEPS = 1e-3, 2000


def level_seams(
    color: NDArray[np.float64], vertex_idx: NDArray[np.int64], faces: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Offsets of colours that make the charts agree at their seams and change as slowly as they can within.

    Minimises, over the offsets g, the sum of the squares of ``(f + g)_a - (f + g)_b`` over pairs a, b of vertices of
    charts that are the same vertex of the surface (less where they differ much, as Geman and McClure weight residuals),
    of ``g_a - g_b`` over edges, and of g.

    Args:
        color: (N, 3) f, what its photograph shows at each vertex of a chart.
        vertex_idx: (N,) which vertex of the surface it is.
        faces: (F, 3) corners, in vertices of charts.

    Returns:
        (N, 3).
    """
    from scipy.sparse import coo_array, csr_array, diags_array
    from scipy.sparse.linalg import cg

    order = np.argsort(vertex_idx, kind="stable")
    same = np.flatnonzero(vertex_idx[order[1:]] == vertex_idx[order[:-1]])
    a, b = order[same], order[same + 1]
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    start, end = np.r_[a, edges[:, 0]], np.r_[b, edges[:, 1]]
    trust = 1.0 / (1.0 + np.sum((color[a] - color[b]) ** 2, axis=1) / (3.0 * FOREIGN**2))
    weight = np.r_[trust, np.full(len(edges), SMOOTHNESS)]
    num = len(color)
    links = csr_array(coo_array((np.r_[weight, weight], (np.r_[start, end], np.r_[end, start])), (num, num)))
    diagonal = np.asarray(links.sum(axis=1)).ravel() + PULL
    system = csr_array(diags_array(diagonal) - links)
    out = np.empty((num, 3), np.float32)
    for channel in range(3):
        step = trust * (color[b, channel] - color[a, channel])
        right = np.bincount(a, step, num) - np.bincount(b, step, num)
        out[:, channel] = cg(system, right, rtol=TOLERANCE, maxiter=MOST_STEPS, M=diags_array(1.0 / diagonal))[0]
    return out
