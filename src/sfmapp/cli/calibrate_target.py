"""``sfmapp calibrate target``: a camera from photographs of points with known places."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.camera.names import MODEL_NAMES
from sfmapp.cli.common import (
    add_output_flags,
    limit_library_threads,
    listening,
    tell_result,
    took,
)
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.calibration.point_reports import FitReport, ParameterReport
    from sfmapp.pipelines.calibration.known_points import PointSource, TargetResult
    from sfmapp.pipelines.calibration.known_views import TargetsResult
    from sfmapp.report.model import RunUsage

_NAMES_SHOWN = 10

POINTS = """\
a table of points has a line for each:  [image] [name] X Y Z u v
  separated by commas, semicolons, tabs or spaces, with names of the columns in the first line or without; a unit in
  them (X [mm]) is that of the results; a column image has to have its name. Without Z the points lie in one plane.
  Pixels are those of the file as stored, the centre of the first one at (0.5, 0.5); with --opencv-pixels at (0, 0).
a table of markers has four lines for each:  id corner X Y Z
  with corners 0 to 3 clockwise from the top left of the marker itself."""

EXAMPLES = f"""\
examples:
  sfmapp calibrate target box.jpg --points box.csv -o box/
  sfmapp calibrate target room.jpg --markers room.csv --dictionary DICT_4X4_50 -o room/
  sfmapp calibrate target a.jpg b.jpg c.jpg --points a.csv b.csv c.csv -o cam/
  sfmapp calibrate target photos/ --points all.csv -o cam/       # all.csv has a column image
  sfmapp reconstruct photos/ -o out/ --camera box/calibration.json

{POINTS}
Six points that are not in one plane are needed, twenty and more are good. Points of a plane tell the focal length where
it is tilted against the picture, with the principal point taken as near the middle."""


def add_way(ways: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add this way to the parser."""
    parser = ways.add_parser(
        "target", help="photographs of points with known places, in space or in a plane",
        description="Calibrate from a photograph of points with known places: the direct linear transform, or Tsai's "
        "method where they lie in a plane, refined; points that are wrong are named. Several photographs of one camera "
        "tell it together, and where it stood each time.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "photographs",
        metavar="PHOTO",
        type=Path,
        nargs="+",
        help="a photograph, several of one camera, or their folder",
    )
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="output folder, new or empty")
    add_point_flags(parser, several=True)
    parser.add_argument(
        "--camera-model", choices=MODEL_NAMES, metavar="NAME",
        help="default: PINHOLE, from 20 points on OPENCV or a fisheye; PINHOLE_SKEW finds the skew as well",
    )  # fmt: skip
    parser.add_argument("--no-recording", action="store_true", help="do not write recording.rrd")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_calibrate)


def add_point_flags(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Flags on the points of a photograph, which `locate` has as well; ``several``: tables, one for each photograph."""
    if several:
        parser.add_argument(
            "--points", metavar="CSV", type=Path, nargs="+",
            help="points, [name] X Y Z u v: a table for each photograph, or one with a column image",
        )  # fmt: skip
    else:
        parser.add_argument("--points", metavar="CSV", type=Path, help="points: [name] X Y Z u v")
    parser.add_argument("--markers", metavar="CSV", type=Path, help="corners of markers: id corner X Y Z")
    parser.add_argument("--dictionary", metavar="NAME", help="of the markers, such as DICT_4X4_50")
    parser.add_argument(
        "--opencv-pixels", action="store_true", help="the centre of the first pixel is (0, 0) in tables"
    )
    parser.add_argument(
        "--sigma-px", metavar="PX", type=float, help="standard deviation of a mark; default: from the residuals"
    )


def point_source(args: argparse.Namespace, points: Path | None) -> PointSource:
    """What the flags say of the points, with the table of a photograph."""
    from sfmapp.pipelines.calibration.known_points import PointSource

    return PointSource(points, args.markers, args.dictionary, is_opencv=args.opencv_pixels)


def print_fit(fit: FitReport) -> None:
    """What a fit comes to, and what is wrong with its points."""
    print(
        f"{fit.num_used} of {len(fit.points)} points agree, rms {fit.rms_px:.3f} px, noise of a mark "
        f"{fit.noise_px:.3g} px ({fit.noise_source})"
    )
    wrong = [point for point in fit.points if not point.is_used]
    for point in wrong[:_NAMES_SHOWN]:
        print(f"  WRONG: {point.name}: {point.reason}")
    if len(wrong) > _NAMES_SHOWN:
        print(f"  and {len(wrong) - _NAMES_SHOWN} more, which the report names")
    for warning in fit.warnings:
        print(f"  {warning}")
    pose, axes = fit.pose, "xyz"
    shown = ", ".join(
        f"{axis} {value:.6g} +- {sigma:.2g}"
        for axis, value, sigma in zip(axes, pose.center, pose.sigma_center, strict=True)
    )
    turn = max(pose.sigma_rotation_deg)
    print(f"the camera stood at {shown} {pose.unit}, its rotation is known to {turn:.2g} degrees")


def _calibrate(args: argparse.Namespace) -> int:
    limit_library_threads()
    load_numba_sparingly()
    from sfmapp.camera.names import CameraModel
    from sfmapp.pipelines.calibration.known_points import calibrate_from_target
    from sfmapp.pipelines.calibration.known_views import calibrate_from_targets, photographs_in
    from sfmapp.report.model import RunUsage
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    model = None if args.camera_model is None else CameraModel[args.camera_model]
    photographs = photographs_in(args.photographs, args.points or [])
    sources = [point_source(args, table) for table in args.points or [None]]
    with listening(args) as events:
        if len(photographs) > 1 or len(sources) > 1:
            several = calibrate_from_targets(
                photographs, args.output, sources, camera_model=model, sigma_px=args.sigma_px,
                recording=not args.no_recording, events=events, watch=watch,
            )  # fmt: skip
            tell_result(args, several, lambda: _print_several(several, RunUsage(**watch.read())))
            return 0
        result = calibrate_from_target(
            photographs[0], args.output, sources[0], camera_model=model, sigma_px=args.sigma_px,
            recording=not args.no_recording, events=events, watch=watch,
        )  # fmt: skip
    tell_result(args, result, lambda: _print(result, RunUsage(**watch.read())))
    return 0


def _print(result: TargetResult, run: RunUsage) -> None:
    report = result.report
    print(f"{report.fit.model}: {_values(report.parameters)}")
    print_fit(report.fit)
    print(took(result.output, run))
    print(f"calibration {result.output / 'calibration.json'}, report {result.output / 'report.html'}")


def _print_several(result: TargetsResult, run: RunUsage) -> None:
    report = result.report
    print(f"{report.model}: {_values(report.parameters)}")
    print(f"rms {report.rms_px:.3f} px, noise of a mark {report.noise_px:.3g} px")
    for fit in report.photographs:
        wrong = [point.name for point in fit.points if not point.is_used]
        text = f"  {fit.photograph}: {fit.num_used} of {len(fit.points)} points agree, rms {fit.rms_px:.3f} px"
        print(text + (f"; WRONG: {', '.join(wrong[:_NAMES_SHOWN])}" if wrong else ""))
    for warning in report.warnings:
        print(f"  {warning}")
    print(took(result.output, run))
    print(f"calibration {result.output / 'calibration.json'}, report {result.output / 'report.html'}")


def _values(parameters: Sequence[ParameterReport]) -> str:
    return ", ".join(f"{p.name} {p.value:.6g} +- {p.sigma:.2g}" for p in parameters)
