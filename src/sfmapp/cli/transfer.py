"""``sfmapp transfer``: what two photographs say of a third, with no calibration."""

from __future__ import annotations

import argparse
import math
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
    from sfmapp.pipelines.transfer import TransferResult

EXAMPLES = """\
examples:
  sfmapp transfer left.jpg right.jpg middle.jpg -o third/

Points of the first two photographs in the third: where their epipolar lines cross (F31 x1 x F32 x2), with the trifocal
plane, in which both lines are one, named and refused; and by the trifocal tensor, which has no such plane. The third
photograph is then synthesised from the other two, with no model in between, and compared with the real one.

Writes
  OUT/report.html      three photographs to be clicked into, and the synthesised one; opens without a network
  OUT/report.json      fundamental matrices, tensor, cameras in a projective frame, errors on points that were held back
  OUT/synthesised.jpg  the photograph that nobody took
  OUT/recording.rrd    points, lines and photographs for rerun: sfmapp view OUT"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "transfer", help="two photographs in the place of a third, with no calibration: points, and a synthesised view",
        description="Transfer of points and of a whole photograph to a third view.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "photographs", metavar="PHOTO", nargs=3, help="two photographs that are transferred, and the third"
    )
    parser.add_argument("-o", "--output", metavar="DIR", required=True, help="output folder, new or empty")
    parser.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    parser.add_argument("--seed", metavar="N", help="of the searches; default: 0")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_transfer)


def _transfer(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"images.mask_path": args.mask_path, "seed": args.seed})
    load_numba_sparingly()
    from sfmapp.pipelines.transfer import transfer_views
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = transfer_views(args.photographs, args.output, options, events=events, watch=watch)
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: TransferResult) -> None:
    """A result in a few lines."""
    told = result.report.transfer
    print(f"{told.num_common} points in common, noise {told.noise_px:.2f} px; transfer to {told.names[2]}:")
    for way in told.ways:
        within = "" if math.isnan(way.median_px) else f", median error {way.median_px:.2f} px"
        print(f"  {way.name}: {way.num_points - way.num_refused} of {way.num_points} told{within}")
    if told.degenerate:
        print(f"  {told.degenerate}")
    if told.new_view is not None:
        view = told.new_view
        print(f"synthesised view: {view.coverage:.0%} filled, correlation with the real one {view.correlation:.3f}")
    print(took(result.output, result.report.run))
    print(f"page {result.output / 'report.html'}, picture {result.picture}")
