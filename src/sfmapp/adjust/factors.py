"""Where gtsam comes in: factors of any kind over poses and intrinsics, and the sparse solution of large systems.

gtsam's poses are world_from_cam and move on the right, ours are cam_from_world and move on the left: to first order the
one tangent (rotation, translation) is the negative of the other.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import K, X
from numpy.typing import NDArray

from sfmapp.adjust.problem import Problem, free_values
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


def gtsam_pose(cam_from_world: Array) -> Any:
    """gtsam.Pose3 world_from_cam of a pose (7,)."""
    x, y, z, w, *t = rigid3.inverse(cam_from_world)
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.array(t))


class ExtraFactors:
    """A gtsam.NonlinearFactorGraph over ``X(i)`` and ``K(c)``, linearised by gtsam into the reduced system.

    Attributes:
        images, cameras: positions of all that the graph mentions.
        weight: factor on cost and information of the whole graph.
    """

    weight = 1.0

    def __init__(self, graph: Any) -> None:
        self._graph = graph
        symbols = [gtsam.Symbol(key) for key in sorted(graph.keyVector())]
        kinds = {chr(s.chr()) for s in symbols}
        if not kinds <= {"x", "k"}:
            raise ValueError(f"extra factors may be over X(i) and K(c) only, found {sorted(kinds - {'x', 'k'})}")
        self.images = [s.index() for s in symbols if chr(s.chr()) == "x"]
        self.cameras = [s.index() for s in symbols if chr(s.chr()) == "k"]

    def attach(self, problem: Problem) -> None:
        """Fix the places of the unknowns. Factors on unregistered images and constant cameras drop out."""
        self._problem = problem
        self._place: dict[int, NDArray[np.int64]] = {}
        self._sign: dict[int, float] = {}
        self._poses, self._cameras = [], []
        for n in np.flatnonzero(np.isin(problem.image_idx, self.images)).tolist():
            key, block = X(int(problem.image_idx[n])), problem.image_block[n]
            if problem.image_mount[n] >= 0:
                raise ValueError(
                    f"extra factors on a rig must name the image of sensor 0, found X({problem.image_idx[n]})"
                )
            self._place[key] = block * 8 + np.arange(6) if block >= 0 else np.full(6, -1)
            self._poses.append((key, int(problem.image_pose[n])))
            self._sign[key] = -1.0
        for c, camera in enumerate(problem.camera_idx.tolist()):
            if camera in set(self.cameras) and problem.camera_block[c] >= 0:
                columns = np.unique(problem.free.column[problem.free.ptr[c] : problem.free.ptr[c + 1]])
                self._place[K(int(camera))] = problem.camera_block[c] * 8 + columns
                self._cameras.append((K(int(camera)), c))
                self._sign[K(int(camera))] = 1.0
        self.known = gtsam.NonlinearFactorGraph()
        for n in range(self._graph.size()):
            if set(self._graph.at(n).keys()) <= self._place.keys():
                self.known.push_back(self._graph.at(n))
        places = [self._indices(self.known.at(n).keys()) for n in range(self.known.size())]
        pairs = [np.stack(np.meshgrid(p, p, indexing="ij"), -1).reshape(-1, 2) for p in places]
        self._row, self._column = np.concatenate([*pairs, np.zeros((0, 2), np.int64)]).T
        self._single = np.concatenate([*places, np.zeros(0, np.int64)])
        # tiles are kept for a <= b only
        self._kept = (self._row >= 0) & (self._column >= 0) & (self._row // 8 <= self._column // 8)
        self._row, self._column = self._row[self._kept], self._column[self._kept]

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Keys a B + b of the tiles that the factors touch."""
        return np.unique(self._row // 8 * self._problem.num_blocks + self._column // 8)

    def _indices(self, keys: Any) -> NDArray[np.int64]:
        return np.concatenate([self._place[key] for key in keys]).astype(np.int64)

    def _values(self, poses: Array, canonical: Array) -> Any:
        values = gtsam.Values()
        for key, n in self._poses:
            values.insert(key, gtsam_pose(poses[n]))
        for key, c in self._cameras:
            values.insert(key, free_values(self._problem, canonical, c))
        return values

    def cost(self, poses: Array, canonical: Array) -> float:
        """gtsam's error, half the squared whitened residuals; infinite where a factor cannot be evaluated."""
        try:
            return self.weight * float(self.known.error(self._values(poses, canonical)))
        except RuntimeError:
            return float("inf")

    def linearize(self, own: Array, gradient: Array) -> None:
        """Linearise at the problem's state; adds what concerns single blocks to own (B * 64,) and gradient (B * 8,)."""
        linear = self.known.linearize(self._values(self._problem.poses, self._problem.canonical))
        matrices, vectors = [], []
        for n in range(linear.size()):
            factor = linear.at(n)
            keys = list(factor.keys())
            sign = np.concatenate([np.full(len(self._place[key]), self._sign[key]) for key in keys])
            information = self.weight * factor.augmentedInformation()
            matrices.append((information[:-1, :-1] * np.outer(sign, sign)).ravel())
            vectors.append(-information[:-1, -1] * sign)
        self._value = np.concatenate([*matrices, np.zeros(0)])[self._kept]
        vector = np.concatenate([*vectors, np.zeros(0)])
        np.add.at(gradient, self._single[self._single >= 0], vector[self._single >= 0])
        same = self._row // 8 == self._column // 8
        np.add.at(own, self._row[same] * 8 + self._column[same] % 8, self._value[same])

    def add_pairs(self, tiles: Array, tile_of: NDArray[np.int64]) -> None:
        """Add what couples different blocks; tile_of gives the tile of each of :attr:`pairs`."""
        other = self._row // 8 != self._column // 8
        keys = self._row[other] // 8 * self._problem.num_blocks + self._column[other] // 8
        tile = tile_of[np.searchsorted(self.pairs, keys)]
        np.add.at(tiles, tile * 64 + self._row[other] % 8 * 8 + self._column[other] % 8, self._value[other])


class SparseSystem:
    """The reduced system as gtsam Hessian factors, one per tile (keys a B + b in order), eliminated in METIS order."""

    def __init__(self, problem: Problem, keys: NDArray[np.int64]) -> None:
        blocks, first = problem.num_blocks, problem.num_pose_blocks
        images = problem.image_idx[problem.pose_images[problem.pose_block >= 0]]
        own = np.flatnonzero(problem.camera_block >= first)
        self._keys = [X(int(i)) for i in images]
        for c in own:
            number = int(problem.camera_idx[c])
            self._keys += [K(number), *([gtsam.symbol("l", number)] if problem.second_block[c] >= 0 else [])]
        self._pairs = list(zip(*(part.tolist() for part in np.divmod(keys, blocks)), range(len(keys)), strict=True))
        self._dims = problem.block_dim.tolist()
        self._ordering: Any = None

    def solve(self, tiles: Array, rhs: Array) -> Array | None:
        """Solution (B * 8,) of the damped system in tiles (N, 8, 8), None where it is not positive definite."""
        graph, factor, keys, dims = gtsam.GaussianFactorGraph(), gtsam.HessianFactor, self._keys, self._dims
        right = rhs.reshape(-1, 8)
        nothing = [(np.zeros((d, d)), np.zeros(d)) for d in range(9)]
        for a, b, tile in self._pairs:
            p, q = dims[a], dims[b]
            if a == b:
                graph.push_back(factor(keys[a], tiles[tile, :p, :p], right[a, :p], 0.0))
            else:
                (zero_a, none_a), (zero_b, none_b) = nothing[p], nothing[q]
                graph.push_back(factor(keys[a], keys[b], zero_a, tiles[tile, :p, :q], none_a, zero_b, none_b, 0.0))
        if self._ordering is None:
            self._ordering = gtsam.Ordering.MetisGaussianFactorGraph(graph)
        try:
            solution = graph.optimize(self._ordering)
        except RuntimeError:  # indeterminate: the caller raises the damping
            return None
        step = np.zeros((len(dims), 8))
        step[np.arange(8) < np.array(dims)[:, None]] = solution.vector(keys)
        return step.ravel()
