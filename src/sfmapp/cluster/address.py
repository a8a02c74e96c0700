"""Where a cluster is, as options name it."""

from __future__ import annotations

import re

from sfmapp.errors import UsageError

_LOCAL = re.compile(r"local:([1-9]\d{0,2})")
_REMOTE = re.compile(r"(tcp|tls)://[^\s/]+:\d+")
ADVICE = "local:4 starts four workers here; tcp://HOST:PORT and tls://HOST:PORT are schedulers of dask"


def num_local(address: str) -> int | None:
    """How many workers an address asks for on this machine; None for one of a scheduler.

    Raises:
        UsageError: it is no address of a cluster.
    """
    if local := _LOCAL.fullmatch(address):
        return int(local[1])
    if not _REMOTE.fullmatch(address):
        raise UsageError(f"cluster is {address!r}: expected local:N, tcp://HOST:PORT or tls://HOST:PORT", ADVICE)
    return None
