"""The unit of length of a monocular map: from a known distance, the length of the path, or the height of the camera.

Markers have :mod:`sfmapp.odometry.inertial.markers`, inertial measurements
:mod:`sfmapp.odometry.inertial.visual_inertial`; all of them answer with a :class:`ScaleEstimate`, or with a
:class:`ScaleRefusal` that says why there is none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.errors import UsageError
from sfmapp.geometry import rigid3
from sfmapp.odometry.report import DistanceEvidence, HeightEvidence, PathEvidence, ScaleEvidence
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Source = Literal["marker", "distance", "camera_height", "imu"]

# Median absolute deviation to standard deviation, and the efficiency of the median, of a normal distribution.
_MAD_TO_SIGMA = 1.4826
_MEDIAN_SIGMA = 1.2533


@dataclass(frozen=True)
class ScaleEstimate:
    """How long the map's unit is.

    Attributes:
        scale: metres per map unit.
        sigma_relative: standard deviation of the scale over the scale.
        source: as in ``MapResult.scale_source``.
        evidence: numbers for the report.
    """

    scale: float
    sigma_relative: float
    source: Source
    evidence: ScaleEvidence


@dataclass(frozen=True)
class ScaleRefusal:
    """Why a source does not give the scale.

    Attributes:
        source: which.
        reason: a sentence for the report, with the numbers that failed.
        evidence: more numbers.
        contradiction: set where the source does not fall silent but says something else than the map.
    """

    source: Source
    reason: str
    evidence: ScaleEvidence
    contradiction: Contradiction | None = None


@dataclass(frozen=True)
class Length:
    """A measured length and how well it is known, in metres."""

    metres: float
    sigma_m: float = 0.0


@dataclass(frozen=True)
class KnownDistance:
    """A distance that the user measured.

    Attributes:
        frames: names or indices of two frames, between whose cameras it was measured; None for the whole path.
        length: of it.
    """

    frames: tuple[str, str] | None
    length: Length


@dataclass(frozen=True)
class GroundOptions:
    """How the ground below a camera of known height is looked for."""

    down_in_cam: tuple[float, float, float] = (0.0, 1.0, 0.0)  # direction of the ground, in the camera's frame
    max_tilt_deg: float = 15.0  # the ground's normal may differ by so much from down_in_cam
    num_neighbors: int = 3  # keyframes on either side whose points are looked at
    tolerance: float = 0.05  # a ground point lies within this share of the height from the plane
    min_depression_deg: float = 3.0  # points less far below the horizon are not looked at: their depths are too poor
    min_points: int = 20  # ground points that a keyframe's plane must have
    max_keyframe_sigma: float = 0.1  # relative standard deviation from the fit above which a keyframe's plane is no use
    min_keyframes: int = 5  # keyframes with a plane that must be there
    max_spread: float = 0.3  # robust relative spread of the heights over the keyframes above which they are no ground
    num_samples: int = 200  # random planes tried a keyframe
    seed: int = 0


def parse_length(text: str) -> Length:
    """Length of a number in metres; its error is taken as even over half a unit of the last digit given.

    Raises:
        UsageError: not a positive number.
    """
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not (np.isfinite(value) and value > 0):
        raise UsageError(
            f"--scale: expected a length above zero in metres, found {text!r}", "give it as a number, such as 0.16"
        )
    mantissa, _, exponent = text.strip().lower().partition("e")
    digits = len(mantissa.partition(".")[2])
    return Length(value, float(0.5 * 10.0 ** (int(exponent or 0) - digits) / np.sqrt(3.0)))


def parse_distance(text: str) -> KnownDistance:
    """``frame_a,frame_b,metres`` or ``path,metres``.

    Raises:
        UsageError: neither of the two.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 2 and parts[0] == "path":
        return KnownDistance(None, parse_length(parts[1]))
    if len(parts) == 3 and all(parts):
        if parts[0] == parts[1]:
            raise UsageError(f"a known distance is between two different frames, got {text!r}")
        return KnownDistance((parts[0], parts[1]), parse_length(parts[2]))
    raise UsageError(f"a known distance is 'frame_a,frame_b,metres' or 'path,metres', got {text!r}")


