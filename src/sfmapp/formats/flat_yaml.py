"""The part of YAML that calibration files are written in: maps, lists and scalars, nested by indentation or brackets.

Anchors, aliases, block strings and several documents are refused. Tags such as OpenCV's ``!!opencv-matrix`` are read
over: nothing is built or evaluated.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NoReturn

from sfmapp.errors import InputError
from sfmapp.formats.text_input import read_limited_text

_LARGEST_BYTES = 1 << 22
_DEEPEST = 20
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_TAG = re.compile(r"![^\s\[\]{},]*")


def read_flat_yaml(path: Path) -> dict[str, Any]:
    """The map that a file holds: keys are text; values are maps, lists, numbers, booleans, None and text.

    Raises:
        InputError: the file cannot be read, holds no map, or goes beyond the part of YAML that is read.
    """
    return parse_flat_yaml(read_limited_text(path, _LARGEST_BYTES), str(path))


def parse_flat_yaml(text: str, place: str) -> dict[str, Any]:
    """As :func:`read_flat_yaml`, of text; ``place`` begins the messages."""
    parser = _Parser(text, place)
    value = parser.block(0, 0) if parser.lines else None
    if not isinstance(value, dict):
        raise InputError(f"{place}: expected lines of 'name: value' (YAML), found {text.strip()[:40]!r}")
    if parser.position < len(parser.lines):
        parser.refuse("a line that is indented like those around it")
    return value


class _Parser:
    """Lines (indent, content, number), joined where brackets are open, and a position among them."""

    def __init__(self, text: str, place: str) -> None:
        self.place = place
        self.position = 0
        self.lines: list[tuple[int, str, int]] = []
        parts: list[str] = []
        depth = first = indent = 0
        for number, line in enumerate(text.splitlines(), 1):
            content = _without_comment(line)
            if not content.strip() or (not parts and (content.startswith("%") or content.strip() == "---")):
                continue
            if not parts:
                first, indent = number, len(content) - len(content.lstrip(" "))
            parts.append(content.strip())
            depth += _open_brackets(content)
            if depth <= 0:
                self.lines.append((indent, " ".join(parts), first))
                parts, depth = [], 0
        if parts:
            raise InputError(f"{place}:{first}: expected a closing bracket, found the end of the file")

    def refuse(self, expected: str) -> NoReturn:
        _, content, number = self.lines[min(self.position, len(self.lines) - 1)]
        raise InputError(f"{self.place}:{number}: expected {expected}, found {content[:80]!r}")

    def block(self, least_indent: int, depth: int) -> Any:
        """The map, list or scalar that begins here, indented by ``least_indent`` or more; None if there is none."""
        if self.position >= len(self.lines) or self.lines[self.position][0] < least_indent:
            return None
        if depth > _DEEPEST:
            self.refuse(f"no more than {_DEEPEST} levels")
        indent, content, _ = self.lines[self.position]
        if _is_item(content):
            return self._list(indent, depth)
        if _key(content, 0) is not None:
            return self._map(indent, depth)
        value = self._inline(content)
        self.position += 1
        return value

    def _list(self, indent: int, depth: int) -> list[Any]:
        values = []
        while self.position < len(self.lines):
            at, content, number = self.lines[self.position]
            if at != indent or not _is_item(content):
                break
            rest = content[1:].lstrip()
            if rest:  # what stands behind the dash is a block of its own, indented by where it begins
                self.lines[self.position] = (indent + len(content) - len(rest), rest, number)
            else:
                self.position += 1
            values.append(self.block(indent + 1, depth + 1))
        return values

    def _map(self, indent: int, depth: int) -> dict[str, Any]:
        values: dict[str, Any] = {}
        while self.position < len(self.lines):
            at, content, _ = self.lines[self.position]
            found = _key(content, 0)
            if at != indent or found is None:
                break
            name, end = found
            if name in values:
                self.refuse(f"{name!r} once")
            tag = _TAG.match(content, end)
            rest = content[tag.end() if tag else end :].strip()
            if rest:
                values[name] = self._inline(rest)
                self.position += 1
                continue
            self.position += 1
            # a list may stand at the indent of its name
            has_list = self.position < len(self.lines) and _is_item(self.lines[self.position][1])
            values[name] = self.block(indent if has_list else indent + 1, depth + 1)
        return values

    def _inline(self, text: str) -> Any:
        if text[0] in "&*|>@`%":
            self.refuse("plain values (no anchors, aliases or block strings)")
        if text[0] not in "[{":
            return _scalar(text)
        value, end = self._flow(text, 0, 0)
        if text[end:].strip():
            self.refuse("nothing behind the closing bracket")
        return value

    def _flow(self, text: str, at: int, depth: int) -> tuple[Any, int]:
        """The bracketed value that begins at ``at``, and where it ends."""
        if depth > _DEEPEST:
            self.refuse(f"no more than {_DEEPEST} levels")
        closing = {"[": "]", "{": "}"}[text[at]]
        items: list[Any] = []
        named: dict[str, Any] = {}
        at = _behind_blanks(text, at + 1)
        while at < len(text) and text[at] != closing:
            name = None
            if closing == "}":
                found = _key(text, at)
                if found is None:
                    self.refuse("'name: value' inside of { }")
                name, at = found
            if at < len(text) and text[at] in "[{":
                value, at = self._flow(text, at, depth + 1)
            else:
                end = _end_of_scalar(text, at)
                value, at = _scalar(text[at:end].strip()), end
            items.append(value)
            if name is not None:
                named[name] = value
            at = _behind_blanks(text, at)
            if at < len(text) and text[at] == ",":
                at = _behind_blanks(text, at + 1)
            elif at >= len(text) or text[at] != closing:
                self.refuse(f"a comma or {closing}")
        if at >= len(text):
            self.refuse(f"a closing {closing}")
        return (named if closing == "}" else items), at + 1


def _is_item(content: str) -> bool:
    return content == "-" or content.startswith("- ")


def _key(text: str, at: int) -> tuple[str, int] | None:
    """The name before the first colon that ends a word, and where its value begins; None if there is no such name."""
    end = at
    while True:
        end = text.find(":", end)
        if end < 0:
            return None
        if end + 1 == len(text) or text[end + 1].isspace():
            break
        end += 1
    name = text[at:end].strip()
    if not name or any(c in "[]{},#&*!" for c in name):
        return None
    return name.strip("\"'"), _behind_blanks(text, end + 1)


def _behind_blanks(text: str, at: int) -> int:
    while at < len(text) and text[at].isspace():
        at += 1
    return at


def _end_of_scalar(text: str, at: int) -> int:
    if at < len(text) and text[at] in "\"'":
        end = text.find(text[at], at + 1)
        return len(text) if end < 0 else end + 1
    while at < len(text) and text[at] not in ",[]{}":
        at += 1
    return at


def _without_comment(line: str) -> str:
    quote = ""
    for i, c in enumerate(line):
        begins_word = i == 0 or line[i - 1] in " \t[,{"
        if quote:
            quote = "" if c == quote else quote
        elif c in "\"'" and begins_word:
            quote = c
        elif c == "#" and (i == 0 or line[i - 1].isspace()):
            return line[:i]
    return line


def _open_brackets(content: str) -> int:
    bare = re.sub(r""""[^"]*"|'[^']*'""", "", content)
    return sum(map(bare.count, "[{")) - sum(map(bare.count, "]}"))


def _scalar(text: str) -> Any:
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    if _NUMBER.fullmatch(text):
        # Python refuses to read longer whole numbers
        return int(text) if len(text) < 300 and re.fullmatch(r"[-+]?\d+", text) else float(text)
    return {"true": True, "false": False, "null": None, "~": None, "": None}.get(text.lower(), text)
