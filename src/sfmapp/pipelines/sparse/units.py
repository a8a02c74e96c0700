"""Metres and the vertical for models that no position and no survey places: from known lengths, and from markers, the
ground, or the roll of photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.graph import FactorGraph
from sfmapp.events import Events
from sfmapp.formats.control_points import LOCAL, ControlPoints
from sfmapp.geometry import rigid3, similarity
from sfmapp.georeference.control.marks import check_marks
from sfmapp.georeference.control.report import LeveledModel, ScaledModel, UnitsReport
from sfmapp.georeference.control.scale_bars import ScaleBar, scale_by_bars
from sfmapp.georeference.leveling import Up, level_rotation, up_of_ground, up_of_markers, up_of_photographs
from sfmapp.images.pixels import read_gray
from sfmapp.odometry.inertial.markers import MarkerDetector, MarkerSightings, scale_from_markers
from sfmapp.odometry.inertial.scale import ScaleRefusal
from sfmapp.pipelines.sparse.known_lengths import KnownLength

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.mapping.mapper import Mapper
    from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
# corners (4, 3) of markers by id, and their variances (4, 3, 3)
Corners: TypeAlias = tuple[dict[int, Array], dict[int, Array]]
STAGE = "units"
# Of a corner of a marker that a detector has refined.
_CORNER_PX = 0.3
# All corners of blurred squares are found too far inside by about this much (drawn ones: 0.14 px at a side of 50
# pixels, 0.09 at 200), which no mean over pictures takes away. The middle of a marker does not feel it.
_INWARD_PX = 0.12
# A known length and a model that is in metres already differ by less than this many sigmas.
_AGREES = 3.0


# ------------------------------------------------------------------------------------------------------------- markers


def find_markers(image_set: ImageSet, known: Sequence[KnownLength], threads: int) -> dict[str, MarkerSightings]:
    """Markers of all dictionaries that known lengths name, in all images."""
    out = {}
    for dictionary in sorted({one.dictionary for one in known if one.dictionary is not None}):

        def detect(n: int, dictionary: str = dictionary) -> tuple[NDArray[np.int64], Array]:
            return MarkerDetector(dictionary).detect(read_gray(image_set.images[n]))

        with ThreadPoolExecutor(threads) as pool:
            found = list(pool.map(detect, range(len(image_set.images))))
        image = np.repeat(np.arange(len(found)), [len(ids) for ids, _ in found])
        out[dictionary] = MarkerSightings(
            image, np.concatenate([ids for ids, _ in found]), np.concatenate([corners for _, corners in found])
        )
    return out


def marker_corners(model: Reconstruction, sightings: MarkerSightings) -> Corners:
    """Corners (4, 3) of markers by id, and variances (4, 3, 3) of these with the cameras held, of those whose corners
    two photographs or more agree on."""
    pairs, count = np.unique(np.stack([sightings.image_idx, sightings.marker_id], 1), axis=0, return_counts=True)
    once = {tuple(pair) for pair in pairs[count == 1].tolist()}  # one id twice in a picture is none
    rows = [
        (marker, corner, image, sightings.corners[n, corner])
        for n, (image, marker) in enumerate(
            zip(sightings.image_idx.tolist(), sightings.marker_id.tolist(), strict=True)
        )
        if (image, marker) in once
        for corner in range(4)
    ]
    rows.sort(key=lambda row: row[:3])
    keys = sorted({row[:2] for row in rows})
    number = {key: n for n, key in enumerate(keys)}
    control = ControlPoints(
        path=Path("markers"), crs_line=0, crs=LOCAL, names=tuple(f"{marker}/{corner}" for marker, corner in keys),
        xyz=np.zeros((len(keys), 3)), sigma_m=np.ones((len(keys), 3)),
        obs_point_idx=np.array([number[row[:2]] for row in rows], np.int64),
        obs_image_idx=np.array([row[2] for row in rows], np.int64),
        obs_xy=np.array([row[3] for row in rows], np.float64).reshape(-1, 2),
        obs_sigma_px=np.full(len(rows), _CORNER_PX), obs_line=np.zeros(len(rows), np.int64),
    )  # fmt: skip
    marked = check_marks(model, control)
    whole = [m for m in sorted({key[0] for key in keys}) if all(marked.is_placed[number[m, c]] for c in range(4))]
    places = {m: marked.place[[number[m, c] for c in range(4)]] for m in whole}
    return places, {m: marked.covariance[[number[m, c] for c in range(4)]] for m in whole}


# ----------------------------------------------------------------------------------------------------------- measuring


def _measured(
    mapper: Mapper, known: KnownLength, seen: dict[str, MarkerSightings], corners: Callable[[str], Corners]
) -> ScaleBar | str:
    """A known length in a model, or why it cannot be had; ``corners``: of the markers of a dictionary in it."""
    model = mapper.reconstruction
    if known.images is not None:
        return _between_images(mapper, known)
    assert known.dictionary is not None
    sightings = seen[known.dictionary]
    metres, sigma_m = known.length.metres, known.length.sigma_m
    if known.ids is None:
        found = scale_from_markers(model, sightings, known.length)
        if isinstance(found, ScaleRefusal):
            return f"{known.text}: {found.reason}"
        length = metres / found.scale
        share2 = max(found.sigma_relative**2 - (sigma_m / metres) ** 2, 0.0)
        sides = np.linalg.norm(np.diff(sightings.corners, axis=1, append=sightings.corners[:, :1]), axis=2)
        share = np.hypot(np.sqrt(share2), 2.0 * _INWARD_PX / float(np.median(sides)))
        return ScaleBar(known.text, metres, sigma_m, length, float(share) * length)
    places, variances = corners(known.dictionary)
    missing = [m for m in known.ids if m not in places]
    if missing:
        return f"{known.text}: marker {missing[0]} was not measured from two photographs that agree"
    a, b = known.ids
    line = places[b].mean(0) - places[a].mean(0)
    length = float(np.linalg.norm(line))
    variance = (variances[a].sum(0) + variances[b].sum(0)) / 16.0
    return ScaleBar(known.text, metres, sigma_m, length, float(np.sqrt(line @ variance @ line)) / length)


def _between_images(mapper: Mapper, known: KnownLength) -> ScaleBar | str:
    model, images = mapper.reconstruction, known.images
    assert images is not None
    a, b = images
    for i in images:
        if not model.is_registered[i]:
            return f"{known.text}: {model.image_names[i]} is not in the model"
    line = model.centers[b] - model.centers[a]
    length = float(np.linalg.norm(line))
    if not length > 1e-9 * rigid3.spread(model.cam_from_world[model.is_registered]):
        return f"{known.text}: both were taken from one place"
    options, varying, noise = mapper.closing_options()
    graph = FactorGraph(model, options, varying=varying, prior_cameras=mapper.prior_cameras, noise_px=noise.sigma_px)
    joint = graph.marginal_covariance(images=[a, b])
    moves = rigid3.center_jacobian(model.cam_from_world[[a, b]])
    slope = np.concatenate([-moves[0].T @ line, moves[1].T @ line]) / length
    return ScaleBar(
        known.text, known.length.metres, known.length.sigma_m, length, float(np.sqrt(slope @ joint.matrix @ slope))
    )


def _up(
    model: Reconstruction, wanted: str, orientation: list[int], seen: Iterable[str], corners: Callable[[str], Corners]
) -> tuple[Up, float]:
    """Up by what is wanted, and the angle to what photographs say."""
    held = up_of_photographs(model, orientation)
    tried = {"exif": ["exif"], "plane": ["plane"], "markers": ["markers"]}.get(wanted, ["markers", "plane", "exif"])
    found = held
    for kind in tried:
        if kind == "exif":
            # who asks for it by name knows that they were held upright
            found = replace(held, problem="") if wanted == "exif" else held
        elif kind == "plane":
            found = up_of_ground(model, held)
        else:
            places = [place for dictionary in seen for place in corners(dictionary)[0].values()]
            found = up_of_markers(np.array(places).reshape(-1, 4, 3))
        if not found.problem:
            break
    return found, float(np.degrees(np.arccos(np.clip(found.direction @ held.direction, -1.0, 1.0))))


# -------------------------------------------------------------------------------------------------------- what is done


def give_units(
    mappers: Sequence[Mapper],
    image_set: ImageSet,
    known: Sequence[KnownLength],
    up: str,
    placed: set[int],
    *,
    threads: int,
    events: Events,
) -> UnitsReport:
    """Scale and turn models, in place, that nothing else places; hold the others against known lengths.

    Args:
        up: as of :class:`~sfmapp.georeference.unit_options.UnitOptions`.
        placed: numbers of models that are in metres, z up, already.
    """
    seen = find_markers(image_set, known, threads)
    orientation = [record.orientation for record in image_set.images]
    scales: list[ScaledModel] = []
    levels: list[LeveledModel] = []
    for number, mapper in enumerate(mappers):
        model = mapper.reconstruction
        scale, rotation = 1.0, np.eye(3)

        @cache
        def corners(dictionary: str, model: Reconstruction = model) -> Corners:
            return marker_corners(model, seen[dictionary])

        if known:
            found = [_measured(mapper, one, seen, corners) for one in known]
            bars = [one for one in found if isinstance(one, ScaleBar)]
            row = scale_by_bars(number, bars, [one for one in found if isinstance(one, str)])
            row = _compared(row) if number in placed else row
            scale = 1.0 if number in placed or row.metres_per_unit is None else row.metres_per_unit
            scales.append(row)
        if up != "none" and number not in placed:
            direction, angle = _up(model, up, orientation, seen, corners)
            rotation = np.eye(3) if direction.problem else level_rotation(direction.direction)
            levels.append(_level_row(number, direction, angle))
        moved = similarity.from_parts(rotation, np.zeros(3), scale)
        model.cam_from_world[:] = similarity.transform_poses(moved, model.cam_from_world)
        model.point_xyz[:] = similarity.apply(moved, model.point_xyz)
    _tell(scales, levels, placed, events)
    return UnitsReport(scales=scales, levels=levels)


def _compared(row: ScaledModel) -> ScaledModel:
    """Of a model that is in metres already: what known lengths say of these."""
    if row.metres_per_unit is None or row.sigma_share is None:
        return row
    off = row.metres_per_unit - 1.0
    findings = list(row.findings)
    if abs(off) > _AGREES * row.sigma_share:
        findings.append(
            f"known lengths say that the model's metres are {100 * off:+.2g} % off, within "
            f"{100 * row.sigma_share:.2g} %: they contradict what placed it, and were not followed"
        )
    return ScaledModel(**{**row, "findings": findings})


def _level_row(number: int, up: Up, angle_deg: float) -> LeveledModel:
    if up.problem:
        return LeveledModel(model=number, source=up.source, reason=up.problem)
    return LeveledModel(
        model=number, source=up.source, reason="", sigma_deg=float(np.degrees(up.sigma_rad)),
        from_photographs_deg=angle_deg,
    )  # fmt: skip


def _tell(scales: Sequence[ScaledModel], levels: Sequence[LeveledModel], placed: set[int], events: Events) -> None:
    for row in scales:
        for finding in row.findings:
            events.warned(STAGE, finding)
        if row.metres_per_unit is not None and row.model not in placed:
            assert row.sigma_share is not None
            events.decided(STAGE, f"model {row.model} is in metres, to {100 * row.sigma_share:.2g} %", **row)
    for level in levels:
        text = f"model {level.model} is level by {level.source}" if not level.reason else level.reason
        events.decided(STAGE, text, **level)
