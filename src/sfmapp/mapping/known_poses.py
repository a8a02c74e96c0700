"""Points from photographs whose poses are known: triangulated, adjusted, and held against the matches.

Poses stay as they are. Photographs without a known pose are registered among the others as usual, and so are those
whose known pose most of their verified matches contradict. Intrinsics are refined as the options have it: known poses
tell them well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.images.image_set import ImageSet
from sfmapp.mapping import structure
from sfmapp.mapping.incremental import first_cameras, image_reports
from sfmapp.mapping.mapper import STAGE, Mapper
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.register import FOCAL_SCALES
from sfmapp.mapping.report import LookAlikesReport, MappingReport, ModelReport, Uncertainty
from sfmapp.mapping.tracks import build_tracks, track_colors
from sfmapp.mapping.verified_pairs import contradictions_of, pair_agreement
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Where more of the poses are refuted, poses and photographs contradict each other as a whole.
MAX_REFUTED = 0.4
_ADVICE = (
    "are they cam_from_world where the format has world_from_cam, or of another program's camera axes, or of other "
    "photographs? Without --fix-poses the photographs are mapped on their own, and the poses compared"
)


@dataclass(frozen=True)
class HeldPoses:
    """Poses that are known and stay.

    Attributes:
        cam_from_world: (I, 7), NaN where unknown.
        judge: called in the end with the finished map; may let go of further poses.
    """

    cam_from_world: Array
    judge: Callable[[Mapper], None]

    @property
    def is_known(self) -> Mask:
        """(I,) bool."""
        return np.isfinite(self.cam_from_world[:, 0])


def map_known_poses(
    image_set: ImageSet,
    features: Sequence[Features],
    correspondences: Correspondences,
    options: MappingOptions,
    *,
    adjust_options: AdjustOptions,
    threads: int,
    events: Events,
    poses: HeldPoses,
) -> tuple[list[Reconstruction], MappingReport]:
    """One model in the frame of the known poses; arguments and result as of
    :func:`~sfmapp.mapping.incremental.map_images`.

    Raises:
        NoReconstructionError: the photographs refute most of the poses, or nothing can be triangulated from them; its
            ``report`` attribute holds the report.
    """
    names = [record.name for record in image_set.images]
    image_camera_idx = np.array([record.camera_idx for record in image_set.images], np.int32)
    tracks, track_report = build_tracks(correspondences, features)
    events.started(STAGE, "mapping", total=len(names))
    events.decided(STAGE, f"{track_report.num_tracks} tracks", **track_report)
    cameras, focal = first_cameras(
        list(image_set.cameras), image_camera_idx, correspondences, tracks, options, events
    )  # fmt: skip
    model = Reconstruction.empty(cameras, names, image_camera_idx, tracks)
    model.cam_from_world[:] = poses.cam_from_world
    _find_focal_lengths(model, correspondences, events)
    with ThreadPoolExecutor(threads) as pool:
        mapper = Mapper(
            reconstruction=model, correspondences=correspondences, options=options, adjust_options=adjust_options,
            events=events, pool=pool, prior_cameras=list(model.cameras), locked=np.zeros(len(names), bool),
            held=poses.is_known, poses_tell_centers=True, threads=threads,
        )  # fmt: skip
        refuted = _triangulate(mapper)
        is_believed = refuted <= MAX_REFUTED * poses.is_known.sum()
        is_mapped = is_believed and bool(model.is_triangulated.sum() >= options.min_pose_inliers)
        if is_mapped:
            mapper.grow()
            mapper.finish()
            poses.judge(mapper)
            adjustment = mapper.polish()
            model.point_rgb = track_colors(tracks, features)
    models = [model] if is_mapped else []
    entries = [
        ModelReport(**model.summary(), uncertainty=Uncertainty(), contradictions=found, apart="", adjustment=adjustment)
        for found in contradictions_of(models, correspondences)
    ]
    report = MappingReport(
        tracks=track_report, focal=focal, look_alikes=LookAlikesReport(), initial_pairs=[],
        images=image_reports(names, models, mapper.attempts), models=entries,
    )  # fmt: skip
    events.finished(STAGE, f"{len(models)} model(s)", num_models=len(models))
    if not is_mapped:
        num, points = int(poses.is_known.sum()), int(model.is_triangulated.sum())
        reason = f"the photographs refute {refuted} of {num} known poses" if refuted else f"they make {points} points"
        error = NoReconstructionError(f"points cannot be triangulated from the known poses: {reason}", _ADVICE)
        error.report = report
        raise error
    return models, report


def _find_focal_lengths(model: Reconstruction, correspondences: Correspondences, events: Events) -> None:
    """Of cameras of which nothing is known the focal length by which most matches agree with the poses, in place."""
    unknown = [c for c, camera in enumerate(model.cameras) if camera.focal_source == "default" and not camera.is_fixed]
    if not unknown:
        return
    first = list(model.cameras)
    agreeing = []
    for scale in FOCAL_SCALES.tolist():
        for c in unknown:
            model.cameras[c] = first[c].with_focal(scale * first[c].focal)
        agreeing.append(int(pair_agreement(model, correspondences).num_agreeing.sum()))
    best = float(FOCAL_SCALES[int(np.argmax(agreeing))])
    for c in unknown:
        model.cameras[c] = first[c].with_focal(best * first[c].focal)
    events.decided(
        STAGE, f"focal length {best:.2f} times the first guess: {max(agreeing)} matches agree with the poses"
    )


def _triangulate(mapper: Mapper) -> int:
    """Points from the poses that hold, intrinsics with them; returns how many poses most of their own matches refute:
    these are taken back."""
    model, held = mapper.reconstruction, mapper.held
    assert held is not None
    while True:
        # intrinsics are not adjusted yet
        structure.triangulate(
            model, np.arange(model.tracks.num_tracks), mapper.options, mapper.pool, mapper.options.max_pose_error_px
        )
        mapper.adjust_globally()
        is_refuted = mapper.drop_contradicted_images(held_too=True)
        mapper.held = held & model.is_registered
        if not is_refuted:
            break
        model.point_xyz[:], model.obs_is_inlier[:] = np.nan, False
    mapper.failed_with.clear()  # they come as if nothing were known of them
    mapper.times_dropped.clear()
    return int(held.sum() - mapper.held.sum())
