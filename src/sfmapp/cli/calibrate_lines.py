"""``sfmapp calibrate lines``: a camera from the straight lines of buildings, without a board."""

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
    from sfmapp.pipelines.calibration.lines import LinesResult

EXAMPLES = """\
examples:
  sfmapp calibrate lines house.jpg -o out/
  sfmapp calibrate lines street/*.jpg -o out/
  sfmapp reconstruct photos/ -o model/ --camera out/calibration.json

Photographs of a built place by one camera at one zoom, best across the corner of a house or a room, with long edges out
to the borders. Straight edges tell the distortion; edges that run in directions at right angles tell the focal length,
and where three directions recede, the principal point. What lines do not tell is named and left alone: in a frontal
view the focal length stays a default with a sigma of 60 per cent. The lens is SIMPLE_DIVISION.

Writes
  OUT/calibration.json   for --camera; with the covariance
  OUT/report.html        what is told and why; report.json has the same
  OUT/recording.rrd      lines, their planes through the camera and where they vanish, for rerun
  OUT/lines/NAME.jpg     edges in the colours of their directions
  OUT/undistorted/NAME.jpg
and the camera for other programs, where they know the lens."""


def add_way(ways: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add this way to the parser."""
    parser = ways.add_parser(
        "lines", help="from straight lines of buildings, without a board",
        description="Distortion, focal length and principal point from the straight lines of photographs.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("photos", metavar="PHOTO", nargs="+", help="photographs, or a folder or glob pattern of them")
    parser.add_argument("-o", "--output", metavar="DIR", required=True, help="output folder, new or empty")
    parser.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    parser.add_argument("--seed", metavar="N", help="of the search; default: 0")
    parser.add_argument("--no-recording", action="store_true", help="do not write recording.rrd")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_calibrate)


def _calibrate(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"images.mask_path": args.mask_path, "seed": args.seed})
    load_numba_sparingly()
    from sfmapp.pipelines.calibration.lines import calibrate_lines
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = calibrate_lines(
            args.photos, args.output, options, recording=not args.no_recording, events=events, watch=watch
        )
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: LinesResult) -> None:
    """A line for each parameter, and where the files are."""
    for one in result.report.lines.parameters:
        print(f"{one.name}: {one.verdict}, {one.value:.5g} +- {one.sigma:.2g}; {one.reason}")
    for warning in result.report.lines.warnings:
        print(f"warning: {warning}")
    print(took(result.output, result.report.run))
    print(f"camera {result.output / 'calibration.json'}, report {result.output / 'report.html'}")
