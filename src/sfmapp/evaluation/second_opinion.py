"""pycolmap on the same photographs, as a second opinion: extraction, exhaustive matching, incremental mapping.

It runs in a process of its own (``python -m sfmapp.evaluation.second_opinion REQUEST.json``), so that its time and its
memory are its own and a crash is not ours. Request and answer are JSON; the models are COLMAP folders. All options are
pycolmap's defaults but for those that :class:`SecondOpinionOptions` names.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from sfmapp.errors import InputError, SfmError
from sfmapp.evaluation.measured import high_water_mark_mb, run_measured
from sfmapp.events import Events
from sfmapp.packages import require

STAGE = "second_opinion"


@dataclass(frozen=True)
class SecondOpinionOptions:
    """What pycolmap is told; everything else is its default."""

    camera_mode: Literal["auto", "single", "per_folder", "per_image"] = "auto"
    """Which photographs share a camera; ``auto`` is pycolmap's default. Explicit camera groups override it."""

    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's name of the camera model (pycolmap's default)."""

    fix_intrinsics: bool = False
    """Keep the cameras at their initial parameters."""

    mask_root: str | None = None
    """Folder of masks, NAME.png for the photograph NAME, black is ignored; None for none."""

    max_image_size_px: int | None = None
    """Longer side that photographs are reduced to before extraction; None for pycolmap's default (3200 for SIFT)."""

    num_threads: int | None = None
    """Threads of every phase; None for one per processor (pycolmap's default)."""

    seed: int = 0
    """Seed of all its random sampling. With several threads pycolmap is not reproducible even so."""


@dataclass(frozen=True)
class CameraGroup:
    """Photographs that share a camera.

    Attributes:
        names: of the photographs.
        params: initial parameters in COLMAP's order, taken for a good prior; None: from EXIF or pycolmap's default.
        model: COLMAP's name of the camera model; None: that of the options.
    """

    names: tuple[str, ...]
    params: tuple[float, ...] | None = None
    model: str | None = None


@dataclass(frozen=True)
class SecondOpinion:
    """What pycolmap found, and what it took.

    Attributes:
        num_images, num_registered, num_points, num_observations: counts of its largest model.
        num_models: how many models it made.
        mean_track_length: observations per point.
        mean_reprojection_error_px: mean over the observations (pycolmap itself averages over points).
        model_folder: its largest model, COLMAP binary; None if it made none.
        phases: wall and CPU seconds of ``import``, ``extract``, ``match`` and ``map``.
        wall_s, cpu_s: of the whole process, its start and the import included.
        peak_memory_mb: largest resident set, 1e6 bytes.
        version: of pycolmap.
        options: as it ran.
    """

    num_images: int
    num_registered: int
    num_points: int
    num_observations: int
    num_models: int
    mean_track_length: float
    mean_reprojection_error_px: float
    model_folder: str | None
    phases: dict[str, dict[str, float]]
    wall_s: float
    cpu_s: float
    peak_memory_mb: float
    version: str
    options: dict[str, Any] = field(default_factory=dict)


def ask_second_opinion(
    image_root: Path,
    image_names: Sequence[str],
    output: Path,
    options: SecondOpinionOptions | None = None,
    *,
    camera_groups: Sequence[CameraGroup] | None = None,
    fingerprint: str = "",
    events: Events | None = None,
) -> SecondOpinion:
    """Reconstruct photographs with pycolmap in a child process and measure it.

    An answer that lies in the output folder already is given again if the same was asked with the same fingerprint;
    an answer to another question is replaced.

    Args:
        image_root: folder that the names are relative to.
        image_names: photographs to use, with forward slashes.
        output: folder of this function's own for the database, the models, the request, the answer and the log.
        options: None for the defaults.
        camera_groups: which photographs share a camera, all of them; None lets ``options.camera_mode`` decide.
        fingerprint: changes whenever a photograph does, such as a hash of them all; empty: never give an old answer.
        events: progress and cancellation.

    Raises:
        InputError: the image folder is missing, or pycolmap is not installed.
        SfmError: pycolmap failed or crashed; the message holds the end of its log.
    """
    options, events = options or SecondOpinionOptions(), events or Events()
    if not image_root.is_dir():
        raise InputError(f"{image_root}: no such folder of photographs")
    request = {
        "image_root": str(image_root.resolve()),
        "image_names": list(image_names),
        "camera_groups": None if camera_groups is None else [asdict(group) for group in camera_groups],
        "output": str(output.resolve()),
        "options": asdict(options),
        "fingerprint": fingerprint,
    }
    request_path, answer_path, log = output / "request.json", output / "answer.json", output / "log.txt"
    request_text = json.dumps(request, indent=1)
    if fingerprint and answer_path.is_file() and request_path.is_file() and request_path.read_text() == request_text:
        return SecondOpinion(**json.loads(answer_path.read_text()))
    require("pycolmap")
    output.mkdir(parents=True, exist_ok=True)
    _remove_old(output)
    request_path.write_text(request_text)
    events.started(STAGE, f"pycolmap on {len(image_names)} photographs", total=4)

    def on_line(line: str) -> None:
        if line.startswith("phase "):
            events.advanced(STAGE, message=line.removeprefix("phase "))

    command = [sys.executable, "-P", "-m", "sfmapp.evaluation.second_opinion", str(request_path)]
    usage = run_measured(command, log, on_line=on_line, on_tick=events.raise_if_cancelled)
    part = output / "answer.part"
    if usage.exit_code != 0 or not part.is_file():
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-8:])
        raise SfmError(f"pycolmap ended with code {usage.exit_code}; the end of {log}:\n{tail}")
    answer = json.loads(part.read_text())
    # the child reads its own mark as the very last thing, after the parent's last look
    peak_mb = max(usage.peak_memory_mb, answer.pop("high_water_mark_mb"))
    opinion = SecondOpinion(**answer, wall_s=usage.wall_s, cpu_s=usage.cpu_s, peak_memory_mb=peak_mb)
    part.write_text(json.dumps(asdict(opinion), indent=1))
    os.replace(part, answer_path)
    events.finished(STAGE, f"pycolmap registered {opinion.num_registered} of {opinion.num_images}", **asdict(opinion))
    return opinion


