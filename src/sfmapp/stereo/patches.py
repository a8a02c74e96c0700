"""Two views with known cameras to oriented patches, by way of their disparities.

Of two views no third one corrects what a window alone decides, but semi-global matching has the neighbours to do it:
its disparities, refined by slanted planes, become patches of the left view, the plane through those about each its
normal.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.dense.densify import STAGE, densify
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.report import DensifyReport, TwoViewsReport
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.reporting import Step
from sfmapp.scene.rig import Rig
from sfmapp.stereo.depth import points_of_depth
from sfmapp.stereo.disparity_error import match_cues
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.measured import MeasuredPair, measure_pair
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.rectification import Rectification, plan_rectification, rectify
from sfmapp.stereo.result import DisparityMap, RectifiedGeometry, RectifiedPair
from sfmapp.stereo.sparse_matches import PairMatches

Array = NDArray[np.float64]
Map = NDArray[np.float32]

# disparities that tell the plane through a pixel: so many on each side of it, and so far off the plane at most, pixels
_REACH, _MOST_OFF_PX = 5, 1.0
# fewer sparse points than this tell no range of disparities
_FEW_POINTS = 20


def densify_pair(
    scene: DenseScene, options: DenseOptions, *, threads: int = 1, events: Events | None = None
) -> tuple[Patches, DensifyReport]:
    """Two views to patches, by growth and by stereo: the one that covers more of both is taken, and the other where it
    leaves gaps. Neither is the better one everywhere (``benchmarks/results/dense_pairs.md``): disparities cover what
    has little texture, patches what the two views see at different slants.

    Arguments and result are those of :func:`~sfmapp.dense.densify.densify`.

    Raises:
        InterruptedRunError: ``events`` was asked to stop.
    """
    events = events or Events()
    grown, report = densify(scene, options, threads=threads, events=events)
    try:
        matched = stereo_patches(scene, options.cell_px, threads=threads)
    except InputError as refused:
        events.decided(STAGE, f"patches by growth alone, not by stereo: {refused}")
        return grown, report
    covered = [_covered(scene, patches, options.cell_px) for patches in (matched, grown)]
    counts = [sum(int(cells.sum()) for cells in of_views) for of_views in covered]
    either = sum(int((one | other).sum()) for one, other in zip(*covered, strict=True))
    first = int(counts[1] > counts[0])
    both = (matched, grown)
    gaps = _in_gaps(scene, both[1 - first], covered[first], options.cell_px)
    patches = both[first].with_more(both[1 - first].subset(gaps))
    taken = len(both[first]), int(gaps.sum())
    by_stereo, by_growth = taken[::-1] if first else taken
    steps = {
        "by stereo and by growth": len(matched) + len(grown),
        "where the other has one": len(matched) + len(grown) - len(patches), "patches": len(patches),
    }  # fmt: skip
    events.decided(STAGE, f"of two photographs {by_stereo} patches by stereo, {by_growth} by growth")
    return patches, replace(
        report, num_patches=len(patches), funnel=[Step(name=name, count=count) for name, count in steps.items()],
        two_views=TwoViewsReport(
            by_stereo=by_stereo, by_growth=by_growth, of_stereo_share=counts[0] / max(either, 1),
            of_growth_share=counts[1] / max(either, 1), is_stereo_first=not first,
        ),
    )  # fmt: skip


def _cells(view: DenseView, patches: Patches, cell_px: int) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """(N,) which patches a view shows, and (N, 2) their column and row of cells; (0, 0) of those that it does not."""
    pixel, _ = view.project(patches.xyz)
    shown = view.shows(pixel)
    return shown, (np.where(shown[:, None], pixel, 0.0) / cell_px).astype(np.int64)


def _covered(scene: DenseScene, patches: Patches, cell_px: int) -> list[NDArray[np.bool_]]:
    """Of each view the cells that a patch lies in or beside: a rectified grid is not that of the view."""
    import cv2

    out = []
    for view in scene.views:
        shown, cell = _cells(view, patches, cell_px)
        cells = np.zeros((-(-view.height // cell_px), -(-view.width // cell_px)), np.uint8)
        cells[cell[shown, 1], cell[shown, 0]] = 1
        out.append(cv2.dilate(cells, np.ones((3, 3), np.uint8)) > 0)
    return out


def _in_gaps(scene: DenseScene, patches: Patches, covered: list[NDArray[np.bool_]], cell_px: int) -> NDArray[np.bool_]:
    """(N,) which patches lie in cells of both views that are not covered."""
    inside = np.ones(len(patches), np.bool_)
    for view, cells in zip(scene.views, covered, strict=True):
        shown, cell = _cells(view, patches, cell_px)
        inside &= shown & ~cells[cell[:, 1], cell[:, 0]]
    return inside


def stereo_patches(scene: DenseScene, cell_px: int = 1, *, threads: int = 1) -> Patches:
    """Patches of the two views of a scene by their disparities alone, one for each cell of ``cell_px`` pixels of the
    left one at most, which is their reference image.

    Raises:
        InputError: the views cannot be rectified: one camera sees the other, or they look too far apart.
    """
    rig, order = _rig_of(scene.views)
    left, right = (scene.views[m] for m in order)
    plan = plan_rectification(rig)
    pair = rectify(plan, left.rgb, right.rgb)
    points = _rectified_points(scene, plan, (left, right))
    found = match_pair(pair, StereoOptions(refine=True), matches=points if len(points) >= _FEW_POINTS else None)
    return _patches(scene, plan, pair, found, measure_pair(pair, found, threads=threads), order, cell_px)


def _rig_of(views: tuple[DenseView, ...]) -> tuple[Rig, tuple[int, int]]:
    """The two cameras, the left one first, and which views they are."""
    cameras = tuple(Camera(CameraModel.PINHOLE, view.width, view.height, view.k) for view in views)
    first, second = (view.cam_from_world for view in views)
    rig = Rig(cameras, np.array([rigid3.IDENTITY, rigid3.compose(second, rigid3.inverse(first))]))
    return (rig.reversed_pair(), (1, 0)) if rig.second_is_left else (rig, (0, 1))


def _rectified_points(scene: DenseScene, plan: Rectification, views: tuple[DenseView, DenseView]) -> PairMatches:
    """The sparse points where both rectified pictures show them."""
    places = [plan.points(side, view.project(scene.point_xyz)[0]) for side, view in enumerate(views)]
    shown = [((xy >= 0.0) & (xy < [plan.geometry.width, plan.geometry.height])).all(1) for xy in places]
    return PairMatches(places[0], places[1]).of(np.asarray(shown[0] & shown[1]))


def _patches(
    scene: DenseScene, plan: Rectification, pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair,
    order: tuple[int, int], cell_px: int,
) -> Patches:  # fmt: skip
    assert measured.depth is not None
    assert measured.depth_sigma is not None
    assert pair.geometry is not None
    view, other = scene.views[order[0]], scene.views[order[1]]
    row, column = np.nonzero(measured.is_solid)
    seen = points_of_depth(measured.depth, pair.geometry)[row, column].astype(np.float64)
    normal = _normals(found.disparity, measured.is_solid, pair.geometry)[row, column]
    world_from_cam = rigid3.inverse(view.cam_from_world)
    turn = plan.left_from_camera  # of rows: points from the rectified frame to the camera's
    xyz = rigid3.apply(world_from_cam, seen @ turn)
    pixel, depth = view.project(xyz)
    far = np.linalg.norm(seen, axis=1)
    chosen = np.flatnonzero(view.shows(pixel) & _is_open(view, pixel) & _is_open(other, other.project(xyz)[0]))
    confidence = measured.error.confidence[row, column]
    chosen = _best_of_cells(pixel[chosen], confidence[chosen], view.width, cell_px, chosen)
    ncc = 1.0 - np.exp(match_cues(pair, found)[0][1][row, column])
    x, y = pixel[chosen].astype(np.int64).T
    count = len(chosen)
    rotation = rigid3.rotation_matrix(world_from_cam)
    return Patches(
        xyz[chosen], (normal[chosen] @ turn @ rotation.T).astype(np.float32), view.rgb[y, x],
        ncc[chosen].astype(np.float32),
        (measured.depth_sigma[row, column] * far / seen[:, 2])[chosen].astype(np.float32),
        (depth[chosen] / view.k[:2].mean()).astype(np.float32), np.zeros(count, np.int32),
        2 * np.arange(count + 1, dtype=np.int64), np.tile(np.array(order, np.int32), count),
    )  # fmt: skip


def _is_open(view: DenseView, pixel: Array) -> NDArray[np.bool_]:
    if view.mask is None:
        return np.ones(len(pixel), np.bool_)
    x, y = np.nan_to_num(pixel, nan=-1.0).clip(0, [view.width - 1, view.height - 1]).astype(np.int64).T
    return np.asarray(view.mask[y, x])


def _best_of_cells(
    pixel: Array, confidence: Map, width: int, cell_px: int, idx: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Of the patches ``idx`` at pixels (N, 2) the most confident of each cell, in their order."""
    x, y = (pixel / cell_px).astype(np.int64).T
    cell = y * (width // cell_px + 1) + x
    best = np.lexsort((-confidence, cell))
    first = np.ones(len(best), np.bool_)
    first[1:] = np.diff(cell[best]) != 0
    return idx[np.sort(best[first])]


def _normals(disparity: Map, use: NDArray[np.bool_], geometry: RectifiedGeometry) -> Array:
    """(H, W, 3) unit normals in the frame of the rectified left camera, towards it, of the plane through disparities
    about each pixel: d + doffs = a x + b y + c is the plane (a f, b f, a cx + b cy + c) X = f B."""
    slopes = np.zeros((*disparity.shape, 2), np.float32)
    fit_slopes(np.where(use, disparity, np.float32(np.nan)), slopes)
    a, b = slopes[..., 0].astype(np.float64), slopes[..., 1].astype(np.float64)
    y, x = np.mgrid[: disparity.shape[0], : disparity.shape[1]] + 0.5
    along = disparity + geometry.doffs - a * (x - geometry.cx) - b * (y - geometry.cy)
    normal = -np.stack([a * geometry.focal, b * geometry.focal, along], -1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


@numba.njit(cache=True, nogil=True)
def fit_slopes(disparity: Map, slopes: Map) -> None:
    """The slope (H, W, 2) along x and y of a plane through each disparity (H, W), NaN where there is none, and those
    about it, which count the less the farther off it they lie: twice, first about the disparity itself."""
    height, width = disparity.shape
    for y in range(height):
        for x in range(width):
            here = disparity[y, x]
            if not np.isfinite(here):
                continue
            a = b = 0.0
            for n in range(3):
                reach = 2 if n == 0 else _REACH
                xx = yy = 1e-3
                xy = xd = yd = 0.0
                sw = sx = sy = sd = 0.0
                for v in range(max(y - reach, 0), min(y + reach + 1, height)):
                    for u in range(max(x - reach, 0), min(x + reach + 1, width)):
                        d = disparity[v, u] - here
                        off = (d - a * (u - x) - b * (v - y)) / (_MOST_OFF_PX * (2.0 if n == 0 else 1.0))
                        weight = 1.0 - off * off
                        if weight > 0.0:
                            weight *= weight
                            sw += weight
                            sx += weight * (u - x)
                            sy += weight * (v - y)
                            sd += weight * d
                            xx += weight * (u - x) * (u - x)
                            yy += weight * (v - y) * (v - y)
                            xy += weight * (u - x) * (v - y)
                            xd += weight * (u - x) * d
                            yd += weight * (v - y) * d
                xx -= sx * sx / sw
                yy -= sy * sy / sw
                xy -= sx * sy / sw
                xd -= sx * sd / sw
                yd -= sy * sd / sw
                determinant = xx * yy - xy * xy
                if determinant > 1e-3 * xx * yy:
                    a, b = (yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant
            slopes[y, x, 0], slopes[y, x, 1] = a, b