def apply_scale(reconstruction: Reconstruction, scale: float) -> Reconstruction:
    """A copy in metres: translations and points times ``scale``."""
    out = reconstruction.copy()
    out.cam_from_world[:, 4:] *= scale
    out.point_xyz *= scale
    return out


def scale_covariance(covariance: ArrayLike, scale: float) -> Array:
    """Covariances (..., 6, 6) of rotation and translation after :func:`apply_scale`; the scale's own is not in it."""
    factor = np.array([1.0, 1.0, 1.0, scale, scale, scale])
    scaled: Array = np.asarray(covariance, np.float64) * factor[:, None] * factor
    return scaled


def scale_from_distance(
    cam_from_world_a: ArrayLike,
    cam_from_world_b: ArrayLike,
    length: Length,
    covariance_a: ArrayLike | None = None,
    covariance_b: ArrayLike | None = None,
) -> ScaleEstimate | ScaleRefusal:
    """Scale from the distance between two camera centres.

    Args:
        cam_from_world_a, cam_from_world_b: (7,) poses in one map.
        length: of the line between the centres.
        covariance_a, covariance_b: (6, 6) as in ``MapResult``; None where not known. Taken as independent: between
            frames far apart drift, which they do not hold, may be larger.
    """
    centers = np.stack([rigid3.center(pose) for pose in (cam_from_world_a, cam_from_world_b)])
    if not np.isfinite(centers).all():
        return ScaleRefusal("distance", "one of the two frames has no pose", DistanceEvidence())
    line = centers[1] - centers[0]
    distance = float(np.linalg.norm(line))
    if not distance > 1e-9 * max(float(np.abs(centers).max()), 1e-300):
        return ScaleRefusal(
            "distance", "the two frames are in the same place", DistanceEvidence(distance_map_units=distance)
        )
    variance = 0.0
    for pose, covariance in ((cam_from_world_a, covariance_a), (cam_from_world_b, covariance_b)):
        if covariance is not None:
            variance += float(line @ rigid3.center_covariance(pose, covariance) @ line) / distance**2
    sigma = float(np.hypot(np.sqrt(variance) / distance, length.sigma_m / length.metres))
    evidence = DistanceEvidence(metres=length.metres, sigma_m=length.sigma_m, distance_map_units=distance)
    return ScaleEstimate(length.metres / distance, sigma, "distance", evidence)


def scale_from_path(cam_from_world: ArrayLike, length: Length) -> ScaleEstimate | ScaleRefusal:
    """Scale from the length of the whole path.

    The length of a path drawn through noisy positions grows with their number, so keyframes serve better than frames.
    What the length loses when every second pose is left out bounds both this and what the corners cut off; it goes
    into sigma.

    Args:
        cam_from_world: (K, 7) poses in the order of time, in one map, without gaps.
        length: of the path.
    """
    centers = rigid3.center(cam_from_world)
    if len(centers) < 2 or not np.isfinite(centers).all():
        reason = "the path has gaps or no length: give the distance of two frames instead"
        return ScaleRefusal("distance", reason, DistanceEvidence())
    path = _path_length(centers)
    if not path > 0:
        return ScaleRefusal("distance", "the camera did not move", DistanceEvidence())
    coarse = np.concatenate([centers[:-1:2], centers[-1:]])
    sigma = float(np.hypot(abs(path - _path_length(coarse)) / path, length.sigma_m / length.metres))
    evidence = PathEvidence(
        metres=length.metres, sigma_m=length.sigma_m, path_map_units=path,
        path_of_every_second_map_units=_path_length(coarse), num_poses=len(centers),
    )  # fmt: skip
    return ScaleEstimate(length.metres / path, sigma, "distance", evidence)


def _path_length(centers: Array) -> float:
    return float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())


