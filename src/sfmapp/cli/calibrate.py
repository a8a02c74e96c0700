"""``sfmapp calibrate``: cameras from boards, targets, lines and rigs. Each way is a file ``calibrate_WAY`` beside this
one, with ``add_way``."""

from __future__ import annotations

import argparse
import importlib
import pkgutil

from sfmapp import cli


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its ways to the parser."""
    parser = commands.add_parser(
        "calibrate", help="a camera from photographs of a board, with the sigma of every parameter",
        description="Find what a camera does to rays, how sure that is, and what to photograph next. The result is "
        "taken by --camera of reconstruct and odometry.",
    )  # fmt: skip
    ways = parser.add_subparsers(title="ways", metavar="WAY", required=True)
    for module in sorted(found.name for found in pkgutil.iter_modules(cli.__path__)):
        if module.startswith("calibrate_"):
            importlib.import_module(f"{cli.__name__}.{module}").add_way(ways)
    for way in ways.choices.values():
        way.allow_abbrev = False  # as those of the commands
