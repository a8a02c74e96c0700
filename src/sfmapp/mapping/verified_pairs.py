"""Verified pairs held against a model: which of them does it agree with, and which contradict it?

Every pair with verified matches says how its two images lie to each other. A model that was grown from some of them
may put the images elsewhere: then it contradicts evidence in hand, as a model does that takes two sides of a thing
that look alike for one. Not every such pair is right, however: repeated structure gives pairs that are verified and
false. What tells is the strength of the evidence, here the share of the picture in which a pair matches what can be
matched: a pair stands against the model if what holds its two images in their places is not clearly stronger.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.lens import undistort, unproject
from sfmapp.contradictions import Contradiction
from sfmapp.geometry import rigid3
from sfmapp.mapping import near_views, pair_motions
from sfmapp.mapping.report import NUM_NAMED, NamedPair, named_pairs
from sfmapp.mapping.tracks import USELESS_CONFIGS
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import Tracks

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Matches are verified within 0.2 % of the diagonal, 2 to 8 px. Twice as much is gross, whatever the lens and the noise,
# and still a band so narrow that matches of another place fall into it by chance once in fifty.
TOLERANCE_SHARE, TOLERANCE_PX = 0.004, (4.0, 16.0)
# A pair agrees with a model if more than half of its matches do, and contradicts it if no more than a third do: of a
# right pair nearly all agree, of one that belongs elsewhere those that lie near its epipolar lines by chance.
AGREES, CONTRADICTS = 0.5, 1 / 3
# Fewer verified matches prove no geometry on their own: twice what verification asks for.
MIN_MATCHES = 30
# One such pair makes a model red: three times what verification asks for. Of 50 views of a small model with much
# repetition one false pair was verified with twice as many.
MIN_MATCHES_AGAINST = 45
# A cell is covered by a pair that matches half as much of what is in it as it does where it has its matches.
HALF_AS_WELL = 0.5
# Few matches that are scattered over a picture do not cover it: a pair should match a fifth of what is where it has
# its matches, which pairs of 40 degrees apart still do.
GOOD_SHARE = 0.2
# Side of the grid on which strength is measured: fine enough to tell a thing from what is around it.
CELLS = 8
# Evidence must be stronger by so much to overrule what contradicts it. Near neighbours cover 0.75 to 0.95 of a picture,
# look-alike things what they fill of it. Where they fill the picture, or nothing else is in it, neither is stronger.
CLEARLY = 4 / 3
# Verified matches between two models that need an explanation.
MIN_MATCHES_BETWEEN = 100
# Strength from which on a pair matches in most of the picture.
MOST = 0.5


@dataclass(frozen=True)
class PairAgreement:
    """What a model says to the verified pairs whose two images it holds, in the order of the correspondences.

    Attributes:
        pair_idx: (K,) int64 positions of the pairs in the correspondences.
        image_idx: (K, 2) int64 their images.
        num_matches: (K,) int64 verified matches (of keypoints that are in a track).
        num_agreeing: (K,) int64 of them that the model's relative pose and cameras can explain: the rays meet in
            front of both, or are parallel, within the tolerance.
        num_shared: (K,) int64 of them whose keypoints support one point of the model.
    """

    pair_idx: Ints
    image_idx: Ints
    num_matches: Ints
    num_agreeing: Ints
    num_shared: Ints

    @property
    def agrees(self) -> Bools:
        """(K,) bool: more than half of the matches agree."""
        return self.num_agreeing > AGREES * self.num_matches

    @property
    def disagrees(self) -> Bools:
        """(K,) bool: next to none of the matches agree or share a point."""
        limit = CONTRADICTS * self.num_matches
        return (self.num_agreeing <= limit) & (self.num_shared <= limit)

    @property
    def contradicts(self) -> Bools:
        """(K,) bool: the pair disagrees, and has matches enough to say so."""
        return (self.num_matches >= MIN_MATCHES) & self.disagrees


def pair_agreement(reconstruction: Reconstruction, correspondences: Correspondences) -> PairAgreement:
    """Hold the verified pairs of registered images against a model.

    Args:
        reconstruction: the model; its tracks are those of the correspondences.
        correspondences: verified matches. Pairs that say nothing of the scene (watermarks) are left out.
    """
    images = correspondences.pair_image_idx.astype(np.int64)
    registered = reconstruction.is_registered
    pair_idx = np.flatnonzero(_is_useful(correspondences) & registered[images].all(axis=1))
    counts = np.zeros((len(pair_idx), 3), np.int64)
    image_idx = images[pair_idx]
    if len(pair_idx):
        canonical = reconstruction.canonical_cameras()
        camera_of = reconstruction.image_camera_idx
        poses = reconstruction.cam_from_world
        relative = rigid3.compose(poses[image_idx[:, 1]], rigid3.inverse(poses[image_idx[:, 0]]))
        focal = canonical[:, :2].mean(axis=1)[camera_of[image_idx]].mean(axis=1)
        diagonal = np.array([math.hypot(c.width, c.height) for c in reconstruction.cameras])[camera_of[image_idx]]
        tolerance_px = np.clip(TOLERANCE_SHARE * diagonal.max(axis=1), *TOLERANCE_PX)
        tracks = reconstruction.tracks
        rays = np.empty((tracks.num_observations, 3))
        is_wide = np.array([camera.is_wide for camera in reconstruction.cameras], bool)
        _rays_of_observations(
            tracks.obs_xy, camera_of[tracks.obs_image_idx], canonical, is_wide, registered[tracks.obs_image_idx], rays
        )
        _count_matches(
            pair_idx, image_idx, _matches_of(tracks, correspondences), rays, tracks.obs_track_idx,
            reconstruction.obs_is_inlier, rigid3.rotation_matrix(relative), np.ascontiguousarray(relative[:, 4:]),
            tolerance_px / focal, counts,
        )  # fmt: skip
    return PairAgreement(pair_idx, image_idx, *np.ascontiguousarray(counts.T))


def pair_strengths(reconstruction: Reconstruction, correspondences: Correspondences) -> Array:
    """(P,) share of the picture that a pair matches, between 0 and 1: the strength of its evidence.

    Each image is divided into cells. Of the keypoints in a cell that any pair matches, a pair matches some share; the
    cell is covered if that is at least half of the share where this pair has its matches, and in part if it is less.
    The share of covered cells, in the image where it is less, is the strength. Near neighbours match in all of the
    picture, if less the farther they are apart; pictures of two things that look alike match on the thing only,
    however well. Only the tracks and cameras of ``reconstruction`` are used, no pose.
    """
    tracks = reconstruction.tracks
    sizes = np.array([(c.width, c.height) for c in reconstruction.cameras], np.float64)
    size = sizes[reconstruction.image_camera_idx[tracks.obs_image_idx]]
    column_row = np.clip((CELLS * tracks.obs_xy / size).astype(np.int64), 0, CELLS - 1)
    cell = tracks.obs_image_idx.astype(np.int64) * CELLS**2 + column_row[:, 1] * CELLS + column_row[:, 0]
    matchable = np.bincount(cell, minlength=tracks.num_images * CELLS**2).reshape(-1, CELLS**2)
    out = np.zeros(correspondences.num_pairs)
    _measure_strengths(
        np.flatnonzero(_is_useful(correspondences)), correspondences.pair_image_idx.astype(np.int64),
        _matches_of(tracks, correspondences), cell % CELLS**2, matchable, out,
    )  # fmt: skip
    return out


@dataclass(frozen=True)
class Standing:
    """Pairs that stand against a model: all that contradict it, and those that what it rests on does not overrule.

    Attributes:
        agreement: of all verified pairs with the model.
        strength: (K,) of these pairs; zeros if none contradicts the model.
        overruled_by: (K,) how strong the weakest link is of the strongest chain of agreeing pairs between the two
            images; 0 where there is none.
        stands: (K,) bool: contradicts the model, with matches enough, and is not clearly weaker than that chain.
        doubt: how strong what contradicts the model is, at most, against what it rests on there: 0 if nothing does,
            1 if it is as strong, infinite if the two images hang together by nothing else.
    """

    agreement: PairAgreement
    strength: Array
    overruled_by: Array
    stands: Bools
    doubt: float


def standing_pairs(reconstruction: Reconstruction, correspondences: Correspondences) -> Standing:
    """Which verified pairs contradict a model, and which of them with evidence as strong as what it rests on."""
    agreement = pair_agreement(reconstruction, correspondences)
    agrees, contradicts = agreement.agrees, agreement.contradicts & (agreement.num_matches >= MIN_MATCHES_AGAINST)
    strength, overruled_by = np.zeros(len(agrees)), np.zeros(len(agrees))
    if contradicts.any():
        strength = pair_strengths(reconstruction, correspondences)[agreement.pair_idx]
        chains = Chains.of(len(reconstruction.image_names), agreement.image_idx[agrees], strength[agrees])
        for k in np.flatnonzero(contradicts):
            link = chains.weakest_link(*agreement.image_idx[k])
            overruled_by[k] = chains.strength[link] if link >= 0 else 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(contradicts & (strength > 0), strength / overruled_by, 0.0)
    return Standing(agreement, strength, overruled_by, ratio > 1 / CLEARLY, float(ratio.max(initial=0.0)))


@dataclass(frozen=True)
class Chains:
    """The strongest chains of pairs between images: what joins them when pairs are taken from the strongest down.

    A tree over the images in which each hangs on another by the pair that joined the group of the one to that of the
    other. As the smaller group is hung on the larger one, it is as deep as the logarithm of their number.

    Attributes:
        parent: (I,) int64 the image that this one hangs on; itself at a root.
        joined_as: (I,) int64 when: 0 for the strongest pair; I at a root.
        strength: (I,) of the pair that joined them; 0 at a root.
    """

    parent: Ints
    joined_as: Ints
    strength: Array

    @staticmethod
    def of(num_images: int, image_idx: Ints, strength: Array) -> Chains:
        """Chains between I images over pairs of them (E, 2) with strengths (E,)."""
        chains = Chains(np.arange(num_images), np.full(num_images, num_images), np.zeros(num_images))
        order = np.argsort(-strength, kind="stable")
        _hang(image_idx[order], strength[order], chains.parent, chains.joined_as, chains.strength)
        return chains

    def weakest_link(self, first: int, second: int) -> int:
        """The image that hangs on its parent by the weakest link between two images, -1 where no chain joins them."""
        return int(_weakest_link(first, second, self.parent, self.joined_as))

    def group_before(self, image_idx: int, when: int) -> Bools:
        """(I,) bool: what pairs stronger than the one that joined as number ``when`` join with an image."""
        roots = _roots_before(when, self.parent, self.joined_as)
        return np.asarray(roots == roots[image_idx])


def contradictions_of(models: Sequence[Reconstruction], correspondences: Correspondences) -> list[list[Contradiction]]:
    """For each model the pairs that stand against it: pairs inside it, pairs that lead out of it, pairs that should
    have matches and have none, and pairs with relative poses of their own.

    Args:
        models: over the same tracks, the largest first.
        correspondences: all verified matches, those that the models were not built from as well.
    """
    found: list[list[Contradiction]] = []
    for n, model in enumerate(models):
        of_model = _inside(model, correspondences)
        for m, other in enumerate(models):
            if m > n:
                of_model += _between(model, other, correspondences, m)
        of_model += _left_out(model, models, correspondences) + near_views.contradiction_of(model, correspondences)
        found.append(of_model + pair_motions.contradiction_of(model, correspondences))
    return found


def _inside(model: Reconstruction, correspondences: Correspondences) -> list[Contradiction]:
    standing = standing_pairs(model, correspondences)
    pairs = np.flatnonzero(standing.stands)
    if len(pairs) == 0:
        return []
    agreement = standing.agreement
    matches, shared = agreement.num_matches[pairs], agreement.num_shared[pairs]
    order = np.argsort(-matches, kind="stable")[:NUM_NAMED]
    named = [
        NamedPair(
            images=[model.image_names[i] for i in agreement.image_idx[pairs[k]]],
            num_matches=int(matches[k]), num_agreeing=int(agreement.num_agreeing[pairs[k]]),
            num_shared_points=int(shared[k]),
        )
        for k in order
    ]  # fmt: skip
    total = int(agreement.num_matches.sum())
    strongest = named[0]
    message = (
        f"{_count(len(pairs), 'pair')} with {matches.sum()} verified matches contradict the poses in the model: "
        f"{strongest.images[0]} and {strongest.images[1]} have {strongest.num_matches}, of which "
        f"{strongest.num_agreeing} agree and {strongest.num_shared_points} are points of the model"
    )
    return [
        Contradiction(
            "verified pairs", message,
            "parts that look alike were confused, or photographs are in the wrong place: add photographs between them "
            "that show more of the surroundings",
            {
                "num_pairs": len(pairs), "num_matches": int(matches.sum()), "num_matches_of_all": total,
                "num_pairs_overruled": int((agreement.contradicts & ~standing.stands).sum()), "pairs": named,
            },
            rotation_sigma_deg=_turn_deg(model, correspondences, agreement, pairs),
            # an image that is in a wrong place may be anywhere in the model
            position_sigma_share=1.0,
        )
    ]  # fmt: skip


def _turn_deg(
    model: Reconstruction, correspondences: Correspondences, agreement: PairAgreement, pairs: NDArray[np.int64]
) -> float:
    """Root mean square angle between the relative rotations of some pairs and those of the model, by their matches."""
    own = correspondences.cam2_from_cam1[agreement.pair_idx[pairs]]
    poses = model.cam_from_world[agreement.image_idx[pairs]]
    in_model = rigid3.compose(poses[:, 1], rigid3.inverse(poses[:, 0]))
    angle = rigid3.rotation_angle_deg(rigid3.rotation_matrix(rigid3.compose(own, rigid3.inverse(in_model))))
    is_known = np.isfinite(angle)
    if not is_known.any():
        return 180.0
    return float(np.sqrt(np.average(angle[is_known] ** 2, weights=agreement.num_matches[pairs][is_known])))


def _between(
    model: Reconstruction, other: Reconstruction, correspondences: Correspondences, other_idx: int
) -> list[Contradiction]:
    """Pairs of many matches whose one image only this model holds and whose other image only another one does."""
    images = correspondences.pair_image_idx
    only, only_other = model.is_registered & ~other.is_registered, other.is_registered & ~model.is_registered
    linked = (only[images] & only_other[images][:, ::-1]).any(axis=1) & _is_useful(correspondences)
    pairs = np.flatnonzero(linked & (correspondences.num_inliers >= MIN_MATCHES_BETWEEN))
    if len(pairs) == 0:
        return []
    matches = correspondences.num_inliers[pairs]
    named = named_pairs(model.image_names, images[pairs], matches)
    strongest = named[0]
    message = (
        f"{_count(len(pairs), 'pair')} with {matches.sum()} verified matches link it to model {other_idx}, but the two "
        f"could not be joined: {strongest.images[0]} and {strongest.images[1]} have "
        f"{strongest.num_matches}"
    )
    return [
        Contradiction(
            "pairs between models",
            message,
            "add photographs between the two groups that overlap with both",
            {"other_model": other_idx, "num_pairs": len(pairs), "num_matches": int(matches.sum()), "pairs": named},
        )
    ]


def _left_out(
    model: Reconstruction, models: Sequence[Reconstruction], correspondences: Correspondences
) -> list[Contradiction]:
    """Images that no model holds although they match an image of this one in most of the picture.

    The seam of a fold looks like this when the images that it tears apart have been taken back.
    """
    images = correspondences.pair_image_idx
    nowhere = ~np.any([m.is_registered for m in models], axis=0)
    linked = (model.is_registered[images] & nowhere[images][:, ::-1]).any(axis=1) & _is_useful(correspondences)
    pairs = np.flatnonzero(linked & (correspondences.num_inliers >= MIN_MATCHES_BETWEEN))
    if len(pairs):
        pairs = pairs[pair_strengths(model, correspondences)[pairs] >= MOST]
    if len(pairs) == 0:
        return []
    matches = correspondences.num_inliers[pairs]
    left_out = np.unique(images[pairs][nowhere[images[pairs]]])
    named = named_pairs(model.image_names, images[pairs], matches)
    message = (
        f"{_count(len(left_out), 'photograph')} that no model holds match photographs of the model in most of the "
        f"picture: {named[0].images[0]} and {named[0].images[1]} have {named[0].num_matches} verified matches"
    )
    return [
        Contradiction(
            "photographs left out", message,
            "parts that look alike may have been confused: add photographs that show more of the surroundings",
            {"num_images": len(left_out), "num_pairs": len(pairs), "num_matches": int(matches.sum()), "pairs": named},
            # what was taken back may have been right, and the model wrong
            rotation_sigma_deg=180.0, position_sigma_share=1.0,
        )
    ]  # fmt: skip


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _is_useful(correspondences: Correspondences) -> Bools:
    """(P,) bool: verified pairs that say something of the scene."""
    return (correspondences.num_inliers > 0) & ~np.isin(correspondences.config, USELESS_CONFIGS)


class _Matches(NamedTuple):
    """Verified matches (M) of pairs (P), those of pair p at ``pair_ptr[p] : pair_ptr[p + 1]``, and their observations.

    Attributes:
        pair_ptr: (P + 1,) int64. matches: (M, 2) int32 positions among the keypoints of either image.
        first: (I + 1,) where the keypoints of each image begin in ``obs_of_feature``.
        obs_of_feature: for every keypoint its observation or -1.
    """

    pair_ptr: Ints
    matches: NDArray[np.int32]
    first: Ints
    obs_of_feature: Ints


def _matches_of(tracks: Tracks, correspondences: Correspondences) -> _Matches:
    sizes = np.zeros(tracks.num_images, np.int64)
    _num_features(tracks.obs_image_idx, tracks.obs_feature_idx, sizes)
    for side in range(2):
        per_match = np.repeat(correspondences.pair_image_idx[:, side], correspondences.num_inliers)
        _num_features(per_match, np.ascontiguousarray(correspondences.matches[:, side]), sizes)
    first = np.concatenate([[0], np.cumsum(sizes)])
    obs_of_feature = np.full(first[-1], -1, np.int64)
    obs_of_feature[first[tracks.obs_image_idx] + tracks.obs_feature_idx] = np.arange(tracks.num_observations)
    return _Matches(correspondences.pair_ptr, correspondences.matches, first, obs_of_feature)


@numba.njit(cache=True, nogil=True)
def _num_features(image_idx: NDArray[np.int32], feature_idx: NDArray[np.int32], sizes: Ints) -> None:
    """Raise sizes (I,) to one more than the largest position of a keypoint in each image."""
    for k in range(len(image_idx)):
        sizes[image_idx[k]] = max(sizes[image_idx[k]], feature_idx[k] + 1)


@numba.njit(cache=True, nogil=True)
def _hang(image_idx: Ints, strength: Array, parent: Ints, joined_as: Ints, link: Array) -> None:
    size = np.ones(len(parent), np.int64)
    count = 0
    for e in range(len(image_idx)):
        a, b = image_idx[e, 0], image_idx[e, 1]
        while parent[a] != a:
            a = parent[a]
        while parent[b] != b:
            b = parent[b]
        if a == b:
            continue
        if size[a] > size[b]:
            a, b = b, a
        parent[a], joined_as[a], link[a] = b, count, strength[e]
        size[b] += size[a]
        count += 1


@numba.njit(cache=True, nogil=True)
def _weakest_link(a: int, b: int, parent: Ints, joined_as: Ints) -> int:
    last = -1
    while a != b:
        if joined_as[a] > joined_as[b]:
            a, b = b, a  # links get weaker on the way up: the one that was joined earlier goes first
        if parent[a] == a:
            return -1
        last, a = a, parent[a]
    return last


@numba.njit(cache=True, nogil=True)
def _roots_before(when: int, parent: Ints, joined_as: Ints) -> Ints:
    """(I,) the image at which each ends on its way up the links that came before number ``when``."""
    roots = np.empty(len(parent), np.int64)
    for i in range(len(parent)):
        root = i
        while joined_as[root] < when:
            root = parent[root]
        roots[i] = root
    return roots


@numba.njit(cache=True, nogil=True)
def _rays_of_observations(
    xy: Array, camera_idx: NDArray[np.int32], canonical: Array, is_wide: Bools, wanted: Bools, out: Array
) -> None:
    """Fill out (O, 3) with rays, of unit length for wide cameras, else to z = 1; NaN where they are not wanted."""
    for o in range(len(xy)):
        out[o, 0] = out[o, 1] = out[o, 2] = math.nan
        if not wanted[o]:
            continue
        k = camera_idx[o]
        if is_wide[k]:
            out[o, 0], out[o, 1], out[o, 2] = unproject(canonical[k], xy[o, 0], xy[o, 1])
        else:
            out[o, 0], out[o, 1] = undistort(canonical[k], xy[o, 0], xy[o, 1])
            out[o, 2] = 1.0


@numba.njit(cache=True, nogil=True)
def _count_matches(
    pair_idx: Ints,
    image_idx: Ints,
    found: _Matches,
    rays: Array,
    obs_track_idx: NDArray[np.int32],
    obs_is_inlier: Bools,
    rotation: Array,
    translation: Array,
    tolerance: Array,
    counts: Ints,
) -> None:
    """Fill counts (K, 3): matches, those that agree with relative poses, those that support one point."""
    pair_ptr, matches, first, obs_of_feature = found
    for n in range(len(pair_idx)):
        r, t = rotation[n], translation[n]
        for m in range(pair_ptr[pair_idx[n]], pair_ptr[pair_idx[n] + 1]):
            a = obs_of_feature[first[image_idx[n, 0]] + matches[m, 0]]
            b = obs_of_feature[first[image_idx[n, 1]] + matches[m, 1]]
            if a < 0 or b < 0:
                continue
            counts[n, 0] += 1
            if _rays_meet(r, t, rays[a], rays[b], tolerance[n]):
                counts[n, 1] += 1
            if obs_track_idx[a] == obs_track_idx[b] and obs_is_inlier[a] and obs_is_inlier[b]:
                counts[n, 2] += 1


@numba.njit(cache=True, nogil=True)
def _rays_meet(r: Array, t: Array, ray1: Array, ray2: Array, tolerance: float) -> bool:
    """Whether the rays (3,) of camera 1 and camera 2 meet in front of both, or are parallel.

    r and t are camera 2 from camera 1; the tolerance is an angle in radians. NaN meets nothing.
    """
    x, y, z = ray1[0], ray1[1], ray1[2]
    u, v, w = ray2[0], ray2[1], ray2[2]
    a0 = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
    a1 = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
    a2 = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
    aa, bb = a0 * a0 + a1 * a1 + a2 * a2, u * u + v * v + w * w
    ab = a0 * u + a1 * v + a2 * w
    c0, c1, c2 = a1 * w - a2 * v, a2 * u - a0 * w, a0 * v - a1 * u
    cross = c0 * c0 + c1 * c1 + c2 * c2
    if ab > 0.0 and cross <= tolerance * tolerance * aa * bb:
        return True
    # the angles of both rays to the plane of the other one and the baseline
    e0, e1, e2 = t[1] * a2 - t[2] * a1, t[2] * a0 - t[0] * a2, t[0] * a1 - t[1] * a0
    f0, f1, f2 = t[1] * w - t[2] * v, t[2] * u - t[0] * w, t[0] * v - t[1] * u
    volume = abs(u * e0 + v * e1 + w * e2)
    near_plane = volume <= tolerance * math.sqrt(bb * (e0 * e0 + e1 * e1 + e2 * e2))
    near_other = volume <= tolerance * math.sqrt(aa * (f0 * f0 + f1 * f1 + f2 * f2))
    if not (near_plane and near_other):
        return False
    at, bt = a0 * t[0] + a1 * t[1] + a2 * t[2], u * t[0] + v * t[1] + w * t[2]
    return ab * bt - bb * at > 0.0 and aa * bt - ab * at > 0.0


@numba.njit(cache=True, nogil=True)
def _measure_strengths(
    pair_idx: Ints,
    image_idx: Ints,
    found: _Matches,
    obs_cell: Ints,
    matchable: Ints,
    out: Array,
) -> None:
    """Fill out (P,) with :func:`pair_strengths`; matchable is (I, cells)."""
    pair_ptr, matches, first, obs_of_feature = found
    num_cells = matchable.shape[1]
    matched = np.empty((2, num_cells), np.int64)
    for p in pair_idx:
        matched[:] = 0
        for m in range(pair_ptr[p], pair_ptr[p + 1]):
            for side in range(2):
                o = obs_of_feature[first[image_idx[p, side]] + matches[m, side]]
                if o >= 0:
                    matched[side, obs_cell[o]] += 1
        weakest = 1.0
        for side in range(2):
            weakest = min(weakest, _covered_share(matched[side], matchable[image_idx[p, side]]))
        out[p] = weakest


@numba.njit(cache=True, nogil=True)
def _covered_share(matched: Ints, matchable: Ints) -> float:
    """How much of an image a pair covers, 0 to 1, from the keypoints in each cell: those that it matches, and all that
    any pair does."""
    total, weighted = 0.0, 0.0
    for c in range(len(matched)):
        if matched[c] > 0:
            total += matched[c]
            weighted += matched[c] * matched[c] / matchable[c]
    if total == 0.0:
        return 0.0
    full = HALF_AS_WELL * max(weighted / total, GOOD_SHARE)
    covered, everything = 0.0, 0.0
    for c in range(len(matched)):
        if matchable[c] > 0:
            weight = math.sqrt(matchable[c])
            everything += weight
            covered += weight * min(1.0, matched[c] / matchable[c] / full)
    return covered / everything


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene, true_correspondences

    scene = make_scene(0, 3, 60)
    standing_pairs(scene.observed, true_correspondences(scene, min_matches=1))
