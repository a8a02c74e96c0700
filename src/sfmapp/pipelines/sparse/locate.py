"""Photographs located in a finished reconstruction, which stays as it is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.one_view_kernels import POSE
from sfmapp.calibration.point_reports import POSE_FILE, POSES, PhotographFacts, pose_report, write_pose
from sfmapp.camera.camera import Camera
from sfmapp.dense.photographs import scaled_camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features.extract import extract_features
from sfmapp.images.folder import describe_images, load_images
from sfmapp.images.image_set import ImageOptions, ImageRecord, ImageSet
from sfmapp.images.pixels import read_gray
from sfmapp.images.report import CameraPrior
from sfmapp.mapping.attach import NewPhotograph
from sfmapp.mapping.locate import STAGE, Located, LocateOptions, find_candidates, locate_photograph
from sfmapp.odometry.belief.photographs import CHANGED_AMONG_LIKES, judge_place
from sfmapp.odometry.loops.evidence import MAX_DOUBT, Score
from sfmapp.pipelines.metres import metre_sigma_of_run
from sfmapp.pipelines.sparse.finished import Finished, open_database, read_finished
from sfmapp.report.located_html import LandmarksReport, LocatedPhotographReport, LocatedReport, render_located_html
from sfmapp.report.model import RunUsage
from sfmapp.reporting import Usage, document_text
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.workspace.job import Job
from sfmapp.workspace.kernels import kernels_compiling
from sfmapp.workspace.layout import LOCATE, PAGE, REPORT
from sfmapp.workspace.manifest import image_root
from sfmapp.workspace.usage import Stopwatch

# In the order in which they are needed.
_MODULES = (
    "sfmapp.features.extract", "sfmapp.matching.stage", "sfmapp.mapping.incremental", "sfmapp.mapping.verified_pairs",
    "sfmapp.mapping.near_views", "sfmapp.odometry.loops.place_recognition", "sfmapp.adjust.compile",
)  # fmt: skip
# Longer side of pictures in which landmarks are looked for, in pixels: descriptors there are of a fixed size.
_SIDE_PX = 1000
# Share of the points told by matches that agree with a pose, below which a place has its likes: 0.77 and more do in
# sets of photographs, half and less where everything is there eight times.
_UNLIKE = 0.75
# Focal lengths of one camera: the points may contradict that of a camera of the model by so many standard deviations,
# and by this share, which is what focusing changes.
_FOCAL_SIGMAS, _FOCAL_SHARE = 5.0, 0.02


@dataclass(frozen=True)
class LocatedResult:
    """What was found of photographs in a model.

    Attributes:
        photographs: of each one; report: the same in plain values, and what it took.
        output: where it was written; None where it was not.
    """

    photographs: tuple[Located, ...]
    report: LocatedReport
    output: Path | None


@dataclass(frozen=True)
class _Search:
    """What all photographs of one call have in common."""

    finished: Finished
    options: LocateOptions
    events: Events
    pool: ThreadPoolExecutor
    unit: str

    @cached_property
    def small_model(self) -> Reconstruction:
        """The model with cameras and observations in pixels of the pictures in which landmarks are looked for."""
        model = self.finished.known.model
        shrunk = [_shrunk(camera) for camera in model.cameras]
        share = np.array([(s.width / c.width, s.height / c.height) for s, c in zip(shrunk, model.cameras, strict=True)])
        xy = model.tracks.obs_xy * share[model.image_camera_idx[model.tracks.obs_image_idx]]
        return replace(model, cameras=shrunk, tracks=replace(model.tracks, obs_xy=xy))


def locate_photographs(
    photographs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    model: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    camera: str | None = None,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> LocatedResult:
    """Find where photographs were taken, in a finished reconstruction.

    Args:
        photographs: a file, several, a folder or a pattern.
        model: OUT of ``sfmapp reconstruct``; nothing in it is changed.
        output: a new folder, an empty one, or that of an earlier call, for report and poses; None: nothing is written.
        camera: as ``images.camera``, where the photographs are of none of the model's cameras. None: the camera of the
            model that EXIF names, or that has the same size where there is one alone; else EXIF, or a search.
        events: told of progress and warnings, and asked whether to stop.
        watch: started earlier, if more is to be counted in the report than this call.

    Returns:
        A pose for each photograph, or the reason why there is none.

    Raises:
        UsageError: an output that holds something else.
        InputError: there is no photograph, or the model is none that photographs can be found in.
        NoReconstructionError: the model is empty.
        InterruptedRunError: ``events`` was asked to stop.
    """
    folder, events, watch = Path(model), events or Events(), watch or Stopwatch()
    with ExitStack() as stack:
        job = None
        if output is not None:
            job = stack.enter_context(Job.opened(LOCATE, folder, output, None, events=events, watch=watch))
        database = stack.enter_context(open_database(folder))
        finished = read_finished(folder, database, events)
        stack.enter_context(kernels_compiling(events, {}, _MODULES))
        threads = finished.options.num_workers
        found, entries = _photographs(photographs, finished, camera, events)
        options = LocateOptions(
            finished.options.matching, finished.options.mapping, finished.options.adjust, finished.options.seed, threads
        )  # fmt: skip
        pool = stack.enter_context(ThreadPoolExecutor(threads))
        unit = "units" if metre_sigma_of_run(folder) is None else "m"
        search = _Search(finished, options, events, pool, unit)
        located, rows = _locate_all(search, found, entries)
        warnings = [*finished.contradictions]
        for warning in warnings:
            events.warned(STAGE, warning)
        report = LocatedReport(
            model=os.fspath(model), num_images=len(finished.known.model.image_names), photographs=rows,
            skipped=[list(one) for one in found.skipped], warnings=warnings, run=RunUsage(**watch.read()),
        )  # fmt: skip
        events.finished(STAGE, f"{report.num_located} of {len(rows)} photographs located")
        if job is not None:
            job.note_inputs({record.name: record.digest for record in found.images})
            _write(job, search, located, report)
        return LocatedResult(tuple(located), report, None if output is None else Path(output))


def _photographs(
    given: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], finished: Finished, camera: str | None,
    events: Events,
) -> tuple[ImageSet, Sequence[CameraPrior]]:  # fmt: skip
    """The photographs, and what is known of their cameras. Raises InputError if there is none."""
    several = [os.fspath(given)] if isinstance(given, str | os.PathLike) else [os.fspath(one) for one in given]
    is_files = len(several) > 1 or (os.path.isfile(several[0]) and not several[0].endswith(".txt"))
    options = ImageOptions(camera=camera)
    if camera is None:
        options = ImageOptions(camera_model=finished.options.images.camera_model)
    found, report = load_images(several if is_files else several[0], options, events, threads=None)
    if not found.images:
        name, reason = found.skipped[0] if found.skipped else (several[0], "there is none")
        raise InputError(f"{name}: expected a photograph to locate, found none: {reason}")
    return found, report.cameras


def _locate_all(
    search: _Search, found: ImageSet, entries: Sequence[CameraPrior]
) -> tuple[list[Located], list[LocatedPhotographReport]]:
    """All photographs, one after the other."""
    finished, events = search.finished, search.events
    known, options = finished.known, finished.options
    events.started(STAGE, f"locating {len(found.images)} photographs", total=len(found.images))
    features, _ = extract_features(found, options.features, threads=search.options.threads, events=events)
    candidates = find_candidates(known, features, options.pairs, options.seed)
    of_digest = {digest.split("+")[0]: name for name, digest in finished.manifest.inputs.items()}
    located, rows = list[Located](), list[LocatedPhotographReport]()
    for k, record in enumerate(found.images):
        events.raise_if_cancelled()
        watch, same = Stopwatch(), of_digest.get(record.digest)
        tried = [i for i in candidates[k] if known.model.image_names[i] != same]
        entry = entries[record.camera_idx] if record.camera_idx < len(entries) else None
        one, source = _locate(search, record, features[k], (found.camera_of(k), entry), tried)
        landmarks = None
        if one.is_located:
            landmarks = _landmarks(search, record, one.camera, one.cam_from_world)
            rivals = [_landmarks(search, record, one.camera, pose) for pose in one.rivals]
            one = _doubted(one, landmarks, rivals)
        located.append(one)
        rows.append(_row(search, one, source, same, landmarks, Usage(**watch.read())))
        events.advanced(STAGE, message=f"{record.name}: {rows[-1].text}")
    return located, rows


def _locate(
    search: _Search, record: ImageRecord, features: Features, given: tuple[Camera, CameraPrior | None],
    candidates: Sequence[int],
) -> tuple[Located, str]:  # fmt: skip
    """A photograph, by the model's own camera if it is of one, and what its camera is from."""
    known, (camera, entry) = search.finished.known, given
    own = search.finished.camera_like(entry) if entry is not None and camera.focal_source != "user" else None

    def run(photograph: NewPhotograph) -> Located:
        return locate_photograph(known, photograph, candidates, search.options, search.events, search.pool)

    if own is not None:
        shared = NewPhotograph(record.name, features, known.model.cameras[own], own)
        found = run(shared)
        told = found.told_focal
        if told is None or not _is_other(told, shared.camera.focal):
            return found, "a camera of the model"
        camera = replace(camera, focal_source="default", focal_sigma=None)
    source = {"user": "as given", "default": "searched"}.get(camera.focal_source, "EXIF")
    return run(NewPhotograph(record.name, features, camera)), source


