"""``sfmapp evaluate``: a trajectory against the ground truth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.cli.common import add_output_flags, print_json

if TYPE_CHECKING:
    from sfmapp.pipelines.evaluate import Evaluation

ALIGNMENTS = ("sim3", "se3", "origin", "none")

EPILOG = """\
formats, told apart by what is in the files:
  TUM    8 columns: timestamp tx ty tz qx qy qz qw
  KITTI  12 columns: the rows of world_from_cam; line i is frame i. --times FILE gives the lines their seconds, which a
         comparison with another format needs
  EuRoC  data.csv: nanoseconds, position, quaternion w x y z, with commas"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command of this family to the parser."""
    parser = commands.add_parser(
        "evaluate", help="compare a trajectory with ground truth: ATE, RPE, KITTI's drift, and a plot",
        description="Print the absolute error (ATE), the relative error (RPE) and KITTI's t_rel and r_rel of a "
        "trajectory, and plot it against the ground truth.",
        epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "trajectory", metavar="TRAJ", type=Path, help="estimated trajectory, or the folder of an odometry run"
    )
    parser.add_argument(
        "ground_truth",
        metavar="GROUND_TRUTH",
        type=Path,
        help="ground-truth poses: a file, or the folder of a sequence that has them",
    )
    pairs = parser.add_argument_group("pairs of poses")
    pairs.add_argument("--max-diff", metavar="SECONDS", type=float, default=0.01,
                       help="largest time difference of a pair; default: 0.01")  # fmt: skip
    pairs.add_argument("--offset", metavar="SECONDS", type=float, default=0.0, help="added to the timestamps of TRAJ")
    pairs.add_argument(
        "--times", metavar="FILE", type=Path, help="timestamps in seconds, a line for each of a KITTI trajectory"
    )
    errors = parser.add_argument_group("errors")
    errors.add_argument("--align", choices=ALIGNMENTS, action="append",
                        help="sim3: best rotation, translation and scale; se3: the same without scale; origin: align "
                        "the first poses; none. May be repeated; default: sim3 and se3")  # fmt: skip
    errors.add_argument("--delta", metavar="N{f,s,m}", action="append",
                        help="interval of the RPE in frames, seconds or metres of path, such as 1f, 0.5s, 10m. May be "
                        "repeated; default: a frame, a second, and about a tenth of the path")  # fmt: skip
    errors.add_argument("--all-pairs", action="store_true",
                        help="overlapping RPE: motions from every pose, not end to end")  # fmt: skip
    errors.add_argument("--pairs-from", choices=("ground-truth", "estimate"), default="ground-truth",
                        help="whose path the metres of --delta are measured along; default: ground-truth")  # fmt: skip
    drawing = parser.add_argument_group("plot").add_mutually_exclusive_group()
    drawing.add_argument("--plot", metavar="PNG", type=Path, help="file of the plot; default: TRAJ.png")
    drawing.add_argument("--no-plot", action="store_true", help="do not plot")
    add_output_flags(parser)
    parser.set_defaults(run=_evaluate)


def _evaluate(args: argparse.Namespace) -> int:
    from sfmapp.pipelines.evaluate import EvaluateOptions, evaluate, parse_delta

    options = EvaluateOptions(
        alignments=tuple(args.align or ("sim3", "se3")),
        deltas=tuple(map(parse_delta, args.delta)) if args.delta else None,
        max_difference_s=args.max_diff,
        offset_s=args.offset,
        is_overlapping=args.all_pairs,
        is_by_estimate=args.pairs_from == "estimate",
    )
    result = evaluate(args.trajectory, args.ground_truth, options, times=args.times)
    try:  # before the table, which may go to a pipe that closes early
        picture = None if args.no_plot else _draw(result, args.plot)
    finally:
        if not args.json and not args.quiet:
            print(result.table())
    if args.json:
        print_json({"exit_code": 0, **result.report(), "plot": None if picture is None else str(picture)})
    elif picture is not None and not args.quiet:
        print(f"drawn: {picture}")
    return 0


def _draw(result: Evaluation, wanted: Path | None) -> Path | None:
    """Where the picture is; None if nobody asked for a place and there is none beside the trajectory."""
    from sfmapp.errors import InputError
    from sfmapp.pipelines.evaluate import draw

    read = result.estimate.path
    path = wanted or read.with_name(read.name + ".png")
    try:
        draw(result, path)
    except InputError as error:
        if wanted is not None:
            raise
        print(f"sfmapp: no picture: {error}", file=sys.stderr)
        return None
    return path
