"""Frames of a video that was taken turning on the spot, to stitch: sharp ones, spaced by how far the camera turned."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.images.containers import Damaged, DecodedFrame, decoded_frames, gray_of, open_container, rgb_of
from sfmapp.images.video import is_stream, read_video_facts, sharpness

Pixels = NDArray[np.uint8]

STAGE = "frames"
# Of each piece of a video, over which the picture moves by a fifth of its side, the sharpest frame is taken: two that
# follow each other overlap by three fifths at least, and so does every frame with the one after the next by a fifth.
_PIECE = 0.2
# Pictures are laid over each other in small, pixels of their longer side
_SMALL_PX = 160
# Below this peak of their correlation, two frames that follow each other show different things, or one is blurred.
_LEAST_PEAK = 0.05


@dataclass(frozen=True)
class PickedFrame:
    """A frame that was picked.

    Attributes:
        name: its number in the video. pixels: (H, W, 3) RGB, upright.
    """

    name: str
    pixels: Pixels


def pick_frames(source: str, events: Events) -> Iterator[PickedFrame]:
    """The sharpest frame of each piece of a video.

    Args:
        source: a file or a stream.

    Raises:
        InputError: it cannot be read, or holds no frame.
    """
    facts = read_video_facts(source)
    events.started(STAGE, f"frames of {source}", total=facts.num_frames)
    best: tuple[float, int, DecodedFrame] | None = None
    meter, num_picked, number = _Meter(), 0, -1
    with closing(open_container(source, is_stream=is_stream(source))) as container:
        for number, item in enumerate(decoded_frames(container)):
            events.advanced(STAGE)
            events.raise_if_cancelled()
            if isinstance(item, Damaged):
                continue
            gray = gray_of(item)
            if meter.has_moved(gray) and best is not None:
                num_picked += 1
                yield PickedFrame(f"{best[1]:06d}", rgb_of(best[2]))
                best = None
            score = sharpness(gray)
            if best is None or score > best[0]:
                best = score, number, item
    if best is None:
        raise InputError(f"{source}: expected a video, found no frame that can be decoded")
    yield PickedFrame(f"{best[1]:06d}", rgb_of(best[2]))
    events.finished(STAGE, f"{num_picked + 1} of {number + 1} frames, each a fifth of the picture from the one before")


class _Meter:
    """How far the picture has moved since the piece began, by phase correlation of frames that follow each other."""

    def __init__(self) -> None:
        self._last: NDArray[np.float32] | None = None
        self._moved = np.zeros(2)

    def has_moved(self, gray: Pixels) -> bool:
        """Take the next frame; whether a new piece begins with it."""
        import cv2

        factor = _SMALL_PX / max(gray.shape)
        size = max(8, round(gray.shape[1] * factor)), max(8, round(gray.shape[0] * factor))
        small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        last, self._last = self._last, small
        if last is None or last.shape != small.shape:
            self._moved[:] = 0.0
            return last is not None
        window = cv2.createHanningWindow(size, cv2.CV_32F)
        by, peak = cv2.phaseCorrelate(last, small, window)
        self._moved += np.array(by) / size
        if peak < _LEAST_PEAK or np.abs(self._moved).max() >= _PIECE:
            self._moved[:] = 0.0
            return True
        return False
