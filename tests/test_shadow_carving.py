"""Shadows take away what is not there, and nothing that is: on rendered solids of exact shape."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from carving_scenes import write_cameras
from rendered_worlds.lit_solids import LAMPS_DEG, Rig, around, lamps_at, looking_in
from rendered_worlds.solids import BALL, BOX, Rendering, Solid, photograph, render, shape
from sfmapp.carve.cell_grid import CellGrid, coarsened, grid_of, intersect, octree_of
from sfmapp.carve.files import read_octree
from sfmapp.carve.lamp_mixtures import LampLight
from sfmapp.carve.leaning import lamp_gains, quotients_of
from sfmapp.carve.mixture_kernels import least_mixture
from sfmapp.carve.octree import Octree, codes_of
from sfmapp.carve.options import CarveOptions
from sfmapp.carve.outlines import signed_distance
from sfmapp.carve.shadow_carving import Shadow, ShadowCarvingReport, ShadowOptions, carve_shadows
from sfmapp.carve.shadows import (
    DetectionReport,
    LitPhotograph,
    doubts_of,
    fan_of_quotient,
    find_shadows,
    linear,
    noise_of,
    quotient_of_lean,
)
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.space_carving import carve
from sfmapp.carve.views import View, view_of_camera
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.formats.lights_file import read_lights
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
CELLS = 64


def block_with_cavity() -> Solid:
    """Three quarters of a box, open in front."""
    return Solid(
        np.array([
            shape(BOX, (0, 0, 0), (0.55, 0.55, 0.55), rounding=0.1),
            shape(BOX, (0.45, 0, 0), (0.6, 0.38, 0.38), taken=True),
        ]),
        1.0,
    )  # fmt: skip


def ball() -> Solid:
    return Solid(np.array([shape(BALL, (0, 0, 0), 0.8)]), 1.0)


def rendered(solid: Solid, rig: Rig) -> list[Rendering]:
    """The first light of each is the camera's."""
    return [
        render(solid, rig.camera, pose, lamps_at(np.vstack([rigid3.center(pose), lamps])))
        for pose, lamps in zip(rig.poses, rig.lamps, strict=True)
    ]


def views_of(rig: Rig) -> list[View]:
    return [view_of_camera(str(i), rig.camera, pose) for i, pose in enumerate(rig.poses)]


def exact_shadows(rig: Rig, pictures: list[Rendering]) -> list[Shadow]:
    return [
        Shadow(i, rig.lamps[i][k], np.where((picture.cover == 1.0) & (light == 0.0), 0.0, np.inf).astype(np.float32))
        for i, picture in enumerate(pictures)
        for k, light in enumerate(picture.light[1:])
    ]


def hull_of(views: list[View], pictures: list[Rendering]) -> Octree:
    silhouettes = [Silhouette(signed_distance(picture.cover)) for picture in pictures]
    return carve(views, silhouettes, [-1.0] * 3, 2.0, CarveOptions(CELLS))[0]


@cache
def scene(name: str) -> tuple[Solid, list[View], list[Shadow], Octree, list[Rendering]]:
    """Solid, views, exact shadows, hull, renderings."""
    solid = block_with_cavity() if name == "block" else ball()
    rig = around(16, 4, width=160)
    pictures = rendered(solid, rig)
    views = views_of(rig)
    return solid, views, exact_shadows(rig, pictures), hull_of(views, pictures), pictures


def surface_points(solid: Solid) -> Array:
    """Points drawn in the cube and brought to the surface along the gradient of its distance."""
    xyz = np.random.default_rng(1).uniform(-1.0, 1.0, (20000, 3))
    for _ in range(12):
        steps = 1e-5 * np.eye(3)
        gradient = np.stack([solid.distance(xyz + e) - solid.distance(xyz - e) for e in steps], axis=1) / 2e-5
        xyz = xyz - solid.distance(xyz)[:, None] * gradient
    return np.asarray(xyz[np.abs(solid.distance(xyz)) < 1e-4])


@cache
def points_of(name: str) -> Array:
    return surface_points(scene(name)[0])


@cache
def carved_exactly(name: str) -> tuple[Octree, ShadowCarvingReport]:
    """By exact shadows, on one thread."""
    _, views, shadows, hull, _ = scene(name)
    return carve_shadows(hull, views, shadows, threads=1)


