"""An object that turns before a background that stands still, told by what changes.

The median of all photographs is the background where the object was in less than half of them. In the middle, which it
never leaves, the median is the object's, and nothing that changes says so: there the colours decide, of what changes
elsewhere and of what does not. The object is then cut out of each photograph by GrabCut (Rother, Kolmogorov and Blake,
2004), whose sides are certain where a known background is hidden or in view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.backgrounds import Mask, Pixels, color_index, histogram, without_specks
from sfmapp.carve.graph_cut import cut_by_labels, shrunk_picture
from sfmapp.carve.still_matching import Matched, matched, measured_sigma, moved_by, put_back

Array = NDArray[np.float64]
Picture = NDArray[np.float32]

_ROUNDS = 3
# pixels are averaged over so many a side before they are held against the background
_WINDOW = 5
# logarithms of probabilities are believed up to this
_MOST_EVIDENCE = 8.0
# the background is told where so large a share of the photographs agree, and later, without the object, where so many
# of those that show it do, and so many of all
_MAJORITY, _AGREE, _LEAST_SEEN = 0.5, 0.7, 0.2
# what is rarer among background than where the object always is by this factor is the object's
_OFTENER = 3.0
# probability that what is told to be background is, and that what is in no place told is
_TOLD, _NOT_TOLD = 0.95, 1e-3
# probability of a shadow on the background
_SHADOW = 0.1
# what did not change once, and what may be the object all the same: the share of it that is said
_NEVER = 0.97
# standard deviations by which the object surely hides the background
_SURE = 4.0


@dataclass(frozen=True)
class StillBackground:
    """A background in small pixels, and what is in front of it.

    Attributes:
        picture: (h, w, 3) float32 grey levels. sigma: (h, w) float32 of these.
        is_known: (h, w) bool where the picture is the background.
        is_object: (h, w) bool where it is what the object always shows there.
        object_colors, background_colors: (32768,) logarithms of densities of colours.
        unsure: share of the outline of ``is_object`` beyond which nothing ever changed: colours alone tell it.
        spanned: (h, w) bool the rectangle around all that changes.
    """

    picture: Picture
    sigma: Picture
    is_known: Mask
    is_object: Mask
    object_colors: Array
    background_colors: Array
    unsure: float
    spanned: Mask


def learn_background(pictures: Sequence[Pixels], given: Pixels | None = None) -> StillBackground | None:
    """The background of photographs (H, W, 3) of one size from one place; None if nothing moves before it.

    Args:
        given: (H, W, 3) the background without the object, if there is a photograph of it.
    """
    small = [shrunk_picture(picture).astype(np.float32) for picture in pictures]
    if given is None:
        picture = np.median(small, axis=0).astype(np.float32)
        for _ in range(2):
            lit = [put_back(each, matched(each, picture)) for each in small]
            picture = np.median(lit, axis=0).astype(np.float32)
    else:
        picture = shrunk_picture(given).astype(np.float32)
    matches = [matched(each, picture) for each in small]
    sigma = measured_sigma(small, matches, picture)
    fits = [match.fits(each, sigma) for each, match in zip(small, matches, strict=True)]
    is_known = np.mean(fits, axis=0) >= _MAJORITY if given is None else np.ones(sigma.shape, bool)
    colors = [color_index(each.astype(np.uint8)) for each in small]
    changes = [_opened(~fit & is_known) for fit in fits]
    if not any(change.any() for change in changes):
        return None
    start = _first_colors(colors, changes, is_known, color_index(picture.astype(np.uint8)))
    spanned = _spanned(changes, is_known)
    scene = StillBackground(picture, sigma, is_known, np.zeros_like(is_known), *start, 0.0, spanned)
    if given is not None:
        return scene
    for k in range(_ROUNDS):
        if k:
            matches = [matched(each, scene.picture) for each in small]
            fits = [match.fits(each, sigma) for each, match in zip(small, matches, strict=True)]
        scene = _with_object(scene, colors, fits)
        masks = [_rough(each, match, scene) for each, match in zip(small, matches, strict=True)]
        if k + 1 < _ROUNDS:
            scene = _learned_again(scene, small, matches, masks, colors)
    return replace(scene, unsure=_unsure(scene.is_object, np.mean(fits, axis=0)))


def cut_from_background(picture: Pixels, scene: StillBackground) -> Mask | None:
    """(H, W) the object in a photograph (H, W, 3); None if it does not show the background."""
    small = shrunk_picture(picture)
    color = small.astype(np.float32)
    match = matched(color, scene.picture)
    if not match.is_there(color, scene.sigma):
        return None
    rough = _rough(color, match, scene)
    fits = match.fits(color, scene.sigma)
    hidden = match.away(color, scene.sigma) > _SURE**2
    surely = _eroded(hidden & ~fits & rough & scene.is_known)
    never = scene.is_known & fits & ~_dilated(rough)
    return without_specks(cut_by_labels(small, rough, surely=surely, never=never, size=picture.shape[:2]))


def _rough(color: Picture, match: Matched, scene: StillBackground) -> Mask:
    """(h, w) where a small picture (h, w, 3) shows the object, pixel by pixel."""
    import cv2

    index = color_index(color.astype(np.uint8))
    near = match.density(color, scene.sigma)
    told, shaded = np.where(scene.is_known, _TOLD, _NOT_TOLD), match.shaded_density(color, scene.sigma)
    here = np.logaddexp(near, np.log(_SHADOW) + shaded)
    background = np.logaddexp(np.log(told) + here, np.log1p(-told) + scene.background_colors[index])
    found = scene.object_colors[index]
    found = np.where(scene.is_object, np.logaddexp(near, found) - np.log(2.0), found)
    # where the object is in most photographs, it rather is in this one
    evidence = found - background + np.where(scene.is_known, 0.0, 1.0)
    evidence = np.clip(evidence, -_MOST_EVIDENCE, _MOST_EVIDENCE)
    return without_specks(cv2.blur(evidence, (_WINDOW, _WINDOW)) > 0.0)


def _with_object(scene: StillBackground, colors: Sequence[NDArray[np.int32]], fits: Sequence[Mask]) -> StillBackground:
    """Where the picture of the background is the object's: by its colours, more than what else is seen there."""
    import cv2

    ratio = np.clip(scene.object_colors - scene.background_colors, -6.0, 6.0)
    evidence = cv2.blur(ratio[color_index(np.clip(scene.picture, 0, 255).astype(np.uint8))], (3, 3))
    num = np.sum([~fit for fit in fits], axis=0)
    other = np.sum([np.where(fit, 0.0, ratio[index]) for fit, index in zip(fits, colors, strict=True)], axis=0)
    evidence = evidence - np.where(num >= 2, other / np.maximum(num, 1), 2.0)
    is_told = scene.is_known | scene.is_object
    evidence = np.where(is_told, np.where(scene.spanned, evidence, -_MOST_EVIDENCE), _MOST_EVIDENCE)
    is_object = cv2.blur(np.clip(evidence, -_MOST_EVIDENCE, _MOST_EVIDENCE), (_WINDOW, _WINDOW)) > 0.0
    return replace(scene, is_known=is_told & ~is_object, is_object=is_told & is_object)


