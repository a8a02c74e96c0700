"""``sfmapp sweep``: depth maps by sweeping planes."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
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
    from sfmapp.pipelines.sweep.run import SweepResult

EXAMPLES = """\
examples:
  sfmapp sweep out/ -o depth/
  sfmapp sweep colmap/sparse/0 --images colmap/images -o depth/ --level 1

SOURCE is a workspace of sfmapp reconstruct, or a COLMAP model with the folder of its photographs. Writes
  DIR/maps/NAME.depth.npy       (H, W) float32, along the axis of the undistorted photograph, units of the world; NaN
                                where it is not known
  DIR/maps/NAME.sigma.npy       how far off it may be: 68 per cent of the depths are off by less
  DIR/maps/NAME.half_width_95.npy
                                the same of 95 per cent
  DIR/maps/NAME.confidence.npy  share of such depths that are off by less than a plane, 0 to 1
  DIR/maps/NAME.depth.png       to look at: near is red
  DIR/maps/views.json           size, calibration and pose of each map
  DIR/report.html, report.json  the page, with pictures of the maps
  DIR/recording.rrd             the points of one map after the other, and the volume, for the viewer of rerun
  DIR/occupancy.npz, .ply       with --occupancy: votes of the photographs' edges, and the cells that hold a feature
A depth is kept where the map of at least one other photograph confirms it, and no more of them see through it."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "sweep", help="depth maps of photographs with known cameras, by sweeping planes", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Sweep planes through what each photograph shows, and write its depth.",
    )  # fmt: skip
    parser.add_argument("source", metavar="SOURCE", type=Path, help="a workspace, or a COLMAP model")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="output folder, new or empty")
    parser.add_argument("--images", metavar="DIR", type=Path, help="folder of the photographs of a COLMAP model")
    parser.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    parser.add_argument(
        "--level", metavar="N", help="halve the photographs N times; default: to 1600 px or less a side"
    )
    parser.add_argument(
        "--occupancy", metavar="CELLS", type=int,
        help="a volume of so many cells on its longest side as well, and which of them hold edges of the photographs",
    )  # fmt: skip
    parser.add_argument("--no-recording", action="store_true", help="do not write recording.rrd")
    parser.add_argument("--threads", metavar="N", help="default: all cores; results do not depend on it")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_sweep)


def _sweep(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"threads": args.threads, "images.mask_path": args.mask_path, "dense.level": args.level})
    load_numba_sparingly()
    from sfmapp.pipelines.sweep.run import sweep
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = sweep(
            args.source, args.output, options, images=args.images, occupancy=args.occupancy,
            record=not args.no_recording, events=events, watch=watch,
        )  # fmt: skip
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: SweepResult) -> None:
    """A result in three lines."""
    maps = result.report.maps
    confirmed = sorted(each.confirmed for each in maps)
    sigmas = sorted(each.median_sigma for each in maps if each.median_sigma is not None)
    print(
        f"{len(maps)} depth maps, {confirmed[len(confirmed) // 2]:.1%} of the pixels confirmed by others (least "
        f"{confirmed[0]:.1%}), sigma {sigmas[len(sigmas) // 2]:.2%} of the depth"
    )
    print(took(result.output, result.report.run))
    volume = result.report.occupancy
    if volume is not None:
        print(f"{volume.num_features} of {math.prod(volume.cells)} cells hold a feature")
    print(f"maps {result.output / 'maps'}")
    print(f"page {result.output / 'report.html'}")
