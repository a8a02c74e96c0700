"""Which photographs were taken by the same camera, and what is known of it beforehand."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from statistics import median, pstdev

from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.photographs import GivenCamera, Photograph, read_given_cameras
from sfmapp.errors import UsageError
from sfmapp.events import Events
from sfmapp.geometry.orientation import MIRRORED
from sfmapp.images.exif import ExifFacts, FocalPrior, focal_prior
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.report import CameraPrior
from sfmapp.scene.turned_camera import fault_of_upright

# Trust in what a user gives without fixing it: a focal length copied from a data sheet, or a calibration.
_SIGMA_USER_FOCAL, SIGMA_USER_PARAMS = 0.03, 0.01
# Frames of one video or one shoot have one size; a few strays must not split them, while photographs collected from
# many people come in many sizes, none of which holds nearly all.
_SERIES_SHARE = 0.9
# That many names that differ in their numbers alone make a series of their own.
_SERIES_LENGTH = 5
# Editors and converters write a focal length as another fraction, which changes its fifth digit or a later one; the
# nearest settings of a zoom are about a per cent apart, and focusing alone changes the picture by more than this.
_SAME_FOCAL = 1e-3
# EXIF contradicts a given focal length that it misses by more than so many standard deviations of both: 35 mm
# equivalents are off by 10 % here and there, another setting of a zoom by a factor.
_CONTRADICTS_SIGMAS = 4.0
_SOURCE_RANK = ("exif_35mm", "exif_sensor", "default")


@dataclass(frozen=True)
class Shot:
    """What cameras are told apart by: a name, a size in pixels of the file, and EXIF."""

    name: str
    width: int
    height: int
    facts: ExifFacts


def group_cameras(
    shots: Sequence[Shot], options: ImageOptions, root: str = ""
) -> tuple[list[Camera], list[int], list[CameraPrior], list[tuple[str, str]]]:
    """Cameras, the camera index of each shot, a report entry per camera, and warnings.

    ``auto`` shares a camera between shots with the same make, model, lens, serial number, focal length and size. Where
    EXIF does not tell, a series (one folder, one file type, names that differ in their numbers alone) shares a camera
    if nearly all of it has one size; otherwise the photographs may come from anyone, and each has a camera of its own.
    Photographs that one of the given cameras took share it.

    Args:
        shots: in the order of the images.
        options: what is known about the cameras.
        root: folder that the names are relative to, whose own name may be that of a camera.

    Returns:
        cameras in order of first use; camera_idx per shot; what is known of each camera; (image name, problem) pairs.

    Raises:
        UsageError: ``camera_params`` with images of several sizes, or for pictures that EXIF's orientation has turned.
        InputError: the given cameras cannot be read, or do not fit the images.
    """
    sizes = {(shot.width, shot.height) for shot in shots}
    if options.camera_params is not None and len(sizes) > 1:
        shown = ", ".join(f"{w}x{h}" for w, h in sorted(sizes)[:4])
        raise UsageError(
            f"camera_params describe one camera, but the images have several sizes: {shown}",
            "give focal_px instead, or leave out the images of other sizes",
        )
    given = _given_cameras(shots, options, root)
    keys, rules = _sharing_keys(shots, options)
    keys = [(known.name if known else None, key) for known, key in zip(given, keys, strict=True)]
    index = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    members: list[list[int]] = [[] for _ in index]
    for i, key in enumerate(keys):
        members[index[key]].append(i)
    priors = [focal_prior(shot.facts, shot.width, shot.height) for shot in shots]
    warnings = [(shot.name, problem) for shot, prior in zip(shots, priors, strict=True) for problem in prior.problems]
    warnings += _doubts(shots, priors, given)
    cameras: list[Camera] = []
    entries: list[CameraPrior] = []
    for group in members:
        camera, reason = _camera(shots[group[0]], [priors[i] for i in group], options, given[group[0]])
        if options.camera_params is not None:
            _check_not_of_upright(camera, [shots[i] for i in group])
        facts = shots[group[0]].facts
        entries.append(
            CameraPrior(
                camera_idx=len(cameras),
                num_images=len(group),
                model=camera.model.name,
                width=camera.width,
                height=camera.height,
                params=[float(value) for value in camera.params],
                focal_px=camera.focal,
                focal_sigma_px=camera.focal_sigma,
                focal_source=camera.focal_source,
                focal_reason=reason,
                is_fixed=camera.is_fixed,
                make=facts.make,
                camera=facts.model,
                sharing=rules[group[0]],
            )
        )
        cameras.append(camera)
    return cameras, [index[key] for key in keys], entries, warnings


def tell_cameras(entries: Sequence[CameraPrior], stage: str, events: Events) -> None:
    """One event for each camera: which images share it, and where its focal length comes from."""
    for entry in entries:
        sigma = "" if entry.focal_sigma_px is None else f" +- {entry.focal_sigma_px:.0f}"
        events.decided(
            stage,
            f"camera {entry.camera_idx}: {entry.num_images} images, {entry.width}x{entry.height}, focal "
            f"length {entry.focal_px:.0f}{sigma} px ({entry.focal_reason})",
            **entry,
        )


def _given_cameras(shots: Sequence[Shot], options: ImageOptions, root: str) -> Sequence[GivenCamera | None]:
    if options.camera is None or not shots:
        return [None] * len(shots)
    photographs = [Photograph(shot.name, (shot.width, shot.height), shot.facts.orientation) for shot in shots]
    return read_given_cameras(options.camera).of_photographs(root, photographs)


def _camera(
    shot: Shot, priors: list[FocalPrior], options: ImageOptions, given: GivenCamera | None
) -> tuple[Camera, str]:
    model, width, height = options.camera_model, shot.width, shot.height
    if given is not None:
        camera, reason = given.camera, given.reason
    elif options.camera_params is not None:
        camera = simple_camera(model, width, height, 1.0, source="user").with_params(options.camera_params)
        camera = replace(camera, focal_sigma=SIGMA_USER_PARAMS * camera.focal)
        reason = "camera_params"
    elif options.focal_px is not None:
        sigma = _SIGMA_USER_FOCAL * options.focal_px
        camera = simple_camera(model, width, height, options.focal_px, sigma, "user")
        reason = "focal_px"
    else:
        prior = _common_prior(priors)
        camera = simple_camera(model, width, height, prior.focal_px, prior.sigma_px, prior.source)
        reason = prior.reason
    if camera.model == CameraModel.EQUIRECTANGULAR:  # its size says all
        return replace(camera, focal_source="user", focal_sigma=None, is_fixed=True), "the size of a panorama"
    return replace(camera, is_fixed=options.fix_intrinsics), reason


def _check_not_of_upright(camera: Camera, shots: Sequence[Shot]) -> None:
    """Parameters that were found with pictures that some reader had turned, as OpenCV's does."""
    for shot in shots:
        fault = fault_of_upright(camera, shot.facts.orientation, f"as {shot.name} has them")
        if fault is not None:
            raise UsageError(f"camera_params: {fault[0]}", f"give {fault[1]}, the same lens in the pixels of the file")


