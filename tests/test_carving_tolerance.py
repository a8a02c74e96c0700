"""Silhouettes with holes: found by what all others show, and the hull as if they were not there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from carving_scenes import Solid, around, ball, both, box, pixel_centers, ring, silhouette_of, without
from rendered_worlds.lit_solids import around as all_round
from sfmapp.carve.hull import hull_of
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.tolerance import doubt_holes
from sfmapp.carve.views import View, project_points, view_of_camera

LOW, SIDE = np.full(3, -1.3), 2.6
TWO = both(ball(0.45, (0.5, 0.0, 0.3)), box((0.3, 0.5, 0.6), (-0.4, 0.0, 0.0)))
SLOTTED = without(box(), box((0.2, 2.0, 0.2)))
LEGS = both(ball(0.6), box((0.9, 0.25, 0.2)))


def holed(silhouette: Silhouette, at: tuple[float, float], share: float = 0.05) -> Silhouette:
    """Without a disk around a pixel that takes away a share of its area."""
    height, width = silhouette.distance.shape
    centers = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    away = np.linalg.norm(centers - at, axis=-1)
    inside = silhouette.inside
    radius = np.sort(away[inside])[int(share * inside.sum())]
    inside &= away > radius
    distance = distance_transform_edt(inside) - distance_transform_edt(~inside)
    return Silhouette((distance - 0.5 * np.sign(distance)).astype(np.float32))


def agreement(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / (a | b).sum())


def inside(views: list[View], silhouettes: list[Silhouette]) -> NDArray[np.bool_]:
    at = LOW[0] + (np.arange(48) + 0.5) / 48 * SIDE
    grid = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(hull_of(views, silhouettes).distance(grid) > 0.0)


@pytest.mark.parametrize(("solid", "at"), [(ball(), (80.0, 60.0)), (ball(), (92.0, 66.0)), (LEGS, (92.0, 66.0))])
def test_holes_are_named_and_carve_nothing(solid: Solid, at: tuple[float, float]) -> None:
    views = around(20, elevation_deg=35.0)
    clean = [silhouette_of(view, solid) for view in views]
    spoiled = [holed(s, at) if i in (3, 11) else s for i, s in enumerate(clean)]
    mended, report = doubt_holes(views, spoiled, LOW, SIDE)
    assert [one.name for one in report.doubted] == ["view_003.png", "view_011.png"]
    whole, strict, tolerant = (inside(views, s) for s in (clean, spoiled, mended))
    assert agreement(whole, strict) < 0.97
    assert agreement(whole, tolerant) > 0.99
    # what is not known is the hole and its rim
    known = mended[3].known
    assert known is not None
    away = np.linalg.norm(pixel_centers(views[3]) - at, axis=1).reshape(known.shape)
    assert away[~known].max() < 40.0
    assert (~known).mean() < 0.06


def test_holes_that_cut_thin_parts_are_told_by_those_that_lack_them() -> None:
    # a rod of four pixels to either side is thinner than what some clean silhouettes take away alone
    solid = both(ball(0.6), box((1.0, 0.08, 0.08)))
    views = around(12, elevation_deg=35.0)
    clean = [silhouette_of(view, solid) for view in views]
    at = np.empty((1, 3))
    project_points(views[2].row, np.array([[0.8, 0.0, 0.0]]), at)
    spoiled = [holed(s, (at[0, 0], at[0, 1]), 0.07) if k == 2 else s for k, s in enumerate(clean)]
    mended, report = doubt_holes(views, spoiled, LOW, SIDE)
    assert [one.name for one in report.doubted] == ["view_002.png"]
    assert report.doubted[0].lacked_by >= 2
    assert report.doubted[0].thickness < 0.1
    # of the rod beyond the ball
    whole, strict, tolerant = (inside(views, s).reshape(48, 48, 48)[36:] for s in (clean, spoiled, mended))
    assert agreement(whole, strict) < 0.7
    assert agreement(whole, tolerant) > 0.95


@pytest.mark.parametrize(("num", "solid"), [(8, TWO), (12, ring()), (20, LEGS), (20, SLOTTED)])
def test_good_silhouettes_are_left_alone(num: int, solid: Solid) -> None:
    views = around(num, elevation_deg=35.0)
    clean = [silhouette_of(view, solid) for view in views]
    mended, report = doubt_holes(views, clean, LOW, SIDE)
    assert not report.doubted
    assert all(a is b for a, b in zip(mended, clean, strict=True))


def test_an_arch_in_an_outline_that_others_do_not_contradict_is_left() -> None:
    # one of twelve views on all sides looks along the arch, and takes away far more alone than any other does
    rig = all_round(12, 1, 160)
    views = [view_of_camera(f"view_{i:03d}.png", rig.camera, pose) for i, pose in enumerate(rig.poses)]
    house = without(box((0.62, 0.5, 0.5)), box((0.2, 0.8, 0.3), (0.0, 0.0, -0.4)))
    clean = [silhouette_of(view, house) for view in views]
    mended, report = doubt_holes(views, clean, LOW, SIDE)
    assert not report.doubted
    # where a mask has a hole beside it, that alone is named
    spoiled = [holed(s, (80.0, 60.0)) if i == 10 else s for i, s in enumerate(clean)]
    mended, report = doubt_holes(views, spoiled, LOW, SIDE)
    assert [one.name for one in report.doubted] == ["view_010.png"]
    assert agreement(inside(views, clean), inside(views, spoiled)) < 0.98
    assert agreement(inside(views, clean), inside(views, mended)) > 0.99
