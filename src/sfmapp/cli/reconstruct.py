"""``sfmapp reconstruct`` and ``sfmapp demo``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.camera.names import MODEL_NAMES
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
    from sfmapp.report.model import ReconstructionReport
    from sfmapp.workspace.options import Options


EXAMPLES = """\
examples:
  sfmapp reconstruct photos/ -o out/
  sfmapp reconstruct photos/ -o out/ --preset quality --set features.max_num_features=12000
  sfmapp reconstruct photos/ -o out/ --dense --mesh
  sfmapp reconstruct walk.mp4 -o out/
  sfmapp reconstruct walk.mp4 more.mp4 photos/ -o out/ --frames-max 200
  sfmapp reconstruct photos/ -o out/ --camera calibration.yaml
  sfmapp reconstruct more/ -o out/ --add
  sfmapp reconstruct 'frames/*.png' -o out/ --camera-model OPENCV_FISHEYE --seed 7

The same command again resumes a run that was cut off, does nothing where all is done, and re-runs only what a changed
option touches. The largest model is OUT/sparse/0, in COLMAP's format; OUT/report.html says how good it is and why."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = commands.add_parser(
        "reconstruct", help="photographs or videos to cameras and points", epilog=EXAMPLES, formatter_class=raw,
        description="Reconstruct cameras and points from photographs, or from frames that are chosen of videos.",
    )  # fmt: skip
    parser.add_argument(
        "images", metavar="IMAGES", nargs="*",
        help="a folder, a quoted glob, a .txt list of files, a video, of which frames are chosen, or several of these",
    )  # fmt: skip
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, help="output folder, created if missing")
    parser.add_argument(
        "--add", action="store_true",
        help="add IMAGES to the finished reconstruction in OUT, with its options; what is there already is told",
    )  # fmt: skip
    parser.add_argument("--dense", action="store_true", help="also compute dense patches: OUT/dense/fused.ply")
    parser.add_argument("--mesh", action="store_true", help="also make a mesh: OUT/mesh/mesh.ply and mesh.glb")
    parser.add_argument("--texture", action="store_true", help="with --mesh: texture mesh.glb with the photographs")
    parser.add_argument(
        "--list-options", action="store_true", help="list every stage.option with its default and effect"
    )
    add_option_flags(parser)
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_reconstruct, parser=parser)

    parser = commands.add_parser(
        "demo", help="reconstruct the bundled sample and compare it with its ground truth",
        description="Reconstruct the bundled sample, a rendered courtyard, and print the pose error against the "
        "ground truth.",
    )  # fmt: skip
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, default=Path("demo"), help="default: demo")
    add_option_flags(parser)
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_demo, parser=parser)


