"""Meshes from patches on surfaces that are known exactly."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, DenseView, Region
from sfmapp.errors import InterruptedRunError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.mesh import face_vectors
from sfmapp.surface import child, gaps, poisson, trim
from sfmapp.surface.mesh import make_mesh
from sfmapp.surface.options import SurfaceOptions
from sfmapp.surface.patch_cloud import make_patch_cloud
from sfmapp.surface.trim import pieces

SPACING = 0.1


def sphere(count: int = 6000, noise: float = 0.0) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Patches on a sphere whose radius gives them the spacing above, on Fibonacci's lattice."""
    i = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * i / count, i * np.pi * (3.0 - 5.0**0.5)
    n = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    radius = SPACING * np.sqrt(count / (4.0 * np.pi))
    along = radius + np.random.default_rng(1).normal(0.0, noise, count) if noise else np.full(count, radius)
    rgb = np.where(z[:, None] > 0.0, [200, 100, 0], [0, 100, 200]).astype(np.uint8)
    return n * along[:, None], n.astype(np.float32), rgb, np.full(count, 0.5 * SPACING, np.float32)


def looking_at(eye: NDArray, target: NDArray, width: int = 64, focal: float = 64.0) -> DenseView:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0]) if abs(forward[2]) < 0.9 else np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = rigid3.from_matrix(rotation, -rotation @ eye)
    k = np.array([focal, focal, width / 2, width / 2])
    return DenseView("view", np.zeros((width, width, 3), np.uint8), None, k, pose)


def scene_of(*views: DenseView) -> DenseScene:
    none = np.zeros((len(views), 0), np.int32)
    return DenseScene(views, none, np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))


def test_patches_all_round_become_a_closed_sphere_far_from_the_origin() -> None:
    xyz, normal, rgb, size = sphere(12000)
    origin = np.array([4.5e5, 5.2e6, 300.0])
    mesh, report = make_mesh(xyz + origin, normal, rgb, size, None, SurfaceOptions())
    radius = np.linalg.norm(xyz[0])
    assert report["num_rim_edges"] == 0
    # Euler: a closed surface of genus 0 in one piece
    assert len(mesh.xyz) - len(mesh.faces) / 2 == 2
    error = np.linalg.norm(mesh.xyz - origin, axis=1) - radius
    assert np.abs(error).max() < 0.1 * SPACING
    assert np.linalg.norm(face_vectors(mesh.xyz, mesh.faces), axis=1).sum() == pytest.approx(
        4.0 * np.pi * radius**2, rel=0.01
    )
    outward = np.einsum("nc,nc->n", mesh.normal, (mesh.xyz - origin) / radius)
    assert outward.min() > 0.95
    # six neighbours lie nearer on the densest lattice, of hexagons, than on a square one
    assert 0.85 * SPACING < report["spacing"] < 1.05 * SPACING
    # cells of the octree are between one and two spacings
    assert 1.0 < 1.1 * 2.0 * radius / 2 ** report["depth"] / report["spacing"] <= 2.0
    north = mesh.xyz[:, 2] - origin[2] > 3 * SPACING
    assert np.abs(mesh.rgb[north] - np.array([200.0, 100, 0])).max() == 0
    assert report["poisson"]["peak_memory_mb"] > 50
    assert [row["count"] for row in report["funnel"]][-1] == len(mesh.faces)


def test_noise_is_averaged_by_the_surface() -> None:
    xyz, normal, rgb, size = sphere(noise=0.3 * SPACING)
    mesh, report = make_mesh(xyz, normal, rgb, size, None, SurfaceOptions())
    radius = SPACING * np.sqrt(6000 / (4.0 * np.pi))
    rms = np.sqrt(np.mean((np.linalg.norm(mesh.xyz, axis=1) - radius) ** 2))
    assert 0.02 * SPACING < rms < 0.25 * SPACING
    assert report["num_rim_edges"] == 0


def test_half_a_sphere_stays_open_and_ends_at_its_patches() -> None:
    xyz, normal, rgb, size = sphere()
    half = xyz[:, 2] > 0.0
    mesh, report = make_mesh(xyz[half], normal[half], rgb[half], size[half], None, SurfaceOptions())
    assert report["num_rim_edges"] > 0
    assert -3.1 * SPACING < mesh.xyz[:, 2].min() < 0.0
    assert np.abs(np.linalg.norm(mesh.xyz[mesh.xyz[:, 2] > 0.0], axis=1) - np.linalg.norm(xyz[0])).max() < SPACING


