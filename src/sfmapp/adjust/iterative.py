"""Systems that are too large and too full to be factored: conjugate gradients on the Schur complement, which is applied
and never made (Agarwal, Snavely, Seitz and Szeliski, "Bundle Adjustment in the Large", ECCV 2010).

A product with it passes once over the ``Z`` of all points (:func:`sfmapp.adjust.kernels.reduce_points`). The
preconditioner has the tiles of clusters of neighbouring blocks, factored exactly (as in Kushal and Agarwal, CVPR 2012);
the rest of the reduced system is not there. Steps need not be exact: rounds stop when the quadratic model gains little
more (Nash and Sofer 1990), and the closer the nearer the minimum is.

Systems that can be factored are, once: from step to step they change by little, and the factor of an earlier one is so
good a preconditioner that a few rounds cost less than making and factoring the next.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.elimination import COLUMNS
from sfmapp.adjust.envelope import EnvelopeSystem
from sfmapp.adjust.front_system import FrontSystem
from sfmapp.adjust.gauge import StepsInGauge
from sfmapp.adjust.kernels import ImageArrays, LensArrays, Meetings
from sfmapp.simd.pointers import pointer

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Blocks of a cluster of the preconditioner: the columns of tiles that are summed at once, all or none.
CLUSTER = COLUMNS
# A step of the model is wanted to this share at first, and to the last one near the minimum; the most rounds of a step.
_LOOSE, _TIGHT, _MAX_ROUNDS = 0.1, 1e-3, 300


def is_of_cluster(first: Ints, second: Ints) -> NDArray[np.bool_]:
    """(N,) which pairs of blocks are of one cluster."""
    same: NDArray[np.bool_] = first // CLUSTER == second // CLUSTER
    return same


class IterativeSystem:
    """Conjugate gradients, preconditioned by the factor of a system that is near: of clusters of blocks, or of all as
    it was some steps before.

    Attributes:
        is_held: the factor is that of an earlier step, and near enough: tiles need not be made. The caller sets it to
            False where he knows better.
        num_rounds: that the last step took.
    """

    def __init__(self, block_dim: Ints, near: EnvelopeSystem | FrontSystem, held_rounds: int = 0) -> None:
        """near: of clusters, to be factored in each step. held_rounds: or of the whole, whose factor is held for as
        long as a step takes no more rounds."""
        self._near, self._held_rounds = near, held_rounds
        self._max_rounds = 2 * held_rounds if held_rounds else _MAX_ROUNDS
        self._used = (np.arange(8) < block_dim[:, None]).ravel()
        self._last_gradient = np.inf
        self.is_held, self.num_rounds = False, 0

    def solve_with(
        self, product: Callable[[Array], Array], gauge: Callable[[], StepsInGauge], tiles: Array, rhs: Array,
        run: Callable[..., Any],
    ) -> Array | None:  # fmt: skip
        """Solution (B * 8,), None where the system is not positive definite.

        Args:
            product: of the damped reduced system with a vector (B * 8,). gauge: of the present state; a factor that is
                held has that of an earlier one. tiles: of what is near, damped; not looked at while its factor is held.
            rhs: (B * 8,).
        """
        if not self.is_held:
            if not self._near.factor(tiles, run):
                return None
            if self._held_rounds:
                self.is_held, self.num_rounds = True, 0
                return self._near.substitute(rhs)
        steps = gauge() if self._held_rounds else None

        def near(rest: Array) -> Array:
            if steps is None:
                return self._near.substitute(rest)
            return steps.of(self._near.substitute(steps.of_gradient(rest)))

        found = self._rounds(product, near, rhs)
        self.is_held = self.num_rounds <= self._held_rounds
        return found

    def _rounds(self, product: Callable[[Array], Array], near: Callable[[Array], Array], rhs: Array) -> Array | None:
        x, rest = np.zeros(len(rhs)), np.where(self._used, rhs, 0.0)
        better = near(rest)
        direction, gain, gained = better, float(rest @ better), 0.0
        wanted = self._forcing(np.sqrt(max(gain, 0.0)))
        self.num_rounds = 0
        for n in range(1, self._max_rounds + 1):
            image = product(direction)
            curvature = float(direction @ image)
            if not curvature > 0.0:
                return x if n > 1 else None
            length = gain / curvature
            x += length * direction
            rest -= length * image
            self.num_rounds, more = n, 0.5 * length * gain
            gained += more
            if n * more <= wanted * gained:
                break
            better = near(rest)
            before, gain = gain, float(rest @ better)
            direction = better + gain / before * direction
        return x

    def _forcing(self, gradient: float) -> float:
        """How closely the model is to be solved, by how much the gradient has shrunk (Eisenstat and Walker 1996)."""
        ratio = gradient / self._last_gradient if self._last_gradient > 0.0 else 1.0
        self._last_gradient = gradient
        return float(np.clip(0.9 * ratio**2, _TIGHT, _LOOSE))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_point_products(part: tuple[int, int], meetings: Meetings, rows: Array, x: Array, out: Array) -> None:
    """Take ``Z Z^T x`` of points ``part[0]`` to ``part[1]`` off out (B * 8,); rows as of ``reduce_points``."""
    ptr, block = meetings.ptr, meetings.block
    total = np.zeros(24)
    sums, Z, source, target = pointer(total), pointer(rows), pointer(x), pointer(out)
    for p in range(part[0], part[1]):
        for n in range(24):
            sums[n] = 0.0
        for e in range(ptr[p], ptr[p + 1]):
            b = 8 * block[e]
            for k in range(3):
                for n in range(8):
                    sums[8 * k + n] += Z[24 * e + 8 * k + n] * source[b + n]
        t0 = t1 = t2 = 0.0
        for n in range(8):
            t0 += sums[n]
            t1 += sums[8 + n]
            t2 += sums[16 + n]
        for e in range(ptr[p], ptr[p + 1]):
            b = 8 * block[e]
            for n in range(8):
                target[b + n] -= Z[24 * e + n] * t0 + Z[24 * e + 8 + n] * t1 + Z[24 * e + 16 + n] * t2
    total[0] = 0.0  # kept alive so far


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_block_products(own: Array, cross: Array, images: ImageArrays, lenses: LensArrays, x: Array, out: Array) -> None:
    """Add to out (B * 8,) the product of the system before elimination with x: own (B * 64,) of blocks with themselves,
    cross of poses with intrinsics, as of :class:`sfmapp.adjust.kernels.Sums`."""
    num_images = images.block.shape[0]
    for a in range(x.shape[0] // 8):
        for j in range(8):
            for k in range(8):
                out[8 * a + j] += own[64 * a + 8 * j + k] * x[8 * a + k]
    for i in range(num_images):
        a, c = images.block[i], images.camera[i]
        b, second = lenses.block[c], lenses.second[c]
        if a >= 0 and b >= 0 and a != b:
            _add_both(cross, i, a, b, x, out)
            if second >= 0:
                _add_both(cross, num_images + i, a, second, x, out)
    for c in range(lenses.block.shape[0]):
        if lenses.second[c] >= 0:
            _add_both(cross, 2 * num_images + c, lenses.block[c], lenses.second[c], x, out)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_both(cross: Array, source: int, a: int, b: int, x: Array, out: Array) -> None:
    """A tile beside the diagonal and its transpose."""
    for j in range(8):
        for k in range(8):
            out[8 * a + j] += cross[64 * source + 8 * j + k] * x[8 * b + k]
            out[8 * b + k] += cross[64 * source + 8 * j + k] * x[8 * a + j]