def _remove_old(output: Path) -> None:
    """Take away the files of an earlier opinion, and nothing else."""
    names = ("answer.json", "answer.part", "database.db", "database.db-shm", "database.db-wal", "log.txt")
    for path in [*(output / name for name in names), *output.glob("sparse/*/*.bin"), *output.glob("sparse/*/*.ini")]:
        path.unlink(missing_ok=True)


def _reconstruct(request: dict[str, Any]) -> dict[str, Any]:
    """The work of the child process."""
    phases: dict[str, dict[str, float]] = {}

    def timed(name: str, step: Callable[[], Any]) -> Any:
        wall, cpu = time.perf_counter(), time.process_time()
        result = step()
        phases[name] = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
        print("phase", name, flush=True)
        return result

    pycolmap = timed("import", _import_pycolmap)
    options = SecondOpinionOptions(**request["options"])
    output = Path(request["output"])
    database, models = output / "database.db", output / "sparse"
    models.mkdir(exist_ok=True)
    pycolmap.set_random_seed(options.seed)
    timed("extract", lambda: _extract(pycolmap, request, options, database))
    timed("match", lambda: _match(pycolmap, options, database))
    found = timed("map", lambda: _map(pycolmap, options, database, request["image_root"], models))
    # ties go to the model with more points, then to the first
    best = max(found, key=lambda k: (found[k].num_reg_images(), len(found[k].points3D), -k), default=None)
    answer = _summary(found[best]) if best is not None else _summary(pycolmap.Reconstruction())
    return {
        "num_images": len(request["image_names"]),
        "num_models": len(found),
        **answer,
        "model_folder": None if best is None else str(models / str(best)),
        "phases": phases,
        "version": pycolmap.__version__,
        "options": request["options"] | {"camera_groups": request["camera_groups"] is not None},
    }


def _import_pycolmap() -> Any:
    import pycolmap

    return pycolmap


def _extract(pycolmap: Any, request: dict[str, Any], options: SecondOpinionOptions, database: Path) -> None:
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model = options.camera_model
    extraction.use_gpu = False
    if options.mask_root is not None:
        reader.mask_path = options.mask_root
    if options.max_image_size_px is not None:
        extraction.max_image_size = options.max_image_size_px
    if options.num_threads is not None:
        extraction.num_threads = options.num_threads
    pycolmap.Database.open(database).close()  # an empty one: import_images wants the file to exist
    for group in request["camera_groups"] or ():
        reader.camera_model = group["model"] or options.camera_model
        reader.camera_params = ", ".join(map(repr, group["params"] or ()))
        pycolmap.import_images(database, request["image_root"], pycolmap.CameraMode.SINGLE, group["names"], reader)
    reader.camera_model, reader.camera_params = options.camera_model, ""
    mode = pycolmap.CameraMode.__members__[options.camera_mode.upper()]
    pycolmap.extract_features(
        database, request["image_root"], request["image_names"], mode, reader, extraction, pycolmap.Device.cpu
    )


def _match(pycolmap: Any, options: SecondOpinionOptions, database: Path) -> None:
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.use_gpu = False
    verification.ransac.random_seed = options.seed
    if options.num_threads is not None:
        matching.num_threads = options.num_threads
    pycolmap.match_exhaustive(
        database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu
    )


def _map(pycolmap: Any, options: SecondOpinionOptions, database: Path, image_root: str, models: Path) -> dict[int, Any]:
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.random_seed = options.seed
    if options.num_threads is not None:
        mapping.num_threads = options.num_threads
    if options.fix_intrinsics:
        mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = False
        mapping.mapper.abs_pose_refine_focal_length = mapping.mapper.abs_pose_refine_extra_params = False
    return dict(pycolmap.incremental_mapping(database, image_root, models, mapping))


def _summary(model: Any) -> dict[str, float | int]:
    """Counts and errors of a pycolmap reconstruction; the error is the mean over observations."""
    model.update_point_3d_errors()
    points = [(point.error, point.track.length()) for point in model.points3D.values()]
    num_observations = sum(length for _, length in points)
    return {
        "num_registered": model.num_reg_images(),
        "num_points": len(points),
        "num_observations": num_observations,
        "mean_track_length": num_observations / max(len(points), 1),
        "mean_reprojection_error_px": sum(e * n for e, n in points) / max(num_observations, 1),
    }


def _main(request_path: Path) -> None:
    request = json.loads(request_path.read_text())
    answer = _reconstruct(request)
    part = Path(request["output"]) / "answer.part"
    part.write_text(json.dumps(answer | {"high_water_mark_mb": high_water_mark_mb()}, indent=1))


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
