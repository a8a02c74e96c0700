"""``sfmapp export``: a model in the format of another program."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from sfmapp.cli.common import add_output_flags, print_json


class _Formats:
    """The formats, from the one table of them: it is loaded when somebody exports, or asks for this help."""

    def __iter__(self) -> Iterator[str]:
        from sfmapp.pipelines.export import EXPORTS

        return iter(EXPORTS)

    def __contains__(self, name: object) -> bool:
        return name in list(self)


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this family to the parser."""
    parser = commands.add_parser(
        "export", help="export a model to another program's format",
        description="Write OUT/sparse/0 in another format, read it back, and print the worst reprojection difference.",
    )  # fmt: skip
    parser.add_argument("output", metavar="OUT", type=Path, help="folder of a run")
    parser.add_argument("--to", metavar="FORMAT", required=True, choices=_Formats(), help="%(choices)s")
    parser.add_argument("-o", dest="path", metavar="PATH", type=Path, required=True, help="file or folder to write")
    parser.add_argument(
        "--crs", metavar="EPSG:CODE",
        help="coordinate system of ply, las and laz, in metres; default: of ply the frame of the model, of others UTM",
    )  # fmt: skip
    parser.add_argument(
        "--dense", action="store_true", help="of ply, las and laz: the dense points, not the sparse ones"
    )
    add_output_flags(parser)
    parser.set_defaults(run=_export)


def _export(args: argparse.Namespace) -> int:
    from sfmapp.pipelines.export import export_model

    result = export_model(args.output, args.to, args.path, crs=args.crs, is_dense=args.dense)
    if args.json:
        print_json({"exit_code": 0, **result})
    else:
        worst = (
            f"worst difference {result.max_px:.2g} px of a reprojection, {result.max_coordinate:.2g} of a coordinate"
        )
        print(f"wrote {args.path} ({args.to}), read it back: {worst}")
        for note in result.notes:
            print(f"note: {note}")
    return 0
