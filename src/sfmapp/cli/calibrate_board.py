"""``sfmapp calibrate board``: a camera from photographs or a video of a board."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.calibration.board_forms import BOARD_FORMS
from sfmapp.camera.names import MODEL_NAMES
from sfmapp.cli.common import (
    add_output_flags,
    limit_library_threads,
    listening,
    options_of,
    tell_result,
    took,
)
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.pipelines.calibration.board import CalibrationResult

# so many pictures that stand out are named on the terminal; a video has more
_LINES = 15

EPILOG = f"""\
{BOARD_FORMS}

writes
  OUT/calibration.json   the camera with its covariances; give it, or OUT, to --camera of reconstruct and odometry
  OUT/cameras.txt, OUT/opencv.yaml, OUT/camchain.yaml, OUT/camera_info.yaml
                         the same for COLMAP, OpenCV, Kalibr and ROS, where they have words for the lens
  OUT/report.html, OUT/report.json, OUT/recording.rrd
                         residuals, coverage, sigmas over the picture, and what to photograph next"""


def add_way(ways: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add this way to the parser."""
    parser = ways.add_parser(
        "board", help="from a chessboard, ChArUco board, circle grid or AprilGrid",
        description="Calibrate a camera from photographs or a video of a board, after Zhang: ten or more views, tilted "
        "by 20 to 50 degrees about both axes, out to the corners of the picture.",
        epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("source", metavar="INPUT", help="a folder, a glob pattern or a list of photographs, or a video")
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help="output folder, new or empty")
    parser.add_argument(
        "--board", metavar="BOARD",
        help="what is photographed; see below. Default: what several photographs agree on, with lengths in squares",
    )  # fmt: skip
    parser.add_argument(
        "--camera-model", dest="model", type=str.upper, choices=MODEL_NAMES, metavar="MODEL",
        help="lens model, one of COLMAP's and others; default: by views that are held out",
    )  # fmt: skip
    parser.add_argument("--flat", action="store_true", help="do not look whether the board is bent")
    parser.add_argument("--no-recording", action="store_true", help="do not write recording.rrd")
    parser.add_argument("--threads", metavar="N", help="number of workers, default: all cores")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_board)


def _board(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"threads": args.threads})
    load_numba_sparingly()
    from sfmapp.calibration.boards import parse_board
    from sfmapp.camera.names import CameraModel
    from sfmapp.pipelines.calibration.board import BoardOptions, calibrate_board
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    model = None if args.model is None else CameraModel[args.model]
    asked = BoardOptions(model, bends=not args.flat, recording=not args.no_recording)
    with listening(args) as events:
        result = calibrate_board(
            args.source, args.output, None if args.board is None else parse_board(args.board), options,
            asked=asked, events=events, watch=watch,
        )  # fmt: skip
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: CalibrationResult) -> None:
    made = result.calibration
    report = result.report.board
    if report.guess is not None:
        sure = "" if report.guess.is_sure else "not surely "
        print(f"board {report.board}: {sure}told by {report.guess.num_agree} photographs; lengths in {report.unit}")
    print(
        f"{report.model} of {report.num_views} views, {report.width}x{report.height}: rms {report.rms_px:.3f} px, "
        f"noise {report.noise_px:.3f} px a coordinate"
    )
    for name, value, sigma in zip(made.param_names, made.camera.params, made.sigmas, strict=True):
        print(f"  {name:<6} {value:13.6g} +- {sigma:.2g}")
    print(
        f"sigma of a projection over the picture: {report.mean_sigma_px:.4f} px in the mean, "
        f"{report.worst_sigma_px:.4f} px at worst"
    )
    odd = [
        f"  {one.name}: {one.unused or one.problem}"
        for one in report.pictures if (one.unused or one.problem) and not one.like
    ]  # fmt: skip
    num_alike = sum(one.like is not None for one in report.pictures)
    print("".join(f"{line}\n" for line in odd[:_LINES]), end="")
    if len(odd) > _LINES:
        print(f"  and {len(odd) - _LINES} more, in report.html")
    if num_alike:
        print(f"  frames that show what others show, and were not needed: {num_alike}")
    for warning in made.warnings:
        print(f"  note: {warning}")
    for n, view in enumerate(report.next_views, 1):
        print(f"  photograph next, {n}: {view.hint}; then {view.mean_sigma_px:.4f} px")
    print(took(result.output, result.report.run))
    print(f"calibration {result.output / 'calibration.json'}, report {result.output / 'report.html'}")
