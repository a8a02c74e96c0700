"""Photographs or a video of a board to a camera, with every parameter's sigma."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import Fit, TargetView
from sfmapp.calibration.board_guess import BoardGuess
from sfmapp.calibration.boards import Board
from sfmapp.calibration.planning import NextView, mean_sigma, next_views
from sfmapp.calibration.report import (
    BendReport,
    BoardGuessReport,
    BoardPictureReport,
    BoardReport,
    CameraFileReport,
    ClosedFormReport,
    LensTrialReport,
    NextViewReport,
)
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.solve import Solution, ViewFacts, solve_views
from sfmapp.calibration.uncertainty import image_grid, projection_sigma
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.pipelines.calibration.centers import with_points_by
from sfmapp.pipelines.calibration.pictures import BoardPictures, look_at_pictures
from sfmapp.pipelines.calibration.results import outline_of, write_camera, write_recording
from sfmapp.report.calibration_html import render_board_html
from sfmapp.report.model import CalibrateReport
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import CALIBRATE, PAGE, REPORT
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch


@dataclass(frozen=True)
class BoardOptions:
    """What a user may say of a calibration from a board.

    Attributes:
        model: of the lens; None: chosen by views that are held out.
        bends: look whether the board is bent.
        recording: write ``recording.rrd``.
    """

    model: CameraModel | None = None
    bends: bool = True
    recording: bool = True

    def __post_init__(self) -> None:
        if self.model == CameraModel.EQUIRECTANGULAR:
            raise UsageError("model is EQUIRECTANGULAR: a panorama has no parameters to calibrate")


@dataclass(frozen=True)
class CalibrationResult:
    """What was found and written.

    Attributes:
        output: the folder.
        calibration: the camera.
        report: what is in ``report.json``.
    """

    output: Path
    calibration: CameraCalibration
    report: CalibrateReport


def calibrate_board(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    board: Board | None = None,
    options: Options | None = None,
    *,
    asked: BoardOptions | None = None,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> CalibrationResult:
    """Calibrate one camera from photographs of a board.

    Args:
        source: a folder, a glob pattern or a list of photographs, or a video.
        output: a new folder, an empty one, or that of an earlier call.
        board: what they show; None: what several of them agree on, in squares.
        options: of these, those of images and ``threads``.
        asked: for the lens model and the rest; None for the defaults.
        events: progress, decisions, warnings and cancellation.
        watch: started when the run began.

    Raises:
        InputError: nothing to read, fewer than three photographs with a board, views that leave the camera open, or no
            board that photographs agree on.
        UsageError: an output that holds something else.
    """
    asked = asked or BoardOptions()
    with Job.opened(CALIBRATE, source, output, options, events=events, watch=watch) as job:
        with job.stage("detection"):
            pictures = look_at_pictures(job, board)
        job.note_inputs(pictures.digests)
        used, board = pictures.used, pictures.board
        if not used:
            raise InputError(
                f"{job.source}: expected a board {board.text()} in the photographs, found none in "
                f"{len(pictures.pictures)}: {pictures.pictures[0].unused}",
                "check --board: of a chessboard inner corners count, one less than fields",
            )
        with job.stage("calibration"):
            solution, views = _solved(job, pictures, asked)
            again = with_points_by(solution.calibration.camera, pictures, job.threads)
            if again is not None:
                job.events.decided("calibration", "points measured by the camera that was found, then once more")
                pictures = again
                solution, views = _solved(job, pictures, asked)
        with job.stage("plan"):
            made = solution.calibration
            solved = {view.name: view for view in views}
            counted = [solved[view.name] for view in made.views if view.is_used.any()]
            coming = next_views(made, _fit_of(solution, counted), counted, board)
        with job.stage("files"):
            files = write_camera(job.workspace.folder, made)
            report = CalibrateReport(board=_report(pictures, solution, coming, files), run=job.facts())
            job.workspace.write_json(REPORT, report)
            job.workspace.write_text(PAGE, render_board_html(report, made))
        if asked.recording:
            with job.stage("recording"):
                _record(job, board, pictures, made)
        job.workspace.save()
        return CalibrationResult(job.workspace.folder, solution.calibration, report)


def _solved(job: Job, pictures: BoardPictures, asked: BoardOptions) -> tuple[Solution, list[TargetView]]:
    """The camera by the points of the pictures, and these as views of the board."""
    board = pictures.board
    views = [TargetView(one.name, board.points[one.detection.idx], one.detection.xy) for one in pictures.used]
    facts = [_facts(board, len(one.detection.idx), one.detection.sharpness_px) for one in pictures.used]
    solution = solve_views(
        views, pictures.size, asked.model, facts=facts, bends=asked.bends, threads=job.threads, events=job.events,
        unit=board.unit,
    )  # fmt: skip
    return solution, views


def _hull(xy: NDArray[np.float64]) -> list[list[float]]:
    """The convex outline of pixels."""
    import cv2

    found: list[list[float]] = cv2.convexHull(xy.astype(np.float32))[:, 0].astype(np.float64).tolist()
    return found


def _facts(board: Board, num: int, sharpness_px: float) -> ViewFacts:
    # without markers it cannot be told which part of a board a picture shows
    return ViewFacts(sharpness_px, board.tells_part or num == len(board.points))


def _fit_of(solution: Solution, views: Sequence[TargetView]) -> Fit:
    """The fit with the poses of these views alone."""
    poses = {view.name: view.cam_from_target for view in solution.calibration.views}
    return replace(solution.fit, cam_from_target=np.array([poses[view.name] for view in views]))


def _record(job: Job, board: Board, pictures: BoardPictures, made: CameraCalibration) -> None:
    paths = {one.name: str(one.path) for one in pictures.pictures if one.path is not None}
    write_recording(job, made, outline_of(board.points), paths, Path(job.source).name)


def _guess_report(guess: BoardGuess | None) -> BoardGuessReport | None:
    if guess is None:
        return None
    return BoardGuessReport(
        num_agree=guess.num_agree, num_part=guess.num_part, num_other=guess.num_other, num_nothing=guess.num_nothing,
        is_sure=guess.is_sure, notes=guess.notes,
    )  # fmt: skip


def _report(
    pictures: BoardPictures,
    solution: Solution,
    coming: Sequence[NextView],
    files: Sequence[CameraFileReport],
) -> BoardReport:
    board, made, bend = pictures.board, solution.calibration, solution.bend
    fits = {view.name: view for view in made.views}
    rows = []
    for one in pictures.pictures:
        fit = fits.get(one.name)
        num_used = 0 if fit is None else int(fit.is_used.sum())
        problem = None if fit is None else fit.problem
        rows.append(
            BoardPictureReport(
                name=one.name,
                num_points=len(one.detection.idx),
                num_used=num_used,
                rms_px=fit.rms_px if fit is not None and num_used else None,
                unused=one.unused if fit is None or num_used else problem,
                problem=problem if num_used else None,
                picked=one.picked if num_used else None,
                like=one.like,
            )
        )
    sigma = projection_sigma(made, image_grid(made.camera), made.distances[1] if made.distances else None)
    linear = solution.closed_form
    return BoardReport(
        board=board.text(),
        unit=board.unit,
        guess=_guess_report(pictures.guess),
        model=made.camera.model.name,
        width=made.camera.width,
        height=made.camera.height,
        params=dict(zip(made.param_names, made.camera.params.tolist(), strict=True)),
        sigmas=dict(zip(made.param_names, made.sigmas.tolist(), strict=True)),
        correlations=made.correlations.tolist(),
        rms_px=made.rms_px,
        noise_px=made.noise_px,
        degrees_of_freedom=made.degrees_of_freedom,
        num_views=sum(bool(view.is_used.any()) for view in made.views),
        pictures=rows,
        lenses=[
            LensTrialReport(
                model=trial.model.name,
                num_params=len(trial.model.params),
                rms_px=trial.rms_px,
                worst_px=trial.worst_px if np.isfinite(trial.worst_px) else None,
                held_out_px=None if trial.held_out is None else trial.held_out_px,
                reason=trial.reason,
            )
            for trial in solution.trials
        ],
        closed_form=ClosedFormReport(
            rank=linear.rank,
            singular_values=linear.singular_values.tolist(),
            k_matrix=None if linear.k_matrix is None else linear.k_matrix.tolist(),
        ),
        bend=None
        if bend is None
        else BendReport(
            coefficients=bend.coefficients.tolist(),
            sigmas=bend.sigmas.tolist(),
            depth=bend.depth,
            rms_if_flat_px=bend.rms_before_px,
        ),
        bend_note=solution.bend_note,
        median_sigma_px=float(np.nanmedian(sigma)),
        worst_sigma_px=float(np.nanmax(sigma)),
        mean_sigma_px=mean_sigma(made, made.distances[1] if made.distances else None),
        next_views=[
            NextViewReport(hint=view.hint, mean_sigma_px=view.mean_sigma_px, outline=_hull(view.xy)) for view in coming
        ],
        files=list(files),
        warnings=list(made.warnings),
    )
