"""``sfmapp sweep`` from the command line."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sfmapp.pipelines.sweep.run as sweep_pipeline
from dense_models import DEPTH, write_wall
from schemas import check_schema
from sfmapp.carve.feature_occupancy import FeatureOccupancy
from sfmapp.carve.plane_sweep import SweptPlanes
from sfmapp.cli.main import main
from sfmapp.dense.scene import DenseScene
from sfmapp.geometry import rigid3
from sfmapp.viewer.sweep_recording import ShownMap, make_sweep_replay


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wall")
    write_wall(folder, 4)
    return folder


def swept(wall: Path, out: Path, *flags: str) -> int:
    return main(["sweep", str(wall / "sparse" / "0"), "-o", str(out), "--no-recording", *flags])


def test_depth_maps_of_a_wall_are_those_of_its_plane(
    wall: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "depth"
    assert swept(wall, out, "--threads", "2") == 0
    assert "4 depth maps" in capsys.readouterr().out
    views = json.loads((out / "maps" / "views.json").read_text())
    report = json.loads((out / "report.json").read_text())
    check_schema("sweep", report)
    assert len(views) == len(report["maps"]) == 4
    for view, row in zip(views, report["maps"], strict=True):
        base = out / "maps" / view["name"]
        depth, sigma, confidence = (
            np.load(base.with_name(f"{base.name}.{what}.npy")) for what in ("depth", "sigma", "confidence")
        )
        known = np.isfinite(depth)
        assert known.mean() == pytest.approx(row["confirmed"])
        assert known.mean() > 0.75
        assert (known == np.isfinite(sigma)).all()
        assert (known == (confidence > 0.0)).all()
        v, u = np.mgrid[: view["height"], : view["width"]] + 0.5
        fx, fy, cx, cy = view["k"]
        pose = np.array(view["cam_from_world"])
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) @ rigid3.rotation_matrix(pose)
        true = (DEPTH - rigid3.center(pose)[2]) / rays[..., 2]
        step = (1.0 / row["near"] - 1.0 / row["far"]) / (row["num_planes"] - 1)
        off = np.abs(1.0 / depth - 1.0 / true)[known] / step
        # in planes, for on pictures so small one is some per cent of the depth
        assert np.median(off) < 0.15
        assert np.quantile(off, 0.95) < 0.5
        assert (base.with_name(f"{base.name}.depth.png")).is_file()
    assert not (out / "unconfirmed").exists()


def test_bytes_do_not_depend_on_threads(wall: Path, tmp_path: Path) -> None:
    for threads in ("1", "2"):
        assert swept(wall, tmp_path / threads, "--threads", threads, "--level", "1", "-q") == 0
    for name in ("view_0.png.depth.npy", "view_3.png.sigma.npy"):
        assert (tmp_path / "1" / "maps" / name).read_bytes() == (tmp_path / "2" / "maps" / name).read_bytes()


def test_what_is_no_model_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", str(tmp_path), "-o", str(tmp_path / "out")]) != 0
    assert "expected a workspace of sfmapp or a COLMAP model" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["sweep_planes", "exchange_planes"])
def test_a_call_that_was_stopped_goes_on(
    wall: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    assert swept(wall, tmp_path / "whole", "--level", "1", "-q") == 0
    calls: list[int] = []
    usual = getattr(sweep_pipeline, name)

    def stopped(scene: DenseScene, view: int, *rest: Any) -> SweptPlanes:
        calls.append(view)
        if len(calls) == 3:
            raise KeyboardInterrupt
        found: SweptPlanes = usual(scene, view, *rest)
        return found

    monkeypatch.setattr(sweep_pipeline, name, stopped)
    out = tmp_path / "stopped"
    with contextlib.suppress(KeyboardInterrupt):
        assert swept(wall, out, "--level", "1", "-q") != 0
    assert len(calls) == 3
    assert swept(wall, out, "--level", "1", "-q") == 0
    # two of four were there
    assert len(calls) == 5
    for path in (tmp_path / "whole" / "maps").iterdir():
        assert path.read_bytes() == (out / "maps" / path.name).read_bytes()
    assert not (out / "unconfirmed").exists()


def test_page_occupancy_and_recording(wall: Path, tmp_path: Path) -> None:
    model, out = str(wall / "sparse" / "0"), str(tmp_path / "out")
    assert main(["sweep", model, "-o", out, "--level", "1", "--occupancy", "24", "-q"]) == 0
    assert (tmp_path / "out" / "recording.rrd").read_bytes()[:4] == b"RRF2"
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<img") >= 4 * 3
    assert "view_0.png" in page
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    check_schema("sweep", report)
    with np.load(tmp_path / "out" / "occupancy.npz") as volume:
        assert list(volume["votes"].shape[::-1]) == report["occupancy"]["cells"]
        assert volume["is_feature"].sum() == report["occupancy"]["num_features"]
        assert (volume["votes"][volume["is_feature"]] >= 3).all()
    assert (tmp_path / "out" / "occupancy.ply").is_file()
    assert swept(wall, tmp_path / "few", "--occupancy", "2", "-q") == 2


def test_the_recording_shows_points_of_maps_where_they_are_in_the_world() -> None:
    depth = np.full((40, 60), np.nan, np.float32)
    depth[10:30, 20:50] = 4.0
    pose = np.concatenate([rigid3.quaternion(np.diag([1.0, -1.0, -1.0])), [3.0, 2.0, 1.0]])
    rgb = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    shown = ShownMap("a.png", "", rgb, depth, 0.01 * depth, np.array([50.0, 50.0, 30.0, 20.0]), pose)
    volume = FeatureOccupancy(
        np.array([-1.0, -2.0, -3.0]), 0.5, *np.full((2, 4, 6, 8), 5, np.uint8), np.arange(192).reshape(4, 6, 8) == 0
    )
    replay = make_sweep_replay("", "", [shown, shown], volume)
    places = rigid3.apply(pose, replay.xyz[: replay.map_ptr[1]] + replay.origin)
    np.testing.assert_allclose(places[:, 2], 4.0, atol=1e-5)
    v, u = np.nonzero(np.isfinite(depth))
    np.testing.assert_allclose(50.0 * places[:, 0] / 4.0 + 30.0, u + 0.5, atol=1e-3)
    assert (replay.rgb[: replay.map_ptr[1]] == rgb[v, u]).all()
    assert replay.map_ptr.tolist() == [0, 600, 1200]
    np.testing.assert_allclose(replay.cell_xyz + replay.origin, [[-0.75, -1.75, -2.75]], atol=1e-5)
    np.testing.assert_allclose(replay.box + replay.origin, [[-1.0, -2.0, -3.0], [3.0, 1.0, -1.0]], atol=1e-5)
