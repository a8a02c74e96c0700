"""The intrinsics of a camera from the first minute of its sequence, by a reconstruction of a few frames."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.camera.names import CameraModel
from sfmapp.contradictions import Contradiction, widened
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.geometry.epipolar import essential_from_pose, fundamental_from_essential
from sfmapp.geometry.self_calibration import SharedFocal, combine_focals, focals_from_matches
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.sequence import Frame, Sequence
from sfmapp.odometry.result import OdometryResult
from sfmapp.pipelines.lens_fit import LensFit, fit_lens
from sfmapp.pipelines.sparse.reconstruct import RunResult, reconstruct
from sfmapp.report.document import named_params
from sfmapp.report.model import CalibrationReport, PairFocal
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.sequences.open import HOW_TO_CALIBRATE, open_sequence
from sfmapp.workspace.options import Options

STAGE = "calibration"
Pixels = NDArray[np.uint8]

# Frames that are reconstructed: enough baselines and turns for a focal length, few enough for two minutes.
MAX_FRAMES, MIN_FRAMES = 20, 6
# They are looked for in so many seconds, or frames where the rate is high.
MAX_SECONDS, MAX_READ = 60.0, 1800
# The next frame is taken when the picture has moved by this share of its width, or most of what was seen is gone.
_MOTION, _LEFT = 0.07, 0.5
# Motion is measured on images of this width.
_SMALL_PX = 320
# What a calibration must reach to be used: a focal length that is off by 3 % bends a straight path noticeably. What it
# must reach to be called settled: 2 %, the best that odometry puts right by itself, is three of these sigmas away.
MAX_FOCAL_SIGMA, SETTLED_SIGMA, MIN_SHARE = 0.03, 0.0067, 0.6
# A second term of distortion has to make the reprojection error smaller by this share: noise alone, of a few thousand
# observations, would give it some thousandths; a wide lens whose first term is not enough, more than half.
_MIN_GAIN = 0.05
# Matches of a pair that is asked for the focal length: several for each of the seven numbers of F, so that their noise
# is known.
_MIN_MATCHES = 40
# The focal lengths of the reconstruction and of pairs contradict each other from so many sigmas on: once in 400.
_SIGMAS = 3.0
ADVICE = HOW_TO_CALIBRATE.partition("; or let ")[0]


def self_calibrated(source: str, options: Options, events: Events) -> tuple[Options, CalibrationReport]:
    """The same options with a camera, and how it was found.

    The first camera of the sequence is calibrated, and used alone. What the sequence itself says of its camera is not
    looked at, apart from a focal length in EXIF.

    Raises:
        InputError: the frames do not tell the intrinsics: too few, too little parallax, or a reconstruction that leaves
            the focal length open.
    """
    wanted = replace(options.sequence, camera=None, mono=True)
    sequence = open_sequence(source, wanted, events, require_camera=False)
    events.started(STAGE, "calibrating with the first minute")
    frames = choose_frames(sequence)
    if len(frames) < MIN_FRAMES:
        raise InputError(
            f"{source}: the picture moves too little to calibrate: {len(frames)} distinct views, "
            f"at least {MIN_FRAMES} are needed",
            f"begin where the camera moves (--start), or {ADVICE}",
        )
    run = _reconstruct(source, frames, options, events)
    found = _verdict(source, run, fit_lens(run.reconstruction), [frame.name for frame in frames])
    text = ",".join([found.model, *(f"{value!r}" for value in found.params.values())])
    events.finished(STAGE, found.text)
    if not found.is_settled:
        events.warned(STAGE, f"the calibration is uncertain: {found.text}")
    return replace(options, sequence=replace(wanted, camera=text)), found


def choose_frames(sequence: Sequence) -> list[Frame]:
    """Up to MAX_FRAMES frames in a row, the picture moved by some percent from each to the next.

    Of all such rows in the first minute the one in which the camera turns, or moves sideways, most past things at
    different distances: driving straight on, and turning on the spot, tell next to nothing of a lens.
    """
    found: list[Frame] = []
    worth: list[float] = []
    follower: _Follower | None = None
    frames = sequence.frames()
    first_s = 0.0
    for count, frame in enumerate(frames):
        first_s = frame.timestamp_s if count == 0 else first_s
        if follower is None or follower.has_moved(frame.images[0]):
            worth.append(0.0 if follower is None else follower.worth)
            found.append(frame)
            follower = _Follower(frame.images[0])
        if count >= MAX_READ or frame.timestamp_s - first_s > MAX_SECONDS:
            break
    frames.close()  # type: ignore[attr-defined]  # a generator: ends its thread
    if len(found) <= MAX_FRAMES:
        return found
    # the first step leads to the first frame of a row and is no part of it
    total = np.concatenate([[0.0], np.cumsum(worth)])
    rows = total[MAX_FRAMES:] - total[1 : len(total) - MAX_FRAMES + 1]
    start = int(np.argmax(rows))
    return found[start : start + MAX_FRAMES]


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
        moved: bool = float(np.median(shift)) > _MOTION * small.shape[1]
        return moved

    @property
    def worth(self) -> float:
        """What the motion since the first frame tells of a lens: the geometric mean of how far the picture as a whole
        has moved, in its widths, and how far its points have moved apart."""
        motion = (self._now - self._start)[:, 0]
        if len(motion) < 8:
            return 0.0
        whole = np.median(motion, axis=0)
        apart = np.median(np.linalg.norm(motion - whole, axis=1))
        return float(np.sqrt(np.linalg.norm(whole) * apart)) / _SMALL_PX

    @staticmethod
    def _shrunk(image: Pixels) -> Pixels:
        import cv2

        scale = _SMALL_PX / image.shape[1]
        size = (_SMALL_PX, max(1, round(image.shape[0] * scale)))
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _reconstruct(source: str, frames: list[Frame], options: Options, events: Events) -> RunResult:
    """A reconstruction of the frames; its files are gone afterwards.

    Unless the user has named a camera model, two are tried: the default, and one with another term of distortion.
    """
    model = options.images.camera_model
    models = (model, CameraModel.RADIAL) if model == ImageOptions().camera_model else (model,)
    # names that differ in their numbers alone, as files of one camera have
    views = {f"{number:03d}": frame.images[0] for number, frame in enumerate(frames)}
    runs: list[RunResult] = []
    with tempfile.TemporaryDirectory(prefix="sfmapp-calibration-") as name:
        for model in models:
            images = replace(options.images, camera=None, camera_model=model, camera_sharing="all", mask_path=None)
            wanted = replace(options, images=images, min_registered=None)
            try:
                runs.append(reconstruct(views, Path(name) / "out", wanted, events=events, record=False))
            except NoReconstructionError as failure:
                raise InputError(
                    f"{source}: no calibration from its first minute: {failure}",
                    f"begin where the camera moves sideways past something near (--start), or {ADVICE}",
                ) from failure
    errors = [run.report.models[0].mean_reprojection_error_px for run in runs]
    return runs[1] if len(errors) > 1 and errors[1] < (1 - _MIN_GAIN) * errors[0] else runs[0]


def focal_of_pairs(model: Reconstruction, camera: Camera) -> SharedFocal | None:
    """What the fundamental matrices of pairs of images tell of the focal length of their one camera.

    Nothing of the model counts for it but where the search for F begins: all matches of tracks take part, whether the
    model agrees with them or not. Pixels are laid out without the distortion of the camera.

    Returns:
        None where no pair tells it.
    """
    tracks, center = model.tracks, camera.canonical[2:4]
    flat = pixels_to_normalized(camera, np.asarray(tracks.obs_xy, np.float64)) * camera.focal + center
    size = float(max(camera.width, camera.height))
    pinhole = np.array([[camera.focal, 0.0, center[0]], [0.0, camera.focal, center[1]], [0.0, 0.0, 1.0]])
    told = []
    registered = model.registered_idx.tolist()
    for i, j in combinations(registered, 2):
        first, second = (tracks.observations_of_image(image) for image in (i, j))
        _, a, b = np.intersect1d(tracks.obs_track_idx[first], tracks.obs_track_idx[second], return_indices=True)
        if len(a) < _MIN_MATCHES:
            continue
        pose = rigid3.compose(model.cam_from_world[j], rigid3.inverse(model.cam_from_world[i]))
        start = fundamental_from_essential(essential_from_pose(pose), pinhole, pinhole)
        xy1, xy2 = flat[first[a]], flat[second[b]]
        is_known = np.isfinite(xy1).all(1) & np.isfinite(xy2).all(1)
        one = focals_from_matches(xy1[is_known], xy2[is_known], center, center, size, fundamental=start)
        if one is not None:
            told.append(one)
    return combine_focals(told)


def _verdict(source: str, run: RunResult, lens: LensFit, names: list[str]) -> CalibrationReport:
    """The camera of a good reconstruction and how good it is."""
    reconstruction, report = run
    model, camera = report.models[0], lens.camera
    relative, pairs = lens.focal_sigma_relative, focal_of_pairs(reconstruction, camera)
    if pairs is not None:
        # two ways to the same number: where they disagree, neither is as sure as it says
        apart = abs(math.log(pairs.focal / camera.focal))
        if apart > _SIGMAS * math.hypot(relative, pairs.sigma / pairs.focal):
            relative = math.hypot(relative, apart)
    problem = ""
    if model.num_registered < max(MIN_FRAMES, MIN_SHARE * len(names)):
        problem = f"only {model.num_registered} of {len(names)} frames could be joined"
    elif not relative <= MAX_FOCAL_SIGMA:
        known = f"to {100 * relative:.1f} % only" if np.isfinite(relative) else "not at all"
        problem = f"they tell the focal length {known}, {100 * MAX_FOCAL_SIGMA:g} % are needed"
    if problem:
        raise InputError(
            f"{source}: no calibration from its first minute: {problem}",
            f"begin where the camera moves sideways and turns (--start), or {ADVICE}",
        )
    text = (
        f"{camera.model.name}, f {camera.focal:.1f} px \N{PLUS-MINUS SIGN}{relative * camera.focal:.1f}, from "
        f"{model.num_registered} frames, reprojection error {model.mean_reprojection_error_px:.2f} px"
    )
    if pairs is not None:
        of_pairs = f"{pairs.focal:.1f} px \N{PLUS-MINUS SIGN}{pairs.sigma:.1f}"
        text += f"; {pairs.num_pairs} pairs of frames alone: {of_pairs}"
    return CalibrationReport(
        model=camera.model.name, params=named_params(camera), sigma=lens.sigma, focal_sigma_relative=float(relative),
        is_settled=bool(relative <= SETTLED_SIGMA), fit=lens.evidence, frames=names,
        num_registered=model.num_registered, num_points=model.num_points,
        mean_reprojection_error_px=model.mean_reprojection_error_px, text=text,
        pairs=None if pairs is None else PairFocal(
            focal_px=pairs.focal, sigma_px=pairs.sigma, num_pairs=pairs.num_pairs),
    )  # fmt: skip


def widen(result: OdometryResult, calibration: CalibrationReport) -> None:
    """Add to the covariances of every map, in place, what the calibration leaves open; where its focal length is not
    settled, note that as well."""
    relative = calibration.focal_sigma_relative
    found = Contradiction(
        "self-calibration",
        f"the focal length is known only to {100 * relative:.1f} %: parts of the first minute contradict each other",
        f"begin where the camera moves sideways and turns (--start), or {ADVICE}",
        {"focal_sigma_relative": relative, "settled": SETTLED_SIGMA, "parts": calibration.fit.parts},
        # a turn of 90 degrees is seen wrong by the same share, and so is what follows it
        rotation_sigma_deg=90.0 * relative, position_sigma_share=np.pi / 2 * relative, scale_sigma=relative,
    )  # fmt: skip
    for m, entry in enumerate(result.maps):
        covariance, mine = entry.covariance, result.frame_map == m
        spread = rigid3.spread(entry.reconstruction.cam_from_world[entry.keyframe_image_idx])
        if covariance is not None:
            covariance = widened(covariance, spread, [found])
        if result.covariance is not None:
            result.covariance[mine] = widened(result.covariance[mine], spread, [found])
        noted = [] if calibration.is_settled else [found]
        result.maps[m] = replace(entry, covariance=covariance, contradictions=[*entry.contradictions, *noted])
