"""``sfmapp dense``, ``sfmapp mesh`` and ``sfmapp reconstruct --dense --mesh`` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dense_models import write_wall
from sfmapp.cli.main import main


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wall")
    write_wall(folder, 4)
    return folder


FAST = ["--preset", "fast", "--threads", "1", "--no-recording"]


def test_dense_and_mesh(wall: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = wall / "out"
    # the photographs lie where COLMAP has them
    assert main(["dense", str(wall / "sparse" / "0"), "-o", str(out), *FAST, "--maps"]) == 0
    said = capsys.readouterr().out
    assert "patches from 4 views" in said
    assert str(out / "dense" / "fused.ply") in said
    assert (out / "dense" / "maps" / "view_0.png.depth.npy").is_file()
    assert main(["dense", str(out), *FAST]) == 0
    assert "up to date" in capsys.readouterr().out
    assert main(["mesh", str(out), "--threads", "1", "--no-recording", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["exit_code"] == 0
    assert Path(result["mesh"]).is_file()
    assert Path(result["glb"]).is_file()
    assert result["num_faces"] > 100


def test_json_and_flags(wall: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for m in range(4):
        mask = np.full((140, 200), 255, np.uint8)
        mask[:, :100] = 0
        cv2.imwrite(str(masks / f"view_{m}.png.png"), mask)
    command = ["dense", str(wall), "--images", str(wall / "images"), "-o", str(tmp_path / "out"), *FAST, "--json"]
    command += ["--mask-path", str(masks), "--region", "-9", "-9", "3", "9", "9", "5", "--max-memory", "2000"]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["num_patches"] > 500
    assert 0.9 < result["shares"]["textured"] <= 1.0
    with np.load(result["patches"], allow_pickle=False) as archive:
        reference, xyz = archive["reference"], archive["xyz"]
    # nothing has its reference where the mask is black
    from sfmapp.camera.camera import project
    from sfmapp.formats.colmap import read_model
    from sfmapp.geometry import rigid3

    model, _ = read_model(wall / "sparse" / "0")
    for m in range(4):
        x = project(model.cameras[m], rigid3.apply(model.cam_from_world[m], xyz[reference == m]))[:, 0]
        assert (x > 98).all()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["dense", "NONE", "-o", "OUT"], 3, "no such folder"),
        (["dense", "MODEL", "-o", "OUT", "--images", "EMPTY"], 3, "view_0.png"),
        (["dense", "MODEL", "-o", "OUT", "--level", "9"], 2, "dense.level"),
        (["dense", "MODEL", "-o", "OUT", "--level", "1", "--ground-sampling", "0.1"], 2, "both set"),
        (["dense", "MODEL", "-o", "OUT", "--region", "1", "1", "1", "0", "0", "0"], 2, "dense.region"),
        (["dense", "MODEL", "-o", "OUT", "--mask-path", "NONE"], 3, "NONE"),
        (["dense", "MODEL", "-o", "EMPTY/../FULL"], 2, "is not empty"),
        (["mesh", "EMPTY"], 3, "not a workspace"),
        (["mesh", "NONE.ply", "-o", "OUT"], 3, "NONE.ply"),
    ],
)
def test_bad_input(
    wall: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    (tmp_path / "EMPTY").mkdir()
    (tmp_path / "FULL").mkdir()
    (tmp_path / "FULL" / "thesis.txt").write_text("the only copy")
    places = {"MODEL": str(wall / "sparse" / "0"), "OUT": str(tmp_path / "out")}

    def place(word: str) -> str:
        if word in places:
            return places[word]
        return str(tmp_path / word) if word.partition("/")[0].isupper() else word

    assert main([place(word) for word in arguments]) == code
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said


def test_a_workspace_without_patches(tmp_path: Path, wall: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["dense", str(wall / "sparse" / "0"), "-o", str(tmp_path / "out"), *FAST, "--set", "dense.cell_px=4"]) == 0
    )
    (tmp_path / "out" / "dense" / "patches.npz").unlink()
    assert main(["mesh", str(tmp_path / "out")]) == 3
    assert "sfmapp dense" in capsys.readouterr().err


def test_photographs_to_mesh_in_one_go(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    settings = ["--preset", "fast", "--threads", "1", "--set", "dense.level=1", "--no-recording"]
    assert main(["reconstruct", str(photos), "-o", str(out), "--mesh", *settings, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["num_registered"] == 7
    assert result["dense"]["num_patches"] > 3000
    assert result["mesh"]["num_faces"] > 1000
    for name in ("sparse/0/images.bin", "dense/fused.ply", "dense/patches.npz", "mesh/mesh.ply", "mesh/mesh.glb"):
        assert (out / name).is_file()
    report = json.loads((out / "report.json").read_text())
    # the report of the reconstruction is still there
    assert len(report["images"]) == 7
    assert {"mapping", "dense", "mesh"} <= set(report["stages"])
    assert report["dense"]["mesh"]["num_faces"] == result["mesh"]["num_faces"]
    manifest = json.loads((out / "run.json").read_text())
    assert manifest["command"] == "reconstruct"
    assert all(manifest["stages"][name]["is_done"] for name in ("mapping", "dense", "mesh"))
    assert manifest["source"] == str(photos)
    # and again: nothing to do
    assert main(["reconstruct", str(photos), "-o", str(out), "--mesh", *settings]) == 0
    assert capsys.readouterr().out.count("up to date") == 3
