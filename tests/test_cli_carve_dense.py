"""``sfmapp carve --with-dense``, on photographs of a trough whose shape is known."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from carving_scenes import around, box, mask_of, without, write_cameras
from sfmapp.carve.files import read_joined, read_octree
from sfmapp.carve.limits import PATCHES
from sfmapp.cli.main import main
from sfmapp.dense.files import write_patches
from sfmapp.dense.scene import Patches
from sfmapp.formats.ply_reader import read_ply_geometry

VIEWS = around(10, 5.0, 120, 90, 50.0)
TROUGH = without(box((0.8, 0.6, 0.5)), box((0.6, 0.4, 0.5), (0.0, 0.0, 0.3)))
VOLUME = 1.6 * 1.2 * 1.0 - 1.2 * 0.8 * 0.7


def patches_inside() -> Patches:
    """The floor and the walls of the trough, and which views look at them from the right side."""
    rng = np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(-0.6, 0.6, 4000), rng.uniform(-0.4, 0.4, 4000), np.full(4000, -0.2)])
    points, normals = [floor], [np.tile([0.0, 0.0, 1.0], (4000, 1))]
    for axis, half, other in ((0, 0.6, 0.4), (1, 0.4, 0.6)):
        for sign in (-1.0, 1.0):
            wall = np.empty((2000, 3))
            wall[:, axis], wall[:, 1 - axis] = sign * half, rng.uniform(-other, other, 2000)
            wall[:, 2] = rng.uniform(-0.2, 0.5, 2000)
            points.append(wall)
            normals.append(np.tile(-sign * np.eye(3)[axis], (2000, 1)))
    xyz, normal = np.concatenate(points), np.concatenate(normals)
    seen = np.stack([sees(xyz, normal, view.center) for view in VIEWS], axis=1)
    xyz, normal, seen = xyz[seen.any(axis=1)], normal[seen.any(axis=1)], seen[seen.any(axis=1)]
    point, view_idx = np.nonzero(seen)
    ptr, num = np.concatenate([[0], np.cumsum(np.bincount(point))]), len(xyz)
    return Patches(
        xyz, normal.astype(np.float32), np.full((num, 3), 90, np.uint8), np.ones(num, np.float32),
        np.full(num, 1e-3, np.float32), np.full(num, 0.025, np.float32), np.zeros(num, np.int32), ptr,
        view_idx.astype(np.int32),
    )  # fmt: skip


def sees(xyz: NDArray[np.float64], normal: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points face a camera and nothing of the trough is between."""
    ways = np.linspace(0.02, 0.5, 40)[:, None, None]
    between = xyz + ways * (center - xyz)
    is_free = (TROUGH(between.reshape(-1, 3)).reshape(len(ways), len(xyz)) > -1e-3).all(axis=0)
    return np.asarray(is_free & (((center - xyz) * normal).sum(axis=1) > 0.5))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trough")
    (folder / "images").mkdir()
    for view in VIEWS:
        assert view.camera is not None
        shown = mask_of(view, TROUGH)
        cv2.imwrite(str(folder / "images" / view.name), np.uint8(255) * np.repeat(shown[..., None], 4, axis=2))
    write_cameras(folder, VIEWS)
    return folder


def carve(*args: object) -> int:
    return main(["carve", *map(str, args), "--cells", "64", "--no-recording", "-q"])


@pytest.fixture(scope="module")
def joined(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with patches.npz and the result of carving with them, out/; to be read only."""
    folder = tmp_path_factory.mktemp("joined")
    write_patches(folder / "patches.npz", patches_inside(), [view.name for view in VIEWS])
    assert carve(photographs, "-o", folder / "out", "--with-dense", folder / "patches.npz") == 0
    return folder


def test_patches_hollow_out_what_silhouettes_leave_full(joined: Path) -> None:
    report = json.loads((joined / "out" / "report.json").read_text())
    # ten outlines leave a good deal below the trough as well, and that stays as far as they ask for it
    assert report["joining"]["hull_volume"] > 2.0 * VOLUME
    assert 0.97 * VOLUME < report["surface"]["volume"] < 1.3 * VOLUME
    assert report["carving"]["volume_low"] < report["surface"]["volume"] < report["carving"]["volume_high"]
    assert "joined.npz" in report["files"]
    inner, outer = read_octree(joined / "out" / "joined.npz").volume_bounds()
    assert inner < report["surface"]["volume"] < outer


def test_the_surface_says_what_tells_it_and_a_second_call_joins_no_more(
    photographs: Path, joined: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(joined / "out", tmp_path / "out"))
    call = photographs, "-o", out, "--with-dense", joined / "patches.npz"
    limits = json.loads((out / "report.json").read_text())["limits"]
    first = (out / "mesh.ply").read_bytes()
    header, body = first.split(b"end_header\n", 1)
    assert b"comment evidence: 0 unseen, 1 closure, 2 outlines, 3 patches\n" in header
    assert header.endswith(b"property uchar evidence\nelement face " + header.split(b"element face ")[1])
    num = int(header.split(b"element vertex ")[1].split()[0])
    fields = [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3), ("evidence", "u1")]
    vertices = np.frombuffer(body, fields, num)
    assert len(read_ply_geometry(out / "mesh.ply").xyz) == num
    floor = np.abs(vertices["xyz"] - (0.0, 0.0, -0.2)).max(axis=1) < 0.3
    assert (vertices["evidence"][floor & (vertices["normal"][:, 2] > 0.9)] == PATCHES).all()
    assert (vertices["evidence"] == PATCHES).mean() == pytest.approx(limits["patches_share"], abs=0.1)
    # of a trough that patches tell, the volume is bounded by its outlines still
    assert limits["volume_high"] > VOLUME

    assert carve(*call) == 0
    decisions = json.loads((out / "report.json").read_text())["decisions"]
    assert any("joined by an earlier call" in decision["message"] for decision in decisions)
    assert (out / "mesh.ply").read_bytes() == first
    (out / "joined.npz").write_bytes((out / "joined.npz").read_bytes()[:1000])
    assert carve(*call) == 0
    assert (out / "mesh.ply").read_bytes() == first
    assert read_joined(out / "joined.npz").tree.cell > 0.0


def test_missing_or_foreign_patches_are_named(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert carve(photographs, "-o", tmp_path / "a", "--with-dense") == 3
    assert "found nothing" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
    write_patches(tmp_path / "patches.npz", patches_inside(), [f"other_{view.name}" for view in VIEWS])
    assert carve(photographs, "-o", tmp_path / "b", "--with-dense", tmp_path / "patches.npz") == 3
    assert "of the same model" in capsys.readouterr().err
