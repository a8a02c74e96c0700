"""Textures of meshes whose photographs are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.mesh import Mesh, vertex_normals
from sfmapp.surface.options import SurfaceOptions
from sfmapp.surface.painting import fill_gaps, paint
from sfmapp.surface.seams import level_seams
from sfmapp.surface.texture import texture_mesh
from sfmapp.surface.view_choice import choose_views, neighbor_pairs

GRAY = 120


def color_at(x: NDArray, y: NDArray) -> NDArray:
    """What is painted on the plane z = 0: colours that change slowly."""
    return np.stack([GRAY + 50 * np.sin(2 * x), GRAY + 50 * np.cos(3 * y), GRAY + 30 * np.sin(x + 2 * y)], axis=-1)


def view_of(eye: tuple[float, float, float], aim: tuple[float, float], gain: float = 1.0) -> DenseView:
    """A photograph of the plane from above it (z < 0, for z is forward), its pixels by ray and plane."""
    width, focal = 160, 160.0
    forward = np.array([*aim, 0.0]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    grid = (np.arange(width) + 0.5 - width / 2) / focal
    rays = np.stack([*np.meshgrid(grid, grid), np.ones((width, width))], axis=-1) @ rotation
    point = np.asarray(eye) - rays * (eye[2] / rays[..., 2:])
    rgb = np.rint((gain * color_at(point[..., 0], point[..., 1])).clip(0, 255)).astype(np.uint8)
    pose = rigid3.from_matrix(rotation, -rotation @ np.asarray(eye))
    return DenseView("", rgb, None, np.array([focal, focal, width / 2, width / 2]), pose)


def scene_of(*views: DenseView) -> DenseScene:
    none = np.zeros((len(views), 0), np.int32)
    return DenseScene(views, none, np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))


def plane(num: int = 40, half: float = 1.0) -> Mesh:
    """A square of the plane, its front toward z < 0, in the colours that it has."""
    line = np.linspace(-half, half, num + 1)
    x, y = (part.ravel() for part in np.meshgrid(line, line))
    xyz = np.stack([x, y, np.zeros_like(x)], axis=1)
    i = (np.arange(num)[:, None] * (num + 1) + np.arange(num)).ravel()
    faces = np.concatenate([np.stack([i, i + num + 1, i + 1], 1), np.stack([i + 1, i + num + 1, i + num + 2], 1)])
    faces = faces.astype(np.int32)
    return Mesh(xyz, faces, vertex_normals(xyz, faces), np.rint(color_at(x, y)).astype(np.uint8))


def looked_up(mesh: Mesh) -> tuple[NDArray, NDArray]:
    """Centres of the faces (F, 3), and what the texture shows there (F, 3), interpolated as a viewer does."""
    assert mesh.uv is not None
    assert mesh.texture is not None
    size = np.array(mesh.texture.shape[1::-1])
    place = (mesh.uv[mesh.faces].mean(axis=1) * size - 0.5).clip(0.0, size - 1.0)
    low = np.minimum(place.astype(int), size - 2)
    t = place - low
    out = np.zeros((len(place), 3))
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        weight = np.where(dx, t[:, 0], 1 - t[:, 0]) * np.where(dy, t[:, 1], 1 - t[:, 1])
        out += weight[:, None] * mesh.texture[low[:, 1] + dy, low[:, 0] + dx]
    return mesh.xyz[mesh.faces].mean(axis=1), out


LEFT, RIGHT, MIDDLE = (-1.0, 0.2, -2.0), (1.0, -0.2, -2.0), (0.0, 0.1, -3.2)


def test_the_texture_is_the_photograph() -> None:
    scene = scene_of(view_of(LEFT, (-0.5, 0.0)), view_of(RIGHT, (0.5, 0.0)), view_of(MIDDLE, (0.0, 0.0)))
    textured, report = texture_mesh(plane(), scene, SurfaceOptions())
    center, shown = looked_up(textured)
    np.testing.assert_allclose(center, plane().xyz[plane().faces].mean(axis=1))  # the same triangles, in their order
    error = np.abs(shown - color_at(center[:, 0], center[:, 1]))
    assert error.max() < 4.0
    assert error.mean() < 0.6  # the photographs are rounded: 0.25
    assert report["seen"] == 1.0
    assert report["scale"] == 1.0
    assert 2 <= report["num_charts"] <= 6  # not salt and pepper


def test_seams_between_exposures_vanish() -> None:
    bright, dark = view_of(LEFT, (-0.5, 0.0), 1.15), view_of(RIGHT, (0.5, 0.0), 0.85)
    textured, report = texture_mesh(plane(), scene_of(bright, dark), SurfaceOptions())
    assert report["seam_before"] > 25.0
    assert report["seam_after"] < 0.1 * report["seam_before"]
    # halves differ by little about the seam now, and keep their own light far from it
    center, shown = looked_up(textured)
    difference = (shown - color_at(center[:, 0], center[:, 1])).mean(axis=1)
    a, b = neighbor_pairs(plane().faces)
    assert np.abs(difference[a] - difference[b]).max() < 8.0


def test_what_stands_before_the_surface_is_not_painted_onto_it() -> None:
    ground = plane()
    small = plane(10, 0.25)
    lid = replace(small, xyz=small.xyz + np.array([0.0, 0.0, -0.5]), rgb=np.full_like(small.rgb, 255))
    xyz = np.concatenate([ground.xyz, lid.xyz])
    faces = np.concatenate([ground.faces, lid.faces + len(ground.xyz)]).astype(np.int32)
    mesh = Mesh(xyz, faces, vertex_normals(xyz, faces), np.concatenate([ground.rgb, lid.rgb]))
    views = []
    for view in (view_of(LEFT, (0.0, 0.0)), view_of(RIGHT, (0.0, 0.0))):
        # the lid, white, in the photographs
        pixel, _ = view.project(lid.xyz[[0, 10, -1, -11]])
        rgb = view.rgb.copy()
        y, x = np.mgrid[:160, :160] + 0.5
        inside = np.ones((160, 160), bool)
        for p, q in zip(pixel, np.roll(pixel, -1, axis=0), strict=True):
            inside &= (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) > 0
        assert inside.any()
        rgb[inside] = 255
        views.append(replace(view, rgb=rgb))
    scene = scene_of(*views)
    choice = choose_views(mesh, scene, Events())
    center = mesh.xyz[mesh.faces].mean(axis=1)
    on_ground = center[:, 2] > -0.1
    # from eyes at x = -1 and 1 and 2 above, the lid's shadows on the ground are shifted by a third of a unit
    hidden_left = on_ground & (np.abs(center[:, 0] - 1 / 3) < 0.25) & (np.abs(center[:, 1] + 0.07) < 0.2)
    hidden_right = on_ground & (np.abs(center[:, 0] + 1 / 3) < 0.25) & (np.abs(center[:, 1] - 0.07) < 0.2)
    only_left = hidden_left & ~hidden_right & (center[:, 0] > 0.1)
    assert only_left.sum() > 50
    assert (choice.view_idx[only_left] == 1).all()
    textured, _ = texture_mesh(mesh, scene, SurfaceOptions())
    _, shown = looked_up(textured)
    assert shown[only_left].max() < 200.0


def test_what_no_view_shows_has_the_colours_of_its_vertices() -> None:
    mesh = plane()
    back = replace(mesh, faces=mesh.faces[:, ::-1].copy(), normal=-mesh.normal)
    textured, report = texture_mesh(back, scene_of(view_of(MIDDLE, (0.0, 0.0))), SurfaceOptions())
    center, shown = looked_up(textured)
    assert report["seen"] == 0.0
    assert np.abs(shown - color_at(center[:, 0], center[:, 1])).max() < 6.0


def test_a_small_texture_holds_all_of_it() -> None:
    scene = scene_of(view_of(LEFT, (-0.5, 0.0)), view_of(RIGHT, (0.5, 0.0)))
    views = tuple(replace(view, rgb=view.rgb.repeat(4, 0).repeat(4, 1), k=4.0 * view.k) for view in scene.views)
    textured, report = texture_mesh(plane(), replace(scene, views=views), SurfaceOptions(texture_px=256))
    assert max(report["width"], report["height"]) <= 256
    assert 0.1 < report["scale"] < 1.0
    center, shown = looked_up(textured)
    assert np.abs(shown - color_at(center[:, 0], center[:, 1])).mean() < 1.5


def test_triangles_without_area_do_no_harm() -> None:
    mesh = plane()
    slivers = np.array([[0, 0, 1], [5, 5, 5], [0, 1, 2], [0, 1680, 840]], np.int32)
    faces = np.concatenate([mesh.faces, slivers]).astype(np.int32)
    textured, _ = texture_mesh(replace(mesh, faces=faces), scene_of(view_of(MIDDLE, (0.0, 0.0))), SurfaceOptions())
    assert textured.uv is not None
    assert np.isfinite(textured.uv).all()
    assert textured.uv.min() >= 0.0
    assert textured.uv.max() <= 1.0
    center, shown = looked_up(textured)
    num = len(mesh.faces)
    assert np.abs(shown[:num] - color_at(center[:num, 0], center[:num, 1])).max() < 4.0


def test_levelling_meets_in_the_middle() -> None:
    # two strips of triangles, alike but for 20 levels; their last and first columns are the same vertices
    num = 20
    strip = np.array(
        [[2 * i, 2 * i + 2, 2 * i + 1] for i in range(num)] + [[2 * i + 1, 2 * i + 2, 2 * i + 3] for i in range(num)]
    )
    faces = np.concatenate([strip, strip + 2 * num + 2]).astype(np.int32)
    vertex_idx = np.concatenate([np.arange(2 * num + 2), np.arange(2 * num, 4 * num + 2)])
    color = np.concatenate([np.full((2 * num + 2, 3), 100.0), np.full((2 * num + 2, 3), 120.0)])
    level = level_seams(color, vertex_idx, faces)
    meeting = color[[2 * num, 2 * num + 2]] + level[[2 * num, 2 * num + 2]]
    assert np.abs(meeting[0] - meeting[1]).max() < 2.0
    # the triangles of the strips are not quite each other's mirror images
    np.testing.assert_allclose(meeting.mean(axis=0), 110.0, atol=0.5)
    assert np.abs(np.diff(level[0 : 2 * num + 2 : 2, 0])).max() < 3.0  # no new edge within a strip


def test_painting_copies_pixels_and_fills_the_rest() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (20, 20, 3)).astype(np.uint8)
    places = np.array([[2.0, 2.0], [12.0, 2.0], [2.0, 12.0], [12.0, 12.0]])
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    texture, painted = np.zeros((16, 16, 3), np.uint8), np.zeros((16, 16), np.uint8)
    offset = np.zeros((4, 3), np.float32)
    paint(np.arange(2), faces, places, places + np.array([3.0, 5.0]), offset, image, texture, painted)
    np.testing.assert_array_equal(texture[2:12, 2:12], image[7:17, 5:15])
    assert painted[2:12, 2:12].all()
    assert not painted[:1].any()
    assert not painted[14:].any()
    fill_gaps(texture, painted)
    np.testing.assert_array_equal(texture[0, 5], texture[1, 5])
    np.testing.assert_array_equal(texture[5, 15], texture[5, 12])


def test_neighbours_share_edges() -> None:
    a, b = neighbor_pairs(np.array([[0, 1, 2], [2, 1, 3], [3, 4, 5]], np.int32))
    assert {(int(min(p)), int(max(p))) for p in zip(a, b, strict=True)} == {(0, 1)}


def test_the_choice_of_views_knows_no_scale() -> None:
    scale = 1e3
    views = [view_of(LEFT, (-0.5, 0.0)), view_of(RIGHT, (0.5, 0.0))]
    chosen = choose_views(plane(), scene_of(*views), Events()).view_idx
    grown = [replace(view, cam_from_world=view.cam_from_world * ([1.0] * 4 + [scale] * 3)) for view in views]
    mesh = replace(plane(), xyz=plane().xyz * scale)
    assert (choose_views(mesh, scene_of(*grown), Events()).view_idx == chosen).mean() > 0.99
