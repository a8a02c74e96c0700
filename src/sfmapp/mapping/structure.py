"""Points of a growing reconstruction: triangulate, add observations, filter. Threads over chunks of tracks."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import triangulation
from sfmapp.geometry.noise import sigma_of_lengths
from sfmapp.geometry.triangulation import Observed
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.reconstruction import Reconstruction

# Tracks are independent of each other, so that chunks of any size give the same result.
CHUNK = 4096


def triangulate(
    reconstruction: Reconstruction,
    tracks: NDArray[np.int64],
    options: MappingOptions,
    pool: Executor,
    max_error_px: float | None = None,
) -> int:
    """Triangulate the given tracks afresh from the registered images, in place; returns how many succeeded."""
    return _over_chunks(triangulation.triangulate_tracks, reconstruction, tracks, options, pool, max_error_px)


def filter_observations(
    reconstruction: Reconstruction,
    options: MappingOptions,
    pool: Executor,
    tracks: NDArray[np.int64] | None = None,
    max_error_px: float | None = None,
) -> int:
    """Decide afresh which observations support their points, in place; returns the number of points dropped.

    Observations come back as well as go: those of newly registered images join the points that they agree with.

    Args:
        reconstruction: changed in place.
        options: thresholds.
        pool: runs the chunks.
        tracks: (K,) int64 tracks to look at, None for all that are triangulated.
        max_error_px: overrides the threshold of the options.
    """
    if tracks is None:
        tracks = np.flatnonzero(reconstruction.is_triangulated)
    return _over_chunks(triangulation.classify_observations, reconstruction, tracks, options, pool, max_error_px)


def residual_scale_px(reconstruction: Reconstruction, at_least: float = math.nan) -> float:
    """Robust standard deviation of one residual coordinate of the inliers in pixels.

    Inliers that have come to lie behind their camera have no residual and are left out.

    Args:
        reconstruction: what is measured.
        at_least: returned where the residuals are shorter, or where there is none.
    """
    lengths = reconstruction.errors_px()[reconstruction.obs_is_inlier]
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        return at_least
    scale = sigma_of_lengths(lengths)
    return at_least if scale < at_least else scale


def _over_chunks(
    kernel: Callable[..., int],
    reconstruction: Reconstruction,
    tracks: NDArray[np.int64],
    options: MappingOptions,
    pool: Executor,
    max_error_px: float | None = None,
) -> int:
    t = reconstruction.tracks
    arguments = (
        Observed(t.track_ptr, t.obs_image_idx, t.obs_xy), reconstruction.views(),
        max_error_px or options.max_reprojection_error_px, math.radians(options.min_triangulation_angle_deg),
        reconstruction.point_xyz, reconstruction.obs_is_inlier,
    )  # fmt: skip
    chunks = [tracks[i : i + CHUNK] for i in range(0, len(tracks), CHUNK)]
    return sum(pool.map(lambda chunk: kernel(chunk, *arguments), chunks))


def compile_kernels() -> None:
    """Compile the kernels of triangulation, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene

    model, options = make_scene(0, 3, 24).observed, MappingOptions()
    with ThreadPoolExecutor(1) as pool:
        triangulate(model, np.arange(24), options, pool)
        filter_observations(model, options, pool)
    model.residuals_px()
