"""``sfmapp calibrate rig``: cameras that are mounted together."""

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
    from sfmapp.pipelines.calibration.rig import RigResult

EPILOG = f"""\
{BOARD_FORMS}

Photographs of one moment have the same name in every folder, or the same last number, or else the same place in order.
One board that is held before the cameras is enough where pictures overlap. Cameras that share no view are joined by
motion: fix a board before each, all boards to each other (--board once for each), and move the rig, turning it about
two axes.

examples:
  sfmapp calibrate rig left/ right/ -o rig/ --board chessboard:9x6:0.025
  sfmapp calibrate rig 'calib/left*.jpg' 'calib/right*.jpg' -o rig/ --board chessboard:9x6:0.025 --camera-model OPENCV
  sfmapp odometry walk/ -o out/ --camera rig/rig.json

writes
  OUT/rig.json           cameras, poses and the covariance of everything; give it to --camera of odometry
  OUT/camchain.yaml, OUT/stereo.yaml, OUT/rig_config.json   for Kalibr, OpenCV and COLMAP
  OUT/CAMERA/            calibration.json of each camera, and its files for other programs
  OUT/report.html, OUT/report.json, OUT/recording.rrd"""


def add_way(ways: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add this way to the parser."""
    parser = ways.add_parser(
        "rig", help="cameras that are mounted together, from boards that they photograph at the same moments",
        description="Calibrate two or more cameras together: intrinsics, poses in the rig and the sigmas of all of it.",
        epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "sources", metavar="INPUT", nargs="+", help="for each camera a folder, a quoted glob pattern or a list"
    )
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help="output folder, new or empty")
    parser.add_argument(
        "--board", metavar="BOARD", action="append", required=True,
        help="what is photographed; repeat it for boards that differ and are fixed to each other",
    )  # fmt: skip
    parser.add_argument(
        "--camera", metavar="MODEL,...|FILE|free", action="append", default=[],
        help="intrinsics that stay, once for each INPUT in order; free: find them, as without --camera",
    )  # fmt: skip
    parser.add_argument(
        "--camera-model", dest="model", type=str.upper, choices=MODEL_NAMES, metavar="MODEL",
        help="lens model, one of COLMAP's and others; default: for each camera by views that are held out",
    )  # fmt: skip
    parser.add_argument("--threads", metavar="N", help="number of workers, default: all cores")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_rig)


def _rig(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"threads": args.threads})
    load_numba_sparingly()
    from sfmapp.calibration.boards import parse_board
    from sfmapp.camera.names import CameraModel
    from sfmapp.pipelines.calibration.rig import calibrate_cameras
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = calibrate_cameras(
            args.sources, args.output, [parse_board(text) for text in args.board], options,
            model=None if args.model is None else CameraModel[args.model],
            cameras=[None if text == "free" else text for text in args.camera], events=events, watch=watch,
        )  # fmt: skip
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: RigResult) -> None:
    rig = result.report.rig
    print(f"{len(rig.cameras)} cameras, {rig.result.num_shots} shots with two of them ({rig.shots})")
    for camera, photos, made in zip(rig.cameras, rig.photographs, result.calibration.cameras, strict=True):
        print(f"{camera.name}: {camera.model}, rms {camera.rms_px:.3f} px, {photos.intrinsics}")
        for name, value, sigma in zip(made.param_names, camera.params, camera.sigmas, strict=True):
            print(f"  {name:<6} {value:13.6g} {'held' if photos.is_held else f'+- {sigma:.2g}'}")
    for pair in rig.result.pairs:
        seen = "joined by motion" if pair.by_motion else f"{pair.num_points} points in common"
        error = "" if pair.epipolar_rms_px is None else f", epipolar error {pair.epipolar_rms_px:.3f} px rms"
        print(
            f"{pair.first} and {pair.second}: {1000 * pair.baseline_m:.2f} +- {1000 * pair.baseline_sigma_m:.2g} mm "
            f"apart, {pair.turn_deg:.3f} +- {pair.turn_sigma_deg:.2g} degrees, {seen}{error}"
        )
    print(took(result.output, result.report.run))
    print(f"rig {result.output / 'rig.json'}, report {result.output / 'report.html'}")