def add_option_flags(parser: argparse.ArgumentParser) -> None:
    """Flags that set options of a reconstruction; :func:`effective_options` reads them."""
    group = parser.add_argument_group("options (the last one wins: presets in order, then --set, then flags)")
    group.add_argument(
        "--preset", metavar="NAME|FILE", action="append", default=[],
        help="default, fast, quality, or a TOML file; repeatable",
    )  # fmt: skip
    group.add_argument(
        "--set", metavar="STAGE.OPTION=VALUE", action="append", default=[], help="any option; repeatable"
    )
    group.add_argument("--seed", metavar="N", help="seed of all random choices; the same seed gives the same bytes")
    group.add_argument(
        "--threads", metavar="N", help="number of workers, default: all cores; results do not depend on it"
    )
    group.add_argument(
        "--cluster", metavar="ADDRESS",
        help="have workers find features and matches: local:4, or tcp://HOST:PORT of a scheduler of dask",
    )  # fmt: skip
    cameras = group.add_mutually_exclusive_group()
    cameras.add_argument(
        "--camera", metavar="MODEL,...|FILE",
        help="what is known of the camera: a calibration of COLMAP, OpenCV, Kalibr, ROS, ... (several are told apart "
        "by the names of images, or of folders such as cam0), or numbers such as PINHOLE,fx,fy,cx,cy",
    )  # fmt: skip
    cameras.add_argument("--camera-model", metavar="MODEL", help=", ".join(MODEL_NAMES))
    group.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    group.add_argument(
        "--gps", metavar="FILE|exif|none",
        help="positions of the photographs: what cameras wrote into the files (the default), none, or a file: geo.txt "
        "of OpenDroneMap, a CSV of image, latitude, longitude, height, or a track with times (GPX, CSV)",
    )  # fmt: skip
    group.add_argument(
        "--gcp", metavar="FILE",
        help="ground control points: gcp_list.txt of OpenDroneMap, or a CSV of name, x, y, z, image, px, py, sigmas",
    )  # fmt: skip
    group.add_argument(
        "--scale", metavar="WHAT", action="append", default=[],
        help="a known length, repeatable: distance:IMAGE:IMAGE:METRES, marker:DICT:METRES, pair:DICT:ID:ID:METRES",
    )  # fmt: skip
    group.add_argument(
        "--pose-priors", metavar="FILE",
        help="known poses of photographs: a COLMAP model, TUM, cameras.json or transforms.json; models come into "
        "its frame",
    )  # fmt: skip
    group.add_argument(
        "--fix-poses", action="store_true", help="hold the poses of --pose-priors, and triangulate points from them"
    )
    group.add_argument("--up", metavar="HOW", help="turn models upright: auto, markers, plane or exif (as held)")
    group.add_argument("--frames-max", metavar="N", help="most frames that are taken of each video")
    group.add_argument("--min-registered", metavar="N", help="exit with code 5 if fewer images are registered")
    group.add_argument("--no-recording", action="store_true", help="do not write recording.rrd, the replay of the run")


def effective_options(args: argparse.Namespace) -> Options:
    """The effective options of a command line."""
    limit_library_threads()
    from sfmapp.workspace.options import load_options

    flags = {
        "seed": args.seed,
        "threads": args.threads,
        "cluster": args.cluster,
        "images.camera": args.camera,
        "images.camera_model": args.camera_model,
        "images.mask_path": args.mask_path,
        "gps.source": args.gps,
        "control.file": args.gcp,
        "units.known": ";".join(args.scale) or None,
        "units.up": args.up,
        "poses.file": args.pose_priors,
        "poses.fixed": "true" if args.fix_poses else None,
        "video.max_frames": args.frames_max,
        "min_registered": args.min_registered,
    }
    settings = [*args.set, *(f"{name}={value}" for name, value in flags.items() if value is not None)]
    return load_options(args.preset, settings)


def _reconstruct(args: argparse.Namespace) -> int:
    if args.list_options:
        return list_options(args)
    if not args.images or args.output is None:
        args.parser.error("IMAGES and -o OUT are needed")
    if args.texture and not args.mesh:
        args.parser.error("--texture needs --mesh")
    if args.texture:
        args.set.append("surface.texture=true")
    options = effective_options(args)
    report = _run(args, args.images if len(args.images) > 1 else args.images[0], options)
    result = reconstruction_result(args.output, report)
    if not args.json and not args.quiet:
        print_summary(args.output, report)
    if args.dense or args.mesh:
        result |= _go_on(args, options)
    if args.json:
        print_json({"exit_code": 0, **result})
    return 0


def _go_on(args: argparse.Namespace, options: Options) -> dict[str, object]:
    """Dense patches and maybe a mesh of what was reconstructed; what ``--json`` prints of them."""
    from sfmapp.cli.dense import dense_result, mesh_result, print_dense, print_mesh
    from sfmapp.pipelines.dense.densify import dense
    from sfmapp.pipelines.dense.mesh import mesh_workspace

    is_talking = not args.json and not args.quiet
    with listening(args) as events:
        # the recording shows patches and mesh: it is written once, by the last stage
        record = not args.no_recording
        cloud = dense(args.output, options=options, record=record and not args.mesh, events=events).report
        result: dict[str, object] = {"dense": dense_result(args.output, cloud)}
        if is_talking:
            print_dense(args.output, cloud)
        if args.mesh:
            mesh = mesh_workspace(args.output, options, record=record, events=events).report
            result["mesh"] = mesh_result(args.output, mesh)
            if is_talking:
                print_mesh(args.output, mesh)
    return result


