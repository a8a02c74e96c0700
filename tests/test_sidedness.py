"""Triangles of neighbouring points, from the same side and from the other one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from sfmapp.geometry.sidedness import triangles_kept


def test_a_projective_view_of_a_plane_keeps_every_triangle_and_its_mirror_image_none():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 1000, (200, 2))
    h = np.array([[0.8, 0.3, 50.0], [-0.4, 1.1, 20.0], [2e-4, 1e-4, 1.0]])
    seen = np.column_stack([xy, np.ones(200)]) @ h.T
    seen = seen[:, :2] / seen[:, 2:]
    kept, total = triangles_kept(xy, seen)
    assert kept == total > 300
    assert triangles_kept(xy, seen * [-1.0, 1.0]) == (0, total)


def test_triangles_are_those_of_qhull():
    xy = np.random.default_rng(2).normal(0, 1000, (2000, 2))
    kept, total = triangles_kept(xy, xy)
    # but for some at the hull, where triangles are slivers, and in ties of single precision
    assert kept == total
    assert total == pytest.approx(len(Delaunay(xy).simplices), rel=0.01)


def test_points_that_have_nothing_to_do_with_each_other_keep_half():
    rng = np.random.default_rng(1)
    kept, total = triangles_kept(*rng.uniform(0, 1000, (2, 3000, 2)))
    # as independent as there are points
    assert kept / total == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(3000))


@pytest.mark.parametrize(
    "xy", [np.zeros((0, 2)), np.eye(2), np.arange(10.0)[:, None] * [1.0, 2.0], np.ones((9, 2))], ids=len
)
def test_points_without_triangles_say_nothing(xy):
    assert triangles_kept(xy, xy) == (0, 0)
