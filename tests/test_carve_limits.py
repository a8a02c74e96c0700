"""What a carved surface cannot tell, on solids of exact shape."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from carving_scenes import Solid, around, ball, box, ring, silhouette_of, without
from sfmapp.carve.hull import hull_of
from sfmapp.carve.isosurface import surface_of
from sfmapp.carve.limits import OUTLINES, UNSEEN, Known, LimitsReport, find_known, find_limits
from sfmapp.carve.options import CarveOptions
from sfmapp.carve.space_carving import carve
from sfmapp.carve.views import View, view_of_camera
from sfmapp.geometry import rigid3
from sfmapp.scene.mesh import Mesh

LOW, SIDE, CELLS = np.array([-1.28, -1.28, -1.28]), 2.56, 64


def carved(solid: Solid, views: list[View]) -> tuple[Mesh, Known, LimitsReport]:
    silhouettes = [silhouette_of(view, solid) for view in views]
    tree, _ = carve(views, silhouettes, LOW, SIDE, CarveOptions(cells=CELLS))
    mesh = surface_of(tree, hull_of(views, silhouettes).distance)
    known = find_known(mesh, views)
    return mesh, known, find_limits(mesh, mesh, views, silhouettes, known)


@pytest.mark.parametrize(
    ("solid", "volume", "area"),
    [
        (ball(0.9), 4.0 / 3.0 * np.pi * 0.9**3, 4.0 * np.pi * 0.9**2),
        (box(), 1.6 * 1.2 * 1.0, 2 * (1.6 * 1.2 + 1.6 + 1.2)),
        (ring(0.8, 0.25), 2 * np.pi**2 * 0.8 * 0.25**2, 4 * np.pi**2 * 0.8 * 0.25),
    ],
)
def test_bounds_hold_and_are_no_looser_than_silhouettes_are(solid: Solid, volume: float, area: float) -> None:
    _, _, limits = carved(solid, around(16, 5.0, 160, 120, 35.0))
    assert volume < limits.volume_high < 1.5 * volume
    assert 0.25 * area < limits.area_low < area


def test_of_a_ball_seen_from_above_the_underside_is_unseen_and_the_next_view_from_below() -> None:
    views = around(16, 5.0, 120, 90, 45.0)[::2]
    mesh, known, limits = carved(ball(0.9), views)
    up = known.normals[:, 2]
    assert (known.kind[up > 0.5] == OUTLINES).mean() > 0.95
    assert (known.kind[up < -0.9] == UNSEEN).mean() > 0.9
    assert limits.patches_share == 0.0
    assert limits.outlines_share + limits.unseen_share == pytest.approx(1.0)
    assert limits.hollows[0].faces[2] < -0.9
    assert limits.hollows[0].at[2] < -0.2
    place = np.array(limits.next_views[0].place)
    assert place[2] / np.linalg.norm(place) < -0.3
    gains = [view.gain_share for view in limits.next_views]
    assert gains == sorted(gains, reverse=True)
    assert len(mesh.faces) == len(known.kind)


def test_suggested_views_see_more_of_what_was_unseen_than_others_do() -> None:
    for solid in (box((0.7, 0.5, 0.4)), without(ball(0.9), box((0.5, 1.0, 0.5), (0.7, 0.0, -0.5))), ring(0.8, 0.25)):
        views = around(12, 5.0, 100, 80, 20.0)[:4]
        mesh, known, limits = carved(solid, views)
        candidates = [view for e in (-60.0, 0.0, 60.0) for view in around(8, 5.0, 100, 80, e)[::2]]
        best = towards(np.array(limits.next_views[0].place))
        gains = [unseen_share(known) - unseen_share(find_known(mesh, [*views, view])) for view in (best, *candidates)]
        assert gains[0] > 1.3 * np.median(gains[1:])
        assert gains[0] > 0.9 * max(gains)


def unseen_share(known: Known) -> float:
    return float(known.areas[known.kind == UNSEEN].sum() / known.areas.sum())


def towards(place: NDArray[np.float64]) -> View:
    """A view like those of ``around`` from a place."""
    distance = float(np.linalg.norm(place))
    elevation = float(np.degrees(np.arcsin(place[2] / distance)))
    turn = np.arctan2(place[1], place[0])
    model = around(1, distance, 100, 80, elevation)[0]
    about = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    assert model.camera is not None
    rotation = model.outer[:, :3] @ about.T
    pose = np.concatenate([rigid3.quaternion(rotation), model.outer[:, 3]])
    return view_of_camera("next.png", model.camera, pose)
