"""Poses that are held as they are, judged by the same photographs adjusted without them.

A pose that is far off the others is let go. Where all are a little off, none stands out, and each looks as good as the
rest; but points that are made of poses held so are wrong, and their reprojections say it. So the poses are freed, and
points that these were not fitted to tell whether photographs and poses contradict each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.georeference.poses.fit import MAX_POSE_CHI2, MIN_REDUNDANT_POSES, KnownPoses, PoseFit
from sfmapp.georeference.poses.report import KnownPoseRow, PosedModel, PosesReport
from sfmapp.georeference.poses.stage import (
    MIN_AGREEING,
    STAGE,
    Judged,
    PoseFile,
    brought,
    pose_rows,
    posed_row,
    poses_report,
)
from sfmapp.mapping.focal_priors import FOCAL_INFLATION
from sfmapp.mapping.intrinsics_check import hold_out
from sfmapp.mapping.mapper import Mapper
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# Freed poses leave this share of the residuals of points that they were not fitted to, or less. Surveyed ones (2 to
# 6 mm and 0.03 degrees off) leave 0.7 to 1 on the shared sets; 1 cm and 0.05 degrees at ten metres leave 0.16.
CLEAR_RATIO = 0.5
_NUM_NAMED, _FEWEST_NAMED = 5, 3


def judge_held_poses(mapper: Mapper, known: PoseFile, events: Events) -> PosesReport:
    """Hold known poses that a finished map was made of against the same photographs adjusted without them; those that
    are clearly refuted are let go, and the map is adjusted once more."""
    held = mapper.held
    assert held is not None
    rows = {int(i): _taken_back(int(i), mapper) for i in np.flatnonzero(known.is_known & ~held)}
    image_idx = np.flatnonzero(held)
    # what was known of the cameras beforehand speaks neither for nor against poses: it holds them where these put them
    cameras = list(mapper.reconstruction.cameras)
    free = replace(mapper, reconstruction=mapper.reconstruction.copy(), held=None, prior_cameras=cameras)
    free.polish()
    judged_idx = image_idx[free.reconstruction.is_registered[image_idx]]
    of_images = known.of_images(judged_idx)
    _, fit = brought(free, of_images)
    names, num = mapper.reconstruction.image_names, int(known.is_known.sum())
    for i in image_idx.tolist():
        rows[i] = KnownPoseRow(name=names[i], model=0, is_used=True, reason="")
    row = PosedModel(model=0, reason="", num_known=num, num_used=len(image_idx))
    if fit is None or len(judged_idx) < MIN_REDUNDANT_POSES:
        return poses_report(known, [row], rows, events)
    refuted = judged_idx[~fit.is_inlier]
    judged = Judged(of_images, fit, posed_row(0, of_images, fit, 1.0))
    found = pose_rows(0, mapper, judged)
    if len(refuted) > (1.0 - MIN_AGREEING) * len(judged_idx):
        events.warned(
            STAGE,
            f"{len(refuted)} of {len(judged_idx)} known poses that were held contradict the photographs: wrong poses, "
            "or a wrong lens; all were held nevertheless",
        )
        found = {i: replace(one, is_used=True) for i, one in found.items()}
    elif len(refuted):
        _let_go(mapper, free.reconstruction, refuted)
    sigmas = _off_sigmas(of_images, fit)
    found = {i: replace(found[i], sigmas=float(off)) for i, off in zip(judged_idx.tolist(), sigmas, strict=True)}
    row = replace(
        judged.row, num_known=num, num_used=int(held.sum()), scale=None, scale_sigma_share=None, is_adjusted=None
    )
    contradictions = _contradiction(mapper, free, known, row, [found[i] for i in judged_idx.tolist() if held[i]])
    for contradiction in contradictions:
        events.warned(STAGE, contradiction.message)
    return poses_report(known, [row], rows | found, events, contradictions)


def _off_sigmas(known: KnownPoses, fit: PoseFit) -> Array:
    """(m,) how far poses are off in standard deviations of what photographs tell, and of what was stated, as a pose
    that is held claims to be right. Infinite where photographs tell nothing."""
    stated = np.where(known.is_stated, known.sigma, 0.0)
    total = FOCAL_INFLATION**2 * fit.own + np.diag(np.repeat(np.maximum(stated, 1e-9), 3) ** 2)
    solved = np.linalg.solve(total, fit.residual[:, :, None])[:, :, 0]
    sigmas: Array = np.sqrt((fit.residual * solved).sum(1))
    return np.where(fit.own.any(axis=(1, 2)), sigmas, np.inf)


def _contradiction(
    mapper: Mapper, free: Mapper, known: PoseFile, row: PosedModel, held: Sequence[KnownPoseRow]
) -> list[Contradiction]:
    """What the photographs say against poses that are held: nothing, or one contradiction.

    Args:
        free: the map adjusted without known poses, in their frame. held: what was found of each.
    """
    assert row.sigma is not None
    assert row.sigma_deg is not None
    if mapper.held is None or not mapper.held.any():
        return []
    base, own = free.reconstruction.copy(), mapper.reconstruction
    base.cam_from_world[mapper.held] = known.cam_from_world[mapper.held]
    # a loss that lets go of what is far off needs the lens that these poses have
    base.cameras[:] = own.cameras
    both = base.is_triangulated & own.is_triangulated
    base.point_xyz[both] = own.point_xyz[both]
    options = free.robust(free.adjust_options)
    found = hold_out(base, options, free.reconstruction.copy(), options, held_images=mapper.held)
    if not found.ratio <= CLEAR_RATIO:
        return []
    worst = sorted(held, key=lambda one: -(one.sigmas or 0.0))
    off = [one for one in worst if one.sigmas is not None and one.sigmas**2 > MAX_POSE_CHI2]
    off = off or worst[:_FEWEST_NAMED]  # none is beyond doubt by itself, all together are
    named = ", ".join(_off_text(one) for one in off[:_NUM_NAMED])
    more = f", and {len(off) - _NUM_NAMED} more" if len(off) > _NUM_NAMED else ""
    return [
        Contradiction(
            "held poses",
            f"{len(held)} poses are held, and the photographs contradict them: freed, points that the poses were not "
            f"fitted to agree {1.0 / max(found.ratio, 1e-9):.1f} times better; off are {named}{more}",
            "leave out --fix-poses: as priors, known poses give way as far as they are wrong",
            {
                "held_out_residual_ratio": found.ratio, "limit": CLEAR_RATIO, "sigma": row.sigma,
                "sigma_deg": row.sigma_deg, "images": [one.name for one in off],
            },
            rotation_sigma_deg=row.sigma_deg,
            position_sigma_share=row.sigma / rigid3.spread(known.cam_from_world[mapper.held]),
        )
    ]  # fmt: skip


def _off_text(row: KnownPoseRow) -> str:
    sigmas = f" ({row.sigmas:.0f} sigmas)" if row.sigmas is not None and np.isfinite(row.sigmas) else ""
    return f"{row.name} by {row.off:.2g} and {row.off_deg:.2g} degrees{sigmas}"


def _let_go(mapper: Mapper, free: Reconstruction, refuted: NDArray[np.int64]) -> None:
    """Free some of the poses that were held, which begin where the photographs put them, and adjust the map again.

    Args:
        free: the map adjusted without known poses, in their frame.
    """
    assert mapper.held is not None
    mapper.held[refuted] = False
    mapper.reconstruction.cam_from_world[refuted] = free.cam_from_world[refuted]
    mapper.triangulate_images(refuted.tolist())
    mapper.finish()


def _taken_back(image: int, mapper: Mapper) -> KnownPoseRow:
    """An image whose known pose its matches have contradicted before all else."""
    model = mapper.reconstruction
    pose = "" if model.is_registered[image] else ", and no other was found"
    reason = f"most of its verified matches contradict the known pose{pose}"
    return KnownPoseRow(
        name=model.image_names[image], model=0 if model.is_registered[image] else None, is_used=False, reason=reason
    )
