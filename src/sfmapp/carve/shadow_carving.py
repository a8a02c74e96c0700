"""Volumes made smaller by shadows, where camera and light both vouch that nothing is there.

After Savarese, Andreetto, Rushmeier, Bernardini and Perona, "3D reconstruction by shadow carving: theory and practical
evaluation", IJCV 71(3), 2007. What follows is their argument for cells of finite size.

Let U hold the object O, and let R be a part of U such that

1. every pixel that R may touch in a photograph is in shadow under a light l, and
2. from every point of R, straight ways to the camera c, to l, and to all directions up to an angle a beyond l as seen
   from c (in the plane of point, c and l), meet nothing of U but R.

Camera and light have a common direction d that leads nearer to both. If there were points of O in R, then the one
farthest along d would be seen by the camera and be lit, as whatever could hide it would be one of O farther along d.
Its normal n turns towards c, and towards l' at the end of the fan; since l lies between the two,
``n l >= (n c) sin(a) / sin(angle(c, l) + a)``: beside a photograph that is lit from the camera, its brightness in the
photograph under l is no less than that quotient of sines. That is no shadow, so R is empty. The angle a may be another
at each point, and dark shadows need a narrow one. All such R together are one again, and it is found by taking from
what is dark all that lies behind a held place for the camera or for the fan.

That is for surfaces which are smooth to the eye of the camera. Of an edge, the side that is seen may be turned away
from the light, and the side that is lit from the camera, if its interior angle is less than that between light and
camera. Nothing lit is seen of it then, though nothing is in its way, and it would be taken away: of a solid with edges
of 23 to 46 degrees 0.2 % of the surface was, by lights at 55. But if the side that is seen leans towards the light, it
is lit. So 1. is asked of pixels whose surface leans towards l, as the other lights show (:mod:`sfmapp.carve.leaning`),
unless no edge of the object is as sharp (``edge_deg``). There mixtures of three lights take away more, whatever the
edges: :mod:`sfmapp.carve.lamp_mixtures`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.cell_grid import CellGrid, coarsened, grid_of, intersect, octree_of
from sfmapp.carve.lamp_mixtures import LampLight, proven_empty
from sfmapp.carve.octree import Octree
from sfmapp.carve.shadow_kernels import Planes, angles_of_all, find_dark, find_held, take_free
from sfmapp.carve.views import View, angle_deg
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.option_checks import Range, check_options
from sfmapp.reporting import Report

Array = NDArray[np.float64]
# finest level whose window of dense cells is held in memory, some of them at a time
MAX_DEPTH = 9
# samples in half planes, in finest cells where the volume has its middle
_STEP = 0.5
# shares of the widest fan that are told apart: the narrower, the more is carved
_FANS = (0.25, 0.5, 1.0)
# all photographs are gone through once with cells of each level from this one on: twice took 0.3 to 2 % more
_COARSEST = 6
# slices of a window that are gone through at a time
_SLICES = 32


@dataclass(frozen=True)
class ShadowOptions:
    """Options of the stage ``shadows``.

    Attributes:
        fan_deg: Angle beyond a light from which a place has to be free too, degrees. The larger, the brighter may a
            shadow be that is told from a surface which hardly turns towards the light, and the less is carved.
        max_angle_deg: Light and camera farther apart, as seen from the object, are not used together, degrees.
        edge_deg: No edge of the object is sharper, interior angle in degrees. Between light and camera farther apart,
            only what is shown to lean towards the light counts as shadow.
        margin_px: What is no farther than that from a lit pixel does not count as dark, pixels: the lit part of a dark
            pixel may be too small to be noticed, and cameras may be off.
    """

    fan_deg: float = 2.0
    max_angle_deg: float = 75.0
    edge_deg: float = 20.0
    margin_px: float = 0.25

    def __post_init__(self) -> None:
        check_options("shadows", self, {
            "fan_deg": Range(0.5, 30.0), "max_angle_deg": Range(5.0, 90.0),
            "edge_deg": Range(0.0, 90.0), "margin_px": Range(0.0),
        })  # fmt: skip


@dataclass(frozen=True)
class Shadow:
    """What one photograph under one light shows to be in shadow.

    Attributes:
        view: index of its camera.
        light: (3,) place of the light, world.
        fan_deg: (H, W) float32 angle beyond the light, degrees, from which a place has to be free for it to be seen
            that nothing of the object is there: a surface that is turned to all of that angle would be brighter. inf
            where light may fall, something else than the object is seen, or an edge may have its other side lit.
        light_name: for reports.
    """

    view: int
    light: Array
    fan_deg: NDArray[np.float32]
    light_name: str = ""

    @property
    def dark(self) -> NDArray[np.bool_]:
        """(H, W) pixels that are in shadow from some fan on."""
        return np.isfinite(self.fan_deg)


class ShadowCarvingReport(Report):
    """What shadows took away.

    Attributes:
        num_pairs: photographs under a light that were used. num_too_far: left out, light and camera too far apart.
        sweeps: cells of the finest level taken away in each passage of all photographs, by coarse cells first.
        cells_before, cells_after: of the finest level.
        volume_before, volume_after: of these, cubic units of the world.
        volume_within: of those left that are wholly inside.
    """

    num_pairs: int
    num_too_far: int
    sweeps: Sequence[int]
    cells_before: int
    cells_after: int
    volume_before: float
    volume_after: float
    volume_within: float


def carve_shadows(
    tree: Octree, views: Sequence[View], shadows: Sequence[Shadow], options: ShadowOptions | None = None,
    events: Events | None = None, *, lights: Sequence[LampLight] = (), threads: int = 2,
) -> tuple[Octree, ShadowCarvingReport]:  # fmt: skip
    """Take cells away that cannot belong to the object, as the camera would see them lit.

    Args:
        tree: holds the object wholly, such as its hull; at most 512 cells on a side.
        views: cameras.
        shadows: what is dark in their photographs, in any order; nothing but the object throws shadows on it.
        lights: brightness of their photographs, one for each camera at most, for mixtures of lamps.
        options, events: as for every stage.
        threads: do not change the result.

    Returns:
        the smaller volume and its report.

    Raises:
        InputError: shadows or brightness of another size than their view, places or counts of lamps that do not fit,
            or the octree is too fine.
    """
    options = options or ShadowOptions()
    events = events or Events()
    _check(tree, views, shadows, lights)
    grid = grid_of(tree)
    by_view: dict[int, list[Shadow]] = {}
    used = [s for s in shadows if angle_deg(grid.middle, views[s.view], s.light) <= options.max_angle_deg]
    for shadow in used:
        by_view.setdefault(shadow.view, []).append(shadow)
    mixed = {light.view: light for light in (_within(each, views, grid.middle, options) for each in lights) if light}
    before, sweeps = int(np.count_nonzero(grid.filled)), list[int]()
    levels = range(min(_COARSEST, tree.depth), tree.depth + 1) if used or mixed else range(0)
    events.started("shadows", f"{len(used)} photographs under lights", len(levels) * len(by_view | mixed))
    left = before
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for level in levels:
            coarse = coarsened(grid, level)
            for view in sorted(by_view | mixed):
                _carve_by_view(coarse, views[view], by_view.get(view, []), mixed.get(view), options, pool)
                events.advanced("shadows", message=views[view].name)
            intersect(grid, coarse)
            sweeps.append(left - int(np.count_nonzero(grid.filled)))
            left -= sweeps[-1]
    carved = octree_of(grid) if left < before else tree
    report = ShadowCarvingReport(
        num_pairs=len(used), num_too_far=len(shadows) - len(used), sweeps=sweeps, cells_before=before, cells_after=left,
        volume_before=before * tree.cell**3, volume_after=left * tree.cell**3,
        volume_within=carved.volume_bounds()[0],
    )  # fmt: skip
    events.finished("shadows", f"{100.0 * (before - left) / max(before, 1):.1f} % of the hull taken away", **report)
    return carved, report


def _check(tree: Octree, views: Sequence[View], shadows: Sequence[Shadow], lights: Sequence[LampLight]) -> None:
    if tree.depth > MAX_DEPTH:
        raise InputError(
            f"shadows carve up to {2**MAX_DEPTH} cells on a side, the volume has {2**tree.depth}", "ask for fewer cells"
        )
    for shadow in shadows:
        view = _view_at(views, shadow.view)
        _check_shape(view, "the place of a light", (3,), shadow.light)
        _check_shape(
            view, f"a shadow of {view.width} x {view.height} pixels", (view.height, view.width), shadow.fan_deg
        )
    for light in lights:
        view, num = _view_at(views, light.view), len(light.lamps)
        _check_shape(view, f"places of {num} lamps", (num, 3), light.lamps)
        what = f"brightness of {view.width} x {view.height} pixels under {num} lamps"
        _check_shape(view, what, (num, view.height, view.width), light.most)
    for index, times in Counter(light.view for light in lights).items():
        if times > 1:
            raise InputError(f"{views[index].name}: expected its lamps once, found them {times} times")


def _view_at(views: Sequence[View], index: int) -> View:
    if not 0 <= index < len(views):
        raise InputError(f"expected photographs of {len(views)} cameras under lights, found one of camera {index}")
    return views[index]


def _check_shape(view: View, what: str, shape: tuple[int, ...], found: NDArray[np.generic]) -> None:
    if found.shape != shape:
        raise InputError(f"{view.name}: expected {what}, an array of shape {shape}, found shape {found.shape}")


def _within(light: LampLight, views: Sequence[View], middle: Array, options: ShadowOptions) -> LampLight | None:
    """The lamps that are not too far from the camera, as seen from a place; None where mixtures tell nothing: there are
    fewer than three, or each tells by itself (mixtures would raise 31.3 % of an error to 31.4)."""
    angles = np.array([angle_deg(middle, views[light.view], lamp) for lamp in light.lamps])
    near = angles <= options.max_angle_deg
    if np.count_nonzero(near) < 3 or angles[near].max() <= options.edge_deg:
        return None
    return LampLight(light.view, light.lamps[near], light.most[near])


def _counted(masks: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(N, H + 1, W + 1) how many pixels of masks (N, H, W) are above and to the left of the corners of pixels."""
    sums = np.zeros((len(masks), masks.shape[1] + 1, masks.shape[2] + 1), np.int32)
    sums[:, 1:, 1:] = masks.cumsum(axis=1, dtype=np.int32).cumsum(axis=2, dtype=np.int32)
    return sums