def lost(name: str, carved: Octree) -> int:
    """Points of a solid's surface that its hull has and what is left of it has not."""
    points = points_of(name)
    return int((grid_of(scene(name)[3]).holds(points) & ~grid_of(carved).holds(points)).sum())


def test_shadows_open_a_cavity_and_leave_its_walls() -> None:
    solid, _, _, hull, _ = scene("block")
    carved, report = carved_exactly("block")
    before, after = grid_of(hull), grid_of(carved)
    true = solid.volume(96)
    # what is left of the hull's error; cells are coarse here, and the surface's are wholly counted
    assert 0.3 < (after.volume - true) / (before.volume - true) < 0.9
    assert report.cells_before - report.cells_after == sum(report.sweeps)
    assert len(points_of("block")) > 10000
    assert lost("block", carved) == 0


def test_a_ball_lit_from_all_sides_stays_whole() -> None:
    assert sum(int(shadow.dark.sum()) for shadow in scene("ball")[2]) > 1000
    assert lost("ball", carved_exactly("ball")[0]) == 0


def test_threads_and_order_do_not_change_the_volume() -> None:
    _, views, shadows, hull, _ = scene("block")
    one, _ = carved_exactly("block")
    other, _ = carve_shadows(hull, views, shadows[::-1], threads=3)
    assert one.surface.tobytes() == other.surface.tobytes()
    assert [a.tobytes() for a in one.full] == [a.tobytes() for a in other.full]


def test_darker_shadows_carve_more() -> None:
    _, views, shadows, hull, _ = scene("block")
    wide, _ = carve_shadows(hull, views, [replace(s, fan_deg=np.maximum(s.fan_deg, np.float32(2.0))) for s in shadows])
    exact, _ = carved_exactly("block")
    assert grid_of(exact).volume < grid_of(wide).volume < grid_of(hull).volume
    for angle in (5.0, 19.0, 60.0):
        quotients = np.array([quotient_of_lean(angle, fan) for fan in (0.1, 0.5, 2.0)])
        assert fan_of_quotient(quotients, angle) == pytest.approx(np.array([0.1, 0.5, 2.0]))


def test_lights_far_from_the_camera_are_left_out() -> None:
    _, views, shadows, hull, _ = scene("block")
    behind = [replace(shadow, light=-views[shadow.view].center) for shadow in shadows[:4]]
    carved, report = carve_shadows(hull, views, behind)
    assert (report.num_pairs, report.num_too_far) == (0, 4)
    assert carved is hull


def test_shadows_and_lamps_that_do_not_fit_the_views_are_named() -> None:
    _, views, shadows, hull, _ = scene("block")
    light = LampLight(0, np.zeros((2, 3)), np.zeros((2, 120, 160), np.float32))
    wrong: list[tuple[str, list[Shadow], list[LampLight]]] = [
        (r"160 x 120 pixels, .*found shape \(20, 10\)", [replace(shadows[0], fan_deg=light.most[0, :20, :10])], []),
        (r"place of a light, .* \(3,\), found shape \(2,\)", [replace(shadows[0], light=np.zeros(2))], []),
        ("16 cameras under lights, found one of camera 16", [replace(shadows[0], view=16)], []),
        ("16 cameras under lights, found one of camera -1", [], [replace(light, view=-1)]),
        (r"places of 2 lamps, .* \(2, 3\), found shape \(2, 2\)", [], [replace(light, lamps=np.zeros((2, 2)))]),
        (r"160 x 120 pixels under 2 lamps, .*found shape \(1, 120, 160\)", [], [replace(light, most=light.most[:1])]),
        ("0: expected its lamps once, found them 2 times", [], [light, light]),
    ]  # fmt: skip
    for said, some, lights in wrong:
        with pytest.raises(InputError, match=said):
            carve_shadows(hull, views, some, ShadowOptions(), lights=lights)


