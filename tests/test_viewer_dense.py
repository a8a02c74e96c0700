"""The recording of a dense result: nothing is lost on the way, and it says so where something is left out."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.cli.main import main
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.geometry import rigid3
from sfmapp.scene.mesh import Mesh, vertex_normals
from sfmapp.viewer import view as view_module
from sfmapp.viewer.dense_recording import record_dense
from sfmapp.viewer.dense_replay import MAX_STEPS, make_dense_replay, thinned, wave_steps

WIDTH, HEIGHT, DEPTH = 200, 120, 5.0


def make_scene(origin: NDArray[np.float64] | None = None) -> DenseScene:
    """Four cameras in a row that look along z of a world with y down."""
    rng = np.random.default_rng(0)
    centers = np.stack([0.5 * np.arange(4), np.zeros(4), np.zeros(4)], 1) + (0.0 if origin is None else origin)
    views = tuple(
        DenseView(
            f"a b/{m} ü.jpg", rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8), None,
            np.array([180.0, 180.0, 100.0, 60.0]), np.concatenate([rigid3.IDENTITY[:4], -center]),
        )
        for m, center in enumerate(centers)
    )  # fmt: skip
    neighbors = np.array([[b for b in range(4) if b != a] for a in range(4)], np.int32)
    none = np.zeros(0, np.int32)
    return DenseScene(views, neighbors, np.zeros((0, 3)), np.zeros(1, np.int64), none)


def make_patches(waves: NDArray[np.integer], origin: NDArray[np.float64] | None = None) -> Patches:
    """Patches on the wall z = DEPTH, a pixel of DEPTH / 180 apart, seen by three or four views."""
    n, rng = len(waves), np.random.default_rng(1)
    pixel, side = DEPTH / 180.0, int(np.ceil(np.sqrt(n)))
    place = np.arange(n)
    xyz = np.stack([pixel * (place % side), pixel * (place // side), np.full(n, DEPTH)], axis=1)
    counts = rng.integers(3, 5, n)
    return Patches(
        xyz + (0.0 if origin is None else origin), np.tile(np.float32([0, 0, -1]), (n, 1)),
        rng.integers(0, 255, (n, 3)).astype(np.uint8), rng.uniform(0.7, 1.0, n).astype(np.float32),
        np.full(n, 0.1 * pixel, np.float32), np.full(n, pixel, np.float32), waves.astype(np.int32),
        np.concatenate([[0], np.cumsum(counts)]), np.array([m for c in counts for m in range(c)], np.int32),
    )  # fmt: skip


def growing(n: int = 3000, num_waves: int = 12) -> NDArray[np.int32]:
    """Waves (n,) not in order, the first the largest, the last but one empty."""
    wave = np.random.default_rng(2).geometric(0.3, n) - 1
    wave = np.minimum(wave, num_waves - 3)
    wave[:5] = num_waves - 1
    return wave.astype(np.int32)


def make_mesh() -> Mesh:
    xyz = np.array([[0.0, 0, DEPTH], [1, 0, DEPTH], [0, 1, DEPTH], [1, 1, DEPTH]])
    faces = np.array([[0, 2, 1], [1, 2, 3]], np.int32)
    return Mesh(xyz, faces, vertex_normals(xyz, faces), np.full((4, 3), 200, np.uint8))


def chunks_of(path: Path) -> dict[str, list[Any]]:
    """The record batches of each entity, read back by rerun."""
    reader_of = pytest.importorskip("rerun.chunk").RrdReader
    reader = reader_of(path)
    assert [entry.application_id for entry in reader.blueprints()] == ["sfmapp dense"]
    found: dict[str, list[Any]] = {}
    for chunk in reader.stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def values_of(batches: list[Any], component: str) -> list[Any]:
    """The rows of a component, whatever chunks they are in."""
    return [row for b in batches for name in b.schema.names if name == component for row in b[name].to_pylist() if row]


def test_a_recording_holds_every_patch_at_its_wave(tmp_path: Path) -> None:
    wave = growing()
    scene, patches, path = make_scene(), make_patches(wave), tmp_path / "recording.rrd"
    report = record_dense(path, scene, patches, mesh=make_mesh(), title="wall")
    assert report.problem == ""
    assert report.num_bytes == path.stat().st_size
    assert list(tmp_path.iterdir()) == [path]  # nothing is left over
    found = chunks_of(path)
    shown = []
    for number in np.unique(wave):
        batches = found[f"/world/scene/patches/wave{number}"]
        assert [b["wave"].to_pylist() for b in batches] == [[number]]
        (places,) = values_of(batches, "Points3D:positions")
        assert len(places) == (wave == number).sum()
        shown += places
    np.testing.assert_allclose(sorted(map(tuple, shown)), sorted(map(tuple, patches.xyz.astype(np.float32))))
    assert len([name for name in found if "/patches/" in name]) == len(np.unique(wave))
    for name in ("views", "score", "sigma"):
        (colors,) = values_of(found[f"/world/scene/{name}"], "Points3D:colors")
        assert len(colors) == len(patches)
    # three views or four are two colours, a single deviation is one
    assert len(set(values_of(found["/world/scene/views"], "Points3D:colors")[0])) == 2
    assert len(set(values_of(found["/world/scene/sigma"], "Points3D:colors")[0])) == 1
    totals = dict(
        zip(
            [w for b in found["/plots/patches"] if "wave" in b.schema.names for w in b["wave"].to_pylist()],
            [row[0] for row in values_of(found["/plots/patches"], "Scalars:scalars")],
            strict=True,
        )
    )
    assert totals == {number: (wave <= number).sum() for number in np.unique(wave)}
    cameras = [name for name in found if name.startswith("/world/scene/cameras/")]
    assert len(cameras) == 4
    for name in cameras:
        assert len(values_of(found[name], "EncodedImage:blob")) == 1
        assert len(values_of(found[name], "Pinhole:image_from_camera")) == 1
    assert len(values_of(found["/world/scene/mesh"], "Mesh3D:triangle_indices")[0]) == 2
    assert "3000 patches" in values_of(found["/about"], "TextDocument:text")[0][0]


def test_a_thinned_recording_says_so_and_keeps_the_true_totals(tmp_path: Path) -> None:
    patches, path = make_patches(growing()), tmp_path / "recording.rrd"
    assert record_dense(path, make_scene(), patches, max_points=1000).problem == ""
    found = chunks_of(path)
    assert len(values_of(found["/world/scene/score"], "Points3D:positions")[0]) == 1000
    assert values_of(found["/plots/patches"], "Scalars:scalars")[-1] == [3000.0]
    assert "1000 of them are shown" in values_of(found["/about"], "TextDocument:text")[0][0]
    assert "/world/scene/mesh" not in found


def test_a_textured_mesh_keeps_its_texture(tmp_path: Path) -> None:
    texture = np.random.default_rng(3).integers(0, 255, (8, 16, 3)).astype(np.uint8)
    mesh = replace(make_mesh(), uv=np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32), texture=texture)
    path = tmp_path / "recording.rrd"
    assert record_dense(path, make_scene(), make_patches(growing()), mesh=mesh).problem == ""
    found = chunks_of(path)["/world/scene/mesh"]
    (buffer,) = values_of(found, "Mesh3D:albedo_texture_buffer")
    assert bytes(buffer[0]) == texture.tobytes()
    assert len(values_of(found, "Mesh3D:vertex_texcoords")[0]) == 4
    assert not values_of(found, "Mesh3D:vertex_colors")


def test_a_recording_of_no_patches_is_still_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    assert record_dense(path, make_scene(), make_patches(np.zeros(0, np.int32))).problem == ""
    assert "0 patches" in values_of(chunks_of(path)["/about"], "TextDocument:text")[0][0]


def test_a_crash_of_the_other_process_is_a_report_and_leaves_the_older_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.rrd"
    path.write_text("older")
    monkeypatch.setattr(sys, "executable", "/bin/false")
    report = record_dense(path, make_scene(), make_patches(growing()))
    assert report.path is None
    assert "exit code 1" in report.problem
    assert path.read_text() == "older"


def test_many_waves_share_steps_and_lose_no_patch() -> None:
    wave = np.repeat(np.arange(200), np.maximum(1, 2000 // (1 + np.arange(200)) ** 2))
    steps = wave_steps(wave)
    assert len(steps) <= MAX_STEPS
    assert steps[0] == 0  # the seeds are a step of their own
    assert steps[-1] == 199
    replay = make_dense_replay(make_scene(), make_patches(wave))
    assert replay.step_ptr[-1] == replay.step_total[-1] == len(wave)
    assert (np.diff(replay.step_ptr) > 0).all()
    assert wave_steps(np.array([0, 0, 3, 7])).tolist() == [0, 3, 7]
    assert wave_steps(np.zeros(0, np.int32)).tolist() == []


def test_thinning_is_even_and_the_same_every_time() -> None:
    kept = thinned(100_000, 10_000)
    assert (np.diff(kept) > 0).all()
    np.testing.assert_array_equal(kept, thinned(100_000, 10_000))
    per_tenth = np.bincount(kept // 10_000, minlength=10)
    # 1000 expected, deviation sqrt(10000 0.1 0.9 0.9) = 28
    assert (np.abs(per_tenth - 1000) < 5 * 28).all()
    assert thinned(5, 10).tolist() == [0, 1, 2, 3, 4]


def test_points_just_close_up() -> None:
    pixel = DEPTH / 180.0
    replay = make_dense_replay(make_scene(), make_patches(growing(2500)))
    np.testing.assert_allclose(replay.radius, pixel, rtol=1e-4)
    # a quarter of the patches on the same wall lie about twice as far apart at most
    few = make_dense_replay(make_scene(), make_patches(growing(2500)), max_points=625)
    assert 1.0 * pixel <= few.radius[0] < 2.5 * pixel


def test_far_from_the_origin_places_keep_their_precision() -> None:
    origin = np.array([4.5e5, 5.2e6, 300.0])
    here = make_dense_replay(make_scene(), make_patches(growing()))
    far = make_dense_replay(make_scene(origin), make_patches(growing(), origin), mesh=make_mesh())
    assert not here.origin.any()
    shift = far.origin - origin
    np.testing.assert_allclose(far.xyz + shift, here.xyz, atol=1e-6)
    # the cameras came along
    np.testing.assert_allclose(rigid3.center(far.cam_from_world) + shift, rigid3.center(here.cam_from_world), atol=1e-8)


def test_photographs_are_shrunk_with_their_cameras() -> None:
    scene = make_scene()
    big = tuple(
        DenseView(v.name, np.repeat(np.repeat(v.rgb, 8, 0), 8, 1), None, 8 * v.k, v.cam_from_world) for v in scene.views
    )
    replay = make_dense_replay(
        DenseScene(big, scene.neighbors, scene.point_xyz, scene.point_ptr, scene.point_view_idx),
        make_patches(growing()),
    )
    assert replay.view_size.tolist() == [[640, 384]] * 4
    np.testing.assert_allclose(replay.view_k[0], 3.2 * scene.views[0].k)


def test_view_shows_the_surface_where_there_is_one_and_names_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[Path] = []
    monkeypatch.setattr(view_module, "view", lambda recording, **_: shown.append(recording))
    sparse, dense = tmp_path / "recording.rrd", tmp_path / "dense" / "recording.rrd"
    sparse.touch()
    assert main(["view", str(tmp_path)]) == 0
    dense.parent.mkdir()
    dense.touch()
    assert main(["view", str(tmp_path)]) == 0
    assert f"sfmapp view {sparse}" in capsys.readouterr().out
    assert main(["view", str(sparse)]) == 0
    assert shown == [sparse, dense, sparse]