def _is_other(told: tuple[float, float], focal: float) -> bool:
    """Whether the points tell another focal length than the camera's."""
    off = abs(told[0] - focal)
    return off > _FOCAL_SIGMAS * told[1] and off > _FOCAL_SHARE * focal


def _landmarks(search: _Search, record: ImageRecord, lens: Camera, pose: NDArray[np.float64]) -> Score | None:
    """What photographs of the model say of the place (7,) of a photograph from beside it; None where they are gone."""
    root, model = image_root(search.finished.manifest), search.finished.known.model
    if root is None or lens.is_wide or any(camera.is_wide for camera in model.cameras):
        return None
    small = search.small_model

    def picture_of(image: int) -> NDArray[np.uint8] | None:
        records, _ = describe_images(root, [model.image_names[image]], ImageOptions(), threads=1)
        return None if records[0] is None else _picture(records[0], small.cameras[model.image_camera_idx[image]])

    camera = _shrunk(lens)
    return judge_place(small, pose, camera, _picture(record, camera), picture_of)


def _shrunk(camera: Camera) -> Camera:
    share = min(1.0, _SIDE_PX / max(camera.width, camera.height))
    return scaled_camera(camera, max(1, round(share * camera.width)), max(1, round(share * camera.height)))


def _picture(record: ImageRecord, camera: Camera) -> NDArray[np.uint8]:
    import cv2

    pixels = read_gray(record)
    size = (camera.width, camera.height)
    return pixels if pixels.shape == size[::-1] else np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def _doubted(found: Located, landmarks: Score | None, rivals: Sequence[Score | None]) -> Located:
    """A located photograph, not located where its landmarks are missing, or do not speak for one place of several.

    At a place that clearly weaker matches put it at more has to be missing than here, as for a camera that is lost in a
    known map (:mod:`sfmapp.odometry.belief.belief`).
    """
    if landmarks is None:
        return found
    agreeing, told = len(found.track_idx), found.num_correspondences
    has_likes = agreeing < _UNLIKE * told
    if landmarks.is_contradicted_beyond(CHANGED_AMONG_LIKES) if has_likes else landmarks.is_contradicted:
        return found.refused(
            f"where its matches put it, {landmarks.num_missing} of {landmarks.num_clusters} clusters of landmarks that "
            "photographs beside it show are not in it: it looks alike there"
        )
    if any(rival is not None and rival.num_missing <= landmarks.num_missing for rival in rivals):
        return found.refused(
            f"{agreeing} of {told} points agree with its pose, and others with a place that looks alike, where no more "
            "landmarks are missing"
        )
    if 2 * agreeing < told and landmarks.support < -np.log(MAX_DOUBT):
        return found.refused(
            f"only {agreeing} of {told} points agree with its pose, and no photograph from beside "
            "it tells that this is not another place that looks alike"
        )
    return found


