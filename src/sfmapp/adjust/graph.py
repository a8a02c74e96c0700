"""A reconstruction as a gtsam factor graph in which the landmarks are eliminated by our kernels.

What is left is over poses ``X(i)`` and intrinsics ``K(c)``, beside which any other gtsam factor stands with its noise
model and robust kernel. The graph is driven by our Levenberg-Marquardt steps; its linear systems are solved by gtsam
where they are sparse, by LAPACK where most blocks meet most others, and by the envelope where they are large.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import constrained_columns, gauge_of, reduced_matrix, residual_variance
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.problem import EVERYTHING, Problem, Varying, write_back
from sfmapp.adjust.selected_inverse import covariance_of_functions
from sfmapp.adjust.solver import Engine, make_engine, run_engine
from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Residuals are not believed to be better than that.
_MIN_NOISE_PX = 0.01


@dataclass(frozen=True)
class MarginalCovariance:
    """The joint covariance of some poses, intrinsics and points, all others marginalised out.

    Attributes:
        matrix: (N, N) over six rows for each image, rotation w (radians) and translation v of
            ``x_cam <- exp(w) x_cam + v`` (gtsam's tangent of world_from_cam is its negative); the free parameters of
            each camera, in the order of ``Camera.params``; three rows for each point, in the world; and gtsam's tangent
            of each variable that was inserted. Infinite where ``is_determined`` is False.
        image_idx, camera_idx, track_idx: in this order, the variables behind them.
        num_gauge: degrees of freedom that nothing but inner constraints holds (:mod:`sfmapp.adjust.covariance`): 7 in a
            free network, 0 where factors or constant images tell place and size.
        is_determined: False if the factors leave more open than that.
    """

    matrix: Array
    image_idx: Ints
    camera_idx: Ints
    track_idx: Ints
    num_gauge: int
    is_determined: bool
    _places: dict[tuple[str, int], slice]
    _poses: Array

    def of_image(self, image: int) -> Array:
        """(6, 6) of the pose of an image position. Raises InputError if it was not asked for."""
        return self._of("image", image)

    def of_camera(self, camera: int) -> Array:
        """(Q, Q) of the free parameters of a camera. Raises InputError if it was not asked for."""
        return self._of("camera", camera)

    def of_point(self, track: int) -> Array:
        """(3, 3) of the point of a track, in the world. Raises InputError if it was not asked for."""
        return self._of("point", track)

    def of_center(self, image: int) -> Array:
        """(3, 3) of the centre of an image's camera, in the world. Raises InputError if it was not asked for."""
        found = self._of("image", image)
        if not np.isfinite(found).all():
            return np.full((3, 3), np.inf)
        return rigid3.center_covariance(self._poses[np.flatnonzero(self.image_idx == image)[0]], found)

    def of_variable(self, key: int) -> Array:
        """(D, D) of a variable that was inserted. Raises InputError if it was not asked for."""
        return self._of("variable", key)

    def _of(self, what: str, number: int) -> Array:
        place = self._places.get((what, number))
        if place is None:
            raise InputError(f"{what} {number} is not one whose covariance was asked for")
        return self.matrix[place, place]


class FactorGraph:
    """A factor graph over a reconstruction: its reprojections, and whatever else is added.

    Variables are ``X(i)``, gtsam.Pose3 world_from_cam of the image at position i (on a rig: of the image of sensor 0);
    ``K(c)``, Vector of the free parameters of camera c in the order of ``Camera.params``; ``L(t)``, Point3 of track t;
    and those of :meth:`insert`, of up to eight dimensions. Landmarks are eliminated by our kernels, except those that a
    factor mentions. A factor with a constant image or point counts as it stands; one with an image that is not
    registered, a point without a place or a constant camera is left out, and the report says how many were.

    Noise of a pixel coordinate is ``noise_px``, and all other factors are as sure as they say: sigmas of positions are
    in units of the world, of rotations in radians. Hard constraints are refused.

    Attributes:
        reconstruction: changed in place by :meth:`optimize` and :meth:`from_gtsam`.
        options: the loss of the reprojections, which intrinsics are free, and when to stop.
        noise_px: standard deviation of a pixel coordinate.
        factors: gtsam.NonlinearFactorGraph of what was added. values: gtsam.Values of variables that were inserted.

    Example:
        >>> graph = sfmapp.FactorGraph(reconstruction)
        >>> noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.02)  # metres
        >>> for i, position in enumerate(gps):
        ...     graph.add(gtsam.GPSFactor(gtsam.symbol_shorthand.X(i), position, noise))
        >>> report = graph.optimize()
        >>> graph.marginal_covariance(images=[0]).of_center(0)
    """

    def __init__(
        self,
        reconstruction: Reconstruction,
        options: AdjustOptions | None = None,
        *,
        varying: Varying = EVERYTHING,
        prior_cameras: Sequence[Camera] | None = None,
        noise_px: float | None = None,
        threads: int = 1,
    ) -> None:
        """Nothing is adjusted yet.

        Args:
            reconstruction: its inlier observations are the reprojection factors.
            options: None for the default ones.
            varying: which poses, intrinsics and points take part and may change; all by default.
            prior_cameras: (C,) cameras as they were known beforehand: Gaussian priors around their parameters, with
                ``focal_sigma`` for focal lengths and the options' sigmas for the rest. None for no priors.
            noise_px: None to take it from the residuals as they are now, (robustly) weighted, and from how many degrees
                of freedom an adjustment leaves them.
            threads: at most this many; the result does not depend on it.

        Raises:
            InputError: the noise is not positive, or there are too few residuals to take it from.
        """
        self.reconstruction, self.options = reconstruction, options or AdjustOptions()
        self._varying, self._prior_cameras, self._threads = varying, prior_cameras, threads
        self.noise_px = self._measured_noise() if noise_px is None else noise_px
        if not (np.isfinite(self.noise_px) and self.noise_px > 0.0):
            raise InputError(f"the noise of a pixel coordinate must be positive, found {noise_px}")
        self._factors: Any = None
        self._kinds: dict[int, str] = {}
        self._values: Any = None
        self._plain: Any = None

    @property
    def factors(self) -> Any:
        """gtsam.NonlinearFactorGraph of what was added; see the class."""
        if self._factors is None:
            import gtsam

            self._factors = gtsam.NonlinearFactorGraph()
        return self._factors

    @property
    def values(self) -> Any:
        """gtsam.Values of variables that were inserted; see the class."""
        if self._values is None:
            import gtsam

            self._values = gtsam.Values()
        return self._values

    def add(self, factor: Any, kind: str | None = None) -> None:
        """Add a gtsam factor, or a NonlinearFactorGraph of them.

        Args:
            kind: what the report calls a single factor; None for the name of its class.
        """
        if kind is not None:
            self._kinds[self.factors.size()] = kind
        self.factors.push_back(factor)

    def insert(self, key: int, value: Any) -> None:
        """Add a variable of any type that gtsam.Values holds, where the search for it begins: a velocity, a bias, an
        offset that many factors share. Some factor has to mention it.

        Raises:
            InputError: the key is one of X, K or L, which the reconstruction has, or is there already.
        """
        import gtsam

        if chr(gtsam.Symbol(key).chr()) in "xkl" or self.values.exists(key):
            raise InputError(f"{gtsam.DefaultKeyFormatter(key)} is a variable of the graph already")
        self.values.insert(key, value)

    def optimize(self, events: Events | None = None) -> AdjustReport:
        """Adjust everything, in place, and say what each kind of factor came to.

        Raises:
            InterruptedRunError: on cancellation; the reconstruction then holds the best state so far.
            ValueError: a factor over an unknown variable, a hard constraint, or an image that has not the rig's pose.
            UsageError: ``options.backend`` is gtsam, which has not this camera model.
        """
        extras = self._extras()
        if self.options.backend == "gtsam":
            from sfmapp.adjust.reference import adjust_with_gtsam

            report = adjust_with_gtsam(
                self.reconstruction, self.options, self._varying, prior_cameras=self._prior_cameras,
                extra_factors=extras, noise_px=self.noise_px, events=events,
            )  # fmt: skip
        else:
            engine = self._engine(extras, is_closing=True, may_iterate=True)
            report = run_engine(engine, self.reconstruction, self.options, threads=self._threads, events=events)
        if extras is not None:
            self._values = extras.values
        return report

    def to_gtsam(self) -> tuple[Any, Any]:
        """The plain gtsam.NonlinearFactorGraph, one factor per observation, and its Values at the present state.

        Its variables are those of this graph, all landmarks among them, and ``C(c)``, the calibrations. What is
        constant is held by priors of 1e-7. One focal length beside a free principal point, which none of gtsam's
        calibrations has, is two that are tied; gtsam.Marginals, which factorises by Cholesky, may take what the tie
        leaves for open, where QR does not. Hundreds of thousands of observations take gigabytes.

        Raises:
            UsageError: gtsam has no such camera model.
        """
        self._plain = self._plain_graph()
        return self._plain.graph, self._plain.values

    def from_gtsam(self, values: Any) -> None:
        """Take over values of the variables of :meth:`to_gtsam`, after whatever was done with them.

        Raises:
            InputError: a variable is missing, or has another type.
        """
        plain = self._plain or self._plain_graph()
        try:
            plain.read_back(values)
        except RuntimeError as error:
            raise InputError(f"these are not the values of this graph: {str(error).strip()}") from error
        write_back(plain.problem, self.reconstruction)
        if plain.extras is not None:
            self._values = plain.extras.values
        self._plain = None

    def marginal_covariance(
        self,
        *,
        images: Iterable[int | str] = (),
        cameras: Iterable[int] = (),
        points: Iterable[int] = (),
        variables: Iterable[int] = (),
    ) -> MarginalCovariance:
        """The joint covariance of some variables at the present state, which should be the minimum.

        Args:
            images: names or positions. cameras: positions. points: tracks. variables: keys that were inserted. All must
                vary.

        Time is that of one dense factor over all poses and intrinsics, memory that of two such matrices; variables that
        were inserted and are not asked for are eliminated before that, sparsely.

        Raises:
            InputError: something is not there or does not vary.
        """
        image_idx = [self._image_position(image) for image in images]
        camera_idx, track_idx, keys = [int(c) for c in cameras], [int(t) for t in points], [int(k) for k in variables]
        engine = self._engine(self._extras(track_idx), is_closing=False)
        problem, extras = engine.problem, engine.extras
        own = extras.own_places() if extras is not None else {}
        rows, places = _rows_of(problem, image_idx, camera_idx, track_idx, {key: own.get(key) for key in keys})
        engine.linearize(0.0, map)
        is_kept = np.ones(problem.num_blocks, bool)
        is_kept[[place[0] // 8 for key, place in own.items() if key not in keys]] = False
        has_row = np.arange(8) < problem.block_dim[:, None]
        used, inner = (is_kept[:, None] & has_row).ravel(), has_row[is_kept].ravel()
        information, scale = reduced_matrix(engine, is_kept)[np.ix_(inner, inner)], engine.diagonal[used]
        basis, constraint = gauge_of(problem, used, information, scale, has_factors=extras is not None)
        wanted = rows[:, used]
        columns = constrained_columns(information, scale, basis, constraint, wanted.T)
        size = len(rows)
        matrix = np.full((size, size), np.inf) if columns is None else self.noise_px**2 * wanted @ columns
        poses = self.reconstruction.cam_from_world[image_idx].reshape(-1, 7)
        return MarginalCovariance(
            0.5 * (matrix + matrix.T), np.array(image_idx, np.int64), np.array(camera_idx, np.int64),
            np.array(track_idx, np.int64), len(basis), columns is not None, places, poses,
        )  # fmt: skip

    def covariance_of_functions(self, of_images: Array, of_variables: Mapping[int, Array]) -> Array | None:
        """The joint covariance (M, M) of a few linear functions of all poses and of variables that were inserted, at
        the present state, which should be the minimum: of large graphs as well, by one sparse factor.

        Args:
            of_images: (M, I, 6) how each moves with the pose of each image, in the tangent of
                :class:`MarginalCovariance`; what is constant does not count.
            of_variables: (M, D) likewise of variables, by their keys.

        Returns:
            None where the factors leave something open.
        """
        engine = self._engine(self._extras(), is_closing=True)
        problem, own = engine.problem, engine.extras.own_places() if engine.extras is not None else {}
        rows = np.zeros((len(of_images), problem.num_blocks * 8))
        for n in np.flatnonzero(problem.image_block >= 0):
            at = problem.image_block[n] * 8 + np.arange(6)
            rows[:, at] += of_images[:, problem.image_idx[n]] @ _of_rig(problem, int(n))
        for key, part in of_variables.items():
            rows[:, own[key]] = part
        found = covariance_of_functions(engine, rows)
        return None if found is None else self.noise_px**2 * 0.5 * (found + found.T)

    def _image_position(self, image: int | str) -> int:
        names = self.reconstruction.image_names
        if isinstance(image, str):
            if image not in names:
                raise InputError(f"there is no image {image!r}")
            return list(names).index(image)
        return int(image)

    def _extras(self, points: Sequence[int] = ()) -> Any:
        """What was added, and points that are not to be eliminated; None where there is nothing of the kind."""
        if not points and (self._factors is None or self._factors.size() == 0):
            return None
        from sfmapp.adjust.factors import ExtraFactors

        return ExtraFactors(self.factors, self.values, points, self._kinds)

    def _engine(self, extras: Any, *, is_closing: bool, may_iterate: bool = False) -> Engine:
        return make_engine(
            self.reconstruction, self.options, self._varying, prior_cameras=self._prior_cameras, extra_factors=extras,
            is_closing=is_closing, may_iterate=may_iterate, noise_px=self.noise_px,
        )  # fmt: skip

    def _measured_noise(self) -> float:
        engine = make_engine(
            self.reconstruction, self.options, self._varying, prior_cameras=self._prior_cameras, is_closing=False
        )
        if not engine.problem.num_observations:
            raise InputError("the reconstruction has no observations to estimate the noise from")
        variance = residual_variance(engine)
        if not np.isfinite(variance):
            raise InputError("too few observations to estimate their noise; give noise_px")
        return max(_MIN_NOISE_PX, float(np.sqrt(variance)))

    def _plain_graph(self) -> Any:
        from sfmapp.adjust.reference import PlainGraph

        return PlainGraph(
            self.reconstruction, self.options, self._varying, self._prior_cameras, self._extras(), self.noise_px
        )


def _rows_of(
    problem: Problem, images: list[int], cameras: list[int], tracks: list[int], variables: dict[int, Ints | None]
) -> tuple[Array, dict[tuple[str, int], slice]]:
    """(N, B * 8) how each wanted quantity moves with the unknowns, and the rows of each."""
    parts: list[tuple[tuple[str, int], Ints, Array]] = []
    for i in images:
        n = np.flatnonzero(problem.image_idx == i)
        block = problem.image_block[n[0]] if len(n) else -1
        parts.append((("image", i), block * 8 + np.arange(6), _of_rig(problem, int(n[0]) if len(n) else -1)))
    for c in cameras:
        n = np.flatnonzero(problem.camera_idx == c)
        block = problem.camera_block[n[0]] if len(n) else -1
        columns = np.arange(0)
        if block >= 0:
            columns = np.unique(problem.free.column[problem.free.ptr[n[0]] : problem.free.ptr[n[0] + 1]])
        parts.append((("camera", c), block * 8 + columns, np.eye(len(columns))))
    for t in tracks:
        n = np.flatnonzero(problem.track_idx == t)
        block = problem.point_block[n[0]] if len(n) else -1
        parts.append((("point", t), block * 8 + np.arange(3), np.eye(3)))
    for key, place in variables.items():
        at = np.full(1, -1) if place is None else place
        parts.append((("variable", key), at, np.eye(len(at))))
    places, first = {}, 0
    rows = np.zeros((sum(len(part[2]) for part in parts), problem.num_blocks * 8))
    for (what, number), at, matrix in parts:
        if not len(at) or at[0] < 0:
            raise InputError(f"{what} {number} has no covariance: it does not exist or is constant")
        places[what, number] = slice(first, first + len(at))
        rows[first : first + len(at), at] = matrix
        first += len(at)
    return rows, places


def _of_rig(problem: Problem, image: int) -> Array:
    """(6, 6) how the pose of a local image moves with that of its block: by its adjoint where it sits on a rig."""
    adjoint = np.eye(6)
    if image >= 0 and problem.image_mount[image] >= 0:
        mount = problem.mounts[problem.image_mount[image]]
        rotation = mount[:9].reshape(3, 3)
        adjoint[:3, :3] = adjoint[3:, 3:] = rotation
        adjoint[3:, :3] = rigid3.skew(mount[9:]) @ rotation
    return adjoint
