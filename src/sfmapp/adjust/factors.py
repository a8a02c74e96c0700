"""Where gtsam comes in: factors of any kind beside the reprojections, and the elimination of sparse systems.

gtsam's poses are world_from_cam and move on the right, ours are cam_from_world and move on the left: to first order the
one tangent (rotation, translation) is the negative of the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import K, L, X
from numpy.typing import NDArray

from sfmapp.adjust.linear import gather_scaled, group_blocks
from sfmapp.adjust.options import REJECTED_WEIGHT, FactorReport
from sfmapp.adjust.problem import Mentioned, Problem, free_values
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Places = NDArray[np.int64]

# The most rows that a block has.
_MAX_DIM = 8
# gtsam refuses a pivot that is 2^24 times smaller than the one before, as those are that only the damping of a free
# gauge holds. With this share of the diagonal added none is; rounds until the residual is this share of what it was.
_ENOUGH, _SOLVED, _MAX_ROUNDS = 2.0**-21, 1e-12, 50


def gtsam_pose(cam_from_world: Array) -> Any:
    """gtsam.Pose3 world_from_cam of a pose (7,)."""
    x, y, z, w, *t = rigid3.inverse(cam_from_world)
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.array(t))


class ExtraFactors:
    """A gtsam.NonlinearFactorGraph beside the reprojections, linearised by gtsam into the reduced system.

    Its keys are ``X(i)``, Pose3 world_from_cam of image i; ``K(c)``, Vector of the free parameters of camera c in the
    order of ``Camera.params``; ``L(t)``, Point3 of track t; and whatever ``values`` holds. ``points`` are further
    tracks that are not to be eliminated; ``kinds`` are names of factors by their position, for the report.

    Attributes:
        mentioned: what of the reconstruction takes part for that reason, and the dimensions of its own variables.
        values: of its own variables, at the state of the problem; new_values: after the step that is tried.
        known: the factors that count. Those on unregistered images, points without a place and constant cameras do not.
        num_left_out: how many do not.
        weight: factor on cost and information of the whole graph.
    """

    weight = 1.0

    def __init__(
        self, graph: Any, values: Any = None, points: Sequence[int] = (), kinds: Mapping[int, str] | None = None
    ) -> None:
        self._graph, self._kinds = graph, kinds or {}
        self.values = self.new_values = gtsam.Values() if values is None else values
        own = set(self.values.keys())
        indices: dict[str, list[int]] = {"x": [], "k": [], "l": []}
        for key in sorted(set(graph.keyVector()) - own):
            symbol = gtsam.Symbol(key)
            if chr(symbol.chr()) not in indices:
                raise ValueError(
                    "extra factors may be over X(i), K(c), L(t) and variables that have a value, found "
                    f"{gtsam.DefaultKeyFormatter(key)}"
                )
            indices[chr(symbol.chr())].append(symbol.index())
        self._zeros = self.values.zeroVectors()
        self._check_noise()
        self._own = sorted(own & set(graph.keyVector()))
        dims = [self._dim(key) for key in self._own]
        self.mentioned = Mentioned(indices["x"], indices["k"], sorted({*indices["l"], *points}), dims)

    def _check_noise(self) -> None:
        for n in range(self._graph.size()):
            noise = getattr(self._graph.at(n), "noiseModel", lambda: None)()
            if noise is not None and noise.isConstrained():
                raise ValueError(
                    f"extra factor {n} ({type(self._graph.at(n)).__name__}) is a hard constraint, which least squares "
                    "cannot hold: give it a small sigma, or hold its variables constant"
                )

    def _dim(self, key: int) -> int:
        dim = len(self._zero(key))
        if dim > _MAX_DIM:
            raise ValueError(
                f"variables may have up to {_MAX_DIM} dimensions, found {dim} of {gtsam.DefaultKeyFormatter(key)}"
            )
        return dim

    def attach(self, problem: Problem) -> None:
        """Fix the places of the unknowns."""
        self._problem = problem
        self._place: dict[int, Places] = {}
        self._sign: dict[int, float] = {}
        self._poses: list[tuple[int, int]] = []
        self._cameras: list[tuple[int, int]] = []
        self._points: list[tuple[int, int]] = []
        self._place_images()
        for c, camera in enumerate(problem.camera_idx.tolist()):
            if camera in set(self.mentioned.cameras) and problem.camera_block[c] >= 0:
                columns = np.unique(problem.free.column[problem.free.ptr[c] : problem.free.ptr[c + 1]])
                self._put(K(int(camera)), problem.camera_block[c] * 8 + columns)
                self._cameras.append((K(int(camera)), c))
        for n in np.flatnonzero(np.isin(problem.track_idx, self.mentioned.points)).tolist():
            key, block = L(int(problem.track_idx[n])), problem.point_block[n]
            self._put(key, block * 8 + np.arange(3) if block >= 0 else np.full(3, -1))
            self._points.append((key, n))
        first = problem.num_blocks - len(self._own)
        for n, (key, dim) in enumerate(zip(self._own, self.mentioned.dims, strict=True)):
            self._put(key, (first + n) * 8 + np.arange(dim))
        self._choose_known()

    def _put(self, key: int, place: Places, sign: float = 1.0) -> None:
        self._place[key], self._sign[key] = place.astype(np.int64), sign

    def _place_images(self) -> None:
        problem = self._problem
        for n in np.flatnonzero(np.isin(problem.image_idx, self.mentioned.images)).tolist():
            key, block = X(int(problem.image_idx[n])), problem.image_block[n]
            if problem.image_mount[n] >= 0:
                raise ValueError(
                    f"extra factors on a rig must name the image of sensor 0, found X({problem.image_idx[n]})"
                )
            self._put(key, block * 8 + np.arange(6) if block >= 0 else np.full(6, -1), -1.0)
            self._poses.append((key, int(problem.image_pose[n])))

    def _choose_known(self) -> None:
        self.known, self._names = gtsam.NonlinearFactorGraph(), list[str]()
        for n in range(self._graph.size()):
            if set(self._graph.at(n).keys()) <= self._place.keys():
                self.known.push_back(self._graph.at(n))
                self._names.append(self._kinds.get(n, type(self._graph.at(n)).__name__))
        self.num_left_out = self._graph.size() - self.known.size()
        places = [self._indices(self.known.at(n).keys()) for n in range(self.known.size())]
        pairs = [np.stack(np.meshgrid(p, p, indexing="ij"), -1).reshape(-1, 2) for p in places]
        self._row, self._column = np.concatenate([*pairs, np.zeros((0, 2), np.int64)]).T
        self._single = np.concatenate([*places, np.zeros(0, np.int64)])
        # tiles are kept for a <= b only
        self._kept = (self._row >= 0) & (self._column >= 0) & (self._row // 8 <= self._column // 8)
        self._row, self._column = self._row[self._kept], self._column[self._kept]
        self.pairs: Places = np.unique(self._row // 8 * self._problem.num_blocks + self._column // 8)
        """Keys a B + b of the tiles that the factors touch."""

    @property
    def num_own_dims(self) -> int:
        """Unknowns that no reprojection knows."""
        return sum(self.mentioned.dims)

    def block_keys(self) -> list[int]:
        """gtsam's keys of the blocks of the variables of its own."""
        return list(self._own)

    def own_places(self) -> dict[int, Places]:
        """Rows of the variables of its own among the unknowns of the blocks, by key."""
        return {key: self._place[key] for key in self._own}

    def _indices(self, keys: Any) -> Places:
        return np.concatenate([self._place[key] for key in keys]).astype(np.int64)

    def _values(self, poses: Array, canonical: Array, xyz: Array, own: Any) -> Any:
        values = gtsam.Values(own)
        for key, n in self._poses:
            values.insert(key, gtsam_pose(poses[n]))
        for key, c in self._cameras:
            values.insert(key, free_values(self._problem, canonical, c))
        for key, n in self._points:
            values.insert(key, xyz[n])
        return values

    def retract(self, step: Array) -> None:
        """Fill ``new_values`` after a step (B * 8,) of the blocks."""
        if self._own:
            delta = gtsam.VectorValues()
            for key in self.values.keys():  # noqa: SIM118
                delta.insert(key, step[self._place[key]] if key in self._place else self._zero(key))
            self.new_values = self.values.retract(delta)

    def _zero(self, key: int) -> Array:
        zero: Array = self._zeros.at(key)
        return zero

    def accept(self) -> None:
        """Make the values that were tried the current ones."""
        self.values, self.new_values = self.new_values, self.values

    def cost(self, poses: Array, canonical: Array, xyz: Array, own: Any) -> float:
        """gtsam's error, half the squared whitened residuals; infinite where a factor cannot be evaluated."""
        try:
            return self.weight * float(self.known.error(self._values(poses, canonical, xyz, own)))
        except RuntimeError:
            return float("inf")

    def current(self) -> Any:
        """gtsam.Values of all that the factors are over, at the state of the problem."""
        p = self._problem
        return self._values(p.poses, p.canonical, p.xyz, self.values)

    def linearize(self, own: Array, gradient: Array) -> None:
        """Linearise at the problem's state; adds what concerns single blocks to own (B * 64,) and gradient (B * 8,)."""
        linear = self.known.linearize(self.current())
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

    def reports(self) -> list[FactorReport]:
        """What the factors come to at the state of the problem, by kind."""
        values = self.current()
        found: dict[str, list[tuple[int, float, float, bool]]] = {}
        for n in range(self.known.size()):
            factor = self.known.at(n)
            error, dim = factor.error(values), factor.dim()
            square, weight = 2 * error, 1.0
            noise = factor.noiseModel() if hasattr(factor, "noiseModel") else None
            if isinstance(noise, gtsam.noiseModel.Robust):
                distance = noise.noise().mahalanobisDistance(factor.unwhitenedError(values))
                weight = noise.robust().weight(distance)
                square = weight * distance**2
            found.setdefault(self._names[n], []).append((dim, error, square, weight < REJECTED_WEIGHT))
        out = []
        for name, rows in sorted(found.items()):
            dims, errors, squares, rejected = (np.array(column) for column in zip(*rows, strict=True))
            out.append(
                FactorReport(
                    kind=name, num_factors=len(rows), num_rows=int(dims.sum()), cost=float(errors.sum()),
                    normalized_residual=float(np.sqrt(squares[~rejected].sum() / max(1, dims[~rejected].sum()))),
                    num_rejected=int(rejected.sum()),
                )
            )  # fmt: skip
        return out


