"""``sfmapp validate --ground-ground_truth-cloud``: known shifts come out as scores, in any frame, from clouds and from
meshes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas import check_schema
from sfmapp.cli.main import main
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.colmap import write_model
from sfmapp.formats.ply import write_ply
from sfmapp.geometry import rigid3, similarity
from sfmapp.pipelines.validate_cloud import validate_cloud
from sfmapp.reporting import plain
from sfmapp.scene.synthetic import make_scene
from sfmapp.viewer.cloud_error import error_colors

SIZE = 1 / 64  # sums of it are exact


def floor(count: int = 60) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(count) * SIZE, np.arange(count) * SIZE)
    return np.stack([x.ravel(), y.ravel(), np.zeros(count * count)], 1)


def save(path: Path, xyz: NDArray[np.float64]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, xyz, np.zeros((len(xyz), 3), np.uint8))
    return path


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A cloud of which a half lies 1.5 pixels too high, and a quarter of the ground truth is not there."""
    cloud = floor()[: 45 * 60]
    cloud[::2, 2] += 1.5 * SIZE
    save(tmp_path / "out" / "dense" / "fused.ply", cloud)
    np.savez(tmp_path / "out" / "dense" / "patches.npz", size=np.full(len(cloud), SIZE, np.float32))
    return tmp_path / "out"


def test_known_errors_are_told_at_one_two_and_five_pixels(workspace: Path, tmp_path: Path) -> None:
    ground_truth = save(tmp_path / "ground_truth.ply", floor())
    result = validate_cloud(workspace, ground_truth)
    assert result.distance == pytest.approx(SIZE, rel=1e-6)
    summary = result.scores["dense/fused.ply"]
    assert (summary["num_points"], summary["num_ground_truth"]) == (2700, 3600)
    one, two, five = summary["scores"]
    assert one["accuracy"] == 0.5
    assert two["accuracy"] == five["accuracy"] == 1
    # 45 of 60 rows are there; behind them, the columns that lie right reach a pixel further than the others
    assert [score["completeness"] for score in (one, two, five)] == [45.5 / 60, 46.5 / 60, 49.5 / 60]
    assert two["f_score"] == pytest.approx(2 * two["completeness"] / (1 + two["completeness"]), abs=1e-12)
    assert json.loads((workspace / "validation" / "cloud.json").read_text()) == plain(result)
    check_schema("validate-cloud", plain(result))
    assert (workspace / "validation" / "cloud_error.rrd").stat().st_size > 10_000
    table = result.table()
    for words in ("2700 points, 3600 true points", "50.00 %", "100.00 %", "F-score"):
        assert words in table, words


def test_true_cameras_carry_the_cloud_into_the_frame_of_the_ground_truth(workspace: Path, tmp_path: Path) -> None:
    scene = make_scene(num_images=6, num_points=60, seed=1).ground_truth
    sim = similarity.from_parts(rigid3.exp_so3([0.3, -0.2, 1.0]), [5.0, 6, 7], 3.0)
    write_model(workspace / "sparse" / "0", scene)
    ground_truth_model = scene.copy()
    ground_truth_model.cam_from_world = similarity.transform_poses(sim, scene.cam_from_world)
    ground_truth_model.point_xyz = similarity.apply(sim, scene.point_xyz)
    write_model(tmp_path / "ground_truth", ground_truth_model)
    ground_truth = save(tmp_path / "ground_truth.ply", similarity.apply(sim, floor()))
    result = validate_cloud(workspace, ground_truth, ground_truth_poses=tmp_path / "ground_truth")
    assert result.distance == pytest.approx(3 * SIZE, rel=1e-6)
    assert "6 cameras" in result.notes[0]
    scores = result.scores["dense/fused.ply"]["scores"]
    assert [score["accuracy"] for score in scores] == [0.5, 1, 1]
    lost = validate_cloud(workspace, ground_truth, distance=3 * SIZE)
    assert lost.scores["dense/fused.ply"]["scores"][2]["f_score"] == 0


