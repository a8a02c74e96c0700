"""``sfmapp dense`` and ``sfmapp mesh``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

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
    from sfmapp.report.model import DenseReport, MeshRunReport
    from sfmapp.workspace.options import Options

DENSE_EXAMPLES = """\
examples:
  sfmapp dense out/
  sfmapp dense colmap/sparse/0 --images colmap/images -o out/
  sfmapp dense out/ --set dense.level=0 --region -1 -1 0 1 1 2 --maps
  sfmapp dense colmap/sparse/0 --images colmap/images -o out/ --camera cam/calibration.json

SOURCE is a workspace of sfmapp reconstruct, or a COLMAP model (binary or text, any of our camera models) with the
folder of its photographs. --camera FILE puts a calibration in place of its cameras: poses and points, which were found
with the old ones, are adjusted to it (OUT/sparse/0), and what the photographs say against it is told. Writes
OUT/dense/fused.ply (positions, normals, colours, number of views, score, sigma) and patches.npz; the same command again
resumes a run that was cut off, and does nothing where all is done."""


MESH_EXAMPLES = """\
examples:
  sfmapp mesh out/
  sfmapp mesh out/ --texture
  sfmapp mesh out/dense/fused.ply -o surface/ --set surface.depth=9

Writes OUT/mesh/mesh.ply and OUT/mesh/mesh.glb, with vertex colours or, with --texture, the photographs as texture."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = commands.add_parser(
        "dense", help="cameras and photographs to a dense cloud of oriented patches", epilog=DENSE_EXAMPLES,
        formatter_class=raw, description="Reconstruct a dense cloud of oriented patches.",
    )  # fmt: skip
    parser.add_argument("source", metavar="SOURCE", type=Path, nargs="?", help="a workspace, or a COLMAP model")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=Path,
        help="workspace of the results; default: SOURCE, or SOURCE/sfmapp for a COLMAP model",
    )
    parser.add_argument("--images", metavar="DIR", type=Path, help="folder of the photographs of a COLMAP model")
    parser.add_argument("--maps", action="store_true", help="also write depth and normal maps to OUT/dense/maps")
    parser.add_argument(
        "--list-options", action="store_true", help="list every stage.option with its default and effect"
    )
    _add_dense_flags(parser)
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_dense, parser=parser)

    parser = commands.add_parser(
        "mesh", help="dense patches to a mesh", epilog=MESH_EXAMPLES, formatter_class=raw,
        description="Make a mesh of dense patches: a Poisson surface, trimmed to what patches and photographs support.",
    )  # fmt: skip
    parser.add_argument("source", metavar="SOURCE", type=Path, nargs="?", help="a workspace, or a PLY with normals")
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, help="output folder, for a PLY only")
    parser.add_argument(
        "--list-options", action="store_true", help="list every stage.option with its default and effect"
    )
    group = _add_option_flags(parser)
    group.add_argument("--texture", action="store_true", help="texture mesh.glb with the photographs")
    group.add_argument("--depth", metavar="N", help="depth of the octree; default: from the density of the patches")
    group.add_argument("--no-recording", action="store_true", help="do not add the mesh to dense/recording.rrd")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_mesh, parser=parser)


