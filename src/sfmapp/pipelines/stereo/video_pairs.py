"""Pairs of a video whose frames hold both pictures side by side, left half and right half."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.images.containers import Damaged, decoded_frames, open_container, rgb_of
from sfmapp.images.video import is_stream, read_video_facts
from sfmapp.pipelines.stereo.sources import KnownCameras, PairSource, cameras_of

Pixels = NDArray[np.uint8]


def pairs_of_video(video: str, known: KnownCameras, step: int) -> Iterator[PairSource]:
    """The pairs of every ``step``-th frame, decoded as they are asked for.

    Raises:
        InputError: it cannot be read, or its frames have no two halves of one width.
    """
    facts = read_video_facts(video)
    if facts.width % 2:
        raise InputError(
            f"{video}: expected frames whose halves are the left and the right picture, found {facts.width} x "
            f"{facts.height} pixels, an odd width"
        )
    size = facts.width // 2, facts.height
    cameras = cameras_of(known, (size, size))
    stat = os.stat(video) if os.path.isfile(video) else None
    digests = {} if stat is None else {video: f"{stat.st_size} bytes, modified at {stat.st_mtime_ns}"}
    with closing(open_container(video, is_stream=is_stream(video))) as container:
        for number, item in enumerate(decoded_frames(container)):
            if number % step or isinstance(item, Damaged):
                continue
            name = f"{number:06d}"
            yield PairSource(
                name, f"{name}, left half", f"{name}, right half", partial(_halves, rgb_of(item)), lambda: cameras,
                digests, is_frame=True,
            )  # fmt: skip


def _halves(pixels: Pixels) -> tuple[Pixels, Pixels]:
    middle = pixels.shape[1] // 2
    return np.ascontiguousarray(pixels[:, :middle]), np.ascontiguousarray(pixels[:, middle:])
