"""What the covariance of a calibration leaves unknown of depths.

A pair is rectified as the calibration says, whatever the cameras are. If these are others, a point of depth Z has not
the disparity ``f B / Z - doffs`` but one that differs by ``a f B / Z + c``, and by what changes over the picture. So
each unknown of the calibration is moved by its sigma, points all over the picture and at all depths are projected by
the cameras that it makes and taken to the pair by the plan as it stands, and two numbers are fitted to how far their
disparities come to lie off: a is the relative error of f B, -c that of doffs. Part of the former is the baseline's,
which is known by itself; the rest is the focal length's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import project
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.rectification import Rectification

Array = NDArray[np.float64]

# points across and down the left picture, and their disparities from infinity, shares of the width: what pairs have
_GRID, _DISPARITIES = (9, 7), (0.01, 0.03, 0.06, 0.1)


def geometry_covariance(plan: Rectification, covariance: Array, *, is_swapped: bool = False) -> Array:
    """(3, 3) covariance of focal length, baseline and doffs of a rectified pair, as ``RectifiedGeometry`` has it.

    What moves disparities by other amounts here and there is added to doffs by its mean square.

    Args:
        covariance: (P0 + P1 + 6,) squared, of the parameters of the first camera and of the second, then of the turn
            (radians) and shift of the second one's pose about its own axes.
        is_swapped: the first of these is the right camera of the plan.
    """
    g = plan.geometry
    assert g.baseline is not None
    left, right, expected = _seen(plan, plan.rig)
    inside = np.isfinite(_disparities(plan, plan.rig))
    for camera, xy in zip(plan.rig.cameras, (left, right), strict=True):
        inside &= ((xy >= 0.0) & (xy <= [camera.width, camera.height])).all(1)
    design = np.stack([expected[inside], np.ones(int(inside.sum()))], 1)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    slopes, beyond = np.zeros((3, len(sigma))), np.zeros((len(design), len(sigma)))
    for n in np.flatnonzero(sigma > 0.0).tolist():
        step = np.zeros(len(sigma))
        step[n] = sigma[n]
        rigs = [_moved(plan.rig, sign * step, is_swapped) for sign in (1.0, -1.0)]
        ends = [_disparities(plan, one)[inside] for one in rigs]
        longer, shorter = (float(np.linalg.norm(one.cam_from_rig[1, 4:])) for one in rigs)
        off = (ends[0] - ends[1]) / (2.0 * sigma[n])
        (scale, shift), *_ = np.linalg.lstsq(design, off, rcond=None)
        of_baseline = (longer - shorter) / (2.0 * sigma[n] * g.baseline)
        slopes[:, n] = g.focal * (scale - of_baseline), g.baseline * of_baseline, -shift
        beyond[:, n] = off - design @ [scale, shift]
    found: Array = slopes @ covariance @ slopes.T
    found[2, 2] += float(np.einsum("ia,ab,ib->i", beyond, covariance, beyond).mean())
    return found


def without_turn(covariance: Array) -> Array:
    """The covariance of a calibration whose turn has been measured since, and is not uncertain by it any more."""
    found = covariance.copy()
    turn = slice(len(covariance) - 6, len(covariance) - 3)
    found[turn, :] = 0.0
    found[:, turn] = 0.0
    return found


def _seen(plan: Rectification, rig: Rig) -> tuple[Array, Array, Array]:
    """Pixels (N, 2) in both photographs of a rig of the points, and (N,) how far from infinity the plan has them."""
    g = plan.geometry
    assert g.baseline is not None
    x, y = ((np.arange(count) + 0.5) / count * side for count, side in zip(_GRID, (g.width, g.height), strict=True))
    u, v, d = (one.ravel() for one in np.meshgrid(x, y, np.array(_DISPARITIES) * g.width, indexing="ij"))
    flat = np.stack([(u - g.cx) / g.focal, (v - g.cy) / g.focal, np.ones_like(u)], 1)
    points = (flat * (g.focal * g.baseline / d)[:, None]) @ plan.left_from_camera
    left, right = (
        project(camera, rigid3.apply(pose, points)) for camera, pose in zip(rig.cameras, rig.cam_from_rig, strict=True)
    )
    return left, right, d


def _disparities(plan: Rectification, rig: Rig) -> Array:
    """(N,) disparities of the points in the pair that the plan makes of the photographs of a rig."""
    left, right, _ = _seen(plan, rig)
    found: Array = plan.points(0, left)[:, 0] - plan.points(1, right)[:, 0]
    return found


def _moved(rig: Rig, step: Array, is_swapped: bool) -> Rig:
    """The rig with its calibration moved by a step, in the order of the covariance."""
    if is_swapped:
        return _moved(rig.reversed_pair(), step, False).reversed_pair()
    first, second = rig.cameras
    ends = np.cumsum([len(first.params), len(second.params)])
    turn = rigid3.from_matrix(rigid3.exp_so3(step[-6:-3]), step[-3:])
    cameras = first.with_params(first.params + step[: ends[0]]), second.with_params(second.params + step[ends[0] : -6])
    return Rig(cameras, np.array([rigid3.IDENTITY, rigid3.compose(turn, rig.cam_from_rig[1])]))