def scale_from_camera_height(
    reconstruction: Reconstruction, image_idx: ArrayLike, height: Length, options: GroundOptions = GroundOptions()
) -> ScaleEstimate | ScaleRefusal:
    """Scale from the height of the camera over the ground.

    At every keyframe a plane below the camera is fitted to the map's points that the keyframes around it see: random
    planes near ``down_in_cam`` (less its part along the motion, which is taken to be along the ground), scored by the
    points on them less those below them, then least squares of ``a.x = 1`` on the points within tolerance. The median
    of the heights gives the scale, so a drifting map gets its mean scale; ``evidence`` tells of the drift. Sigma holds
    the map's noise and the given length's, not a body on springs or a lens that was calibrated wrongly.

    Args:
        reconstruction: a map.
        image_idx: (K,) its images in the order of time; unregistered ones are left out.
        height: of the camera's centre over the ground.
    """
    images = np.asarray(image_idx, np.int64)
    images = images[reconstruction.is_registered[images]]
    planes = np.full((len(images), 3), np.nan)
    heights, sigmas, counts = np.full(len(images), np.nan), np.full(len(images), np.nan), np.zeros(len(images), int)
    for k in range(len(images)):
        rng = np.random.default_rng([options.seed, 0x6A0D, k])
        points, down = _points_below(reconstruction, images, k, options)
        start = _carry_plane(reconstruction, images, planes, k)
        found = _fit_ground(points, down, start, options, rng)
        if found is not None:
            planes[k], sigmas[k], counts[k] = found
            heights[k] = 1.0 / np.linalg.norm(planes[k])
    return _height_verdict(heights, sigmas, counts, height, options)


def _points_below(
    reconstruction: Reconstruction, images: NDArray[np.int64], k: int, options: GroundOptions
) -> tuple[Array, Array]:
    """Points (N, 3) below the horizon that the keyframes around the k-th see, and the way down (3,), in its frame."""
    tracks = reconstruction.tracks
    around = images[max(k - options.num_neighbors, 0) : k + options.num_neighbors + 1]
    obs = np.concatenate([tracks.observations_of_image(int(i)) for i in around])
    seen = np.unique(tracks.obs_track_idx[obs[reconstruction.obs_is_inlier[obs]]])
    pose = reconstruction.cam_from_world[images[k]]
    down = np.asarray(options.down_in_cam, np.float64)
    down = down / np.linalg.norm(down)
    centers = reconstruction.centers[around]
    motion = rigid3.rotation_matrix(pose) @ (centers[-1] - centers[0])
    length = np.linalg.norm(motion)
    # the camera nods, the vehicle under it does not: but only what the tilt allows is believed to be nodding
    if length > 0 and abs(down @ motion) < np.sin(np.radians(options.max_tilt_deg)) * length:
        down = down - (down @ motion) * motion / length**2
        down /= np.linalg.norm(down)
    xyz = rigid3.apply(pose, reconstruction.point_xyz[seen])
    with np.errstate(invalid="ignore"):
        is_below = xyz @ down > np.sin(np.radians(options.min_depression_deg)) * np.linalg.norm(xyz, axis=1)
    return xyz[is_below], down


def _carry_plane(reconstruction: Reconstruction, images: NDArray[np.int64], planes: Array, k: int) -> Array | None:
    """The plane of the keyframe before in the frame of the k-th, a.x = 1 as ever; None without one."""
    if k == 0 or not np.isfinite(planes[k - 1, 0]):
        return None
    poses = reconstruction.cam_from_world[images[k - 1 : k + 1]]
    now_from_before = rigid3.compose(poses[1], rigid3.inverse(poses[0]))
    normal = rigid3.rotation_matrix(now_from_before) @ planes[k - 1]
    offset = 1.0 + normal @ now_from_before[4:]
    return normal / offset if offset > 0 else None


