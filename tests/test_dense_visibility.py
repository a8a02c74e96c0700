"""Who can see a patch, and which of two patches in a cell its image shows: against geometry and rendered depth."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from dense_scenes import HEIGHT, WIDTH, scene_of, wall_with_box_and_bars
from sfmapp.dense.arrays import LAYERS, Cells, Images, Store, cell_pointers, image_pointers, store_pointers
from sfmapp.dense.layers import take_trust, weigh_layers
from sfmapp.dense.pyramid import Frame, frame_of, gray_pyramids, make_images
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.visibility import BORDER, are_excused, can_see
from sfmapp.dense.window import make_scratch
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
SIZE, FOCAL_PX, CELL_PX = (160, 120), 140.0, 2
# a wall at z = 0, and before it a screen of one by one at z = -1; the cameras stand at z = -4
HALF_SCREEN, SCREEN_Z, CAMERA_Z = 0.5, -1.0, -4.0


@numba.njit
def _can_see(images, store, cells, s, found, i):  # type: ignore[no-untyped-def]
    return can_see(image_pointers(images), store_pointers(store), cell_pointers(cells), s, store_pointers(found), i)


@numba.njit
def _are_excused(images, store, cells, found, i):  # type: ignore[no-untyped-def]
    return are_excused(image_pointers(images), store_pointers(store), cell_pointers(cells), store_pointers(found), i)


def patches(xyz: Array, frame: Frame, depth: Any, views: list[list[int]], normal: Any = (0.0, 0.0, -1.0)) -> Store:
    """Patches that face the cameras, in the world of the kernels."""
    store = Store.of_capacity(len(xyz), 2)
    store.xyz[:] = (xyz - frame.origin) * frame.scale
    store.normal[:] = normal
    store.size[:] = np.asarray(depth) * frame.scale / FOCAL_PX
    store.views[:] = -1
    for i, seen in enumerate(views):
        store.views[i, : len(seen)], store.num_views[i] = seen, len(seen)
    return store


class Stage:
    """Three cameras side by side; each cell of each holds the patch that its ray hits first, screen or wall."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        k = np.array([FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2])
        self.centers = np.array([[x, 0.1 * x, CAMERA_Z] for x in (-1.2, 0.0, 1.2)])
        views = []
        for m, center in enumerate(self.centers):
            rgb = rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
            mask = np.ones(SIZE[::-1], bool)
            if m == 2:
                mask[:30] = False
            views.append(DenseView(f"{m}", rgb, mask, k, rigid3.from_matrix(np.eye(3), -center)))
        nothing = (np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))
        neighbors = np.array([[1, 2], [0, 2], [1, 0]], np.int32)
        scene = DenseScene(tuple(views), neighbors, *nothing)
        self.frame = frame_of(scene)
        self.images = make_images(scene, gray_pyramids(scene.views, 1, 1)[0], self.frame, CELL_PX)
        columns, rows = SIZE[0] // CELL_PX, SIZE[1] // CELL_PX
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        pixels = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * CELL_PX
        rays = np.column_stack([(pixels - k[2:]) / k[:2], np.ones(len(pixels))])
        xyz, depths, owners = [], [], []
        for m, center in enumerate(self.centers):
            at_screen = center + rays * (SCREEN_Z - CAMERA_Z)
            is_screen = (np.abs(at_screen[:, :2]) < HALF_SCREEN).all(1)
            depth = np.where(is_screen, SCREEN_Z - CAMERA_Z, -CAMERA_Z)
            xyz.append(center + rays * depth[:, None])
            depths.append(depth)
            owners += [[m]] * len(rays)
        self.store = patches(np.concatenate(xyz), self.frame, np.concatenate(depths), owners)
        cell = np.full((len(self.images.closed), LAYERS), -1, np.int32)
        for m in range(3):
            first = int(self.images.cell_start[m])
            cell[first : first + len(rays), 0] = m * len(rays) + np.arange(len(rays))
        self.cells = Cells(cell, np.zeros(len(cell), np.uint8))

    def sees(self, s: int, xyz: Array, normal: Any = (0.0, 0.0, -1.0), depth: float = -CAMERA_Z) -> NDArray[np.bool_]:
        """By the kernel, for points that no view trusts yet."""
        found = patches(xyz, self.frame, depth, [[0]] * len(xyz), normal)
        return np.array([_can_see(self.images, self.store, self.cells, s, found, i) for i in range(len(xyz))])


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage()


