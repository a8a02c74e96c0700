"""``sfmapp uncalibrated``: a model of photographs without any calibration, projective first."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

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
    from sfmapp.pipelines.uncalibrated import UncalibratedResult

EXAMPLES = """\
examples:
  sfmapp uncalibrated photos/ -o open/
  sfmapp uncalibrated photos/ -o open/ --points known.csv

Cameras of eleven free numbers and points in a projective frame, from matched pixels alone; then what such a frame
leaves open, and what closes it: five known points or more, or that all photographs are of one camera with square
pixels. Motions that leave the camera open (no turns, turns about one axis) are named.

Writes
  OUT/report.html              the steps, and clouds to be turned; opens without a network
  OUT/report.json              every number in it
  OUT/cameras_projective.json  the 3 x 4 matrices
  OUT/points.ply, OUT/sparse   the metric points; by self-calibration a model in COLMAP's format
  OUT/recording.rrd            the clouds for rerun: sfmapp view OUT"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "uncalibrated", help="a model without any calibration: projective, then metric by known points or one camera",
        description="Projective reconstruction, and its upgrade.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("images", metavar="IMAGES", help="folder of photographs, or a glob pattern")
    parser.add_argument("-o", "--output", metavar="DIR", required=True, help="output folder, new or empty")
    parser.add_argument(
        "--points", metavar="FILE", help="known points and their pixels: a CSV or gcp_list.txt, as of reconstruct --gcp"
    )
    parser.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    parser.add_argument("--seed", metavar="N", help="where every random choice starts")
    parser.add_argument(
        "--threads", metavar="N", help="number of workers, default: all cores; results do not depend on it"
    )
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_uncalibrated)


def _uncalibrated(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"threads": args.threads, "images.mask_path": args.mask_path, "seed": args.seed})
    load_numba_sparingly()
    from sfmapp.pipelines.uncalibrated import reconstruct_uncalibrated
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = reconstruct_uncalibrated(
            args.images, args.output, options, points=args.points, events=events, watch=watch
        )
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: UncalibratedResult) -> None:
    """A result in a few lines."""
    report = result.report
    told = report.projective
    print(
        f"projective: {told.num_cameras} of {told.num_images} photographs, {told.num_points} points, "
        f"{told.rms_px:.3f} px"
    )
    if report.refused:
        print(f"no metric model: {report.refused}")
    if report.known_points is not None:
        known = report.known_points
        print(f"by {known.num_used} of {len(known.points)} known points, condition {known.condition:.0f}")
        for one in known.points:
            if not one.is_used:
                print(f"  not used: {one.name}, in {one.num_images} photographs" + _away(one.distance))
    if report.self_calibration is not None:
        one_camera = report.self_calibration
        sigma = one_camera.focal_sigma_px
        print(
            f"one camera: focal length {one_camera.focal_px:.1f} \N{PLUS-MINUS SIGN} {sigma:.2g} px, "
            f"{one_camera.rms_px:.3f} px"
        )
        for warning in one_camera.warnings:
            print(f"  {warning}")
    print(took(result.output, report.run))
    print(f"page {result.output / 'report.html'}")


def _away(distance: float | None) -> str:
    return "" if distance is None else f", {distance:.4g} from where the others put it"
