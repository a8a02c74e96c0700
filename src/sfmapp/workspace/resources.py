"""Where the presets and the sample lie: inside an installed package, else in the checkout around it."""

from __future__ import annotations

import difflib
from pathlib import Path

from sfmapp.errors import InputError, UsageError

PACKAGE = Path(__file__).resolve().parent.parent
ROOTS = (PACKAGE / "resources", PACKAGE.parent.parent)


def preset_names() -> list[str]:
    """Names of the presets that ship with sfmapp, sorted."""
    return sorted({path.stem for root in ROOTS for path in (root / "pipelines").glob("*.toml")})


def find_preset(name: str) -> Path:
    """Path of a preset that ships with sfmapp.

    Raises:
        UsageError: there is none of this name.
    """
    for root in ROOTS:
        path = root / "pipelines" / f"{name}.toml"
        if path.is_file():
            return path
    names = preset_names()
    near = difflib.get_close_matches(name, names, 1, 0.5)
    found = f"did you mean {near[0]}?" if near else f"there are {', '.join(names)}; or give a path to a TOML file"
    raise UsageError(f"there is no preset {name!r}", found)


def sample_folder() -> Path:
    """Folder of the bundled sample, with ``images/`` and ``cameras.json``.

    Raises:
        InputError: the installation lacks it.
    """
    for root in ROOTS:
        folder = root / "data" / "courtyard"
        if (folder / "images").is_dir():
            return folder
    raise InputError(f"the bundled sample is not in {ROOTS[0]}", "install sfmapp again")
