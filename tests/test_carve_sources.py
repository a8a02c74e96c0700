"""Photographs with cameras of all forms that carving takes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from carving_scenes import around
from sfmapp.carve.views import View, project_points
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.middlebury_multiview import read_middlebury
from sfmapp.formats.projection_matrices import read_projection_matrices
from sfmapp.geometry import rigid3
from sfmapp.pipelines.carve.sources import find_views
from sfmapp.workspace.options import Options, load_options

VIEWS = around(4, width=64, height=48)


def matrices(views: list[View] = VIEWS) -> np.ndarray:
    """As others write them, with the first pixel's centre at (0, 0)."""
    half = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
    return np.array([half @ view.camera.k_matrix @ view.outer for view in views if view.camera is not None])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    for view in VIEWS:
        cv2.imwrite(str(tmp_path / "images" / view.name), np.zeros((48, 64, 3), np.uint8))
    return tmp_path


def check(folder: Path, poses: Path | None = None, options: Options | None = None) -> None:
    found = find_views(folder, None, poses, options or Options())
    assert [view.name for view in found.views] == [view.name for view in VIEWS]
    xyz = np.random.default_rng(0).uniform(-1.0, 1.0, (9, 3))
    ours, known = np.empty((9, 3)), np.empty((9, 3))
    for view, truth in zip(found.views, VIEWS, strict=True):
        project_points(view.row, xyz, ours)
        project_points(truth.row, xyz, known)
        assert ours == pytest.approx(known, abs=1e-5)


def write_list(folder: Path) -> None:
    entries = []
    for view, matrix in zip(VIEWS, matrices(), strict=True):
        k = matrix[:, :3] @ np.linalg.inv(view.outer[:, :3])
        entries.append({
            "file": f"images/{view.name}", "K": k.round(9).tolist(), "R_w2c": view.outer[:, :3].tolist(),
            "t_w2c": view.outer[:, 3].tolist(), "width": 64, "height": 48,
        })  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps({"cameras": entries}))


def write_middlebury(folder: Path) -> None:
    lines = [str(len(VIEWS))]
    for view in VIEWS:
        assert view.camera is not None
        k = view.camera.k_matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        values = np.concatenate([k.ravel(), view.outer[:, :3].ravel(), view.outer[:, 3]])
        lines.append(" ".join([view.name, *map(repr, values.tolist())]))
    (folder / "box_par.txt").write_text("\n".join(lines) + "\n")


def write_cells(folder: Path) -> None:
    cells = np.empty((1, 4), object)
    cells[0] = list(matrices())
    savemat(folder / "P.mat", {"P": cells, "note": "from a turntable"})


def write_stack(folder: Path) -> None:
    savemat(folder / "P.mat", {"P": np.moveaxis(matrices(), 0, 2)})


def write_array(folder: Path) -> None:
    np.save(folder / "P.npy", matrices())


def write_archive(folder: Path) -> None:
    listed = {f"world_mat_{i}": np.vstack([p, [0, 0, 0, 1]]) for i, p in enumerate(matrices())}
    scales = {f"scale_mat_{i}": np.eye(4) for i in range(4)}
    np.savez(folder / "cameras.npz", allow_pickle=False, **listed, **scales)


def write_files(folder: Path) -> None:
    (folder / "txt").mkdir()
    for view, p in zip(VIEWS, matrices(), strict=True):
        rows = "\n".join(" ".join(map(repr, row)) for row in p.tolist())
        (folder / "txt" / Path(view.name).with_suffix(".txt")).write_text(f"CONTOUR\n{rows}\n")


@pytest.mark.parametrize(
    "write", [write_list, write_middlebury, write_cells, write_stack, write_array, write_archive, write_files]
)
def test_cameras_are_found_in_the_folder(folder: Path, write: object) -> None:
    assert callable(write)
    write(folder)
    check(folder)


def test_cameras_in_a_file_that_is_named(folder: Path) -> None:
    lines = [f"{v.name} " + " ".join(map(repr, p.ravel().tolist())) for v, p in zip(VIEWS, matrices(), strict=True)]
    (folder / "named.txt").write_text("# name and matrix\n" + "\n".join(lines[::-1]) + "\n")
    check(folder, folder / "named.txt")
    poses = [rigid3.inverse(view.cam_from_world) for view in VIEWS if view.cam_from_world is not None]
    rows = [f"{i:05d} " + " ".join(map(repr, [*p[4:].tolist(), *p[:4].tolist()])) for i, p in enumerate(poses)]
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    camera = VIEWS[0].camera
    assert camera is not None
    given = "images.camera=" + ",".join(["PINHOLE", *map(str, camera.params.tolist())])
    check(folder, folder / "poses.txt", load_options([], [given]))
    with pytest.raises(UsageError, match="come without cameras"):
        find_views(folder, None, folder / "poses.txt", Options())


def test_what_does_not_fit_is_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="expected cameras of the photographs"):
        find_views(folder, None, None, Options())
    np.save(folder / "P.npy", matrices()[:3])
    with pytest.raises(InputError, match="a matrix for each of 4 photographs, found 3"):
        find_views(folder, None, None, Options())
    rigid = np.array([view.outer for view in VIEWS])
    np.save(folder / "P.npy", rigid)
    with pytest.raises(InputError, match="found rotations"):
        find_views(folder, None, None, Options())
    with pytest.raises(InputError, match="found nothing"):
        find_views(tmp_path / "absent", None, None, Options())
    for view in VIEWS[1:]:
        (folder / "images" / view.name).unlink()
    np.save(folder / "P.npy", matrices()[:1])
    with pytest.raises(InputError, match="two photographs with cameras or more, found 1"):
        find_views(folder, None, None, Options())


def test_a_photograph_without_a_camera_is_left_out(folder: Path) -> None:
    write_middlebury(folder)
    cv2.imwrite(str(folder / "images" / "other.png"), np.zeros((48, 64, 3), np.uint8))
    found = find_views(folder, None, None, Options())
    assert len(found.views) == 4
    assert found.left_out == (("other.png", "has no camera"),)


@pytest.mark.parametrize("name", ["bad.mat", "bad.npy", "bad.npz", "bad.txt", "bad.xyz"])
def test_damaged_files_are_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"1 2 3 nonsense\x00")
    with pytest.raises(InputError, match=name):
        read_projection_matrices(path)
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(InputError, match=r"objects\.npy"):
        read_projection_matrices(tmp_path / "objects.npy")


def test_a_line_that_is_no_camera_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x_par.txt"
    path.write_text("2\na.png 1 2 3\n")
    with pytest.raises(InputError, match="expected 2 cameras"):
        read_middlebury(path)
    path.write_text("a.png 1 2 3\n")
    with pytest.raises(InputError, match=r"a\.png: expected NAME and 21"):
        read_middlebury(path)
