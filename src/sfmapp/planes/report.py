"""What warp and rectify say of the plane that they worked on."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report

Matrix = Sequence[Sequence[float]]


class ShapeReport(Report):
    """The rectangle that the corners are of.

    Attributes:
        aspect, aspect_sigma: width over height.
        angle_deg, angle_sigma_deg: between its sides with the focal length as it was known: 90 for a rectangle.
        focal_px, focal_sigma_px: as it was known, corrected by that angle being right.
        misfit_sigmas: how far that angle and what was known of the focal length contradict each other.
        is_rectangle: whether they do not, within three sigmas; otherwise the angle corrected nothing.
    """

    aspect: float
    aspect_sigma: float
    angle_deg: float
    angle_sigma_deg: float
    focal_px: float
    focal_sigma_px: float
    misfit_sigmas: float
    is_rectangle: bool


class PlanePose(Report):
    """How a plane may lie before the camera: four points of a plane allow two ways within their noise, seen from afar.

    Attributes:
        distance: of its middle from the camera. tilt_deg: of its normal from the line of sight to the middle.
        normal: in the frame of the camera (x right, y down, z forward), away from it.
        cam_from_plane: qx qy qz qw tx ty tz; the plane is z = 0, its origin the top left corner, y down.
        rms_px: of the corners.
    """

    distance: float
    tilt_deg: float
    normal: Sequence[float]
    cam_from_plane: Sequence[float]
    rms_px: float


class PlaneReport(Report):
    """A rectangle of a plane in a photograph.

    Attributes:
        photograph, width, height: the file as it is stored.
        corners: pixels, clockwise from the rectangle's own top left. source: where they are from.
        sigma_px: standard deviation of one of their coordinates.
        homography: from the plane, in units of ``size``, to pixels; to normalised image points where the camera's
            distortion is known.
        camera: in words. shape: what the corners tell of the rectangle.
        size, unit: of the rectangle; ``widths`` if no length is known.
        poses: where the camera is known: the likeliest first, others that the corners allow behind it.
        distance_sigma: of the first.
    """

    photograph: str
    width: int
    height: int
    corners: Matrix
    source: str
    sigma_px: float
    homography: Matrix
    camera: str
    shape: ShapeReport
    size: Sequence[float]
    unit: str
    poses: Sequence[PlanePose]
    distance_sigma: float | None
    warnings: Sequence[str]


class WarpReport(Report):
    """The report of ``sfmapp warp``.

    Attributes:
        picture: its file, ``picture_width`` and ``picture_height`` as it is looked at.
        result, mask: files in the folder.
        covered_share: of the photograph.
        stretch, stretch_sigma: of the picture, in width over height: 1 if it keeps its shape in the world.
        blend, opacity: as it was put on.
        pixel_share: pixels of the photograph for one of the picture along a side, where it is seen largest.
    """

    plane: PlaneReport
    picture: str
    picture_width: int
    picture_height: int
    result: str
    mask: str
    covered_share: float
    stretch: float
    stretch_sigma: float
    blend: str
    opacity: float
    pixel_share: float


class RectifyReport(Report):
    """The report of ``sfmapp rectify``.

    Attributes:
        result: file in the folder. mask: white where the photograph shows the plane; None if it shows all.
        result_width, result_height: pixels.
        area: left, top, right and bottom of what it shows, in ``plane.unit``.
        units_per_pixel: size of a pixel. size_sigma: of width and height of the rectangle, None where they were given.
        aspect_source: in words, where the ratio of width and height is from.
    """

    plane: PlaneReport
    result: str
    mask: str | None
    result_width: int
    result_height: int
    area: Sequence[float]
    units_per_pixel: float
    size_sigma: Sequence[float | None]
    aspect_source: str
