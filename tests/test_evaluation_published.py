"""Folders of KITTI, EuRoC and TUM as `benchmarks/odometry.py` finds them, and its tables of their runs."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sfmapp.events import Events
from sfmapp.sequences.open import SequenceOptions, open_sequence
from test_sequences import make_euroc, make_kitti, make_tum

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def published() -> ModuleType:
    if not BENCHMARKS.is_dir():
        pytest.skip("benchmarks/ is not part of an installed package")
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import published_sequences
    finally:
        sys.path.remove(str(BENCHMARKS))
    return published_sequences


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The three benchmarks, unpacked as they come."""
    root = tmp_path_factory.mktemp("published")
    make_kitti(root / "kitti")
    make_euroc(root / "euroc" / "machine_hall" / "MH_01_easy")
    make_tum(root / "tum" / "rgbd_dataset_freiburg1_xyz")
    return {name: root / name for name in ("kitti", "euroc", "tum")}


def test_folders_are_found_and_can_be_played(published: ModuleType, roots: dict[str, Path]) -> None:
    found = published.find_published(**roots)
    assert [sequence.name for sequence in found] == [
        "KITTI 07 stereo", "KITTI 07 mono", "EuRoC MH_01_easy mono", "EuRoC MH_01_easy stereo",
        "EuRoC MH_01_easy mono, IMU", "TUM freiburg1_xyz mono",
    ]  # fmt: skip
    for sequence in found:
        played = open_sequence(sequence.folder, SequenceOptions(mono="--mono" in sequence.flags), Events())
        assert played.kind == sequence.benchmark.lower()
        assert len(played.rig.cameras) == (2 if sequence.sensor == "stereo" else 1)
        assert played.ground_truth is not None
        assert (played.imu is not None) == (sequence.benchmark == "EuRoC")
    # the folder of the sequences themselves does as well
    inside = published.find_published(roots["kitti"] / "sequences", None, None)
    assert [s.folder for s in inside] == [s.folder for s in found[:2]]


def test_a_folder_without_sequences_is_told(published: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"expected sequences of TUM .*rgb\.txt"):
        published.find_published(None, None, tmp_path)


def row(case: str, program: str, ate: float | None, **changes: Any) -> dict[str, Any]:
    truth = {"alignment": "se3" if "stereo" in case or "IMU" in case else "sim3", "ate_m": {"rmse": ate},
             "drift_percent": 0.7, "drift_deg_per_100m": 0.25, "is_kitti_drift": True}  # fmt: skip
    return {"case": case, "program": program, "exit_code": 0, "num_frames": 200, "num_in_largest_map": 200,
            "ground_truth": None if ate is None else truth} | changes  # fmt: skip


def test_the_tables_of_papers(published: ModuleType, roots: dict[str, Path]) -> None:
    sequences = published.find_published(**roots)
    rows = [
        row("KITTI 07 stereo", "sfmapp", 1.234), row("KITTI 07 stereo", "ORB-SLAM3", 2.0, num_in_largest_map=150),
        row("KITTI 07 mono", "sfmapp", None), row("EuRoC MH_01_easy mono", "sfmapp", 0.0161),
        row("EuRoC MH_01_easy stereo", "sfmapp", 0.029), row("TUM freiburg1_xyz mono", "sfmapp", 0.0094),
    ]  # fmt: skip
    text = published.published_tables(sequences, rows)
    assert "| 07 | stereo | 0.70 | 0.25 | 1.23 | 0.70 (75 %) | 0.25 (75 %) | 2.00 (75 %) |" in text
    assert "| 07 | mono | X | X | X | - | - | - |" in text
    assert "| ATE RMSE m | after | MH_01_easy | mean |" in text
    assert "| sfmapp, mono | Sim(3) | 0.016 | 0.016 |" in text
    assert "| sfmapp, stereo | SE(3) | 0.029 | 0.029 |" in text
    assert "| sfmapp, mono, IMU | - | - | - |" in text
    tables = [[line for line in part.splitlines() if line.startswith("|")] for part in text.split("## ")[1:]]
    assert [len({line.count("|") for line in table}) for table in tables] == [1, 1, 1]


def test_stretches_too_short_for_kitti_are_left_out(published: ModuleType, roots: dict[str, Path]) -> None:
    sequences = published.find_published(roots["kitti"], None, None)
    short = row("KITTI 07 stereo", "sfmapp", 1.0)
    short["ground_truth"]["is_kitti_drift"] = False
    assert "| 07 | stereo | - | - | 1.00 |" in published.published_tables(sequences, [short])
