"""The command ``sfmapp``: parse, call a pipeline, and turn every failure into a message, advice and an exit code."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Sequence

import sfmapp
from sfmapp.cli import convert, dense, evaluate, inspect, odometry, reconstruct
from sfmapp.errors import SfmError

BUG = 1
INTERRUPTED = 130

EXIT_CODES = """\
exit codes: 0 done, 1 a bug, 2 usage, 3 bad input, 4 no reconstruction (the report is still written),
            5 fewer images than asked for, 130 interrupted (reconstruct resumes)"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    args = make_parser().parse_args(argv)
    try:
        code: int = args.run(args)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except SfmError as error:
        return _fail(args, str(error), error.advice, error.exit_code)
    except MemoryError:
        return _fail(args, "out of memory", "try --preset fast, or --set features.max_size_px=1600", BUG)
    except KeyboardInterrupt:
        return _fail(args, "interrupted", None, INTERRUPTED)
    except Exception as error:
        if args.verbose:
            raise
        message = " ".join(f"{type(error).__name__}: {error}".split())
        where = "the traceback is in OUT/log.jsonl; -v shows it" if args.has_log else "-v shows where"
        return _fail(args, f"a bug in sfmapp: {message}", f"please report it ({where})", BUG)


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="sfmapp",
        description="Photographs and video into cameras, points and trajectories, on an ordinary CPU.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"sfmapp {sfmapp.__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for family in (reconstruct, dense, odometry, evaluate, inspect, convert):
        family.add_commands(commands)
    return parser


def _fail(args: argparse.Namespace, message: str, advice: str | None, code: int) -> int:
    """Say what went wrong: a line and advice for a person; with --json the same on the output stream."""
    with contextlib.suppress(BrokenPipeError):
        print(f"sfmapp: {message}", file=sys.stderr)
        if advice:
            print(f"  {advice}", file=sys.stderr)
        if args.json:
            print(json.dumps({"exit_code": code, "error": message, "advice": advice}), flush=True)
    return code
