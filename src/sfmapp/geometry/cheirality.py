"""Which of the four poses of an essential matrix it is, and whether the points can tell.

Each pair of rays that is not parallel lies in front of both cameras under exactly one of the four (Hartley and
Zisserman, "Multiple View Geometry", 2004, section 9.6.3). Two things make the count worthless: rays that are parallel
within the noise, whose vote is a coin, and a pose that the noise leaves so loose that other poses, which fit as well,
are chosen otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.epipolar import decompose_essential, essential_from_pose, ray_depths
from sfmapp.geometry.essential import moved_pose, refine_pose

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Standard deviations of a parallax that is no coin, and of the poses that are tried around the best.
_SIGMAS = 3.0
# The vote of parallaxes beyond the noise is nearly unanimous where the pose is right: what is left are wrong matches.
_MAJORITY = 0.75
_MIN_VOTES = 5


@dataclass(frozen=True)
class PoseChoice:
    """The four poses of an essential matrix, and the vote of N pairs of rays between them.

    Attributes:
        poses: (4, 7) cam2_from_cam1 with unit translation. num_in_front: (4,) points in front of both cameras.
        votes: (4,) the same, of those points only whose parallax is beyond the noise; equal to ``num_in_front`` where
            the noise is not known.
        best: position of the pose with most votes.
        in_front: (N,) bool, the points in front of both cameras under it. angles: (N,) parallax in radians.
        reason: why the points cannot tell; empty where they can.
    """

    poses: Array
    num_in_front: NDArray[np.int64]
    votes: NDArray[np.int64]
    best: int
    in_front: Bools
    angles: Array
    reason: str = ""

    @property
    def is_decided(self) -> bool:
        """Whether the points tell which of the four it is."""
        return not self.reason

    @property
    def pose(self) -> Array:
        """(7,) the pose with most votes, also where that means nothing."""
        best: Array = self.poses[self.best]
        return best


def choose_pose(essential: Array, xn1: Array, xn2: Array, noise: float = 0.0) -> PoseChoice:
    """Let the points choose among the four poses of an essential matrix, or say that they cannot.

    Args:
        essential: (3, 3).
        xn1, xn2: (N, 2) normalised image points of inliers.
        noise: standard deviation of one of their coordinates in radians: pixels over focal length. 0: they are exact,
            and the vote alone decides.
    """
    poses = decompose_essential(essential)
    in_front, certain = _ballots(poses, xn1, xn2, noise)
    votes = (in_front & certain).sum(1)
    best = int(np.argmax(votes))
    if not votes.any():
        best = int(np.argmax(in_front.sum(1)))
    _, angles = ray_depths(poses[best], xn1, xn2)
    reason = _doubts(poses, votes, best, len(xn1)) or (_looseness(poses[best], xn1, xn2, noise) if noise else "")
    return PoseChoice(poses, in_front.sum(1), votes, best, in_front[best], angles, reason)


def _ballots(poses: Array, xn1: Array, xn2: Array, noise: float) -> tuple[Bools, Bools]:
    """(K, N) which points lie in front of both cameras of each pose, and (K, N) whose parallax is beyond the noise."""
    tried = [ray_depths(pose, xn1, xn2) for pose in poses]
    in_front = np.array([(depths > 0).all(1) for depths, _ in tried])
    # the noise of both rays across each other
    least = _SIGMAS * math.sqrt(2.0) * noise
    certain = np.array([(angles > least) & np.isfinite(depths).all(1) for depths, angles in tried])
    return in_front, certain


def _doubts(poses: Array, votes: NDArray[np.int64], best: int, num_points: int) -> str:
    """What speaks against a vote; empty if nothing."""
    if votes[best] < _MIN_VOTES:
        return (
            f"{int(votes.sum())} of {num_points} points have a parallax beyond the noise, {_MIN_VOTES} in front of "
            "both cameras are wanted: from (nearly) one place every direction of the baseline fits"
        )
    # the same rotation with the other end of the baseline, and the two that are turned half about it
    if votes[best] < _MAJORITY * votes.sum():
        second = int(np.argsort(-votes, kind="stable")[1])
        return f"the points are divided: {int(votes[best])} vote for one pose, {int(votes[second])} for another"
    return ""


def _looseness(pose: Array, xn1: Array, xn2: Array, noise: float) -> str:
    """Whether a pose as probable as the best one chooses another of its four; empty if none does.

    Tried are poses three standard deviations away along each axis of the covariance, refined again, and the minimum of
    the cost on the other side: relief that is turned inside out while the camera goes the other way (the reversal of
    Necker, which narrow fields of view cannot tell from the truth; Soatto and Brockett, CVPR 1998).
    """
    best, cost, covariance = refine_pose(pose, xn1, xn2, noise)
    if covariance is None:
        return "the points leave the pose open: their equations are singular"
    values, vectors = np.linalg.eigh(covariance)
    if not _agrees(best, pose, xn1, xn2, noise):
        return "refined to the least error, the pose is another of the four"
    for value, vector in zip(values, vectors.T, strict=True):
        for sign in (-1.0, 1.0):
            step = sign * _SIGMAS * math.sqrt(value) * vector
            if not _agrees(moved_pose(best, step), pose, xn1, xn2, noise):
                return (
                    "poses that fit as well choose otherwise: the direction of the baseline is known to "
                    f"{math.degrees(min(math.sqrt(float(values[-1])), math.pi)):.2g} degrees only"
                )
    for other in _reversals(best):
        refined, other_cost, _ = refine_pose(other, xn1, xn2, noise)
        # a difference of costs of this many sigmas tells one hypothesis from the other
        is_as_good = other_cost - cost < _SIGMAS**2 * noise**2
        if is_as_good and not _agrees(refined, pose, xn1, xn2, noise):
            return (
                "another pose, with the scene turned inside out and the camera gone the other way, fits as well: a "
                "plane or a narrow field of view leaves both"
            )
    return ""


def _agrees(pose: Array, wanted: Array, xn1: Array, xn2: Array, noise: float) -> bool:
    """Whether most of the points choose, of the four poses of this one, that which is nearest to the wanted one."""
    poses = decompose_essential(essential_from_pose(pose))
    in_front, certain = _ballots(poses, xn1, xn2, noise)
    votes = (in_front & certain).sum(1)
    chosen = poses[int(np.argmax(votes))]
    turn = rigid3.rotation_angle_deg(rigid3.rotation_matrix(chosen) @ rigid3.rotation_matrix(wanted).T)
    return bool(votes.any() and chosen[4:] @ wanted[4:] > 0.0 and float(turn) < 90.0)


def _reversals(pose: Array) -> list[Array]:
    """Poses on the other side: the same motion of a narrow field of view with the depths reversed."""
    w = rigid3.log_so3(rigid3.rotation_matrix(pose))
    t = pose[4:]
    other = np.array([-w[0], -w[1], w[2]])
    turned = rigid3.exp_so3(other)
    flipped = np.array([-t[0], -t[1], t[2]])
    return [rigid3.from_matrix(turned, each) for each in (flipped, -t, t)]