# away from the sides of the octree's box, and at one of them, where Poisson's surface leaves it
@pytest.mark.parametrize("toward", [np.full(3, 3.0**-0.5), np.array([0.0, 0.0, -1.0])])
def test_a_small_gap_is_closed_and_a_wide_one_stays_if_told_so(toward: NDArray) -> None:
    xyz, normal, rgb, size = sphere()
    radius = np.linalg.norm(xyz[0])
    gap = xyz @ toward > 0.9 * radius  # 5 % of the sphere
    args = (xyz[~gap], normal[~gap], rgb[~gap], size[~gap])
    closed, report = make_mesh(*args, None, SurfaceOptions())
    assert report["num_rim_edges"] == 0
    assert 0.89 * radius < (closed.xyz @ toward).max() < 1.1 * radius
    _, report = make_mesh(*args, None, SurfaceOptions(max_hole=0.0))
    assert report["num_rim_edges"] > 0
    # a camera that looks into the gap would have shown what is there
    facing = scene_of(*(looking_at(6.0 * side, np.zeros(3)) for side in (*np.eye(3), *-np.eye(3), toward)))
    _, report = make_mesh(*args, facing, SurfaceOptions(max_hole=0.1))
    assert report["num_rim_edges"] > 0


def test_nothing_stands_out_of_the_region() -> None:
    xyz, normal, rgb, size = sphere()
    low, high = xyz.min(axis=0) - 1.0, xyz.max(axis=0) + 1.0
    high[2] = 0.7 * xyz[:, 2].max()
    region = Region(low, high)
    kept = region.holds(xyz)
    views = (looking_at(6.0 * side, np.zeros(3)) for side in (*np.eye(3), *-np.eye(3)))
    scene = replace(scene_of(*views), region=region)
    mesh, _ = make_mesh(xyz[kept], normal[kept], rgb[kept], size[kept], scene, SurfaceOptions())
    assert region.holds(mesh.xyz).all()
    assert mesh.xyz[:, 2].max() > high[2] - 1e-9


def test_islands_are_dropped() -> None:
    xyz, normal, rgb, size = sphere()
    speck = xyz[:300] * 0.2 + [0.0, 0.0, 4.0]
    arrays = [
        np.concatenate(pair)
        for pair in zip((xyz, normal, rgb, size), (speck, normal[:300], rgb[:300], size[:300]), strict=True)
    ]
    mesh, _ = make_mesh(*arrays, None, SurfaceOptions(min_island=0.05))
    assert mesh.xyz[:, 2].max() < np.linalg.norm(xyz[0]) + SPACING
    assert len(np.unique(trim.pieces(mesh.faces, len(mesh.xyz)))) == 1
    both, _ = make_mesh(*arrays, None, SurfaceOptions(min_island=0.0))
    assert both.xyz[:, 2].max() > 4.0


def test_what_no_camera_shows_is_cut_off() -> None:
    xyz, normal, rgb, size = sphere()
    radius = np.linalg.norm(xyz[0])
    eye = np.array([0.0, 0.0, 10.0])
    scene = scene_of(looking_at(eye, np.zeros(3)))
    mesh, _ = make_mesh(xyz, normal, rgb, size, scene, SurfaceOptions())
    # from outside, a sphere is seen as far as its tangents: at z = r^2 / distance
    horizon = radius**2 / 10.0
    assert horizon - 2 * SPACING < mesh.xyz[:, 2].min() < horizon + SPACING
    away = scene_of(looking_at(eye, 2.0 * eye))
    with pytest.raises(NoReconstructionError, match="in view"):
        make_mesh(xyz, normal, rgb, size, away, SurfaceOptions())


def test_in_view_knows_frames_and_sides() -> None:
    triangle = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.0, 0.1, 0.0]])
    faces = np.array([[0, 1, 2]], np.int32)  # its front is up
    above, below = np.array([0.0, 0.0, 5.0]), np.array([0.0, 0.0, -5.0])
    for eye, target, expected in [(above, np.zeros(3), True), (below, np.zeros(3), False), (above, above * 2, False)]:
        assert trim.in_view(triangle, faces, scene_of(looking_at(eye, target)))[0] == expected
    # 64 pixels of focal length and of width see half as far aside as they look ahead
    for aside, expected in [(2.4, True), (2.6, False)]:
        shifted = triangle + np.array([aside, 0.0, 0.0])
        assert trim.in_view(shifted, faces, scene_of(looking_at(above, np.zeros(3))))[0] == expected


