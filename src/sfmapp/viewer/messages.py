"""Messages with arrays from a run to the child that draws it, through a pipe."""

from __future__ import annotations

import os
import pickle
import struct
from collections.abc import Callable
from typing import Any


def write_message(descriptor: int, message: dict[str, Any]) -> None:
    """Pickle a message without copying its arrays: sizes, the pickle, then the bytes of each array."""
    buffers: list[pickle.PickleBuffer] = []
    parts: list[Any] = [pickle.dumps(message, 5, buffer_callback=buffers.append), *(buffer.raw() for buffer in buffers)]
    sizes = [len(memoryview(part).cast("B")) for part in parts]
    _write(descriptor, struct.pack(f"<{1 + len(sizes)}Q", len(sizes), *sizes))
    for part in parts:
        _write(descriptor, part)


def _write(descriptor: int, data: Any) -> None:
    view = memoryview(data).cast("B")
    while len(view):
        view = view[os.write(descriptor, view) :]


def read_message(read: Callable[[int], bytes]) -> dict[str, Any] | None:
    """What :func:`write_message` wrote; None at the end, also where it comes in the middle of a message."""
    head = read(8)
    if len(head) < 8:
        return None
    (count,) = struct.unpack("<Q", head)
    table = read(8 * count)
    if len(table) < 8 * count:
        return None
    sizes = struct.unpack(f"<{count}Q", table)
    parts = [bytearray(read(size)) for size in sizes]
    if any(len(part) < size for part, size in zip(parts, sizes, strict=True)):
        return None
    message: dict[str, Any] = pickle.loads(parts[0], buffers=parts[1:])
    return message