def _demo(args: argparse.Namespace) -> int:
    options = effective_options(args)
    from sfmapp.pipelines.demo import compare_with_ground_truth
    from sfmapp.workspace.resources import sample_folder

    sample = sample_folder()
    report = _run(args, str(sample / "images"), options)
    errors = compare_with_ground_truth(args.output, sample)
    if args.json:
        print_json({"exit_code": 0, **reconstruction_result(args.output, report), "ground_truth": errors})
        return 0
    if not args.quiet:
        print_summary(args.output, report)
    center, rotation = errors.center_error, errors.rotation_error_deg
    assert center is not None
    assert rotation is not None
    whose = f"{errors.num_common} of {errors.num_reference_images} images, {errors.scene_size:.1f} m apart"
    print(
        f"against the ground truth: camera centres off by {1000 * center.mean:.2f} mm on average,"
        f" {1000 * center.max:.2f} mm at worst; rotations by {rotation.mean:.4f} and {rotation.max:.4f}"
        f" degrees ({whose})"
    )
    return 0


def _run(args: argparse.Namespace, images: str | list[str], options: Options) -> ReconstructionReport:
    load_numba_sparingly()
    from sfmapp.workspace.usage import Stopwatch

    if getattr(args, "add", False):
        from sfmapp.pipelines.sparse.add import add_photographs as run
    else:
        from sfmapp.pipelines.sparse.reconstruct import reconstruct as run
    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = run(images, args.output, options, events=events, record=not args.no_recording, watch=watch)
    return result.report


def reconstruction_result(output: Path, report: ReconstructionReport) -> dict[str, object]:
    """What ``--json`` prints: the outcome in numbers; the rest is in report.json."""
    missing = [image.name for image in report.images if not image.is_registered]
    paths = {"model": str(output / "sparse" / "0"), "report": str(output / "report.json")}
    return {"output": str(output), **paths, **report.models[0], "not_registered": missing, "run": report.run}


def _print_world(report: ReconstructionReport) -> None:
    """Where models lie, by positions of photographs, and which of these were left aside."""
    placed = report.stages.georeference
    if placed is None:
        return
    for model in placed.models:
        if model.reason:
            print(f"  model {model.model} is in arbitrary units: {model.reason}")
            continue
        assert model.rms_residual_m is not None
        assert model.scale_sigma_share is not None
        assert model.rotation_sigma_deg is not None
        flat, up = model.rms_residual_m
        height = "" if up is None else f", {up:.2g} m in height"
        print(
            f"  model {model.model} is in metres, z up, by {model.num_used} of {model.num_positions} positions: "
            f"residuals {flat:.2g} m horizontally{height}; scale to {100 * model.scale_sigma_share:.2g} %, "
            f"north to {model.rotation_sigma_deg[2]:.2g} degrees"
        )
    for finding in placed.findings:
        print(f"  positions: {finding.sentence}")


def _print_control(report: ReconstructionReport) -> None:
    """Control points left out in turn, and what is wrong with them."""
    found = report.stages.control
    for model in found.models if found is not None else ():
        if model.reason:
            print(f"  model {model.model} is not georeferenced by its ground control: {model.reason}")
        elif model.summary is not None:
            one = model.summary
            print(
                f"  model {model.model} lies on ground control; its points, left out in turn, in metres beside their"
                " standard deviations:"
            )
            print(f"    {'point':<14}{'east':>16}{'north':>16}{'up':>16}")
            for point in model.points:
                if point.left_out_m is not None and point.left_out_sigma_m is not None:
                    pairs = zip(point.left_out_m, point.left_out_sigma_m, strict=True)
                    cells = "".join(f"{f'{value:+.3f} ({sigma:.3f})':>16}" for value, sigma in pairs)
                    print(f"    {point.name:<14}{cells}{'  refuted' if point.role == 'refuted' else ''}")
            print(
                f"    rms {one.horizontal_rms_m:.3f} m horizontally, expected {one.expected_horizontal_m:.3f};"
                f" {one.vertical_rms_m:.3f} m in height, expected {one.expected_vertical_m:.3f}"
            )
        for finding in model.findings:
            print(f"  {finding}")