def _common_prior(priors: list[FocalPrior]) -> FocalPrior:
    """One prior for images that share a camera: the median of the best source, no surer than they agree."""
    best = min(priors, key=lambda prior: _SOURCE_RANK.index(prior.source)).source
    of_best = [prior for prior in priors if prior.source == best]
    focals = [prior.focal_px for prior in of_best]
    sigma = (median(prior.sigma_px for prior in of_best) ** 2 + pstdev(focals) ** 2) ** 0.5
    return replace(of_best[0], focal_px=float(median(focals)), sigma_px=sigma)


def _doubts(
    shots: Sequence[Shot], priors: Sequence[FocalPrior], given: Sequence[GivenCamera | None]
) -> list[tuple[str, str]]:
    """(image name, problem) of photographs whose given camera is odd, or has clearly another focal length than EXIF."""
    found = []
    for shot, prior, known in zip(shots, priors, given, strict=True):
        if known is not None and known.problem is not None:
            found.append((shot.name, known.problem))
        if known is None or prior.source == "default" or known.camera.model == CameraModel.EQUIRECTANGULAR:
            continue
        focal, sigma = known.camera.focal, math.hypot(prior.sigma_px, known.camera.focal_sigma or 0.0)
        if abs(prior.focal_px - focal) > _CONTRADICTS_SIGMAS * sigma:
            problem = f"the given camera has a focal length of {focal:.0f} px, EXIF says {prior.focal_px:.0f} px"
            found.append((shot.name, f"{problem} ({prior.reason}): is it of another camera, zoom or size of picture?"))
    return found