def _planes(grid: CellGrid, camera: Array, light: Array, fans_deg: Array) -> Planes:
    """Half planes about the line from a camera to a light, wide and fine enough for all cells of a window."""
    base = float(np.linalg.norm(light - camera))
    axis = (light - camera) / base
    # counted from the middle of the volume, so that angles do not jump
    first = grid.middle - camera
    first -= (first @ axis) * axis
    first /= np.linalg.norm(first)
    near, away = np.linalg.norm(grid.middle - camera), np.linalg.norm(grid.middle - light)
    at = np.arctan2((grid.middle - camera) @ first, (grid.middle - camera) @ axis)
    between = np.sin(np.arccos((camera - grid.middle) @ (light - grid.middle) / (near * away)))
    # a step at the light goes along a ray of the camera, which it crosses at that angle, by no more than the others
    step = _STEP * grid.tree.cell / np.array([near * np.sin(at), near, away / between])
    axes = np.stack([axis, first, np.cross(axis, first)])
    planes = Planes(camera, light, axes, base, np.zeros(3), step, np.zeros(3, np.int64), np.zeros(len(fans_deg)))
    low, high = _ranges(grid, planes)
    low, high = low - 2.0 * step, high + 2.0 * step
    # along a way to the light, in samples: what the fan opens while the angle at the camera goes on by one
    spread = np.tan(np.radians(fans_deg)) * near * step[1] / (between * away * step[2])
    return planes._replace(low=low, num=np.ceil((high - low) / step).astype(np.int64) + 1, spread=spread)


