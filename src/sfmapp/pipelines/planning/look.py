"""A cheap look at every photograph: how good it is, and a few hundred features of a small version."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features.extract import FeatureOptions, empty_features, features_from_picture
from sfmapp.features.octaves import Scratch
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import Picture, as_rgb, read_mask_file
from sfmapp.images.quality import PictureQuality, picture_quality
from sfmapp.images.small import read_small_gray, small_picture
from sfmapp.scene.features import Features

STAGE = "look"
# Blur that costs a reconstruction its matches shows at this size; at twice of it a look takes twice the time.
_QUALITY_PX = 1000
# As few pixels and features as still link neighbours: of nine shared sets all but 4 in 100 pairs with more than 100
# matches.
_SMALL_PX, _NUM_FEATURES = 480, 600
# side of the picture by which photographs are told to be the same
_TINY_PX = 32


@dataclass(frozen=True)
class Look:
    """What a cheap look shows of a photograph.

    Attributes:
        quality: of a version of at most a thousand pixels.
        features: of a small version, in pixels of the whole photograph.
        tiny: (1024,) float32 grey values without their mean, of length 1; 0 of a plain picture.
        problem: why it cannot be read; empty if it can.
        cpu_s: of the thread that looked.
    """

    quality: PictureQuality
    features: Features
    tiny: NDArray[np.float32]
    problem: str = ""
    cpu_s: float = 0.0


def look_at_all(images: Sequence[ImageRecord], *, threads: int, events: Events) -> list[Look]:
    """A look at each photograph; the result does not depend on the number of threads."""
    events.started(STAGE, f"looking at {len(images)} photographs in small", total=len(images))
    with ThreadPoolExecutor(max(1, threads)) as pool:
        try:
            looks = []
            for look in pool.map(_look_at, images):
                looks.append(look)
                events.advanced(STAGE)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    events.finished(STAGE, f"{sum(len(look.features) for look in looks)} features in small")
    return looks


def _look_at(record: ImageRecord) -> Look:
    start = time.thread_time()
    try:
        gray = read_small_gray(record, _QUALITY_PX)
        mask = read_mask_file(record)
    except InputError as error:
        nothing = np.zeros(_TINY_PX**2, np.float32)
        return Look(PictureQuality(float("nan"), 0.0, 0.0), empty_features("sift"), nothing, str(error))
    import cv2

    small = small_picture(gray, _SMALL_PX)
    usable = None
    if mask is not None:
        size = small.shape[1], small.shape[0]
        usable = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) != 0
    options = FeatureOptions(max_num_features=_NUM_FEATURES)
    found = features_from_picture(Picture(as_rgb(small), small, usable), options, Scratch())[0]
    keypoints = found.keypoints.copy()
    factor = np.array([record.width / small.shape[1], record.height / small.shape[0]], np.float32)
    keypoints[:, :2] *= factor
    keypoints[:, 2] *= factor.mean()
    tiny = cv2.resize(gray, (_TINY_PX, _TINY_PX), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    tiny -= tiny.mean()
    tiny /= max(float(np.linalg.norm(tiny)), 1.0)
    quality = picture_quality(gray)
    return Look(quality, replace(found, keypoints=keypoints), tiny, "", time.thread_time() - start)
