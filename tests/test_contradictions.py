"""What contradictions add to a stated uncertainty, and that they can be read."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.contradictions import Contradiction, widened, widened_scale_sigma
from sfmapp.report.document import check_contradictions
from sfmapp.reporting import plain

LENS = Contradiction("given calibration", "f is 10 % too long", "calibrate", {"evidence": 2800.0}, 0.3, 0.04, 0.0)
RIG = Contradiction("stereo pairs", "the right camera is late", scale_sigma=0.3)


def test_variances_add_up_about_every_axis() -> None:
    before = np.eye(6)[None].repeat(2, 0) * 1e-6
    before[1] = np.nan
    after = widened(before, 5.0, [LENS, LENS])
    expected = [1e-6 + 2 * np.radians(0.3) ** 2] * 3 + [1e-6 + 2 * 0.2**2] * 3
    assert np.diag(after[0]) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(after[1]).any()
    assert widened(before, 5.0, [])[0] == pytest.approx(before[0])


def test_an_arbitrary_unit_has_no_sigma_and_one_in_metres_is_widened() -> None:
    assert widened_scale_sigma(None, [RIG]) is None
    assert widened_scale_sigma(0.04, [RIG, LENS]) == pytest.approx(np.hypot(0.04, 0.3))


def test_each_is_a_red_light_that_says_what_it_contradicts() -> None:
    rows = check_contradictions((LENS, RIG))
    assert [row["light"] for row in rows] == ["red", "red"]
    assert rows[0]["name"] == "contradiction: given calibration"
    assert rows[0]["value"] == LENS.message
    assert [row["light"] for row in check_contradictions([])] == ["green"]
    assert plain(LENS)["evidence"] == {"evidence": 2800.0}
