"""Photographs of a camera that nobody has calibrated: projective, then metric by known points or one camera."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features.extract import extract_features
from sfmapp.formats.control_points import read_control_points
from sfmapp.formats.ply import write_ply
from sfmapp.geometry import rigid3
from sfmapp.geometry.absolute_conic import NoMetricFrameError
from sfmapp.geometry.projective import dehomogenized, in_frame
from sfmapp.geometry.projective_adjustment import ProjectiveModel
from sfmapp.images.load import Images, load_images, name_of
from sfmapp.mapping.tracks import build_tracks, track_colors
from sfmapp.matching.pairs import select_pairs
from sfmapp.matching.stage import match_images
from sfmapp.report.uncalibrated_html import (
    KnownPointsReport,
    ProjectiveReport,
    SelfCalibrationReport,
    UncalibratedReport,
    uncalibrated_page,
)
from sfmapp.uncalibrated.clouds import Clouds
from sfmapp.uncalibrated.known_places import KnownFrame, upgrade_by_known_points
from sfmapp.uncalibrated.metric import MetricModel, upgrade_by_self_calibration
from sfmapp.uncalibrated.projective_model import (
    ProjectiveReconstruction,
    reconstruct_projective,
    sightings_of_tracks,
)
from sfmapp.viewer.uncalibrated_recording import record_clouds
from sfmapp.workspace.job import FAILED, WRITTEN, Job
from sfmapp.workspace.kernels import PAIR_MODULES, kernels_compiling
from sfmapp.workspace.layout import PAGE, REPORT, UNCALIBRATED
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet

Array = NDArray[np.float64]

CAMERAS, POINTS = "cameras_projective.json", "points.ply"


@dataclass(frozen=True)
class UncalibratedResult:
    """What was found and written.

    Attributes:
        output: the folder. report: what is in ``report.json``.
        projective: the model of the pixels. metric: by self-calibration; known: frame of known points; None without.
    """

    output: Path
    report: UncalibratedReport
    projective: ProjectiveReconstruction
    metric: MetricModel | None
    known: KnownFrame | None


def reconstruct_uncalibrated(
    images: Images, output: str | os.PathLike[str], options: Options | None = None, *,
    points: str | os.PathLike[str] | None = None, events: Events | None = None, watch: Stopwatch | None = None,
) -> UncalibratedResult:  # fmt: skip
    """Reconstruct photographs without any calibration, in a projective frame, and make that metric.

    Args:
        images: as of :func:`sfmapp.reconstruct`.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these, images, features, pairs, matching, seed and threads.
        points: file of known points and where photographs show them, as of ``reconstruct --gcp``; None: one camera with
            square pixels and its principal point in the middle is looked for.
        events: progress, warnings and cancellation.
        watch: started when the run began.

    Raises:
        UsageError: an output that holds something else.
        InputError: no photographs, known points that cannot be read, or, for self-calibration, several sizes.
        NoReconstructionError: the pixels do not tell a projective model, or known points do not tell its frame. Where
            only self-calibration fails, the projective model is written and the report says why.
    """
    with Job.opened(UNCALIBRATED, name_of(images), output, options, events=events, watch=watch) as job:
        with kernels_compiling(job.events, job.usage, PAIR_MODULES):
            image_set, found, rgb = _projective(job, images)
        known, metric, refused = None, None, ""
        with job.stage("metric"):
            if points is not None:
                known = _known(image_set, found, Path(points))
            else:
                metric, refused = _self_calibrated(job, image_set, found)
        return _written(job, image_set, found, (known, metric, refused), rgb)


def _projective(job: Job, images: Images) -> tuple[ImageSet, ProjectiveReconstruction, NDArray[np.uint8]]:
    """The photographs, their projective model, and the colours (N, 3) of its points."""
    options, events, threads = job.options, job.events, job.threads
    with job.stage("images"):
        image_set, _ = load_images(images, options.images, events, threads=threads)
        job.note_inputs({record.name: record.digest for record in image_set.images})
    with job.stage("features"):
        features, _ = extract_features(image_set, options.features, threads=threads, events=events)
    with job.stage("matching"):
        pairs, _ = select_pairs(
            image_set, features, options.pairs, seed=options.seed, threads=threads, events=events
        )  # fmt: skip
        matches, _ = match_images(
            image_set, features, pairs, options.matching, seed=options.seed, threads=threads, events=events
        )
        tracks, _ = build_tracks(matches, features)
    with job.stage("projective"):
        events.started("projective", "cameras of eleven free numbers", total=len(image_set.images))
        found = reconstruct_projective(sightings_of_tracks(tracks), len(image_set.images), events=events)
        events.finished(
            "projective", f"{len(found.view_idx)} cameras, {len(found.point_idx)} points, {found.info.rms_px:.3f} px"
        )
    return image_set, found, track_colors(tracks, features)[found.point_idx]


def _known(image_set: ImageSet, found: ProjectiveReconstruction, path: Path) -> KnownFrame:
    sizes = {record.name: (record.width, record.height) for record in image_set.images}
    control = read_control_points(path, sizes)
    xy = np.full((control.num_points, len(image_set.images), 2), np.nan)
    xy[control.obs_point_idx, control.obs_image_idx] = control.obs_xy
    # a frame without a calibration needs a space with three straight axes of one unit
    if control.crs.lower() != "local":
        raise InputError(
            f"{path}: expected places along three axes at right angles (local), found the coordinate system "
            f"{control.crs}",
            "write 'local' in its first line, or '# crs: local' in a table",
        )
    return upgrade_by_known_points(found, control.names, control.xyz, xy)


def _self_calibrated(job: Job, image_set: ImageSet, found: ProjectiveReconstruction) -> tuple[MetricModel | None, str]:
    """The metric model, or why there is none."""
    sizes = {(record.width, record.height) for record in image_set.images}
    if len(sizes) > 1:
        return None, f"self-calibration takes photographs of one camera and size, found {len(sizes)} sizes"
    names = [record.name for record in image_set.images]
    try:
        metric = upgrade_by_self_calibration(found, names, sizes.pop(), threads=job.threads)
    except NoMetricFrameError as error:
        job.events.warned("metric", str(error))
        return None, str(error)
    for warning in metric.warnings:
        job.events.warned("metric", warning)
    return metric, ""


def _written(
    job: Job, image_set: ImageSet, found: ProjectiveReconstruction,
    upgrade: tuple[KnownFrame | None, MetricModel | None, str], rgb: NDArray[np.uint8],
) -> UncalibratedResult:  # fmt: skip
    known, metric, refused = upgrade
    names = [record.name for record in image_set.images]
    with job.stage("files"):
        projective, mapped = _projective_report(found, names, job.options.seed)
        xyz, centers = _metric_points(found, known, metric)
        clouds = Clouds(dehomogenized(_quasi_affine(found.model)), mapped, xyz, rgb, centers)
        job.workspace.write_json(CAMERAS, _cameras(found, names, known))
        if xyz is not None:
            finite = np.isfinite(xyz).all(1)
            write_ply(job.workspace.folder / POINTS, xyz[finite], rgb[finite])
        if metric is not None:
            model = metric.reconstruction
            model.point_rgb[:] = rgb
            job.workspace.write_models([model], _keypoints(metric), job.events)
        recorded = record_clouds(job.workspace.recording, clouds, names[0])
        job.workspace.note(recording=FAILED if recorded.problem else WRITTEN)
        if recorded.problem:
            job.events.warned("recording", f"no recording: {recorded.problem}")
    report = UncalibratedReport(
        projective=projective, refused=refused, run=job.facts(), self_calibration=_metric_report(metric),
        known_points=_known_report(known, found),
    )  # fmt: skip
    job.workspace.write_json(REPORT, report)
    job.workspace.write_text(PAGE, uncalibrated_page(report, clouds))
    job.workspace.save()
    return UncalibratedResult(job.workspace.folder, report, found, metric, known)


def _quasi_affine(model: ProjectiveModel) -> Array:
    """Points (N, 4) in a frame whose plane at infinity is far from all of them: nothing is torn apart on a picture."""
    signs = np.where(model.points @ model.cameras[0, 2] < 0.0, -1.0, 1.0)
    oriented = model.points * signs[:, None]
    values, vectors = np.linalg.eigh(oriented.T @ oriented)
    # the direction that most points share becomes the last coordinate
    frame = (vectors / np.sqrt(values.clip(1e-12 * values[-1]))).T
    turned: Array = oriented @ frame.T
    return turned


def _projective_report(found: ProjectiveReconstruction, names: list[str], seed: int) -> tuple[ProjectiveReport, Array]:
    """Facts of the projective model, and the points (N, 3) of its image under a random map of space."""
    rng = np.random.default_rng([seed, 1])
    near = _quasi_affine(found.model)
    # a mild one: what a wild one does to a cloud cannot be looked at
    mild = np.eye(4) + np.array([0.25, 0.25, 0.25, 0.12])[:, None] * rng.uniform(-1.0, 1.0, (4, 4))
    other = ProjectiveModel(*in_frame(found.model.cameras, found.model.points, rng.normal(size=(4, 4))))
    rms = float(np.sqrt(np.nanmean(other.left(found.seen) ** 2)))
    mapped = dehomogenized(near @ mild.T)
    lengths = [np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1) for xyz in (dehomogenized(near), mapped)]
    ratio = lengths[1] / np.maximum(lengths[0], 1e-12)
    low, high = np.nanpercentile(ratio, [5, 95])
    held = set(found.view_idx.tolist())
    report = ProjectiveReport(
        num_images=len(names), num_cameras=len(found.view_idx),
        without_camera=[name for n, name in enumerate(names) if n not in held], num_points=len(found.point_idx),
        num_sightings=len(found.seen.xy), dropped=found.share_dropped, rms_px=found.info.rms_px,
        sigma_px=found.info.sigma_px, core=[names[n] for n in found.core], ambiguity_rms_px=rms,
        ambiguity_ratio=float(high / low),
    )  # fmt: skip
    return report, mapped


def _metric_points(
    found: ProjectiveReconstruction, known: KnownFrame | None, metric: MetricModel | None
) -> tuple[Array | None, Array]:
    """(N, 3) places and (V, 3) camera centres of the metric model, if there is one."""
    if metric is not None:
        return metric.reconstruction.point_xyz, rigid3.center(metric.reconstruction.cam_from_world[found.view_idx])
    if known is None:
        return None, np.zeros((0, 3))
    cameras, points = in_frame(found.model.cameras, found.model.points, known.frame)
    return dehomogenized(points), dehomogenized(np.linalg.svd(cameras)[2][:, 3])


def _cameras(found: ProjectiveReconstruction, names: list[str], known: KnownFrame | None) -> dict[str, object]:
    cameras = found.model.cameras
    if known is not None:
        cameras, _ = in_frame(cameras, found.model.points, known.frame)
    frame = "the known points'" if known is not None else "any projective one: P H^-1 and H X do as well"
    return {
        "convention": "x ~ P X, pixels with the centre of the first at (0.5, 0.5); each P of unit norm",
        "frame": frame,
        "images": [{"name": names[n], "P": p.tolist()} for n, p in zip(found.view_idx, cameras, strict=True)],
    }


def _keypoints(metric: MetricModel) -> list[Array]:
    """The pixels of each image, in the order in which the model's tracks number them."""
    tracks = metric.reconstruction.tracks
    out = []
    for image in range(tracks.num_images):
        of_image = tracks.observations_of_image(image)
        xy = np.zeros((len(of_image), 2))
        xy[tracks.obs_feature_idx[of_image]] = tracks.obs_xy[of_image]
        out.append(xy)
    return out


def _metric_report(metric: MetricModel | None) -> SelfCalibrationReport | None:
    if metric is None:
        return None
    linear = metric.start.linear_focal
    return SelfCalibrationReport(
        focal_px=metric.focal_px, focal_sigma_px=metric.focal_sigma_px,
        linear_focal_px=linear if math.isfinite(linear) else None, start_focal_px=float(metric.start.k[0, 0]),
        condition=metric.start.condition, rms_px=metric.rms_px, motion=metric.motion, warnings=metric.warnings,
    )  # fmt: skip


def _known_report(known: KnownFrame | None, found: ProjectiveReconstruction) -> KnownPointsReport | None:
    if known is None:
        return None
    covariances = known.covariances_of(found)
    sigmas = None if covariances is None else np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    return KnownPointsReport(
        num_used=sum(one.is_used for one in known.points), sigma=known.sigma if math.isfinite(known.sigma) else None,
        condition=known.condition, median_point_sigma=None if sigmas is None else float(np.nanmedian(sigmas)),
        points=known.points,
    )  # fmt: skip
