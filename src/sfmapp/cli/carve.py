"""``sfmapp carve``: photographs from all sides to a closed volume."""

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
    from sfmapp.pipelines.carve.run import CarveResult

EXAMPLES = """\
examples:
  sfmapp carve out/                                   a reconstruction: OUT/carve
  sfmapp carve lego/ -o volume/                       photographs and their cameras.json or transforms.json
  sfmapp carve out/ --with-dense                      after sfmapp dense: hollows that patches show are carved too
  sfmapp carve lego/ -o volume/ --colors              hollows by the colours of the photographs, without dense patches
  sfmapp carve dinosaur/ -o volume/ --cells 512       photographs and a file of 3x4 projection matrices
  sfmapp carve photos/ -o volume/ --mask-path masks/  masks named IMAGE.png, the object white
  sfmapp carve figure/ --lights lights.json -o volume/  photographs under single lights too: hollows by their shadows
  sfmapp carve masks/ --poses poses.txt --camera PINHOLE,258.65,258.25,159.8,128.15 -o volume/

Where an object is in the photographs is told by their alpha channel, by masks, or by a background that all have in
common (sfmapp masks shows it). What all silhouettes leave standing is the volume: exact from outside, blind to hollows
that no outline shows. --lights FILE takes photographs under one light at a time as well: what camera and light both
would see lit, and is dark, is not there.

Writes
  OUT/mesh.ply, OUT/mesh.glb   the closed surface, in colours of the photographs
  OUT/octree.npz               the volume as cells; what shadows have left of it: OUT/octree_shadows.npz,
                               of colours: OUT/octree_colors.npz; with patches: OUT/joined.npz
  OUT/report.html              how well it fits each silhouette, its slices, volume and area, what is wrong
  OUT/recording.rrd            how it was carved, level by level
The same command again goes on where an earlier one was stopped."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "carve", help="photographs from all sides to a closed volume, by silhouettes",
        description="Carve a closed volume out of photographs with known cameras.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "source", metavar="SOURCE", help="a workspace, a COLMAP model, or a folder of photographs with their cameras"
    )
    parser.add_argument("-o", "--output", metavar="OUT", help="output folder, new or empty; of a model, SOURCE/carve")
    cameras = parser.add_argument_group("photographs and cameras")
    add_object_flags(cameras)
    cameras.add_argument(
        "--lights", metavar="FILE", help="JSON file of photographs under single lights, whose shadows carve hollows"
    )
    volume = parser.add_argument_group("volume")
    volume.add_argument(
        "--cells", metavar="N", help="finest cells along the longest side; default: as outlines tell, 256 at most"
    )
    volume.add_argument(
        "--box", metavar=("X", "Y", "Z", "X", "Y", "Z"), type=float, nargs=6,
        help="lower and upper corners of the box that the object is in; default: as the silhouettes say",
    )  # fmt: skip
    volume.add_argument("--misses", metavar="K", help="silhouettes that may miss a place that is kept; default: 0")
    volume.add_argument("--keep-holes", action="store_true", help="carve through holes that one mask alone has, too")
    volume.add_argument("--texture", action="store_true", help="texture mesh.glb with the photographs")
    volume.add_argument(
        "--with-dense", metavar="DIR", nargs="?", const="",
        help="join the patches of sfmapp dense with the silhouettes: hollows that no outline shows are carved where "
        "patches are seen in them; a workspace or its patches.npz; default: SOURCE",
    )  # fmt: skip
    volume.add_argument(
        "--colors", action="store_true",
        help="carve hollows by the colours of the photographs: where those of several look alike something is, and "
        "what they see through is not; surfaces with texture that look the same from everywhere",
    )  # fmt: skip
    volume.add_argument("--threads", metavar="N", help="default: all cores; results do not depend on it")
    volume.add_argument("--no-recording", action="store_true", help="do not write recording.rrd")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_carve)


def _carve(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({
        **object_options(args), "carve.cells": args.cells, "carve.misses": args.misses,
        "carve.doubts_holes": "false" if args.keep_holes else None, "threads": args.threads,
        "surface.texture": "true" if args.texture else None,
    })  # fmt: skip
    load_numba_sparingly()
    from sfmapp.pipelines.carve.run import CarveInput, carve
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    what = CarveInput(args.source, args.images, args.poses, args.box, args.lights, args.with_dense, args.colors)
    with listening(args) as events:
        result = carve(what, args.output, options, record=not args.no_recording, events=events, watch=watch)
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: CarveResult) -> None:
    report = result.report
    fits = sorted(fit.iou for fit in report.colors.views)
    print(
        f"{report.num_views} photographs, silhouettes by {report.masks.masks[0].source}; the volume covers them by "
        f"{fits[len(fits) // 2]:.1%} (least {fits[0]:.1%})"
    )
    carving, surface = report.carving, report.surface
    if report.shadows:
        taken = report.shadows.carving
        print(
            f"shadows of {len(report.shadows.lights)} lights took away "
            f"{1.0 - taken.volume_after / taken.volume_before:.1%} of what silhouettes left"
        )
    print(
        f"{carving.cells} cells along the side, {carving.share_of_dense:.2%} of them looked at; volume "
        f"{surface.volume:.5g} ({carving.volume_low:.5g} to {carving.volume_high:.5g}), area {surface.area:.5g}"
    )
    if report.joining is not None:
        joining = report.joining
        print(
            f"{joining.num_sights} photographs see {'patches' if report.sights is None else 'colours that agree'}; of "
            f"the hull {joining.volume / joining.hull_volume:.0%} is left with them"
        )
    print(f"{surface.num_faces} triangles, {report.colors.seen_share:.1%} of the vertices in colours of photographs")
    print(took(result.output, report.run))
