"""The arithmetic and the tables of benchmarks/sparse.py, on made-up runs."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "sparse.py"


@pytest.fixture(scope="module")
def sparse() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("benchmarks/ is not part of an installed package")
    spec = importlib.util.spec_from_file_location("sparse_benchmark", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def run(program: str, seed: int, wall_s: float, error: float | None, is_cold: bool = False) -> dict[str, Any]:
    ground_truth = {"center_error": None if error is None else {"mean": error}, "auc": {"0.5": 0.25, "1": 0.5}}
    return {
        "set": "church", "program": program, "seed": seed, "is_cold": is_cold, "load_before": 0.5, "wall_s": wall_s,
        "cpu_s": 2 * wall_s, "peak_memory_mb": 100.0, "model": {"num_registered": 5, "num_images": 5},
        "ground_truth": ground_truth,
    }  # fmt: skip


def test_medians_are_over_warm_runs_and_ratios_over_medians(sparse: ModuleType) -> None:
    runs = [run("sfmapp", 0, 100, 0.9, is_cold=True)]
    runs += [run("sfmapp", k, wall, error) for k, (wall, error) in enumerate([(1, 0.1), (2, 0.2), (9, 0.3)])]
    runs += [run("pycolmap", k, 10, 0.1) for k in range(3)]
    row = sparse.medians(runs)["church"]
    assert row["sfmapp"]["wall_s"] == 2
    assert row["pycolmap_over_sfmapp"]["wall_s"] == 5
    assert row["pycolmap_over_sfmapp"]["ground_truth.center_error.mean"] == pytest.approx(0.5)
    assert row["sfmapp"]["ground_truth.auc.0.5"] == 0.25


def test_a_run_without_a_result_has_no_median(sparse: ModuleType) -> None:
    """Leaving the failure out would flatter the program that failed."""
    runs = [run("sfmapp", 0, 1, 0.1), run("sfmapp", 1, 1, None), run("pycolmap", 0, 1, 0.1)]
    row = sparse.medians(runs)["church"]
    assert row["sfmapp"]["ground_truth.center_error.mean"] is None
    assert "ground_truth.center_error.mean" not in row["pycolmap_over_sfmapp"]
    assert row["sfmapp"]["wall_s"] == 1


def test_tables_of_both_and_of_one_alone(sparse: ModuleType) -> None:
    facts = {"versions": {"sfmapp": "1", "pycolmap": "4"}, "commit": "abc", "camera_mode": "auto", "seeds": 1,
             "cpu": "a cpu", "cores": 2, "date": "today"}  # fmt: skip
    both = [run("sfmapp", 0, 50, 0.1, is_cold=True), run("sfmapp", 0, 2, 0.1), run("pycolmap", 0, 8, 0.2)]
    for runs in (both, both[:2], both[2:]):
        text = sparse.markdown({**facts, "runs": runs, "medians": sparse.medians(runs)})
        assert "| church (5) |" in text
        assert "None" not in text
    text = sparse.markdown({**facts, "runs": both, "medians": sparse.medians(both)})
    assert "2 / 8 (4.00)" in text
    assert "50.0 s wall" in text
    columns = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert columns == {6, 11}


def test_folders_with_images_and_ground_truth_are_found(sparse: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "set" / "images" / "a").mkdir(parents=True)
    (tmp_path / "set" / "images" / "a" / "1.JPG").touch()
    (tmp_path / "set" / "images" / "notes.txt").touch()
    (tmp_path / "set" / "cameras.json").touch()
    found = sparse.find_sets([tmp_path / "set"])[0]
    assert (found.name, found.image_names, found.ground_truth) == (
        "set",
        ["a/1.JPG"],
        tmp_path / "set" / "cameras.json",
    )
    with pytest.raises(SystemExit):
        sparse.find_sets([tmp_path])
