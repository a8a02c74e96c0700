"""Images that the observations leave open, told apart from the others, whose covariances they would take along.

An image whose own information is singular, all points and all other cameras given, is open in that direction whatever
the others do: the marginal covariance of the others is had by eliminating it, with the pseudo-inverse of its block,
which is exact as a positive semidefinite system couples nothing to the null space of a block of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.problem import Problem

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A direction of a pose is open below this share of what is known of its axes one by one. Rounding leaves some 1e-15,
# and turns and shifts that look the same in a narrow picture of flat things far away leave 1e-9.
_OPEN_SHARE = 1e-12


def open_pose_blocks(problem: Problem, information: Array, scale: Array, used: Mask) -> NDArray[np.int64]:
    """Blocks of poses that are open by themselves.

    Args:
        information: (N, N) the undamped reduced system over the unknowns that are ``used`` (B * 8,) bool.
        scale: (N,) its diagonal before points were eliminated.
    """
    column = np.cumsum(used) - 1
    found = []
    for block in problem.pose_block[problem.pose_block >= 0]:
        at = column[block * 8 + np.arange(6)]
        root = np.sqrt(scale[at])
        if np.linalg.eigvalsh(information[np.ix_(at, at)] / np.outer(root, root))[0] < _OPEN_SHARE:
            found.append(block)
    return np.array(found, np.int64)


def eliminated(information: Array, scale: Array, gone: Mask) -> Array:
    """(M, M) information of the unknowns that stay, without those of ``gone`` (N,) bool, which may be open."""
    root = np.sqrt(scale[gone])
    own = information[np.ix_(gone, gone)] / np.outer(root, root)
    cross = information[np.ix_(gone, ~gone)] / root[:, None]
    less = cross.T @ np.linalg.pinv(own, rcond=_OPEN_SHARE, hermitian=True) @ cross
    return np.asarray(information[np.ix_(~gone, ~gone)] - less, np.float64)
