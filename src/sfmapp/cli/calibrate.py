"""``sfmapp calibrate``: cameras from boards, targets, lines and rigs. Each way has a file beside this one."""

from __future__ import annotations

import argparse

from sfmapp.cli import calibrate_print

# a way to calibrate is a module with add_command(ways), named here
WAYS = (calibrate_print,)


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its ways to the parser."""
    parser = commands.add_parser(
        "calibrate", help="a camera from photographs of a board, with the sigma of every parameter",
        description="Find what a camera does to rays, how sure that is, and what to photograph next. The result is "
        "taken by --camera of reconstruct and odometry.",
    )  # fmt: skip
    ways = parser.add_subparsers(title="ways", metavar="WAY", required=True)
    for way in WAYS:
        way.add_command(ways)
    for one in ways.choices.values():
        one.allow_abbrev = False
