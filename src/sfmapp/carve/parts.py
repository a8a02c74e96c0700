"""Parts of a range, done on threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

# enough that handing a part to a thread costs nothing beside it
_CHUNK = 1 << 15


def in_parts(run: Callable[[int, int], None], num: int, pool: ThreadPoolExecutor, chunk: int = _CHUNK) -> None:
    """Call ``run(first, last)`` for parts of a range of ``num``, each of ``chunk`` but for the last one."""
    if num <= chunk:
        run(0, num)
    else:
        list(pool.map(lambda first: run(first, min(num, first + chunk)), range(0, num, chunk)))
