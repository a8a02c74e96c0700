"""The planes that two photographs show: which matches lie on each, how it stands, and what of the pictures it takes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import pixels_to_normalized
from sfmapp.geometry import rigid3
from sfmapp.geometry.cheirality import PoseChoice
from sfmapp.geometry.homography import motions_from_homography
from sfmapp.geometry.pair_plane import PlaneFit, find_planes, fit_plane
from sfmapp.matching.search import Ransac, find_homography
from sfmapp.twoview.report import PlaneNormal, PlaneStep
from sfmapp.twoview.view import View

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

# a plane is flat to so many sigmas of a match: both directions of the transfer, and what the plane's own error adds
_SIGMAS, _LEAST_PX = 4.0, 0.75
# of the cells of a photograph, in its longer side, that are a plane's or another's
_CELLS = 40


def planes_of(
    views: tuple[View, View], used: Ints, choice: PoseChoice, px: tuple[float, float], ransac: Ransac
) -> tuple[list[PlaneStep], Ints]:
    """Planes among verified matches (P, 2), and (P,) which of them each is on; -1 for none.

    Args:
        choice: the relative pose.
        px: standard deviation of a coordinate of a match, and the most that a match may be from a model.
    """
    sigma_px, most_px = px
    cameras = views[0].camera, views[1].camera
    xy1, xy2 = (view.xy[used[:, side]] for side, view in enumerate(views))
    xn = [pixels_to_normalized(camera, xy) for camera, xy in zip(cameras, (xy1, xy2), strict=True)]
    flat = [each * camera.focal for camera, each in zip(cameras, xn, strict=True)]
    threshold = float(np.clip(_SIGMAS * sigma_px, _LEAST_PX, max(most_px, _LEAST_PX)))
    owner = np.full(len(used), -1, np.int32)
    found: list[tuple[Array, NDArray[np.bool_], PlaneFit | None, list[PlaneNormal]]] = []

    def search(a: Array, b: Array) -> Array | None:
        return find_homography(a, b, threshold, ransac)

    for h, mask in find_planes(flat[0], flat[1], threshold, search):
        fit = fit_plane(choice.pose, xn[0][mask], xn[1][mask])
        owner[mask] = len(found)
        k1, k2 = (np.diag([camera.focal, camera.focal, 1.0]) for camera in cameras)
        found.append((h, mask, fit, _normals(h, k1, k2, xn[0][mask], choice.pose)))
    shares = [_areas(view, xy, owner) for view, xy in zip(views, (xy1, xy2), strict=True)]
    steps = [
        PlaneStep(
            name=chr(ord("A") + n), look="unknown" if fit is None else look_of(fit.normal), num_matches=int(mask.sum()),
            share=float(mask.mean()), threshold_px=threshold,
            normal=None if fit is None else fit.normal.tolist(),
            normal_sigma_deg=None if fit is None else math.degrees(fit.normal_sigma),
            distance=None if fit is None else fit.distance,
            distance_sigma=None if fit is None else fit.distance_sigma,
            rms_px=math.nan if fit is None else fit.rms * cameras[1].focal, alternatives=normals,
            area_shares=[share[n] for share in shares],
        )
        for n, (_, mask, fit, normals) in enumerate(found)
    ]  # fmt: skip
    return steps, owner


def _normals(h: Array, k1: Array, k2: Array, xn1: Array, pose: Array) -> list[PlaneNormal]:
    """What H alone allows: as a rule two ways the camera may have moved, with a normal each."""
    possible = motions_from_homography(h, k1, k2).possible(xn1)
    rotation = rigid3.rotation_matrix(pose)
    out = []
    for each, normal in zip(possible.poses, possible.normals, strict=True):
        turn = float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(each) @ rotation.T))
        cosine = float(np.clip(each[4:] @ pose[4:], -1.0, 1.0))
        out.append(
            PlaneNormal(normal=normal.tolist(), turn_gap_deg=turn, baseline_gap_deg=math.degrees(math.acos(cosine)))
        )
    return out


def look_of(normal: Array) -> str:
    """How a plane with this normal, away from the camera, looks to whoever holds the camera upright."""
    x, y, z = normal
    if abs(z) > math.cos(math.radians(30.0)):
        return "facing the camera"
    if abs(y) > max(abs(x), abs(z)):
        return "floor" if y > 0 else "ceiling"
    if abs(x) > abs(z):
        return "wall on the right" if x > 0 else "wall on the left"
    # depth is one over n . x: less where that grows
    side = ("left" if x > 0 else "right") if abs(x) > abs(y) else ("top" if y > 0 else "bottom")
    return f"slanting, farther at the {side}"


def _areas(view: View, xy: Array, owner: Ints) -> list[float]:
    """Share of a photograph that each plane takes: of its cells, those in which most matches are on it."""
    size = max(view.camera.width, view.camera.height) / _CELLS
    num = int(owner.max(initial=-1)) + 1
    cells = np.floor(xy / size).astype(np.int64)
    columns = math.ceil(view.camera.width / size)
    place = cells[:, 1] * columns + cells[:, 0]
    total = columns * math.ceil(view.camera.height / size)
    counts = np.zeros((num + 1, total), np.int64)
    inside = (place >= 0) & (place < total)
    np.add.at(counts, (np.where(owner < 0, num, owner)[inside], place[inside]), 1)
    winner = np.where(counts.sum(0) > 0, counts.argmax(0), -1)
    return [float((winner == n).mean()) for n in range(num)]
