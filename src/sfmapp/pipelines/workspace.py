"""The workspace: the folder that a run writes, and the memory of what in it is still good.

``run.json`` holds the effective options, the versions, the seed, the digests of the inputs and one key per stage: a
hash of the stage's inputs, its options and its source code. A stage whose key is unchanged and which is marked done is
not run again. The manifest is written before a stage begins to overwrite anything and after it has ended, so that a run
may be cut off anywhere.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import platform
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfmapp import kernel_cache
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.atomic import replaced_file
from sfmapp.images.products import FORMAT_NAME, MANIFEST

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sfmapp.scene.reconstruction import Reconstruction

FORMAT = f"{FORMAT_NAME} 1"
# the commands that write workspaces; manifests of before the second one name none
RECONSTRUCT, ODOMETRY, REFINE, DENSE, UNDISTORT = "reconstruct", "odometry", "refine", "dense", "undistort"
LOCK = ".lock"
# where the photographs of a COLMAP model are by its custom, from MODEL and from PROJECT/sparse/0
USUAL_FOLDERS = ("images", "../images", "../../images")
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")
_PACKAGE = Path(__file__).resolve().parent.parent
_RECORDED_VERSIONS = ("numpy", "numba", "opencv-contrib-python-headless", "gtsam", "scipy")


class Workspace:
    """One output folder, locked by this process while it is open. Make it with :func:`open_workspace`."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self.folder = folder
        self.manifest = manifest

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    @property
    def log(self) -> Path:
        return self.folder / "log.jsonl"

    @property
    def recording(self) -> Path:
        return self.folder / "recording.rrd"

    def model(self, idx: int = 0) -> Path:
        """Folder of a model; 0 is the largest."""
        return self.folder / "sparse" / str(idx)

    def is_current(self, stage: str, key: str) -> bool:
        """The stage was run to its end with this key."""
        entry = self.manifest["stages"].get(stage, {})
        return bool(entry.get("key") == key and entry.get("is_done"))

    def has_key(self, stage: str, key: str) -> bool:
        """The stage was begun with this key: what it has stored so far can be used."""
        return bool(self.manifest["stages"].get(stage, {}).get("key") == key)

    def begin(self, stage: str, key: str, **facts: Any) -> None:
        """Note, before anything is overwritten, that the stage now works under this key."""
        self.manifest["stages"][stage] = {"key": key, "is_done": False, **facts}
        self.save()

    def finish(self, stage: str, usage: dict[str, float], **facts: Any) -> None:
        """Note that the stage has ended, with its time and memory. The caller saves."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self.manifest["stages"][stage] |= {"is_done": True, "finished": now, **usage, **facts}

    def save(self) -> None:
        """Write ``run.json``, beside and renamed."""
        self.write_json(MANIFEST, self.manifest)

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file of the workspace, beside and renamed."""
        self.write_text(name, json.dumps(value, indent=1, default=plain_number) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file of the workspace, beside and renamed."""
        with replaced_file(self.folder / name) as beside:
            # a name in it may not be text
            beside.write_text(text, encoding="utf-8", errors="backslashreplace")

    def read_json(self, name: str) -> Any:
        """A JSON file of the workspace; None if it is not there or damaged."""
        return _read_json(self.folder / name)

    def write_models(
        self, models: Sequence[Reconstruction], keypoints: list[NDArray[np.float64]] | None = None
    ) -> None:
        """Write ``sparse/0``, ``sparse/1`` and so on, and take away what an earlier run left behind them.

        Only files that sfmapp itself writes are replaced or removed: whatever else lies in these folders stays.
        """
        from sfmapp.formats.colmap import write_model

        for idx, model in enumerate(models):
            write_model(self.model(idx), model, keypoints)
        self._remove_models(len(models))

    def _remove_models(self, first: int) -> None:
        for folder in self.folder.glob("sparse/*"):
            if folder.name.isdigit() and int(folder.name) >= first:
                for name in MODEL_FILES:
                    (folder / name).unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # something of the user's is in it
                    folder.rmdir()


@contextlib.contextmanager
def open_workspace(folder: Path, command: str = RECONSTRUCT) -> Iterator[Workspace]:
    """Make or open the workspace of a command and lock it until the block ends.

    Raises:
        UsageError: the folder holds something that is not a workspace, or the results of another command, or another
            run is at work in it.
        InputError: it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        manifest = _manifest_of(folder)
        if manifest is not None:
            _check_command(folder, manifest, command)
        lock = _lock(folder / LOCK)
        lock.__enter__()
    except (NotADirectoryError, FileExistsError) as error:
        raise UsageError(f"{error.filename} is a file: the output must be a folder", "choose another OUT") from error
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror}", "choose another OUT") from error
    with contextlib.ExitStack() as stack:
        stack.push(lock)
        workspace = Workspace(folder, _manifest_of(folder) or _new_manifest(command))
        if manifest is None:
            workspace.save()
        yield workspace