@pytest.mark.parametrize("s", [0, 1, 2])
def test_a_point_is_seen_where_nothing_stands_before_it(stage: Stage, s: int) -> None:
    rng = np.random.default_rng(s)
    xyz = np.column_stack([rng.uniform(-3.0, 3.0, (600, 2)), np.zeros(600)])
    center = stage.centers[s]
    at_screen = center + (xyz - center) * (SCREEN_Z - CAMERA_Z) / -CAMERA_Z
    off = np.abs(at_screen[:, :2]).max(1) - HALF_SCREEN
    pixel = (xyz - center)[:, :2] / -CAMERA_Z * FOCAL_PX + np.array(SIZE) / 2
    inside = np.minimum(pixel, np.array(SIZE) - pixel).min(1)
    # index coordinates begin half a pixel further in; what is near an edge of screen, image or mask is either
    is_clear = (np.abs(off) > 2 * CELL_PX * 3.0 / FOCAL_PX) & (np.abs(inside - BORDER - 0.5) > 1.0)
    is_masked = np.full(len(xyz), False)
    if s == 2:
        is_masked = pixel[:, 1] < 30
        is_clear &= np.abs(pixel[:, 1] - 30) > 2 * CELL_PX
    expected = (off > 0) & (inside > BORDER + 0.5) & ~is_masked
    assert 100 < (expected & is_clear).sum() < 500
    assert ((off < 0) & is_clear).sum() > 10
    np.testing.assert_array_equal(stage.sees(s, xyz)[is_clear], expected[is_clear])


def test_the_screen_does_not_hide_itself_and_a_turned_patch_is_not_seen(stage: Stage) -> None:
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), np.full(50, SCREEN_Z)])
    # on it, and so little behind it that it is the same surface
    pixel = (SCREEN_Z - CAMERA_Z) / FOCAL_PX
    for behind in (0.0, 2.0 * pixel):
        assert stage.sees(1, xyz + np.array([0, 0, behind]), depth=SCREEN_Z - CAMERA_Z).all()
    assert not stage.sees(1, xyz + np.array([0, 0, 0.5]), depth=SCREEN_Z - CAMERA_Z).any()
    assert not stage.sees(1, xyz, normal=(0.0, 0.0, 1.0)).any()
    oblique = (np.sqrt(1 - 0.1**2), 0.0, -0.1)
    assert not stage.sees(1, xyz[:1] * [0, 0, 1], normal=oblique).any()
    assert not stage.sees(1, np.array([[0.0, 0.0, CAMERA_Z - 1.0]])).any()  # behind the camera


def test_images_are_excused_that_cannot_see_a_patch(stage: Stage) -> None:
    """A point of the wall that the screen hides from view 2 alone, its reference image being view 0."""
    xyz = np.array([[-0.8, 0.1, 0.0]])
    assert [bool(stage.sees(s, xyz)[0]) for s in range(3)] == [True, True, False]
    for views, is_excused in (([0], False), ([0, 2], False), ([0, 1], True), ([0, 2, 1], True)):
        found = patches(xyz, stage.frame, -CAMERA_Z, [views])
        assert _are_excused(stage.images, stage.store, stage.cells, found, 0) is is_excused, views


# ------------------------------------------------------------------------------------------------------------ layers


