"""The intrinsics of a camera from the first seconds of its sequence, by a reconstruction of a few frames."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.formats.sequences import HOW_TO_CALIBRATE, open_sequence
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.sequence import Frame, Sequence
from sfmapp.pipelines.options import Options
from sfmapp.pipelines.reconstruct import reconstruct
from sfmapp.scene.camera import CameraModel

STAGE = "calibration"
Pixels = NDArray[np.uint8]

# Frames that are reconstructed: enough baselines for a focal length, few enough for a minute.
MAX_FRAMES, MIN_FRAMES = 16, 6
# They are looked for in so many seconds, or frames where the rate is high.
MAX_SECONDS, MAX_READ = 30.0, 900
# The next frame is taken when the picture has moved by this share of its width, or most of what was seen is gone.
_MOTION, _LEFT = 0.04, 0.4
# Motion is measured on images of this width.
_SMALL_PX = 320
# What a calibration must reach to be used. A focal length that is off by 3 % bends a straight path noticeably.
MAX_FOCAL_SIGMA, MIN_SHARE = 0.03, 0.6
# A second term of distortion has to make the reprojection error smaller by this share: noise alone, of a few thousand
# observations, would give it some thousandths; a wide lens whose first term is not enough, more than half.
_MIN_GAIN = 0.05
ADVICE = HOW_TO_CALIBRATE.partition("; or let ")[0]


def self_calibrated(source: str, options: Options, events: Events) -> tuple[Options, dict[str, Any]]:
    """The same options with a camera, and how it was found.

    The first camera of the sequence is calibrated, and used alone. What the sequence itself says of its camera is not
    looked at, apart from a focal length in EXIF.

    Raises:
        InputError: the frames do not tell the intrinsics: too few, too little parallax, or a reconstruction that leaves
            the focal length open.
    """
    wish = replace(options.sequence, camera=None, mono=True)
    sequence = open_sequence(source, wish, events, require_camera=False)
    events.started(STAGE, "calibrating with the first seconds")
    frames = choose_frames(sequence)
    if len(frames) < MIN_FRAMES:
        raise InputError(
            f"{source}: the picture moves too little to calibrate with: {len(frames)} views that differ, "
            f"at least {MIN_FRAMES} are needed",
            f"begin where the camera moves (--start), or {ADVICE}",
        )
    report = _reconstruct(source, frames, options, events)
    found = _verdict(source, report, [frame.name for frame in frames])
    text = ",".join([found["model"], *(f"{value!r}" for value in found["params"].values())])
    events.finished(STAGE, found["text"])
    return replace(options, sequence=replace(wish, camera=text)), found


def choose_frames(sequence: Sequence) -> list[Frame]:
    """Up to MAX_FRAMES frames of the first seconds, the picture moved by some percent from each to the next."""
    chosen: list[Frame] = []
    follower: _Follower | None = None
    frames = sequence.frames()
    first_s = 0.0
    for count, frame in enumerate(frames):
        first_s = frame.timestamp_s if count == 0 else first_s
        if follower is None or follower.has_moved(frame.images[0]):
            chosen.append(frame)
            follower = _Follower(frame.images[0])
        if len(chosen) == MAX_FRAMES or count >= MAX_READ or frame.timestamp_s - first_s > MAX_SECONDS:
            break
    frames.close()  # type: ignore[attr-defined]  # a generator: ends its thread
    return chosen


class _Follower:
    """Corners of a frame, followed from frame to frame on small images."""

    def __init__(self, image: Pixels) -> None:
        import cv2

        self._small = self._shrunk(image)
        corners = cv2.goodFeaturesToTrack(self._small, 300, 0.01, 8)
        self._start = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._now, self._count = self._start, len(self._start)

    def has_moved(self, image: Pixels) -> bool:
        """The picture has moved far enough for another view."""
        import cv2

        small = self._shrunk(image)
        if not len(self._now):  # nothing to be seen in the frame it began with
            return True
        now, status, _ = cv2.calcOpticalFlowPyrLK(self._small, small, self._now, None)
        is_kept = status.ravel() > 0
        self._small, self._start, self._now = small, self._start[is_kept], np.asarray(now[is_kept], np.float32)
        if is_kept.sum() < _LEFT * self._count:
            return True
        shift = np.linalg.norm(self._now - self._start, axis=2)
        return float(np.median(shift)) > _MOTION * small.shape[1]

    @staticmethod
    def _shrunk(image: Pixels) -> Pixels:
        import cv2

        scale = _SMALL_PX / image.shape[1]
        size = (_SMALL_PX, max(1, round(image.shape[0] * scale)))
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _reconstruct(source: str, frames: list[Frame], options: Options, events: Events) -> dict[str, Any]:
    """Report of a reconstruction of the frames, in a folder that is gone afterwards.

    Unless the user has named a camera model, two are tried: the default, and one with another term of distortion.
    """
    import cv2

    model = options.images.camera_model
    models = (model, CameraModel.RADIAL) if model == ImageOptions().camera_model else (model,)
    reports: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="sfmapp-calibration-") as name:
        folder = Path(name) / "frames"
        folder.mkdir()
        for number, frame in enumerate(frames):
            cv2.imwrite(str(folder / f"{number:03d}.png"), frame.images[0])
        for model in models:
            images = replace(options.images, camera_model=model, camera_sharing="all", mask_path=None)
            wish = replace(options, images=images, min_registered=None)
            try:
                reports.append(reconstruct(folder, Path(name) / "out", wish, events=events, record=False).report)
            except NoReconstructionError as failure:
                raise InputError(
                    f"{source}: no calibration from its first seconds: {failure}",
                    f"begin where the camera moves sideways past something near (--start), or {ADVICE}",
                ) from failure
    errors = [report["models"][0]["mean_reprojection_error_px"] for report in reports]
    return reports[1] if len(errors) > 1 and errors[1] < (1 - _MIN_GAIN) * errors[0] else reports[0]


def _verdict(source: str, report: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """The camera of a good reconstruction and how good it is."""
    model, camera = report["models"][0], report["cameras"][0]
    params, sigma = camera["refined"] or camera["initial"], camera["sigma"]
    focals = [name for name in params if name in ("f", "fx", "fy")]
    relative = max((sigma[name] / params[name] for name in focals if sigma.get(name)), default=np.inf)
    problem = ""
    if model["num_registered"] < max(MIN_FRAMES, MIN_SHARE * len(names)):
        problem = f"only {model['num_registered']} of {len(names)} frames could be joined"
    elif not relative <= MAX_FOCAL_SIGMA:
        known = f"to {100 * relative:.1f} % only" if np.isfinite(relative) else "not at all"
        problem = f"they tell the focal length {known}, {100 * MAX_FOCAL_SIGMA:g} % are needed"
    if problem:
        raise InputError(
            f"{source}: no calibration from its first seconds: {problem}",
            f"begin where the camera moves sideways and turns (--start), or {ADVICE}",
        )
    focal = float(np.mean([params[name] for name in focals]))
    text = (
        f"{camera['model']}, f {focal:.1f} px \N{PLUS-MINUS SIGN}{relative * focal:.1f}, from "
        f"{model['num_registered']} frames, reprojection error {model['mean_reprojection_error_px']:.2f} px"
    )
    return {
        "model": camera["model"], "params": params, "sigma": sigma, "focal_sigma_relative": float(relative),
        "frames": names, "num_registered": model["num_registered"], "num_points": model["num_points"],
        "mean_reprojection_error_px": model["mean_reprojection_error_px"], "text": text,
    }  # fmt: skip
