"""``sfmapp pair``: why two photographs give, or do not give, a reconstruction, told step by step."""

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
    from sfmapp.pipelines.pair import PairResult

EXAMPLES = """\
examples:
  sfmapp pair left.jpg right.jpg -o story/
  sfmapp pair left.jpg right.jpg -o story/ --steps > numbers.txt
  sfmapp pair out/ IMG_0012.jpg IMG_0017.jpg     with the features, matches and cameras of a reconstruction

From keypoints to nearest neighbours, the ratio test, F by RANSAC and by eight points with and without normalisation,
epipolar lines, E, the four poses and the choice between them, parallax, and H beside F: what kind of pair it is, and
whether and why a reconstruction would begin with it.

Writes
  OUT/report.html    the story, to be clicked into; opens without a network
  OUT/report.json    every number in it
  OUT/recording.rrd  matches, epipolar lines and the four poses for rerun: sfmapp view OUT
OUT of a workspace is, by default, its folder pairs/NAME--NAME."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "pair", help="the story of two photographs, step by step: why they give a reconstruction, or not",
        description="Two-view geometry with two photographs, step by step.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "sources",
        metavar="SOURCE",
        nargs="+",
        help="two photographs, or a workspace and the names of two of its images",
    )
    parser.add_argument("-o", "--output", metavar="DIR", help="output folder, new or empty")
    parser.add_argument("--steps", action="store_true", help="print the numbers of every step")
    parser.add_argument("--camera", metavar="CAMERA", help="calibration of the photographs, as of sfmapp reconstruct")
    parser.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    parser.add_argument("--seed", metavar="N", help="of the searches; default: 0")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_pair)


def _pair(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"images.camera": args.camera, "images.mask_path": args.mask_path, "seed": args.seed})
    load_numba_sparingly()
    from sfmapp.pipelines.pair import tell_pair
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = tell_pair(args.sources, args.output, options, events=events, watch=watch)
    tell_result(args, result, lambda: _print(result, with_steps=args.steps))
    return 0


def _print(result: PairResult, *, with_steps: bool) -> None:
    """The story in a few lines, or all its numbers."""
    from sfmapp.report.pair_words import step_lines, story_lines

    told = result.report.story
    for line in step_lines(told) if with_steps else story_lines(told):
        print(line)
    print(took(result.output, result.report.run))
    print(f"page {result.output / 'report.html'}, recording {result.output / 'recording.rrd'}")
