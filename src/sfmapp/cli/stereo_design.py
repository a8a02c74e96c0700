"""``sfmapp stereo-design``: what a stereo rig will measure, before it is built."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.cli.common import add_output_flags, print_json

if TYPE_CHECKING:
    from sfmapp.stereo.design import DesignReport, RigStudy

EXAMPLES = """\
examples:
  sfmapp stereo-design --focal 20mm --pixel 30/mm --size 1280x960 --baseline 100mm 500mm --range 2m --disparity-error 2
  sfmapp stereo-design --focal 1200 --size 1920x1080 --baseline 12cm --range 0.5m 20m --wanted-error 2cm -o rig.html
  sfmapp stereo-design --focal 1200 --size 1920x1080 --baseline 30cm --range 0.5m 3m --fixate 1m"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command of this family to the parser."""
    parser = commands.add_parser(
        "stereo-design", help="what a stereo rig will measure: depth errors, common view, the baseline to choose",
        description="Depth errors, common field of view, least and greatest depth and the surface of disparity 0 of "
        "two equal cameras, for parallel axes and converging ones, and the baseline that a wanted error needs.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--focal", metavar="F", required=True, help="focal length: pixels, or 8mm with --pixel")
    parser.add_argument("--pixel", metavar="SIZE", help="width of a pixel, 3.75um, or how many a millimetre has, 30/mm")
    parser.add_argument("--size", metavar="WxH", required=True, help="of a picture, pixels")
    parser.add_argument("--baseline", metavar="B", nargs="+", required=True, help="distance of the centres: 12cm")
    parser.add_argument(
        "--range", metavar="Z", nargs="+", required=True, help="a depth, or the nearest and the farthest: 0.5m 20m"
    )
    axes = parser.add_mutually_exclusive_group()
    axes.add_argument("--converging", metavar="DEG", type=float, help="angle between the axes; default: parallel")
    axes.add_argument("--fixate", metavar="Z", help="the axes meet at this distance: 2m")
    parser.add_argument(
        "--disparity-error", metavar="PX", type=float, default=1.0, help="largest error of a disparity; default: 1"
    )
    parser.add_argument("--baseline-error", metavar="B", help="largest error of the baseline: 0.1mm; default: none")
    parser.add_argument(
        "--focal-error", metavar="PX", type=float, default=0.0, help="largest error of the focal length; default: 0"
    )
    parser.add_argument(
        "--max-disparity", metavar="PX", type=float,
        help="greatest disparity that is searched, which bounds the least depth; default: the width of a picture",
    )  # fmt: skip
    parser.add_argument("--wanted-error", metavar="Z", help="find the baseline that keeps depth errors below: 2cm")
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, help="a page with tables and plots, ends in .html")
    add_output_flags(parser)
    parser.set_defaults(run=_design)


def _design(args: argparse.Namespace) -> int:
    from sfmapp.pipelines.stereo_design import Wishes, design_stereo

    wishes = Wishes(
        args.focal, args.size, args.baseline, args.range, args.pixel, args.converging, args.fixate,
        args.disparity_error, args.focal_error, args.baseline_error, args.max_disparity, args.wanted_error,
    )  # fmt: skip
    report = design_stereo(wishes, args.output)
    if args.json:
        print_json({"exit_code": 0, **report})
    elif not args.quiet:
        print("\n".join(_lines(report)))
        if args.output is not None:
            print(f"page {args.output}")
    return 0


def _lines(report: DesignReport) -> Iterator[str]:
    unit = report.unit
    yield (
        f"{report.width} x {report.height} pixels, focal length {report.focal_px:.5g} px, field of view "
        f"{report.field_of_view_deg:.1f} degrees; disparities to {report.disparity_error_px:g} px"
    )
    for rig in report.rigs:
        yield from _rig_lines(rig, unit)
    for wanted in report.wanted:
        seen = f"both see {wanted.common_share:.0%}" if wanted.common_share else "nothing in common there"
        yield (
            f"{wanted.error:g} {unit} at {wanted.depth:g} {unit} needs a baseline of {wanted.baseline:.4g} {unit} "
            f"({seen})"
        )


def _rig_lines(rig: RigStudy, unit: str) -> Iterator[str]:
    axes = f"axes converging by {rig.converging_deg:.3g} degrees" if rig.converging_deg else "parallel axes"
    yield f"\nbaseline {rig.baseline:g} {unit}, {axes}:"
    if rig.fixation is not None:
        yield (
            f"  axes meet at {rig.fixation:.4g} {unit}; disparity is 0 on a cylinder of radius "
            f"{rig.zero_disparity_radius:.4g} {unit} through that point and both centres"
        )
    yield f"  seen by both from {rig.least_depth:.4g} {unit}, told from infinity up to {rig.greatest_depth:.4g} {unit}"
    head = f"{'depth':>10} {'disparity':>10} {'nearest':>12} {'farthest':>12} {'between':>10} {'error':>10}"
    yield f"  {head} in common"
    for row in rig.rows:
        far = "infinity" if row.farthest is None else f"{row.farthest:.7g}"
        spread = "-" if row.spread is None else f"{row.spread:.6g}"
        yield (
            f"  {row.depth:>10g} {row.disparity_px:>10.3f} {row.nearest:>12.7g} {far:>12} {spread:>10} "
            f"{row.total:>10.4g} {row.common_share:>9.0%}"
        )
