"""Silhouettes with holes: found by what all others show, and the hull as if they were not there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from carving_scenes import Solid, around, ball, both, box, pixel_centers, silhouette_of
from sfmapp.carve.hull import hull_of
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.tolerance import doubt_holes
from sfmapp.carve.views import View

LOW, SIDE = np.full(3, -1.3), 2.6
TWO = both(ball(0.45, (0.5, 0.0, 0.3)), box((0.3, 0.5, 0.6), (-0.4, 0.0, 0.0)))
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


def inside(views: list[View], silhouettes: list[Silhouette]) -> NDArray[np.bool_]:
    at = LOW[0] + (np.arange(48) + 0.5) / 48 * SIDE
    grid = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(hull_of(views, silhouettes).distance(grid) > 0.0)


@pytest.mark.parametrize("solid", [ball(), LEGS])
@pytest.mark.parametrize("at", [(80.0, 60.0), (92.0, 66.0)])
def test_holes_are_named_and_carve_nothing(solid: Solid, at: tuple[float, float]) -> None:
    views = around(20, elevation_deg=35.0)
    clean = [silhouette_of(view, solid) for view in views]
    spoiled = [holed(s, at) if i in (3, 11) else s for i, s in enumerate(clean)]
    mended, report = doubt_holes(views, spoiled, LOW, SIDE)
    assert [one.name for one in report.doubted] == ["view_003.png", "view_011.png"]
    whole, strict, tolerant = (inside(views, s) for s in (clean, spoiled, mended))
    assert (whole & strict).sum() < 0.97 * (whole | strict).sum()
    assert (whole & tolerant).sum() > 0.99 * (whole | tolerant).sum()
    # what is not known is the hole and its rim
    known = mended[3].known
    assert known is not None
    away = np.linalg.norm(pixel_centers(views[3]) - at, axis=1).reshape(known.shape)
    assert away[~known].max() < 40.0
    assert (~known).mean() < 0.06


@pytest.mark.parametrize("solid", [ball(), LEGS, TWO])
@pytest.mark.parametrize("num", [8, 20])
def test_good_silhouettes_are_left_alone(solid: Solid, num: int) -> None:
    views = around(num, elevation_deg=35.0)
    clean = [silhouette_of(view, solid) for view in views]
    mended, report = doubt_holes(views, clean, LOW, SIDE)
    assert not report.doubted
    assert all(a is b for a, b in zip(mended, clean, strict=True))
