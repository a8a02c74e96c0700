"""The workspace: the folder that a run writes, and the memory of what in it is still good.

``run.json`` holds the effective options, the versions, the seed, the digests of the inputs and one key per stage: a
hash of the stage's inputs, its options and its source code. A stage whose key is unchanged and which is marked done is
not run again. The manifest is written before a stage begins to overwrite anything and after it has ended, so that a run
may be cut off anywhere.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfmapp.errors import InputError, UsageError
from sfmapp.formats.atomic import replaced_file
from sfmapp.reporting import R, Usage, from_plain, to_json
from sfmapp.workspace.layout import LOCK, MANIFEST, RECONSTRUCT, REPORT
from sfmapp.workspace.lock import locked
from sfmapp.workspace.manifest import Manifest, StageEntry, check_command, manifest_of, new_manifest, read_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sfmapp.events import Events
    from sfmapp.scene.reconstruction import Reconstruction


class Workspace:
    """One output folder, locked by this process while it is open. Make it with :func:`open_workspace`."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
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
        return self.has_key(stage, key) and bool(self.manifest.stage(stage).is_done)

    def has_key(self, stage: str, key: str) -> bool:
        """The stage was begun with this key: what it has stored so far can be used."""
        return self.manifest.stage(stage).key == key

    def note(self, **facts: Any) -> None:
        """Put facts, fields of the manifest, in the place of what it says of them. The caller saves."""
        self.manifest = replace(self.manifest, **facts)

    def begin(self, stage: str, key: str, **facts: Any) -> None:
        """Note, before anything is overwritten, that the stage now works under this key, and facts of its entry."""
        entry = StageEntry(key=key, is_done=False, **facts)
        self.note(stages={**self.manifest.stages, stage: entry})
        self.save()

    def finish(self, stage: str, usage: Usage | None, **facts: Any) -> None:
        """Note that the stage has ended, with its time and memory. The caller saves."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        entry = replace(
            self.manifest.stages[stage], is_done=True, finished=now, **(facts if usage is None else {**usage, **facts})
        )
        self.note(stages={**self.manifest.stages, stage: entry})

    def save(self) -> None:
        """Write ``run.json``, beside and renamed."""
        self.write_json(MANIFEST, self.manifest)

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file of the workspace, beside and renamed."""
        self.write_text(name, to_json(value, indent=1) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file of the workspace, beside and renamed."""
        with replaced_file(self.folder / name) as beside:
            # a name in it may not be text
            beside.write_text(text, encoding="utf-8", errors="backslashreplace")

    def read_json(self, name: str) -> Any:
        """A JSON file of the workspace; None if it is not there or damaged."""
        return read_json(self.folder / name)

    def read_report(self, kind: type[R]) -> R | None:
        """``report.json`` of an earlier run, to show it again; None if it is not there, damaged or of another kind."""
        try:
            return from_plain(kind, self.read_json(REPORT))
        except ValueError:
            return None

    def write_models(
        self,
        models: Sequence[Reconstruction],
        keypoints: list[NDArray[np.float64]] | None = None,
        events: Events | None = None,
    ) -> None:
        """Write ``sparse/0``, ``sparse/1`` and so on, and take away what an earlier run left behind them.

        Only files that sfmapp itself writes are replaced or removed: whatever else lies in these folders stays. The
        events are told of cameras that COLMAP will refuse.
        """
        from sfmapp.formats.colmap import write_model

        for idx, model in enumerate(models):
            write_model(self.model(idx), model, keypoints)
        self._remove_models(len(models))
        foreign = {camera.model for model in models for camera in model.cameras if not camera.model.is_colmaps}
        if foreign and events is not None:
            names = " and ".join(f"{model.name} (number {int(model)})" for model in sorted(foreign))
            events.warned(
                "output",
                f"sparse/ holds {names} cameras, which COLMAP and what reads its files refuse; sfmapp reads them. For "
                "other programs: sfmapp undistort, which writes pictures with PINHOLE cameras, or another model",
            )

    def _remove_models(self, first: int) -> None:
        from sfmapp.formats.colmap import MODEL_FILES

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
        manifest = manifest_of(folder)
        if manifest is not None:
            check_command(folder, manifest, command)
        lock = locked(folder / LOCK)
        lock.__enter__()
    except (NotADirectoryError, FileExistsError) as error:
        raise UsageError(f"{error.filename} is a file: the output must be a folder", "choose another OUT") from error
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror}", "choose another OUT") from error
    with contextlib.ExitStack() as stack:
        stack.push(lock)
        workspace = Workspace(folder, manifest_of(folder) or new_manifest(command))
        if manifest is None:
            workspace.save()
        yield workspace