def two_layers(scene: DenseScene, images: Images, frame: Frame, m: int, depths: list[Any], surfaces: list[Any]) -> Any:
    """Cells of a view with the patch of the true surface, and one 0.25 m before or behind it, in either order."""
    view = scene.views[m]
    rotation, center = rigid3.rotation_matrix(view.cam_from_world), rigid3.center(view.cam_from_world)
    xyz, normal, cell, true = [], [], [], []
    for n, (v, u) in enumerate((v, u) for v in range(24, HEIGHT - 24, 7) for u in range(24, WIDTH - 24, 7)):
        if len(np.unique(surfaces[m][v - 6 : v + 7, u - 6 : u + 7])) > 1:
            continue
        ray = rotation.T @ np.array([(u + 0.5 - view.k[2]) / view.k[0], (v + 0.5 - view.k[3]) / view.k[1], 1.0])
        depth, away = float(depths[m][v, u]), 0.25 if n % 2 else -0.25
        places = [center + ray * depth, center + ray * (depth + away)]
        for place in places if n % 4 < 2 else places[::-1]:
            xyz.append(place)
            normal.append([0.0, -1.0, 0.0])
        true.append(len(xyz) - 2 + (n % 4 >= 2))
        cell.append(images.cell_start[m] + v * images.columns[m] + u)
    others = [s for s in range(len(scene.views)) if s != m]
    store = Store.of_capacity(len(xyz), len(others))
    store.xyz[:] = (np.array(xyz) - frame.origin) * frame.scale
    store.normal[:], store.views[:], store.num_views[:] = normal, [others[0], m, *others[1:]], len(others) + 1
    patch = np.full((len(images.closed), LAYERS), -1, np.int32)
    patch[cell] = np.arange(len(xyz)).reshape(-1, 2)
    return store, Cells(patch, np.zeros(len(patch), np.uint8)), np.array(cell, np.int64), np.array(true)


def test_of_two_patches_in_a_cell_the_one_goes_that_the_image_contradicts() -> None:
    scene, depths, surfaces = scene_of(wall_with_box_and_bars(), 5, 1.0)
    frame, m = frame_of(scene), 2
    images = make_images(scene, gray_pyramids(scene.views, 1, 1)[0], frame, 1)
    store, cells, cell, true = two_layers(scene, images, frame, m, depths, surfaces)
    loser = np.full(len(cell), 7, np.int32)
    weigh_layers(images, store, cells, m, cell, 0, len(cell), make_scratch(), loser)
    assert len(cell) > 300
    assert (loser == true).mean() < 0.01
    # where the other lies too little off to look different, or the texture is flat, nothing is taken away
    is_other = loser == np.where(true % 2 == 0, true + 1, true - 1)
    assert ((loser == -1) | is_other | (loser == true)).all()
    assert is_other.mean() > 0.8
    before = store.num_views.copy()
    take_trust(store, cells, m, cell, loser)
    gone = loser[loser >= 0]
    assert (before[gone] - store.num_views[gone] == 1).all()
    assert not (store.views[gone] == m).any()
    assert (store.views[gone, -1] == -1).all()
    kept = np.setdiff1d(np.arange(len(before)), gone)
    np.testing.assert_array_equal(store.num_views[kept], before[kept])
    for place, lost, alone in zip(cells.patch[cell], loser, true, strict=True):
        assert (place[1] == -1) == (lost >= 0)
        assert lost < 0 or lost == alone or place[0] == alone


def test_a_patch_whose_reference_image_gives_it_up_is_gone() -> None:
    store = Store.of_capacity(3, 2)
    store.views[:], store.num_views[:] = [[0, 1, 2], [1, 0, 2], [2, 1, 0]], 3
    cells = Cells(np.array([[0, 1], [2, 1]], np.int32), np.zeros(2, np.uint8))
    take_trust(store, cells, 0, np.array([0], np.int64), np.array([0], np.int32))
    assert store.num_views.tolist() == [0, 3, 3]
    assert cells.patch.tolist() == [[1, -1], [2, 1]]  # what lay behind is in front now; other cells stay
    take_trust(store, cells, 0, np.array([1], np.int64), np.array([1], np.int32))
    assert store.num_views.tolist() == [0, 2, 3]
    assert store.views[1].tolist() == [1, 2, -1]
    assert cells.patch.tolist() == [[1, -1], [2, -1]]
