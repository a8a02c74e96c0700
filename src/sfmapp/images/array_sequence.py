"""Frames in memory as a sequence: a list of arrays, or a generator that grabs them as they come."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence, Sized
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError, UsageError
from sfmapp.images.frame_reader import scaled_to_8_bits
from sfmapp.images.pixels import checked_pixels
from sfmapp.images.sequence import Frame, GroundTruth, Imu, SequenceKind
from sfmapp.scene.rig import Rig

Pixels = NDArray[np.uint8]


class ArraySequence:
    """Frames in memory, for ``track_sequence``. Those of a generator can be played once.

    Args:
        frames: (H, W) grey or (H, W, 3) RGB arrays of uint8 or uint16, or, of a rig, a tuple with one for each camera.
        camera: what took them, or the rig of them.
        timestamps_s: seconds of each frame, strictly ascending; asked for one as each frame comes. None: the frames
            come at a steady rate.
        fps: that rate.
        imu: inertial measurements on the clock of the frames.
        ground_truth: where the camera truly was, for reports.

    Raises:
        UsageError: a rate that is none.

    Example:
        >>> def grab():
        ...     while (frame := device.read()) is not None:
        ...         yield frame
        >>> sfmapp.track_sequence(sfmapp.ArraySequence(grab(), camera, fps=20))
    """

    kind: SequenceKind = "arrays"
    source = "memory://frames"
    orientation = 1

    def __init__(
        self,
        frames: Iterable[NDArray[Any] | tuple[NDArray[Any], ...]],
        camera: Camera | Rig,
        *,
        timestamps_s: Iterable[float] | None = None,
        fps: float = 30.0,
        imu: Imu | None = None,
        ground_truth: GroundTruth | None = None,
    ) -> None:
        if not (math.isfinite(fps) and fps > 0):
            raise UsageError(f"fps is {fps}", "give the frames per second, such as 30")
        self.rig = camera if isinstance(camera, Rig) else Rig.single(camera)
        self.frames_per_second: float | None = fps if timestamps_s is None else None
        self.num_frames: int | None = len(frames) if isinstance(frames, Sized) else None
        self.imu, self.ground_truth = imu, ground_truth
        self._given, self._times, self._fps = frames, timestamps_s, fps
        self._is_used = False

    def frames(self) -> Iterator[Frame]:
        """The frames in order, as 8-bit grey.

        Raises:
            InputError: an array of another shape than its camera's, a time that does not ascend, or a generator that
                was walked through before.
        """
        is_once = iter(self._given) is self._given or (self._times is not None and iter(self._times) is self._times)
        if is_once and self._is_used:
            raise InputError("the frames of a generator can be read only once", "give a list of them")
        self._is_used = True
        times = None if self._times is None else iter(self._times)
        white = [255] * len(self.rig.cameras)
        last_s = -math.inf
        for idx, item in enumerate(self._given):
            name = f"{idx:06d}"
            timestamp_s = idx / self._fps if times is None else float(next(times, math.nan))
            if not last_s < timestamp_s < math.inf:
                raise InputError(f"frame {name}: expected a time after {last_s:g} s, found {timestamp_s:g}")
            last_s = timestamp_s
            yield Frame(idx, name, timestamp_s, gray_images(name, item, self.rig, white))


def gray_images(
    name: str, item: NDArray[Any] | Sequence[NDArray[Any]], rig: Rig, white: list[int]
) -> tuple[Pixels, ...]:
    """A frame, or one for each camera of a rig, as (H, W) 8-bit grey of their own.

    Args:
        item: as of :class:`ArraySequence`.
        white: largest value that each camera's deeper frames were found to reach, 255 to begin with; it grows here.

    Raises:
        InputError: an array that is no picture, or of another shape than its camera's.
    """
    images = item if isinstance(item, tuple | list) else (item,)
    if len(images) != len(rig.cameras):
        raise InputError(f"frame {name}: expected {len(rig.cameras)} images, found {len(images)}")
    return tuple(_gray(name, rig.cameras[k], image, white, k) for k, image in enumerate(images))


def _gray(name: str, camera: Camera, image: NDArray[Any], white: list[int], camera_idx: int) -> Pixels:
    import cv2

    raw = checked_pixels(f"frame {name}", image)
    if raw.shape[:2] != (camera.height, camera.width):
        size = f"{raw.shape[1]}x{raw.shape[0]}"
        raise InputError(f"frame {name}: {size} pixels, but its camera has {camera.width}x{camera.height}")
    if raw.dtype == np.uint16:
        raw, white[camera_idx] = scaled_to_8_bits(raw, white[camera_idx])
    if raw.ndim == 3:
        raw = cv2.cvtColor(raw, cv2.COLOR_RGBA2GRAY if raw.shape[2] == 4 else cv2.COLOR_RGB2GRAY)
    return np.array(raw, np.uint8)  # a copy: grabbers use their buffers again
