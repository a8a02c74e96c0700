"""``sfmapp calibrate compare``: are two calibrations of the same camera?"""

from __future__ import annotations

import argparse
from pathlib import Path

from sfmapp.cli.common import add_output_flags, limit_library_threads, print_json


def add_way(ways: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add this way to the parser."""
    parser = ways.add_parser(
        "compare", help="the difference of two calibrations over the picture, and whether it is one",
        description="Compare where two calibrations put the same rays, after the best rotation, with both sigmas.",
    )  # fmt: skip
    parser.add_argument("first", metavar="A", type=Path, help="OUT, or OUT/calibration.json, of sfmapp calibrate")
    parser.add_argument("second", metavar="B", type=Path, help="the other")
    parser.add_argument("--picture", metavar="FILE", type=Path, help="draw the difference over the picture, an SVG")
    add_output_flags(parser)
    parser.set_defaults(run=_compare)


def _compare(args: argparse.Namespace) -> int:
    limit_library_threads()
    from sfmapp.pipelines.calibration.compare import compare_calibrations

    report = compare_calibrations(args.first, args.second, args.picture)
    if args.json:
        print_json({"exit_code": 0, **report})
    elif not args.quiet:
        verdict = "the same camera, as far as the sigmas tell" if report.is_same else "not the same camera"
        print(f"{verdict}: chance {report.chance:.2g} (chi2 {report.chi2:.1f}, {report.degrees_of_freedom} numbers)")
        print(
            f"difference after a turn of {report.turn_deg:.3f} degrees: median {report.median_px:.3f} px, largest "
            f"{report.largest_px:.3f} px at ({report.largest_at[0]:.0f}, {report.largest_at[1]:.0f}), where its sigma "
            f"is {report.largest_sigma_px:.3f} px"
        )
        if args.picture is not None:
            print(f"drawn: {args.picture}")
    return 0
