"""Photographs of boards by cameras that are mounted together, to a rig with every sigma."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.boards import Board
from sfmapp.calibration.report import BoardPictureReport, CameraFileReport
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.calibration.rig import RigCalibration, calibrate_rig
from sfmapp.calibration.rig_adjustment import RigView
from sfmapp.calibration.rig_ends import read_from_one_end
from sfmapp.calibration.rig_file import rig_cameras, rig_head, write_rig
from sfmapp.calibration.rig_report import RigPhotographs, RigReport
from sfmapp.calibration.solve import solve_views
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.fields import camera_from_text, is_calibration_path
from sfmapp.camera_files.reading import read_calibration
from sfmapp.camera_files.rig_writing import write_rig_files
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.images.video import is_video
from sfmapp.pipelines.calibration.centers import with_points_by
from sfmapp.pipelines.calibration.pictures import BoardPictures, look_at_pictures
from sfmapp.pipelines.calibration.results import note_recording, outline_of, write_camera
from sfmapp.pipelines.calibration.shots import match_shots
from sfmapp.report.model import CalibrateRigReport
from sfmapp.report.rig_html import render_rig_html
from sfmapp.viewer.rig_recording import ShownView, record_rig
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import CALIBRATE, PAGE, REPORT
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

STAGE = "calibration"
RIG = "rig.json"


@dataclass(frozen=True)
class RigResult:
    """What was found and written.

    Attributes:
        output: the folder.
        calibration: the rig.
        report: what is in ``report.json``.
    """

    output: Path
    calibration: RigCalibration
    report: CalibrateRigReport


@dataclass(frozen=True)
class _Seen:
    """A camera of the rig: its photographs, what was found of each board in them, and its lens."""

    name: str
    source: str
    of_board: tuple[BoardPictures, ...]
    camera: Camera | None = None
    is_held: bool = False
    intrinsics: str = ""


def calibrate_cameras(
    sources: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    boards: Sequence[Board],
    options: Options | None = None,
    *,
    model: CameraModel | None = None,
    cameras: Sequence[str | None] = (),
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> RigResult:
    """Calibrate cameras that are mounted together, from photographs that they took at the same moments.

    Args:
        sources: of each camera a folder, a glob pattern or a list of photographs.
        output: a new folder, an empty one, or that of an earlier call.
        boards: one that is held before the cameras, or several that are fixed to each other.
        options: of these, those of images and ``threads``.
        model: of the lenses; None: chosen for each camera by views that are held out.
        cameras: of each source a calibration file or ``MODEL,PARAMETERS`` whose numbers stay; None, or nothing: found.
        events: progress, decisions, warnings and cancellation.
        watch: started when the run began.

    Raises:
        InputError: nothing to read, photographs that cannot be told to be of one moment, or that leave the rig open.
        UsageError: fewer than two sources, more cameras than sources, or an output that holds something else.
    """
    texts = [os.fspath(source) for source in sources]
    _check(texts, cameras, model)
    with Job.opened(CALIBRATE, texts[0], output, options, events=events, watch=watch) as job:
        with job.stage("detection"):
            seen = [_looked_at(job, name, text, boards) for name, text in zip(_names(texts), texts, strict=True)]
        job.note_inputs({f"{one.name}/{name}": d for one in seen for name, d in one.of_board[0].digests.items()})
        names = [[picture.name for picture in one.of_board[0].pictures] for one in seen]
        shots, told = match_shots(texts, names)
        job.events.decided(STAGE, told)
        with job.stage("calibration"):
            given = [*cameras, *[None] * (len(seen) - len(cameras))]
            seen = [_with_lens(job, one, boards, text, model) for one, text in zip(seen, given, strict=True)]
            views = read_from_one_end(_views(seen, boards, shots), boards, [_lens(one) for one in seen])
            # the shape of a board is seen only where it is known which of its points are which
            bends = all(
                boards[view.board].kind != "chessboard" or len(view.view.xy) == len(boards[view.board].points)
                for view in views
            )
            found = calibrate_rig(
                [one.name for one in seen], [_lens(one) for one in seen], [one.is_held for one in seen], views,
                bends=bends,
            )  # fmt: skip
        for warning in found.warnings:
            job.events.warned(STAGE, warning)
        with job.stage("files"):
            files = _write(job.workspace.folder, found)
            _record(job, seen, views, found)
        rig = RigReport(
            boards=[board.text() for board in boards], shots=told, cameras=rig_cameras(found), result=rig_head(found),
            photographs=[_photographs(one, fit.views) for one, fit in zip(seen, found.cameras, strict=True)],
            files=files,
        )  # fmt: skip
        report = CalibrateRigReport(rig=rig, run=job.facts())
        job.workspace.write_json(REPORT, report)
        job.workspace.write_text(PAGE, render_rig_html(report, found))
        job.workspace.save()
        return RigResult(job.workspace.folder, found, report)


def _check(sources: Sequence[str], cameras: Sequence[str | None], model: CameraModel | None) -> None:
    if len(sources) < 2:
        raise UsageError(f"rig: expected photographs of two cameras or more, found {len(sources)} source")
    if len(cameras) > len(sources):
        raise UsageError(f"rig: expected --camera once for each of {len(sources)} sources, found {len(cameras)}")
    if model == CameraModel.EQUIRECTANGULAR:
        raise UsageError("model is EQUIRECTANGULAR: a panorama has no parameters to calibrate")
    films = [source for source in sources if is_video(source)]
    if films:
        raise UsageError(
            f"rig: expected photographs, found the video {films[0]}: which frames of two videos were taken together "
            "cannot be told",
            "write the frames into folders, with the same number for the same moment",
        )


def _names(sources: Sequence[str]) -> list[str]:
    """Names of cameras: those of their folders, where they differ."""
    names = [Path(source).name for source in sources]
    is_plain = all(Path(source).is_dir() for source in sources) and len(set(names)) == len(names)
    return names if is_plain else [f"cam{n}" for n in range(len(sources))]


def _looked_at(job: Job, name: str, source: str, boards: Sequence[Board]) -> _Seen:
    own = replace(job, source=source)
    return _Seen(name, source, tuple(look_at_pictures(own, board) for board in boards))


def _lens(one: _Seen) -> Camera:
    assert one.camera is not None
    return one.camera


def _with_lens(job: Job, one: _Seen, boards: Sequence[Board], given: str | None, model: CameraModel | None) -> _Seen:
    """The camera that was given for it, or the one that its own photographs tell."""
    size = one.of_board[0].size
    if given is not None:
        camera = read_calibration(given, [size]).rig.cameras[0] if is_calibration_path(given) else None
        camera = camera_from_text(given, size) if camera is None else camera
        one = replace(one, camera=camera, is_held=True, intrinsics=f"held as {given} has them")
        return _with_points_by(job, one, camera) or one
    made = _calibrated(job, one, boards, model)
    again = _with_points_by(job, one, made.camera)
    if again is not None:
        one, made = again, _calibrated(job, again, boards, model)
    text = f"begun with those of its {len(made.views)} photographs alone, rms {made.rms_px:.3f} px"
    return replace(one, camera=made.camera, intrinsics=text)


def _calibrated(job: Job, one: _Seen, boards: Sequence[Board], model: CameraModel | None) -> CameraCalibration:
    """A camera by its own photographs."""
    views = [
        TargetView(picture.name, board.points[picture.detection.idx], picture.detection.xy)
        for board, pictures in zip(boards, one.of_board, strict=True)
        for picture in pictures.used
    ]
    try:
        size = one.of_board[0].size
        return solve_views(
            views, size, model, bends=False, threads=job.threads, events=job.events
        ).calibration  # fmt: skip
    except InputError as error:
        raise InputError(f"{one.name}: {error}", "give its intrinsics with --camera, or more photographs") from error


def _with_points_by(job: Job, one: _Seen, camera: Camera) -> _Seen | None:
    """With the points that its camera gives its photographs; None where that changes nothing."""
    found = [with_points_by(camera, pictures, job.threads) for pictures in one.of_board]
    if not any(found):
        return None
    return replace(one, of_board=tuple(new or old for new, old in zip(found, one.of_board, strict=True)))


def _views(seen: Sequence[_Seen], boards: Sequence[Board], shots: Sequence[dict[int, int]]) -> list[RigView]:
    """Every board in every photograph. Photographs without a partner, and boards without markers that are seen in
    part, of which nobody knows which part, have shots of their own: they tell of the lens."""
    shot_of = {(camera, n): t for t, shot in enumerate(shots) for camera, n in shot.items()}
    views, alone = [], len(shots)
    for c, one in enumerate(seen):
        for b, (board, pictures) in enumerate(zip(boards, one.of_board, strict=True)):
            for n, picture in enumerate(pictures.pictures):
                if picture.unused is not None:
                    continue
                idx = picture.detection.idx
                is_known = board.tells_part or len(idx) == len(board.points)
                shot = shot_of.get((c, n)) if is_known else None
                if shot is None:
                    shot, alone = alone, alone + 1
                view = TargetView(picture.name, board.points[idx], picture.detection.xy)
                views.append(RigView(c, shot, b, view))
    return views


def _write(folder: Path, found: RigCalibration) -> list[CameraFileReport]:
    write_rig(folder / RIG, found)
    written = [
        CameraFileReport(name=one.name, program=one.program, max_px=one.max_px, reason=one.reason)
        for one in write_rig_files(folder, found.rig, found.names)
    ]
    for name, camera in zip(found.names, found.cameras, strict=True):
        (folder / name).mkdir(exist_ok=True)
        written += [
            one if one.reason is not None else CameraFileReport(
                name=f"{name}/{one.name}", program=one.program, max_px=one.max_px)
            for one in write_camera(folder / name, camera, name)
        ]  # fmt: skip
    return written


def _record(job: Job, seen: Sequence[_Seen], views: Sequence[RigView], found: RigCalibration) -> None:
    """Cameras and boards for rerun; a failure is a warning."""
    # a photograph shows several boards, whose fits are told apart by their points
    of_points = {(view.camera, view.view.xy.tobytes()): view for view in views}
    shown = []
    for c, made in enumerate(found.cameras):
        for fit in made.views:
            view = of_points.get((c, fit.xy.tobytes()))
            if view is not None:
                shown.append(ShownView(c, view.shot, outline_of(view.view.xyz), fit))
    paths = {
        (c, picture.name): str(picture.path)
        for c, one in enumerate(seen)
        for picture in one.of_board[0].pictures
        if picture.path is not None
    }
    cameras = list(zip(found.names, found.cameras, strict=True))
    told = record_rig(job.workspace.recording, found.rig, cameras, shown, paths, " and ".join(found.names))
    note_recording(job, told)


def _photographs(one: _Seen, fits: Sequence[ViewFit]) -> RigPhotographs:
    by_name: dict[str, list[ViewFit]] = {}
    for fit in fits:
        by_name.setdefault(fit.name, []).append(fit)
    rows = []
    for n, picture in enumerate(one.of_board[0].pictures):
        mine = by_name.get(picture.name, [])
        num_used = sum(int(fit.is_used.sum()) for fit in mine)
        square = sum(float((fit.residuals[fit.is_used] ** 2).sum()) for fit in mine)
        rows.append(BoardPictureReport(
            name=picture.name, num_points=sum(len(pictures.pictures[n].detection.idx) for pictures in one.of_board),
            num_used=num_used, rms_px=(square / num_used) ** 0.5 if num_used else None,
            unused=None if mine else picture.unused, problem=next((fit.problem for fit in mine if fit.problem), None),
        ))  # fmt: skip
    return RigPhotographs(
        name=one.name, source=one.source, is_held=one.is_held, intrinsics=one.intrinsics, pictures=rows
    )
