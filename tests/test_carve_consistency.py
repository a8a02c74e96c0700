"""Silhouettes against each other: what is clean stays so, spills, holes and turned cameras are found and named."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from carving_scenes import Solid, around, ball, both, box, mask_of, ring, without
from sfmapp.carve import consistency
from sfmapp.carve.consistency import Verdict, compare
from sfmapp.carve.masks_report import PhotographMask
from sfmapp.carve.outlines import Silhouette, coverage_of_mask, signed_distance
from sfmapp.carve.silhouettes import told_of_repairs
from sfmapp.carve.views import View, view_of_camera
from sfmapp.events import Events
from sfmapp.geometry import rigid3

Mask = NDArray[np.bool_]
VIEWS = around(12, width=120, height=90)
TURNED, HOLED, SPILT = 3, 5, 8


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of two pixels, as those of photographs are of several."""
    monkeypatch.setattr(consistency, "_CELLS", 60)


def lumps(seed: int) -> Solid:
    """Four boxes and balls that run into each other."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(4):
        at = tuple(rng.uniform(-0.6, 0.6, 3))
        parts.append(ball(rng.uniform(0.25, 0.5), at) if k % 2 else box(tuple(rng.uniform(0.15, 0.5, 3)), at))
    return both(*parts)


SOLIDS = {
    "bitten": without(box(), ball(0.5, (0.6, 0.3, 0.4))),
    "ring": ring(),
    "lumps": lumps(2),
}
MASKS = {name: [mask_of(view, solid) for view in VIEWS] for name, solid in SOLIDS.items()}


def silhouette(mask: Mask, source: str = "mask") -> Silhouette:
    return Silhouette(signed_distance(coverage_of_mask(mask)), source=source)


def verdicts(views: list[View], masks: list[Mask], source: str = "mask") -> list[Verdict]:
    return compare(views, [silhouette(mask, source) for mask in masks], repairs=True, workers=2, events=Events())


def turned(view: View, degrees: float, seed: int) -> View:
    """About the camera's own centre, around an axis drawn."""
    return turned_about(view, degrees, np.random.default_rng(seed).normal(size=3))


def turned_about(view: View, degrees: float, axis: ArrayLike) -> View:
    """About the camera's own centre, around an axis of its frame: x to the right, y down, z ahead."""
    assert view.camera is not None
    assert view.cam_from_world is not None
    axis = np.asarray(axis, np.float64)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    rotation = turn @ rigid3.rotation_matrix(view.cam_from_world)
    return view_of_camera(
        view.name, view.camera, np.concatenate([rigid3.quaternion(rotation), turn @ view.cam_from_world[4:]])
    )


def disk(mask: Mask, share: float, *, within: bool, seed: int) -> Mask:
    """A disk of a share of a mask's area, deep inside it or over its edge."""
    radius = np.sqrt(share * mask.sum() / np.pi)
    deep = distance_transform_edt(mask if within else ~mask)
    fits = (deep > min(1.2 * radius, 0.95 * deep.max())) if within else ((deep > 0) & (deep < 0.5 * radius))
    row, column = np.argwhere(fits)[np.random.default_rng(seed).integers(fits.sum())]
    rows, columns = np.indices(mask.shape)
    return (rows - row) ** 2 + (columns - column) ** 2 <= radius**2


def agreement(a: Mask, b: Mask) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("name", SOLIDS)
def test_clean_silhouettes_are_left_alone(name: str) -> None:
    for verdict, mask in zip(verdicts(VIEWS, MASKS[name]), MASKS[name], strict=True):
        assert (verdict.problem, verdict.spilled, verdict.filled) == ("", 0.0, 0.0)
        assert np.array_equal(verdict.silhouette.distance, silhouette(mask).distance)


@pytest.mark.parametrize(("name", "seed"), [("bitten", 1), ("ring", 2), ("lumps", 4)])
def test_one_camera_turned_by_five_degrees_is_named_and_no_other(name: str, seed: int) -> None:
    views = list(VIEWS)
    views[TURNED] = turned(views[TURNED], 5.0, seed)
    found = verdicts(views, MASKS[name])
    assert [i for i, verdict in enumerate(found) if verdict.problem] == [TURNED]
    angle = found[TURNED].turned_deg
    assert angle is not None
    assert 3.5 < angle < 6.5
    known = found[TURNED].silhouette.known
    assert known is not None
    assert not known.any()
    assert all(verdict.spilled == verdict.filled == 0.0 for i, verdict in enumerate(found) if i != TURNED)


