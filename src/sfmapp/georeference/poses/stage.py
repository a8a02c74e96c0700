"""Models in the frame of poses that are known beforehand, which are priors of the last adjustment.

For each model a robust similarity to the known poses, which are judged by it: their residuals have the errors of the
known pose, and those of the model as photographs alone made it. A pose that is refuted is named and left aside, the
others take part in the adjustment. Poses that are held are judged in :mod:`sfmapp.georeference.poses.held`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from sfmapp.adjust.selected_inverse import selected_covariances
from sfmapp.contradictions import Contradiction
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3, similarity
from sfmapp.georeference.adjustment import MAX_COST_PER_NUMBER, growth_of_cost
from sfmapp.georeference.control.stage import adjusting_of
from sfmapp.georeference.poses.fit import (
    GROUPS,
    KnownPoses,
    PoseFit,
    known_poses,
    robust_pose_fit,
)
from sfmapp.georeference.poses.options import PoseOptions
from sfmapp.georeference.poses.report import KnownPoseRow, PosedModel, PosesReport
from sfmapp.mapping.mapper import Mapper
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STAGE = "poses"
# Where fewer poses agree, they and the photographs contradict each other, and nothing tells which of them is right.
MIN_AGREEING = 0.6
# A scale that is four sigmas from nothing is known.
_MAX_SCALE_SIGMA = 0.25
# Huber's loss bends here, of six numbers together: of right poses one in thirty is beyond. Wrong ones were left out.
_HUBER_SIGMAS = 3.75


@dataclass(frozen=True)
class PoseFile:
    """Poses of a file, by photograph.

    Attributes:
        cam_from_world: (I, 7) in the frame of the file, NaN where it holds none.
        num_strange: poses of no photograph.
        options: where they are from, and how far to believe them.
    """

    path: Path
    cam_from_world: Array
    num_strange: int
    options: PoseOptions

    @property
    def is_known(self) -> Mask:
        """(I,) bool."""
        return np.isfinite(self.cam_from_world[:, 0])

    def of_images(self, image_idx: NDArray[np.int64]) -> KnownPoses:
        """Those of some images, with sigmas as stated or guessed."""
        sigma_deg = self.options.sigma_deg
        turn = None if sigma_deg is None else float(np.radians(sigma_deg))
        return known_poses(image_idx, self.cam_from_world[image_idx], self.options.sigma_m, turn)


def read_poses(options: PoseOptions, names: Sequence[str]) -> PoseFile:
    """The poses of photographs in the file of the options.

    Raises:
        InputError: it cannot be read, is damaged, names no photograph, or holds fewer than two poses of these.
    """
    assert options.file is not None
    found = read_ground_truth(options.file).for_images(names)
    position = {name: i for i, name in enumerate(names)}
    poses = np.full((len(names), 7), np.nan)
    for name, pose in zip(found.names, found.cam_from_world, strict=True):
        if name in position:
            poses[position[name]] = pose
    num = int(np.isfinite(poses[:, 0]).sum())
    if num < 2:
        raise InputError(
            f"{found.path}: expected poses of two photographs or more, found one of {len(names)}",
            "one pose determines neither scale nor position of a model",
        )
    return PoseFile(found.path, poses, len(found.names) - num, options)


# -------------------------------------------------------------------------------------------------------------- priors


def pose_models(mappers: Sequence[Mapper], known: PoseFile, events: Events) -> PosesReport:
    """Bring finished models into the frame of known poses and adjust them with these, in place, where two of their
    photographs or more have one."""
    rows = {i: _unplaced(i, mappers) for i in np.flatnonzero(known.is_known).tolist()}
    models = []
    for number, mapper in enumerate(mappers):
        image_idx = np.flatnonzero(mapper.reconstruction.is_registered & known.is_known)
        found = _pose_model(number, mapper, known.of_images(image_idx))
        models.append(found if isinstance(found, PosedModel) else found.row)
        if isinstance(found, PosedModel):
            events.decided(STAGE, f"model {number} is not aligned with the known poses: {found.reason}")
            continue
        rows |= pose_rows(number, mapper, found)
        events.decided(STAGE, _placed_text(found.row), **found.row)
    return poses_report(known, models, rows, events)


@dataclass(frozen=True)
class Judged:
    """Known poses, their fit to what photographs alone made of them, and what is said of it."""

    known: KnownPoses
    fit: PoseFit
    row: PosedModel


def _pose_model(number: int, mapper: Mapper, known: KnownPoses) -> PosedModel | Judged:
    """A model brought to known poses, or why it is not."""
    model, num = mapper.reconstruction, len(known.image_idx)
    if num < 2:
        reason = f"{num} of its photographs have a known pose, two are needed"
        return PosedModel(model=number, reason=reason, num_known=num, num_used=0)
    first = model.copy()
    scale, fit = brought(mapper, known)
    reason = "their places are all within rounding of each other" if fit is None else _fault(fit, num)
    if fit is None or reason:
        _restore(model, first)
        return PosedModel(model=number, reason=reason, num_known=num, num_used=0)
    judged = Judged(known, fit, posed_row(number, known, fit, scale))
    rigid = model.copy()
    optimized = adjusting_of(mapper).to_optimize()
    optimized.add(pose_graph(known, fit.sigma, fit.is_inlier))
    optimized.optimize(mapper.events)
    if growth_of_cost(rigid, model, mapper.noise.sigma_px) > MAX_COST_PER_NUMBER * 6 * int(fit.is_inlier.sum()):
        _restore(model, rigid)
        return replace(judged, row=replace(judged.row, is_adjusted=False))
    return judged


def brought(mapper: Mapper, known: KnownPoses) -> tuple[float, PoseFit | None]:
    """Bring a model into the frame of known poses, in place: by what scale, and how it fits there, its own errors
    reckoned with; None if it cannot be."""
    model = mapper.reconstruction
    # what photographs alone make of one more adjustment is no doing of the poses
    adjusting_of(mapper).to_optimize().optimize(mapper.events)
    first = robust_pose_fit(model.cam_from_world[known.image_idx], known)
    if first is None:
        return 1.0, None
    _move(model, first.world_from_model)
    fit = robust_pose_fit(model.cam_from_world[known.image_idx], known, _own_covariances(mapper, known))
    if fit is not None:
        _move(model, fit.world_from_model)
        return float(first.world_from_model[7] * fit.world_from_model[7]), fit
    return 1.0, None


def _own_covariances(mapper: Mapper, known: KnownPoses) -> Array | None:
    """(m, 6, 6) of poses as photographs alone tell them, in the order of residuals: the centre moves by -R^T v with
    ``x_cam <- exp(w) x_cam + v``, the rotation residual by R^T w. None where they are not determined, or too many
    images meet too many others."""
    model = mapper.reconstruction
    options, varying, noise = mapper.closing_options()
    found = selected_covariances(
        model, options, sigma_px=mapper.widening * noise.sigma_px, varying=varying, prior_cameras=mapper.prior_cameras
    )
    if found is None:
        return None
    back = rigid3.rotation_matrix(model.cam_from_world[known.image_idx]).transpose(0, 2, 1)
    slope = np.zeros((len(back), 6, 6))
    slope[:, :3, 3:], slope[:, 3:, :3] = -back, back
    own = np.stack([found.of_image(i) for i in known.image_idx.tolist()])
    turned: Array = slope @ own @ slope.transpose(0, 2, 1)
    return turned


def _fault(fit: PoseFit, num: int) -> str:
    """Why a similarity to known poses is not to be used; empty if it is."""
    if fit.is_inlier.mean() < MIN_AGREEING:
        return (
            f"only {fit.is_inlier.sum()} of {num} agree with the photographs: wrong poses, another convention than "
            "that of the format, or a wrong model"
        )
    if np.sqrt(fit.covariance[3, 3]) > _MAX_SCALE_SIGMA:
        share = 100 * float(np.sqrt(fit.covariance[3, 3]))
        return f"they tell the scale within {share:.0f} % only: cameras are too near to each other"
    return ""


def _move(model: Reconstruction, world_from_model: Array) -> None:
    registered = model.is_registered
    model.cam_from_world[registered] = similarity.transform_poses(world_from_model, model.cam_from_world[registered])
    model.point_xyz[:] = similarity.apply(world_from_model, model.point_xyz)


def _restore(model: Reconstruction, saved: Reconstruction) -> None:
    for name in ("cam_from_world", "point_xyz", "obs_is_inlier"):
        getattr(model, name)[:] = getattr(saved, name)
    model.cameras[:] = saved.cameras


def pose_graph(known: KnownPoses, sigma: Array, is_used: Mask) -> Any:
    """A gtsam.NonlinearFactorGraph that holds images at known poses, with a robust loss.

    Args:
        sigma: (2,) of places along each axis, of rotations about each axis; is_used: (m,) bool.
    """
    graph = gtsam.NonlinearFactorGraph()
    world_from_cam = rigid3.inverse(known.cam_from_world)
    rotation = rigid3.rotation_matrix(world_from_cam)
    # alike about all axes, so that those of the camera, as gtsam has them, will do
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sigma[::-1], 3))
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_SIGMAS), noise)
    for n in np.flatnonzero(is_used).tolist():
        pose = gtsam.Pose3(gtsam.Rot3(rotation[n]), world_from_cam[n, 4:])
        graph.push_back(gtsam.PriorFactorPose3(X(int(known.image_idx[n])), pose, robust))
    return graph


# ------------------------------------------------------------------------------------------------------- what is said


def _unplaced(image: int, mappers: Sequence[Mapper]) -> KnownPoseRow:
    number = next((n for n, mapper in enumerate(mappers) if mapper.reconstruction.is_registered[image]), None)
    reason = "no model holds the photograph" if number is None else "its model does not lie in the frame of the poses"
    name = mappers[0].reconstruction.image_names[image] if mappers else ""
    return KnownPoseRow(name=name, model=number, is_used=False, reason=reason)


def posed_row(number: int, known: KnownPoses, fit: PoseFit, scale: float) -> PosedModel:
    """What is said of a model that lies in the frame of known poses."""
    sigma, sigma_rad = fit.sigma
    factor = np.where(known.is_stated, fit.sigma / known.sigma, 1.0)
    return PosedModel(
        model=number,
        reason="",
        num_known=len(known.image_idx),
        num_used=int(fit.is_inlier.sum()),
        sigma=float(sigma),
        sigma_deg=float(np.degrees(sigma_rad)),
        sigma_factor=(float(factor[0]), float(factor[1])),
        scale=scale,
        scale_sigma_share=float(np.sqrt(fit.covariance[3, 3])),
        is_adjusted=True,
    )


def pose_rows(number: int, mapper: Mapper, judged: Judged) -> dict[int, KnownPoseRow]:
    """What is said of each known pose, by photograph."""
    rows = {}
    fit = judged.fit
    length, angle = (np.linalg.norm(fit.residual[:, group], axis=1) for group in GROUPS)
    for n, i in enumerate(judged.known.image_idx.tolist()):
        off, off_deg, sigmas = float(length[n]), float(np.degrees(angle[n])), float(np.sqrt(fit.squares[n]))
        is_used = bool(fit.is_inlier[n])
        reason = f"photographs put it {off:.3g} and {off_deg:.2g} degrees from its known pose, {sigmas:.0f} sigmas"
        rows[i] = KnownPoseRow(
            name=mapper.reconstruction.image_names[i], model=number, is_used=is_used, reason="" if is_used else reason,
            off=off, off_deg=off_deg, sigmas=sigmas,
        )  # fmt: skip
    return rows


def _placed_text(row: PosedModel) -> str:
    assert row.sigma is not None
    assert row.sigma_deg is not None
    return (
        f"model {row.model} lies in the frame of {row.num_used} of {row.num_known} known poses, which are good to "
        f"{row.sigma:.2g} and {row.sigma_deg:.2g} degrees"
    )


def poses_report(
    known: PoseFile,
    models: Sequence[PosedModel],
    rows: dict[int, KnownPoseRow],
    events: Events,
    contradictions: Sequence[Contradiction] = (),
) -> PosesReport:
    """What is said of the poses of a file, by photograph; those that are left aside are warned of."""
    for row in rows.values():
        if row.model is not None and not row.is_used and row.reason:
            events.warned(STAGE, f"known pose of {row.name} is left aside: {row.reason}")
    return PosesReport(
        path=str(known.path), is_fixed=known.options.fixed, num_known=int(known.is_known.sum()),
        num_strange=known.num_strange, models=models, images=[rows[i] for i in sorted(rows)],
        contradictions=list(contradictions),
    )  # fmt: skip
