"""Addresses of streams: what is accepted, and what of them may be told.

Cameras on the network are called by addresses that hold their passwords: ``rtsp://user:password@host/``, or
``?token=...``. These go to the camera and nowhere else: no log, report or message names them.
"""

from __future__ import annotations

import re
from urllib.parse import urlsplit

from sfmapp.errors import InputError

_LONGEST = 2048
_USER = re.compile(r"(?<=://)[^/?#]*@")
_SECRETS = re.compile(
    r"(?i)(?<=[?&;/])([^=&;#/]*(?:pass|pwd|token|key|secret|auth|sig|cred|user|login)[^=&;#/]*)=[^&;#]*"
)
HIDDEN = "***"


def without_credentials(source: str) -> str:
    """A source as it may be told: user, password and secrets of a query replaced; paths are left as they are."""
    if "://" not in source:
        return source
    return _SECRETS.sub(rf"\1={HIDDEN}", _USER.sub(f"{HIDDEN}@", source))


def check_address(source: str) -> None:
    """Raises InputError where a URL could not be that of a stream: before anything is connected."""
    shown = without_credentials(source[:_LONGEST])
    if len(source) > _LONGEST:
        raise InputError(f"{shown[:80]}...: expected an address of at most {_LONGEST} characters, found {len(source)}")
    if any(not char.isprintable() or char.isspace() for char in source):
        text = shown.encode("unicode_escape").decode("ascii")
        raise InputError(f"{text}: expected an address without blanks and control characters", "write a blank as %20")
    try:
        parts = urlsplit(source)
        has_host, _ = bool(parts.hostname), parts.port
    except ValueError as error:
        raise InputError(f"{shown}: expected an address of a stream: {error}") from None
    if not has_host and parts.scheme.lower() not in ("udp", "rtp", "srt"):  # these may listen
        raise InputError(f"{shown}: expected an address with a host, such as rtsp://192.168.0.9:554/stream")
