"""Calibration files of all forms, read into fields with the names that JSON has for them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from sfmapp.camera.camera import Camera
from sfmapp.camera.names import MODEL_NAMES
from sfmapp.camera_files.fields import Fields, is_of_camera
from sfmapp.errors import InputError
from sfmapp.formats.colmap_binary import read_binary_cameras, read_binary_images
from sfmapp.formats.colmap_text import read_text_images
from sfmapp.formats.flat_yaml import parse_flat_yaml
from sfmapp.formats.middlebury_calibration import is_middlebury, middlebury_fields
from sfmapp.formats.nerfstudio import read_nerfstudio_cameras
from sfmapp.formats.text_input import read_json_object, read_limited_text

_LARGEST_BYTES = 1 << 22
_LARGEST_LIST_BYTES = 1 << 26
# where a folder holds the cameras of a COLMAP model, and of other things
_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0")
_LISTS = ("transforms.json", "cameras.json")


def read_fields(path: Path) -> Fields:
    """The fields of a calibration file, under the names that JSON has for them.

    Files that list cameras, with the images that each took or without (COLMAP's, ``cameras.json``, nerfstudio's
    ``transforms.json``), give ``cameras``: a list of such fields, in which ``files`` names the images. A folder is
    looked into for one of these, and for EuRoC's ``cam0/sensor.yaml``.

    Raises:
        InputError: it cannot be read, or has no form that is known.
    """
    if path.is_dir():
        return _fields_in_folder(path)
    if path.suffix.lower() == ".bin":
        return {"cameras": _colmap_binary_cameras(path)}
    if path.suffix.lower() == ".json":
        fields = read_json_object(path, _LARGEST_LIST_BYTES)
        if isinstance(fields.get("frames"), list):
            return {"cameras": _nerfstudio_cameras(path)}
        return {"cameras": _listed_cameras(str(path), fields)} if isinstance(fields.get("cameras"), list) else fields
    text = read_limited_text(path, _LARGEST_BYTES)
    if text.lstrip().startswith("<"):
        return _fields_of_xml(str(path), text)
    if is_middlebury(text):
        return middlebury_fields(str(path), text)
    rows = [
        line.split() for line in text.replace(",", " ").splitlines() if line.strip() and line.lstrip()[0] not in "#%"
    ]
    if rows and len(rows[0]) >= 4 and rows[0][1] in MODEL_NAMES:
        return {"cameras": _colmap_text_cameras(path, rows)}
    if rows and all(re.fullmatch(r"[-+.\deE]+", field) for row in rows for field in row):
        return _fields_of_numbers(str(path), [field for row in rows for field in row])
    return parse_flat_yaml(text, str(path))


def _fields_in_folder(folder: Path) -> Fields:
    for inside in _MODEL_FOLDERS:
        for name in ("cameras.bin", "cameras.txt"):
            if (folder / inside / name).is_file():
                return read_fields(folder / inside / name)
    for name in _LISTS:
        if (folder / name).is_file():
            return read_fields(folder / name)
    sensors = sorted([*folder.glob("cam[0-9]/sensor.yaml"), *folder.glob("mav0/cam[0-9]/sensor.yaml")])
    if sensors:
        return {sensor.parent.name: read_fields(sensor) for sensor in sensors}
    raise InputError(
        f"{folder}: expected a folder with the cameras of a COLMAP model, {', '.join(_LISTS)} or cam0/sensor.yaml, "
        "found none of them",
        "name the calibration file itself",
    )


def _colmap_text_cameras(path: Path, rows: list[list[str]]) -> list[Fields]:
    cameras: dict[str, Fields] = {}
    for row in rows:
        try:
            width, height, params = int(row[2]), int(row[3]), [float(field) for field in row[4:]]
        except (ValueError, IndexError):
            raise InputError(
                f"{path}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {' '.join(row)[:80]}"
            ) from None
        cameras[row[0]] = {"id": row[0], "model": row[1], "width": width, "height": height, "params": params}
    if len(cameras) > 1 and (path.parent / "images.txt").is_file():
        images = read_text_images(path.parent)
        _add_files(path, cameras, images.camera_ids.tolist(), images.names)
    return list(cameras.values())


def _colmap_binary_cameras(path: Path) -> list[Fields]:
    images = read_binary_images(path.parent) if (path.parent / "images.bin").is_file() else None
    ids, cameras = read_binary_cameras(path.parent)
    if not cameras:
        raise InputError(f"{path}: expected a camera, found none")
    found = {str(i): {"id": str(i), **_colmap_fields(camera)} for i, camera in zip(ids, cameras, strict=True)}
    if images is not None:
        _add_files(path, found, images.camera_ids.tolist(), images.names)
    return list(found.values())


def _add_files(path: Path, cameras: dict[str, Fields], camera_ids: list[int], names: list[str]) -> None:
    for camera_id, name in zip(camera_ids, names, strict=True):
        if str(camera_id) not in cameras:
            raise InputError(f"{path}: expected camera {camera_id} of image {name!r}, found none")
        cameras[str(camera_id)].setdefault("files", []).append(name)


def _colmap_fields(camera: Camera) -> Fields:
    return {
        "model": camera.model.name, "width": camera.width, "height": camera.height, "params": camera.params.tolist(),
    }  # fmt: skip


def _nerfstudio_cameras(path: Path) -> list[Fields]:
    names, cameras = read_nerfstudio_cameras(path)
    return _joined([_colmap_fields(camera) for camera in cameras], names)


def _listed_cameras(place: str, fields: Fields) -> list[Fields]:
    """The entries of ``cameras.json``: a camera for each image, or one for several; what is said once is of all."""
    shared = {name: value for name, value in fields.items() if name != "cameras"}
    entries = [{**shared, **entry} for entry in fields["cameras"] if isinstance(entry, dict)]
    if not entries or len(entries) < len(fields["cameras"]):
        raise InputError(f"{place}: expected a list of objects under cameras, found {str(fields['cameras'])[:80]}")
    names = [entry["file"] if isinstance(entry.get("file"), str) else "" for entry in entries]
    return _joined([{name: entry[name] for name in entry if is_of_camera(name)} for entry in entries], names)


def _joined(entries: list[Fields], names: list[str]) -> list[Fields]:
    """Equal cameras once, with the names of all their images."""
    found: dict[str, Fields] = {}
    for entry, name in zip(entries, names, strict=True):
        one = found.setdefault(json.dumps(entry, sort_keys=True), dict(entry))
        if name:
            one.setdefault("files", []).append(name)
    return list(found.values())


def _fields_of_numbers(place: str, fields: list[str]) -> Fields:
    try:
        values = [float(field) for field in fields]
    except ValueError:
        values = []
    if len(values) == 9 and values[6:] == [0, 0, 1]:
        values = [values[0], values[4], values[2], values[5]]
    if len(values) not in (4, 8, 9):
        raise InputError(
            f"{place}: expected fx fy cx cy, with k1 k2 p1 p2 and k3 or without, or a 3 x 3 matrix, found "
            f"{len(fields)} numbers"
        )
    return {"intrinsics": values[:4], "distortion_coefficients": values[4:]}


def _fields_of_xml(place: str, text: str) -> dict[str, Any]:
    """The nested elements of an XML file as objects. Entities, which can grow without bound, are refused."""
    from xml.etree import ElementTree

    if "<!" in re.sub("<!--.*?-->", "", text, flags=re.DOTALL):
        raise InputError(f"{place}: expected XML without document types and entities")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{place}: expected XML: {error}") from None

    def fields_of(element: ElementTree.Element, depth: int) -> Any:
        if depth > 10:
            raise InputError(f"{place}: expected no more than 10 levels of XML")
        if len(element):
            return {child.tag: fields_of(child, depth + 1) for child in element}
        content = (element.text or "").strip()
        try:
            return float(content)
        except ValueError:
            return content

    value = fields_of(root, 0)
    if not isinstance(value, dict):
        raise InputError(f"{place}: expected XML with elements, found text")
    return value
