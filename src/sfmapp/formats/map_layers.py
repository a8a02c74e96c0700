"""Places on a map for QGIS and Google Earth: GeoJSON (RFC 7946, 2016) and KML 2.2 (OGC 07-147r2, 2008).

Both have longitude and latitude on WGS84, in degrees, and heights in metres; KML's are meant above the sea.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.text_input import read_json_object

Array = NDArray[np.float64]

# Decimals of degrees and metres: a tenth of a millimetre.
_DEGREES, _METRES = 9, 4
_KML = "http://www.opengis.net/kml/2.2"


@dataclass(frozen=True)
class Placemarks:
    """Named places (N): geodetic (N, 3) latitude, longitude, height, and numbers or text of each."""

    names: Sequence[str]
    geodetic: Array
    properties: Sequence[Mapping[str, float | str]]


def write_geojson(path: str | Path, places: Placemarks) -> None:
    """Write points with their properties. Raises InputError if it cannot be written."""
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": _coordinates(place)},
            "properties": {"name": name, **own},
        }
        for name, place, own in zip(places.names, places.geodetic, places.properties, strict=True)
    ]
    lines = ",\n  ".join(json.dumps(feature, allow_nan=False) for feature in features)
    with replaced_file(Path(path)) as beside:
        beside.write_text(f'{{"type": "FeatureCollection", "features": [\n  {lines}\n]}}\n', encoding="utf-8")


def read_geojson(path: str | Path) -> Placemarks:
    """Read points that have a name. Raises InputError for anything else."""
    path = Path(path)
    document = read_json_object(path)
    try:
        features = document["features"]
        coordinates = np.array([feature["geometry"]["coordinates"] for feature in features], np.float64).reshape(-1, 3)
        properties = [dict(feature["properties"]) for feature in features]
        names = [str(own.pop("name")) for own in properties]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a FeatureCollection of named points, found none: {error!r}") from None
    return Placemarks(names, coordinates[:, [1, 0, 2]], properties)


def write_kml(path: str | Path, places: Placemarks, title: str) -> None:
    """Write points; their properties become their descriptions. Raises InputError if it cannot be written."""
    ElementTree.register_namespace("", _KML)
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = ElementTree.SubElement(root, f"{{{_KML}}}Document")
    _text(document, "name", title)
    for name, place, own in zip(places.names, places.geodetic, places.properties, strict=True):
        mark = ElementTree.SubElement(document, f"{{{_KML}}}Placemark")
        _text(mark, "name", name)
        _text(mark, "description", ", ".join(f"{key} {value}" for key, value in own.items()))
        point = ElementTree.SubElement(mark, f"{{{_KML}}}Point")
        _text(point, "altitudeMode", "absolute")
        _text(point, "coordinates", ",".join(map(repr, _coordinates(place))))
    with replaced_file(Path(path)) as beside:
        ElementTree.ElementTree(root).write(beside, encoding="utf-8", xml_declaration=True)


def read_kml(path: str | Path) -> Placemarks:
    """Read the points of a KML that :func:`write_kml` has written. Raises InputError for anything else."""
    try:
        marks = ElementTree.parse(path).getroot().findall(f".//{{{_KML}}}Placemark")
        rows = [(_found(mark, "name"), _found(mark, "Point/{}coordinates")) for mark in marks]
        coordinates = np.array([text.split(",") for _, text in rows], np.float64).reshape(-1, 3)
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: expected KML with points, found other: {error}") from None
    return Placemarks([name for name, _ in rows], coordinates[:, [1, 0, 2]], [{} for _ in rows])


def _coordinates(geodetic: Array) -> list[float]:
    latitude, longitude, height = map(float, geodetic)
    return [round(longitude, _DEGREES), round(latitude, _DEGREES), round(height, _METRES)]


def _text(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(parent, f"{{{_KML}}}{tag}").text = text


def _found(parent: ElementTree.Element, tag: str) -> str:
    space = f"{{{_KML}}}"
    text = parent.findtext(space + tag.replace("{}", space))
    if text is None:
        raise ValueError(f"no {tag} in a placemark")
    return text
