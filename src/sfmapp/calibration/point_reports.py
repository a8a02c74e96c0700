"""What `calibrate target`, `locate` and `measure` say of themselves, and ``pose.json``, which measuring starts from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.documents import read_document, write_document
from sfmapp.calibration.locate import Location
from sfmapp.calibration.measure import MeasuredFigure
from sfmapp.calibration.one_view import Noise, OneView
from sfmapp.calibration.one_view_kernels import POSE
from sfmapp.calibration.report import CameraFileReport
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.target import TargetFit
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.camera.names import MODEL_NAMES
from sfmapp.errors import InputError
from sfmapp.formats.colmap_model import checked_camera
from sfmapp.formats.text_input import finite_array
from sfmapp.geometry import rigid3
from sfmapp.reporting import Report

Array = NDArray[np.float64]

POSE_FILE = "pose.json"
POSES = "poses"
"""Folder of ``NAME.json``, a pose for each of several photographs."""
FORMAT = "sfmapp pose 1"


class PointReport(Report):
    """A point and what the fit leaves of it.

    Attributes:
        marked_px, expected_px: where it was marked, and where camera and pose put it; absent where the lens has no ray.
        left_out_px: distance of the mark from where all others put it; absent where nothing tells.
        is_used: False for a point that the others contradict.
        reason: why it was left aside, or why nothing checks it.
    """

    name: str
    marked_px: Sequence[float]
    expected_px: Sequence[float] | None = None
    left_out_px: float | None = None
    is_used: bool
    reason: str | None = None


class ParameterReport(Report):
    """A parameter of a camera and its standard deviation."""

    name: str
    value: float
    sigma: float


class LensReport(Report):
    """A lens that was tried; ``left_out_px``: how far points lie from where the others put them, root mean square."""

    model: str
    num_unknown: int
    num_used: int
    rms_px: float
    left_out_px: float | None = None
    is_chosen: bool


class LinearReport(Report):
    """The direct linear transform of the points that agree.

    Attributes:
        rank: combinations of the eleven that the points tell; singular_values: of the normalised system; noise_level:
            what those would be that noise alone makes.
    """

    rank: int
    singular_values: Sequence[float]
    noise_level: float


class PoseReport(Report):
    """Where a camera stood.

    Attributes:
        cam_from_world: qx qy qz qw tx ty tz. center: in the world.
        sigma_rotation_deg: about the camera's axes. sigma_center: along the world's axes.
        unit: of the places.
    """

    cam_from_world: Sequence[float]
    center: Sequence[float]
    sigma_rotation_deg: Sequence[float]
    sigma_center: Sequence[float]
    unit: str


class OtherPoseReport(Report):
    """A second pose that the points allow."""

    cam_from_world: Sequence[float]
    rms_px: float
    turn_deg: float
    shift: float


class FitReport(Report):
    """One photograph of known points: what ``calibrate target`` and ``locate`` have in common.

    Attributes:
        rms_px: of the points that agree. noise_px: standard deviation of a mark, from ``noise_source``.
    """

    photograph: str
    model: str
    width: int
    height: int
    pose: PoseReport
    points: Sequence[PointReport]
    num_used: int
    rms_px: float
    noise_px: float
    noise_source: str
    degrees_of_freedom: float
    method: str
    warnings: Sequence[str]


class TargetReport(Report):
    """The report of ``sfmapp calibrate target``."""

    fit: FitReport
    parameters: Sequence[ParameterReport]
    linear: LinearReport | None = None
    tilt_deg: float | None = None
    lenses: Sequence[LensReport]
    files: Sequence[CameraFileReport]


class LostPhotographReport(Report):
    """A photograph that tells nothing of its camera, and why."""

    photograph: str
    reason: str


class TargetsReport(Report):
    """The report of ``sfmapp calibrate target`` with several photographs.

    Attributes:
        photographs: their poses by the joint camera, whose sigmas are in theirs, and their points.
        lost: those that were left aside.
    """

    model: str
    width: int
    height: int
    parameters: Sequence[ParameterReport]
    photographs: Sequence[FitReport]
    lost: Sequence[LostPhotographReport]
    rms_px: float
    noise_px: float
    degrees_of_freedom: float
    method: str
    files: Sequence[CameraFileReport]
    warnings: Sequence[str]


class LocationReport(Report):
    """The report of ``sfmapp locate``; ``others``: poses that explain the points nearly as well."""

    fit: FitReport
    others: Sequence[OtherPoseReport]


class QuantityReport(Report):
    """A measured number; ``mark_share``: of its variance, what the marks contribute."""

    value: float
    sigma: float
    mark_share: float


class FigureReport(Report):
    """A length between two marks; of three or more the way round and the area.

    Attributes:
        corners: in the plane.
        problem: why its sigma is not to be trusted.
    """

    name: str
    corners: Sequence[Sequence[float]]
    length: QuantityReport
    area: QuantityReport | None = None
    problem: str | None = None


class MeasureReport(Report):
    """The report of ``sfmapp measure``."""

    plane: str
    unit: str
    sigma_px: float
    figures: Sequence[FigureReport]


def figure_report(figure: MeasuredFigure) -> FigureReport:
    """A measured figure in plain values."""
    area = figure.area
    return FigureReport(
        name=figure.name, corners=figure.ab.tolist(),
        length=QuantityReport(
            value=figure.length.value, sigma=figure.length.sigma, mark_share=figure.length.mark_share
        ),
        area=None if area is None else QuantityReport(value=area.value, sigma=area.sigma, mark_share=area.mark_share),
        problem="seen along the plane: too far off for its sigma" if figure.is_grazing else None,
    )  # fmt: skip


@dataclass(frozen=True)
class PhotographFacts:
    """What a fit does not know: the name of the photograph, those of its points, and the unit of their places."""

    photograph: str
    names: Sequence[str]
    unit: str


def target_report(fit: TargetFit, facts: PhotographFacts, files: Sequence[CameraFileReport]) -> TargetReport:
    """A calibration from one photograph in plain values."""
    view = fit.view
    reasons = dict.fromkeys(fit.unchecked, "nothing checks it: without it the camera would be open")
    for wrong in fit.wrong:
        text = f"{wrong.distance_px:.1f} px from where the others put it"
        if wrong.swapped_with is not None:
            text += f": it has the place of {facts.names[wrong.swapped_with]}, were they exchanged?"
        reasons[wrong.index] = text
    names = PARAM_NAMES[view.camera.model]
    sigmas = np.zeros(len(names))
    sigmas[view.is_free] = np.sqrt(np.diag(fit.covariance)[:-POSE])
    linear = fit.linear
    return TargetReport(
        fit=_fit(
            (view, fit.covariance, fit.noise), facts, _points(view, facts.names, fit.points[1], fit.distance, reasons),
            fit.calibration(facts.photograph).method, fit.warnings,
        ),
        parameters=[
            ParameterReport(name=name, value=float(value), sigma=float(sigma))
            for name, value, sigma in zip(names, view.camera.params, sigmas, strict=True)
        ],
        linear=None if linear is None else LinearReport(
            rank=linear.rank, singular_values=linear.singular_values.tolist(), noise_level=linear.noise_level
        ),
        tilt_deg=fit.tilt_deg,
        lenses=[
            LensReport(
                model=t.model.name, num_unknown=t.num_unknown, num_used=t.num_used, rms_px=t.rms_px,
                left_out_px=t.left_out_px, is_chosen=t.is_chosen,
            )
            for t in fit.trials
        ],
        files=list(files),
    )  # fmt: skip


def targets_report(
    made: CameraCalibration, fits: Sequence[FitReport], files: Sequence[CameraFileReport]
) -> TargetsReport:
    """A calibration from several photographs in plain values; ``fits``: of those that count."""
    return TargetsReport(
        model=made.camera.model.name, width=made.camera.width, height=made.camera.height,
        parameters=[
            ParameterReport(name=name, value=float(value), sigma=float(sigma))
            for name, value, sigma in zip(made.param_names, made.camera.params, made.sigmas, strict=True)
        ],
        photographs=list(fits),
        lost=[
            LostPhotographReport(photograph=view.name, reason=view.problem)
            for view in made.views if view.problem is not None
        ],
        rms_px=made.rms_px, noise_px=made.noise_px, degrees_of_freedom=made.degrees_of_freedom, method=made.method,
        files=list(files), warnings=list(made.warnings),
    )  # fmt: skip


def location_report(found: Location, facts: PhotographFacts, xy: Array) -> LocationReport:
    """A pose in plain values."""
    reasons = {
        int(i): f"{found.distance[i]:.1f} px from where the others put it" if np.isfinite(found.distance[i])
        else "the lens does not see it from there"
        for i in np.flatnonzero(~found.view.is_used)
    }  # fmt: skip
    return LocationReport(
        fit=_fit(
            (found.view, found.covariance, found.noise), facts,
            _points(found.view, facts.names, xy, found.distance, reasons), found.method, location_warnings(found),
        ),
        others=[
            OtherPoseReport(
                cam_from_world=other.cam_from_world.tolist(), rms_px=other.rms_px, turn_deg=other.turn_deg,
                shift=other.shift,
            )
            for other in found.others
        ],
    )  # fmt: skip


def location_warnings(found: Location) -> list[str]:
    """What a user of a pose has to know."""
    warnings = []
    if found.others:
        other = found.others[0]
        warnings.append(
            f"the points do not tell which of {len(found.others) + 1} poses is true: another is turned by "
            f"{other.turn_deg:.1f} degrees (rms {other.rms_px:.2f} px); use more points, out of one plane"
        )
    if found.noise.source.endswith("is taken"):
        warnings.append(f"barely enough points: {found.noise.source}")
    return warnings


def _fit(
    found: tuple[OneView, Array, Noise], facts: PhotographFacts, points: Sequence[PointReport], method: str,
    warnings: Sequence[str],
) -> FitReport:  # fmt: skip
    view, covariance, noise = found
    return FitReport(
        photograph=facts.photograph, model=view.camera.model.name, width=view.camera.width, height=view.camera.height,
        pose=pose_report(view.cam_from_world, covariance[-POSE:, -POSE:], facts.unit), points=list(points),
        num_used=int(view.is_used.sum()), rms_px=float(np.sqrt(view.squares / max(view.is_used.sum(), 1))),
        noise_px=noise.sigma_px, noise_source=noise.source, degrees_of_freedom=view.degrees_of_freedom, method=method,
        warnings=list(warnings),
    )  # fmt: skip


def pose_report(cam_from_world: Array, covariance: Array, unit: str) -> PoseReport:
    """A pose (7,) in plain values, with covariance (6, 6) over turn and shift of the camera's frame."""
    center = rigid3.center_covariance(cam_from_world, covariance)
    return PoseReport(
        cam_from_world=cam_from_world.tolist(), center=rigid3.center(cam_from_world).tolist(),
        sigma_rotation_deg=np.degrees(np.sqrt(np.diag(covariance)[:3])).tolist(),
        sigma_center=np.sqrt(np.diag(center)).tolist(), unit=unit,
    )  # fmt: skip