def test_a_stray_patch_and_finer_images_keep_their_own_scale() -> None:
    grid = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0)), axis=-1).reshape(-1, 2)
    coarse = np.column_stack([grid * 1.0, np.zeros(900)])
    fine = np.column_stack([grid * 0.1 + 100.0, np.zeros(900)])
    xyz = np.concatenate([coarse, fine, [[0.0, 0.0, 50.0]]])
    size = np.concatenate([np.full(900, 0.5), np.full(900, 0.05), [0.5]]).astype(np.float32)
    normal = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(xyz), 1))
    patches = make_patch_cloud(xyz, normal, np.zeros((len(xyz), 3), np.uint8), size, 1)
    np.testing.assert_allclose(patches.spacing[:900], 1.0, rtol=0.1)
    np.testing.assert_allclose(patches.spacing[900:1800], 0.1, rtol=0.1)
    assert patches.spacing[-1] == patches.spacing[0]


def test_too_few_or_coinciding_patches_are_named() -> None:
    xyz, normal, rgb, size = sphere()
    with pytest.raises(NoReconstructionError, match="more than 6 patches, found 3"):
        make_mesh(xyz[:3], normal[:3], rgb[:3], size[:3], None, SurfaceOptions())
    with pytest.raises(NoReconstructionError, match="at least 50 oriented points, found 30"):
        make_mesh(xyz[:30], normal[:30], rgb[:30], size[:30], None, SurfaceOptions())
    with pytest.raises(NoReconstructionError, match="different places"):
        make_mesh(xyz * 0.0, normal, rgb, size, None, SurfaceOptions())


CRASHES = {"os.abort()": "signal SIGABRT", "os.kill(os.getpid(), 9)": "SIGKILL, as when memory runs out",
           "raise ValueError('no more')": "exit code 1, .*ValueError: no more", "pass": "exit code 0"}  # fmt: skip


@pytest.mark.parametrize("code", CRASHES)
def test_a_crash_of_the_child_is_a_message(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "crashing_child.py").write_text(f"import os\n{code}\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(NoReconstructionError, match=CRASHES[code]) as caught:
        child.run_child("crashing_child", "task", {"x": np.zeros(1)}, (), "try less", Events())
    assert caught.value.advice == "try less"


def test_cancelling_kills_the_child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "slow_child.py").write_text(
        f"import os, time\nopen({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\ntime.sleep(60)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    events = Events()
    timer = threading.Timer(1.0, events.cancel)
    timer.start()
    start = time.monotonic()
    with pytest.raises(InterruptedRunError):
        child.run_child("slow_child", "task", {"x": np.zeros(1)}, (), "", events)
    assert time.monotonic() - start < 10.0
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), signal.SIG_DFL)


def test_the_result_does_not_depend_on_threads() -> None:
    xyz, normal, rgb, size = sphere(3000, noise=0.02)
    one, two = (make_mesh(xyz, normal, rgb, size, None, SurfaceOptions(), threads=n)[0] for n in (1, 2))
    for name in ("xyz", "faces", "normal", "rgb"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_open3d_stays_out_of_this_process() -> None:
    code = (
        "import sys; import sfmapp.surface.mesh, sfmapp.formats.glb, sfmapp.formats.mesh_ply;"
        "sys.exit('open3d' in sys.modules)"
    )
    assert os.spawnv(os.P_WAIT, sys.executable, [sys.executable, "-c", code]) == 0


def tube(height: float, step: float = 0.1) -> tuple[NDArray, NDArray]:
    """A round tube of radius 1 from z = 0 up, with a roof: as triangles of about ``step``, open below."""
    num, rings = round(2 * np.pi / step), round(height / step)
    angle = np.arange(num) * 2 * np.pi / num
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(num)], axis=1)
    xyz = np.concatenate([ring + np.array([0, 0, z]) for z in np.linspace(0.0, height, rings + 1)] + [[[0, 0, height]]])
    i = np.arange(num * rings)
    right = i - i % num + (i + 1) % num
    top = np.arange(num * rings, num * (rings + 1))
    roof = np.stack([top, np.roll(top, -1), np.full(num, len(xyz) - 1)], axis=1)
    walls = [np.stack([i, right, right + num], axis=1), np.stack([i, right + num, i + num], axis=1)]
    return xyz, np.concatenate([*walls, roof]).astype(np.int32)


def test_a_tall_balloon_becomes_a_flat_lid() -> None:
    xyz, faces = tube(5.0)
    kept = (xyz[faces][:, :, 2] < 3.0 + 1e-9).all(axis=1)  # 6 pi of wall, and 5 pi of balloon over an opening of pi
    moved, closed = gaps.close_gaps(xyz, faces, kept, None, 0.2, 0.1)
    assert closed.all()
    np.testing.assert_array_equal(moved[np.unique(faces[kept])], xyz[np.unique(faces[kept])])
    np.testing.assert_allclose(moved[:, 2].max(), 3.0, atol=1e-6)
    assert np.linalg.norm(face_vectors(moved, faces[~kept]), axis=1).sum() == pytest.approx(np.pi, rel=0.01)
    # too large a share; nothing is closed
    moved, closed = gaps.close_gaps(xyz, faces, kept, None, 0.15, 0.1)
    np.testing.assert_array_equal(moved, xyz)
    np.testing.assert_array_equal(closed, kept)


