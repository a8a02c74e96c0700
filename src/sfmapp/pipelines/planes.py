"""A picture into a plane of a photograph, and a plane out of one: files and reports."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.one_view import HAND_SIGMA_PX
from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.atomic import write_bytes
from sfmapp.geometry.orientation import upright_pixels
from sfmapp.geometry.rectangle import RectangleShape
from sfmapp.images.folder import load_images
from sfmapp.images.headers import Header
from sfmapp.images.image_set import ImageOptions, ImageRecord
from sfmapp.images.pixels import decode_file, read_file, read_gray, read_mask_file
from sfmapp.images.rewrite import encode, encode_mask
from sfmapp.pipelines.calibration.known_points import describe_photograph, read_camera
from sfmapp.planes.corners import corners_of_markers
from sfmapp.planes.lengths import parse_length, parse_size
from sfmapp.planes.rectify import Area, check_size, natural_scale, take_plane
from sfmapp.planes.report import PlaneReport, RectifyReport, ShapeReport, WarpReport
from sfmapp.planes.told import KnownCamera, poses_in, shape_in
from sfmapp.planes.view import PlaneView, check_in_photograph, view_of_corners
from sfmapp.planes.warp import Look, put_picture
from sfmapp.report.plane_html import rectify_page, warp_page
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import PAGE, RECTIFY, REPORT, WARP
from sfmapp.workspace.usage import Stopwatch

Array = NDArray[np.float64]

STAGE, MASK = "plane", "mask.png"
# corners that a finder has refined
_FOUND_SIGMA_PX = 0.2


@dataclass(frozen=True)
class PlaneSource:
    """What says where the plane is.

    Attributes:
        corners: (4, 2) pixels, clockwise from the top left; or
        markers: the id of one marker, or of four at the corners; ``dictionary`` of these.
        camera: a calibration of any form; None: a focal length from EXIF, or none.
        sigma_px: standard deviation of a coordinate of a corner; None: one pixel of a hand, 0.2 of a marker.
        is_opencv: corners count the centre of the first pixel as 0, as OpenCV does, not as a half.
    """

    corners: tuple[tuple[float, float], ...] | None = None
    markers: tuple[int, ...] | None = None
    dictionary: str | None = None
    camera: str | None = None
    sigma_px: float | None = None
    is_opencv: bool = False

    def __post_init__(self) -> None:
        if (self.corners is None) == (self.markers is None):
            raise UsageError("expected either the corners of the plane or markers: --corners or --marker")
        if self.markers is not None and self.dictionary is None:
            raise UsageError("expected the dictionary of the markers: --dictionary, such as DICT_4X4_50")
        if self.sigma_px is not None and not 0.0 < self.sigma_px < np.inf:
            raise UsageError(f"sigma_px is {self.sigma_px:g}, expected more than 0 pixels")


@dataclass(frozen=True)
class Wanted:
    """How a plane is to be taken out.

    Attributes:
        size: ``WxH`` in pixels of the result, or, with a unit, the true size of the rectangle; None: told by the
            photograph.
        width: true width of the rectangle with its unit, its height told by the photograph.
        margin: how much of the plane round the rectangle is shown, in shares of its longer side.
        max_size: limit of the longer side of the result, pixels.
    """

    size: str | None = None
    width: str | None = None
    margin: float = 0.0
    max_size: int | None = None

    def __post_init__(self) -> None:
        if self.size is not None and self.width is not None:
            raise UsageError("expected either --size or --width: a size has a width")
        if not 0.0 <= self.margin <= 100.0:
            raise UsageError(f"margin is {self.margin:g}, expected a share from 0 to 100")
        if self.max_size is not None and self.max_size < 1:
            raise UsageError(f"max_size is {self.max_size}, expected 1 pixel or more")


@dataclass(frozen=True)
class WarpResult:
    """What ``warp`` has written; ``pixels`` (H, W, ...) of the photograph with the picture."""

    output: Path
    report: WarpReport
    pixels: NDArray[Any]


@dataclass(frozen=True)
class RectifyResult:
    """What ``rectify`` has written; ``pixels`` (h, w, ...) of the plane."""

    output: Path
    report: RectifyReport
    pixels: NDArray[Any]


@dataclass(frozen=True)
class _Plane:
    """A photograph, the corners in it, and what they tell."""

    record: ImageRecord
    known: KnownCamera
    corners: Array
    sigma_px: float
    source: str
    warnings: list[str]
    shape: RectangleShape

    @property
    def lens(self) -> Camera | None:
        """The camera where its distortion is known; where it is not, or there is none, straight lines are straight."""
        return None if self.known.camera.is_pinhole else self.known.camera

    def view(self, size: tuple[float, float]) -> PlaneView:
        return view_of_corners(self.corners, size, self.lens)

    def report(self, size: tuple[float, float], unit: str, view: PlaneView) -> PlaneReport:
        poses, sigma = poses_in(self.known, self.corners, size, self.sigma_px)
        shape = self.shape
        return PlaneReport(
            photograph=self.record.name, width=self.record.width, height=self.record.height,
            corners=self.corners.tolist(), source=self.source, sigma_px=self.sigma_px,
            homography=(view.homography / view.homography[2, 2]).tolist(), camera=self.known.text,
            shape=ShapeReport(
                aspect=shape.aspect, aspect_sigma=shape.aspect_sigma, angle_deg=shape.angle_deg,
                angle_sigma_deg=shape.angle_sigma_deg, focal_px=shape.focal_px,
                focal_sigma_px=shape.focal_px * shape.focal_share, misfit_sigmas=shape.misfit_sigmas,
                is_rectangle=shape.is_rectangle,
            ),
            size=list(size), unit=unit, poses=poses, distance_sigma=sigma, warnings=self.warnings,
        )  # fmt: skip


def warp(
    picture: str | os.PathLike[str], photograph: str | os.PathLike[str], output: str | os.PathLike[str],
    source: PlaneSource, *, look: Look | None = None, mask: str | os.PathLike[str] | None = None,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> WarpResult:  # fmt: skip
    """Put a picture onto a plane of a photograph.

    Args:
        picture: a file; it is taken as it is looked at, and its alpha channel is kept.
        photograph: a file, whose depth and format the result has.
        output: a new folder, an empty one, or that of an earlier call.
        source: where the plane is. look: how the picture lies on it.
        mask: a file of the photograph's shape, black where something stands in front of the plane.
        events: progress and warnings. watch: started when the run began.

    Raises:
        UsageError: corners that no rectangle has, or an output that holds something else.
        InputError: a file that cannot be read, or a marker that is not there once.
    """
    look = look or Look()
    with Job.opened(WARP, photograph, output, None, events=events, watch=watch) as job:
        with job.stage(STAGE):
            shown = describe_photograph(picture)
            plane = _plane(job, photograph, source, mask)
            job.note_inputs({plane.record.name: plane.record.digest, shown.name: shown.digest})
            pixels, header = _read(plane.record)
            on_it = upright_pixels(_read(shown)[0], shown.orientation)
            size = float(on_it.shape[1]), float(on_it.shape[0])
            view = plane.view(size)
        with job.stage("picture"):
            result, covered = put_picture(on_it, pixels, view, look, free=read_mask_file(plane.record))
            name = _result_name(plane.record)
            _write(job, name, encode(result, header.format))
            _write(job, MASK, encode(covered, "png"))
        aspect = plane.shape.aspect / (size[0] / size[1])
        _tell(job, plane)
        report = WarpReport(
            plane=plane.report((1.0, 1.0 / plane.shape.aspect), "widths", view), picture=shown.name,
            picture_width=int(size[0]), picture_height=int(size[1]), result=name, mask=MASK,
            covered_share=float(covered.mean() / 255.0), stretch=aspect,
            stretch_sigma=aspect * plane.shape.aspect_share, blend=look.blend, opacity=look.opacity,
            pixel_share=natural_scale(view, size),
        )  # fmt: skip
        job.workspace.write_json(REPORT, report)
        job.workspace.write_text(PAGE, warp_page(report, result, plane.record.orientation))
        job.workspace.save()
        return WarpResult(job.workspace.folder, report, result)


def rectify(
    photograph: str | os.PathLike[str], output: str | os.PathLike[str], source: PlaneSource, *,
    wanted: Wanted | None = None, events: Events | None = None, watch: Stopwatch | None = None,
) -> RectifyResult:  # fmt: skip
    """Take a plane out of a photograph, as it looks straight on.

    Args:
        photograph: a file. output: a new folder, an empty one, or that of an earlier call.
        source: where a rectangle of the plane is. wanted: its size, and that of the result.
        events: progress and warnings. watch: started when the run began.

    Raises:
        UsageError: corners that no rectangle has, a result too large, or an output that holds something else.
        InputError: a file that cannot be read, or a marker that is not there once.
    """
    wanted = wanted or Wanted()
    with Job.opened(RECTIFY, photograph, output, None, events=events, watch=watch) as job:
        with job.stage(STAGE):
            plane = _plane(job, photograph, source, None)
            job.note_inputs({plane.record.name: plane.record.digest})
            laid = _laid_out(plane, wanted)
            view = plane.view(laid.size)
            area = _area(view, laid, wanted)
        with job.stage("picture"):
            pixels, header = _read(plane.record)
            result, shown = take_plane(pixels, view, area)
            if not shown.any():
                raise InputError(f"{plane.record.name}: it shows nothing of the plane that is asked for")
            name = _result_name(plane.record)
            _write(job, name, encode(result, header.format))
            mask = None if shown.all() else MASK
            if mask is not None:
                _write(job, mask, encode_mask(shown))
        _tell(job, plane)
        report = RectifyReport(
            plane=plane.report(laid.size, laid.unit, view), result=name, mask=mask, result_width=area.width,
            result_height=area.height, area=list(area[:4]), units_per_pixel=(area.right - area.left) / area.width,
            size_sigma=laid.sigmas, aspect_source=laid.aspect_source,
        )  # fmt: skip
        job.workspace.write_json(REPORT, report)
        job.workspace.write_text(PAGE, rectify_page(report, pixels, result, plane.record.orientation))
        job.workspace.save()
        return RectifyResult(job.workspace.folder, report, result)


# --------------------------------------------------------------------------------------------------------- the plane


def _plane(
    job: Job, photograph: str | os.PathLike[str], source: PlaneSource, mask: str | os.PathLike[str] | None
) -> _Plane:
    found, _ = load_images((os.fspath(photograph),), ImageOptions(), Events(), threads=1)
    if not found.images:
        describe_photograph(photograph)  # says why
    record, camera = found.images[0], found.camera_of(0)
    if mask is not None:
        record = _with_mask(record, Path(mask))
    if source.camera is not None:
        camera, covariance = read_camera(source.camera, record)
        known = KnownCamera(camera, covariance, f"{camera.model.name} of {source.camera}")
    else:
        text = "nothing is known: 1.2 times the longer side, +- 50 %" if camera.focal_source == "default" else "EXIF"
        known = KnownCamera(camera, None, f"focal length {camera.focal:.0f} px ({text}), no distortion")
    if source.corners is not None:
        corners = np.array(source.corners, np.float64).reshape(-1, 2) + 0.5 * source.is_opencv
        text, sigma_px = "given", HAND_SIGMA_PX
    else:
        assert source.markers is not None
        assert source.dictionary is not None
        corners = corners_of_markers(read_gray(record), source.dictionary, source.markers, record.name)
        ids = ", ".join(map(str, source.markers))
        text, sigma_px = f"marker{'s' * (len(source.markers) > 1)} {ids} of {source.dictionary}", _FOUND_SIGMA_PX
    sigma_px = source.sigma_px or sigma_px
    lens = None if known.camera.is_pinhole else known.camera
    view_of_corners(corners, (1.0, 1.0), lens)  # before anything is made of them
    warnings = check_in_photograph(corners, (record.width, record.height), record.name)
    if record.orientation != 1:
        warnings.append(
            f"{record.name} has EXIF orientation {record.orientation}: corners are pixels of the file as it is stored, "
            f"{record.width} x {record.height}, and so is the result"
        )
    shape = shape_in(known, corners, sigma_px)
    if not shape.is_rectangle:
        warnings.append(
            f"the corners are not those of a rectangle, or the focal length is another ({shape.misfit_sigmas:.1f} "
            f"sigmas): with {known.camera.focal:.0f} px its sides meet under {shape.angle_deg:.1f} degrees"
        )
    return _Plane(record, known, corners, sigma_px, text, warnings, shape)


def _tell(job: Job, plane: _Plane) -> None:
    for warning in plane.warnings:
        job.events.warned(STAGE, warning)


def _with_mask(record: ImageRecord, mask: Path) -> ImageRecord:
    if not mask.is_file():
        raise InputError(f"{mask}: expected a mask of {record.name}, found no file")
    return replace(record, mask_path=mask.resolve())


@dataclass(frozen=True)
class _LaidOut:
    """A rectangle in its own unit: width and height, their sigmas, how they are known, and pixels of the result."""

    size: tuple[float, float]
    unit: str
    sigmas: list[float | None]
    aspect_source: str
    pixels: tuple[float, float] | None = None


def _laid_out(plane: _Plane, wanted: Wanted) -> _LaidOut:
    if wanted.size is not None:
        asked = parse_size(wanted.size)
        size = asked.width, asked.height
        _compare(plane, size[0] / size[1], "--size")
        if asked.is_metric:
            return _LaidOut(size, "m", [None, None], "as given")
        return _LaidOut((1.0, size[1] / size[0]), "widths", [None, None], "as given", size)
    is_marker = plane.source.startswith("marker ")
    aspect, share = (1.0, 0.0) if is_marker else (plane.shape.aspect, plane.shape.aspect_share)
    if is_marker:
        _compare(plane, 1.0, "a marker")
    source = "a marker is square" if is_marker else "told by the corners and the focal length"
    width = 1.0 if wanted.width is None else parse_length(wanted.width)
    height = width / aspect
    if share > 0.1:
        plane.warnings.append(
            f"the ratio of width and height is uncertain: {aspect:.3g} +- {plane.shape.aspect_sigma:.2g}; "
            "--size says what it is, --camera makes it surer"
        )
    sigma = height * share if share else None
    return _LaidOut((width, height), "widths" if wanted.width is None else "m", [None, sigma], source)


def _compare(plane: _Plane, aspect: float, what: str) -> None:
    """Warn where the corners contradict a ratio of width and height that is given."""
    gap = math.log(aspect / plane.shape.aspect)
    if plane.shape.is_rectangle and abs(gap) > 3.0 * plane.shape.aspect_share:
        plane.warnings.append(
            f"{what} has width to height as {aspect:.4g}, the corners tell {plane.shape.aspect:.4g} +- "
            f"{plane.shape.aspect_sigma:.2g}: corners, camera or size are wrong, and the picture is stretched"
        )


def _area(view: PlaneView, laid: _LaidOut, wanted: Wanted) -> Area:
    width, height = laid.size
    margin = wanted.margin * max(width, height)
    left, top, right, bottom = -margin, -margin, width + margin, height + margin
    if laid.pixels is not None:
        scale = laid.pixels[0] / width
    else:
        scale = natural_scale(view, laid.size)
    longer = scale * max(right - left, bottom - top)
    if wanted.max_size is not None and longer > wanted.max_size:
        scale *= wanted.max_size / longer
    size = max(scale * (right - left), 1.0), max(scale * (bottom - top), 1.0)
    check_size(*size)
    return Area(left, top, right, bottom, round(size[0]), round(size[1]))


# ------------------------------------------------------------------------------------------------------------- files


def _read(record: ImageRecord) -> tuple[NDArray[Any], Header]:
    data, header = read_file(record)
    return decode_file(record, data, header), header


def _result_name(record: ImageRecord) -> str:
    """The photograph's own, which a mask may not take away from it."""
    name = Path(record.name).name
    return f"picture_{name}" if name == MASK else name


def _write(job: Job, name: str, data: bytes) -> None:
    write_bytes(job.workspace.folder / name, data)