def _print_poses(report: ReconstructionReport) -> None:
    """How models lie to poses that were known, and which of these were left aside."""
    found = report.stages.poses
    if found is None:
        return
    for model in found.models:
        if model.reason:
            print(f"  model {model.model} is in arbitrary units, and not in the frame of known poses: {model.reason}")
        elif model.sigma is not None and model.sigma_deg is not None:
            how = "holds" if found.is_fixed else "lies in the frame of"
            print(
                f"  model {model.model} {how} {model.num_used} of {model.num_known} known poses, which are good to"
                f" {model.sigma:.2g} and {model.sigma_deg:.2g} degrees by the photographs"
            )
        if model.positions is not None:
            print(f"  model {model.model}: {model.positions.sentence}")
    for image in found.images:
        if not image.is_used and image.model is not None and image.reason:
            print(f"  {image.name}: {image.reason}; it was left aside")
    if found.num_strange:
        print(f"  {found.num_strange} poses of {found.path} are of no photograph")


def _print_units(report: ReconstructionReport) -> None:
    """Metres by known lengths, each left out in turn, and what levelled models."""
    found = report.stages.units
    for scale in found.scales if found is not None else ():
        if scale.reason:
            print(f"  model {scale.model} has no metres: {scale.reason}")
        elif scale.sigma_share is not None:
            print(f"  model {scale.model} is in metres by known lengths, to {100 * scale.sigma_share:.2g} %")
        for bar in scale.bars:
            if bar.left_out_m is not None and bar.left_out_sigma_m is not None:
                off = f"{bar.left_out_m:+.3g} m by the others ({bar.left_out_sigma_m:.2g})"
                print(f"    {bar.name}: {off}{'' if bar.is_used else '  refuted'}")
        for finding in scale.findings:
            print(f"  {finding}")
    for level in found.levels if found is not None else ():
        text = level.reason or f"level by {level.source}, within {level.sigma_deg:.2g} degrees"
        print(f"  model {level.model}: {text}")


def print_summary(output: Path, report: ReconstructionReport) -> None:
    """What came of a reconstruction, in words."""
    model, run = report.models[0], report.run
    print(
        f"{model.num_registered} of {model.num_images} images registered, {model.num_points} points,"
        f" tracks of {model.mean_track_length:.2f}, reprojection error {model.mean_reprojection_error_px:.2f} px"
    )
    if report.merged is not None:
        print(f"  {report.merged.text}")
    if report.added is not None:
        print(f"  {report.added.text}")
        for one in report.added.known:
            print(f"  {one.name}: {one.reason}")
    for image in report.images:
        if not image.is_registered:
            print(f"  not registered: {image.name}: {image.reason}. {image.remedy}")
    if len(report.models) > 1:
        sizes = ", ".join(str(other.num_registered) for other in report.models)
        print(f"  the photographs fall into {len(report.models)} models of {sizes} images: sparse/0, sparse/1, ...")
        for m, other in enumerate(report.models[1:], 1):
            if other.apart:
                print(f"  model {m} is {other.apart}")
    _print_world(report)
    _print_control(report)
    _print_poses(report)
    _print_units(report)
    print_contradictions(found for one in report.models for found in one.contradictions)
    if report.stages.poses is not None:
        print_contradictions(report.stages.poses.contradictions)
    print(took(output, run))
    if report.plan is not None and not run.is_up_to_date:
        print(f"  {report.plan.sentence}")
    print(f"model {output / 'sparse' / '0'}, report {output / 'report.html'}; look at it: sfmapp view {output}")
