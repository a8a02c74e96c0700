"""What the commands share: flags, listeners, and the two ways to stop a run."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import gc
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sfmapp.cli.progress import make_listener
from sfmapp.cli.signals import signals_stop
from sfmapp.packages import BLAS_THREADS

if TYPE_CHECKING:
    from sfmapp.contradictions import Contradiction
    from sfmapp.events import Events
    from sfmapp.report.model import RunUsage
    from sfmapp.reporting import Report
    from sfmapp.workspace.options import Options

    class Told(Protocol):
        """What a command has found: where it is written, and what there is to say of it."""

        @property
        def output(self) -> Path: ...

        @property
        def report(self) -> Report: ...


# how often Python looks for rubbish
_USUAL = gc.get_threshold()


def add_output_flags(parser: argparse.ArgumentParser, *, has_log: bool = False) -> None:
    """Flags on how much is said, and in which form. ``has_log``: the command writes ``OUT/log.jsonl``."""
    parser.set_defaults(has_log=has_log)
    group = parser.add_argument_group("output")
    loudness = group.add_mutually_exclusive_group()
    loudness.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    loudness.add_argument("-v", "--verbose", action="store_true", help="print every decision, and tracebacks of bugs")
    group.add_argument("--json", action="store_true", help="result as JSON on stdout, events as JSON lines on stderr")


def add_object_flags(group: argparse._ActionsContainer) -> None:
    """Flags on photographs of an object, their cameras, and where the object is in them."""
    group.add_argument("--images", metavar="DIR", help="folder of the photographs, where SOURCE does not hold them")
    group.add_argument("--poses", metavar="FILE", help="poses or projection matrices, where SOURCE holds none")
    group.add_argument("--camera", metavar="MODEL,...|FILE", help="the lens, where poses come without one")
    group.add_argument("--mask-path", metavar="DIR", help="folder of masks named IMAGE.png; the object is white")
    group.add_argument(
        "--mask-source", metavar="NAME", help="alpha, mask, background or grabcut; default: what is there"
    )
    group.add_argument(
        "--background", metavar="FILE", help="photograph without the object, from where all others were taken"
    )


def object_options(args: argparse.Namespace) -> dict[str, str | None]:
    """What flags of :func:`add_object_flags` set, for :func:`options_of`."""
    return {
        "images.camera": args.camera, "images.mask_path": args.mask_path, "masks.mask_source": args.mask_source,
        "masks.background": args.background,
    }  # fmt: skip


@contextlib.contextmanager
def listening(args: argparse.Namespace) -> Iterator[Events]:
    """Events, shown as the flags ask. Ctrl-C, SIGTERM or SIGHUP ends the run at its next step, a second one at once."""
    from sfmapp.events import Events

    gc.freeze()  # what is loaded by now is never rubbish, and not looked through again
    gc.set_threshold(*_USUAL)
    listener = make_listener(quiet=args.quiet, verbose=args.verbose, as_json=args.json)
    events = Events(listener)

    with signals_stop(events.cancel, is_talking=not args.json):
        try:
            yield events
        finally:
            listener.close()
            gc.unfreeze()


@contextlib.contextmanager
def seldom_collecting() -> Iterator[None]:
    """Until a job begins Python loads a hundred thousand objects that are there to stay; looking for rubbish among them
    each time that there are a few hundred more is a tenth of that time. When the process ends it would look through all
    of them once more, a third of a second, for memory that the system takes back anyway."""
    atexit.unregister(gc.freeze)  # a program may run several commands
    atexit.register(gc.freeze)
    gc.set_threshold(100_000, *_USUAL[1:])
    try:
        yield
    finally:
        gc.set_threshold(*_USUAL)


def print_json(value: Any) -> None:
    """The machine-readable result of a command: one JSON document on stdout."""
    from sfmapp.reporting import to_json

    print(to_json(value), flush=True)


def tell_result(args: argparse.Namespace, result: Told, tell: Callable[[], None]) -> None:
    """The end of a command with a report: as JSON, in words by ``tell``, or not at all, as the flags ask."""
    if args.json:
        print_json({"exit_code": 0, "output": str(result.output), **result.report})
    elif not args.quiet:
        tell()


def took(output: Path, run: RunUsage) -> str:
    """What a run took, in words, or that there was nothing to do in its folder."""
    if run.is_up_to_date:
        return f"{output} is up to date: nothing to do"
    return f"took {run.wall_s:.1f} s, {run.cpu_s:.1f} CPU s, {run.peak_memory_mb or 0.0:.0f} MB"


def print_contradictions(found: Iterable[Contradiction]) -> None:
    """A line for each contradiction, and what to do about it."""
    for each in found:
        print(f"  CONTRADICTED: {each.message}")
        if each.advice:
            print(f"    {each.advice}")


def limit_library_threads() -> None:
    """Before numpy is imported: our own workers use the cores; a thread pool in the linear algebra beneath each of them
    would only compete with them for the cores, and would make sums depend on their number."""
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")


def options_of(flags: Mapping[str, str | None]) -> Options:
    """Options as flags of the command line set them, by the names of options; None for a flag that is not there."""
    from sfmapp.workspace.options import load_options

    return load_options([], [f"{name}={value}" for name, value in flags.items() if value is not None])


def list_options(args: argparse.Namespace) -> int:
    """Print every option with its type, default and comment."""
    from sfmapp.workspace import options

    rows = options.list_options()
    if args.json:
        print_json([dict(zip(("name", "type", "default", "comment"), row, strict=True)) for row in rows])
        return 0
    width = max(len(name) for name, *_ in rows)
    for name, kind, default, comment in rows:
        print(f"{name:<{width}}  {default}  [{kind}]\n{'':<{width}}  {comment}")
    return 0
