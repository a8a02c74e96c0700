"""What is said of rotations: of every pair, photograph and camera, and of the photographs that were left out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.contradictions import Contradiction
from sfmapp.geometry import rigid3
from sfmapp.panorama.adjustment import TurnedFit
from sfmapp.panorama.pairs import MAJORITY, MIN_MATCHES, TURNED_SHARE, MatchedPixels, fit_turn
from sfmapp.panorama.report import LensChoice, TurnedCamera, TurnedImage, TurnedPair, TurningReport
from sfmapp.reporting import NamedReason
from sfmapp.scene.tracks import Tracks

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.panorama.turned_photographs import TurnedPhotographs

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# The photographs tell a focal length when they do so to a twentieth, which EXIF, rounded to millimetres, does as well.
_TOLD = 0.05
# The median of the distance of two points that have the noise of one coordinate each: 2 sqrt(ln 2) of it.
_MEDIAN_OF_NOISE = 2.0 * math.sqrt(math.log(2.0))
# A pair whose median is below twice what noise makes of it says nothing of parallax.
_TWICE = 2.0
# Matches nearer to each other than this angle are no neighbours: they share pixels, and with these their noise.
_APART = 0.02
# directions, of a half sphere, in which a pair may have moved: a tenth of a right angle from one to the next
_NUM_DIRECTIONS = 200
# The median of the length of two coordinates of noise, in units of that of one: sqrt(2 ln 2) / 0.6745; and a half more,
# for blur by motion makes noise up to twice as great along it (of rendered frames that eleven pixels passed).
_MEDIAN_OF_ONE = 1.5 * math.sqrt(2.0 * math.log(2.0)) / 0.6745
# A rotation that contradicts the panorama is red if it rests on so many matches, of those of its photographs' best pair
_STRONG_SHARE = 0.5


def judge_pairs(
    pixels: Sequence[MatchedPixels], thresholds: Sequence[float], members: Ints, names: Sequence[str], fit: TurnedFit,
    seed: int,
) -> list[TurnedPair]:  # fmt: skip
    """Hold all verified matches of pairs of members, used or not, to the rotations. ``names``: of all photographs."""
    position = {int(image): k for k, image in enumerate(members)}
    cameras, rotations = fit.state.cameras, fit.state.rotations
    expected = _MEDIAN_OF_NOISE * fit.noise_px
    out = []
    for pair, threshold in zip(pixels, thresholds, strict=True):
        if not all(image in position for image in pair.images):
            continue
        i, j = (position[image] for image in pair.images)
        turn = rotations[j] @ rotations[i].T
        both = [cameras[c] for c in pair.cameras]
        a, b = (pixels_to_rays(camera, xy) for camera, xy in zip(both, pair.xy, strict=True))
        focal = 0.5 * (both[0].focal + both[1].focal)
        there = a @ turn.T
        errors = focal * np.linalg.norm(there - b, axis=1)
        # where a lens has no inverse, as far as anything can be apart
        errors = np.where(np.isfinite(errors), errors, 2.0 * focal)
        share, median = float((errors < threshold).mean()), float(np.median(errors))
        verdict = "rotation" if share >= TURNED_SHARE else "parallax" if share >= MAJORITY else "no rotation"
        if verdict == "no rotation" and fit_turn(a, b, focal, threshold, (seed, *pair.images)).share >= TURNED_SHARE:
            verdict = "contradicted"
        noise = expected
        if median > _TWICE * expected:
            noise = max(noise, focal * _noise_of_pair(there, b))
        parallax = math.sqrt(median**2 - noise**2) if median > _TWICE * noise else 0.0
        out.append(TurnedPair(
            images=(names[pair.images[0]], names[pair.images[1]]), num_matches=len(errors),
            num_turned=int((errors < threshold).sum()), threshold_px=threshold,
            turn_deg=float(rigid3.rotation_angle_deg(turn)), median_px=median, parallax_px=parallax, verdict=verdict,
        ))  # fmt: skip
    return out


def _noise_of_pair(there: Array, seen: Array) -> float:
    """What noise makes of the median distance of matched unit rays (N, 3), radians, the pair's own: a blurred
    photograph has several times that of the others.

    Parallax is common to neighbours that are equally far, or lies along the lines to where the camera moved, whatever
    is how far; noise is neither. The lesser of what neighbours differ by and of what lies across such lines counts, so
    that leaves before a sky do not pass for noise; where the camera moved to is found on one half of the matches, and
    what lies across taken from the other.
    """
    known = np.isfinite(there[:, 0]) & np.isfinite(seen[:, 0])
    there, errors = there[known], (seen - there)[known]
    if len(errors) < MIN_MATCHES:
        return math.inf
    near = there @ there.T
    near[near > math.cos(_APART)] = -2.0
    beside = near.argmax(1)
    of_neighbors = float(np.median(np.linalg.norm(errors - errors[beside], axis=1))) / math.sqrt(2.0)
    # of directions by Fibonacci's spiral
    k = np.arange(_NUM_DIRECTIONS)
    z, angle = (k + 0.5) / _NUM_DIRECTIONS, k * math.pi * (3.0 - math.sqrt(5.0))
    toward = np.stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z], 1)
    normals = np.cross(toward[:, None], there[None])
    length = np.maximum(np.linalg.norm(normals, axis=2), 1e-9)
    lengths = np.abs(np.einsum("kni,ni->kn", normals, errors)) / length
    across = [np.median(lengths[:, half::2], axis=1) for half in range(2)]
    held_out = max(float(across[1 - half][across[half].argmin()]) for half in range(2))
    return min(of_neighbors, _MEDIAN_OF_ONE * held_out)


def report_of(
    image_set: ImageSet, groups: Sequence[Ints], turned: TurnedPhotographs, fit: TurnedFit, tracks: Tracks,
    verdicts: Sequence[TurnedPair], before: tuple[Sequence[Camera], Sequence[Camera]],
    choices: Sequence[LensChoice],
) -> TurningReport:  # fmt: skip
    """The report of the stage.

    Args:
        groups: photographs that were looked at, those of the panorama, and those of each other group.
        turned: those of the panorama.
        before: cameras as they were known, and as pairs alone had them.
    """
    among, members, *others = groups
    total = sum(each.num_matches for each in verdicts)
    num_explained = sum(each.num_turned for each in verdicts)
    return TurningReport(
        num_images=len(among),
        num_turned=len(members),
        noise_px=fit.noise_px,
        correlation=fit.correlation,
        num_rays=tracks.num_tracks,
        num_observations=tracks.num_observations,
        turned_share=num_explained / max(total, 1),
        cameras=_cameras(turned.camera_idx, fit, before),
        images=_images(image_set, turned, fit, tracks),
        pairs=verdicts,
        lens_choice=choices,
        left_out=_left_out(image_set, among, members, others),
        contradictions=_contradictions(verdicts),
        thresholds={"turned_share": TURNED_SHARE, "majority": MAJORITY, "min_matches": MIN_MATCHES},
    )  # fmt: skip


def _cameras(camera_idx: Ints, fit: TurnedFit, before: tuple[Sequence[Camera], Sequence[Camera]]) -> list[TurnedCamera]:
    whose = camera_idx.tolist()
    out = []
    for c in sorted(set(whose)):
        camera, sigma = fit.state.cameras[c], fit.sigmas(c)
        relative = sigma.get("log_focal")
        out.append(TurnedCamera(
            camera_idx=c, num_images=whose.count(c), model=camera.model.name, width=camera.width, height=camera.height,
            prior_focal_px=before[0][c].focal, prior_source=before[0][c].focal_source,
            start_focal_px=before[1][c].focal, focal_px=camera.focal,
            focal_sigma_px=None if relative is None else relative * camera.focal,
            params=camera.params.tolist(), refined=list(sigma), sigma=sigma,
            is_told=relative is None or relative < _TOLD,
        ))  # fmt: skip
    return out


def _images(image_set: ImageSet, turned: TurnedPhotographs, fit: TurnedFit, tracks: Tracks) -> list[TurnedImage]:
    members, rotations = turned.image_idx, turned.rotations
    squares = (fit.residuals**2).sum(1)
    counts = np.bincount(tracks.obs_image_idx, minlength=len(members))
    sums = np.bincount(tracks.obs_image_idx, squares, len(members))
    return [
        TurnedImage(
            name=image_set.images[i].name, camera_idx=int(turned.camera_idx[k]),
            rotation=rigid3.quaternion(rotations[k]).tolist(), sigma_deg=fit.rotation_sigma_deg[k].tolist(),
            num_rays=int(counts[k]), rms_px=math.sqrt(sums[k] / counts[k]) if counts[k] else None,
        )
        for k, i in enumerate(members)
    ]  # fmt: skip


def _left_out(image_set: ImageSet, among: Ints, members: Ints, others: Sequence[Ints]) -> list[NamedReason]:
    inside = set(members.tolist())
    of_group = {int(i): group for group in others for i in group}
    out = []
    for i in among.tolist():
        if i in inside:
            continue
        reason = "no photograph of the panorama is a rotation away from it: too few matches, or taken from elsewhere"
        if i in of_group:
            group = of_group[i]
            first = image_set.images[int(group[0])].name
            reason = (
                f"belongs to another panorama, of {len(group)} photographs that overlap none of these (the first is "
                f"{first})"
            )
        out.append(NamedReason(name=image_set.images[i].name, reason=reason))
    return out


def _contradictions(verdicts: Sequence[TurnedPair]) -> list[Contradiction]:
    """Pairs that are rotations for themselves, others than the panorama has, on many matches."""
    strongest: dict[str, int] = {}
    for each in verdicts:
        for image in each.images:
            strongest[image] = max(strongest.get(image, 0), each.num_turned)
    return [
        Contradiction(
            "panorama",
            f"{each.num_matches} matches of {each.images[0]} and {each.images[1]} show a rotation that "
            f"is not the panorama's: its median error there is {each.median_px:.1f} px",
            "look at the two: if they show different places that look alike, leave one out",
            {"num_matches": each.num_matches, "median_px": each.median_px},
        )
        for each in verdicts
        if each.verdict == "contradicted"
        and each.num_matches > _STRONG_SHARE * min(strongest[image] for image in each.images)
    ]
