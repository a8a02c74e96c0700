"""Which photographs of several cameras were taken together."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePath

from sfmapp.errors import InputError

_NUMBER = re.compile(r"\d+")


def match_shots(folders: Sequence[str], names: Sequence[Sequence[str]]) -> tuple[list[dict[int, int]], str]:
    """The shots of cameras, by the names of their photographs.

    Photographs with equal names belong together; else those whose names have the same last number (time stamps and
    counters: left01.jpg, right01.jpg); else those at the same place in order, if there are equally many.

    Args:
        folders: of each camera, for messages.
        names: of its photographs, in order.

    Returns:
        For each shot that two cameras and more took the position of the photograph by camera, and how they were told.

    Raises:
        InputError: nothing tells them: the counts differ, and names have nothing in common.
    """
    for told, keys in (
        ("by equal names", [[PurePath(name).stem for name in one] for one in names]),
        ("by the last number of their names", [[_last_number(name) for name in one] for one in names]),
    ):
        shots = _by_keys(keys)
        # as good as every photograph of the smallest folder has a partner; a few may have been thrown away
        if shots is not None and 2 * len(shots) > min(len(one) for one in names):
            return shots, f"{len(shots)} shots, told {told}"
    counts = [len(one) for one in names]
    if len(set(counts)) == 1:
        shots = [dict.fromkeys(range(len(names)), n) for n in range(counts[0])]
        return shots, f"{counts[0]} shots, told by the order of the names, which have nothing in common"
    found = ", ".join(f"{count} in {folder}" for count, folder in zip(counts, folders, strict=True))
    raise InputError(
        f"rig: expected photographs that were taken together, found {found}, whose names have nothing in common: which "
        "belongs to which cannot be told",
        "give the photographs of one moment the same name or number in every folder, or take away those without one",
    )


def _last_number(name: str) -> str:
    found = _NUMBER.findall(PurePath(name).stem)
    return str(int(found[-1])) if found else ""


def _by_keys(keys: Sequence[Sequence[str]]) -> list[dict[int, int]] | None:
    """Shots of photographs with equal keys; None where a camera has a key twice, or none."""
    place: dict[str, dict[int, int]] = {}
    for camera, own in enumerate(keys):
        if len(set(own)) < len(own) or "" in own:
            return None
        for n, key in enumerate(own):
            place.setdefault(key, {})[camera] = n
    return [shot for _, shot in sorted(place.items()) if len(shot) > 1]
