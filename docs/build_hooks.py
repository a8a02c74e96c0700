"""Hooks of mkdocs: help texts and options are those of the code that is there, not copies of them."""

from __future__ import annotations

import argparse
import re
from html import escape
from typing import Any

HELP = re.compile(r"^<!-- help: all -->$", re.MULTILINE)
OPTIONS = re.compile(r"^<!-- options: (\w+) -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the help texts of all commands and the options of a stage where a page asks for them."""
    markdown = HELP.sub(lambda _: help_of_all(), markdown)
    return OPTIONS.sub(lambda found: options_of(found[1]), markdown)


def help_of_all() -> str:
    """The help text of every command, under a title each."""
    import os

    os.environ["COLUMNS"] = "110"
    from sfmapp.cli.main import make_parser

    (commands,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    found: list[tuple[str, argparse.ArgumentParser]] = []
    for name, one in commands.choices.items():
        found.append((name, one))
        for ways in (action for action in one._actions if isinstance(action, argparse._SubParsersAction)):
            found += [(f"{name} {way}", each) for way, each in ways.choices.items()]
    return "\n".join(f"## {name}\n```text\n{one.format_help()}```\n" for name, one in found)


def options_of(stage: str) -> str:
    """A table of the options of a stage."""
    from sfmapp.workspace.options import list_options

    rows = [row for row in list_options() if row[0].partition(".")[0] == stage]
    if not rows:
        raise ValueError(f"expected the name of a stage, found {stage}")
    lines = ["| option | default | effect |", "|---|---|---|"]
    for name, _, default, comment in rows:
        effect = escape(comment.replace("``", "`"), quote=False).replace("|", "\\|").replace("\n", " ")
        lines.append(f"| `{name}` | `{default}` | {effect} |")
    return "\n".join(lines)