def _first_colors(
    colors: Sequence[NDArray[np.int32]], changes: Sequence[Mask], is_known: Mask, index: NDArray[np.int32]
) -> tuple[Array, Array]:
    """Densities of colours of what changes, and of what is around it."""
    around = ~_spanned(changes, is_known)
    background = histogram([index[around] if np.count_nonzero(around) > 500 else index.ravel()], shaded=True)
    moving = [each[change] for each, change in zip(colors, changes, strict=True)]
    sure = histogram(moving, shaded=False)
    # the background shows where the object is most of the time, too
    within = histogram([each[~is_known] for each in colors], shaded=False)
    within = np.where(within > _OFTENER * background, within, 0.0)
    weights = sum(len(each) for each in moving), len(colors) * np.count_nonzero(~is_known) * within.sum()
    found = (weights[0] * sure + weights[1] * within / max(within.sum(), 1e-300)) / max(sum(weights), 1.0)
    return _density(found), _density(background)


def _learned_again(
    scene: StillBackground, small: Sequence[Picture], matches: Sequence[Matched], masks: Sequence[Mask],
    colors: Sequence[NDArray[np.int32]],
) -> StillBackground:  # fmt: skip
    """Background and colours out of what is not the object's."""
    lit = np.stack([put_back(each, match) for each, match in zip(small, matches, strict=True)])
    hidden = [moved_by(_dilated(m).astype(np.float32), -match.shift) for m, match in zip(masks, matches, strict=True)]
    free = np.stack(hidden) == 0.0
    picture, votes = _most_agreed(lit, free, scene.sigma)
    is_known = (votes >= max(3.0, _LEAST_SEEN * len(lit))) & (votes >= _AGREE * free.sum(axis=0))
    return replace(
        scene, picture=np.where(is_known[..., None], picture, scene.picture), is_known=is_known,
        is_object=np.zeros_like(is_known),
        object_colors=_density(histogram([i[m] for i, m in zip(colors, masks, strict=True)], shaded=False)),
        background_colors=_density(histogram([i[~m] for i, m in zip(colors, masks, strict=True)], shaded=True)),
    )  # fmt: skip


def _most_agreed(lit: Picture, free: Mask, sigma: Picture) -> tuple[Picture, NDArray[np.int64]]:
    """Mean (h, w, 3) of the colours (N, h, w, 3) that most of those that are free (N, h, w) agree on; how many do."""
    votes, best = np.zeros(sigma.shape, np.int64), np.zeros((*sigma.shape, 3), np.float32)
    reach = 2.0 * (3.0 * sigma) ** 2
    for one, is_free in zip(lit, free, strict=True):
        near = (((lit - one) ** 2).max(axis=-1) < reach) & free & is_free
        num = near.sum(axis=0)
        better = num > votes
        mean = np.einsum("nhwc,nhw->hwc", lit, near.astype(np.float32)) / np.maximum(num, 1)[..., None]
        votes, best = np.where(better, num, votes), np.where(better[..., None], mean, best).astype(np.float32)
    return best, votes


def _spanned(changes: Sequence[Mask], is_known: Mask) -> Mask:
    """(h, w) the rectangle around all that changes."""
    anywhere = np.any(changes, axis=0) | _opened(~is_known)
    rows, columns = np.flatnonzero(anywhere.any(axis=1)), np.flatnonzero(anywhere.any(axis=0))
    spanned = np.zeros_like(is_known)
    spanned[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
    return spanned


def _unsure(is_object: Mask, agree: Array) -> float:
    """Share of the outline of the object's own place that lies beside what never changed."""
    beside = _dilated(is_object) & ~is_object
    return float(np.mean(agree[beside] > _NEVER)) if beside.any() else 0.0


def _density(probability: Array) -> Array:
    """Logarithms per cubic grey level of probabilities (32768,) of colours in steps of 8; none is impossible."""
    return np.asarray(np.log(probability + 1e-7) - np.log(512.0))


def _opened(mask: Mask) -> Mask:
    return _dilated(_eroded(mask))


def _eroded(mask: Mask) -> Mask:
    import cv2

    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _dilated(mask: Mask) -> Mask:
    import cv2

    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
