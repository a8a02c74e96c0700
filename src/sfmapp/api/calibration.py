"""One call: photographs to a camera or a rig with its sigmas, where a photograph was taken, two cameras compared."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.api.jobs import FilePath, options_with
from sfmapp.camera.names import CameraModel
from sfmapp.events import Events
from sfmapp.workspace.options import Options

if TYPE_CHECKING:
    from sfmapp.calibration.comparison import Comparison
    from sfmapp.pipelines.calibration.board import CalibrationResult
    from sfmapp.pipelines.calibration.known_points import LocateResult, PointSource, TargetResult
    from sfmapp.pipelines.calibration.lines import LinesResult
    from sfmapp.pipelines.calibration.rig import RigResult


def calibrate_board(
    source: FilePath,
    output: FilePath,
    board: str,
    options: Options | None = None,
    *,
    model: CameraModel | None = None,
    events: Events | None = None,
) -> CalibrationResult:
    """Calibrate a camera from photographs, or a video, of a board.

    Args:
        source: a folder, a glob pattern or a list of photographs, or a video.
        output: a new folder, an empty one, or that of an earlier call: ``calibration.json``, which every ``camera``
            takes, report, recording, and files for other programs.
        board: as ``sfmapp calibrate board --board`` has it, such as ``chessboard:9x6:0.025`` or
            ``charuco:11x8:0.021:0.01575``: kind, size, and lengths in any unit.
        options: of these, those of images and ``threads``.
        model: of the lens; None: chosen by views that are held out.
        events: told of everything that happens, and can ask the run to stop.

    Returns:
        ``calibration`` with the camera, ``params`` (P,) in COLMAP's order in pixels, their ``covariance`` (P, P) and
        the views with residuals (N, 2) in pixels; the report; the folder.

    Raises:
        UsageError: a board that is none, or an output that holds something else.
        InputError: nothing to read, fewer than three photographs with a board, or views that leave the camera open.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> made = sfmapp.calibrate_board("photos/", "cam/", "chessboard:9x6:0.025").calibration
        >>> print(made.camera.params, made.sigmas)
    """
    from sfmapp.calibration.boards import parse_board
    from sfmapp.pipelines.calibration import board as pipeline

    asked = pipeline.BoardOptions(model)
    return pipeline.calibrate_board(source, output, parse_board(board), options, asked=asked, events=events)


def calibrate_rig(
    sources: Sequence[FilePath],
    output: FilePath,
    boards: Sequence[str],
    options: Options | None = None,
    *,
    model: CameraModel | None = None,
    cameras: Sequence[str | None] = (),
    events: Events | None = None,
) -> RigResult:
    """Calibrate cameras that are mounted together, from photographs that they took at the same moments.

    Args:
        sources: of each camera a folder, a glob pattern or a list of photographs.
        output: a new folder, an empty one, or that of an earlier call: ``rig.json``, which ``odometry`` takes.
        boards: one that is held before the cameras, or several that are fixed to each other; each as for
            :func:`calibrate_board`.
        options: of these, those of images and ``threads``.
        model: of the lenses; None: chosen for each camera by views that are held out.
        cameras: of each source a calibration file whose numbers stay; None, or nothing: found.
        events: told of everything that happens, and can ask the run to stop.

    Returns:
        ``calibration`` with the rig, ``cam_from_rig`` (C, 7) in the unit of the boards, cameras and covariances.

    Raises:
        UsageError: fewer than two sources, a board that is none, or an output that holds something else.
        InputError: photographs of which cannot be told which are of one moment, or that leave the rig open.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> sfmapp.calibrate_rig(["left/", "right/"], "rig/", ["chessboard:9x6:0.025"]).calibration.rig
    """
    from sfmapp.calibration.boards import parse_board
    from sfmapp.pipelines.calibration.rig import calibrate_cameras

    parsed = [parse_board(board) for board in boards]
    return calibrate_cameras(sources, output, parsed, options, model=model, cameras=cameras, events=events)


def calibrate_lines(
    sources: FilePath | Sequence[FilePath],
    output: FilePath,
    options: Options | None = None,
    *,
    events: Events | None = None,
    threads: int | None = None,
) -> LinesResult:
    """Calibrate a camera from the straight lines in photographs of a built place, without a board.

    Args:
        sources: a photograph, several of one camera at one zoom, or a folder, glob pattern or list of them.
        output: a new folder, an empty one, or that of an earlier call: ``calibration.json``, lines, straightened
            photographs, report.
        options: of these, those of images and the seed.
        events: told of everything that happens, and can ask the run to stop.
        threads: files that are read at a time; None: as ``options.threads`` says, or as many as there are cores.

    Returns:
        ``calibration`` of a SIMPLE_DIVISION camera, in pixels; what the lines do not tell has the sigma of what is
        assumed instead.

    Raises:
        UsageError: an output that holds something else.
        InputError: nothing to read, photographs of several sizes, or lines that tell nothing.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> sfmapp.calibrate_lines("street.jpg", "cam/").calibration.sigmas
    """
    from sfmapp.pipelines.calibration import lines as pipeline

    several = [sources] if isinstance(sources, str) or not isinstance(sources, Sequence) else list(sources)
    return pipeline.calibrate_lines(several, output, options_with(options, threads), events=events)


def calibrate_target(
    photograph: FilePath,
    output: FilePath,
    points: FilePath,
    *,
    model: CameraModel | None = None,
    dictionary: str | None = None,
    sigma_px: float | None = None,
    events: Events | None = None,
) -> TargetResult:
    """Calibrate a camera from one photograph of points with known places.

    Args:
        photograph: a file.
        output: a new folder, an empty one, or that of an earlier call: ``calibration.json``, ``pose.json``, report.
        points: a CSV of ``[name] X Y Z u v``, in any unit and in pixels of the file; with ``dictionary`` one of the
            places of corners of markers, ``id corner X Y Z``.
        model: of the lens; None: PINHOLE, from 20 points on OPENCV or OPENCV_FISHEYE.
        dictionary: of the markers, such as ``DICT_4X4_50``.
        sigma_px: standard deviation of a marked coordinate; None: as the residuals tell.
        events: told of decisions and warnings.

    Returns:
        ``fit`` with the camera, its pose (7,) ``cam_from_world``, covariance, and the points that are wrong.

    Raises:
        UsageError: an output that holds something else.
        InputError: the photograph or the points cannot be read, or tell no camera.
        NoReconstructionError: they leave the focal length open.

    Example:
        >>> sfmapp.calibrate_target("box.jpg", "box/", "box.csv").fit.view.camera
    """
    from sfmapp.pipelines.calibration.known_points import calibrate_from_target

    source = _point_source(points, dictionary)
    return calibrate_from_target(photograph, output, source, camera_model=model, sigma_px=sigma_px, events=events)


def locate(
    photograph: FilePath,
    output: FilePath,
    camera: FilePath,
    points: FilePath,
    *,
    dictionary: str | None = None,
    sigma_px: float | None = None,
    events: Events | None = None,
) -> LocateResult:
    """Find where a photograph was taken, from points with known places in it.

    :func:`locate_photographs` finds photographs in a reconstruction.

    Args:
        photograph: a file.
        output: a new folder, an empty one, or that of an earlier call: ``pose.json`` and the report.
        camera: a calibration file of any form; one of ours brings its covariance along.
        points: as for :func:`calibrate_target`, four or more.
        dictionary: of the markers, where the points are such.
        sigma_px: standard deviation of a marked coordinate; None: as the residuals tell.
        events: told of decisions and warnings.

    Returns:
        ``location`` with the pose (7,) ``cam_from_world`` in the unit of the points, its covariance over rotation in
        radians and translation, the points that are wrong, and other poses that explain them nearly as well.

    Raises:
        UsageError: an output that holds something else.
        InputError: the photograph, the points or the camera cannot be read.
        NoReconstructionError: no pose agrees with the points, or they leave it open.

    Example:
        >>> sfmapp.locate("photo.jpg", "where/", "cam/", "points.csv").location.view.cam_from_world
    """
    from sfmapp.pipelines.calibration import known_points as pipeline

    source = _point_source(points, dictionary)
    return pipeline.locate(photograph, output, source, str(camera), sigma_px=sigma_px, events=events)


def compare_cameras(first: FilePath, second: FilePath) -> Comparison:
    """Compare two calibrations that sfmapp has made: are they of the same camera?

    Args:
        first: ``calibration.json``, or the folder that holds it.
        second: the other.

    Returns:
        ``difference`` (N, 2) in pixels between where both put the same rays, at places ``xy`` (N, 2) all over the
        picture, after the best turn; ``sigma`` (N,) of a coordinate of it by both; ``is_same`` as far as they tell.

    Raises:
        InputError: one of them cannot be read, or they are for pictures of different sizes.

    Example:
        >>> sfmapp.compare_cameras("cam/", "cam-last-year/").is_same
    """
    from sfmapp.calibration.comparison import compare
    from sfmapp.calibration.file import read_calibration_file

    return compare(read_calibration_file(Path(first)), read_calibration_file(Path(second)))


def _point_source(points: FilePath, dictionary: str | None) -> PointSource:
    """Where points are from: a table is one of markers where they have a dictionary."""
    from sfmapp.pipelines.calibration.known_points import PointSource

    path = Path(points)
    return PointSource(points=path) if dictionary is None else PointSource(markers=path, dictionary=dictionary)
