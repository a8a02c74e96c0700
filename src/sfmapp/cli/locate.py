"""``sfmapp locate``: where photographs were taken, in a finished model, or from points with known places in one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.cli.calibrate_target import POINTS, add_point_flags, point_source, print_fit
from sfmapp.cli.common import (
    add_output_flags,
    limit_library_threads,
    listening,
    print_json,
    tell_result,
)
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.pipelines.calibration.known_points import LocateResult
    from sfmapp.pipelines.sparse.locate import LocatedResult

EXAMPLES = f"""\
examples:
  sfmapp locate photo.jpg --model out/
  sfmapp locate new/*.jpg -m out/ -o where/
  sfmapp locate photo.jpg --points points.csv --camera calibration.json -o where/
  sfmapp locate photo.jpg --markers room.csv --dictionary APRILTAG_36H11 --camera camera.yaml -o where/
  sfmapp measure marks.csv --pose where/ --plane 0,0,1,0

In a model: photographs are matched with those that it was made of; one that may as well have been taken at another
place that looks alike is not located, and the reason says so. The model stays as it is: to add photographs to it, use
sfmapp reconstruct. Exit code 4 if none is located.

{POINTS}
Four points or more; three allow up to four poses. A camera that sfmapp has calibrated brings its sigmas along."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "locate", help="where photographs were taken, in a finished model or from points with known places",
        description="Find the pose of photographs in a finished model, or of a calibrated camera from points with "
        "known places in one photograph, how sure it is, and whether another place explains them as well.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("photographs", metavar="PHOTO", nargs="+", help="photographs; in a model also their folder")
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, help="output folder, new or empty; in a model none is needed"
    )
    parser.add_argument(
        "-m", "--model", metavar="OUT", type=Path, help="a folder of reconstruct whose place the photographs show"
    )
    parser.add_argument(
        "--camera", metavar="FILE", help="a calibration file of any form; default in a model: its own cameras, or EXIF"
    )
    add_point_flags(parser)
    parser.add_argument(
        "--method", choices=("auto", "p3p", "all"), default="auto",
        help="of points: p3p: samples of three points, of which some may be wrong; all: all points at once, none of "
        "them is; default: p3p where there are more than four",
    )  # fmt: skip
    parser.add_argument(
        "--max-error-px", metavar="PX", type=float, default=8.0,
        help="of points: farthest that agrees with a pose while it is searched; default: 8",
    )  # fmt: skip
    parser.add_argument("--no-recording", action="store_true", help="of points: do not write recording.rrd")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_locate, parser=parser)


def _locate(args: argparse.Namespace) -> int:
    limit_library_threads()
    load_numba_sparingly()
    if args.model is not None:
        return _locate_in_model(args)
    from sfmapp.errors import UsageError
    from sfmapp.pipelines.calibration.known_points import PoseSearch, locate

    if len(args.photographs) != 1:
        raise UsageError(
            f"expected one photograph with known points, found {len(args.photographs)}", "give --model OUT"
        )
    if args.output is None or args.camera is None:
        args.parser.error("points need -o DIR and --camera FILE; a model is given by --model OUT")
    with listening(args) as events:
        result = locate(
            args.photographs[0], args.output, point_source(args, args.points), args.camera,
            search=PoseSearch(args.method, args.max_error_px), sigma_px=args.sigma_px,
            recording=not args.no_recording, events=events,
        )  # fmt: skip
    tell_result(args, result, lambda: _print(result))
    return 0


def _locate_in_model(args: argparse.Namespace) -> int:
    from sfmapp.errors import NoReconstructionError, UsageError
    from sfmapp.pipelines.sparse.locate import locate_photographs
    from sfmapp.workspace.usage import Stopwatch

    if args.points is not None or args.markers is not None:
        raise UsageError("expected one of --points, --markers and --model, found two")
    watch = Stopwatch(whole_process=True)
    photographs = args.photographs[0] if len(args.photographs) == 1 else args.photographs
    with listening(args) as events:
        result = locate_photographs(
            photographs, args.model, args.output, camera=args.camera, events=events, watch=watch
        )  # fmt: skip
    code = 0 if result.report.num_located else NoReconstructionError.exit_code
    if args.json:
        output = {} if result.output is None else {"output": str(result.output)}
        print_json({"exit_code": code, **output, **result.report})
    elif not args.quiet:
        _print_located(result)
    return code


def _print_located(result: LocatedResult) -> None:
    report = result.report
    for one in report.photographs:
        same = f" (the same file as {one.same_as})" if one.same_as else ""
        print(f"{one.name}{same}: {one.text}; {one.took.wall_s:.1f} s")
    for name, reason in report.skipped:
        print(f"{name}: skipped: {reason}")
    print(f"{report.num_located} of {len(report.photographs)} photographs located, took {report.run.wall_s:.1f} s")
    if result.output is not None:
        print(f"report {result.output / 'report.html'}")


def _print(result: LocateResult) -> None:
    print_fit(result.report.fit)
    print(f"pose {result.output / 'pose.json'}, report {result.output / 'report.html'}")