def _ranges(grid: CellGrid, planes: Planes) -> tuple[Array, Array]:
    """Least and largest angles (3,) on the faces of a window."""
    t = np.linspace(0.0, 1.0, 17)
    a, b = (side.ravel() for side in np.meshgrid(t, t))
    faces = [np.insert(np.stack([a, b], axis=1), axis, end, axis=1) for axis in range(3) for end in (0.0, 1.0)]
    angles = np.empty((6 * len(a), 3))
    angles_of_all(planes, grid.low + np.vstack(faces) * np.array(grid.filled.shape) * grid.tree.cell, angles)
    return angles.min(axis=0), angles.max(axis=0)


def _carve_by_view(
    grid: CellGrid, view: View, shadows: Sequence[Shadow], light: LampLight | None, options: ShadowOptions,
    pool: ThreadPoolExecutor,
) -> None:  # fmt: skip
    """Take away what the photographs of one camera vouch for, each by itself against the volume as it was before. What
    several volumes lack, the object lacks."""
    empty = np.zeros(grid.filled.shape, np.uint8)
    low, cell = grid.low, grid.tree.cell
    fans = options.fan_deg * np.array(_FANS)

    def hold(shadow: Shadow) -> tuple[Planes, NDArray[np.bool_], NDArray[np.int32]]:
        planes = _planes(grid, view.center, shadow.light, fans)
        dark = shadow.fan_deg <= fans[:, None, None]
        first = np.empty(planes.num[:2], np.int32)
        find_held(planes, view.row, _counted(~dark), options.margin_px, low, cell, grid.filled, first)
        return planes, dark[-1], first

    def take(begin: int) -> None:
        end = min(begin + _SLICES, len(grid.filled))
        num = int(np.count_nonzero(grid.filled[begin:end]))
        places, pixels = np.empty((num, 3), np.int32), np.empty((num, 2), np.int32)
        num = find_dark(view.row, is_dark, low, cell, grid.filled, begin, end, places, pixels)
        for planes, dark, first in held:
            take_free(planes, dark, low, cell, places[:num], pixels[:num], first, empty)

    def mix(light: LampLight) -> None:
        empty[tuple(proven_empty(grid, view, light).T)] = 1

    # all write the same number, in any order
    tasks = [pool.submit(mix, light)] if light is not None else []
    held = list(pool.map(hold, shadows))
    if held:
        is_dark = np.any([dark for _, dark, _ in held], axis=0)
        list(pool.map(take, range(0, len(grid.filled), _SLICES)))
    for task in tasks:
        task.result()
    grid.filled[empty == 1] = 0
