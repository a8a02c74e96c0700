"""``sfmapp merge``: two finished reconstructions as one."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfmapp.cli.common import add_output_flags, limit_library_threads, listening, print_json
from sfmapp.cli.reconstruct import print_summary, reconstruction_result
from sfmapp.kernel_cache import load_numba_sparingly

EXAMPLES = """\
examples:
  sfmapp merge monday/ tuesday/ -o both/

Photographs that are in both, by their bytes, and matches between those of the one and the other tell how the two lie to
each other; then all is adjusted. Where they do not agree they are not averaged: exit code 4, and the reason."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "merge", help="two finished reconstructions as one",
        description="Make one reconstruction of two that share photographs or see the same place. Neither is changed.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("first", metavar="OUT1", type=Path, help="a folder of reconstruct, whose options are kept")
    parser.add_argument("second", metavar="OUT2", type=Path, help="another one")
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help="output folder, new or empty")
    parser.add_argument("--no-recording", action="store_true", help="do not write recording.rrd, the replay of the run")
    add_output_flags(parser, has_log=True)
    parser.set_defaults(run=_merge)


def _merge(args: argparse.Namespace) -> int:
    limit_library_threads()
    load_numba_sparingly()
    from sfmapp.pipelines.sparse.merge import merge_reconstructions
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        report = merge_reconstructions(
            args.first, args.second, args.output, events=events, record=not args.no_recording, watch=watch
        ).report
    if args.json:
        print_json({"exit_code": 0, **reconstruction_result(args.output, report)})
    elif not args.quiet:
        print_summary(args.output, report)
    return 0
