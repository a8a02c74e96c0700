"""What rigs say of themselves, in ``rig.json`` and in reports."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.calibration.report import BoardPictureReport, CameraFileReport
from sfmapp.reporting import Report


class RigCameraSection(Report):
    """A camera of a rig.

    Attributes:
        params: in the order of COLMAP's model; sigmas of these. cam_from_rig: qx qy qz qw tx ty tz, metres.
        pose_sigmas: of its turn (three, radians) and shift (three, metres) about its own axes; of the first 0.
        noise_px: standard deviation of a measured coordinate. rms_px: root mean square length of the residuals.
        T_cn_cnm1: (4, 4) that takes points of the camera before to this one; absent of the first.
    """

    name: str
    model: str
    width: int
    height: int
    params: Sequence[float]
    sigmas: Sequence[float]
    cam_from_rig: Sequence[float]
    pose_sigmas: Sequence[float]
    noise_px: float
    rms_px: float
    T_cn_cnm1: Sequence[Sequence[float]] | None = None


class RigPair(Report):
    """Two cameras of a rig.

    Attributes:
        second_from_first: qx qy qz qw tx ty tz. rotation: (3, 3) of it.
        covariance: (6, 6) of its turn (radians) and shift (metres) about the axes of the second camera.
        baseline_m, turn_deg: with their sigmas.
        essential, fundamental: (3, 3), x2^T E x1 = 0, of unit norm; the second for pixels without distortion, centres
            at halves, absent where a lens sees 88 degrees off its axis.
        num_points: that both see in one shot. epipolar_rms_px: of their Sampson errors; absent without a point.
        epipolar_map: rms of these by where they are in the first picture, four rows of six cells; null where there are
            fewer than four. by_motion: the two never see a board in one shot, and are joined by how the rig moved.
    """

    first: str
    second: str
    second_from_first: Sequence[float]
    rotation: Sequence[Sequence[float]]
    covariance: Sequence[Sequence[float]]
    baseline_m: float
    baseline_sigma_m: float
    turn_deg: float
    turn_sigma_deg: float
    essential: Sequence[Sequence[float]]
    fundamental: Sequence[Sequence[float]] | None = None
    num_points: int
    epipolar_rms_px: float | None = None
    epipolar_map: Sequence[Sequence[float | None]]
    by_motion: bool


class RigHead(Report):
    """What ``rig.json`` begins with; the cameras, ``cam0`` and so on, follow it.

    Attributes:
        format: this form and its version.
        num_shots: moments at which cameras that see a board see it together.
        widening: by which the sigmas of poses are wider than the noise of the points alone makes them.
        world_from_board: (B, 7) of boards that are fixed to each other.
        bend: (B, 3) shapes of boards that are not flat: z = a u^2 + b v^2 + c u v over their points, u and v from -1 to
            1, metres; absent where they are flat as far as the photographs tell.
        unknowns: names of the rows of the covariance.
        covariance: (S, S) of everything; rows of what was held are 0.
    """

    format: str
    num_shots: int
    noise_px: float
    degrees_of_freedom: int
    widening: float
    pairs: Sequence[RigPair]
    warnings: Sequence[str]
    world_from_board: Sequence[Sequence[float]]
    bend: Sequence[Sequence[float]] | None = None
    unknowns: Sequence[str]
    covariance: Sequence[Sequence[float]]


class RigPhotographs(Report):
    """The photographs of a camera of a rig.

    Attributes:
        source: where they are. is_held: its parameters were given, and stay.
        intrinsics: how they were begun with, or where they are from.
    """

    name: str
    source: str
    is_held: bool
    intrinsics: str
    pictures: Sequence[BoardPictureReport]


class RigReport(Report):
    """What calibrating a rig came to.

    Attributes:
        boards: as ``--board`` has them.
        shots: how it was told which photographs were taken together.
        cameras, result: as in ``rig.json``. photographs: of each camera.
        files: for other programs.
    """

    boards: Sequence[str]
    shots: str
    cameras: Sequence[RigCameraSection]
    result: RigHead
    photographs: Sequence[RigPhotographs]
    files: Sequence[CameraFileReport]
