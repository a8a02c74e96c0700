"""Where a run's models lie in the world: ``georeference.json`` in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.text_input import read_json_object
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.coordinate_systems import HeightReference
from sfmapp.reporting import Report, document_text, from_plain

GEOREFERENCE = "georeference.json"
FORMAT = "sfmapp georeference 1"
_LARGEST_BYTES = 2**24


class ModelPlace(Report):
    """How a model was brought into the world frame, ``x_world = scale R x + translation``, and how sure that is.

    Attributes:
        model: its number: it lies in ``sparse/NUMBER``.
        source: what it was placed by.
        scale: metres per unit of the model as photographs alone gave it.
        rotation: of the same, a unit quaternion x y z w; translation_m: (3,).
        scale_sigma_share: standard deviation of the scale, as a share of it.
        rotation_sigma_deg: (3,) about east, north and up.
        position_sigma_m: (3,) of the mean of the photographs' places, east, north and up.
        common_offset_sigma_m: (3,) of what all positions may be off together, which no residual can show; it is not in
            the others.
    """

    model: int
    source: Literal["gps", "control points", "known poses"]
    scale: float
    rotation: tuple[float, float, float, float]
    translation_m: tuple[float, float, float]
    scale_sigma_share: float
    rotation_sigma_deg: tuple[float, float, float]
    position_sigma_m: tuple[float, float, float]
    common_offset_sigma_m: tuple[float, float, float]


class Georeference(Report):
    """The world frame of a run: metres, x east, y north, z up, about an origin on WGS84.

    Attributes:
        format: of the file.
        latitude_deg, longitude_deg, height_m: the origin.
        axes: of the frame.
        crs: what the origin is in.
        heights: what heights are above, as their source gave them: ``ellipsoidal`` as :attr:`crs` has it,
            ``orthometric`` above a geoid (sea level), or ``unknown``. Geoid and ellipsoid are up to a hundred metres
            apart; nothing else depends on it.
        models: those that lie in the frame. Others are in arbitrary units.
    """

    format: str
    latitude_deg: float
    longitude_deg: float
    height_m: float
    axes: Literal["east north up"]
    crs: Literal["EPSG:4979"]
    heights: HeightReference
    models: Sequence[ModelPlace]

    @property
    def frame(self) -> LocalFrame:
        """The frame, to convert by."""
        return LocalFrame(self.latitude_deg, self.longitude_deg, self.height_m)

    def place_of(self, model: int) -> ModelPlace | None:
        """How a model lies in the frame; None if it does not."""
        return next((place for place in self.models if place.model == model), None)

    @classmethod
    def about(cls, frame: LocalFrame, heights: HeightReference, models: Sequence[ModelPlace]) -> Georeference:
        """Of a frame, and of models that lie in it."""
        return cls(
            format=FORMAT,
            latitude_deg=frame.latitude_deg,
            longitude_deg=frame.longitude_deg,
            height_m=frame.height_m,
            axes="east north up",
            crs="EPSG:4979",
            heights=heights,
            models=list(models),
        )


def write_georeference(folder: Path, georeference: Georeference) -> None:
    """Write ``georeference.json`` into a folder. Raises InputError if it cannot be written."""
    with replaced_file(folder / GEOREFERENCE) as beside:
        beside.write_text(document_text(georeference), encoding="utf-8")


def read_georeference(folder: Path) -> Georeference | None:
    """``georeference.json`` of a folder; None if there is none.

    Raises:
        InputError: it is damaged, or holds what cannot be.
    """
    path = folder / GEOREFERENCE
    if not path.exists():
        return None
    advice = "run sfmapp reconstruct again; it writes the file anew"
    try:
        found = from_plain(Georeference, read_json_object(path, _LARGEST_BYTES))
    except ValueError as error:
        raise InputError(f"{path}: {error}", advice) from None
    fault = _fault(found)
    if fault:
        raise InputError(f"{path}: {fault}", advice)
    return found


def _fault(found: Georeference) -> str:
    """What cannot be about a georeference; empty if nothing."""
    if found.format != FORMAT:
        return f"expected format {FORMAT!r}, found {found.format!r}"
    if not (abs(found.latitude_deg) <= 90 and abs(found.longitude_deg) <= 180):
        return f"expected an origin on Earth, found {found.latitude_deg:g}, {found.longitude_deg:g}"
    numbers = [place.model for place in found.models]
    if len(set(numbers)) < len(numbers) or min(numbers, default=0) < 0:
        return f"expected every model once, found {numbers}"
    for place in found.models:
        if not place.scale > 0:
            return f"model {place.model}: expected a positive scale, found {place.scale:g}"
        if abs(float(np.linalg.norm(place.rotation)) - 1.0) > 1e-6:
            return f"model {place.model}: expected a unit quaternion, found {place.rotation}"
        sigmas = [place.scale_sigma_share, *place.rotation_sigma_deg, *place.position_sigma_m]
        if not min(sigmas) > 0:
            return f"model {place.model}: expected sigmas above zero, found {min(sigmas):g}"
        if not min(place.common_offset_sigma_m) >= 0:
            return f"model {place.model}: expected a common offset with sigmas of zero or more"
    return ""
