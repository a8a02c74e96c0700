"""Collins' feature-occupancy volume: exact cameras and edges, and what chance does."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from carving_scenes import around
from sfmapp.carve.feature_occupancy import FeatureOccupancy, sweep_features
from sfmapp.carve.views import View, project_points
from sfmapp.errors import InputError

LOW, CELL, SHAPE = np.array([-0.6, -0.6, -0.6]), 0.04, (30, 30, 30)


def seen_at(view: View, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.empty((len(xyz), 3))
    project_points(view.row, np.ascontiguousarray(xyz, np.float64), out)
    return out


def edges_of(views: list[View], xyz: NDArray[np.float64]) -> list[NDArray[np.uint8]]:
    pictures = []
    for view in views:
        u, v = seen_at(view, xyz)[:, :2].astype(int).T
        picture = np.zeros((view.height, view.width), np.uint8)
        picture[v, u] = 255
        pictures.append(picture)
    return pictures


def swept(views: list[View], edges: list[NDArray[np.uint8]]) -> FeatureOccupancy:
    return sweep_features(views, edges, LOW, CELL, SHAPE)


def test_cells_of_points_get_all_votes_and_next_to_no_others_are_taken() -> None:
    views = around(12)
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    found = swept(views, edges_of(views, xyz))
    x, y, z = np.floor((xyz - LOW) / CELL).astype(int).T
    assert (found.votes[z, y, x] == found.seen[z, y, x]).all()
    assert found.is_feature[z, y, x].all()
    nearest = np.linalg.norm(found.points[:, None] - xyz, axis=2).min(axis=1)
    # the middle of a cell is half a diagonal, 0.9 cells, from its corner
    assert np.quantile(nearest, 0.9) < 1.8 * CELL
    assert len(found.points) < 8 * len(xyz)


def test_votes_are_those_of_the_boxes_about_the_corners() -> None:
    views = around(6)
    edges = edges_of(views, np.random.default_rng(1).uniform(-0.5, 0.5, (300, 3)))
    found = swept(views, edges)
    corners = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) * CELL
    for z, y, x in np.random.default_rng(2).integers(0, 30, (60, 3)):
        votes = 0
        for view, edge in zip(views, edges, strict=True):
            pixel = seen_at(view, LOW + CELL * np.array([x, y, z]) + corners)[:, :2]
            (left, top), (right, bottom) = (np.floor(ends(axis=0)).astype(int) for ends in (pixel.min, pixel.max))
            votes += bool(edge[top : bottom + 1, left : right + 1].any())
        assert found.votes[z, y, x] == votes


def test_edges_that_are_anywhere_fill_hardly_a_cell() -> None:
    views, rng = around(10), np.random.default_rng(3)
    filled = []
    for share in (0.01, 0.05):
        edges = [(rng.random((view.height, view.width)) < share).astype(np.uint8) for view in views]
        found = swept(views, edges)
        filled.append(len(found.points))
        # lines of sight do meet
        assert (found.votes >= 3).sum() > 20
    # one is stated; neighbouring cells share pixels
    assert max(filled) <= 8


def test_what_cannot_vote_is_named() -> None:
    views = around(3)
    with pytest.raises(InputError, match="2 photographs"):
        swept(views[:2], [np.zeros((120, 160), np.uint8)] * 2)
    with pytest.raises(InputError, match="edges of"):
        swept(views, [np.zeros((10, 10), np.uint8)] * 3)
