"""The study of a rig before it is built."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from schemas import check_schema
from sfmapp.cli.main import main
from sfmapp.stereo.design import StereoDesign, baseline_for, study

# f 20 mm, 30 pixels a millimetre, a point at 2 m, disparities to 2 pixels
TEXTBOOK = ["--focal", "20mm", "--pixel", "30/mm", "--size", "1280x960", "--range", "2000mm", "--disparity-error", "2"]


@pytest.mark.parametrize(
    ("baseline", "disparity", "farthest", "nearest"),
    [("100mm", 30.0, 2142.857, 1875.0), ("500mm", 150.0, 2027.027, 1973.684)],
)
def test_accuracy_of_two_baselines(
    baseline: str, disparity: float, farthest: float, nearest: float, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stereo-design", *TEXTBOOK, "--baseline", baseline, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told.pop("exit_code") == 0
    check_schema("stereo-design", told)
    (row,) = told["rigs"][0]["rows"]
    assert told["focal_px"] == pytest.approx(600.0)
    assert told["unit"] == "mm"
    assert row["disparity_px"] == pytest.approx(disparity, abs=1e-9)
    assert abs(row["farthest"] - farthest) < 1e-3
    assert abs(row["nearest"] - nearest) < 1e-3
    # the exact values: f B / (d -+ 2)
    assert row["spread"] == pytest.approx(60000.0 * (float(baseline[:-2]) / 100) * (4 / (disparity**2 - 4)), rel=1e-12)


@pytest.mark.parametrize("converging_deg", [0.0, 30.0])
def test_disparity_and_fields_of_view_are_those_of_projections(converging_deg: float) -> None:
    design = StereoDesign(600.0, 1280, 960, 0.4, converging_deg)
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-4, 4, 4000), rng.uniform(0.3, 5.0, 4000)])

    def seen(points: np.ndarray, side: float) -> np.ndarray:
        half = math.radians(0.5 * converging_deg)
        x, z = points[:, 0] - side * 0.2, points[:, 1]
        across, ahead = math.cos(half) * x + side * math.sin(half) * z, math.cos(half) * z - side * math.sin(half) * x
        return np.where(ahead > 0.0, 600.0 * across / np.maximum(ahead, 1e-9), np.inf)

    middle = np.column_stack([np.zeros(50), np.linspace(0.3, 5.0, 50)])
    exact = seen(middle, -1.0) - seen(middle, 1.0)
    np.testing.assert_allclose(design.disparity(middle[:, 1]), exact, atol=1e-9)
    np.testing.assert_allclose(design.depth(exact), middle[:, 1], rtol=1e-12)
    by_both = (np.abs(seen(points, -1.0)) < 640.0) & (np.abs(seen(points, 1.0)) < 640.0)
    inside = np.abs(points[:, 0]) < 0.5 * design.common_width(points[:, 1])
    assert (by_both == inside).all()
    assert not by_both[points[:, 1] < design.nearest].any()
    if converging_deg:
        radius, angle = design.zero_disparity_radius, rng.uniform(-1.2, 1.2, 100)
        height = design.fixation - radius
        circle = np.column_stack([radius * np.sin(angle), height + radius * np.cos(angle)])
        in_front = circle[circle[:, 1] > 0.05]
        np.testing.assert_allclose(seen(in_front, -1.0), seen(in_front, 1.0), atol=1e-8)


@pytest.mark.parametrize("converging_deg", [0.0, 20.0])
def test_terms_of_the_error_are_slopes(converging_deg: float) -> None:
    errors = {"disparity_error_px": 1e-4, "baseline_error": 1e-6, "focal_error_px": 1e-3}
    design = StereoDesign(600.0, 1280, 960, 0.4, converging_deg, **errors)
    (row,) = study(design, [3.0]).rows
    half = math.radians(0.5 * converging_deg)

    def depth(disparity: float, baseline: float, focal: float) -> float:
        return 0.5 * baseline / math.tan(math.atan(disparity / (2.0 * focal)) + half)

    d = row.disparity_px
    assert depth(d, 0.4, 600.0) == pytest.approx(3.0, rel=1e-12)
    found = (row.of_disparity, row.of_baseline, row.of_focal)
    moved = (depth(d - 1e-4, 0.4, 600.0), depth(d, 0.4 + 1e-6, 600.0), depth(d, 0.4, 600.0 + 1e-3))
    np.testing.assert_allclose(found, np.abs(np.array(moved) - 3.0), rtol=1e-3)
    assert row.total == sum(found)


def test_the_baseline_that_an_error_needs_has_that_error() -> None:
    design = StereoDesign(1200.0, 1920, 1080, 0.1, disparity_error_px=0.5)
    baseline = baseline_for(design, 4.0, 0.02)
    (row,) = study(StereoDesign(1200.0, 1920, 1080, baseline, disparity_error_px=0.5), [4.0]).rows
    assert row.farthest == pytest.approx(4.02, abs=1e-12)


def test_far_points_are_not_told_from_infinity() -> None:
    study_of = study(StereoDesign(600.0, 1280, 960, 0.1), [30.0, 90.0])
    assert study_of.greatest_depth == pytest.approx(60.0)
    assert study_of.rows[0].farthest == pytest.approx(60.0)
    assert study_of.rows[1].farthest is None


def test_a_page_of_all_rigs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "rig.html"
    flags = ["--baseline", "10cm", "50cm", "--fixate", "2m", "--wanted-error", "5mm", "-o", str(page)]
    assert main(["stereo-design", *TEXTBOOK, *flags]) == 0
    assert "2142.857" in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert text.count("<svg") == 5
    assert "NaN" not in text
    assert "converging by 14.3&deg;" in text


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--focal", "20mm", "--baseline", "1m", "--size", "8x8", "--range", "1m"], "size of a pixel"),
        (
            ["--focal", "20", "--pixel", "3um", "--baseline", "1m", "--size", "8x8", "--range", "1m"],
            "in pixels already",
        ),
        (["--focal", "0", "--baseline", "1m", "--size", "8x8", "--range", "1m"], "focal length is '0'"),
        (["--focal", "20mm", "--pixel", "30", "--baseline", "1m", "--size", "8x8", "--range", "1m"], "pixel is '30'"),
        (["--focal", "20", "--baseline", "1", "--size", "8x8", "--range", "1m"], "a number and its unit"),
        (["--focal", "20", "--baseline", "1m", "--size", "8x8", "--range", "2m", "1m"], "nearest depth first"),
        (["--focal", "20", "--baseline", "1m", "--size", "8x8", "--range", "1m", "--converging", "178"], "look ahead"),
        (
            ["--focal", "20", "--baseline", "1m", "--size", "8x8", "--range", "1m", "--disparity-error", "0"],
            "disparity",
        ),
        (["--focal", "20", "--baseline", "1m", "--size", "8x8", "--range", "1m", "-o", "rig.pdf"], "ends in .html"),
    ],
)
def test_wishes_that_mean_nothing_are_named(flags: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stereo-design", *flags]) == 2
    assert said in capsys.readouterr().err
