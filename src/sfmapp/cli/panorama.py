"""``sfmapp panorama``: photographs taken turning on the spot, to one picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.cli.common import (
    add_output_flags,
    limit_library_threads,
    listening,
    options_of,
    print_contradictions,
    tell_result,
    took,
)
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.panorama.report import PictureReport, TurningReport
    from sfmapp.pipelines.panorama import PanoramaResult

EXAMPLES = """\
examples:
  sfmapp panorama photos/ -o pano/
  sfmapp panorama 'photos/IMG_01*.jpg' -o pano/ --projection cylindrical --picture hall.png
  sfmapp panorama photos/ -o pano/ --max-size 8000
  sfmapp panorama turn.mp4 -o pano/

Writes
  OUT/panorama.jpg      the picture; a spherical one with the XMP tags (GPano) by which viewers know it
  OUT/sparse/0/         the cameras, at one centre, as a COLMAP model without points
  OUT/rotations.json    their rotations and the lens, with sigmas
  OUT/frames/           of a video the frames that were picked: sharp ones, a fifth of the picture apart
  OUT/panorama-2.jpg    and so on: of photographs that overlap none of the first panorama, but each other; OUT/sparse/1/
  OUT/report.html       how sure that is, where the camera did not turn on the spot, and what was left out
Photographs that are not of the panorama are left out and named. The same command again resumes a run that was cut
off."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "panorama", help="photographs taken turning on the spot, to one picture",
        description="Stitch photographs that were taken turning on the spot; nothing need be known of the camera.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "images", metavar="IMAGES|VIDEO", help="a folder, a quoted glob, a .txt list of files, or a video"
    )
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help="output folder, new or empty")
    parser.add_argument(
        "--projection", choices=("spherical", "cylindrical", "planar"),
        help="default: planar up to 90 degrees, spherical all round or far up and down, otherwise cylindrical",
    )  # fmt: skip
    parser.add_argument("--max-size", metavar="PX", type=int, help="limit of the longer side in pixels; default: none")
    parser.add_argument(
        "--picture", metavar="NAME", default="panorama.jpg", help="its file in OUT: .jpg, .png or .tif (panorama.jpg)"
    )
    parser.add_argument("--focal-px", metavar="PX", help="focal length of all photographs, as a prior")
    parser.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    parser.add_argument("--seed", metavar="N", help="where every random choice starts")
    parser.add_argument(
        "--threads", metavar="N", help="number of workers, default: all cores; results do not depend on it"
    )
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_panorama)


def _panorama(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({
        "threads": args.threads, "images.mask_path": args.mask_path, "images.focal_px": args.focal_px,
        "seed": args.seed,
    })  # fmt: skip
    load_numba_sparingly()
    from sfmapp.pipelines.panorama import PictureLayout, stitch_panorama
    from sfmapp.workspace.usage import Stopwatch

    watch, layout = Stopwatch(whole_process=True), PictureLayout(args.picture, args.projection, args.max_size)
    with listening(args) as events:
        result = stitch_panorama(args.images, args.output, options, layout=layout, events=events, watch=watch)
    tell_result(args, result, lambda: _print(result))
    return 0


def _print(result: PanoramaResult) -> None:
    """A result in a few lines."""
    report = result.report
    if report.turning is None or report.picture is None:
        return
    _print_panorama(report.turning, report.picture)
    for other in report.others:
        print(f"another panorama, {other.picture.file}:")
        _print_panorama(other.turning, other.picture)
    print(took(result.output, report.run))
    print(f"picture {result.picture}, report {result.output / 'report.html'}")


def _print_panorama(turning: TurningReport, picture: PictureReport) -> None:
    print(
        f"{turning.num_turned} of {turning.num_images} photographs, {picture.width} x {picture.height} pixels, "
        f"{picture.projection}, {picture.span_deg:.0f} degrees"
    )
    for camera in turning.cameras:
        sigma = "" if camera.focal_sigma_px is None else f" \N{PLUS-MINUS SIGN} {camera.focal_sigma_px:.2g}"
        print(f"  camera {camera.camera_idx}: focal length {camera.focal_px:.2f}{sigma} px")
    for one in turning.left_out:
        print(f"  left out {one.name}: {one.reason}")
    moved = [
        pair.parallax_px for pair in turning.pairs if pair.verdict in ("rotation", "parallax") and pair.parallax_px
    ]
    if moved:
        print(f"  parallax in {len(moved)} pairs, up to {max(moved):.1f} px: see the report")
    print_contradictions(turning.contradictions)
