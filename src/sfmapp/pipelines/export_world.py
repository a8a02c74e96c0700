"""Exports into the world: point clouds in a coordinate system, cameras on a map."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.formats.las import read_las, step_of, write_las
from sfmapp.formats.map_layers import Placemarks, read_geojson, read_kml, write_geojson, write_kml
from sfmapp.formats.ply import write_ply
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry import rigid3
from sfmapp.georeference.coordinate_systems import CoordinateSystem, coordinate_system, utm_code
from sfmapp.georeference.world_frame import GEOREFERENCE, Georeference, read_georeference
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

_ABOVE = {
    "ellipsoidal": "above the ellipsoid WGS84",
    "orthometric": "above the geoid",
    "unknown": "as they were given: above the geoid or the ellipsoid, which nobody said",
}


@dataclass(frozen=True)
class World:
    """What a model lies in.

    Attributes:
        georeference: None for a model in no frame of the world.
        crs: the system that the user asked for; None: none.
    """

    georeference: Georeference | None
    crs: str | None

    def system(self, is_needed: bool) -> CoordinateSystem | None:
        """The coordinate system to write in: what was asked for, or else, if one is needed, the UTM zone.

        Raises:
            UsageError: one is asked for, of a model that lies in no frame of the world.
            InputError: it is none, it is not in metres, or its heights are not those of the model.
        """
        if self.georeference is None:
            if self.crs is not None:
                raise UsageError(
                    f"--crs {self.crs}: the model is in no frame of the world",
                    "reconstruct it with photographs that have GPS tags, or with ground control points",
                )
            return None
        if self.crs is None and not is_needed:
            return None
        where = self.georeference
        found = coordinate_system(self.crs or utm_code(where.latitude_deg, where.longitude_deg), "--crs")
        found.check_metres("--crs")
        if found.heights != "unknown" and where.heights != "ellipsoidal":
            raise InputError(
                f"--crs {found.code}: this system has heights {_ABOVE[found.heights]}; those of the model are "
                f"{_ABOVE[where.heights]}",
                "name the horizontal system alone, such as EPSG:25833: heights are then written as they are",
            )
        return found

    def geodetic(self, xyz: Array) -> Array:
        """Geodetic positions (N, 3) of points (N, 3) in the frame."""
        assert self.georeference is not None
        return self.georeference.frame.geodetic_from_enu(xyz)

    def coordinates(self, xyz: Array, system: CoordinateSystem | None) -> Array:
        """Points (N, 3) of the frame in a system; heights stay those of the frame's own kind."""
        return xyz if system is None else system.coordinates(self.geodetic(xyz), "points")

    def frame(self, coordinates: Array, system: CoordinateSystem | None) -> Array:
        """Points (N, 3) of the frame that lie at coordinates (N, 3) of a system."""
        if system is None:
            return coordinates
        assert self.georeference is not None
        return self.georeference.frame.enu_from_geodetic(system.geodetic(coordinates, "points"))

    def notes(self, system: CoordinateSystem | None, offset: str = "") -> tuple[str, ...]:
        """What a user of coordinates has to know."""
        if self.georeference is None:
            return (
                "the model is in no frame of the world: coordinates are its own, in metres only if it was given some",
            )
        if system is None:
            where = self.georeference
            return (
                f"coordinates are metres east, north and up of latitude {where.latitude_deg:.9f}, longitude "
                f"{where.longitude_deg:.9f}, height {where.height_m:.3f}; {GEOREFERENCE} says so",
            )
        return (f"{system.code} ({system.name}), heights {_ABOVE[self.georeference.heights]}{offset}",)


NO_WORLD = World(None, None)


def world_of(folder: Path | None, crs: str | None, model: int = 0) -> World:
    """What a model of a run lies in.

    Args:
        folder: of the run; None for a model of no run.
    """
    found = read_georeference(folder) if folder is not None else None
    if found is not None and found.place_of(model) is None:
        found = None
    return World(found, crs)


@dataclass(frozen=True)
class Cloud:
    """Points to write: xyz (N, 3) in the frame of the model, rgb (N, 3) uint8."""

    xyz: Array
    rgb: NDArray[np.uint8]


@dataclass(frozen=True)
class CloudCopy:
    """What was read back: points in the frame of the model, in our order, and who read it from where."""

    xyz: Array
    rgb: NDArray[np.uint8]
    file: Path
    reader: str
    notes: tuple[str, ...]


