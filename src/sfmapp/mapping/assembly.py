"""Submaps put together by their seams: one world for those that agree, and who does not.

Placements are those of a graph of similarities over all seams (Strasdat, Montiel and Davison, "Scale drift-aware large
scale monocular SLAM", RSS 2010), each weighed by what both sides know. Where a way around closes badly, the seam that
fits worst is not believed; a submap that nothing holds to the others any more is left out, and its images are free to
be registered from where its neighbours are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping.seams import OFF_SIGMAS, Seam, moved_about
from sfmapp.mapping.submaps import Submap
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

_MAX_STEPS = 20


@dataclass(frozen=True)
class Assembly:
    """Submaps in one world, which is that of the first of them.

    Attributes:
        members: their numbers, ascending. world_from_submap: (n, 8) similarities in the same order.
        seams: those that hold them. misfit: (S,) rms standard deviations by which each does not close.
    """

    members: list[int]
    world_from_submap: Array
    seams: list[Seam]
    misfit: Array


def assemble(submaps: Sequence[Submap], seams: Sequence[Seam]) -> tuple[list[Assembly], list[Seam]]:
    """Submaps in as few worlds as agree, those with most images first, and all seams, with the reason against those
    that are not believed."""
    judged = list(seams)
    while True:
        believed = [seam for seam in judged if not seam.reason]
        worlds = [_placed(members, believed) for members in _groups(submaps, believed)]
        worst = max(
            ((value, seam) for world in worlds for value, seam in zip(world.misfit, world.seams, strict=True)),
            key=lambda entry: entry[0], default=None,
        )  # fmt: skip
        if worst is None or worst[0] <= OFF_SIGMAS:
            return worlds, judged
        value, not_believed = worst
        reason = f"the other seams put them elsewhere, by {value:.1f} standard deviations rms"
        judged = [replace(seam, reason=reason) if seam is not_believed else seam for seam in judged]


def union(assembly: Assembly, submaps: Sequence[Submap], empty: Reconstruction) -> Reconstruction:
    """Poses and cameras of submaps in their one world, without points yet.

    An image that several hold is where that one has it which has most observations of it, and nowhere if they put it at
    different places. Cameras are means of what the submaps say, by the numbers of their images.

    Args:
        empty: all images of the run, their cameras and tracks; nothing of it is changed.
    """
    out = empty.copy()
    most = np.zeros(len(out.image_names), np.int64)
    params = [np.zeros_like(camera.params) for camera in out.cameras]
    counts = np.zeros(len(out.cameras), np.int64)
    for number, sim in zip(assembly.members, assembly.world_from_submap, strict=True):
        submap = submaps[number]
        model, registered = submap.model, submap.model.registered_idx
        support = np.bincount(model.tracks.obs_image_idx[model.obs_is_inlier], minlength=len(model.image_names))
        whose = submap.part.image_idx[registered]
        better = support[registered] > most[whose]
        most[whose[better]] = support[registered[better]]
        out.cam_from_world[whose[better]] = similarity.transform_poses(sim, model.cam_from_world[registered[better]])
        for c, n in enumerate(np.bincount(model.image_camera_idx[registered], minlength=len(model.cameras))):
            params[submap.part.camera_idx[c]] += n * model.cameras[c].params
            counts[submap.part.camera_idx[c]] += n
    for seam in assembly.seams:
        out.cam_from_world[seam.image_idx[seam.is_off]] = np.nan
    for c in np.flatnonzero(counts).tolist():
        out.cameras[c] = replace(out.cameras[c], params=params[c] / counts[c])
    return out


def _groups(submaps: Sequence[Submap], seams: Sequence[Seam]) -> list[list[int]]:
    """Numbers of the submaps that seams hold together, those with most images first."""
    group = list(range(len(submaps)))
    for seam in seams:
        a, b = (group[n] for n in seam.submaps)
        group = [min(a, b) if g in (a, b) else g for g in group]
    found = [
        [n for n in range(len(submaps)) if group[n] == g and len(submaps[n].registered_idx)] for g in sorted(set(group))
    ]

    def num_images(members: list[int]) -> int:
        return len(np.unique(np.concatenate([submaps[n].registered_idx for n in members])))

    return sorted((members for members in found if members), key=lambda members: (-num_images(members), members))


def _placed(members: list[int], seams: Sequence[Seam]) -> Assembly:
    """Where members lie in the world of the first of them."""
    own = [seam for seam in seams if seam.submaps[0] in members]
    place = {n: k for k, n in enumerate(members)}
    ends = [(place[seam.submaps[0]], place[seam.submaps[1]]) for seam in own]
    sims = _along_tree(len(members), own, ends)
    num = 7 * (len(members) - 1)
    # parts drift by little, so that slopes stay what they are
    slopes = [_slope(seam, sims[a], sims[b]) for seam, (a, b) in zip(own, ends, strict=True)]
    normal = np.zeros((num + 7, num + 7))
    for seam, slope, (a, b) in zip(own, slopes, ends, strict=True):
        at = np.concatenate([7 * a + np.arange(7), 7 * b + np.arange(7)])
        normal[np.ix_(at, at)] += slope.T @ seam.information @ slope
    scale = 1.0 / np.sqrt(np.diag(normal)[7:])
    for _ in range(_MAX_STEPS if num else 0):
        gradient = np.zeros(num + 7)
        for seam, slope, (a, b) in zip(own, slopes, ends, strict=True):
            at = np.concatenate([7 * a + np.arange(7), 7 * b + np.arange(7)])
            gradient[at] += slope.T @ seam.information @ _error(seam, sims[a], sims[b])
        step = -scale * np.linalg.solve(normal[7:, 7:] * np.outer(scale, scale), scale * gradient[7:])
        for k in range(1, len(members)):
            sims[k] = _stepped(sims[k], step[7 * k - 7 : 7 * k])
        if np.abs(step).max() < 1e-10:
            break
    misfit = np.array([_misfit(seam, sims[a], sims[b]) for seam, (a, b) in zip(own, ends, strict=True)])
    return Assembly(members, sims, own, misfit)


def _along_tree(num: int, seams: Sequence[Seam], ends: Sequence[tuple[int, int]]) -> Array:
    """(num, 8) placements along the seams that most points speak for, from the first."""
    sims = np.tile(similarity.IDENTITY, (num, 1))
    is_placed = np.arange(num) == 0
    while not is_placed.all():
        at = [n for n, (a, b) in enumerate(ends) if is_placed[a] != is_placed[b]]
        best = max(at, key=lambda n: (seams[n].num_seen, -n))
        (a, b), sim = ends[best], seams[best].first_from_second
        if is_placed[a]:
            sims[b] = similarity.compose(sims[a], sim)
        else:
            sims[a] = similarity.compose(sims[b], similarity.inverse(sim))
        is_placed[[a, b]] = True
    return sims


def _error(seam: Seam, first: Array, second: Array) -> Array:
    """(7,) what takes a seam's similarity to that of two placements: turn, shift in sizes, log of the scale."""
    found = similarity.compose(similarity.inverse(first), second)
    apart = similarity.compose(found, similarity.inverse(seam.first_from_second))
    shift = (similarity.apply(apart, seam.middle) - seam.middle) / seam.size
    return np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(apart)), shift, [np.log(apart[7])]])


def _stepped(sim: Array, step: Array) -> Array:
    """A placement that is moved by a turn, a shift and a scale of its own frame, in units of that frame."""
    return similarity.compose(sim, moved_about(similarity.IDENTITY, step, np.zeros(3), 1.0))


def _slope(seam: Seam, first: Array, second: Array) -> Array:
    """(7, 14) of the error with both placements, by differences."""
    steps = [h * axis for axis in np.eye(7) for h in (1e-6, -1e-6)]
    errors = np.array(
        [_error(seam, _stepped(first, step), second) for step in steps]
        + [_error(seam, first, _stepped(second, step)) for step in steps]
    )
    slope: Array = (errors[::2] - errors[1::2]).T / 2e-6
    return slope


def _misfit(seam: Seam, first: Array, second: Array) -> float:
    error = _error(seam, first, second)
    return float(np.sqrt(max(float(error @ seam.information @ error), 0.0) / 7.0))