def test_a_tree_and_its_grid_are_one() -> None:
    full = (np.array([], np.uint64), np.array([0], np.uint64), np.array([8], np.uint64), np.array([], np.uint64))
    tree = Octree(np.zeros(3), 2.0, 3, full, np.sort(codes_of(np.array([[6, 0, 0], [7, 3, 1]]))))
    grid = grid_of(tree)
    assert grid.volume == pytest.approx(tree.volume_bounds()[1])
    again = octree_of(grid)
    assert grid_of(again).filled.tobytes() == grid.filled.tobytes()
    # what has six neighbours: the middle of the cube of four, and the cell of it that leads into the cube of two
    assert sum(len(codes) * 8 ** (3 - level) for level, codes in enumerate(again.full)) == 8 + 1


def test_coarse_cells_hold_a_volume_and_take_from_it_what_they_lost() -> None:
    tree = Octree(np.zeros(3), 2.0, 5, (), np.empty(0, np.uint64))
    filled = (np.random.default_rng(0).random((13, 9, 6)) < 0.3).astype(np.uint8)
    grid = CellGrid(tree, np.array([3, 5, 9]), filled.copy())
    coarse = coarsened(grid, 3)
    assert coarse.tree.cell == 4.0 * tree.cell
    assert coarse.holds(grid.low + (np.argwhere(filled) + 0.5) * tree.cell).all()
    intersect(grid, coarse)
    assert (grid.filled == filled).all()
    gone = tuple(np.argwhere(coarse.filled)[4])
    coarse.filled[gone] = 0
    intersect(grid, coarse)
    # in cells of the finest level
    at = (np.argwhere(filled) + grid.first) // 4 - coarse.first
    assert (grid.filled[filled == 1] == (at != gone).any(axis=1)).all()


def photographed(
    pictures: list[Rendering], rig: Rig, hull: Octree, seed: int, edge_deg: float = 20.0
) -> tuple[list[Shadow], list[LampLight], list[DetectionReport]]:
    """Shadows and brightness found in photographs with noise."""
    photographs = []
    for i, (picture, pose) in enumerate(zip(pictures, rig.poses, strict=True)):
        lit, *under = (photograph(light, 2.0, [seed, i, k]) for k, light in enumerate(picture.light))
        view = view_of_camera("", rig.camera, pose)
        photographs.append(LitPhotograph(lit, under, picture.cover == 1.0, view, rig.lamps[i], hull))
    names = ["a", "b", "c", "d"][: len(rig.lamps[0])]
    fans, brightness, reports = find_shadows(photographs, names, fan_deg=2.0, edge_deg=edge_deg)
    shadows = [Shadow(i, rig.lamps[i][k], fan) for i, row in enumerate(fans) for k, fan in enumerate(row)]
    return shadows, [LampLight(i, rig.lamps[i], most) for i, most in enumerate(brightness)], reports


@cache
def found_in(name: str, seed: int, edge_deg: float) -> tuple[list[Shadow], list[LampLight], list[DetectionReport]]:
    _, _, _, hull, pictures = scene(name)
    return photographed(pictures, around(16, 4, width=160), hull, seed, edge_deg)