def read_manifest(folder: Path, command: str | None = None) -> dict[str, Any]:
    """The manifest of an existing workspace, for commands that only look at one; of a certain command if one is given.

    Raises:
        InputError: the folder is not a workspace, or holds what is left of an odometry run that was cut off.
        UsageError: it holds the results of another command.
    """
    manifest = _read_json(folder / MANIFEST) if folder.is_dir() else None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f"{folder} is not a workspace of sfmapp", "give the OUT of an earlier run")
    if command is not None:
        _check_command(folder, manifest, command)
    _check_ended(folder, manifest)
    return manifest


def _check_ended(folder: Path, manifest: dict[str, Any]) -> None:
    """Refuse an odometry run that is still at work or was cut off: its files may be those of an earlier run."""
    if not manifest.get("stages", {}).get(ODOMETRY, {}).get("is_done", True):
        raise InputError(
            f"{folder}: expected a run that has ended, found one that is still at work or was cut off",
            f"what it has tracked is in {folder / 'trajectory_live.tum'}; sfmapp odometry begins again",
        )


def _check_command(folder: Path, manifest: dict[str, Any], command: str) -> None:
    found = manifest.get("command", RECONSTRUCT)
    if found != command:
        raise UsageError(
            f"{folder} holds the results of sfmapp {found}, not of sfmapp {command}",
            f"nothing in it was touched; give the folder of a sfmapp {command}, or a new one to write to",
        )


def canonical_json(value: Any) -> str:
    """The one spelling of plain values that hashes are made of."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)


def stage_key(packages: Sequence[str], options: Any, *inputs: Any) -> str:
    """Key of a stage: a hash of the source of the packages that it runs, its plain options and its plain inputs."""
    text = canonical_json([[source_digest(package) for package in packages], options, list(inputs)])
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@cache
def source_digest(package: str) -> str:
    """Hash of the source files of one of our packages: the version of a stage that nobody has to remember to raise."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted((_PACKAGE / package).glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def recorded_versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    from importlib import metadata

    versions = {"python": platform.python_version()}
    for name in _RECORDED_VERSIONS:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def plain_number(value: Any) -> Any:
    """What JSON makes of numpy's scalars and arrays, of paths and of sets; for ``json.dumps(default=...)``."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(value)


def _new_manifest(command: str) -> dict[str, Any]:
    return {"format": FORMAT, "command": command, "stages": {}, "inputs": {}}


def _manifest_of(folder: Path) -> dict[str, Any] | None:
    """Manifest of a folder that is a workspace, None if it is empty; refuses any other folder."""
    manifest = _read_json(folder / MANIFEST)
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


def _kernels_in(folder: Path) -> str | None:
    """Name of what is in a folder because the user had compiled kernels put there, for want of another place."""
    place = Path(os.environ.get(kernel_cache.VARIABLE) or os.curdir).absolute()
    return place.relative_to(folder.absolute()).parts[0] if folder.absolute() in place.parents else None


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold a lock file. The kernel lets go of it when the process dies, so no stale lock can stand in the way."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.read(descriptor, 32).decode(errors="replace").strip()
            os.close(descriptor)
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise
            raise UsageError(
                f"another run (process {owner or 'unknown'}) is at work in {path.parent}",
                "wait for it to end, stop it, or choose another OUT",
            ) from error
        # the run before us may have taken the file away between our open and our lock
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(descriptor).st_ino == path.stat().st_ino:
                break
        os.close(descriptor)
    try:
        os.truncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)
