"""Outer tangents of silhouettes: exact where all is right, and a camera or a mask that is wrong is told by them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from carving_scenes import Solid, around, ball, both, box, mask_of, ring
from sfmapp.carve.outlines import Silhouette, coverage_of_mask, signed_distance
from sfmapp.carve.tangency import Contradicted, Tangents, are_in_agreement, find_contradicted, is_contradictory
from sfmapp.carve.views import View, view_of_camera
from sfmapp.geometry import rigid3
from test_carve_consistency import turned_about

Mask = NDArray[np.bool_]
Array = NDArray[np.float64]
NUM, WRONG = 8, 3
VIEWS = around(NUM, width=200, height=150, elevation_deg=30.0)
LUMPS = both(ball(0.5, (0.3, 0.1, 0.2)), box((0.2, 0.7, 0.3)), ball(0.4, (-0.4, 0.2, -0.3)))
MASKS = [mask_of(view, LUMPS) for view in VIEWS]


def silhouette(mask: Mask) -> Silhouette:
    return Silhouette(signed_distance(coverage_of_mask(mask)), outline_sigma_px=0.2)


SILHOUETTES = [silhouette(mask) for mask in MASKS]


def moved(view: View, to: Array) -> View:
    """Another place, the same direction of looking."""
    assert view.camera is not None
    assert view.cam_from_world is not None
    rotation = rigid3.rotation_matrix(view.cam_from_world)
    return view_of_camera(view.name, view.camera, np.concatenate([view.cam_from_world[:4], -rotation @ to]))


def contradicted(views: list[View], silhouettes: list[Silhouette], most: int = 1) -> tuple[list[Contradicted], bool]:
    return find_contradicted(Tangents(views, silhouettes), range(len(views)), most)


def with_view(view: View) -> list[View]:
    return [view if i == WRONG else each for i, each in enumerate(VIEWS)]


def with_mask(mask: Mask) -> list[Silhouette]:
    return [silhouette(mask) if i == WRONG else each for i, each in enumerate(SILHOUETTES)]


@pytest.mark.parametrize("solid", [LUMPS, ring(), box()])
def test_tangents_of_all_pairs_coincide(solid: Solid) -> None:
    silhouettes = [silhouette(mask_of(view, solid)) for view in VIEWS]
    tangents = Tangents(VIEWS, silhouettes)
    miss = tangents.miss[~np.isnan(tangents.miss)]
    # opposite views may have the axis through both of them in the object
    assert len(miss) >= NUM * (NUM - 2) * 2
    assert np.sqrt(np.mean(miss**2)) < 0.4
    assert np.abs(miss).max() < 1.2
    assert contradicted(VIEWS, silhouettes) == ([], True)
    assert not is_contradictory(tangents, range(NUM))


def test_a_silhouette_that_is_wider_by_two_pixels_misses_by_two_pixels() -> None:
    coverage = replace(SILHOUETTES[WRONG], distance=SILHOUETTES[WRONG].distance + np.float32(2.0))
    found = Tangents(VIEWS, [coverage if i == WRONG else each for i, each in enumerate(SILHOUETTES)])
    miss = found.miss[WRONG] - Tangents(VIEWS, SILHOUETTES).miss[WRONG]
    miss = miss[~np.isnan(miss)]
    # along the way to the outline, which is longer at corners than two pixels
    assert 1.9 < np.median(miss) < 2.1
    assert miss.min() > 1.7
    assert miss.max() < 3.0
    # seen from the other end of the baseline the two planes change places
    assert np.allclose(found.miss[WRONG], -found.miss[:, WRONG, ::-1], equal_nan=True)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("degrees", [-5.0, 5.0])
def test_a_turned_camera_is_told_with_its_angle(axis: int, degrees: float) -> None:
    (found,), agree = contradicted(with_view(turned_about(VIEWS[WRONG], degrees, np.eye(3)[axis])), SILHOUETTES)
    assert agree
    assert found.view == WRONG
    assert found.turned_deg is not None
    assert found.sigma_deg is not None
    assert 0.005 < found.sigma_deg < 1.0
    assert abs(found.turned_deg - 5.0) < 3.0 * found.sigma_deg


def test_a_roll_that_changes_no_outline_is_not_told() -> None:
    silhouettes = [silhouette(mask_of(view, ball(0.8))) for view in VIEWS]
    assert contradicted(with_view(turned_about(VIEWS[WRONG], 5.0, np.eye(3)[2])), silhouettes) == ([], True)


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_moved_into_the_volume_is_told(seed: int) -> None:
    at = np.random.default_rng(seed).uniform(-0.2, 0.2, 3)
    (found,), agree = contradicted(with_view(moved(VIEWS[WRONG], at)), SILHOUETTES)
    assert (found.view, found.turned_deg, agree) == (WRONG, None, True)
    assert found.share > 0.7


@pytest.mark.parametrize("share", [0.1, -0.1])
def test_a_camera_nearer_or_farther_than_it_was_is_told(share: float) -> None:
    (found,), _ = contradicted(with_view(moved(VIEWS[WRONG], (1.0 - share) * VIEWS[WRONG].center)), SILHOUETTES)
    assert (found.view, found.turned_deg) == (WRONG, None)


def test_masks_of_something_else_are_told_and_those_that_spill_in_parts_are_not() -> None:
    mask = MASKS[WRONG]
    half = mask.copy()
    half[:, int(np.median(np.nonzero(mask)[1])) :] = False
    for wrong in (mask[::-1].copy(), half):
        (found,), _ = contradicted(VIEWS, with_mask(wrong))
        assert found.view == WRONG
    spilt = cv2.circle(mask.astype(np.uint8), (130, 60), 22, 1, -1) > 0
    assert 1.05 * mask.sum() < spilt.sum() < 1.5 * mask.sum()
    found_none, _ = contradicted(VIEWS, with_mask(spilt))
    assert found_none == []


def test_nobody_is_blamed_where_it_may_be_one_as_well_as_another() -> None:
    # two of four are wrong
    views = [turned_about(view, 6.0, np.eye(3)[i % 2]) if i < 2 else view for i, view in enumerate(VIEWS[:4])]
    assert contradicted(views, SILHOUETTES[:4]) == ([], False)
    # one of three is: they contradict each other, and three others that could tell are not there
    tangents = Tangents(views[1:4], SILHOUETTES[1:4])
    assert find_contradicted(tangents, range(3), 1)[0] == []
    assert is_contradictory(tangents, range(3))
    assert not is_contradictory(Tangents(VIEWS[:3], SILHOUETTES[:3]), range(3))
    # more than one in ten
    views = [turned_about(view, 6.0, np.eye(3)[0]) if i in (1, 4) else view for i, view in enumerate(VIEWS)]
    assert contradicted(views, SILHOUETTES) == ([], False)
    assert sorted(each.view for each in contradicted(views, SILHOUETTES, 2)[0]) == [1, 4]


def test_what_goes_on_beyond_a_picture_contradicts_nobody_by_being_narrower() -> None:
    cut = [mask[:, :110].copy() for mask in MASKS]
    views = [replace(view, width=110) for view in VIEWS]
    assert any(mask[:, -1].any() for mask in cut)
    silhouettes = [silhouette(mask) for mask in cut]
    tangents = Tangents(views, silhouettes)
    is_open = np.array([mask[:, -1].any() for mask in cut])
    assert np.isnan(tangents.miss[np.ix_(is_open, is_open)]).all()
    assert are_in_agreement(tangents, range(NUM))
    assert contradicted(views, silhouettes)[0] == []
