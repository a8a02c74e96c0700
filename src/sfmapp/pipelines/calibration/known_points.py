"""One photograph of points with known places: the camera that took it, where it stood, and lengths on a plane in it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.file import covariance_at, read_given_camera
from sfmapp.calibration.locate import MAX_ERROR_PX, Location, Method, locate_camera
from sfmapp.calibration.marker_points import find_marker_points
from sfmapp.calibration.measure import PlacedMarks, Plane, measure, place_by_homography, place_on_plane
from sfmapp.calibration.point_reports import (
    POSE_FILE,
    LocationReport,
    MeasureReport,
    PhotographFacts,
    TargetReport,
    figure_report,
    location_report,
    read_pose,
    target_report,
    write_pose,
)
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.calibration.target import TargetFit, calibrate_target
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.photographs import Photograph, read_given_cameras
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.atomic import write_bytes
from sfmapp.formats.known_points import read_known_points, read_marker_places, read_marks
from sfmapp.images.folder import describe_images
from sfmapp.images.image_set import ImageOptions, ImageRecord
from sfmapp.images.pixels import read_gray, read_rgb
from sfmapp.pipelines.calibration.results import write_camera, write_recording
from sfmapp.report.point_html import draw_residuals, render_location_html, render_target_html
from sfmapp.reporting import document_text
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import CALIBRATE, LOCATE, PAGE, REPORT
from sfmapp.workspace.usage import Stopwatch
from sfmapp.workspace.workspace import Workspace

Array = NDArray[np.float64]

PICTURE = "residuals.jpg"


@dataclass(frozen=True)
class PointSource:
    """Where the points of a photograph are from: a table of places and pixels, or one of the corners of markers.

    Attributes:
        points: a table of ``[name] X Y Z u v``. markers: one of ``id corner X Y Z``.
        dictionary: of the markers.
        is_opencv: pixels of the table count the centre of the first pixel as 0, as OpenCV does, not as a half.
    """

    points: Path | None = None
    markers: Path | None = None
    dictionary: str | None = None
    is_opencv: bool = False


@dataclass(frozen=True)
class PoseSearch:
    """How a pose is searched; as in :func:`sfmapp.calibration.locate.locate_camera`."""

    method: Method = "auto"
    max_error_px: float = MAX_ERROR_PX

    def __post_init__(self) -> None:
        if not self.max_error_px > 0.0:
            raise UsageError(f"max_error_px is {self.max_error_px:g}, expected more than 0 pixels")


@dataclass(frozen=True)
class TargetResult:
    """What ``calibrate target`` has found; ``report`` of it, and the fit itself."""

    output: Path
    report: TargetReport
    fit: TargetFit


@dataclass(frozen=True)
class LocateResult:
    """What ``locate`` has found; ``report`` of it, and the location itself."""

    output: Path
    report: LocationReport
    location: Location


@dataclass(frozen=True)
class PhotographPoints:
    """Places (N, 3) and pixels (N, 2) of a photograph."""

    facts: PhotographFacts
    xyz: Array
    xy: Array


def calibrate_from_target(
    photograph: str | os.PathLike[str], output: str | os.PathLike[str], source: PointSource, *,
    camera_model: CameraModel | None = None, sigma_px: float | None = None, recording: bool = True,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> TargetResult:  # fmt: skip
    """Calibrate from one photograph, and write ``calibration.json``, ``pose.json``, files for others and a report.

    Args:
        photograph: a file. output: a new folder, an empty one, or that of an earlier call.
        source: of its points.
        camera_model, sigma_px: as in :func:`sfmapp.calibration.target.calibrate_target`.
        recording: write ``recording.rrd``.

    Raises:
        UsageError: options that contradict each other, or an output that holds something else.
        InputError: the photograph or the points cannot be read, or tell no camera.
        NoReconstructionError: they leave the focal length open.
    """
    check_sigma(sigma_px)
    record = describe_photograph(photograph)
    with Job.opened(CALIBRATE, photograph, output, None, events=events, watch=watch) as job:
        job.note_inputs({record.name: record.digest})
        points = read_points(record, source, job.events)
        fit = calibrate_target(
            points.xyz, points.xy, (record.width, record.height), camera_model=camera_model, sigma_px=sigma_px
        )  # fmt: skip
        folder = job.workspace.folder
        files = write_camera(folder, fit.calibration(record.name), Path(record.name).stem)
        report = target_report(fit, points.facts, files)
        write_pose(
            folder / POSE_FILE, (fit.view.camera, fit.view.cam_from_world, fit.whole_covariance), fit.noise.sigma_px,
            points.facts, points.xyz,
        )  # fmt: skip
        picture = draw_residuals(read_rgb(record), record.orientation, report.fit.points)
        _write(job.workspace, picture[0], render_target_html(report, picture), document_text(report))
        _tell(report.fit.warnings, job.events)
        if recording:
            _record(job, record, fit.calibration(record.name), fit.points[0])
        job.workspace.save()
        return TargetResult(folder, report, fit)


def locate(
    photograph: str | os.PathLike[str], output: str | os.PathLike[str], source: PointSource, camera: str, *,
    search: PoseSearch | None = None, sigma_px: float | None = None, recording: bool = True,
    events: Events | None = None,
) -> LocateResult:  # fmt: skip
    """Find where a photograph was taken, and write ``pose.json``, a recording and a report.

    Args:
        photograph: a file. output: a new folder, an empty one, or that of an earlier call.
        source: of its points.
        camera: a calibration file of any form. What ``sfmapp calibrate`` has written brings its covariance.
        search: of the pose; None for the usual one. sigma_px: standard deviation of a marked coordinate; None: as the
            residuals tell.
        recording: write ``recording.rrd``.

    Raises:
        UsageError: options that contradict each other, or an output that holds something else.
        InputError: the photograph, the points or the camera cannot be read.
        NoReconstructionError: no pose agrees with the points, or they leave it open.
    """
    check_sigma(sigma_px)
    search = search or PoseSearch()
    record = describe_photograph(photograph)
    given, covariance = read_camera(camera, record)
    with Job.opened(LOCATE, photograph, output, None, events=events) as job:
        job.note_inputs({record.name: record.digest})
        points = read_points(record, source, job.events)
        found = locate_camera(
            points.xyz, points.xy, given, method=search.method, max_error_px=search.max_error_px, sigma_px=sigma_px,
            camera_covariance=covariance,
        )  # fmt: skip
        folder = job.workspace.folder
        report = location_report(found, points.facts, points.xy)
        write_pose(
            folder / POSE_FILE, (found.view.camera, found.view.cam_from_world, found.covariance), found.noise.sigma_px,
            points.facts, points.xyz,
        )  # fmt: skip
        picture = draw_residuals(read_rgb(record), record.orientation, report.fit.points)
        _write(job.workspace, picture[0], render_location_html(report, picture), document_text(report))
        _tell(report.fit.warnings, job.events)
        if recording:
            view = ViewFit(record.name, found.view.cam_from_world, points.xy, found.view.residual, found.view.is_used)
            num = len(given.params)
            seen = CameraCalibration(
                given, found.covariance[:num, :num], found.method, found.noise.sigma_px,
                round(found.view.degrees_of_freedom), (view,),
            )  # fmt: skip
            _record(job, record, seen, points.xyz)
        job.workspace.save()
        return LocateResult(folder, report, found)


@dataclass(frozen=True)
class MeasureSource:
    """What places marks: the pose of the photograph and a plane, or known points of the plane.

    Attributes:
        pose: ``pose.json``, or the folder that holds it.
        plane: ``a,b,c,d`` of a X + b Y + c Z = d, or three names of points of the pose.
        metric: a table of ``X Y u v``, four points of the plane or more.
        camera: whose distortion is taken away first; with ``metric`` alone.
        is_opencv: as in :class:`PointSource`, of all tables.
    """

    pose: Path | None = None
    plane: str = "0,0,1,0"
    metric: Path | None = None
    camera: str | None = None
    is_opencv: bool = False


def measure_marks(
    marks: str | os.PathLike[str], source: MeasureSource, *, sigma_px: float | None = None
) -> MeasureReport:
    """Lengths and areas of figures that are marked in a photograph, on a plane.

    Args:
        marks: a table of ``name u v``: two marks of one name are a length, three or more a polygon.
        sigma_px: standard deviation of a mark; None: that of the marks that the pose is from.

    Raises:
        UsageError: neither a pose nor known points are given, or both.
        InputError: a file that cannot be read, or marks that do not see the plane.
    """
    check_sigma(sigma_px)
    if (source.pose is None) == (source.metric is None):
        raise UsageError("expected either a pose or known points of the plane: --pose or --metric")
    table = read_marks(Path(marks))
    xy = table.xy + 0.5 * source.is_opencv
    placed, plane, unit = _placed(xy, source, sigma_px)
    figures = measure(placed, table.figures)
    return MeasureReport(
        plane=plane, unit=unit, sigma_px=placed.sigma_px, figures=[figure_report(figure) for figure in figures]
    )  # fmt: skip


def _placed(xy: Array, source: MeasureSource, sigma_px: float | None) -> tuple[PlacedMarks, str, str]:
    """Marks on the plane, which plane that is, and the unit."""
    if source.pose is not None:
        pose = read_pose(source.pose)
        plane, text = _plane(source.plane, pose.places)
        sigma = pose.sigma_px if sigma_px is None else sigma_px
        placed = place_on_plane(xy, pose.camera, pose.cam_from_world, pose.covariance, plane, sigma)
        return placed, text, pose.unit
    assert source.metric is not None
    known = read_known_points(source.metric)
    pixels = known.xy + 0.5 * source.is_opencv
    if np.ptp(known.xyz[:, 2]) > 0.0:
        raise InputError(f"{source.metric}: expected points of one plane, X and Y in it, found several Z")
    camera = None if source.camera is None else _only_camera(source.camera)
    placed = place_by_homography(xy, (known.xyz[:, :2], pixels), sigma_px, camera)
    return placed, f"of {len(known.names)} known points", known.unit


def _plane(text: str, known: Mapping[str, Array]) -> tuple[Plane, str]:
    fields = [field.strip() for field in text.split(",")]
    if len(fields) >= 3 and all(field in known for field in fields):
        return Plane.of_points(np.stack([known[field] for field in fields])), f"through {', '.join(fields)}"
    try:
        values = [float(field) for field in fields]
    except ValueError:
        values = []
    if len(values) != 4:
        shown = ", ".join(list(known)[:6]) or "none"
        raise UsageError(
            f"plane is {text!r}, expected a,b,c,d of a X + b Y + c Z = d, or three names of points",
            f"0,0,1,0 is Z = 0; points of the pose: {shown}",
        )
    terms = [(value, axis) for value, axis in zip(values[:3], "XYZ", strict=True) if value != 0.0]
    shown = " + ".join(axis if value == 1.0 else f"{value:g} {axis}" for value, axis in terms)
    return Plane.of_equation(np.array(values[:3]), values[3]), f"{shown} = {values[3]:g}"


def _record(job: Job, record: ImageRecord, made: CameraCalibration, xyz: Array) -> None:
    write_recording(job, made, plane_outline(xyz), {record.name: str(record.path)}, record.name)


def plane_outline(xyz: Array) -> Array:
    """(4, 3) corners of the rectangle of points (N, 3) along their two widest directions, which is what a recording
    shows in front of a camera."""
    middle = xyz.mean(0)
    axes = np.linalg.svd(xyz - middle)[2][:2]
    low, high = ((xyz - middle) @ axes.T).min(0), ((xyz - middle) @ axes.T).max(0)
    corners: Array = middle + np.array([low, [high[0], low[1]], high, [low[0], high[1]]]) @ axes
    return corners


# ------------------------------------------------------------------------------------------------------------- reading


def check_sigma(sigma_px: float | None) -> None:
    """Raises UsageError for a sigma that is none."""
    if sigma_px is not None and not (np.isfinite(sigma_px) and sigma_px > 0.0):
        raise UsageError(f"sigma_px is {sigma_px:g}, expected more than 0 pixels")


def describe_photograph(photograph: str | os.PathLike[str]) -> ImageRecord:
    """One photograph. Raises InputError if it cannot be used."""
    path = Path(photograph)
    records, reasons = describe_images(path.parent, [path.name], ImageOptions())
    record = records[0]
    if record is None:
        raise InputError(f"{path}: {reasons[0][1]}", "give one photograph")
    return record


def read_points(record: ImageRecord, source: PointSource, events: Events) -> PhotographPoints:
    """The points of a photograph.

    Raises:
        UsageError: a source that is none, or two.
        InputError: a table that cannot be read, pixels outside the photograph, or markers that it does not show.
    """
    if (source.points is None) == (source.markers is None):
        raise UsageError("expected either a table of points or one of markers: --points or --markers")
    if source.points is not None:
        known = read_known_points(source.points, record.name)
        xy = known.xy + 0.5 * source.is_opencv
        outside = ~((xy >= 0.0) & (xy <= [record.width, record.height])).all(1)
        if outside.any():
            n = int(np.argmax(outside))
            raise InputError(
                f"{source.points}, line {known.lines[n]}: expected a pixel of {record.name}, which is {record.width} x "
                f"{record.height}, found ({xy[n, 0]:g}, {xy[n, 1]:g})",
                "pixels are those of the file as it is stored, before EXIF turns it",
            )
        return PhotographPoints(PhotographFacts(record.name, known.names, known.unit), known.xyz, xy)
    assert source.markers is not None
    if source.dictionary is None:
        raise UsageError("expected the dictionary of the markers: --dictionary, such as DICT_4X4_50")
    places = read_marker_places(source.markers)
    names, xyz, xy, unknown = find_marker_points(read_gray(record), source.dictionary, places.corners)
    if not names:
        raise InputError(
            f"{record.name}: expected markers of {source.markers}, found none of them",
            f"markers without a place were found: {unknown}"
            if unknown
            else "check the dictionary, light and sharpness",
        )
    if unknown:
        events.warned(CALIBRATE, f"markers {', '.join(map(str, unknown))} have no place in {source.markers}")
    return PhotographPoints(PhotographFacts(record.name, names, places.unit), xyz, xy)


def read_camera(given: str, record: ImageRecord) -> tuple[Camera, Array | None]:
    """The camera of a photograph, and the covariance of its parameters where its file has one."""
    photograph, root = Photograph(record.name, (record.width, record.height), record.orientation), record.path.parent
    cameras, calibration = read_given_camera(given)
    camera = cameras.of_photographs(str(root), [photograph])[0].camera
    return camera, None if calibration is None else covariance_at(calibration, str(root), photograph)


def _only_camera(given: str) -> Camera:
    cameras = read_given_cameras(given)
    if len(cameras.cameras) != 1 or cameras.sizeless:
        raise InputError(f"{given}: expected one camera with the size of its pictures, found others")
    calibrated = next(iter(cameras.cameras.values()))((1, 1))
    return calibrated.camera


def _tell(warnings: Sequence[str], events: Events) -> None:
    for warning in warnings:
        events.warned(CALIBRATE, warning)


def _write(workspace: Workspace, picture: bytes, page: str, report: str) -> None:
    write_bytes(workspace.folder / PICTURE, picture)
    workspace.write_text(PAGE, page)
    workspace.write_text(REPORT, report)
