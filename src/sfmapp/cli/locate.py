"""``sfmapp locate``: where a photograph was taken, from points with known places in it."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.cli.calibrate_target import POINTS, add_point_flags, point_source, print_fit
from sfmapp.cli.common import add_output_flags, limit_library_threads, listening, load_numba_without_blas, tell_result

if TYPE_CHECKING:
    from sfmapp.pipelines.calibration.known_points import LocateResult

EXAMPLES = f"""\
examples:
  sfmapp locate photo.jpg --points points.csv --camera calibration.json -o where/
  sfmapp locate photo.jpg --markers room.csv --dictionary APRILTAG_36H11 --camera camera.yaml -o where/
  sfmapp locate photo.jpg --model out/ --camera out/sparse/0 -o where/
  sfmapp measure marks.csv --pose where/ --plane 0,0,1,0

{POINTS}
Four points or more; three allow up to four poses. A camera that sfmapp has calibrated brings its sigmas along."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "locate", help="where a photograph was taken, from points with known places in it",
        description="Find the pose of a calibrated camera from points with known places in one photograph, how sure it "
        "is, which points are wrong, and whether a second pose explains them as well.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("photograph", metavar="PHOTO", type=Path, help="a photograph")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="output folder, new or empty")
    parser.add_argument("--camera", metavar="FILE", required=True, help="a calibration file of any form")
    add_point_flags(parser)
    parser.add_argument(
        "--model", metavar="DIR", type=Path, help="in place of a table: a folder of reconstruct whose place it shows"
    )
    parser.add_argument(
        "--method", choices=("auto", "p3p", "all"), default="auto",
        help="p3p: samples of three points, of which some may be wrong; all: all points at once, none of them is; "
        "default: p3p where there are more than four",
    )  # fmt: skip
    parser.add_argument(
        "--max-error-px", metavar="PX", type=float, default=8.0,
        help="farthest point that agrees with a pose while it is searched; default: 8",
    )  # fmt: skip
    parser.add_argument("--no-recording", action="store_true", help="do not write recording.rrd")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_locate)


def _locate(args: argparse.Namespace) -> int:
    limit_library_threads()
    load_numba_without_blas()
    from sfmapp.errors import UsageError
    from sfmapp.pipelines.calibration.known_points import PoseSearch, locate

    source = replace(point_source(args, args.points), model=args.model)
    if args.model is not None and (args.points is not None or args.markers is not None):
        raise UsageError("expected one of --points, --markers and --model, found two")
    with listening(args) as events:
        result = locate(
            args.photograph, args.output, source, args.camera, search=PoseSearch(args.method, args.max_error_px),
            sigma_px=args.sigma_px, recording=not args.no_recording, events=events,
        )  # fmt: skip
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: LocateResult) -> None:
    print_fit(result.report.fit)
    print(f"pose {result.output / 'pose.json'}, report {result.output / 'report.html'}")
