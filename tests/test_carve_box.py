"""The box of an object by its silhouettes: solids of exact shape, and what can be wrong with cameras and masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from carving_scenes import around, ball, box, silhouette_of
from sfmapp.carve.box import cameras_inside, find_box, user_box
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View, view_of_camera
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3


@pytest.fixture(scope="module")
def scene() -> tuple[list[View], list[Silhouette]]:
    views = around(10, width=96, height=72)
    return views, [silhouette_of(view, box()) for view in views]


def test_the_box_holds_the_solid_and_little_more(scene: tuple[list[View], list[Silhouette]]) -> None:
    found = find_box(*scene)
    assert found.told_by == "silhouettes"
    # corners of a turned cube may lie outside along z, which cameras see from 20 degrees above and 10 below
    assert (found.low <= [-0.8, -0.6, -0.5]).all()
    assert (found.high >= [0.8, 0.6, 0.5]).all()
    assert (found.high - found.low <= 1.45 * np.array([1.6, 1.2, 1.0])).all()
    low, side = found.cube()
    assert (low < found.low).all()
    assert (low + side > found.high).all()
    assert cameras_inside(found, scene[0]) == []


def test_a_camera_that_is_turned_cuts_nothing_off(scene: tuple[list[View], list[Silhouette]]) -> None:
    views, silhouettes = scene
    pose = views[3].cam_from_world
    assert pose is not None
    assert views[3].camera is not None
    turn = np.concatenate([rigid3.quaternion(_about_y(np.radians(5.0))), np.zeros(3)])
    turned = view_of_camera(views[3].name, views[3].camera, rigid3.compose(turn, pose))
    found = find_box([*views[:3], turned, *views[4:]], silhouettes)
    assert (found.low <= [-0.8, -0.6, -0.5]).all()
    assert (found.high >= [0.8, 0.6, 0.5]).all()


def _about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def test_a_silhouette_elsewhere_is_named(scene: tuple[list[View], list[Silhouette]]) -> None:
    views, silhouettes = scene
    away = silhouette_of(views[2], ball(0.3, (0.0, 0.0, 1.4)))
    assert find_box(views, [*silhouettes[:2], away, *silhouettes[3:]]).apart == (views[2].name,)
    half = [silhouette_of(view, ball(0.3, (0.0, 0.0, 1.4))) for view in views[:5]]
    with pytest.raises(InputError, match="no place in common"):
        find_box(views, half + silhouettes[5:])


def test_what_goes_beyond_the_pictures_leaves_the_box_open(scene: tuple[list[View], list[Silhouette]]) -> None:
    views, silhouettes = scene
    everywhere = [replace(s, distance=np.full_like(s.distance, np.inf)) for s in silhouettes]
    with pytest.raises(InputError, match="found it in 0 of 10"):
        find_box(views, everywhere)
    # a column from below the pictures to above them, seen by cameras on one level: bounded across, and not along
    views = around(6, width=64, height=48, elevation_deg=0.0)
    column = [silhouette_of(view, box((0.4, 0.4, 9.0))) for view in views]
    with pytest.raises(InputError, match="leave open"):
        find_box(views, column)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))
    assert find_box(views, column, points).told_by == "points"


def test_bad_boxes_and_cameras_inside(scene: tuple[list[View], list[Silhouette]]) -> None:
    views, silhouettes = scene
    assert cameras_inside(user_box([0, -9, -9], [9, 9, 9]), views) == [v.name for v in views if v.center[0] >= 0.0]
    with pytest.raises(InputError, match="lower and an upper corner"):
        user_box([0, 0, 0], [1, -1, 1])
    with pytest.raises(InputError, match="from one place"):
        find_box([views[0], views[0]], silhouettes[:2])
