"""Two photographs of one moment: rectified, matched in every pixel, measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sfmapp.stereo.matcher import Matcher

__all__ = ["Matcher"]


def __getattr__(name: str) -> Any:
    """The matcher, which brings numba with it, is imported when it is asked for."""
    if name == "Matcher":
        from sfmapp.stereo.matcher import Matcher

        return Matcher
    raise AttributeError(name)
