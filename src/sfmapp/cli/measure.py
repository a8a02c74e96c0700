"""``sfmapp measure``: lengths and areas on a plane in one photograph."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.cli.common import add_output_flags, limit_library_threads, print_json
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.calibration.point_reports import FigureReport

EXAMPLES = """\
examples:
  sfmapp measure marks.csv --pose where/                        on the plane Z = 0
  sfmapp measure marks.csv --pose where/ --plane 0,1,0,2.4      on the plane Y = 2.4
  sfmapp measure marks.csv --pose where/ --plane P1,P2,P3       through three of the points of the pose
  sfmapp measure marks.csv --metric door.csv                    without a pose: four known corners tell the plane

A table of marks has a line for each:  name u v
Two marks of one name are a length; three or more, in order, a polygon, of which the way round and the area are told. A
table of known points of a plane has a line for each:  [name] X Y u v"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "measure", help="lengths and areas on a plane in one photograph, with their sigmas",
        description="Measure lengths and areas on a plane in one photograph whose pose is known, or four points of it "
        "are; sigmas count the marks, the pose and the camera.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("marks", metavar="MARKS", type=Path, help="a table of name u v")
    parser.add_argument(
        "--pose", metavar="FILE", type=Path, help="pose.json of locate or calibrate target, or its folder"
    )
    parser.add_argument(
        "--plane", metavar="PLANE", default="0,0,1,0",
        help="a,b,c,d of a X + b Y + c Z = d, or three names of points of the pose; default: 0,0,1,0",
    )  # fmt: skip
    parser.add_argument("--metric", metavar="CSV", type=Path, help="four points of the plane or more: [name] X Y u v")
    parser.add_argument("--camera", metavar="FILE", help="calibration whose distortion is taken away; with --metric")
    parser.add_argument(
        "--opencv-pixels", action="store_true", help="the centre of the first pixel is (0, 0) in tables"
    )
    parser.add_argument(
        "--sigma-px", metavar="PX", type=float, help="standard deviation of a mark; default: that of the pose"
    )
    add_output_flags(parser)
    parser.set_defaults(run=_measure)


def _measure(args: argparse.Namespace) -> int:
    limit_library_threads()
    load_numba_sparingly()
    from sfmapp.pipelines.calibration.known_points import MeasureSource, measure_marks

    source = MeasureSource(args.pose, args.plane, args.metric, args.camera, args.opencv_pixels)
    report = measure_marks(args.marks, source, sigma_px=args.sigma_px)
    if args.json:
        print_json({"exit_code": 0, **report})
    elif not args.quiet:
        print(f"on the plane {report.plane}, with marks to {report.sigma_px:.3g} px:")
        for figure in report.figures:
            print(f"  {_text(figure, report.unit)}")
    return 0


def _text(figure: FigureReport, unit: str) -> str:
    length, area = figure.length, figure.area
    kind = "length" if area is None else "way round"
    text = f"{figure.name}: {kind} {length.value:.6g} +- {length.sigma:.2g} {unit}"
    if area is not None:
        text += f", area {area.value:.6g} +- {area.sigma:.2g} square {unit}"
    text += f" ({(area or length).mark_share:.0%} of the variance from the marks)"
    return text + (f"; {figure.problem}" if figure.problem else "")
