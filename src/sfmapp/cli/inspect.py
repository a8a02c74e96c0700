"""``sfmapp view`` and ``sfmapp validate``: look at a result, and doubt it."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfmapp.cli.common import add_output_flags, listening, print_json


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "view", help="replay a run in rerun",
        description="Open OUT/dense/recording.rrd or, if there is none, OUT/recording.rrd in rerun; serve "
        "it on 127.0.0.1 if there is no display.",
    )  # fmt: skip
    parser.add_argument("output", metavar="OUT", type=Path, help="folder of a run, or a recording in it (.rrd)")
    parser.add_argument(
        "--serve", action="store_true", help="serve it for a browser on this machine, even if there is a display"
    )
    parser.add_argument("--port", metavar="N", type=int, default=9090, help="port to serve on; default: 9090")
    add_output_flags(parser)
    parser.set_defaults(run=_view)

    parser = commands.add_parser(
        "validate", help="compare a result with pycolmap and with ground truth",
        description="Run pycolmap on the same photographs and print both results side by side; with "
        "--ground-truth-cloud, score the dense cloud and the mesh instead.",
    )  # fmt: skip
    parser.add_argument(
        "output", metavar="OUT", type=Path, help="folder of a run; with --ground-truth-cloud also a PLY"
    )
    parser.add_argument(
        "--ground-truth", metavar="FILE", type=Path, help="COLMAP model, cameras.json or TUM trajectory"
    )
    parser.add_argument(
        "--ground-truth-cloud", metavar="PLY", type=Path,
        help="ground-truth cloud or mesh: accuracy, completeness and F-score at 1, 2 and 5 times a distance; with "
        "--ground-truth the result is first aligned by its cameras",
    )  # fmt: skip
    parser.add_argument(
        "--distance",
        metavar="D",
        type=float,
        help="in units of the ground truth; default: the median size of a pixel",
    )
    add_output_flags(parser)
    parser.set_defaults(run=_validate)


def _view(args: argparse.Namespace) -> int:
    from sfmapp.errors import UsageError
    from sfmapp.viewer.view import view

    if not 0 < args.port < 1 << 16:
        raise UsageError(f"--port: expected a number from 1 to 65535, found {args.port}")
    recording, *others = _recordings(args.output)
    for other in others:
        print(f"there is another: sfmapp view {other}", flush=True)
    view(recording, serve=args.serve or None, web_port=args.port, tell=lambda line: print(line, flush=True))
    return 0


def _recordings(output: Path) -> list[Path]:
    """A recording that is named, or those of a run, the one that shows most of it first."""
    from sfmapp.errors import InputError
    from sfmapp.workspace.manifest import read_manifest

    if output.suffix == ".rrd":
        return [output]
    found = [path for path in (output / "dense" / "recording.rrd", output / "recording.rrd") if path.is_file()]
    if not found:
        read_manifest(output)
        raise InputError(f"{output / 'recording.rrd'} does not exist", "run it again with a recording")
    return found


def _validate(args: argparse.Namespace) -> int:
    from sfmapp.errors import UsageError
    from sfmapp.pipelines.validate import validate
    from sfmapp.pipelines.validate_cloud import validate_cloud
    from sfmapp.report.validation import CloudValidation, Validation

    if args.distance is not None and args.ground_truth_cloud is None:
        raise UsageError("--distance needs --ground-truth-cloud")
    with listening(args) as events:
        result: Validation | CloudValidation
        if args.ground_truth_cloud is not None:
            result = validate_cloud(
                args.output,
                args.ground_truth_cloud,
                ground_truth_poses=args.ground_truth,
                distance=args.distance,
                events=events,
            )
        else:
            result = validate(args.output, args.ground_truth, events=events)
    if args.json:
        print_json({"exit_code": 0, **result})
    else:
        print(result.table())
    return 0
