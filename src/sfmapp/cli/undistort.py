"""``sfmapp undistort``: photographs without distortion, for programs that know only pinholes."""

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
    from sfmapp.report.model import UndistortReport

EXAMPLES = """\
examples:
  sfmapp undistort out/ -o splat/
  sfmapp undistort colmap/sparse/0 --images colmap/images -o splat/ --max-size 1600
  sfmapp undistort out/ -o splat/ --blank-pixels 1 --mask-path masks/
  sfmapp undistort panoramas/ -o faces/ --max-size 1024
  sfmapp undistort photos/ -o straight/ --camera cam/calibration.json

SOURCE is a workspace of sfmapp reconstruct, one of sfmapp odometry on a folder of frames (its keyframes), or a COLMAP
model with the folder of its photographs. With --camera it may be photographs alone (a folder, a glob, a list): then
no model is written, but the pinhole that they share, as cameras.txt, opencv.yaml and for others. Writes
  DIR/images/NAME       the photographs, in the format that they have: JPEG with quality 97, all others without loss, 16
                        bits and alpha kept; copied as they are where there is no distortion; never with a tag to turn
                        them
  DIR/masks/NAME.png    black where a mask, or the lack of a photograph, leaves something out
  DIR/sparse/0/         the model with PINHOLE cameras (cameras.bin, images.bin, points3D.bin, rigs.bin, frames.bin),
                        for gaussian-splatting, gsplat, Brush and nerfstudio; the same files in DIR/sparse/, where
                        COLMAP has them and OpenMVS reads them
Of a photograph that shows more than 88 degrees from the axis, such as a panorama, NAME is each face of a cube that it
shows some of: a.jpg becomes a_front.jpg, a_right.jpg, a_back.jpg, a_left.jpg, a_up.jpg, a_down.jpg, a rig in the model.
The same command again resumes a run that was cut off."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "undistort", help="undistorted photographs and a PINHOLE model, for splatting and stereo",
        description="Remove the distortion of the lens from the photographs of a model.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("source", metavar="SOURCE", type=Path, help="a workspace, or a COLMAP model")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="output folder, new or empty")
    parser.add_argument(
        "--camera", metavar="MODEL,...|FILE",
        help="a calibration of any form: of photographs without a model, or in place of the cameras of the model, "
        "whose poses and points are adjusted to it",
    )  # fmt: skip
    parser.add_argument("--images", metavar="DIR", type=Path, help="folder of the photographs of a COLMAP model")
    parser.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    parser.add_argument(
        "--blank-pixels", metavar="SHARE", type=float, default=0.0,
        help="0 crops until no pixel is blank (default), 1 keeps all that the photographs show",
    )  # fmt: skip
    parser.add_argument("--max-size", metavar="PX", type=int, help="limit of the longer side in pixels; default: none")
    parser.add_argument(
        "--front-only", action="store_true",
        help="of photographs that show more than 88 degrees from the axis, one picture of what lies in front, and not "
        "the faces of a cube",
    )  # fmt: skip
    parser.add_argument(
        "--threads", metavar="N", help="number of workers, default: all cores; results do not depend on it"
    )
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_undistort)


def _undistort(args: argparse.Namespace) -> int:
    limit_library_threads()
    options = options_of({"threads": args.threads, "images.mask_path": args.mask_path, "images.camera": args.camera})
    load_numba_sparingly()
    from sfmapp.pipelines.undistort import undistort
    from sfmapp.scene.undistortion import Layout
    from sfmapp.workspace.usage import Stopwatch

    watch, layout = Stopwatch(whole_process=True), Layout(args.blank_pixels, args.max_size, args.front_only)
    with listening(args) as events:
        result = undistort(
            args.source, args.output, options, images=args.images, layout=layout, events=events, watch=watch
        )
    tell_result(args, result, lambda: _print(result.output, result.report))
    return 0


def _print(output: Path, report: UndistortReport) -> None:
    """A result in three lines."""
    sizes = sorted({(camera.width, camera.height) for camera in report.cameras})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
    copied = f", {report.num_copied} of them copied as they were" if report.num_copied else ""
    faces = f", {report.num_faces} of them faces of cubes" if report.num_faces else ""
    masks = f", {report.num_masks} masks" if report.num_masks else ""
    if report.calibration is not None:
        print(report.calibration.text)
        print_contradictions(report.calibration.contradictions)
    has_model = (output / "sparse" / "0").is_dir()
    points = f", {report.num_points} points, {report.num_observations} observations ({report.num_dropped} dropped)"
    print(f"{report.num_images} photographs without distortion ({shown}){faces}{copied}{masks}{points * has_model}")
    print(took(output, report.run))
    made = output / "sparse" / "0" if has_model else output / "cameras.txt"
    print(f"photographs {output / 'images'}" + (f", {'model' if has_model else 'camera'} {made}" * made.exists()))
