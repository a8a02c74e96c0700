"""A matched pair as measurements: depths with their sigmas, how sure each is, and what the rig can tell at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import as_rgb
from sfmapp.reporting import Report
from sfmapp.scene.mesh import Mesh, vertex_normals
from sfmapp.stereo.depth import depth_of_disparity, points_of_depth
from sfmapp.stereo.disparity_error import DisparityError, disparity_error
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedGeometry, RectifiedPair
from sfmapp.stereo.uncertainty import depth_interval, depth_limits, depth_sigma

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

# what is more likely wrong than right is in the maps, but in no cloud or mesh
_LEAST_CONFIDENCE = 0.5
# of depths, what a table shows: nearest to farthest
_SHOWN = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98)
# of a mesh, whose viewers and files suffer from more
_MAX_VERTICES = 600_000


@dataclass(frozen=True)
class MeasuredPair:
    """What is known of each pixel (H, W) of the left picture.

    Attributes:
        error: of disparities.
        depth, depth_sigma: float32, NaN where unknown; None where no baseline is known.
        is_solid: what clouds and meshes are made of: matched, rather right than wrong, and told from infinity with 95
            per cent.
    """

    error: DisparityError
    depth: Map | None
    depth_sigma: Map | None
    is_solid: Mask


class DepthAt(Report):
    """How well a depth is told.

    Attributes:
        depth: that this share of the pixels is nearer than. share: that.
        disparity_px, disparity_sigma_px: there; the latter the median of pixels of about this depth.
        sigma: of the depth. of_calibration: the part that all pixels have in common; 0 where nothing is known of it.
    """

    share: float
    depth: float
    disparity_px: float
    disparity_sigma_px: float
    sigma: float
    of_calibration: float


class MeasuredReport(Report):
    """What is said of the error of a pair.

    Attributes:
        median_sigma_px, median_half_width_95_px: of matched disparities; absent where nothing was matched.
        sure_share: of the matched pixels, those with at least 9 in 10 chances to be right within a pixel.
        expected_right: of the matched pixels, the share that is right within a pixel, as their confidences have it.
        solid_share: of all pixels, those in cloud and mesh.
        least_depth, greatest_depth: that the rig and the search can tell; absent without a baseline.
        ten_percent_depth: where sigma is a tenth of the depth.
        unit: of depths. depths: from near to far.
    """

    median_sigma_px: float | None = None
    median_half_width_95_px: float | None = None
    sure_share: float
    expected_right: float
    solid_share: float
    least_depth: float | None = None
    greatest_depth: float | None = None
    ten_percent_depth: float | None = None
    unit: str
    depths: Sequence[DepthAt]


def measure_pair(pair: RectifiedPair, found: DisparityMap, *, threads: int = 1) -> MeasuredPair:
    """Depths and errors of a matched pair."""
    return measured_of(pair.geometry, found, disparity_error(pair, found, threads=threads))


def measured_of(geometry: RectifiedGeometry | None, found: DisparityMap, error: DisparityError) -> MeasuredPair:
    """The same with errors that are known."""
    is_solid = (error.confidence >= _LEAST_CONFIDENCE) & (found.state == PixelState.MATCHED)
    if geometry is None or geometry.baseline is None:
        return MeasuredPair(error, None, None, is_solid)
    depth = depth_of_disparity(found.disparity, geometry)
    _, far = depth_interval(geometry, found.disparity, error.half_width_95)
    return MeasuredPair(error, depth, depth_sigma(geometry, found.disparity, error.sigma), is_solid & np.isfinite(far))


def report_of(pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair) -> MeasuredReport:
    """What a report says of it."""
    matched = (found.state == PixelState.MATCHED) & np.isfinite(measured.error.sigma)
    confidence = measured.error.confidence[matched]
    told: dict[str, float] = {}
    depths: list[DepthAt] = []
    if matched.any():
        told["median_sigma_px"] = float(np.median(measured.error.sigma[matched]))
        told["median_half_width_95_px"] = float(np.median(measured.error.half_width_95[matched]))
        if pair.geometry is not None and measured.depth is not None:
            limits = depth_limits(pair.geometry, found.searched[1], told["median_sigma_px"])
            told |= {"least_depth": limits.least, "ten_percent_depth": limits.at_ten_percent}
            told["greatest_depth"] = limits.greatest
            depths = _depths(pair.geometry, found, measured)
    return MeasuredReport(
        **told, sure_share=float((confidence >= 0.9).mean()) if confidence.size else 0.0,
        expected_right=float(confidence.mean()) if confidence.size else 0.0,
        solid_share=float(measured.is_solid.mean()), unit=pair.geometry.unit if pair.geometry is not None else "",
        depths=depths,
    )  # fmt: skip


def _depths(geometry: RectifiedGeometry, found: DisparityMap, measured: MeasuredPair) -> list[DepthAt]:
    use = measured.is_solid
    if not use.any():
        return []
    disparity, sigma = found.disparity[use], measured.error.sigma[use]
    order = np.argsort(-disparity)
    rows = []
    for share in _SHOWN:
        # those of the nearest twentieth of the pixels to this place
        place = round(share * (len(order) - 1))
        beside = order[max(0, place - len(order) // 40) : place + len(order) // 40 + 1]
        d, s = float(disparity[order[place]]), float(np.median(sigma[beside]))
        rows.append(
            DepthAt(
                share=share, depth=float(depth_of_disparity(d, geometry)), disparity_px=d, disparity_sigma_px=s,
                sigma=float(depth_sigma(geometry, d, s)), of_calibration=float(depth_sigma(geometry, d, 0.0)),
            )
        )  # fmt: skip
    return rows


def cloud_of(pair: RectifiedPair, measured: MeasuredPair) -> tuple[Map, NDArray[np.uint8]]:
    """Points (N, 3) of the solid pixels, in the frame of the rectified left camera, and their colours (N, 3)."""
    assert measured.depth is not None
    assert pair.geometry is not None
    use = measured.is_solid
    return points_of_depth(measured.depth, pair.geometry)[use], as_rgb(pair.left)[use]


def mesh_of(pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair) -> Mesh:
    """The view as a surface, textured with the left picture: triangles between neighbouring solid pixels, unless their
    disparities differ by more than their places do. Such a slope turns away from the right camera: nothing that both
    see is so steep (the disparity gradient limit of Burt and Julesz, Science 1980), and there is an edge instead."""
    assert measured.depth is not None
    assert pair.geometry is not None
    height, width = measured.depth.shape
    step = max(1, int(np.ceil(np.sqrt(height * width / _MAX_VERTICES))))
    rows, columns = np.arange(0, height, step), np.arange(0, width, step)
    grid = np.ix_(rows, columns)
    disparity = np.where(measured.is_solid[grid], found.disparity[grid], np.nan)
    corner = np.arange(disparity.size, dtype=np.int32).reshape(disparity.shape)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    faces = np.concatenate([np.stack(three, axis=-1).reshape(-1, 3) for three in ((a, c, b), (b, c, d))])
    of_corners = disparity.ravel()[faces]
    faces = faces[of_corners.max(1) - of_corners.min(1) < step]  # never of NaN
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    xyz = points_of_depth(measured.depth, pair.geometry)[grid].reshape(-1, 3)[used].astype(np.float64)
    uv = np.stack(np.meshgrid((columns + 0.5) / width, (rows + 0.5) / height), axis=-1).reshape(-1, 2)[used]
    picture = as_rgb(pair.left)
    return Mesh(
        xyz, faces, vertex_normals(xyz, faces), picture[grid].reshape(-1, 3)[used], uv.astype(np.float32), picture
    )