class SparseSystem:
    """The reduced system as gtsam Hessian factors, eliminated by gtsam.

    Poses that see much the same are one variable of the linear system: with a factor for each pair of single poses
    gtsam takes three times as long. The order is COLAMD's, an approximate minimum degree; METIS takes as long, and
    fails where a block meets no other. Unknowns are scaled to a unit diagonal, as gtsam compares pivots of different
    units.

    Args:
        keys: (N,) a B + b of the pairs of blocks a <= b that meet, in order; numbers: (N,) their tiles.
        own_keys: of the blocks that only the other factors know.
    """

    def __init__(self, problem: Problem, keys: Places, numbers: Places, own_keys: list[int]) -> None:
        blocks, dims = problem.num_blocks, problem.block_dim
        first, second = np.divmod(keys, blocks)
        self._pairs = np.stack([first, second, numbers], 1)
        self._diagonal, self._dims = numbers[first == second], dims
        near = np.zeros((blocks, blocks), bool)
        near[first, second] = near[second, first] = True
        groups = group_blocks(near, problem.num_pose_blocks)
        of_block, row = np.empty(blocks, np.int64), np.empty(blocks, np.int64)
        for n, group in enumerate(groups):
            of_block[group], row[group] = n, np.cumsum(dims[group]) - dims[group]
        self._rows = [np.concatenate([8 * b + np.arange(dims[b]) for b in group]) for group in groups]
        sizes = np.array([len(rows) for rows in self._rows])
        low, high = of_block[first], of_block[second]
        is_turned = low > high
        low, high = np.where(is_turned, high, low), np.where(is_turned, low, high)
        met, of_pair = np.unique(low * len(groups) + high, return_inverse=True)
        self._group_pairs = np.stack(np.divmod(met, len(groups)), 1)
        areas = sizes[self._group_pairs].prod(1)
        start = np.cumsum(areas) - areas
        upper, left = np.where(is_turned, row[second], row[first]), np.where(is_turned, row[first], row[second])
        width = sizes[high]
        self._places = np.stack([start[of_pair] + upper * width + left, width, is_turned.astype(np.int64)], 1)
        self._buffer = np.zeros(int(areas.sum()))
        shapes = [(sizes[i], sizes[j]) for i, j in self._group_pairs]
        self._matrices = [
            self._buffer[s : s + a].reshape(shape) for s, a, shape in zip(start, areas, shapes, strict=True)
        ]
        names = _block_keys(problem, own_keys)
        self._keys = [names[group[0]] for group in groups]
        self._empty = [(np.zeros((size, size)), np.zeros(size)) for size in sizes]
        self._ordering: Any = None
        self._is_weak = False

    def solve(self, tiles: Array, rhs: Array, run: Callable[..., Any] = map) -> Array | None:
        """Solution (B * 8,) of the damped system in tiles (N * 64,), None where it is not positive definite."""
        diagonal = tiles.reshape(-1, 8, 8)[self._diagonal][:, np.arange(8), np.arange(8)]
        if not (diagonal > 0.0).all():
            return None
        root = 1.0 / np.sqrt(diagonal)
        gather_scaled(tiles, self._pairs, self._places, root, self._dims, self._buffer)
        right = rhs * root.ravel()
        graph, factor, keys, empty = gtsam.GaussianFactorGraph(), gtsam.HessianFactor, self._keys, self._empty
        for (i, j), matrix in self._blocks():
            if i == j:
                graph.push_back(factor(keys[i], matrix, right[self._rows[i]], 0.0))
            else:
                graph.push_back(factor(keys[i], keys[j], empty[i][0], matrix, empty[i][1], *empty[j], 0.0))
        if self._ordering is None:
            self._ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
        found: Array | None = None
        if not self._is_weak:
            try:
                found = self._unpacked(graph.optimize(self._ordering))
            except RuntimeError:  # pivots of what only the damping holds are too small for it
                self._is_weak = True
        if found is None:
            found = self._solve_weak(graph, right)
        if found is not None:
            found *= root.ravel()
        return found

    def _solve_weak(self, graph: Any, right: Array) -> Array | None:
        """The same by conjugate gradients, with gtsam's factor of the system with a little more on its diagonal."""
        for key, (square, nothing) in zip(self._keys, self._empty, strict=True):
            graph.push_back(gtsam.HessianFactor(key, _ENOUGH * np.eye(len(square)), nothing, 0.0))
        try:
            net = graph.eliminateSequential(self._ordering)
        except RuntimeError:  # not positive definite: the caller raises the damping
            return None
        blocks = [np.triu(m) + np.triu(m, 1).T if i == j else m for (i, j), m in self._blocks()]
        found, rest = np.zeros(len(right)), right.copy()
        better = direction = self._unpacked(net.backSubstitute(net.backSubstituteTranspose(self._packed(rest))))
        gain = rest @ better
        for _ in range(_MAX_ROUNDS):
            image = self._product(blocks, direction)
            curvature = direction @ image
            if not curvature > 0.0:
                break
            found += gain / curvature * direction
            rest -= gain / curvature * image
            if np.abs(rest).max() <= _SOLVED * np.abs(right).max():
                break
            better = self._unpacked(net.backSubstitute(net.backSubstituteTranspose(self._packed(rest))))
            before, gain = gain, rest @ better
            direction = better + gain / before * direction
        return found

    def _blocks(self) -> Iterator[tuple[tuple[int, int], Array]]:
        """Pairs of groups and their parts of the scaled system; of those on the diagonal only the upper half counts."""
        return zip(map(tuple, self._group_pairs.tolist()), self._matrices, strict=True)

    def _product(self, blocks: list[Array], x: Array) -> Array:
        """The scaled system times x (B * 8,)."""
        out = np.zeros(len(x))
        for ((i, j), _), matrix in zip(self._blocks(), blocks, strict=True):
            out[self._rows[i]] += matrix @ x[self._rows[j]]
            if i != j:
                out[self._rows[j]] += matrix.T @ x[self._rows[i]]
        return out

    def _packed(self, x: Array) -> Any:
        out = gtsam.VectorValues()
        for key, rows in zip(self._keys, self._rows, strict=True):
            out.insert(key, x[rows])
        return out

    def _unpacked(self, values: Any) -> Array:
        out = np.zeros(8 * len(self._dims))
        out[np.concatenate(self._rows)] = values.vector(self._keys)
        return out


def _block_keys(problem: Problem, own_keys: list[int]) -> list[int]:
    """gtsam's keys of all blocks; X(i) where the intrinsics of an image stand in the block of its pose."""
    images = problem.image_idx[problem.pose_images[problem.pose_block >= 0]]
    out = [X(int(i)) for i in images]
    for c in np.flatnonzero(problem.camera_block >= problem.num_pose_blocks):
        number = int(problem.camera_idx[c])
        out += [K(number), *([gtsam.symbol("j", number)] if problem.second_block[c] >= 0 else [])]
    return [*out, *(L(int(t)) for t in problem.track_idx[problem.point_block >= 0]), *own_keys]
