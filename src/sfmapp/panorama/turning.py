"""The stage that finds how a camera was turned: correspondences in, rotations and lenses with their sigmas out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.camera.lens import BROWN
from sfmapp.camera.names import CameraModel
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.mapping.tracks import USELESS_CONFIGS, build_tracks
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.two_view import error_threshold_px
from sfmapp.panorama import pairs as turns
from sfmapp.panorama.adjustment import Turned, TurnedFit, adjust_turns, rays_of_tracks, refinable
from sfmapp.panorama.level import level
from sfmapp.panorama.pairs import MatchedPixels, Turn
from sfmapp.panorama.report import LensChoice, TurningReport
from sfmapp.panorama.turned_photographs import TurnedPhotographs
from sfmapp.panorama.turning_report import judge_pairs, report_of
from sfmapp.panorama.zooms import Zooms, find_zooms, unzoomed
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.scene.tracks import Tracks, make_tracks

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

STAGE = "rotations"
# Before the distortion of the lens is known, matches in the corners may be off by that much more.
_LOOSE = 4.0
# Of all verified matches rotations are to explain three quarters: 96 % of a panorama of alike columns that match each
# other wrongly, and 61 % of two planes, one behind the other, before which the camera moved.
_LEAST_SHARE = 0.75
# Lens models are compared on so many rays of each half: enough to see a hundredth of a pixel.
_TRACKS_OF_HALF = 5000
# Keypoints are of one scale within a quarter of it; so many of them tell how noise grows with scale, and how little of
# it cannot be told from none.
_SAME_SCALE, _FEWEST_OF_GROWTH, _LEAST_NOISE_PX = 0.25, 400, 0.01
# coefficients of distortion that are tried
_MOST_DISTORTION = 2
_ADVICE = (
    "photographs taken from different places belong into sfmapp reconstruct; for a panorama turn the camera on the "
    "spot, about its lens, and let each photograph overlap the next by a third"
)


@dataclass(frozen=True)
class _Evidence:
    """What is worked on.

    Attributes:
        pair_idx: (P,) pairs of the correspondences with enough matches. pixels: of each.
        thresholds: of each, pixels.
        image_camera_idx: (I,). priors: cameras as they were known.
    """

    correspondences: Correspondences
    features: Sequence[Features]
    pair_idx: Ints
    pixels: list[MatchedPixels]
    thresholds: list[float]
    image_camera_idx: Ints
    priors: list[Camera]
    seed: int


@dataclass(frozen=True)
class _Round:
    """Photographs that hang together, the pairs that hold them; ``tracks`` and below count among ``members``."""

    members: Ints
    groups: list[Ints]
    used: Ints
    tracks: Tracks
    camera_idx: Ints
    fit: TurnedFit


def find_rotations(
    image_set: ImageSet, features: Sequence[Features], correspondences: Correspondences, options: MatchingOptions, *,
    seed: int, events: Events, among: Ints | None = None,
) -> tuple[TurnedPhotographs, TurningReport]:  # fmt: skip
    """Find the largest group of photographs that were taken from one place, their rotations and lenses.

    Args:
        image_set: the photographs. features: of each. correspondences: verified matches.
        options: of the matching, for its threshold.
        seed: of the draws.
        among: positions of the photographs to look at; None: all.

    Raises:
        NoReconstructionError: no two photographs are a rotation apart, or most matches contradict that.
    """
    among = np.arange(len(image_set.images)) if among is None else among
    events.started(STAGE, f"rotations of {len(among)} photographs", total=4)
    evidence = _evidence(image_set, features, correspondences, options, seed, among)
    if not evidence.pixels:
        raise NoReconstructionError("no two photographs have verified matches with each other", _ADVICE)
    found = _with_zooms(evidence)
    events.advanced(STAGE)
    if found is not None:
        _tell_zooms(evidence.priors, found, events)
    evidence, start, rough = found or _from_pairs(evidence, {})
    events.advanced(STAGE)
    fine, choices = _chosen(evidence, rough)
    events.advanced(STAGE)
    verdicts = judge_pairs(evidence.pixels, evidence.thresholds, fine.members, image_set.names, fine.fit, seed)
    total = sum(each.num_matches for each in verdicts)
    share = sum(each.num_turned for each in verdicts) / max(total, 1)
    if share < _LEAST_SHARE:
        raise NoReconstructionError(
            f"the camera did not turn on the spot: rotations explain {share:.0%} of {total} verified matches between "
            f"{len(fine.members)} photographs",
            _ADVICE,
        )
    orientation = [image_set.images[i].orientation for i in fine.members]
    turned = TurnedPhotographs(
        fine.members, fine.fit.state.cameras, fine.camera_idx,
        level(fine.fit.state.rotations, orientation), fine.fit.rotation_sigma_deg, fine.groups,
    )  # fmt: skip
    report = report_of(
        image_set, (among, fine.members, *fine.groups), turned, fine.fit, fine.tracks, verdicts,
        (evidence.priors, start), choices,
    )  # fmt: skip
    events.advanced(STAGE)
    events.finished(STAGE, f"{len(turned.image_idx)} of {len(among)} photographs turned on the spot", **report)
    return turned, report


def _evidence(
    image_set: ImageSet, features: Sequence[Features], correspondences: Correspondences, options: MatchingOptions,
    seed: int, among: Ints,
) -> _Evidence:  # fmt: skip
    useful = ~np.isin(correspondences.config, USELESS_CONFIGS) & np.isin(correspondences.pair_image_idx, among).all(1)
    pair_idx = np.flatnonzero(useful & (correspondences.num_inliers >= turns.MIN_MATCHES))
    cameras = [_with_distortion(camera) for camera in image_set.cameras]
    whose = np.array([record.camera_idx for record in image_set.images], np.int64)
    pixels, thresholds = [], []
    for p in pair_idx:
        i, j = (int(k) for k in correspondences.pair_image_idx[p])
        matches = correspondences.matches_of_pair(int(p))
        both = tuple(features[k].keypoints[matches[:, side], :2].astype(np.float64) for side, k in enumerate((i, j)))
        pixels.append(MatchedPixels((i, j), (int(whose[i]), int(whose[j])), (both[0], both[1])))
        thresholds.append(error_threshold_px(cameras[whose[i]], cameras[whose[j]], options))
    return _Evidence(correspondences, features, pair_idx, pixels, thresholds, whose, cameras, seed)


def _with_distortion(camera: Camera) -> Camera:
    """A camera whose model has the coefficients that may be refined, where it is one of the plainest."""
    if camera.is_fixed or camera.model not in (CameraModel.SIMPLE_PINHOLE, CameraModel.SIMPLE_RADIAL):
        return camera
    params = np.zeros(5)
    params[: len(camera.params)] = camera.params
    return replace(camera, model=CameraModel.RADIAL, params=params)


def _from_pairs(evidence: _Evidence, zooms: Mapping[int, Zooms]) -> tuple[_Evidence, list[Camera], _Round]:
    """The evidence with a camera for each zoom, their focal lengths from pairs, and what these come to.

    Args:
        zooms: of those cameras that are split.

    Raises:
        NoReconstructionError: no pair is a rotation.
    """
    whose, priors, start = evidence.image_camera_idx.copy(), list(evidence.priors), []
    split: list[Camera] = []
    for c, camera in enumerate(evidence.priors):
        own, homographies, threshold = _own_pairs(evidence, c)
        if c not in zooms:
            start.append(turns.find_focal(camera, own, homographies, threshold, evidence.seed))
            continue
        # what was known of the focal length is right for one of them at most
        unknown = replace(camera, focal_source="default", focal_sigma=None)
        several = _focals(camera, zooms[c], own, homographies, threshold, evidence.seed)
        numbers = np.array([c, *(len(evidence.priors) + len(split) + k for k in range(len(several) - 1))])
        whose[zooms[c].images] = numbers[zooms[c].group]
        priors[c] = unknown
        start.append(several[0])
        split += several[1:]
        priors += [unknown] * (len(several) - 1)
    pixels = [replace(p, cameras=(int(whose[p.images[0]]), int(whose[p.images[1]]))) for p in evidence.pixels]
    evidence = replace(evidence, pixels=pixels, image_camera_idx=whose, priors=priors)
    start += split
    return evidence, start, _adjusted(evidence, start, _LOOSE)


def _focals(
    camera: Camera, zooms: Zooms, own: Sequence[MatchedPixels], homographies: Sequence[Array], threshold: float,
    seed: int,
) -> list[Camera]:  # fmt: skip
    """A camera for each group of zooms: of the photographs that hang together pixels are drawn to one zoom, and its
    focal length found as that of one camera."""
    out = []
    for part in range(int(zooms.part.max()) + 1):
        mine = zooms.part == part
        inside = [np.isin(pair.images, zooms.images[mine]).all() and np.isfinite(h).all()
                  for pair, h in zip(own, homographies, strict=True)]  # fmt: skip
        alike = [
            unzoomed(own[k], homographies[k], zooms, camera.canonical[2:4]) for k in np.flatnonzero(inside).tolist()
        ]
        base = turns.find_focal(camera, [p for p, _ in alike], [h for _, h in alike], threshold, seed)
        for group in sorted(set(zooms.group[mine].tolist())):
            zoom = math.exp(float(zooms.log_zoom[zooms.group == group].mean()))
            out.append(base.with_focal(base.focal * zoom))
    return out


def _with_zooms(evidence: _Evidence) -> tuple[_Evidence, list[Camera], _Round] | None:
    """Photographs of one size from one folder share a camera, but may be of several zooms: a camera for each of them,
    if that predicts rays that it was not fitted to better than one camera does; None if it does not."""
    zooms = {}
    for c, camera in enumerate(evidence.priors):
        own, homographies, threshold = _own_pairs(evidence, c)
        if not camera.is_fixed and camera.family == BROWN and own:
            found = find_zooms(camera, own, homographies, threshold)
            if found is not None:
                zooms[c] = found
    if not zooms:
        return None
    try:
        several = _from_pairs(evidence, zooms)
    except NoReconstructionError:
        return None
    split, _, rough = several
    halves = _halves(rough.tracks, np.ones(rough.tracks.num_observations))
    state = rough.fit.state
    one = replace(rough, camera_idx=evidence.image_camera_idx[rough.members])
    num = len(evidence.priors)
    for k in range(2):
        free = [refinable(camera, distortion=1) for camera in split.priors]
        apart = _held_out(state, halves, k, rough, free, split.priors)
        shared = _held_out(replace(state, cameras=state.cameras[:num]), halves, k, one, free[:num], evidence.priors)
        if apart >= shared:
            return None
    return several


def _tell_zooms(before: Sequence[Camera], found: tuple[_Evidence, list[Camera], _Round], events: Events) -> None:
    split, start, rough = found
    whose = rough.camera_idx.tolist()
    zooms = [
        f"{start[c].focal:.0f} px ({whose.count(c)} photographs)"
        for c in sorted(set(whose), key=lambda c: start[c].focal)
    ]
    events.decided(
        STAGE,
        f"{len(split.priors) - len(before)} more cameras than sizes and EXIF tell: focal lengths {', '.join(zooms)}",
        focals_px=[start[c].focal for c in sorted(set(whose))],
    )


def _own_pairs(evidence: _Evidence, c: int) -> tuple[list[MatchedPixels], list[Array], float]:
    """Pairs of photographs of one camera, their homographies, and the threshold of their matches, pixels."""
    own = [k for k, pair in enumerate(evidence.pixels) if pair.cameras == (c, c)]
    homographies = [evidence.correspondences.homography[evidence.pair_idx[k]] for k in own]
    return [evidence.pixels[k] for k in own], homographies, evidence.thresholds[own[0]] if own else 1.0


def _adjusted(evidence: _Evidence, cameras: list[Camera], loose: float) -> _Round:
    """From cameras to rotations: pairs that are rotations, the largest group that they join, averaged, adjusted.

    Raises:
        NoReconstructionError: no pair is a rotation.
    """
    thresholds = [loose * each for each in evidence.thresholds]
    found = turns.measure_turns(evidence.pixels, cameras, thresholds, evidence.seed)
    used = np.array([k for k, turn in enumerate(found) if _is_turn(turn)], np.int64)
    if not len(used):
        best = max(found, key=lambda turn: turn.share)
        raise NoReconstructionError(
            f"the camera did not turn on the spot: of the matches of no pair of photographs a rotation explains more "
            f"than {best.share:.0%}",
            _ADVICE,
        )
    counts = np.array([int(found[k].is_inlier.sum()) for k in used])
    rotations = np.array([found[k].rotation for k in used])
    kept = turns.consistent([evidence.pixels[k].images for k in used], rotations, counts)
    used, counts, rotations = used[kept], counts[kept], rotations[kept]
    images = np.array([evidence.pixels[k].images for k in used]).reshape(-1, 2)
    members, *groups = turns.groups_of(len(evidence.image_camera_idx), images)
    position = np.full(len(evidence.image_camera_idx), -1)
    position[members] = np.arange(len(members))
    inside = position[images[:, 0]] >= 0
    used, counts, rotations, images = used[inside], counts[inside], rotations[inside], position[images[inside]]
    turned, agrees = turns.average_rotations(len(members), images, rotations, counts)
    used = used[agrees]
    masks = {int(k): found[k].is_inlier for k in used}
    tracks = _tracks(evidence, members, masks)
    camera_idx = evidence.image_camera_idx[members]
    state = Turned(cameras, turned, rays_of_tracks(cameras, turned, tracks, camera_idx))
    free = [refinable(camera, distortion=1) for camera in cameras]
    fit = adjust_turns(state, tracks, camera_idx, free, evidence.priors)
    return _Round(members, groups, used, tracks, camera_idx, fit)


def _spread(evidence: _Evidence, found: _Round) -> Array:
    """(O,) noise of keypoints, in units of that of the middle one: it grows with their scale.

    The medians of the errors of each eighth of them, from small scales to large, and a line between each two. The ray
    of a track takes part of the noise of each of its keypoints: only tracks whose keypoints are of one scale tell.
    """
    tracks = found.tracks
    scales = np.empty(tracks.num_observations)
    for k, image in enumerate(found.members):
        at = tracks.obs_image_idx == k
        scales[at] = evidence.features[image].keypoints[tracks.obs_feature_idx[at], 2]
    logs = np.log(np.maximum(scales, 1e-6))
    low, high = (np.asarray(f.reduceat(logs, tracks.track_ptr[:-1])) for f in (np.minimum, np.maximum))
    is_alike = (high - low < _SAME_SCALE)[tracks.obs_track_idx]
    order = np.flatnonzero(is_alike)[np.argsort(logs[is_alike], kind="stable")]
    if len(order) < _FEWEST_OF_GROWTH or np.ptp(logs[order]) < _SAME_SCALE:
        return np.ones(len(logs))
    squares = (found.fit.residuals**2).sum(1)
    parts = np.array_split(order, 8)
    x = np.array([logs[part].mean() for part in parts])
    y = np.maximum.accumulate([0.5 * math.log(np.median(squares[part]) + _LEAST_NOISE_PX**2) for part in parts])
    # of the few that are larger than all of these, noise is a share of their scale
    noise = np.interp(logs, x, y) + np.maximum(logs - x[-1], 0.0)
    out: Array = np.exp(noise - np.median(noise))
    return out


def _is_turn(turn: Turn) -> bool:
    return turn.share >= turns.MAJORITY and int(turn.is_inlier.sum()) >= turns.MIN_MATCHES


def _tracks(evidence: _Evidence, members: Ints, masks: dict[int, NDArray[np.bool_]]) -> Tracks:
    """Rays that the matches of some pairs tell, of the members alone."""
    c = evidence.correspondences
    pairs = evidence.pair_idx[list(masks)]
    matches = [c.matches_of_pair(int(p))[mask] for p, mask in zip(pairs, masks.values(), strict=True)]
    rest = {
        field.name: getattr(c, field.name)[pairs] for field in fields(c) if field.name not in ("pair_ptr", "matches")
    }
    rest["pair_image_idx"] = np.searchsorted(members, rest["pair_image_idx"]).astype(np.int32)
    pair_ptr = np.cumsum([0, *(len(each) for each in matches)])
    chosen = replace(c, pair_ptr=pair_ptr, matches=np.concatenate(matches), **rest)
    return build_tracks(chosen, [evidence.features[i] for i in members])[0]


def _chosen(evidence: _Evidence, rough: _Round) -> tuple[_Round, list[LensChoice]]:
    """The final adjustment, with as many coefficients of distortion as predict rays that they were not fitted to."""
    fine = _adjusted(evidence, rough.fit.state.cameras, 1.0)
    spread = _spread(evidence, fine)
    halves = _halves(fine.tracks, spread)
    choices, fits = [], []
    for distortion in range(_MOST_DISTORTION + 1):
        free = [refinable(camera, distortion=distortion) for camera in evidence.priors]
        if distortion and all(len(names) <= distortion for names in free):
            break
        state = replace(fine.fit.state, cameras=[_without(camera, distortion) for camera in fine.fit.state.cameras])
        held_out = [_held_out(state, halves, k, fine, free, evidence.priors) for k in range(2)]
        choices.append(LensChoice(num_distortion=distortion, held_out_px=held_out))
        fits.append((state, free))
    best = 0
    for k in range(1, len(choices)):
        if all(new < old for new, old in zip(choices[k].held_out_px, choices[best].held_out_px, strict=True)):
            best = k
    state, free = fits[best]
    fit = adjust_turns(state, fine.tracks, fine.camera_idx, free, evidence.priors, spread)
    return replace(fine, fit=fit), choices


def _without(camera: Camera, distortion: int) -> Camera:
    """The camera without those coefficients that are not refined, where its prior had none."""
    if camera.model != CameraModel.RADIAL or camera.is_fixed:
        return camera
    return camera.with_params([*camera.params[: 3 + distortion], *[0.0] * (_MOST_DISTORTION - distortion)])


def _halves(tracks: Tracks, spread: Array) -> list[tuple[Tracks, Array]]:
    """Two that have no track in common, and the spread of their keypoints."""
    step = 2 * max(1, tracks.num_tracks // (2 * _TRACKS_OF_HALF))
    return [_every(step, tracks, spread, k) for k in range(2)]


def _every(step: int, tracks: Tracks, spread: Array, first: int) -> tuple[Tracks, Array]:
    """Every so many of the tracks, and the spread of their keypoints."""
    kept = tracks.obs_track_idx % step == first
    return make_tracks(
        tracks.num_images, -(-(tracks.num_tracks - first) // step), tracks.obs_track_idx[kept] // step,
        tracks.obs_image_idx[kept], tracks.obs_feature_idx[kept], tracks.obs_xy[kept],
    ), spread[kept]  # fmt: skip


def _held_out(
    state: Turned, halves: Sequence[tuple[Tracks, Array]], k: int, fine: _Round, free: Sequence[tuple[str, ...]],
    priors: Sequence[Camera],
) -> float:  # fmt: skip
    """Root of the mean robust square of one half, of cameras that were fitted to the other; the size of a picture where
    the lens has no inverse at some of the keypoints, and predicts nothing."""
    (mine, of_mine), (other, of_other) = halves[k], halves[1 - k]
    start = replace(state, rays=rays_of_tracks(state.cameras, state.rotations, mine, fine.camera_idx))
    nothing = float(max(max(camera.width, camera.height) for camera in state.cameras))
    if not np.isfinite(start.rays).all():
        return nothing
    fit = adjust_turns(start, mine, fine.camera_idx, free, priors, of_mine)
    cameras, turned = fit.state.cameras, fit.state.rotations
    held = Turned(cameras, turned, rays_of_tracks(cameras, turned, other, fine.camera_idx))
    squares = (residuals_px(held, other, fine.camera_idx) ** 2).sum(1) / of_other**2
    scale2 = 9.0 * fine.fit.noise_px**2
    rms = math.sqrt(scale2 * float(np.log1p(squares / scale2).mean()))
    return rms if math.isfinite(rms) else nothing


def residuals_px(state: Turned, tracks: Tracks, camera_idx: Ints) -> Array:
    """(O, 2) pixels less those predicted."""
    seen = np.einsum("nij,nj->ni", state.rotations[tracks.obs_image_idx], state.rays[tracks.obs_track_idx])
    out = np.empty((tracks.num_observations, 2))
    whose = camera_idx[tracks.obs_image_idx]
    for c, camera in enumerate(state.cameras):
        at = whose == c
        out[at] = tracks.obs_xy[at] - project(camera, seen[at])
    return out