def test_meshes_are_spread_into_points_on_either_side(workspace: Path, tmp_path: Path) -> None:
    side = 59 * SIZE
    text = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {a}\n" for a in "xyz")
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text += f"0 0 0\n{side} 0 0\n{side} {side} 0\n0 {side} 0\n4 0 1 2 3\n"
    for path in (tmp_path / "ground_truth.ply", workspace / "mesh" / "mesh.ply"):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    result = validate_cloud(workspace, tmp_path / "ground_truth.ply")
    num_samples = round(4 * side**2 / SIZE**2)
    assert result.scores["mesh/mesh.ply"]["num_points"] == pytest.approx(num_samples, abs=1)
    assert result.scores["mesh/mesh.ply"]["scores"][0]["f_score"] == 1
    assert result.scores["dense/fused.ply"]["scores"][0]["accuracy"] == pytest.approx(0.5, abs=0.01)


def test_the_command_takes_a_ply_and_prints_what_it_found(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud, ground_truth = workspace / "dense" / "fused.ply", save(tmp_path / "ground_truth.ply", floor())
    assert (
        main(["validate", str(cloud), "--ground-truth-cloud", str(ground_truth), "--distance", "0.03125", "--json"])
        == 0
    )
    told = json.loads(capsys.readouterr().out)
    assert told["scores"]["fused.ply"]["scores"][0]["accuracy"] == 1
    assert main(["validate", str(workspace), "--ground-truth-cloud", str(ground_truth)]) == 0
    assert "completeness" in capsys.readouterr().out
    assert main(["validate", str(cloud), "--ground-truth-cloud", str(ground_truth)]) == 2  # no patches beside it
    assert "--distance" in capsys.readouterr().err
    assert main(["validate", str(workspace), "--distance", "1"]) == 2
    assert main(["validate", str(workspace), "--ground-truth-cloud", str(tmp_path / "none.ply")]) == 3


def test_what_cannot_be_scored_is_told(workspace: Path, tmp_path: Path) -> None:
    ground_truth = save(tmp_path / "ground_truth.ply", floor())
    with pytest.raises(UsageError, match="above 0, found -1"):
        validate_cloud(workspace, ground_truth, distance=-1)
    with pytest.raises(InputError, match="expected a model"):
        validate_cloud(workspace, ground_truth, ground_truth_poses=tmp_path)
    with pytest.raises(InputError, match=r"expected dense/fused\.ply or mesh/mesh\.ply"):
        validate_cloud(tmp_path, ground_truth, distance=1)
    with pytest.raises(InputError, match="expected finite ground-truth points"):
        validate_cloud(workspace, save(tmp_path / "empty.ply", floor()[:0]))
    (workspace / "dense" / "patches.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="expected an array 'size'"):
        validate_cloud(workspace, ground_truth)


def test_colours_change_at_the_limits() -> None:
    limits = np.array([1.0, 2.0, 5.0])
    colors = error_colors(np.array([0.0, 1.0, 1.5, 2.0, 4.9, 5.1, np.inf]), limits)
    codes = [tuple(color) for color in colors.tolist()]
    assert codes[0] == codes[1] != codes[2] == codes[3] != codes[4] != codes[5] == codes[6]


def test_points_that_are_nowhere_are_counted_in_the_notes(workspace: Path, tmp_path: Path) -> None:
    """A ground truth as a scanner writes it: text, line ends of Windows, NaN where it saw nothing."""
    known = validate_cloud(workspace, save(tmp_path / "ground_truth.ply", floor()))
    rows = [*(" ".join(map(repr, row)) for row in floor().tolist()), "nan nan nan", "1 2 inf"]
    head = ["ply", "format ascii 1.0", "obj_info a scanner", f"element vertex {len(rows)}"]
    head += [f"property double {axis}" for axis in "xyz"] + ["end_header"]
    (tmp_path / "scan.ply").write_text("\r\n".join([*head, *rows, ""]), newline="")
    result = validate_cloud(workspace, tmp_path / "scan.ply")
    assert result.scores == {
        name: replace(scores, num_ground_truth_left_out=2) for name, scores in known.scores.items()
    }
    assert f"2 of {len(rows)} points are not finite and are left out" in result.table()
