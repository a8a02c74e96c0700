"""What will probably go wrong: photographs that are no good, that do not belong together, or that say too little."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import listed
from sfmapp.features.report import FEW_FEATURES
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.report import ImagesReport
from sfmapp.matching.descriptors import match_sift
from sfmapp.matching.options import MatchingOptions
from sfmapp.pipelines.planning.links import Links
from sfmapp.pipelines.planning.look import Look
from sfmapp.pipelines.planning.trial import Trial
from sfmapp.report.plan import Doubt
from sfmapp.scene.correspondences import TwoViewConfig

# A photograph is blurred that has so many times the blur of the set's median, and is that much above it. Of 13 good
# sets the worst photograph has 1.2 times the median, of one with plain sky 1.42; blurred by 0.2 % of its side, or
# shaken by 1.2 %, one has 1.5 to 2.5.
_BLUR_RATIO, _BLUR_ABOVE = 1.5, 0.1
# A whole set is, whose median is above this: of the 13 the largest is 0.37; all blurred by 0.4 % of the side, 0.54.
_BLURRED_SET = 0.5
# Burnt out or black is a photograph with this share of its pixels more so than the set's median: objects before white
# or black are none.
_EXPOSED = 0.3
# photographs that tell what is usual
_ENOUGH = 4
# Photographs are the same whose small versions correlate so well, and whose features have not moved, in the median, by
# this share of the diagonal: half a pixel of a small version. Objects before black correlate to 0.999 and have moved.
_ALIKE, _STILL = 0.98, 1e-3
# matches without which nobody can tell
_FEW_MATCHES = 15
# Smaller by this share of pixels than most: a thumbnail, or a crop.
_MUCH_SMALLER = 0.25
# at least so many of the pairs that overlap, and most of them, for what they have in common to be believed
_MANY_PAIRS = 3
_NAMES_SHOWN = 6


def find_doubts(
    image_set: ImageSet, report: ImagesReport, looks: Sequence[Look], links: Links, trial: Trial
) -> list[Doubt]:
    """What a look and a trial have shown, warnings first."""
    images = image_set.images
    found = [
        *_of_files(report, looks, images),
        *_of_quality(looks, images, links.groups(len(images))),
        *_of_copies(looks, images, report.duplicates),
        *_of_cameras(report, images),
        *_of_groups(links, images, looks),
        *_of_motion(links, trial),
    ]
    return sorted(found, key=lambda doubt: doubt.weight != "warning")


def _of_files(report: ImagesReport, looks: Sequence[Look], images: Sequence[ImageRecord]) -> Iterator[Doubt]:
    for reason in dict.fromkeys(one.reason for one in report.skipped):
        names = [one.name for one in report.skipped if one.reason == reason]
        yield _doubt(
            "warning", "files", names, f"cannot be used: {reason}", "convert or copy them again, or leave them out"
        )
    broken = [image.name for image, look in zip(images, looks, strict=True) if look.problem]
    if broken:
        yield _doubt("warning", "files", broken, "cannot be decoded", "copy them again from their source")
    for problem in dict.fromkeys(one.problem for one in report.problems):
        names = [one.name for one in report.problems if one.problem == problem]
        yield _doubt("note", "files", names, problem, "see whether that is meant")


def _usual(values: NDArray[np.float64], groups: Sequence[Sequence[int]]) -> NDArray[np.float64]:
    """For each photograph what is usual among those that show the same, or among all where these are few."""
    usual = np.full(len(values), np.nanmedian(values))
    for group in groups:
        if len(group) >= _ENOUGH and np.isfinite(values[group]).any():
            usual[group] = np.nanmedian(values[group])
    return usual


def _of_quality(
    looks: Sequence[Look], images: Sequence[ImageRecord], groups: Sequence[Sequence[int]]
) -> Iterator[Doubt]:
    blur = np.array([look.quality.blur for look in looks])
    if np.isfinite(blur).any():
        median, usual = float(np.nanmedian(blur)), _usual(blur, groups)
        if median > _BLURRED_SET:
            message = f"most photographs are blurred ({median:.2f} on a scale from 0, sharp, to 1; good ones have 0.4)"
            yield Doubt(
                weight="warning", subject="blur", message=message, names=[],
                remedy="hold the camera still, give it more light or a shorter exposure; see whether its lens is clean",
            )  # fmt: skip
        is_blurred = (blur > _BLUR_RATIO * usual) & (blur > usual + _BLUR_ABOVE)
        yield from _named(
            images, is_blurred, "blur", "blurred or shaken, unlike the others",
            "leave them out, or take them again with more light or a shorter exposure",
        )  # fmt: skip
    for subject, text in (
        ("white", "burnt out: much of it is plain white"),
        ("black", "dark: much of it is plain black"),
    ):
        share = np.array([getattr(look.quality, subject) for look in looks])
        yield from _named(
            images, share > _usual(share, groups) + _EXPOSED, "exposure", f"{text}, unlike in the others",
            "take them again with the exposure of the others, or mask what is plain",
        )  # fmt: skip
    few = np.array([len(look.features) < FEW_FEATURES and not look.problem for look in looks])
    yield from _named(
        images, few, "texture", f"fewer than {FEW_FEATURES} features in small: plain, dark or masked",
        "include something with texture, and light it",
    )  # fmt: skip


def _of_copies(
    looks: Sequence[Look], images: Sequence[ImageRecord], duplicates: Sequence[Sequence[str]]
) -> Iterator[Doubt]:
    for names in duplicates:
        yield _doubt("warning", "copies", names, "the same file", "leave copies out: they add nothing, and cost time")
    tiny = np.array([look.tiny for look in looks]).reshape(len(looks), -1)
    digests = {names[0]: set(names) for names in duplicates}
    taken: set[int] = set()
    for i in range(len(looks)):
        alike = [int(j) for j in np.flatnonzero(tiny[i + 1 :] @ tiny[i] > _ALIKE) + i + 1]
        still = [j for j in alike if j not in taken and _is_still(looks[i], looks[j], images[i], images[j])]
        names = [images[j].name for j in (i, *still)]
        if i in taken or not still or set(names) <= digests.get(names[0], set()):
            continue
        taken.update(still)
        message = "show the same from the same place: taken twice, or saved twice"
        yield _doubt(
            "warning", "copies", names, message, "leave all but one out: depth needs a step between photographs"
        )


def _is_still(one: Look, two: Look, record1: ImageRecord, record2: ImageRecord) -> bool:
    """Whether what two photographs show is at the same places in both, whatever their sizes."""
    options = MatchingOptions()
    found = match_sift(one.features.descriptors, two.features.descriptors, options.max_ratio, options.max_distance)
    if len(found) < _FEW_MATCHES:
        return False
    size1, size2 = (np.array([record.width, record.height]) for record in (record1, record2))
    places1, places2 = one.features.keypoints[found[:, 0], :2], two.features.keypoints[found[:, 1], :2]
    moved = np.linalg.norm((places1 / size1 - places2 / size2) * size1, axis=1)
    return float(np.median(moved)) < _STILL * float(np.linalg.norm(size1))


def _of_cameras(report: ImagesReport, images: Sequence[ImageRecord]) -> Iterator[Doubt]:
    pixels = np.array([image.width * image.height for image in images], np.float64)
    if len(pixels):
        yield from _named(
            images, pixels < _MUCH_SMALLER * np.median(pixels), "size",
            "much smaller than most: thumbnails or crops?", "use the photographs as the camera wrote them",
        )  # fmt: skip
    without = [camera for camera in report.cameras if camera.focal_source == "default"]
    if without:
        num = sum(camera.num_images for camera in without)
        whose = "all" if num == len(images) else f"{num} of {len(images)}"
        yield Doubt(
            weight="note", subject="focal length", message=f"the focal length of {whose} photographs is not known",
            names=[],
            remedy="it will be searched from the pairs; a calibration is better: --camera",
        )  # fmt: skip
    if len(report.cameras) > 1 and len(report.cameras) == len(images):
        yield Doubt(
            weight="note", subject="cameras", message="every photograph counts as a camera of its own", names=[],
            remedy="if one camera took all at one zoom: --set images.camera_sharing=all",
        )  # fmt: skip


def _of_groups(links: Links, images: Sequence[ImageRecord], looks: Sequence[Look]) -> Iterator[Doubt]:
    """Photographs that show nothing in common with the others, in groups and alone."""
    if len(images) < 2:
        return
    groups = links.groups(len(images))
    others = [group for group in groups[1:] if len(group) > 1]
    if others:
        shown = [f"{len(group)} ({images[group[0]].name}, ...)" for group in others[:_NAMES_SHOWN]]
        more = f" and {len(others) - _NAMES_SHOWN} groups more" if len(others) > _NAMES_SHOWN else ""
        yield Doubt(
            weight="warning", subject="overlap", names=[images[i].name for group in others for i in group],
            message=f"beside the {len(groups[0])} photographs with {images[groups[0][0]].name} there are such as show "
            f"nothing of these: {', '.join(shown)}{more}: other places?",
            remedy="reconstruct them apart, or add photographs between them",
        )  # fmt: skip
    alone = np.zeros(len(images), bool)
    alone[[group[0] for group in groups[0 if len(groups[0]) == 1 else 1 :] if len(group) == 1]] = True
    alone &= np.array([not look.problem for look in looks])
    yield from _named(
        images, alone, "overlap", "nothing in common with any other photograph was found",
        "add photographs between these and the others, more than half of each shared",
    )  # fmt: skip


def _of_motion(links: Links, trial: Trial) -> Iterator[Doubt]:
    """Pairs that show no depth: the camera turned on the spot, or all is a plane."""
    configs: NDArray[np.int8] = links.config[links.is_linked]
    whole = [pair.config for pair in trial.pairs if pair.num_matches]
    turned = sum(config == TwoViewConfig.PANORAMIC for config in whole)
    is_most = 2 * int((configs == TwoViewConfig.PANORAMIC).sum()) > len(configs)
    if is_most and turned >= _MANY_PAIRS and turned > 0.8 * len(whole):
        yield Doubt(
            weight="warning", subject="motion", names=[],
            message=f"{turned} of {len(whole)} pairs show a camera that turned on the spot: no depth can be had",
            remedy="take a step between photographs; or stitch them: sfmapp panorama",
        )  # fmt: skip


def _named(
    images: Sequence[ImageRecord], is_meant: NDArray[np.bool_], subject: str, message: str, remedy: str
) -> Iterator[Doubt]:
    names = [image.name for image, is_one in zip(images, is_meant, strict=True) if is_one]
    if names:
        yield _doubt("warning", subject, names, message, remedy)


def _doubt(weight: str, subject: str, names: Sequence[str], message: str, remedy: str) -> Doubt:
    shown = listed(list(names), _NAMES_SHOWN)
    return Doubt(
        weight="warning" if weight == "warning" else "note", subject=subject, message=f"{shown}: {message}",
        remedy=remedy, names=list(names),
    )  # fmt: skip
