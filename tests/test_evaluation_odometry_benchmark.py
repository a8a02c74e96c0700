"""The arithmetic and the table of benchmarks/odometry.py, on made-up runs."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sfmapp.evaluation.trajectory import Trajectory
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import GroundTruth

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "odometry.py"


@pytest.fixture(scope="module")
def odometry() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("benchmarks/ is not part of an installed package")
    spec = importlib.util.spec_from_file_location("odometry_benchmark", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def run(case: str, repeat: int, cpu_s: float, digest: str = "a", exit_code: int = 0) -> dict[str, Any]:
    ground_truth = {"alignment": "sim3", "ate_m": {"rmse": 0.5}, "ate_percent": 0.25, "drift_percent": 1.5,
             "drift_deg_per_100m": 0.75, "is_kitti_drift": case == "drive"}  # fmt: skip
    good = {"num_frames": 200, "num_with_pose": 199, "num_in_largest_map": 199, "num_maps": 1, "unit": "",
            "live_ate_m": 0.625, "cpu_ms_per_frame": 5 * cpu_s, "process_cpu_ms_per_frame": 10 * cpu_s}  # fmt: skip
    return {
        "case": case, "program": "sfmapp", "repeat": repeat, "load_before": 1.5, "exit_code": exit_code, "wall_s": 20.0,
        "cpu_s": cpu_s, "peak_memory_mb": 300.0, "digest": digest,
        **(good | {"ground_truth": ground_truth} if exit_code == 0 else {"num_frames": None, "ground_truth": None}),
    }  # fmt: skip


def test_two_poses_have_no_error(odometry: ModuleType) -> None:
    """A similarity lays any two on any other two: 0.00 would be no figure."""
    poses = np.tile(rigid3.IDENTITY, (3, 1))
    poses[:, 4] = [0.0, 1.0, 3.0]
    poses[:, 5] = [0.0, 0.5, 0.0]
    truth = GroundTruth(np.arange(3.0), poses)
    for count in (2, 3):
        found = odometry.against(Trajectory.from_cam_from_world(poses[:count], np.arange(count)), truth, "sim3")
        assert (found is None) == (count == 2)


def test_costs_are_medians_and_bytes_are_compared(odometry: ModuleType) -> None:
    runs = [run("drive", k, cpu) for k, cpu in enumerate([4, 5, 9])]
    runs += [run("room", 0, 4), run("room", 1, 4, digest="b"), run("hall", 0, 4)]
    drive, room, hall = odometry.summaries(runs)
    assert drive["cpu_s"] == 5
    assert drive["process_cpu_ms_per_frame"] == 50
    assert [row["same_bytes"] for row in (drive, room, hall)] == [True, False, None]


def test_failed_runs_are_counted_not_averaged(odometry: ModuleType) -> None:
    rows = odometry.summaries([run("drive", 0, 1, exit_code=1), run("drive", 1, 4), run("room", 0, 1, exit_code=4)])
    assert [(row["num_failed"], row["cpu_s"], row["num_frames"]) for row in rows] == [(1, 4, 200), (1, 1, None)]


def test_the_table(odometry: ModuleType) -> None:
    runs = [run("drive", 0, 4), run("drive", 1, 4), run("room", 0, 4), run("hall", 0, 1, exit_code=1)]
    head = {"versions": {"sfmapp": "1"}, "commit": "c", "seed": 0, "repeats": 2, "cpu": "p", "cores": 2, "date": "d"}
    text = odometry.markdown(head | {"runs": runs, "rows": odometry.summaries(runs)})
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len({line.count("|") for line in rows}) == 1
    assert "199 of 200 | 0.5 (0.25 %) sim3 | 0.625 | 1.50, 0.75 | 20.0 (40.0) | 10.0 | 300 | yes" in rows[1]
    assert "1.50, 0.75 *" in rows[2]
    assert "FAILED" in rows[3]


def test_the_digest_is_of_results_not_of_times(odometry: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "trajectory.tum").write_text("1")
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(b"2")
    first = odometry.digest(tmp_path)
    (tmp_path / "report.json").write_text("took 3 s")
    assert odometry.digest(tmp_path) == first
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(b"3")
    assert odometry.digest(tmp_path) != first


def test_errors_of_another_programs_trajectory_can_be_written(odometry: ModuleType) -> None:
    times, rng = np.arange(40) * 0.1, np.random.default_rng(0)
    centers = np.cumsum(rng.normal(0, 4.0, (40, 3)), axis=0)
    poses = rigid3.from_matrix(np.tile(np.eye(3), (40, 1, 1)), -centers)
    other = poses.copy()
    other[:, 4:] /= 2.0  # a unit of its own
    found = odometry.against(Trajectory.from_cam_from_world(other, times), GroundTruth(times, poses), "sim3")
    assert json.loads(json.dumps(found))["ate_m"]["rmse"] == pytest.approx(0.0, abs=1e-9)
    assert found["scale"] == pytest.approx(2.0)
    assert found["is_kitti_drift"]
    assert found["drift_percent"] == pytest.approx(0.0, abs=1e-9)
