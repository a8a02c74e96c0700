"""Pairs of photographs out of a reconstruction: two that are named, or those that stereo has most of."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from sfmapp.dense.photographs import Photographs, find_photographs
from sfmapp.dense.prepare import points_of_views
from sfmapp.dense.selection import weigh_common_points
from sfmapp.errors import InputError
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.images.pixels import read_rgb
from sfmapp.images.sources import position_of_name
from sfmapp.pipelines.dense.source import find_source, is_of_model
from sfmapp.pipelines.metres import metre_sigma_of_run
from sfmapp.pipelines.stereo.sources import PairSource
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig
from sfmapp.stereo.prepare import PairCameras
from sfmapp.stereo.rectification import plan_rectification
from sfmapp.workspace.layout import STEREO
from sfmapp.workspace.options import Options

__all__ = ["is_of_model", "pairs_of_model"]

# under fewer degrees depths are poor, under more the two photographs look too different to be matched (Furukawa and
# Hernandez, "Multi-view stereo: a tutorial", 2015, 2.3)
_GOOD_DEG = (3.0, 15.0)
# points that two photographs share before they are a pair at all, and pairs that are rectified to see what is kept
_LEAST_SHARED, _LOOKED_AT = 20, 4


def pairs_of_model(
    source: str | os.PathLike[str], names: tuple[str, str] | None, best: int, options: Options
) -> list[PairSource]:
    """Pairs of a workspace or of a COLMAP model, with the cameras that it has.

    Args:
        names: of two images, or the ends of their names; None: the best pairs.
        best: how many of these.

    Raises:
        UsageError, InputError: no model, or none of its photographs; images that it does not have; no pair of
            photographs that can be rectified.
    """
    where = find_source(source, None, None, options, STEREO)
    model, _ = read_model(where.model)
    found = find_photographs(
        model, where.images, options.images, is_upright=where.is_upright, threads=options.num_workers
    )
    if names is not None:
        every = [record.name for record in found.records]
        whose = f"with a pose of {os.fspath(source)}"
        chosen = [(position_of_name(names[0], every, whose), position_of_name(names[1], every, whose))]
        if chosen[0][0] == chosen[0][1]:
            raise InputError(f"{names[0]} and {names[1]} are one image of {source}", "name two")
    else:
        chosen = best_pairs(model, found)[:best]
        if not chosen:
            raise InputError(
                f"{source}: expected two photographs side by side that show the same, found no such pair",
                "name two with --pair, or take photographs side by side",
            )
    sigma = metre_sigma_of_run(where.output)
    return [_source(model, found, pair, sigma) for pair in chosen]


def best_pairs(model: Reconstruction, photographs: Photographs) -> list[tuple[int, int]]:
    """Positions of photographs, the pair that stereo has most of first: by the points that both show, the angles under
    which they are seen, and the share of both that is kept when they are rectified."""
    images = photographs.image_idx
    focal = np.array([camera.focal for camera in photographs.cameras])
    common = weigh_common_points(focal, model.cam_from_world[images], *points_of_views(model, images), _GOOD_DEG)
    pairs = np.argwhere(np.triu(common.shared >= _LEAST_SHARED, 1))
    scores = common.score[pairs[:, 0], pairs[:, 1]]
    found = []
    for k in np.argsort(-scores, kind="stable")[: _LOOKED_AT * len(images)]:
        i, j = pairs[k].tolist()
        try:
            kept = min(plan_rectification(_rig(model, photographs, (i, j), leftmost=True)).kept)
        except InputError:
            continue  # one in front of the other
        found.append((float(scores[k]) * kept, i, j))
    return [(i, j) for _, i, j in sorted(found, reverse=True)]


def _rig(model: Reconstruction, photographs: Photographs, pair: tuple[int, int], *, leftmost: bool = False) -> Rig:
    """The two cameras as the model has them; with ``leftmost`` the one that stands to the left first."""
    poses = [model.cam_from_world[photographs.image_idx[one]] for one in pair]
    second = rigid3.compose(poses[1], rigid3.inverse(poses[0]))
    if leftmost and rigid3.center(second)[0] < 0.0:
        return _rig(model, photographs, pair[::-1])
    return Rig(tuple(photographs.cameras[one] for one in pair), np.array([rigid3.IDENTITY, second]))


def _source(
    model: Reconstruction, photographs: Photographs, pair: tuple[int, int], metre_sigma: float | None
) -> PairSource:
    records = [photographs.records[one] for one in pair]
    rig = _rig(model, photographs, pair)
    stems = [Path(record.name).stem for record in records]
    return PairSource(
        "--".join(stems), records[0].name, records[1].name,
        lambda: (read_rgb(records[0]), read_rgb(records[1])),
        lambda: PairCameras(
            rig, text="of the reconstruction", unit="" if metre_sigma is None else "m",
            length_sigma=metre_sigma or 0.0, is_adjusted=True,
        ),
        {record.name: record.digest for record in records},
    )  # fmt: skip
