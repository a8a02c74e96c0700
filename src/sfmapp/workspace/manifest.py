"""``run.json``: what a workspace remembers of the run that wrote it, and whose a folder is.

It holds the effective options, the versions, the seed, the digests of the inputs and one key per stage.

A :class:`Manifest` is never changed in place: :meth:`Workspace.note` puts another one in its place.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sfmapp import kernel_cache
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.images.products import FORMAT_NAME, IN_MEMORY
from sfmapp.odometry.report import MapFacts
from sfmapp.report.model import Outcome, UndistortNumbers
from sfmapp.reporting import Plain, Report, Usage, from_plain
from sfmapp.workspace.layout import FORMAT, LOCK, MANIFEST, ODOMETRY, RECONSTRUCT

_RECORDED_VERSIONS = ("numpy", "numba", "opencv-contrib-python-headless", "gtsam", "scipy")


class StageEntry(Report):
    """What is remembered of a stage; what was not noted is absent.

    Attributes:
        key: that it was begun with. is_done: it has ended. finished: when, date and time in UTC.
        wall_s, cpu_s, peak_memory_mb, num_compiled: what it took; see :class:`~sfmapp.reporting.Usage`.
        outcome: how it ended, where it may come to nothing.
        pixels, orientations, num_models, run: of ``mapping``: what the model counts in, EXIF's orientation of the
            photographs that it turns, how many models there are, and what the whole run took.
        maps: of ``odometry``.
        model: of ``dense``: hash of the model that the patches are of.
        names, report: of ``undistort``: the pictures that are written, and what came of it.
    """

    key: str | None = None
    is_done: bool | None = None
    finished: str | None = None
    wall_s: float | None = None
    cpu_s: float | None = None
    peak_memory_mb: float | None = None
    num_compiled: int | None = None
    outcome: Outcome | None = None
    pixels: str | None = None
    orientations: Mapping[str, int] | None = None
    num_models: int | None = None
    run: Usage | None = None
    maps: Sequence[MapFacts] | None = None
    model: str | None = None
    names: Sequence[str] | None = None
    report: UndistortNumbers | None = None


class Manifest(Report):
    """What a workspace remembers.

    Attributes:
        format, command: of the workspace, and what wrote it.
        stages: by name.
        inputs: digests of what was worked on, by name.
        source: what was worked on, an absolute path; empty until it is known.
        options: of all stages, as they were in effect. versions: of what a result depends on.
        seed: of the run. usage: of each step. recording: what became of it.
        image_root: folder that the names of the photographs are relative to.
        added: where photographs came from that were added to a finished reconstruction, one after the other.
        model, is_upright, photographs: of what was made of another program's model: its folder, whether it counts
            pixels in photographs turned as EXIF says, and the folder of these.
    """

    format: str
    command: str
    stages: Mapping[str, StageEntry]
    inputs: Mapping[str, str]
    source: str = ""
    options: Mapping[str, Plain]
    versions: Mapping[str, str]
    seed: int | None = None
    usage: Mapping[str, Usage] | None = None
    recording: str | None = None
    image_root: str | None = None
    added: Sequence[str] | None = None
    model: str | None = None
    is_upright: bool | None = None
    photographs: str | None = None

    def stage(self, name: str) -> StageEntry:
        """What is remembered of a stage; nothing of one that was not begun."""
        return self.stages.get(name, StageEntry())


# what early manifests, and those of a run that has just begun, do not say
_UNSAID: dict[str, Plain] = {
    "command": RECONSTRUCT, "stages": {}, "inputs": {}, "source": "", "options": {}, "versions": {},
}  # fmt: skip


def _manifest(folder: Path, value: Mapping[str, Plain]) -> Manifest:
    """Raises InputError if it is damaged."""
    try:
        return from_plain(Manifest, {**_UNSAID, **value})
    except ValueError as error:
        raise InputError(f"{folder / MANIFEST}: {error}", "run again into a new folder") from error


def read_manifest(folder: Path, command: str | None = None) -> Manifest:
    """The manifest of an existing workspace, for commands that only look at one; of a certain command if one is given.

    Raises:
        InputError: the folder is not a workspace, or holds what is left of an odometry run that was cut off.
        UsageError: it holds the results of another command.
    """
    found = read_json(folder / MANIFEST) if folder.is_dir() else None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(f"{folder} is not a workspace of sfmapp", "give the OUT of an earlier run")
    manifest = _manifest(folder, found)
    if command is not None:
        check_command(folder, manifest, command)
    _check_ended(folder, manifest)
    return manifest


def manifest_of(folder: Path) -> Manifest | None:
    """Manifest of a folder that is a workspace, None if it is empty; refuses any other folder."""
    manifest = read_json(folder / MANIFEST)
    if isinstance(manifest, dict) and str(manifest.get("format", "")).startswith(FORMAT_NAME):
        if manifest["format"] == FORMAT:
            return _manifest(folder, manifest)
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


def new_manifest(command: str) -> Manifest:
    """The manifest of a workspace that a command begins."""
    return Manifest(format=FORMAT, command=command, stages={}, inputs={}, options={}, versions={})


def check_command(folder: Path, manifest: Manifest, command: str) -> None:
    """Raise UsageError if the workspace is that of another command."""
    if manifest.command != command:
        raise UsageError(
            f"{folder} holds the results of sfmapp {manifest.command}, not of sfmapp {command}",
            f"nothing in it was touched; give the folder of a sfmapp {command}, or a new one to write to",
        )


class AsBeforeError(NoReconstructionError):
    """An earlier run has ended so and written its report, and nothing has changed."""


def raise_as_before(stage: StageEntry) -> None:
    """Raise what the run of a stage has ended with, where it came to nothing.

    Args:
        stage: its entry of the manifest.

    Raises:
        AsBeforeError: it did.
    """
    outcome = stage.outcome
    if outcome is not None and outcome.exit_code == NoReconstructionError.exit_code:
        raise AsBeforeError(f"{outcome.message} (as before: nothing has changed)", outcome.advice)


def missing_photographs(folder: Path, manifest: Manifest) -> InputError:
    """What to say where the photographs of a reconstruction are wanted and :func:`image_root` is None."""
    if manifest.source == IN_MEMORY:
        return InputError(
            f"{folder}: its photographs were arrays in memory, whose pixels were not kept",
            "write them as files under the names that they have in the model, and give that folder: --images DIR",
        )
    place = manifest.image_root or manifest.source or "a folder that run.json does not name"
    return InputError(f"{folder}: expected its photographs in {place}, found no such folder", "give --images DIR")


def image_root(manifest: Manifest) -> Path | None:
    """The folder that the names of a workspace's images are relative to; None where it is not known, or gone.

    A reconstruction has noted it, as a pattern or a list names photographs, not their folder; all else is made of one.
    """
    noted = manifest.image_root or manifest.source
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


def _check_ended(folder: Path, manifest: Manifest) -> None:
    """Refuse an odometry run that is still at work or was cut off: its files may be those of an earlier run."""
    if manifest.stage(ODOMETRY).is_done is False:
        raise InputError(
            f"{folder}: expected a run that has ended, found one that is still running or was interrupted",
            f"what it has tracked is in {folder / 'trajectory_live.tum'}; sfmapp odometry begins again",
        )


def _kernels_in(folder: Path) -> str | None:
    """Name of what is in a folder because the user had compiled kernels put there, for want of another place."""
    place = Path(os.environ.get(kernel_cache.VARIABLE) or os.curdir).absolute()
    return place.relative_to(folder.absolute()).parts[0] if folder.absolute() in place.parents else None
