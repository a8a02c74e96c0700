"""What the documents say of the tree: every path and every file that they link to is there."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pytest

import sfmapp

CHECKOUT = Path(__file__).resolve().parent.parent
SOURCE = Path(sfmapp.__file__).parent
DOCUMENTS = sorted(
    [
        *CHECKOUT.glob("*.md"),
        *CHECKOUT.glob("docs/**/*.md"),
        CHECKOUT / "benchmarks" / "README.md",
        CHECKOUT / "data" / "README.md",
    ]
)
# of the checkout, for an installed package also holds the presets and the sample photographs, in `resources`
ROOMS = {path.name for path in (CHECKOUT / "src" / "sfmapp").glob("*/") if path.name != "__pycache__"}
TOP = {path.name for path in CHECKOUT.iterdir() if path.is_dir() and not path.name.startswith(".")} | {".ci"}
# a path, and maybe what is defined in it: `mapping/register.py::choose_images`
PATH = re.compile(r"`([\w.-]+(?:/[\w.-]+)+/?|[\w-]+/)(?:::(\w+))?`")
LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")

pytestmark = pytest.mark.skipif(not (CHECKOUT / "ARCHITECTURE.md").is_file(), reason="not a checkout")


def named_paths(text: str) -> set[tuple[str, str]]:
    """Paths of the tree in a document, and the name after the two colons; what a run writes begins with OUT."""
    return {(path, name) for path, name in PATH.findall(text) if path.partition("/")[0] in ROOMS | TOP}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_paths_that_are_named_are_there(document: Path) -> None:
    if document.name == "CHANGELOG.md":  # tells of what was
        return
    for path, name in named_paths(document.read_text(encoding="utf-8")):
        found = [root / path for root in (SOURCE, CHECKOUT) if (root / path).exists()]
        assert found, f"{document.name} names {path}"
        if name:
            pattern = rf"^\s*(?:def|class) {name}\b|^{name}\b.*="
            assert re.search(pattern, found[0].read_text(encoding="utf-8"), re.MULTILINE), f"{path} has no {name}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_links_lead_somewhere(document: Path) -> None:
    for link in LINK.findall(document.read_text(encoding="utf-8")):
        if not link.startswith(("http://", "https://")):
            assert (document.parent / link).exists(), f"{document.name} links to {link}"


def test_every_room_is_in_the_architecture() -> None:
    text = (CHECKOUT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert {room for room in ROOMS if not re.search(rf"(^| ){room} ", text, re.MULTILINE)} == set()


def test_every_command_is_documented() -> None:
    assert "<!-- help: all -->" in (CHECKOUT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    readme = (CHECKOUT / "README.md").read_text(encoding="utf-8")
    found = commands()
    assert "reconstruct" in found
    for command in found:
        assert command == "demo" or f"sfmapp {command} " in readme, command


def commands() -> list[str]:
    """Names of all commands."""
    from sfmapp.cli.main import make_parser

    (action,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    return list(action.choices)


def test_pictures_are_used_and_small() -> None:
    pictures = {path.name: path.stat().st_size for path in (CHECKOUT / "docs" / "pictures").iterdir()}
    text = "".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
    assert {name for name in pictures if f"pictures/{name}" not in text} == set()
    assert sum(pictures.values()) < 1_500_000
