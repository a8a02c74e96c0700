"""``sfmapp calibrate print-board``: a board on paper, at true size."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfmapp.calibration.board_forms import BOARD_FORMS
from sfmapp.cli.common import add_output_flags, print_json


def add_way(ways: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add this way to the parser."""
    parser = ways.add_parser(
        "print-board", help="a board on paper, at true size, as SVG or PDF",
        description="Write a board to print at true size. Glue it to something flat and measure a square.",
        epilog=BOARD_FORMS, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="ends in .svg or .pdf")
    parser.add_argument("--board", metavar="BOARD", help="what to print; default: a ChArUco board that fills the sheet")
    parser.add_argument("--paper", choices=("A4", "A3", "letter"), default="A4", help="default: A4")
    add_output_flags(parser)
    parser.set_defaults(run=_print_board)


def _print_board(args: argparse.Namespace) -> int:
    from sfmapp.calibration.boards import parse_board
    from sfmapp.calibration.printing import default_board, write_board

    board = default_board(args.paper) if args.board is None else parse_board(args.board)
    write_board(args.output, board, args.paper)
    if args.json:
        print_json({"exit_code": 0, "output": str(args.output), "board": board.text(), "paper": args.paper})
    elif not args.quiet:
        print(f"{args.output}: {args.paper}, print it at 100 %; then: sfmapp calibrate board --board {board.text()}")
    return 0
