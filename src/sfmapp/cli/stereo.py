"""``sfmapp stereo``: two photographs of one moment to disparities and depths."""

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
    from sfmapp.pipelines.stereo.run import StereoResult
    from sfmapp.stereo.report import StereoPairReport

EXAMPLES = """\
examples:
  sfmapp stereo left.jpg right.jpg --camera rig/ -o depth/     any two calibrated cameras: rectified, then matched
  sfmapp stereo im0.png im1.png --camera calib.txt -o depth/   Middlebury's, rectified already
  sfmapp stereo left/ right/ --camera rig/rig.json -o depth/   pairs by name, a folder for each
  sfmapp stereo kitti/00/ -o depth/                            image_2 and image_3, or image_0 and image_1
  sfmapp stereo film.mp4 --camera rig/rig.json --step 10 -o depth/   left and right half of every tenth frame
  sfmapp stereo out/ --pair IMG_0012 IMG_0017                  two photographs of a reconstruction: OUT/stereo
  sfmapp stereo out/ --best 3                                  the three pairs of it that stereo has most of
  sfmapp stereo l.png r.png --focal 995 --baseline 0.193 --doffs 31.1 -o depth/   rectified, with three numbers

The calibration of two cameras has any form: that of sfmapp calibrate rig, OpenCV's stereo files, Kalibr's, ROS's,
EuRoC's, KITTI's or Middlebury's calib.txt. Where its cameras are rectified already, pictures stay as they are. Without
one, photographs whose rows agree are taken as they are, and others are rectified by their matches alone; disparities
are all that there is then. A rig that has turned since its calibration is found by matches, and corrected.

Writes
  OUT/left.png, OUT/right.png   the pair, its rows epipolar lines
  OUT/disparity.npy             x_left - x_right of each pixel of the left picture; .pfm and .png the same
  OUT/depth.npy                 depths in the unit of the baseline, where one is known; cloud.ply, view.glb
  OUT/calib.txt, *.yaml         the rectified cameras for Middlebury's programs, OpenCV and ROS; without metres OpenCV's
  OUT/rectification_maps.*      with --maps, for cv2.remap and as .npz; sparse.csv and .ply with --sparse
  OUT/report.html               maps and how far off they may be, how the pair was rectified, what is wrong with it
Of several pairs each has a folder in OUT; OUT/report.json tells of all."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "stereo", help="two photographs of one moment to disparities and depths",
        description="Rectify two photographs, match every pixel, and measure depths.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "sources",
        metavar="SOURCE",
        nargs="+",
        help="two photographs, two folders, a KITTI folder, a side-by-side video, a reconstruction, or a track",
    )
    parser.add_argument(
        "-o", "--output", metavar="DIR", help="output folder, new or empty; of a reconstruction, OUT/stereo"
    )
    which = parser.add_argument_group("pairs")
    chosen = which.add_mutually_exclusive_group()
    chosen.add_argument("--pair", metavar="NAME", nargs=2, help="two images of a reconstruction")
    chosen.add_argument(
        "--best", metavar="N", type=int, default=1, help="of a reconstruction, its N best pairs; default: 1"
    )
    which.add_argument("--step", metavar="N", type=int, default=1, help="every N-th pair or frame; default: 1")
    cameras = parser.add_argument_group("cameras")
    cameras.add_argument(
        "--correct", metavar="HOW", help="a rig that has turned since its calibration: turn, rows, no; default: auto"
    )
    cameras.add_argument("--camera", metavar="FILE", help="calibration of both cameras, of any form")
    cameras.add_argument("--focal", metavar="PX", type=float, help="focal length of a rectified pair, pixels")
    cameras.add_argument("--baseline", metavar="B", help="distance of its cameras: 12cm, or a number of metres")
    cameras.add_argument(
        "--doffs", metavar="PX", type=float, help="its principal points along x, right minus left; default: 0"
    )
    matching = parser.add_argument_group("matching")
    matching.add_argument("--matcher", metavar="NAME", help="sgm, window, opencv-sgbm or opencv-bm; default: sgm")
    matching.add_argument("--min-disparity", metavar="PX", help="least disparity looked for; default: as matches tell")
    matching.add_argument("--num-disparities", metavar="N", help="how many from there on")
    matching.add_argument("--window", metavar="PX", help="side of the window, odd; default: the matcher's own")
    more = parser.add_argument_group("what is written")
    more.add_argument("--maps", action="store_true", help="where each pixel of the rectified pictures comes from too")
    more.add_argument(
        "--sparse", action="store_true", help="points of keypoints alone too, with covariances: sparse.csv, sparse.ply"
    )
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_stereo)


def _stereo(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({
        "stereo.matcher": args.matcher, "stereo.min_disparity": args.min_disparity,
        "stereo.correct_rig": args.correct,
        "stereo.num_disparities": args.num_disparities, "stereo.window": args.window,
    })  # fmt: skip
    load_numba_sparingly()
    from sfmapp.pipelines.stereo.run import AlsoWritten, stereo
    from sfmapp.pipelines.stereo.sources import ChosenPairs, KnownCameras
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    chosen = ChosenPairs(None if args.pair is None else tuple(args.pair), args.best, args.step)
    baseline = None if args.baseline is None else _metres(args.baseline)
    known = KnownCameras(args.camera, args.focal, baseline, args.doffs)
    with listening(args) as events:
        result = stereo(
            args.sources, args.output, options,
            known=known, chosen=chosen, also=AlsoWritten(args.maps, args.sparse), events=events, watch=watch,
        )  # fmt: skip
    tell_result(args, result, lambda: _print(result))
    return 0


def _metres(text: str) -> float:
    """Of a length with its unit, or of a number."""
    from sfmapp.planes.lengths import parse_length

    try:
        return float(text)
    except ValueError:
        return parse_length(text)


def _print(result: StereoResult) -> None:
    for pair in result.report.pairs:
        _print_pair(pair)
    film = result.report.film
    if film is not None and film.agreeing_share is not None:
        print(
            f"where nothing moves, {film.agreeing_share:.1%} of the disparities agree with the frame before "
            f"(least: {film.worst}, {film.worst_agreeing_share:.1%})"
        )
    for each in result.report.failed:
        print(f"{each.name}: FAILED: {each.reason}")
    print(f"{took(result.output, result.report.run)}; report {result.output / 'report.html'}")


def _print_pair(pair: StereoPairReport) -> None:
    how, found = pair.rectification, pair.disparity
    start = f"{pair.name}: " if pair.name else ""
    rows = "" if how.rows is None else f", rows agree to {how.rows.rms_px:.2f} px"
    made = f"turned by {how.turn_deg[0]:.2f} and {how.turn_deg[1]:.2f} degrees"
    if how.is_as_given:
        made = "as they are"
    elif how.is_polar:
        made = "about the baseline"
    print(f"{start}{how.width} x {how.height} pixels, rectified {made}{rows}")
    text = f"{found.matcher}: {found.density:.1%} of the pixels matched"
    if found.quantiles_px:
        text += f", disparities {found.quantiles_px[0]:.1f} to {found.quantiles_px[-1]:.1f} px"
    if found.depths:
        nearest, middle, farthest = found.depths
        text += f", depths {nearest:.3g} to {farthest:.3g} {how.unit or 'units'} (median {middle:.3g})"
    print(text)
