"""``run.json``: what a workspace remembers of the run that wrote it, and whose a folder is.

It holds the effective options, the versions, the seed, the digests of the inputs and one key per stage.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sfmapp import kernel_cache
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.images.products import FORMAT_NAME, IN_MEMORY
from sfmapp.workspace.layout import FORMAT, LOCK, MANIFEST, ODOMETRY, RECONSTRUCT

_RECORDED_VERSIONS = ("numpy", "numba", "opencv-contrib-python-headless", "gtsam", "scipy")


def read_manifest(folder: Path, command: str | None = None) -> dict[str, Any]:
    """The manifest of an existing workspace, for commands that only look at one; of a certain command if one is given.

    Raises:
        InputError: the folder is not a workspace, or holds what is left of an odometry run that was cut off.
        UsageError: it holds the results of another command.
    """
    manifest = read_json(folder / MANIFEST) if folder.is_dir() else None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f"{folder} is not a workspace of sfmapp", "give the OUT of an earlier run")
    if command is not None:
        check_command(folder, manifest, command)
    _check_ended(folder, manifest)
    return manifest


def manifest_of(folder: Path) -> dict[str, Any] | None:
    """Manifest of a folder that is a workspace, None if it is empty; refuses any other folder."""
    manifest = read_json(folder / MANIFEST)
    if isinstance(manifest, dict) and str(manifest.get("format", "")).startswith(FORMAT_NAME):
        if manifest["format"] == FORMAT:
            return manifest
        raise UsageError(
            f"{folder} was written by another version of sfmapp ({manifest['format']})", "choose another OUT"
        )
    known = (LOCK, f".{MANIFEST}.new", _kernels_in(folder))
    strangers = sorted(path.name for path in folder.iterdir() if path.name not in known)
    if strangers:
        found = ", ".join(strangers[:3]) + (", ..." if len(strangers) > 3 else "")
        raise UsageError(
            f"{folder} is not empty and is no workspace of sfmapp (it holds {found})",
            "nothing in it was touched; give -o a new or an empty folder",
        )
    return None


def new_manifest(command: str) -> dict[str, Any]:
    """The manifest of a workspace that a command begins."""
    return {"format": FORMAT, "command": command, "stages": {}, "inputs": {}}


def check_command(folder: Path, manifest: dict[str, Any], command: str) -> None:
    """Raise UsageError if the workspace is that of another command."""
    found = manifest.get("command", RECONSTRUCT)
    if found != command:
        raise UsageError(
            f"{folder} holds the results of sfmapp {found}, not of sfmapp {command}",
            f"nothing in it was touched; give the folder of a sfmapp {command}, or a new one to write to",
        )


class AsBeforeError(NoReconstructionError):
    """An earlier run has ended so and written its report, and nothing has changed."""


def raise_as_before(stage: Mapping[str, Any]) -> None:
    """Raise what the run of a stage has ended with, where it came to nothing.

    Args:
        stage: its entry of the manifest.

    Raises:
        AsBeforeError: it did.
    """
    outcome = stage.get("outcome") or {}
    if outcome.get("exit_code") == NoReconstructionError.exit_code:
        raise AsBeforeError(f"{outcome['message']} (as before: nothing has changed)", outcome["advice"])


def missing_photographs(folder: Path, manifest: Mapping[str, Any]) -> InputError:
    """What to say where the photographs of a reconstruction are wanted and :func:`image_root` is None."""
    if manifest.get("source") == IN_MEMORY:
        return InputError(
            f"{folder}: its photographs were arrays in memory, of which no pixels were kept",
            "write them as files under the names that they have in the model, and give that folder: --images DIR",
        )
    place = manifest.get("image_root") or manifest.get("source") or "a folder that run.json does not name"
    return InputError(f"{folder}: expected its photographs in {place}, found no such folder", "give --images DIR")


def image_root(manifest: Mapping[str, Any]) -> Path | None:
    """The folder that the names of a workspace's images are relative to; None where it is not known, or gone.

    A reconstruction has noted it, as a pattern or a list names photographs, not their folder; all else is made of one.
    """
    noted = manifest.get("image_root") or manifest.get("source")
    return Path(noted) if noted and os.path.isdir(noted) else None


def recorded_versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    from importlib import metadata

    versions = {"python": platform.python_version()}
    for name in _RECORDED_VERSIONS:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def read_json(path: Path) -> Any:
    """A JSON file; None if it is not there or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _check_ended(folder: Path, manifest: dict[str, Any]) -> None:
    """Refuse an odometry run that is still at work or was cut off: its files may be those of an earlier run."""
    if not manifest.get("stages", {}).get(ODOMETRY, {}).get("is_done", True):
        raise InputError(
            f"{folder}: expected a run that has ended, found one that is still at work or was cut off",
            f"what it has tracked is in {folder / 'trajectory_live.tum'}; sfmapp odometry begins again",
        )


def _kernels_in(folder: Path) -> str | None:
    """Name of what is in a folder because the user had compiled kernels put there, for want of another place."""
    place = Path(os.environ.get(kernel_cache.VARIABLE) or os.curdir).absolute()
    return place.relative_to(folder.absolute()).parts[0] if folder.absolute() in place.parents else None