def _row(
    search: _Search, found: Located, source: str, same: str | None, landmarks: Score | None, took: Usage
) -> LocatedPhotographReport:
    marks = None
    if landmarks is not None:
        marks = LandmarksReport(
            num_clusters=landmarks.num_clusters, num_missing=landmarks.num_missing, support=landmarks.support
        )
    is_there = found.is_located
    return LocatedPhotographReport(
        name=found.name, reason=found.reason, same_as=same,
        pose=pose_report(found.cam_from_world, found.covariance, search.unit) if is_there else None,
        covariance=found.covariance.tolist() if is_there else None,
        camera=found.camera.model.name, params=found.camera.params.tolist(), camera_source=source,
        num_points=len(found.track_idx), num_correspondences=found.num_correspondences,
        rms_px=found.rms_px if is_there else None, landmarks=marks, matched_with=list(found.images),
        num_tried=found.num_tried, took=took,
    )  # fmt: skip


def _write(job: Job, search: _Search, located: Sequence[Located], report: LocatedReport) -> None:
    """Report, page and poses."""
    folder, model = job.workspace.folder, search.finished.known.model
    found = [one for one in located if one.is_located]
    if len(located) > 1:
        (folder / POSES).mkdir(exist_ok=True)
    for one in found:
        num = len(one.camera.params)
        covariance = np.zeros((num + POSE, num + POSE))
        covariance[num:, num:] = one.covariance
        path = folder / POSE_FILE if len(located) == 1 else folder / POSES / f"{one.name.replace('/', '_')}.json"
        facts = PhotographFacts(one.name, [str(track) for track in one.track_idx], search.unit)
        write_pose(
            path, (one.camera, one.cam_from_world, covariance), max(one.rms_px / np.sqrt(2.0), 1e-3), facts,
            model.point_xyz[one.track_idx],
        )  # fmt: skip
    job.workspace.write_text(PAGE, render_located_html(report, model))
    job.workspace.write_text(REPORT, document_text(report))
    job.workspace.save()