@pytest.mark.usefixtures("coarse")
def test_eight_views_name_a_camera_that_is_turned_about_any_axis() -> None:
    views = around(8, width=240, height=180)
    masks = [mask_of(view, SOLIDS["lumps"]) for view in views]
    for axis in np.eye(3):
        moved = [turned_about(view, 5.0, axis) if i == 4 else view for i, view in enumerate(views)]
        found = verdicts(moved, masks)
        assert [i for i, verdict in enumerate(found) if verdict.problem] == [4]
        assert found[4].turned_deg == pytest.approx(5.0, abs=0.7)
        assert found[4].turned_sigma_deg is not None


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize(("name", "seed"), [("bitten", 1), ("lumps", 2)])
def test_holes_and_spills_are_found(name: str, seed: int) -> None:
    true = MASKS[name]
    masks = list(true)
    masks[HOLED] = masks[HOLED] & ~disk(masks[HOLED], 0.05, within=True, seed=seed)
    masks[SPILT] = masks[SPILT] | disk(masks[SPILT], 0.08, within=False, seed=seed)
    given = verdicts(VIEWS, masks)
    # twelve views are too far apart to tell a narrow hole that is there from one that is none: a mask's is left and
    # named, a small one of a dark background, as shadows make them, is filled
    assert [i for i, verdict in enumerate(given) if verdict.doubtful > 0.0] == [HOLED]
    assert not any(verdict.filled for verdict in given)
    masks[HOLED] = true[HOLED] & ~disk(true[HOLED], 0.015, within=True, seed=seed)
    found = verdicts(VIEWS, masks, "dark background")
    for verdict in (*given, *found):
        assert not verdict.problem
    assert [i for i, verdict in enumerate(found) if verdict.filled > 0.0] == [HOLED]
    assert agreement(found[HOLED].silhouette.inside, true[HOLED]) > 0.995
    assert 0.008 < found[HOLED].filled < 0.03
    assert [i for i, verdict in enumerate(found) if verdict.spilled > 0.0] == [SPILT]
    before, after = (agreement(mask, true[SPILT]) for mask in (masks[SPILT], found[SPILT].silhouette.inside))
    # what lies within a margin of the outline stays
    assert after > before + 0.2 * (1.0 - before)


@pytest.mark.usefixtures("coarse")
def test_holes_that_are_there_stay() -> None:
    found = verdicts(VIEWS, MASKS["ring"], "background")
    through = [i for i, mask in enumerate(MASKS["ring"]) if not mask[45, 60]]
    assert through
    assert all(not found[i].silhouette.inside[45, 60] for i in through)


@pytest.mark.usefixtures("coarse")
def test_wide_holes_that_many_views_should_look_through_are_none() -> None:
    # 48 views, 7.5 degrees apart: behind a plate 0.2 thick a hole 0.3 wide would be seen by its neighbours
    views = around(48, width=80, height=60, elevation_deg=10.0)
    plate = box((0.1, 0.8, 0.6))
    masks = [mask_of(view, plate) for view in views]
    rows, columns = np.indices(masks[0].shape)
    masks[0] = masks[0] & ((rows - 30) ** 2 + (columns - 40) ** 2 > 5**2)
    found = verdicts(views, masks)
    assert [i for i, verdict in enumerate(found) if verdict.filled > 0.0] == [0]
    assert not any(verdict.doubtful or verdict.problem for verdict in found)


def test_with_three_views_nothing_is_judged() -> None:
    masks = [MASKS["bitten"][0], MASKS["bitten"][4], ~MASKS["bitten"][8]]
    assert not any(verdict.problem for verdict in verdicts([VIEWS[i] for i in (0, 4, 8)], masks))


@pytest.mark.usefixtures("coarse")
def test_views_that_disagree_as_a_whole_blame_nobody() -> None:
    views = [turned(view, 6.0, seed) if seed % 2 else view for seed, view in enumerate(VIEWS)]
    lines: list[str] = []
    events = Events(lambda event: lines.append(event.message) if event.kind == "warned" else None)
    silhouettes = [silhouette(mask) for mask in MASKS["bitten"]]
    found = compare(views, silhouettes, repairs=True, workers=2, events=events)
    assert not any(verdict.problem for verdict in found)
    assert any("none is blamed" in line or "not compared" in line for line in lines)


def test_many_large_spills_are_warned_of() -> None:
    lines: list[str] = []
    events = Events(lambda event: lines.append(event.message) if event.kind == "warned" else None)
    for num, is_told in ((1, False), (4, True)):
        lines.clear()
        masks = [
            mask | disk(mask, 0.1, within=False, seed=i) if i < num else mask for i, mask in enumerate(MASKS["lumps"])
        ]
        found = compare(VIEWS, [silhouette(mask) for mask in masks], repairs=True, workers=2, events=events)
        entries = [
            PhotographMask(
                name=f"{i}", source="mask", share=0.1, border_share=0.0, outline_sigma_px=0.2, is_usable=True,
                problem="", spilled=each.spilled, filled=0.0, doubtful=0.0,
            )
            for i, each in enumerate(found)
        ]  # fmt: skip
        told_of_repairs(entries, True, events)
        assert any("masks are bad" in line for line in lines) == is_told


def test_a_camera_amid_the_object_is_named_though_its_picture_cuts_the_object_off() -> None:
    masks = list(MASKS["lumps"])
    views = list(VIEWS)
    camera, pose = views[TURNED].camera, views[TURNED].cam_from_world
    assert camera is not None
    assert pose is not None
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))
    deepest = places[SOLIDS["lumps"](places).argmin()]
    moved = np.concatenate([pose[:4], -rigid3.rotation_matrix(pose) @ deepest])
    views[TURNED] = view_of_camera(views[TURNED].name, camera, moved)
    # what goes on beyond the picture may be anywhere there
    masks[TURNED] = masks[TURNED] | (np.arange(120) > 60)
    found = verdicts(views, masks)
    assert [i for i, verdict in enumerate(found) if verdict.problem] == [TURNED]
    assert "where all others" in found[TURNED].problem
