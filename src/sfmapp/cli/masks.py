"""``sfmapp masks``: where an object is in photographs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from sfmapp.cli.common import (
    add_object_flags,
    add_output_flags,
    limit_library_threads,
    listening,
    object_options,
    options_of,
    tell_result,
    took,
)
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.pipelines.carve.masks import MasksResult

EXAMPLES = """\
examples:
  sfmapp masks turntable/ -o masks/                photographs before one background, cameras known or not
  sfmapp masks out/ -o masks/                      the photographs of a reconstruction, held against each other
  sfmapp masks photos/ -o clean/ --mask-path rough/   masks that there are: checked, spills and holes mended
  sfmapp reconstruct turntable/ -o out/ --mask-path masks/masks

An alpha channel or mask files are taken where they are there. Otherwise the edges of the pictures show the background:
where they are the same in all, the camera stands still, and what hides the background is the object (--background: a
photograph without it); if not, the colours of both are learned from all photographs together.

Writes
  DIR/masks/NAME.png   white where the object is, for --mask-path, COLMAP, and splatting tools
  DIR/report.html      the outlines over the photographs, and what speaks against them"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "masks", help="masks of an object in photographs, checked against each other",
        description="Find where an object is in photographs.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("source", metavar="SOURCE", help="a workspace, a COLMAP model, or photographs")
    parser.add_argument("-o", "--output", metavar="DIR", required=True, help="output folder, new or empty")
    add_object_flags(parser)
    parser.add_argument("--threads", metavar="N", help="default: all cores; results do not depend on it")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_masks)


def _masks(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({**object_options(args), "threads": args.threads})
    load_numba_sparingly()
    from sfmapp.pipelines.carve.masks import MasksInput, find_masks
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    what = MasksInput(args.source, args.images, args.poses)
    with listening(args) as events:
        result = find_masks(what, args.output, options, events=events, watch=watch)
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: MasksResult) -> None:
    report, entries = result.report, result.report.masks.masks
    shares = sorted(entry.share for entry in entries)
    print(
        f"{len(report.files)} masks of {len(entries)} photographs by {entries[0].source}; the object takes "
        f"{shares[0]:.1%} to {shares[-1]:.1%} of them"
    )
    if report.masks.is_compared:
        spilled, filled = (sum(entry[key] > 0.0 for entry in entries) for key in ("spilled", "filled"))
        odd = sum(bool(entry.problem) for entry in entries)
        print(f"held against each other: {odd} do not fit, {spilled} had spills, {filled} had holes that are none")
    print(took(result.output, report.run))
