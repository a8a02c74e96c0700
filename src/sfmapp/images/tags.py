"""The tag directories of TIFF, which are also those of EXIF: a small reader that expects lies.

It reads what the file says and checks every offset and count against the bytes that are there; a broken entry is left
out, and nothing is ever allocated that is larger than the file. (TIFF 6.0, section 2; CIPA DC-008 for EXIF.)
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, TypeAlias

TagValue: TypeAlias = "tuple[int | float, ...] | str | bytes"

_TYPE_FORMAT: Final = MappingProxyType(
    {
        1: "B",
        3: "H",
        4: "I",
        5: "II",
        6: "b",
        8: "h",
        9: "i",
        10: "ii",
        11: "f",
        12: "d",
        13: "I",
        16: "Q",
        17: "q",
        18: "Q",
    }
)
_ASCII, _UNDEFINED = 2, 7
_RATIONAL_TYPES = (5, 10)
# A directory of a photograph has some tens of entries and no value of interest is long; more is a broken file.
_MAX_ENTRIES = 1024
_MAX_VALUES = 1 << 20


@dataclass(frozen=True)
class Directory:
    """One directory: tag number to value.

    Attributes:
        values: numbers as tuples (rationals as floats, NaN where the denominator is zero), text as str, the rest as
            bytes.
        value_offset: position in the data of each tag's value.
        next_offset: position of the directory that follows, 0 for none.
    """

    values: dict[int, TagValue]
    value_offset: dict[int, int]
    next_offset: int

    def numbers(self, tag: int) -> tuple[int | float, ...]:
        """The numbers of a tag; empty where it is absent or is no number."""
        value = self.values.get(tag, ())
        return value if isinstance(value, tuple) else ()

    def number(self, tag: int) -> float | None:
        """The first number of a tag as a float, which may be NaN or infinite; None where there is none."""
        numbers = self.numbers(tag)
        return float(numbers[0]) if numbers else None

    def text(self, tag: int) -> str:
        """The text of a tag without padding; empty where it is absent or is no text."""
        value = self.values.get(tag, "")
        return value if isinstance(value, str) else ""


EMPTY: Final = Directory({}, {}, 0)


def byte_order(data: bytes) -> str | None:
    """``<`` or ``>`` for data that begins like TIFF, classic or BigTIFF, None for anything else."""
    return {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}.get(data[:4])


@dataclass(frozen=True)
class _Form:
    """How directories are written: codes of a count of entries, of values, and of an offset, and the size of an entry.

    BigTIFF has the same directories with offsets of 8 bytes.
    """

    entries: str
    values: str
    offset: str
    entry_size: int
    inline_size: int
    first_at: int


_CLASSIC = _Form("H", "I", "I", 12, 4, 4)
_BIG = _Form("Q", "Q", "Q", 20, 8, 8)


def _form(data: bytes) -> _Form:
    return _BIG if b"+" in data[2:4] else _CLASSIC


def first_directory(data: bytes) -> Directory:
    """The first directory of TIFF or EXIF data (which begins with ``II`` or ``MM``); empty where there is none."""
    order = byte_order(data)
    if order is None or len(data) < 16:
        return EMPTY
    form = _form(data)
    return read_directory(data, struct.unpack_from(order + form.offset, data, form.first_at)[0], order)


def sub_directory(data: bytes, parent: Directory, tag: int) -> Directory:
    """The directory that a tag of the parent points to; empty where there is none."""
    order, offset = byte_order(data), parent.number(tag)
    if order is None or offset is None or not 8 <= offset < len(data):
        return EMPTY
    return read_directory(data, int(offset), order)


def read_directory(data: bytes, offset: int, order: str) -> Directory:
    """The directory at an offset; entries that point outside the data are left out."""
    form = _form(data)
    begin = offset + struct.calcsize("=" + form.entries)
    if offset < 8 or begin > len(data):
        return EMPTY
    count = struct.unpack_from(order + form.entries, data, offset)[0]
    if count > _MAX_ENTRIES:
        return EMPTY
    values: dict[int, TagValue] = {}
    places: dict[int, int] = {}
    end = begin + form.entry_size * count
    for entry in range(begin, min(end, len(data) - form.entry_size + 1), form.entry_size):
        tag, kind, num = struct.unpack_from(order + "HH" + form.values, data, entry)
        value, place = _read_value(data, entry + form.entry_size - form.inline_size, kind, num, order, form)
        if value is not None:
            values[tag], places[tag] = value, place
    is_there = end + struct.calcsize("=" + form.offset) <= len(data)
    following = struct.unpack_from(order + form.offset, data, end)[0] if is_there else 0
    return Directory(values, places, following)


def _read_value(data: bytes, place: int, kind: int, num: int, order: str, form: _Form) -> tuple[TagValue | None, int]:
    code = "B" if kind in (_ASCII, _UNDEFINED) else _TYPE_FORMAT.get(kind)
    if code is None or num == 0 or num > _MAX_VALUES:
        return None, place
    size = struct.calcsize("=" + code) * num
    if size > form.inline_size:  # a value that does not fit into the entry stands elsewhere
        place = struct.unpack_from(order + form.offset, data, place)[0]
    if place + size > len(data):
        return None, place
    raw = data[place : place + size]
    if kind == _UNDEFINED:
        return raw, place
    if kind == _ASCII:
        return raw.split(b"\0", 1)[0].decode("utf-8", "replace").strip(), place
    numbers = struct.unpack(order + code * num, raw)
    if kind in _RATIONAL_TYPES:
        pairs = zip(numbers[::2], numbers[1::2], strict=True)
        return tuple(top / bottom if bottom else float("nan") for top, bottom in pairs), place
    return numbers, place