def _add_option_flags(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    group = parser.add_argument_group("options (the last one wins: presets in order, then --set, then flags)")
    group.add_argument(
        "--preset", metavar="NAME|FILE", action="append", default=[], help="default, fast, or a TOML file"
    )
    group.add_argument(
        "--set", metavar="STAGE.OPTION=VALUE", action="append", default=[], help="any option; repeatable"
    )
    group.add_argument(
        "--threads", metavar="N", help="number of workers, default: all cores; results do not depend on it"
    )
    return group


def _add_dense_flags(parser: argparse.ArgumentParser) -> None:
    group = _add_option_flags(parser)
    group.add_argument("--level", metavar="N", help="halve the photographs N times; default: to 1600 px or less a side")
    group.add_argument(
        "--ground-sampling", metavar="D", help="instead of --level: size of a pixel on the surface, in world units"
    )
    group.add_argument(
        "--camera", metavar="MODEL,...|FILE",
        help="a calibration in place of the cameras of the model, whose poses and points are adjusted to it",
    )  # fmt: skip
    group.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; black pixels are ignored")
    group.add_argument(
        "--region", metavar=("X", "Y", "Z", "X", "Y", "Z"), nargs=6,
        help="lower and upper corners of the box to reconstruct",
    )  # fmt: skip
    group.add_argument("--max-memory", metavar="MB", help="split the views into clusters that need less than this")
    group.add_argument(
        "--cluster", metavar="ADDRESS",
        help="have workers densify clusters of views: local:4, or tcp://HOST:PORT of a scheduler of dask",
    )  # fmt: skip
    group.add_argument("--no-recording", action="store_true", help="do not write dense/recording.rrd")


def _options(args: argparse.Namespace, flags: dict[str, str | None]) -> Options:
    """The effective options of a command line; ``flags``: by name of the option, None where not given."""
    limit_library_threads()
    from sfmapp.workspace.options import load_options

    flags = {"threads": args.threads} | flags
    settings = [*args.set, *(f"{name}={value}" for name, value in flags.items() if value is not None)]
    return load_options(args.preset, settings)


def _dense(args: argparse.Namespace) -> int:
    if args.list_options:
        return list_options(args)
    if args.source is None:
        args.parser.error("SOURCE is needed")
    flags = {
        "dense.level": args.level,
        "dense.ground_sampling": args.ground_sampling,
        "images.camera": args.camera,
        "images.mask_path": args.mask_path,
        "dense.region": None if args.region is None else ",".join(args.region),
        "dense.max_memory_mb": args.max_memory,
        "cluster": args.cluster,
    }
    options = _options(args, flags)
    load_numba_sparingly()
    from sfmapp.pipelines.dense.densify import dense
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        result = dense(
            args.source, args.output, options, images=args.images, maps=args.maps, record=not args.no_recording,
            events=events, watch=watch,
        )  # fmt: skip
    if args.json:
        print_json({"exit_code": 0, **dense_result(result.output, result.report)})
    elif not args.quiet:
        print_dense(result.output, result.report)
    return 0


def _mesh(args: argparse.Namespace) -> int:
    if args.list_options:
        return list_options(args)
    if args.source is None:
        args.parser.error("SOURCE is needed")
    is_cloud = args.source.suffix.lower() == ".ply"
    if is_cloud != (args.output is not None):
        args.parser.error("-o OUT is needed for a PLY" if is_cloud else "leave out -o: it goes into the workspace")
    flags = {"surface.texture": "true" if args.texture else None, "surface.depth": args.depth}
    options = _options(args, flags)
    load_numba_sparingly()
    from sfmapp.pipelines.dense.mesh import mesh_cloud, mesh_workspace
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        if is_cloud:
            result = mesh_cloud(args.source, args.output, options, events=events, watch=watch)
        else:
            result = mesh_workspace(args.source, options, record=not args.no_recording, events=events, watch=watch)
    output = args.output or args.source
    if args.json:
        print_json({"exit_code": 0, **mesh_result(output, result.report)})
    elif not args.quiet:
        print_mesh(output, result.report)
    return 0


def dense_result(output: Path, report: DenseReport) -> dict[str, object]:
    """What ``--json`` prints of a cloud; the rest is in report.json."""
    names = ("num_patches", "mean_views", "median_score", "median_sigma", "median_size", "shares", "calibration", "run")
    paths = {"cloud": str(output / "dense" / "fused.ply"), "patches": str(output / "dense" / "patches.npz")}
    return {"output": str(output), **paths, **{name: report[name] for name in names if name in report}}


def print_dense(output: Path, report: DenseReport) -> None:
    """A cloud in three lines."""
    num_views = report.views.num_views if report.views is not None else 0
    if report.calibration is not None:
        print(report.calibration.text)
        print_contradictions(report.calibration.contradictions)
    print(
        f"{report.num_patches} patches from {num_views} views, each in {report.mean_views:.1f}"
        f" of them, score {report.median_score:.3f}, sigma {report.median_sigma:.3g},"
        f" a pixel measures {report.median_size:.3g}"
    )
    _print_end(output, report)
    print(f"cloud {output / 'dense' / 'fused.ply'}; a surface of it: sfmapp mesh {output}")


def mesh_result(output: Path, report: MeshRunReport) -> dict[str, object]:
    """What ``--json`` prints of a mesh; the rest is in report.json."""
    names = ("num_vertices", "num_faces", "num_rim_edges", "depth", "spacing", "texture", "run")
    paths = {"mesh": str(output / "mesh" / "mesh.ply"), "glb": str(output / "mesh" / "mesh.glb")}
    return {"output": str(output), **paths, **{name: report[name] for name in names if name in report}}


def print_mesh(output: Path, report: MeshRunReport) -> None:
    """A mesh in three lines."""
    rim = report.num_rim_edges
    print(
        f"{report.num_faces} triangles, {report.num_vertices} vertices, octree of depth {report.depth},"
        f" {'closed' if rim == 0 else f'{rim} edges at its rim'}"
    )
    _print_end(output, report)
    print(f"mesh {output / 'mesh' / 'mesh.ply'} and {output / 'mesh' / 'mesh.glb'}")


def _print_end(output: Path, report: DenseReport | MeshRunReport) -> None:
    print(took(output, report.run))