@pytest.mark.parametrize("seed", [0, 1])
def test_shadows_found_in_photographs_carve_as_well(seed: int) -> None:
    _, views, exact, hull, pictures = scene("block")
    # none of its edges is sharper than a right angle
    found, mixed, reports = found_in("block", seed, 75.0)
    for n, (shadow, true) in enumerate(zip(found, exact, strict=True)):
        picture, lamp = pictures[n // 4], 1 + n % 4
        # what is called dark though light falls there hardly leans towards it: below 2 degrees, at less than
        # sin(2) / sin(20 + 2) of what the camera's light makes of it
        wrong = shadow.dark & ~true.dark & (picture.cover == 1.0)
        assert (picture.light[lamp][wrong] <= 0.1 * picture.light[0][wrong]).all()
    assert all(0.6 < report.gain < 1.6 and 1.0 < report.noise_grey < 4.0 for report in reports)
    carved, _ = carve_shadows(hull, views, found, lights=mixed)
    assert lost("block", carved) == 0
    best, _ = carved_exactly("block")
    assert grid_of(hull).volume - grid_of(carved).volume > 0.7 * (grid_of(hull).volume - grid_of(best).volume)


def test_mixtures_of_lamps_need_no_edge_told() -> None:
    solid, views, _, hull, _ = scene("block")
    _, mixed, _ = found_in("block", 0, 20.0)
    carved, _ = carve_shadows(hull, views, [], lights=mixed)
    taken = 1.0 - grid_of(carved).volume / grid_of(hull).volume
    # the lamps are 32 and 55 degrees from the camera, and cells as large as three pixels
    assert 0.01 < taken < 1.0 - solid.volume(96) / grid_of(hull).volume
    assert lost("block", carved) == 0
    # of two lamps the camera is never among
    two = [LampLight(light.view, light.lamps[:2], light.most[:2]) for light in mixed]
    assert carve_shadows(hull, views, [], lights=two)[0] is hull
    # nothing is in the way of any lamp
    _, views, _, hull, _ = scene("ball")
    _, mixed, _ = found_in("ball", 0, 20.0)
    assert carve_shadows(hull, views, [], lights=mixed)[0] is hull


def test_a_mixture_is_no_darker_than_the_camera_wherever_lamps_reach() -> None:
    rng = np.random.default_rng(0)
    lamps = np.array([[0.5, 0.1, 1.0], [-0.4, 0.3, 1.0], [0.1, -0.5, 1.0], [0.9, 0.9, 0.3]])
    normals = rng.normal(0, 1, (2000, 3))
    normals[:, 2] = np.abs(normals[:, 2])
    for shown in np.maximum(normals @ lamps.T, 0.0) / normals[:, 2:]:
        assert least_mixture(lamps, shown, np.ones(4, np.bool_), 0.0, 0.0, 1.0) > 1.0 - 1e-9
    # facing the camera, one lamp in shadow; and none that shines from the other side
    shown = np.array([0.0, 1.0, 1.0, 0.3])
    assert least_mixture(lamps, shown, np.ones(4, np.bool_), 0.0, 0.0, 1.0) < 0.75
    assert least_mixture(lamps, shown, np.array([True, True, False, True]), 0.0, 0.0, 1.0) == np.inf


def leans(solid: Solid, view: View, picture: Rendering, lamp: Array) -> Array:
    """(H, W) cosine between normal and lamp of what each pixel shows."""
    shown = np.isfinite(picture.depth)
    rows, columns = np.nonzero(shown)
    xyz = view.center + picture.depth[shown][:, None] * view.rays(np.stack([columns + 0.5, rows + 0.5], axis=1))
    steps = 1e-4 * np.eye(3)
    normal = np.stack([solid.distance(xyz + e) - solid.distance(xyz - e) for e in steps], axis=1)
    toward = lamp - xyz
    cosine = np.full(shown.shape, np.nan)
    cosine[shown] = (normal * toward).sum(axis=1) / np.linalg.norm(normal, axis=1) / np.linalg.norm(toward, axis=1)
    return cosine


def test_what_turns_away_from_a_light_is_no_shadow() -> None:
    solid, views, _, _, pictures = scene("block")
    found, _, _ = found_in("block", 0, 20.0)
    thrown, kept, wrong = 0, 0, 0
    for n, shadow in enumerate(found):
        picture, lamp = pictures[n // 4], 1 + n % 4
        cosine = leans(solid, views[n // 4], picture, shadow.light)
        truly = (picture.cover == 1.0) & (picture.light[lamp] == 0.0) & (cosine > 0.0)
        thrown, kept = thrown + int(truly.sum()), kept + int((truly & shadow.dark).sum())
        wrong += int((shadow.dark & (cosine < -0.02)).sum())
    assert thrown > 1000
    # a pixel at an edge shows two surfaces
    assert wrong <= 2e-3 * kept
    assert kept > 0.2 * thrown
    # nothing throws a shadow on a ball: all that is dark on it is turned away
    found, _, reports = found_in("ball", 0, 20.0)
    assert not any(shadow.dark.any() for shadow in found)
    assert all(report.turned_share > 0.05 for report in reports if report.light in "ab")
    assert "turned away from the light" in doubts_of(reports)[0]


def test_gains_of_lamps_are_found_beside_the_shapes() -> None:
    _, views, _, hull, pictures = scene("block")
    rig, true = around(16, 4, width=160), np.array([0.5, 0.8, 1.0, 1.6])
    quotients = []
    for view, lamps, picture in zip(views, rig.lamps, pictures, strict=True):
        usable = picture.cover == 1.0
        q = np.where(usable, true[:, None, None] * picture.light[1:] / np.where(usable, picture.light[0], 1.0), 0.0)
        quotients.append(quotients_of(view, lamps, hull, q, usable))
    assert lamp_gains(quotients, np.ones(4)) == pytest.approx(true, rel=0.05)
    # three lamps leave a single equation
    assert np.isnan(lamp_gains([replace(q, lamps=q.lamps[:3], typical=q.typical[:3], least=q.least[:3], most=q.most[:3])
                                for q in quotients], np.ones(3))).all()  # fmt: skip


def blade() -> Solid:
    """A knife edge of 30 degrees that stands on a plate in the shadow of a wall."""
    edge, sides = np.array([0.1, -0.1, 0.0]), np.radians([-75.0, 75.0])
    cuts = [
        shape(BOX, edge + 0.5 * np.array([np.cos(a), np.sin(a), 0.0]), (0.5, 1, 1), taken=True, rounding=0.0,
              turn=(0.0, 0.0, a))
        for a in sides
    ]  # fmt: skip
    return Solid(
        np.array([
            shape(BOX, (-0.15, -0.1, 0), (0.25, 0.2, 0.4), rounding=0.0),
            *cuts,
            shape(BOX, (-0.5, 0, 0), (0.1, 0.6, 0.5)),
            shape(BOX, (-0.05, 0.45, 0), (0.55, 0.08, 0.5)),
        ]),
        1.0,
    )  # fmt: skip


def test_an_edge_sharper_than_the_angle_to_the_light_stays() -> None:
    solid, around_it = blade(), around(10, 4, width=160)
    # the camera sees one side of the blade, the second lamp the other, and both its edge
    beside = looking_in(np.array([-27.5]), np.array([0.0]), LAMPS_DEG[:4], 160)
    rig = Rig(beside.camera, np.vstack([beside.poses, around_it.poses]), beside.lamps + around_it.lamps)
    pictures, views = rendered(solid, rig), views_of(rig)
    hull = hull_of(views, pictures)
    points = surface_points(solid)
    points = points[grid_of(hull).holds(points)]
    # all that is dark takes the edge away
    carved, _ = carve_shadows(hull, views, exact_shadows(rig, pictures)[1:2])
    assert (~grid_of(carved).holds(points)).sum() > 20
    found, mixed, _ = photographed(pictures, rig, hull, 0)
    carved, _ = carve_shadows(hull, views, found, lights=mixed)
    assert grid_of(carved).holds(points).all()


def test_black_and_mirroring_surfaces_are_left_alone_and_named() -> None:
    black = Solid(np.array([shape(BOX, (0, 0, 0), (0.5, 0.5, 0.5), albedo=0.01)]), 1.0)
    rig = around(6, 4, width=160)
    pictures = rendered(black, rig)
    hull = hull_of(views_of(rig), pictures)
    found, mixed, reports = photographed(pictures, rig, hull, 0)
    assert not any(shadow.dark.any() for shadow in found)
    assert carve_shadows(hull, views_of(rig), [], lights=mixed)[0] is hull
    assert "too dark" in doubts_of(reports)[0]
    # nothing but mirrored lamps is bright
    mirror = Solid(np.array([shape(BALL, (0, 0, 0), 0.8, gloss=1.0)]), 1.0)
    pictures = rendered(mirror, rig)
    hull = hull_of(views_of(rig), pictures)
    found, mixed, reports = photographed(pictures, rig, hull, 0)
    assert not any(shadow.dark.any() for shadow in found)
    assert carve_shadows(hull, views_of(rig), [], lights=mixed)[0] is hull
    assert all(report.mirror_share > 0.0 for report in reports)


def test_dead_pixels_are_no_shadows() -> None:
    _, views, _, hull, _ = scene("ball")
    rig, lit = around(16, 4, width=160), np.full((120, 160), 130, np.uint8)
    dead = lit.copy()
    dead[50, 70] = dead[60:62, 80] = 0
    shaded = dead.copy()
    shaded[70:80, 60:90] = 2
    inside = np.ones(lit.shape, np.bool_)
    photographs = [LitPhotograph(lit, [dead, shaded], inside, views[0], rig.lamps[0][:2], hull)]
    fans, _, _ = find_shadows(photographs, ["dead", "shaded"], fan_deg=2.0, edge_deg=75.0)
    assert not np.isfinite(fans[0][0]).any()
    # to the pixel, and black enough for a narrow fan
    assert np.array_equal(np.isfinite(fans[0][1]), shaded == 2)
    assert (fans[0][1][shaded == 2] < 1.0).all()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every other photograph of the block with alpha and cameras, and under each lamp alone."""
    folder = tmp_path_factory.mktemp("block")
    rig, (_, views, _, _, pictures) = around(16, 4, width=160), scene("block")
    for i, picture in enumerate(pictures[::2]):
        grey = [photograph(light, 2.0, [i, k]) for k, light in enumerate(picture.light)]
        alpha = (255.0 * picture.cover).round().astype(np.uint8)
        for name, value in zip("abcd", grey[1:], strict=True):
            (folder / name).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / name / f"{i:03d}.png"), value)
        (folder / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "images" / f"{i:03d}.png"), np.dstack([grey[0]] * 3 + [alpha]))
    write_cameras(folder, (replace(view, name=f"{i:03d}.png") for i, view in enumerate(views[::2])))
    beside = [rigid3.apply(rig.poses[0], lamp) for lamp in rig.lamps[0]]
    lights = [
        {"name": f"lamp {name}", "photographs": name, "position": place.tolist(), "frame": "camera"}
        for name, place in zip("abcd", beside, strict=True)
    ]
    (folder / "lights.json").write_text(json.dumps({"lights": lights, "sharpest_edge_deg": 75}))
    return folder


def test_the_command_carves_by_lights(folder: Path, tmp_path: Path) -> None:
    args = ["carve", str(folder), "-o", str(tmp_path / "out"), "--cells", str(CELLS), "--no-recording", "-q"]
    assert main([*args, "--lights", str(folder / "lights.json")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    hull = report["carving"]["volume_low"], report["carving"]["volume_high"]
    carved = read_octree(tmp_path / "out" / "octree_shadows.npz").volume_bounds()
    true = scene("block")[0].volume(96)
    assert 0.3 < (np.mean(carved) - true) / (np.mean(hull) - true) < 0.9
    # of a mesh that is not closed the volume would be none of these
    assert carved[0] < report["surface"]["volume"] < carved[1]
    assert [light["light"] for light in report["shadows"]["lights"]] == ["lamp a", "lamp b", "lamp c", "lamp d"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"lights": []}, 'expected a list of lights under "lights"'),
        ({"lights": [{"photographs": "a"}]}, 'light 1: expected "position", found photographs'),
        ({"lights": [{"photographs": "z", "position": [0, 0, 1]}]}, "expected a folder of photographs beside the file"),
        ({"lights": [{"photographs": "a", "position": [0, 0, 1]}], "sharpest_edge_deg": "dull"}, "expected degrees"),
        ({"lights": [{"photographs": "a", "position": [0, 1]}]}, "position: expected 3 finite numbers"),
        (
            {"lights": [{"photographs": "a", "position": [0, 0, 1], "frame": "lamp"}]},
            "expected a frame of world or camera",
        ),
    ],
)
def test_a_wrong_file_of_lights_is_named(folder: Path, change: dict[str, object], said: str) -> None:
    path = folder / "wrong.json"
    path.write_text(json.dumps(change))
    with pytest.raises(InputError, match=re.escape(said)):
        read_lights(path)


def test_noise_is_measured() -> None:
    slope = np.tile(np.linspace(40.0, 200.0, 120), (90, 1))
    for sigma in (1.0, 3.0, 8.0):
        noisy = slope + sigma * np.random.default_rng(0).standard_normal(slope.shape)
        picture = np.clip(noisy.round(), 0, 255).astype(np.uint8)
        # whole levels let it be told in steps of a quarter of one
        assert noise_of([picture]) == pytest.approx(np.hypot(sigma, 12.0**-0.5), rel=0.03, abs=0.13)


def test_the_curve_of_grey_values_is_taken_back() -> None:
    light = np.linspace(0.0, 1.0, 400, dtype=np.float32).reshape(20, 20)
    assert linear(photograph(light, 0.0, [0]).astype(np.float64)) == pytest.approx(light, abs=0.006)
