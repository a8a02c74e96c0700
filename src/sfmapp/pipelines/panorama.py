"""Photographs that were taken turning on the spot, to one picture and the rotations of the camera."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.formats.atomic import write_bytes
from sfmapp.formats.colmap import MODEL_FILES
from sfmapp.formats.gpano import Sphere, with_gpano
from sfmapp.geometry import rigid3
from sfmapp.images.load import Images, load_images, name_of
from sfmapp.images.rewrite import encode
from sfmapp.images.video import is_video
from sfmapp.panorama.report import TurningReport
from sfmapp.pipelines.sparse.keys import StageKeys, stage_keys
from sfmapp.pipelines.sparse.matches import find_matches
from sfmapp.pipelines.sparse.run import Run
from sfmapp.report.model import Outcome
from sfmapp.report.panorama_html import OtherPanorama, PanoramaReport, in_small, panorama_page
from sfmapp.reporting import NamedReason, document_text
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import Tracks
from sfmapp.workspace.kernels import PAIR_MODULES
from sfmapp.workspace.keys import stage_key
from sfmapp.workspace.layout import FORMAT, PAGE, PANORAMA, REPORT
from sfmapp.workspace.manifest import raise_as_before
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.panorama.canvas import Canvas, Projection
    from sfmapp.panorama.stitch import StitchedPicture
    from sfmapp.panorama.turned_photographs import TurnedPhotographs
    from sfmapp.scene.correspondences import Correspondences

STAGE = PANORAMA
# Three numbers for each photograph are told by some hundred rays, and matching costs the square of the keypoints: 3,000
# of them bring errors of rotations from 0.002 to 0.001 degrees, for twice the time.
_MOST_FEATURES = 1200
# where the stages behind the matches begin
STAGES = ("sfmapp.panorama.turning", "sfmapp.panorama.stitch", "sfmapp.formats.gpano")
ROTATIONS = "rotations.json"
FRAMES = "frames"
FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".tif": "tiff", ".tiff": "tiff"}
# what a side of a JPEG may have
_MOST_OF_JPEG = 65500


@dataclass(frozen=True)
class PictureLayout:
    """How the picture is made.

    Attributes:
        file: its name in the folder, whose ending says the format.
        projection: None: as the field of view asks for. max_size: limit of its longer side; None: none but JPEG's.
    """

    file: str = "panorama.jpg"
    projection: Projection | None = None
    max_size: int | None = None

    def __post_init__(self) -> None:
        if Path(self.file).name != self.file or self.format not in FORMATS.values():
            raise UsageError(
                f"{self.file}: expected the name of a file that ends in one of {', '.join(FORMATS)}",
                "it is written into OUT",
            )
        if self.max_size is not None and self.max_size < 1:
            raise UsageError(f"the longer side of the picture is to be {self.max_size} pixels", "give one or more")
        if self.projection not in (None, "spherical", "cylindrical", "planar"):
            raise UsageError(f"projection {self.projection!r} is not known", "spherical, cylindrical or planar")

    @property
    def format(self) -> str:
        return FORMATS.get(Path(self.file).suffix.lower(), "")

    @property
    def limit(self) -> int | None:
        """Of the longer side, pixels."""
        if self.format != "jpeg":
            return self.max_size
        return min(self.max_size or _MOST_OF_JPEG, _MOST_OF_JPEG)

    def file_of(self, k: int) -> str:
        """Of the panorama with that number, from 0: a further one has its number in its name."""
        path = Path(self.file)
        return self.file if k == 0 else f"{path.stem}-{k + 1}{path.suffix}"


@dataclass(frozen=True)
class PanoramaResult:
    """What was written.

    Attributes:
        output: the folder. picture: the file of the first panorama, of most photographs.
        report: of it, and in ``report.others`` of those whose photographs overlap none of the first, beside it.
    """

    output: Path
    picture: Path
    report: PanoramaReport


def stitch_panorama(
    images: Images,
    output: str | os.PathLike[str],
    options: Options | None = None,
    *,
    layout: PictureLayout | None = None,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> PanoramaResult:
    """Stitch photographs that were taken turning on the spot.

    What an earlier run in the same folder has done is used where it still holds.

    Args:
        images: as of :func:`sfmapp.reconstruct`, or a video, of which sharp frames are put into ``frames``.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these, images, features (of each photograph 1,200 at most), pairs, matching, seed and threads.
        layout: of the picture.
        events: progress, warnings and cancellation.
        watch: started when the run began.

    Raises:
        UsageError: an output that holds something else, or a picture of a kind that is not known.
        InputError: no photographs.
        NoReconstructionError: the camera did not turn on the spot, or nothing overlaps; the report is written.
        InterruptedRunError: ``events`` was asked to stop; the same call resumes.
    """
    layout, options = layout or PictureLayout(), options or Options()
    most = min(options.features.max_num_features, _MOST_FEATURES)
    options = replace(options, features=replace(options.features, max_num_features=most))
    with Run.opened(PANORAMA, name_of(images), output, options, events=events, watch=watch, images=images) as run:
        report = _run(run, images, layout)
        return PanoramaResult(run.workspace.folder, run.workspace.folder / layout.file, report)


def _run(run: Run, images: Images, layout: PictureLayout) -> PanoramaReport:
    if isinstance(images, str | os.PathLike) and is_video(os.fspath(images)):
        images = _frames_of(run, os.fspath(images))
    with run.stage("images"):
        image_set, described = load_images(images, run.options.images, run.events, threads=run.threads)
        run.image_set, run.stages = image_set, replace(run.stages, images=described)
    keys = stage_keys(run.options, image_set)
    key = stage_key(
        STAGES, None, keys.matching, [layout.file, layout.projection, layout.limit],
        [record.orientation for record in image_set.images],
    )  # fmt: skip
    if (known := _earlier(run, layout, key)) is not None:
        return known
    run.workspace.note(image_root=os.fspath(image_set.root or ""))
    run.note_inputs(keys.inputs)
    try:
        made, shown = _stitched(run, image_set, keys, layout, key)
    except NoReconstructionError as failure:
        run.workspace.begin(STAGE, key)
        _write_report(run, _report(run, [], failure), [], failure)
        raise
    return _write_report(run, _report(run, made, None), shown, None)


def _frames_of(run: Run, video: str) -> Path:
    """The folder of the frames that were picked of a video, unless an earlier run has done so."""
    from sfmapp.panorama.frames import STAGE as PICKING
    from sfmapp.panorama.frames import pick_frames

    workspace, folder = run.workspace, run.workspace.folder / FRAMES
    facts = Path(video).stat() if Path(video).is_file() else None
    key = stage_key(
        ("sfmapp.panorama.frames",), None, os.path.abspath(video), facts and [facts.st_size, facts.st_mtime_ns]
    )
    if facts is not None and workspace.is_current(PICKING, key) and folder.is_dir():
        return folder
    with run.stage(PICKING):
        workspace.begin(PICKING, key)
        folder.mkdir(exist_ok=True)
        for before in folder.glob("*.png"):
            before.unlink()
        for frame in pick_frames(video, run.events):
            write_bytes(folder / f"{frame.name}.png", encode(frame.pixels, "png"))
    workspace.finish(PICKING, run.usage.get(PICKING))
    run.save_first(workspace.save)
    return folder


def _earlier(run: Run, layout: PictureLayout, key: str) -> PanoramaReport | None:
    """The report of an earlier run, if all that this one would write is there."""
    workspace = run.workspace
    if not workspace.is_current(STAGE, key):
        return None
    raise_as_before(workspace.manifest.stage(STAGE))
    report = workspace.read_report(PanoramaReport)
    if report is None:
        return None
    num = 1 + len(report.others)
    wanted = [workspace.folder / name for name in (ROTATIONS, PAGE, *(layout.file_of(k) for k in range(num)))]
    wanted += [workspace.model(k) / name for name in MODEL_FILES for k in range(num)]
    if not all(path.is_file() for path in wanted):
        return None
    return replace(report, run=replace(report.run, is_up_to_date=True, **run.watch.read()))


def _stitched(
    run: Run, image_set: ImageSet, keys: StageKeys, layout: PictureLayout, key: str
) -> tuple[list[OtherPanorama], list[NDArray[np.uint8]]]:
    """From photographs to the pictures, which are written with the rotations: what is said of each, the largest first,
    and each in small."""
    from sfmapp.panorama.stitch import stitch

    workspace = run.workspace
    if len(image_set.images) < 2:
        found = image_set.images[0].name if image_set.images else "none"
        raise NoReconstructionError(
            f"expected two usable photographs or more, found {found}",
            "give photographs that overlap, taken turning on the spot",
        )
    correspondences = find_matches(run, image_set, keys, PAIR_MODULES)
    with run.stage("rotations"):
        groups = _turned_groups(run, image_set, correspondences)
    made: list[OtherPanorama] = []
    shown: list[NDArray[np.uint8]] = []
    with run.stage("picture"):
        workspace.begin(STAGE, key)
        for k, (turned, turning) in enumerate(groups):
            drawn, picture = stitch(
                image_set, turned, projection=layout.projection, max_size=layout.limit, events=run.events
            )
            path = workspace.folder / layout.file_of(k)
            run.save_first(partial(_write_picture, path, drawn, layout))
            made.append(OtherPanorama(turning=turning, picture=replace(picture, file=path.name)))
            shown.append(in_small(drawn.pixels))
        before = workspace.read_report(PanoramaReport)
        for k in range(len(groups), 1 + len(before.others) if before is not None else 0):
            (workspace.folder / layout.file_of(k)).unlink(missing_ok=True)
    with run.stage("output"):
        most = max(len(turned.image_idx) for turned, _ in groups)
        models = [_model(image_set, turned) for turned, _ in groups]
        workspace.write_models(models, [np.zeros((0, 2))] * most, run.events)
        workspace.write_json(ROTATIONS, _rotations([turning for _, turning in groups]))
    return made, shown


def _turned_groups(
    run: Run, image_set: ImageSet, correspondences: Correspondences
) -> list[tuple[TurnedPhotographs, TurningReport]]:
    """Photographs from one place, the largest group first, and each group that overlaps none of these and was turned on
    the spot as well."""
    from sfmapp.panorama.turning import find_rotations

    options = run.options
    out: list[tuple[TurnedPhotographs, TurningReport]] = []
    waiting = [np.arange(len(image_set.images))]
    while waiting:
        among = waiting.pop(0)
        try:
            turned, turning = find_rotations(
                image_set, run.features, correspondences, options.matching, seed=options.seed, events=run.events,
                among=among,
            )  # fmt: skip
        except NoReconstructionError as failure:
            if not out:
                raise
            first = image_set.images[int(among[0])].name
            run.events.warned("rotations", f"no panorama of {len(among)} photographs from {first} on: {failure}")
            continue
        _warn(run, turning)
        out.append((turned, turning))
        if len(out) == 1:
            waiting = list(turned.other_groups)
    return out


def _warn(run: Run, turning: TurningReport) -> None:
    for contradiction in turning.contradictions:
        run.events.warned("rotations", contradiction.message)
    for camera in turning.cameras:
        if not camera.is_told:
            run.events.warned(
                "rotations",
                f"the photographs do not tell the focal length of camera {camera.camera_idx}: {camera.focal_px:.0f} px "
                f"follow from what was known before ({camera.prior_source}). It does not show where little is turned",
            )


def _write_picture(path: Path, drawn: StitchedPicture, layout: PictureLayout) -> None:
    data = encode(drawn.pixels, layout.format)
    if drawn.canvas.projection == "spherical":
        data = with_gpano(data, _sphere(drawn.canvas))
    write_bytes(path, data)


def _sphere(canvas: Canvas) -> Sphere:
    full_width, full_height = round(2.0 * np.pi * canvas.scale), round(np.pi * canvas.scale)
    left, top = round(canvas.left + 0.5 * full_width), round(canvas.top + 0.5 * full_height)
    return Sphere(
        canvas.width, canvas.height, max(full_width, canvas.width), max(full_height, canvas.height),
        left % max(full_width, 1), max(top, 0),
    )  # fmt: skip


def _model(image_set: ImageSet, turned: TurnedPhotographs) -> Reconstruction:
    """Cameras at one centre, without points, which have no distance."""
    names = [image_set.images[i].name for i in turned.image_idx]
    empty = np.zeros(0, np.int64)
    tracks = Tracks.from_observations(empty, empty, np.zeros((0, 2)), num_images=len(names))
    used = sorted(set(turned.camera_idx.tolist()))
    model = Reconstruction.empty(
        [turned.cameras[c] for c in used], names, np.searchsorted(used, turned.camera_idx).astype(np.int32), tracks
    )
    model.cam_from_world = rigid3.from_matrix(turned.rotations, np.zeros((len(names), 3)))
    return model


def _rotations(found: Sequence[TurningReport]) -> dict[str, object]:
    """What ``rotations.json`` holds: the first panorama, and the others in a list of their own."""
    others = [_rotations_of(turning) for turning in found[1:]]
    return {
        "convention": (
            "cam_from_world is a quaternion x, y, z, w; cameras and world have x right, y down, z forward; sigma_deg "
            "is about the x, y and z axes of the camera, in the gauge in which the rotations do not turn as a whole"
        ),
        **_rotations_of(found[0]),
        **({"others": others} if others else {}),
    }


def _rotations_of(turning: TurningReport) -> dict[str, object]:
    return {
        "noise_px": turning.noise_px,
        "cameras": turning.cameras,
        "images": [
            {"name": each.name, "camera": each.camera_idx, "cam_from_world": each.rotation, "sigma_deg": each.sigma_deg}
            for each in turning.images
        ],
    }


def _report(run: Run, made: Sequence[OtherPanorama], failure: NoReconstructionError | None) -> PanoramaReport:
    skipped = run.image_set.skipped if run.image_set is not None else ()
    return PanoramaReport(
        format=FORMAT, outcome=Outcome.of(failure), run=run.facts(), turning=made[0].turning if made else None,
        picture=made[0].picture if made else None, others=made[1:],
        skipped=[NamedReason(name=name, reason=reason) for name, reason in skipped], usage=run.usage,
        warnings=run.log.warnings, decisions=run.log.decisions,
    )  # fmt: skip


def _write_report(
    run: Run, report: PanoramaReport, shown: Sequence[NDArray[np.uint8]], failure: NoReconstructionError | None
) -> PanoramaReport:
    workspace = run.workspace
    page = panorama_page(report, shown)
    run.save_first(lambda: workspace.write_text(PAGE, page))
    took = run.watch.read()
    report = replace(report, run=replace(report.run, **took))
    run.save_first(lambda: workspace.write_text(REPORT, document_text(report)))
    workspace.finish(STAGE, run.usage.get("picture"), outcome=Outcome.of(failure), run=took)
    workspace.note(usage=run.usage)
    run.save_first(workspace.save)
    return report