def test_a_surface_that_stays_open_has_its_small_holes_closed() -> None:
    xyz, faces = tube(5.0)
    middle = xyz[faces].mean(axis=1)
    is_window = (np.abs(middle[:, 2] - 1.5) < 0.5) & (np.abs(np.arctan2(middle[:, 1], middle[:, 0])) < 0.5)
    below = (xyz[faces][:, :, 2] < 3.0 + 1e-9).all(axis=1)
    area = float(np.linalg.norm(face_vectors(xyz, faces[is_window]), axis=1).sum())
    assert 0.8 < area < 1.2
    kept = below & ~is_window
    # the top is too large a gap: of the window it depends on how large it is beside the spacing, 2 x 2 or 0.4 x 0.4
    _, closed = gaps.close_gaps(xyz, faces, kept, None, 0.15, 0.1)
    np.testing.assert_array_equal(closed, below)
    _, closed = gaps.close_gaps(xyz, faces, kept, None, 0.15, 0.02)
    np.testing.assert_array_equal(closed, kept)
    # nothing is left open: both are closed, however large they are beside the spacing
    _, closed = gaps.close_gaps(xyz, faces, kept, None, 0.25, 0.02)
    assert closed.all()


def test_a_membrane_is_no_smaller_than_what_its_rim_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz, faces = tube(5.0)
    kept = (xyz[faces][:, :, 2] < 3.0 + 1e-9).all(axis=1)
    middle = xyz[faces].mean(axis=1)
    kept &= (np.abs(middle[:, 2] - 1.5) > 0.5) | (np.abs(np.arctan2(middle[:, 1], middle[:, 0])) > 0.5)
    piece = pieces(faces[~kept], len(xyz))
    least = gaps._least_areas(xyz, faces[~kept], piece)
    # the window is what it is, the balloon of 5 pi hangs on a circle, of 63 sides
    flat = gaps._membranes(xyz, faces[~kept], np.isin(np.arange(len(xyz)), faces[kept]))
    area = np.bincount(piece, np.linalg.norm(face_vectors(flat, faces[~kept]), axis=1))
    assert 0.75 < least.min() < 1.1
    assert least.max() == pytest.approx(np.pi, rel=0.01)
    assert (least <= area * (1.0 + 1e-12)).all()
    # what is too large by that alone needs no membrane, and what comes of it is the same
    asked: list[int] = []
    membranes = gaps._membranes

    def counted(xyz: NDArray, faces: NDArray, is_fixed: NDArray) -> NDArray:
        asked.append(len(faces))
        return membranes(xyz, faces, is_fixed)

    monkeypatch.setattr(gaps, "_membranes", counted)
    for share, spacing, num in ((0.15, 0.1, 1), (0.15, 0.02, 0), (0.25, 0.02, 2)):
        asked.clear()
        moved, closed = gaps.close_gaps(xyz, faces, kept, None, share, spacing)
        assert sum(asked) == sum(np.sort(np.bincount(piece))[:num])
        with monkeypatch.context() as nothing:
            nothing.setattr(gaps, "_least_areas", lambda *_: np.zeros(2))
            other, expected = gaps.close_gaps(xyz, faces, kept, None, share, spacing)
        np.testing.assert_array_equal(closed, expected)
        np.testing.assert_allclose(moved, other, atol=1e-12)


def test_a_dome_stays_a_dome() -> None:
    xyz, faces = tube(3.3)
    kept = (xyz[faces][:, :, 2] < 3.0 + 1e-9).all(axis=1)
    moved, closed = gaps.close_gaps(xyz, faces, kept, None, 0.2, 0.1)
    assert closed.all()
    np.testing.assert_array_equal(moved, xyz)  # 1.6 pi over pi


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("depth", 3), ("depth", 20), ("trim_distance", 0.0), ("trim_distance", float("nan")), ("trim_density", 1.0),
        ("min_island", -0.1), ("max_hole", float("nan")), ("texture_px", 10),
    ],
)  # fmt: skip
def test_impossible_options_are_named(field: str, value: float) -> None:
    with pytest.raises(UsageError, match=f"surface.{field}"):
        SurfaceOptions(**{field: value})


def test_the_octree_follows_the_sampling() -> None:
    box = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.2]])
    assert poisson.depth_for(box, 1.1 / 2**9) == 8
    assert poisson.depth_for(box, 1.0) == 6
    assert poisson.depth_for(box, 1e-9) == 12
