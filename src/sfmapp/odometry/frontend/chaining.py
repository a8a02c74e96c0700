"""Going on where the map has thinned out: the motion since a keyframe from tracks alone, its length from the few points
of the map that are left.

Two views give the motion up to its length. Points triangulated with it have the distances between them that the map
says, up to that same factor: the median ratio of distances is the scale (Scaramuzza and Fraundorfer, "Visual odometry
part I", IEEE Robotics and Automation Magazine 2011, section on 2-D-to-2-D motion).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.geometry import epipolar, rigid3
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac
from sfmapp.matching.two_view import verify_front
from sfmapp.odometry.frontend.active_tracks import ActiveTracks, References
from sfmapp.scene.correspondences import TwoViewConfig

Array = NDArray[np.float64]

# Tracks that two views are compared over, points that carry the scale, and the least parallax that makes a depth.
_MIN_TRACKS, _MIN_POINTS, _MIN_ANGLE_DEG = 40, 4, 0.5
# Ratios of distances further apart than that share contradict each other.
_MAX_SPREAD = 0.3


def chain_pose(camera: Camera, tracks: ActiveTracks, references: References, xyz: Array, seed: int = 0) -> Array | None:
    """The pose of a frame from its tracks since the keyframe that most of them refer to.

    Args:
        tracks: (N) as they were found in the frame.
        xyz: (N, 3) their points in the map, NaN where not triangulated.

    Returns:
        (7,) cam_from_world, or None where the motion or its length cannot be told.
    """
    if len(tracks) < _MIN_TRACKS:
        return None
    row = int(np.argmax(np.bincount(references.position(tracks.reference))))
    mine = np.flatnonzero(tracks.reference == references.keyframe[row])
    if len(mine) < _MIN_TRACKS:
        return None
    xy1, xy2 = tracks.reference_xy[mine], tracks.xy[mine]
    options = MatchingOptions(max_error_px=max(1.0, 1e-3 * camera.width))
    found = verify_front(xy1, xy2, camera, camera, options, Ransac(1000, seed))
    usable = found.config in (TwoViewConfig.CALIBRATED, TwoViewConfig.PLANAR)
    if not usable or not found.median_angle_deg > _MIN_ANGLE_DEG:
        return None
    good = mine[found.is_inlier]
    xn1, xn2 = tracks.reference_ray[good], pixels_to_normalized(camera, tracks.xy[good])
    depths, _ = epipolar.ray_depths(found.cam2_from_cam1, xn1, xn2)
    known = np.isfinite(xyz[good, 0]) & (depths > 0).all(1)  # False for NaN
    if known.sum() < _MIN_POINTS:
        return None
    there = np.column_stack([xn1, np.ones(len(xn1))])[known] * depths[known, :1]
    scale = _ratio_of_distances(xyz[good][known], there)
    if scale is None:
        return None
    rotation, translation = references.rotation[row], references.translation[row]
    motion = found.cam2_from_cam1.copy()
    motion[4:] *= scale
    return rigid3.compose(motion, rigid3.from_matrix(rotation, translation))


def _ratio_of_distances(xyz1: Array, xyz2: Array) -> float | None:
    """Median over all pairs of points (N, 3) of distance in the first over distance in the second; None if they differ
    too much to mean anything."""
    i, j = np.triu_indices(len(xyz1), 1)
    first, second = (np.linalg.norm(x[i] - x[j], axis=1) for x in (xyz1, xyz2))
    apart = second > 1e-3 * second.max()
    ratios = first[apart] / second[apart]
    if len(ratios) < _MIN_POINTS:
        return None
    low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    return float(middle) if high - low < _MAX_SPREAD * middle else None
