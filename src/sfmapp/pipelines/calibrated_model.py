"""A model whose lenses a calibration replaces: poses and points follow, and the photographs say whether they agree.

A lens alone cannot be exchanged: poses and points were found with the old one, and would project wrongly through the
new one. They are adjusted with the new one held. Evidence for or against the calibration is how much worse they explain
the photographs then, and the focal length that the photographs tell by themselves, with its sigma: a few of them bend
to any lens without a trace in the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.calibration.comparison import projection_difference
from sfmapp.calibration.file import read_given_camera
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.uncertainty import image_grid, projection_sigma
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.photographs import GivenCamera, Photograph
from sfmapp.contradictions import Contradiction
from sfmapp.dense.photographs import Photographs, scaled_camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping import structure
from sfmapp.pipelines.lens_fit import LensFit, fit_lens
from sfmapp.report.model import CalibratedModelReport, LensChange
from sfmapp.scene.reconstruction import Reconstruction

STAGE = "calibration"
# Rounds of adjustment, each with the loss that the residuals of the last one ask for: a lens that is far off begins
# with residuals of tens of pixels.
_ROUNDS = 3
# residuals are not believed to be better than that
_MIN_NOISE_PX = 0.02
# Photographs of a camera from which its focal length is told: those of one place, some seconds of work.
_MOST_PHOTOGRAPHS, _FEWEST_PHOTOGRAPHS = 20, 5
# as everywhere, once in four hundred by chance
_SIGMAS = 3.0
# a ray so far from the axis shows the focal length of any lens
_NEAR_AXIS = 1e-3
# What a calibration adds to the residuals, of those that the model had: that share makes each residual 4 % longer,
# which no lens does that is right up to its own sigmas, and which one that is wrong by more than can be seen does.
_CONTRADICTS = 0.3


def with_calibration(
    model: Reconstruction, photographs: Photographs, folder: str, given: str, events: Events, *, threads: int = 1
) -> tuple[Reconstruction, Photographs, CalibratedModelReport]:
    """A model with the lenses of a calibration, and its poses and points adjusted to them.

    It stays where it lies: place, direction and size are those of the cameras before.

    Args:
        model: left as it is.
        photographs: of its registered images.
        folder: that their names are relative to.
        given: a calibration file of any form, or ``MODEL,PARAMETERS``.
        events: told of decisions and of a contradiction.
        threads: of the adjustment.

    Returns:
        The model, the photographs with their cameras, and what is to be said of it.

    Raises:
        InputError: it cannot be read, is for pictures of another shape, or does not tell its cameras apart.
    """
    shots = [Photograph(one.name, (one.width, one.height), one.orientation) for one in photographs.records]
    cameras, calibration = read_given_camera(given)
    lenses = cameras.of_photographs(folder, shots)
    found = model.copy()
    changes = _replace_cameras(found, photographs, lenses)
    before = structure.residual_scale_px(model, _MIN_NOISE_PX)
    events.started(STAGE, "adjusting poses and points to the calibration")
    for _ in range(_ROUNDS):
        scale = structure.residual_scale_px(found, _MIN_NOISE_PX)
        FactorGraph(found, AdjustOptions().robust(scale), noise_px=1.0, threads=threads).optimize(events)
    events.finished(STAGE)
    _put_back(found, model)
    after = structure.residual_scale_px(found, _MIN_NOISE_PX)
    report = CalibratedModelReport(
        file=given,
        lenses=[
            _told_by_photographs((model, number), (found, place), _change(old, found.cameras[place], calibration))
            for number, place, old in changes
        ],
        noise_before_px=before,
        noise_px=after,
        contradictions=[],
    )
    report = replace(report, contradictions=_contradictions(report))
    _tell(report, lenses, events)
    held = tuple(lens.camera for lens in lenses)
    return found, replace(photographs, cameras=held), report


def _replace_cameras(
    model: Reconstruction, photographs: Photographs, lenses: Sequence[GivenCamera]
) -> list[tuple[int, int, Camera]]:
    """Give images the cameras of the calibration, in place, in pixels of the model.

    Returns:
        Of each its number before and now, and the one before.
    """
    place: dict[tuple[int, int], int] = {}
    cameras = list(model.cameras)
    for image, lens in zip(photographs.image_idx.tolist(), lenses, strict=True):
        old = int(model.image_camera_idx[image])
        key = old, id(lens)
        if key not in place:
            place[key] = old if old not in {first for first, _ in place} else len(cameras)
            before = model.cameras[old]
            new = replace(scaled_camera(lens.camera, before.width, before.height), is_fixed=True)
            cameras[place[key] :] = [new, *cameras[place[key] + 1 :]]
        model.image_camera_idx[image] = place[key]
    olds, model.cameras = model.cameras, cameras
    return [(old, k, olds[old]) for (old, _), k in place.items()]


def _put_back(model: Reconstruction, before: Reconstruction) -> None:
    """Move a model to where it lay, in place: an adjustment leaves place, direction and size open."""
    known = model.is_registered
    try:
        old_from_new = similarity.align_poses(model.cam_from_world[known], before.cam_from_world[known]).b_from_a
    except ValueError:  # all in one place
        return
    if model.rig is not None:  # it knows its own size
        rotation = rigid3.rotation_matrix(old_from_new)
        shift = rigid3.center(before.cam_from_world[known]) - rigid3.center(model.cam_from_world[known]) @ rotation.T
        old_from_new = similarity.from_parts(rotation, shift.mean(0), 1.0)
    model.cam_from_world[known] = similarity.transform_poses(old_from_new, model.cam_from_world[known])
    model.point_xyz = similarity.apply(old_from_new, model.point_xyz)


def _change(old: Camera, new: Camera, calibration: CameraCalibration | None) -> LensChange:
    sigma = None
    if calibration is not None:
        made = calibration.camera
        scale = max(new.width, new.height) / max(made.width, made.height)
        sigma = scale * float(np.sqrt(np.nanmean(projection_sigma(calibration, image_grid(made)) ** 2)))
    try:
        difference = projection_difference(old, new)[1]
    except InputError:  # hardly a ray in common
        return LensChange(before=old.model.name, after=new.model.name, focal_px=_focal(new), sigma_px=sigma)
    length = np.hypot(difference[:, 0], difference[:, 1])
    return LensChange(
        before=old.model.name, after=new.model.name, focal_px=_focal(new), rms_px=float(np.sqrt(np.nanmean(length**2))),
        max_px=float(np.nanmax(length)), sigma_px=sigma,
    )  # fmt: skip


def _focal(camera: Camera) -> float:
    """Pixels for a radian at the axis, whatever the lens."""
    middle, beside = project(camera, np.array([[0.0, 0.0, 1.0], [_NEAR_AXIS, 0.0, 1.0]]))
    return float(np.linalg.norm(beside - middle)) / _NEAR_AXIS


def _told_by_photographs(
    before: tuple[Reconstruction, int], after: tuple[Reconstruction, int], change: LensChange
) -> LensChange:
    """With the focal length that some photographs of a camera tell by themselves; as it is where they do not.

    Both the model as it was and the adjusted one are asked: what the one bends to, because it began there, the other
    does not.
    """
    found = [_lens_of(*one) for one in (before, after)]
    if any(one is None or not np.isfinite(one.focal_sigma_relative) for one in found):
        return change
    (log1, sigma1), (log2, sigma2) = (
        (np.log(_focal(one.camera)), one.focal_sigma_relative) for one in found if one is not None
    )
    if abs(log1 - log2) > _SIGMAS * np.hypot(sigma1, sigma2):
        return change
    # one evidence seen from two sides, not two
    weights = np.array([sigma1**-2, sigma2**-2])
    focal = float(np.exp(np.average([log1, log2], weights=weights)))
    return replace(change, told_focal_px=focal, told_sigma_px=focal * max(min(sigma1, sigma2), abs(log1 - log2) / 2.0))


def _lens_of(model: Reconstruction, number: int) -> LensFit | None:
    """The lens of a camera fitted to some of its photographs; None where they are few."""
    camera = model.cameras[number]
    images = np.flatnonzero(model.is_registered & (model.image_camera_idx == number))[:_MOST_PHOTOGRAPHS]
    if len(images) < _FEWEST_PHOTOGRAPHS or model.rig is not None or camera.model == CameraModel.EQUIRECTANGULAR:
        return None
    part = model.copy()
    part.cameras, part.image_camera_idx = [camera], np.zeros_like(part.image_camera_idx)
    part.cam_from_world[np.setdiff1d(np.flatnonzero(part.is_registered), images)] = np.nan
    part.obs_is_inlier &= np.isin(part.tracks.obs_image_idx, images)
    return fit_lens(part)


def _contradictions(report: CalibratedModelReport) -> list[Contradiction]:
    found = []
    given, before, after = report.file, report.noise_before_px, report.noise_px
    advice = "calibrate the camera at the same zoom, focus and size of picture, or leave --camera out"
    added = float(np.sqrt(max(after**2 - before**2, 0.0)))
    if added > _CONTRADICTS * before:
        message = (
            f"with the camera of {given} the points of the model miss the photographs by {after:.2f} px, with its own "
            f"by {before:.2f} px: the photographs were hardly taken by that camera in that state"
        )
        evidence = {"noise_before_px": before, "noise_px": after, "added_share": added / before, "limit": _CONTRADICTS}
        found.append(Contradiction("given calibration", message, advice, evidence))
    for lens in report.lenses:
        told, sigma = lens.told_focal_px, lens.told_sigma_px
        if told is None or sigma is None or abs(lens.focal_px - told) <= _SIGMAS * sigma:
            continue
        message = (
            f"with the camera of {given} the focal length is {lens.focal_px:.1f} px, by the photographs alone "
            f"{told:.1f} \N{PLUS-MINUS SIGN}{sigma:.1f} px"
        )
        evidence = {"focal_px": lens.focal_px, "told_focal_px": told, "told_sigma_px": sigma, "limit_sigmas": _SIGMAS}
        found.append(Contradiction("given focal length", message, advice, evidence))
    return found


def _tell(report: CalibratedModelReport, lenses: Sequence[GivenCamera], events: Events) -> None:
    for problem in dict.fromkeys(lens.problem for lens in lenses if lens.problem is not None):
        events.warned(STAGE, problem)
    events.decided(STAGE, report.text, **report)
    for each in report.contradictions:
        events.warned(STAGE, f"CONTRADICTED: {each.message}; {each.advice}")