def _sharing_keys(shots: Sequence[Shot], options: ImageOptions) -> tuple[list[Hashable], list[str]]:
    """A key per shot, equal for those that share a camera, and the rule behind it."""
    sharing = options.camera_sharing
    if sharing == "auto" and (options.camera is not None or options.camera_params is not None):
        sharing = "all"
    if sharing == "per_image":
        return [shot.name for shot in shots], ["a camera per image"] * len(shots)
    if sharing == "all":
        return [(shot.width, shot.height) for shot in shots], ["a camera per image size"] * len(shots)
    if sharing == "per_folder":
        folders = [str(PurePosixPath(shot.name).parent) for shot in shots]
        keys: list[Hashable] = [(f, s.width, s.height) for f, s in zip(folders, shots, strict=True)]
        return keys, ["a camera per folder and image size"] * len(shots)
    return _automatic_keys(shots)


def _automatic_keys(shots: Sequence[Shot]) -> tuple[list[Hashable], list[str]]:
    keys: list[Hashable] = [shot.name for shot in shots]
    rules = ["on its own: EXIF does not tell the camera, and the series has other sizes"] * len(shots)
    series: defaultdict[Hashable, list[int]] = defaultdict(list)
    templates = Counter(_template(shot) for shot in shots if not _tells_camera(shot.facts))
    focal_mm = _without_rounding([shot.facts.focal_mm for shot in shots])
    focal_35mm = _without_rounding([shot.facts.focal_35mm for shot in shots])
    for i, shot in enumerate(shots):
        if _tells_camera(shot.facts):
            facts = shot.facts
            lens = (facts.make, facts.model, facts.lens, facts.serial, focal_mm[i], focal_35mm[i])
            keys[i] = ("exif", *lens, shot.width, shot.height, _is_mirrored(shot))
            rules[i] = "EXIF: same make, model, lens, focal length and size"
            continue
        folder, ending, stem = template = _template(shot)
        series[folder, ending, stem if templates[template] >= _SERIES_LENGTH else "", shot.facts.model].append(i)
    for key, group in series.items():
        # portrait and landscape frames of one camera are one size
        sizes = Counter(tuple(sorted((shots[i].width, shots[i].height))) for i in group)
        size, count = sizes.most_common(1)[0]
        if count < _SERIES_SHARE * len(group):
            continue
        for i in group:
            if tuple(sorted((shots[i].width, shots[i].height))) == size:
                keys[i] = ("series", key, shots[i].width, shots[i].height, _is_mirrored(shots[i]))
                rules[i] = "no EXIF: same folder, file type, manner of naming and size"
    return keys, rules


def _without_rounding(focals: Sequence[float | None]) -> list[float | None]:
    """The focal lengths with all that are the same but for their rounding replaced by the shortest of them."""
    shortest: dict[float, float] = {}
    first = 0.0
    for focal in sorted({focal for focal in focals if focal is not None}):
        first = first if focal <= (1.0 + _SAME_FOCAL) * first else focal
        shortest[focal] = first
    return [None if focal is None else shortest[focal] for focal in focals]


def _tells_camera(facts: ExifFacts) -> bool:
    return bool(facts.model) and (facts.focal_mm is not None or facts.focal_35mm is not None)


def _is_mirrored(shot: Shot) -> bool:
    """A mirror moves the principal point to the other side; a turn is only how the sensor was held."""
    return shot.facts.orientation in MIRRORED


def _template(shot: Shot) -> tuple[str, str, str]:
    """(folder, file type, name with its numbers blanked)."""
    path = PurePosixPath(shot.name)
    return str(path.parent), path.suffix.lower().replace("jpeg", "jpg"), re.sub("[0-9]+", "#", path.stem)