def _fit_ground(
    points: Array, down: Array, start: Array | None, options: GroundOptions, rng: np.random.Generator
) -> tuple[Array, float, int] | None:
    """Plane a (3,) with a.x = 1 on the ground, relative sigma of the height, number of points on it; None if none."""
    if len(points) < options.min_points:
        return None
    candidates = _candidate_planes(points, down, start, options, rng)
    value = points @ candidates.T
    on = (np.abs(value - 1.0) < options.tolerance).sum(0)
    below = (value > 1.0 + 2.0 * options.tolerance).sum(0)
    plane = candidates[int(np.argmax(on - below))]
    for _ in range(5):
        is_on = np.abs(points @ plane - 1.0) < options.tolerance
        normal_matrix = points[is_on].T @ points[is_on]
        if is_on.sum() < options.min_points or np.linalg.cond(normal_matrix) > 1e12:
            return None
        plane = np.linalg.solve(normal_matrix, points[is_on].sum(0))
    value = points @ plane
    is_on = np.abs(value - 1.0) < options.tolerance
    num_on = int(is_on.sum())
    num_above = int((np.abs(value - 1.0 + 2.0 * options.tolerance) < options.tolerance).sum())
    # the ground is a peak among the heights, and little lies below it
    is_peak = num_on >= 2 * num_above and num_on > 2 * (value > 1.0 + 2.0 * options.tolerance).sum()
    cosine = plane @ down / np.linalg.norm(plane)
    if num_on < options.min_points or not is_peak or cosine < np.cos(np.radians(options.max_tilt_deg)):
        return None
    variance = ((value[is_on] - 1.0) ** 2).sum() / (num_on - 3)
    # of the height 1 / |a|, relative: a.da / |a|^2
    sigma = float(np.sqrt(variance * plane @ np.linalg.solve(normal_matrix, plane))) / float(plane @ plane)
    return (plane, sigma, num_on) if sigma < options.max_keyframe_sigma else None


def _candidate_planes(
    points: Array, down: Array, start: Array | None, options: GroundOptions, rng: np.random.Generator
) -> Array:
    """Planes (H, 3) through single points across the way down, through random threes, and the start."""
    level = points[rng.permutation(len(points))[: options.num_samples]] @ down
    candidates = [down / level[:, None]]
    index = rng.integers(0, len(points), (options.num_samples, 3))
    triples = points[index]
    size = np.linalg.norm(triples, axis=2).prod(1)
    triples = triples[np.abs(np.linalg.det(triples)) > 1e-9 * size]
    if len(triples):
        through = np.linalg.solve(triples, np.ones((len(triples), 3, 1)))[..., 0]
        cosine = through @ down / np.linalg.norm(through, axis=1)
        candidates.append(through[cosine > np.cos(np.radians(options.max_tilt_deg))])
    if start is not None:
        candidates.append(start[None])
    return np.concatenate(candidates)


def _height_verdict(
    heights: Array, sigmas: Array, counts: NDArray[np.int64], height: Length, options: GroundOptions
) -> ScaleEstimate | ScaleRefusal:
    """Median over the keyframes, or why there is none."""
    good = np.flatnonzero(np.isfinite(heights))
    evidence = HeightEvidence(
        metres=height.metres, sigma_m=height.sigma_m, num_keyframes=len(heights), num_keyframes_with_ground=len(good)
    )
    if len(good) < options.min_keyframes:
        return ScaleRefusal(
            "camera_height",
            f"a ground plane was found below {len(good)} of {len(heights)} keyframes, "
            f"at least {options.min_keyframes} are asked for",
            evidence,
        )
    log_height = np.log(heights[good])
    middle = float(np.median(log_height))
    spread = float(_MAD_TO_SIGMA * np.median(np.abs(log_height - middle)))
    third = max(len(good) // 3, 1)
    drift = float(np.exp(np.median(log_height[-third:]) - np.median(log_height[:third])))
    evidence = replace(
        evidence, height_map_units=float(np.exp(middle)), relative_spread=spread, last_over_first_third=drift,
        median_points=int(np.median(counts[good])), median_keyframe_sigma=float(np.median(sigmas[good])),
    )  # fmt: skip
    if not spread <= options.max_spread:
        return ScaleRefusal(
            "camera_height",
            f"the heights over what looks like ground differ by {spread:.0%} between keyframes, "
            f"at most {options.max_spread:.0%} are allowed",
            evidence,
        )
    # windows that share keyframes share points and errors
    num_independent = max(len(good) / (2 * options.num_neighbors + 1), 1.0)
    error = max(spread, float(np.median(sigmas[good])))
    sigma = float(np.hypot(_MEDIAN_SIGMA * error / np.sqrt(num_independent), height.sigma_m / height.metres))
    return ScaleEstimate(height.metres / float(np.exp(middle)), sigma, "camera_height", evidence)
