"""``sfmapp odometry`` and ``sfmapp refine``: a sequence to a trajectory and a map, and the map once more."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfmapp.cli.common import (
    add_output_flags,
    limit_library_threads,
    list_options,
    listening,
    print_contradictions,
    print_json,
    took,
)
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.report.model import OdometryRunReport, RefineReport
    from sfmapp.viewer.view import LiveViewer
    from sfmapp.workspace.options import Options

EXAMPLES = """\
examples:
  sfmapp odometry walk.mp4 -o out/ --camera PINHOLE,525,525,320,240 --view
  sfmapp odometry dataset/sequences/00 -o out/ --ground-truth poses/00.txt
  sfmapp odometry MH_01_easy -o out/ --mono --scale imu
  sfmapp odometry frames/ -o out/ --camera calib.json --scale marker:DICT_4X4_50:0.16
  sfmapp odometry second_walk.mp4 -o out2/ --map out/ --camera PINHOLE,525,525,320,240
  sfmapp odometry drive.mcap -o out/ --image-topic /camera/image_raw
  sfmapp odometry camera:0 -o out/ --camera calib.json     # or rtsp://HOST/STREAM; Ctrl-C ends it

Frames come from a folder of images, a video or stream, a bag of ROS 1 or 2, or a sequence of KITTI, TUM or EuRoC, whose
cameras, times, ground truth and IMU are found automatically. With two cameras lengths are in metres; with one their
unit is arbitrary unless --scale gives it. OUT/report.html says how good the result is, where there are gaps, and
why."""

SCALE = (
    "source of metric scale: marker:DICT:METRES (side of an ArUco or AprilTag marker), distance:A:B:METRES (between "
    "the cameras of two frames), camera_height:METRES (over level ground), imu (the default where there is one), or "
    "arbitrary"
)


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "odometry", help="a sequence of frames to a trajectory and a map", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Estimate the trajectory of a camera or a stereo pair, and a map, from a sequence of frames.",
    )  # fmt: skip
    parser.add_argument(
        "sequence", metavar="SEQUENCE", nargs="?", help="a folder of frames, a video, a stream, a bag or a data set"
    )
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, help="output folder, created if missing")
    parser.add_argument(
        "--list-options", action="store_true", help="list every stage.option with its default and effect"
    )
    _add_sequence_flags(parser)
    group = parser.add_argument_group("viewing")
    group.add_argument("--view", action="store_true", help="watch the run live in rerun")
    group.add_argument("--no-recording", action="store_true", help="do not write recording.rrd, the replay of the run")
    _add_option_flags(parser)
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_odometry, parser=parser)

    parser = commands.add_parser(
        "refine", help="adjust the maps of an odometry run globally, and add photographs",
        description="Adjust the maps of an odometry run globally, move its trajectory along, and register photographs.",
    )  # fmt: skip
    parser.add_argument("run_folder", metavar="OUT", type=Path, help="folder of an odometry run, which is not changed")
    parser.add_argument("-o", "--output", metavar="OUT2", type=Path, help="output folder; default: OUT/refined")
    parser.add_argument("--add-photos", metavar="DIR", help="photographs to register in the largest map")
    parser.add_argument("--free-intrinsics", action="store_true", help="also refine the calibration of the sequence")
    _add_option_flags(parser)
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_refine, parser=parser)


def _add_sequence_flags(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("sequence")
    group.add_argument("--camera", metavar="MODEL,...|FILE", help="intrinsics, such as PINHOLE,fx,fy,cx,cy, or a file")
    group.add_argument("--self-calibrate", action="store_true", help="calibrate the camera from the first minute")
    group.add_argument("--mono", action="store_true", help="use the first camera alone")
    group.add_argument(
        "--ground-truth", metavar="FILE", help="ground-truth trajectory (TUM, KITTI or EuRoC) to compare with"
    )
    group.add_argument("--imu", metavar="FILE", help="inertial measurements in EuRoC's format")
    group.add_argument(
        "--image-topic",
        metavar="TOPIC[,TOPIC]",
        help="topic of a bag with the images, or of left and right ones",
    )
    group.add_argument("--imu-topic", metavar="TOPIC", help="topic of a bag with the IMU")
    group.add_argument("--scale", metavar="SOURCE", help=SCALE)
    group.add_argument(
        "--map", metavar="OUT", type=Path,
        help="localise the sequence in the map of an earlier run, a reconstruction or a COLMAP model, and go on there",
    )  # fmt: skip
    group.add_argument("--start", metavar="N", help="first frame to play")
    group.add_argument("--stop", metavar="N", help="play the frames before this one")
    group.add_argument("--step", metavar="N", help="play every Nth frame")
    group.add_argument("--reverse", action="store_true", help="play the sequence backwards")
    group.add_argument("--fps", metavar="RATE", help="frame rate; overrides the timestamps of the sequence")


def _add_option_flags(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("options (the last one wins: presets in order, then --set, then flags)")
    group.add_argument(
        "--preset", metavar="NAME|FILE", action="append", default=[], help="default, fast, quality, or a TOML file"
    )
    group.add_argument(
        "--set", metavar="STAGE.OPTION=VALUE", action="append", default=[], help="any option; repeatable"
    )
    group.add_argument("--seed", metavar="N", help="seed of all random choices; the same seed gives the same bytes")
    group.add_argument(
        "--threads", metavar="N", help="number of workers, default: all cores; results do not depend on it"
    )


def _options(args: argparse.Namespace) -> Options:
    """The effective options of a command line."""
    limit_library_threads()
    from sfmapp.workspace.options import load_options

    named = ("camera", "ground_truth", "imu", "image_topic", "imu_topic", "start", "stop", "step", "fps")
    flags: dict[str, Any] = {"seed": args.seed, "threads": args.threads, "scale.source": args.scale}
    flags["odometry.known_map"] = args.map
    flags |= {f"sequence.{name}": getattr(args, name) for name in named}
    flags |= {f"sequence.{name}": True for name in ("mono", "reverse") if getattr(args, name)}
    settings = [*args.set, *(f"{name}={value}" for name, value in flags.items() if value is not None)]
    return load_options(args.preset, settings)


def _odometry(args: argparse.Namespace) -> int:
    if args.list_options:
        return list_options(args)
    if args.sequence is None or args.output is None:
        args.parser.error("SEQUENCE and -o OUT are needed")
    options = _options(args)
    load_numba_sparingly()
    from sfmapp.pipelines.odometry.track import track_sequence
    from sfmapp.workspace.usage import Stopwatch

    watch, viewer = Stopwatch(whole_process=True), _open_viewer(args)
    try:
        with listening(args) as events:
            result = track_sequence(
                args.sequence, args.output, options, events=events, record=not args.no_recording,
                screen=viewer.screen if viewer else None, self_calibrate=args.self_calibrate, watch=watch,
            )  # fmt: skip
    except BaseException:
        if viewer is not None:
            viewer.leave()
        raise
    if args.json:
        print_json({"exit_code": 0, **summary(args.output, result.report)})
    elif not args.quiet:
        _print_summary(args, result.report)
    if viewer is not None:
        viewer.wait()
    return 0


def _refine(args: argparse.Namespace) -> int:
    limit_library_threads()
    from sfmapp.workspace.options import load_options

    flags = {"seed": args.seed, "threads": args.threads}
    options = load_options(args.preset, [*args.set, *(f"{k}={v}" for k, v in flags.items() if v is not None)])
    load_numba_sparingly()
    from sfmapp.pipelines.odometry.refine import FOLDER, refine
    from sfmapp.workspace.usage import Stopwatch

    watch, output = Stopwatch(whole_process=True), args.output or args.run_folder / FOLDER
    with listening(args) as events:
        result = refine(
            args.run_folder, output, options, photos=args.add_photos, free_intrinsics=args.free_intrinsics,
            events=events, watch=watch,
        )  # fmt: skip
    report = result.report
    if args.json:
        named = ("maps", "ground_truth", "photographs", "run")
        print_json({"exit_code": 0, "output": str(output), **{name: report[name] for name in named}})
    elif not args.quiet:
        _print_refined(output, report)
    return 0


def _print_refined(output: Path, report: RefineReport) -> None:
    for before, after in zip(report.maps.before, report.maps.after, strict=True):
        print(
            f"map {after.idx}: {before.num_points} to {after.num_points} points, reprojection error"
            f" {before.mean_reprojection_error_px:.3f} to {after.mean_reprojection_error_px:.3f} px"
        )
    for first, last in zip(report.ground_truth.before, report.ground_truth.after, strict=False):
        errors = f"{first.ate_m.rmse:.4f} to {last.ate_m.rmse:.4f}"
        print(f"  against the ground truth: {errors} m rmse ({first.alignment.upper()})")
    photos, run = report.photographs, report.run
    if photos:
        print(f"{sum(row.is_registered for row in photos)} of {len(photos)} photographs registered")
        for row in photos:
            if not row.is_registered:
                print(f"  not registered: {row.name}: {row.reason}")
    print_contradictions(row for found in report.maps.after for row in found.contradictions)
    print(took(output, run))
    print(f"model {output / 'sparse' / '0'}, trajectory {output / 'trajectory.tum'}, report {output / 'report.html'}")


def _open_viewer(args: argparse.Namespace) -> LiveViewer | None:
    if not args.view:
        return None
    import sys

    from sfmapp.viewer.view import open_live_viewer

    return open_live_viewer(tell=lambda line: print(line, file=sys.stderr, flush=True))


def summary(output: Path, report: OdometryRunReport) -> dict[str, object]:
    """What ``--json`` prints: the outcome in numbers; the rest is in report.json."""
    paths = {name: str(output / path) for name, path in (
        ("trajectory", "trajectory.tum"), ("model", "sparse/0"), ("report", "report.json"),
    )}  # fmt: skip
    named = ("frames", "maps", "ground_truth", "timing", "live", "run")
    return {"output": str(output), **paths, **{name: report[name] for name in named}}


def _print_summary(args: argparse.Namespace, report: OdometryRunReport) -> None:
    from sfmapp.report.odometry_html import known_map_text, live_text, scale_text

    output, frames, first, run, timing = (
        args.output, report.frames, report.maps[0], report.run, report.timing,
    )  # fmt: skip
    print(
        f"{frames.num_with_pose} of {frames.num_frames} frames have a pose; path of {first.path_length:.4g},"
        f" unit: {scale_text(first)}; {first.num_keyframes} keyframes, {first.num_points} points"
    )
    for gap in frames.gaps:
        if gap.num_frames:
            print(f"  no pose from frame {gap.first_frame} to {gap.last_frame} ({gap.duration_s:.1f} s)")
    if len(report.maps) > 1:
        sizes = ", ".join(str(other.num_frames) for other in report.maps)
        print(f"  it falls into {len(report.maps)} maps of {sizes} frames, each with a world of its own")
    for row in report.ground_truth:
        if row.poses == "final":
            ate, which = row.ate_m, f", map {row.map}" if row.map else ""
            print(
                f"  against the ground truth{which}: off by {ate.rmse:.3f} m rmse,"
                f" {ate.max:.3f} m at worst, over {row.true_path_m:.1f} m ({row.alignment.upper()})"
            )
    if report.stages.odometry is not None and report.stages.odometry.known_map is not None:
        print(f"  {known_map_text(report.stages.odometry.known_map)}")
    if report.live is not None:
        print(f"  {live_text(report.live)}")
    print_contradictions(row for found in report.maps for row in found.contradictions)
    if report.stages.filter is not None:
        print_contradictions(report.stages.filter.contradictions)
    pace = ""
    if timing is not None:
        pace = f"; {timing.cpu_ms_per_frame:.1f} CPU ms a frame, {timing.frames_per_second:.1f} frames a second"
    print(took(output, run) + pace)
    looks = "" if args.no_recording else f"; look at it: sfmapp view {output}"
    print(f"trajectory {output / 'trajectory.tum'}, report {output / 'report.html'}{looks}")
