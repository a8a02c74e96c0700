"""The table of verdicts: what the words mean, and that the committed one is made of the committed results."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

verdicts = pytest.importorskip("verdicts", reason="benchmarks/ is not part of an installed package")

ROW = verdicts.Row("sparse", "church", "CPU time", "s", "less", 10.0, "peer", 10.0, False, "2026-11-29", "abc")


@pytest.mark.parametrize(
    ("ours", "theirs", "unit", "better", "verdict"),
    [
        (10.0, 10.9, "s", "less", "level"),
        (10.0, 11.2, "s", "less", "ahead"),
        (11.2, 10.0, "s", "less", "behind"),
        (98.4, 99.5, "%", "more", "behind"),
        (98.4, 99.3, "%", "more", "level"),
        (16, 13, "count", "more", "ahead"),
        (12, 13, "count", "more", "behind"),
        (0.0, 0.0, "m", "less", "level"),
        (10.0, None, "s", "less", "alone"),
    ],
)
def test_verdicts(ours: float, theirs: float | None, unit: str, better: str, verdict: str) -> None:
    row = replace(ROW, sfmapp=ours, peer_value=theirs, unit=unit, better=better)
    assert row.verdict == verdict


def test_the_committed_table_is_made_of_the_committed_results() -> None:
    assert (verdicts.RESULTS / "baseline.json").read_text(encoding="utf-8") == verdicts.baseline(verdicts.RESULTS)
    assert (verdicts.RESULTS / "verdicts.md").read_text(encoding="utf-8") == verdicts.markdown(verdicts.RESULTS)


def test_every_result_is_in_the_table_and_named_after_its_script() -> None:
    results = {path.stem for path in verdicts.RESULTS.glob("*.json")} - {"baseline"}
    assert results == {row.benchmark for row in verdicts.rows_of(verdicts.RESULTS)} | {
        promise.benchmark for promise in verdicts.promises(verdicts.RESULTS)
    }
    for name in results:
        assert (verdicts.RESULTS.parent / f"{name}.py").is_file()


def test_rows_that_are_lost_are_shown() -> None:
    lost = [row for row in verdicts.rows_of(verdicts.RESULTS) if row.verdict == "behind"]
    assert verdicts.markdown(verdicts.RESULTS).count("**behind**") == len(lost) > 0


def test_new_results_are_held_against_the_baseline(tmp_path: Path) -> None:
    shutil.copy(verdicts.RESULTS / "bundle_adjustment.json", tmp_path)
    assert list(verdicts.changes(tmp_path)) == []
    report = json.loads((tmp_path / "bundle_adjustment.json").read_text())
    report["rows"][0]["sfmapp"]["cpu_s"] *= 2
    report["rows"][1]["sfmapp"]["cpu_s"] *= 0.5
    report["rows"][2]["sfmapp"]["cpu_s"] *= 1.05
    (tmp_path / "bundle_adjustment.json").write_text(json.dumps(report))
    changed = list(verdicts.changes(tmp_path))
    assert [line.partition(":")[0] for line in changed] == ["WORSE", "better"]
