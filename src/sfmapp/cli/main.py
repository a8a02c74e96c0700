"""The command ``sfmapp``: parse, call a pipeline, and turn every failure into a message, advice and an exit code."""

from __future__ import annotations

import argparse
import errno
import importlib
import json
import pkgutil
import sys
from collections.abc import Sequence
from types import ModuleType

import sfmapp
from sfmapp import cli
from sfmapp.cli.common import seldom_collecting
from sfmapp.cli.signals import signals_interrupt
from sfmapp.cli.streams import standard_streams
from sfmapp.errors import InputError, InterruptedRunError, SfmError, refusal
from sfmapp.kernel_cache import ADVICE, is_without_cache
from sfmapp.packages import missing_package

# what most people look for comes first in the help; the other families follow by name
FIRST = ("reconstruct", "dense", "odometry")
EXIT_CODES = """\
exit codes: 0 done, 1 a bug, 2 usage, 3 bad input, or out of disk space or memory,
            4 no reconstruction (the report is still written), 5 fewer images than asked for,
            130 interrupted (reconstruct resumes)"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    with standard_streams() as output, signals_interrupt(), seldom_collecting():
        args = make_parser().parse_args(argv)
        code = _run(args)
        output.flush()
        if output.has_lost_text and code == 0:
            lost = InputError(f"standard output cannot be written: {output.error}", "all files were written")
            return _fail(args, lost)
        return code


def _run(args: argparse.Namespace) -> int:
    try:
        code: int = args.run(args)
        return code
    except SfmError as error:
        return _fail(args, error)
    except MemoryError:
        return _fail(args, InputError("out of memory", "try --preset fast, or --set features.max_size_px=1600"))
    except KeyboardInterrupt:
        return _fail(args, InterruptedRunError("interrupted"))
    except Exception as error:
        if (failure := _known(error)) is not None:
            return _fail(args, failure)
        if args.verbose:
            raise
        message = " ".join(f"{type(error).__name__}: {error}".split())
        where = "the traceback is in OUT/log.jsonl; -v shows it" if args.has_log else "-v shows where"
        return _fail(args, SfmError(f"a bug in sfmapp: {message}", f"please report it ({where})"))


def _known(error: Exception) -> SfmError | None:
    """What is no bug: a refusal of the system, a package that is not installed, or kernels that find no place."""
    if isinstance(error, ModuleNotFoundError):
        return missing_package(error)
    if isinstance(error, OSError):
        return refusal(error)
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop"):  # of pathlib, before Python 3.13
        return refusal(OSError(errno.ELOOP, str(error)))
    if is_without_cache(error):
        where = "neither where sfmapp is installed, nor in ~/.cache, nor in /tmp"
        return InputError(f"expected a folder to keep compiled kernels in, found none: {where}", ADVICE)
    return None


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="sfmapp",
        description="Photographs and video into cameras, points, surfaces and trajectories, on an ordinary CPU.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"sfmapp {sfmapp.__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for family in _families():
        family.add_commands(commands)
    for command in commands.choices.values():
        command.allow_abbrev = False  # half a flag would mean another one as soon as there are more
    return parser


def _families() -> list[ModuleType]:
    """The modules of this room that add commands; a new one is found here, and named nowhere."""
    names = [*FIRST, *sorted({module.name for module in pkgutil.iter_modules(cli.__path__)} - {*FIRST})]
    modules = [importlib.import_module(f"{cli.__name__}.{name}") for name in names]
    return [module for module in modules if hasattr(module, "add_commands")]


def _fail(args: argparse.Namespace, failure: SfmError) -> int:
    """Say what went wrong: a line and advice for a person; with --json the same on the output stream."""
    message, advice, code = str(failure), failure.advice, failure.exit_code
    print(f"sfmapp: {message}", file=sys.stderr)
    if advice:
        print(f"  {advice}", file=sys.stderr)
    if args.json:
        print(json.dumps({"exit_code": code, "error": message, "advice": advice}), flush=True)
    return code
