"""A benchmark of named cases that can be measured one by one: what was measured of the others before is kept."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from machine import RESULTS, describe_machine

Row = dict[str, Any]


def measure_cases(
    name: str, description: str | None, cases: Iterable[str], measured: Callable[[str], Iterable[Row]],
    markdown: Callable[[dict[str, Any]], str],
) -> None:  # fmt: skip
    """Measure cases, all or those on the command line, and write results/NAME.json and .md after each.

    Args:
        measured: the rows of a case, each with its name as "case"; the commit that they were measured at is added.
        markdown: the text of a report with "rows" in the order of the cases.
    """
    cases = list(cases)
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / f"{name}.json")
    parser.add_argument("--only", nargs="+", metavar="CASE", choices=cases,
                        help="measure these, and keep what is there of the others")  # fmt: skip
    args = parser.parse_args()
    told: list[Row] = []
    if args.only and args.output.is_file():
        before = json.loads(args.output.read_text())
        told = [{"commit": before["commit"]} | row for row in before["rows"]]
    machine = describe_machine()
    rows = {case: [row for row in told if row["case"] == case] for case in cases}
    for case in args.only or cases:
        rows[case] = []
        for row in measured(case):
            rows[case].append({"commit": machine["commit"]} | row)
            print(json.dumps(row), flush=True)
        report = machine | {"rows": [row for each in rows.values() for row in each]}
        args.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        args.output.with_suffix(".md").write_text(markdown(report), encoding="utf-8")