def dense_cloud(folder: Path) -> Cloud:
    """The dense points of a run. Raises UsageError if it has none, InputError if they are damaged."""
    path = folder / "dense" / "fused.ply"
    if not path.is_file():
        raise UsageError(f"{folder} holds no dense points", f"make them: sfmapp dense {folder}")
    found = read_ply_geometry(path)
    if found.rgb is None or not found.is_finite.all():
        raise InputError(f"{path}: expected finite points with colours", "run sfmapp dense again")
    return Cloud(found.xyz, found.rgb)


def export_cloud_ply(cloud: Cloud, file: Path, world: World) -> CloudCopy:
    """Points as PLY: in the frame, or in a system, then in double precision as its large numbers ask for."""
    system = world.system(is_needed=False)
    coordinates = world.coordinates(cloud.xyz, system)
    write_ply(file, coordinates, cloud.rgb)
    back = read_ply_geometry(file)
    if back.rgb is None or len(back.xyz) != len(cloud.xyz):
        raise InputError(f"{file}: expected to read back {len(cloud.xyz)} coloured points, found {len(back.xyz)}")
    notes = () if world.georeference is None else world.notes(system, "; in double precision")
    return CloudCopy(world.frame(back.xyz, system), back.rgb, file, "sfmapp", notes)


def export_cloud_las(cloud: Cloud, file: Path, world: World) -> CloudCopy:
    """Points as LAS or LAZ in a coordinate system, the UTM zone if none is asked for; of no world in none."""
    system = world.system(is_needed=True)
    coordinates = world.coordinates(cloud.xyz, system)
    write_las(file, coordinates, cloud.rgb, system.wkt if system is not None else None)
    back = read_las(file)
    if len(back.xyz) != len(cloud.xyz) or (back.wkt is None) != (system is None):
        raise InputError(f"{file}: expected to read back {len(cloud.xyz)} points, found {len(back.xyz)}")
    notes = world.notes(system, f"; coordinates are rounded to {step_of(coordinates):g} m")
    return CloudCopy(world.frame(back.xyz, system), back.rgb, file, "laspy", notes)


def export_map(model: Reconstruction, file: Path, world: World) -> CloudCopy:
    """The photographs as points of a map, GeoJSON or KML by the name; what is read back are their centres.

    Raises:
        UsageError: the model is in no frame of the world, or a system is asked for.
    """
    if world.georeference is None:
        raise UsageError(
            "the model is in no frame of the world: there is no map to put it on",
            "reconstruct it with photographs that have GPS tags, or with ground control points",
        )
    if world.crs is not None:
        raise UsageError(f"--crs {world.crs}: maps are in degrees on WGS84 by their formats", "leave it out")
    places = _photographs(model, world)
    is_kml = file.suffix.lower() == ".kml"
    if is_kml:
        write_kml(file, places, "photographs")
    else:
        write_geojson(file, places)
    back = read_kml(file) if is_kml else read_geojson(file)
    if list(back.names) != list(places.names):
        raise InputError(f"{file}: expected to read back {len(places.names)} photographs, found {len(back.names)}")
    heights = world.georeference.heights
    note = f"heights are {_ABOVE[heights]}"
    if is_kml and heights != "orthometric":
        note += "; Google Earth takes them for heights above the sea and may show the cameras tens of metres too high"
    frame = world.georeference.frame
    xyz = frame.enu_from_geodetic(back.geodetic)
    return CloudCopy(xyz, np.zeros((len(xyz), 3), np.uint8), file, "sfmapp", (note,))


def _photographs(model: Reconstruction, world: World) -> Placemarks:
    """Where the photographs were taken, and where they look: heading clockwise from north, pitch from the horizon."""
    images = model.registered_idx
    forward = rigid3.rotation_matrix(model.cam_from_world[images])[:, 2]
    heading = np.degrees(np.arctan2(forward[:, 0], forward[:, 1])) % 360.0
    pitch = np.degrees(np.arcsin(np.clip(forward[:, 2], -1.0, 1.0)))
    properties: list[Mapping[str, float | str]] = [
        {"heading_deg": round(float(h), 3), "pitch_deg": round(float(p), 3), "camera": int(c)}
        for h, p, c in zip(heading, pitch, model.image_camera_idx[images], strict=True)
    ]
    return Placemarks([model.image_names[i] for i in images], world.geodetic(model.centers[images]), properties)


def copy_georeference(folder: Path, target: Path) -> Path:
    """Put ``georeference.json`` of a run beside what was exported of it; returns its place."""
    target.mkdir(parents=True, exist_ok=True)
    path = target / GEOREFERENCE
    if path.resolve() != (folder / GEOREFERENCE).resolve():
        shutil.copyfile(folder / GEOREFERENCE, path)
    return path