def _points(
    view: OneView, names: Sequence[str], xy: Array, distance: Array, reasons: Mapping[int, str]
) -> list[PointReport]:
    expected = xy - view.residual
    return [
        PointReport(
            name=name, marked_px=xy[i].tolist(),
            expected_px=expected[i].tolist() if np.isfinite(expected[i]).all() else None,
            left_out_px=float(distance[i]) if np.isfinite(distance[i]) else None,
            is_used=bool(view.is_used[i]), reason=reasons.get(i),
        )
        for i, name in enumerate(names)
    ]  # fmt: skip


# ------------------------------------------------------------------------------------------------------------ pose.json


class PoseDocument(Report):
    """``pose.json``: a camera where it stood, in pixels whose centres are at halves.

    Attributes:
        covariance: (P + 6, P + 6) of the parameters, a turn of the camera's frame in radians and a shift of it.
        sigma_px: of a mark.
        places: of the points, by name.
    """

    format: str
    photograph: str
    model: str
    width: int
    height: int
    params: Sequence[float]
    cam_from_world: Sequence[float]
    covariance: Sequence[Sequence[float]]
    sigma_px: float
    unit: str
    places: Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class KnownPose:
    """A camera where it stood; see :class:`PoseDocument`."""

    camera: Camera
    cam_from_world: Array
    covariance: Array
    sigma_px: float
    unit: str
    places: Mapping[str, Array]


