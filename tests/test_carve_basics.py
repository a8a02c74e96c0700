"""Views by matrix and by camera, Morton codes, silhouettes of known solids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carving_scenes import around, ball, pixel_centers, silhouette_of
from sfmapp.carve.octree import Octree, codes_of, places_of
from sfmapp.carve.views import project_points, view_of_matrix, views_of_matrices
from sfmapp.errors import InputError


@given(st.lists(st.tuples(*[st.integers(0, 2**21 - 1)] * 3), min_size=1, max_size=20))
def test_a_code_and_its_place_are_one(places: list[tuple[int, int, int]]) -> None:
    at = np.array(places)
    assert (places_of(codes_of(at)) == at).all()
    assert (places_of(codes_of(at) >> np.uint64(3)) == at // 2).all()


def test_a_matrix_is_a_camera_whatever_its_scale_and_sign() -> None:
    rng = np.random.default_rng(0)
    view = around(3)[1]
    assert view.camera is not None
    xyz = rng.uniform(-1.0, 1.0, (50, 3))
    by_camera, by_matrix = np.empty((50, 3)), np.empty((50, 3))
    project_points(view.row, xyz, by_camera)
    for scale in (1.0, -3.7, 1e-6):
        other = view_of_matrix("p", scale * view.camera.k_matrix @ view.outer, view.width, view.height)
        project_points(other.row, xyz, by_matrix)
        assert by_matrix == pytest.approx(by_camera, rel=1e-9)
        assert other.center == pytest.approx(view.center)
        assert other.axis == pytest.approx(view.axis)


def test_a_matrix_without_a_center_is_named() -> None:
    with pytest.raises(InputError, match=r"a\.png.*no finite centre"):
        view_of_matrix("a.png", np.eye(4)[[0, 1, 3]], 10, 10)


def test_the_outline_of_a_ball_is_its_circle() -> None:
    view = around(4, elevation_deg=0.0)[0]
    assert view.camera is not None
    silhouette = silhouette_of(view, ball(1.0))
    # the cone that touches a ball of radius 1 at distance 5 opens by asin(1 / 5)
    radius = view.camera.focal * np.tan(np.arcsin(1.0 / 5.0))
    from_middle = np.linalg.norm(pixel_centers(view) - [view.width / 2, view.height / 2], axis=1)
    # a distance of a mask's outline is off by at most the half diagonal of a pixel, and a pixel's own unevenness
    assert silhouette.distance.ravel() == pytest.approx(radius - from_middle, abs=1.0)


def test_volume_lies_between_its_bounds() -> None:
    full = (np.array([], np.uint64), np.array([0, 7], np.uint64), np.array([8], np.uint64))
    tree = Octree(np.zeros(3), 2.0, 2, full, np.array([9, 10], np.uint64))
    assert tree.volume_bounds() == pytest.approx((2.125, 2.375))
    assert tree.centers(tree.surface) == pytest.approx(np.array([[1.75, 0.25, 0.25], [1.25, 0.75, 0.25]]))


def test_matrices_of_a_mirrored_world_look_ahead() -> None:
    views = around(8)
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    matrices = np.array([view.camera.k_matrix @ view.outer @ mirror for view in views if view.camera is not None])
    out = np.empty((1, 3))
    for sign in (1.0, -1.0):
        for view in views_of_matrices([v.name for v in views], sign * matrices, [(v.width, v.height) for v in views]):
            project_points(view.row, np.zeros((1, 3)), out)
            assert out[0] == pytest.approx([80.0, 60.0, 5.0])
