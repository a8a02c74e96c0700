"""A volume made smaller by photographs under single lights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.cell_grid import depth_under, grid_of
from sfmapp.carve.lamp_mixtures import LampLight
from sfmapp.carve.octree import Octree
from sfmapp.carve.shadow_carving import Shadow, ShadowOptions, carve_shadows
from sfmapp.carve.shadows import LitPhotograph, doubts_of, find_shadows
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.errors import InputError
from sfmapp.evaluation.poses import match_names
from sfmapp.events import Events
from sfmapp.formats.lights_file import Light, read_lights
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageOptions, ImageRecord
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.report.carve_document import ShadowsReport

Array = NDArray[np.float64]
# pixels inside the outline from which all of a pixel shows the object
_WHOLE_PX = 1.0


def carve_by_lights(
    path: Path, source: CarveSource, silhouettes: Sequence[Silhouette], octree: Octree, events: Events,
    threads: int | None,
) -> tuple[Octree, ShadowsReport, Callable[[Array], Array]]:  # fmt: skip
    """Take away what the shadows of single lights show not to be there.

    Args:
        path: the file of lights, see :mod:`sfmapp.formats.lights_file`.
        source, silhouettes, octree: the photographs that were carved by, and what they left.

    Returns:
        The smaller volume, what was found, and the distance (N,) of points (N, 3) inside the hull to what was taken
        away, negative in it.

    Raises:
        InputError: a light without photographs of these cameras, photographs of another size, or a volume too fine.
    """
    file = read_lights(path)
    lights = file.lights
    grid = grid_of(octree)
    lit = list(source.records) if file.lit is None else _photographs(file.lit, source, events, threads)
    under = [_photographs(light.photographs, source, events, threads) for light in lights]
    chosen = [v for v in range(len(source.views)) if lit[v] is not None and all(row[v] is not None for row in under)]
    if not chosen:
        raise InputError(
            f"{path}: expected photographs of one camera at least under every light, found none",
            "name them as the photographs that are carved",
        )
    if len(chosen) < len(source.views):
        events.warned("shadows", f"{len(source.views) - len(chosen)} photographs lack a companion under some light")
    photographs, places = [], []
    for v in chosen:
        view, silhouette = source.views[v], silhouettes[v]
        inside = silhouette.distance > _WHOLE_PX
        if silhouette.known is not None:
            inside &= silhouette.known
        at = [_place(light, view.outer) for light in lights]
        pictures = [_read(record, view.width, view.height) for record in (lit[v], *(row[v] for row in under))]
        photographs.append(LitPhotograph(pictures[0], pictures[1:], inside, view, at, octree))
        places.append(at)
    options = ShadowOptions() if file.sharpest_edge_deg is None else ShadowOptions(edge_deg=file.sharpest_edge_deg)
    fans, brightness, lamps = find_shadows(
        photographs, [light.name for light in lights], fan_deg=options.fan_deg, edge_deg=options.edge_deg
    )
    for doubt in doubts_of(lamps):
        events.warned("shadows", doubt)
    shadows = [
        Shadow(v, places[n][k], fan, lights[k].name) for n, v in enumerate(chosen) for k, fan in enumerate(fans[n])
    ]
    mixed = [LampLight(v, np.array(places[n]), brightness[n]) for n, v in enumerate(chosen)]
    carved, report = carve_shadows(
        octree, source.views, shadows, options, events, lights=mixed, threads=threads or 2
    )  # fmt: skip
    if report.num_too_far:
        events.warned(
            "shadows",
            f"{report.num_too_far} photographs were left out: their light is more than {options.max_angle_deg:g} "
            "degrees from the camera, seen from the object",
        )
    return carved, ShadowsReport(carving=report, lights=lamps), depth_under(grid, grid_of(carved))


def _photographs(folder: Path, source: CarveSource, events: Events, threads: int | None) -> list[ImageRecord | None]:
    """Those of a folder that are named as the photographs of a source, in their order."""
    records = load_images(folder, ImageOptions(), events, threads=threads)[0].images
    index = match_names([record.name for record in records], [record.name for record in source.records])
    return [records[i] if i >= 0 else None for i in index]


def _place(light: Light, outer: Array) -> Array:
    """(3,) of a light in the world, beside a camera of a 3x4 matrix."""
    if not light.is_with_camera:
        return light.position
    return np.asarray(np.linalg.solve(outer[:, :3], light.position - outer[:, 3]))


def _read(record: ImageRecord | None, width: int, height: int) -> NDArray[np.uint8]:
    assert record is not None
    picture = read_rgb(record)
    if picture.shape[:2] != (height, width):
        raise InputError(
            f"{record.path}: expected {width} x {height} pixels as the camera's photograph has, found "
            f"{picture.shape[1]} x {picture.shape[0]}"
        )
    return picture
