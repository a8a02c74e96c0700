"""``sfmapp warp`` and ``sfmapp rectify``: pictures into planes of photographs, and planes out of them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.cli.common import add_output_flags, limit_library_threads, listening, tell_result
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.pipelines.planes import PlaneSource, RectifyResult, WarpResult
    from sfmapp.planes.report import PlaneReport

CORNERS = """\
Corners are pixels of the file as it is stored, x,y: top left, top right, bottom right and bottom left of the picture or
the plane itself, whichever way it hangs. The centre of the first pixel is at 0.5,0.5."""

WARP_EXAMPLES = f"""\
examples:
  sfmapp warp poster.png street.jpg --corners 512,203 871,240 866,655 505,690 -o ad/
  sfmapp warp poster.png street.jpg --corners '512,203 871,240 866,655 505,690' -o ad/ --mask tree.png --blend multiply
  sfmapp warp logo.png desk.jpg --marker 7 --dictionary DICT_4X4_50 --camera cam/ -o ad/
  sfmapp warp film.png wall.jpg --marker 0,1,2,3 --dictionary DICT_4X4_50 -o ad/

{CORNERS}

Writes
  OUT/PHOTO         the photograph with the picture on it, in the photograph's format and depth
  OUT/mask.png      where the picture is, its edges in shades
  OUT/report.html   what was made, the shape of the plane and how it lies before the camera; report.json the same"""

RECTIFY_EXAMPLES = f"""\
examples:
  sfmapp rectify facade.jpg --corners 512,203 871,240 866,655 505,690 -o front/
  sfmapp rectify facade.jpg --corners 512,203 871,240 866,655 505,690 -o front/ --size 2.4x1.2m --margin 0.5
  sfmapp rectify page.jpg --corners 512,203 871,240 866,655 505,690 -o page/ --size 210x297mm --camera cam/
  sfmapp rectify floor.jpg --marker 7 --dictionary DICT_4X4_50 --width 160mm --margin 5 -o floor/

{CORNERS}

Without --size, width over height is told by the corners and the focal length, with its sigma: that of --camera, of
EXIF, or, roughly, by nothing but that the corners are those of a rectangle.