def write_pose(
    path: Path, pose: tuple[Camera, Array, Array], sigma_px: float, facts: PhotographFacts, xyz: Array
) -> None:
    """Write ``pose.json``.

    Args:
        pose: a camera, its cam_from_world (7,), and the covariance (P + 6, P + 6) of both.
        sigma_px: of a mark. facts, xyz: of the points, (N, 3).

    Raises:
        InputError: it cannot be written.
    """
    camera, cam_from_world, covariance = pose
    document = PoseDocument(
        format=FORMAT, photograph=facts.photograph, model=camera.model.name, width=camera.width, height=camera.height,
        params=camera.params.tolist(), cam_from_world=cam_from_world.tolist(), covariance=covariance.tolist(),
        sigma_px=sigma_px, unit=facts.unit, places=dict(zip(facts.names, xyz.tolist(), strict=True)),
    )  # fmt: skip
    write_document(path, document)


def read_pose(path: Path) -> KnownPose:
    """Read ``pose.json``, or that of the folder that holds one.

    Raises:
        InputError: it cannot be read, or is no such file.
    """
    if path.is_dir() and not (path / POSE_FILE).is_file() and (path / POSES).is_dir():
        names = sorted(one.name for one in (path / POSES).glob("*.json"))
        raise InputError(
            f"{path}: expected the pose of one photograph, found those of {len(names)}",
            f"give one of {path / POSES}: {', '.join(names[:5])}",
        )
    path = path / POSE_FILE if path.is_dir() else path
    document = read_document(
        path, PoseDocument, FORMAT, "the pose of a photograph",
        "give OUT or OUT/pose.json of sfmapp locate, or of sfmapp calibrate target",
    )  # fmt: skip
    if document.model not in MODEL_NAMES:
        raise InputError(f"{path}: expected a camera model, found {document.model!r}", ", ".join(MODEL_NAMES))
    camera = checked_camera(path, 0, document.model, document.width, document.height, document.params)
    size = len(camera.params) + POSE
    pose = finite_array(f"{path}: cam_from_world", document.cam_from_world, (7,))
    length = float(np.linalg.norm(pose[:4]))
    covariance = finite_array(f"{path}: covariance", document.covariance, (size, size))
    if abs(length - 1.0) > 1e-6 or not document.sigma_px > 0.0 or (np.diag(covariance) < 0.0).any():
        raise InputError(f"{path}: expected a unit quaternion, a sigma above zero and a covariance, found others")
    places = {name: finite_array(f"{path}: {name}", xyz, (3,)) for name, xyz in document.places.items()}
    return KnownPose(camera, pose, covariance, document.sigma_px, document.unit, places)