Writes
  OUT/PHOTO         the plane seen straight on
  OUT/mask.png      where the photograph shows it, if it does not show all
  OUT/report.html   both pictures, size, shape and pose of the plane, with sigmas; report.json the same"""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "warp", help="put a picture onto a plane of a photograph",
        description="Put a picture onto a plane of a photograph: in perspective, through the lens, its edges smooth.",
        epilog=WARP_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("picture", metavar="PICTURE", type=Path, help="a picture; its alpha channel is kept")
    _add_plane_flags(parser)
    parser.add_argument(
        "--mask", metavar="FILE", type=Path, help="of the photograph's shape, black where something stands in front"
    )
    parser.add_argument(
        "--blend", choices=("over", "multiply"), default="over",
        help="over covers what was there (default), multiply lets its light and shade through",
    )  # fmt: skip
    parser.add_argument("--opacity", metavar="SHARE", type=float, default=1.0, help="from 0 to 1; default: 1")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_warp)

    parser = commands.add_parser(
        "rectify", help="take a plane out of a photograph, seen straight on, with its size",
        description="Take a plane out of a photograph as it looks straight on, and say its shape and how it lies.",
        epilog=RECTIFY_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    _add_plane_flags(parser)
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        "--size", metavar="WxH", help="of the result in pixels, or with a unit the true size of the rectangle: 2.4x1.2m"
    )
    size.add_argument("--width", metavar="LENGTH", help="true width of the rectangle, with its unit: 2.4m")
    parser.add_argument(
        "--margin", metavar="SHARE", type=float, default=0.0,
        help="show the plane so far round the rectangle, in shares of its longer side; default: 0",
    )  # fmt: skip
    parser.add_argument("--max-size", metavar="PX", type=int, help="limit of the longer side in pixels; default: none")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_rectify)


def _add_plane_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("photograph", metavar="PHOTO", type=Path, help="a photograph")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="output folder, new or empty")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--corners", metavar="X,Y", nargs="+", help="four corners, as below")
    where.add_argument(
        "--marker", metavar="ID[,ID,ID,ID]", help="a square marker, or four that stand at the corners, clockwise"
    )
    parser.add_argument("--dictionary", metavar="NAME", help="of the markers, such as DICT_4X4_50")
    parser.add_argument(
        "--camera", metavar="MODEL,...|FILE", help="a calibration of any form: its distortion is respected"
    )
    parser.add_argument(
        "--opencv-pixels", action="store_true", help="the centre of the first pixel is 0,0 in --corners"
    )
    parser.add_argument(
        "--sigma-px", metavar="PX", type=float,
        help="standard deviation of a corner; default: 1 of a hand, 0.2 of a marker",
    )  # fmt: skip


def _plane_source(args: argparse.Namespace) -> PlaneSource:
    from sfmapp.errors import UsageError
    from sfmapp.pipelines.planes import PlaneSource

    corners = ids = None
    if args.corners is not None:
        fields = " ".join(args.corners).replace(";", " ").split()
        try:
            corners = tuple((float(x), float(y)) for x, y in (field.split(",") for field in fields))
        except ValueError:
            corners = ()
        if len(corners) != 4:
            raise UsageError(
                f"corners are {' '.join(args.corners)!r}, expected four pairs x,y",
                "--corners 512,203 871,240 866,655 505,690; one that begins with a minus, in quotes behind a space",
            )
    else:
        try:
            ids = tuple(int(number) for number in args.marker.split(","))
        except ValueError:
            raise UsageError(f"marker is {args.marker!r}, expected an id, or four: 7, or 0,1,2,3") from None
    return PlaneSource(corners, ids, args.dictionary, args.camera, args.sigma_px, args.opencv_pixels)


def _warp(args: argparse.Namespace) -> int:
    limit_library_threads()
    load_numba_sparingly()
    from sfmapp.pipelines.planes import warp
    from sfmapp.planes.warp import Look
    from sfmapp.workspace.usage import Stopwatch

    watch, source, look = Stopwatch(whole_process=True), _plane_source(args), Look(args.blend, args.opacity)
    with listening(args) as events:
        result = warp(
            args.picture, args.photograph, args.output, source, look=look, mask=args.mask, events=events, watch=watch
        )
    tell_result(args, result, lambda: _print_warp(result))
    return 0


def _rectify(args: argparse.Namespace) -> int:
    limit_library_threads()
    load_numba_sparingly()
    from sfmapp.pipelines.planes import Wanted, rectify
    from sfmapp.workspace.usage import Stopwatch

    watch, source = Stopwatch(whole_process=True), _plane_source(args)
    wanted = Wanted(args.size, args.width, args.margin, args.max_size)
    with listening(args) as events:
        result = rectify(args.photograph, args.output, source, wanted=wanted, events=events, watch=watch)
    tell_result(args, result, lambda: _print_rectify(result))
    return 0


def _print_warp(result: WarpResult) -> None:
    report = result.report
    print(
        f"{report.picture} on {report.plane.photograph}: {report.covered_share:.1%} of it, stretched by "
        f"{report.stretch:.3g} +- {report.stretch_sigma:.2g} in width over height"
    )
    _print_plane(report.plane)
    print(f"picture {result.output / report.result}, report {result.output / 'report.html'}")


def _print_rectify(result: RectifyResult) -> None:
    report, unit = result.report, result.report.plane.unit
    texts = [
        f"{value:.5g}" + (f" +- {sigma:.2g}" if sigma is not None else "")
        for value, sigma in zip(report.plane.size, report.size_sigma, strict=True)
    ]
    print(
        f"{report.result_width} x {report.result_height} pixels; the rectangle is {' x '.join(texts)} {unit} "
        f"({report.aspect_source}), a pixel {report.units_per_pixel:.4g}"
    )
    _print_plane(report.plane)
    print(f"picture {result.output / report.result}, report {result.output / 'report.html'}")


def _print_plane(plane: PlaneReport) -> None:
    print(f"camera: {plane.camera}")
    for n, pose in enumerate(plane.poses):
        sigma = f" +- {plane.distance_sigma:.2g}" if n == 0 and plane.distance_sigma is not None else ""
        start = "the plane is" if n == 0 else "or, as the corners allow,"
        print(
            f"{start} {pose.distance:.4g}{sigma} {plane.unit} away, tilted by {pose.tilt_deg:.1f} degrees from the "
            f"line of sight; corners to {pose.rms_px:.2f} px"
        )
