"""Filling of disparities: what lies behind goes on, at most as far as can be hidden; the rest keeps to what is near."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.stereo.filling import COLUMNS, EDGE_PX, fill_by_planes

HEIGHT, WIDTH = 24, 120
Map = NDArray[np.float32]


def wall(slope: float, noise: float = 0.0, seed: int = 0) -> Map:
    """A wall whose disparity rises along the rows, with the scatter of a matcher."""
    scatter = noise * np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH))
    return np.asarray(10.0 + slope * np.arange(WIDTH) + scatter, np.float32)


def with_hole(full: Map, first: int, last: int) -> Map:
    out = full.copy()
    out[:, first:last] = np.nan
    return out


@pytest.mark.parametrize("seed", range(3))
def test_a_slanted_wall_goes_on_behind_what_hides_it(seed: int) -> None:
    truth = wall(0.06)
    found = wall(0.06, 0.2, seed)
    found[:, 70:100] = 35.0
    full = fill_by_planes(with_hole(found, 50, 70))
    error = full[:, 50:70] - truth[:, 50:70]
    # without a slope it would be off by 1.2 px at the end and 0.6 in the mean; the prior takes a quarter of the slope
    assert np.abs(error[2:-2]).max() < 0.8
    assert np.abs(error[2:-2]).mean() < 0.45
    np.testing.assert_array_equal(full[:, :50], found[:, :50])


def test_a_flat_wall_stays_flat() -> None:
    found = wall(0.0)
    found[:, 70:] = 25.0
    np.testing.assert_array_equal(fill_by_planes(with_hole(found, 57, 70))[:, 57:70], 10.0)


def test_what_is_too_wide_to_be_hidden_belongs_to_the_nearer_end() -> None:
    found = wall(0.0)
    found[:, 80:] = 16.0
    full = fill_by_planes(with_hole(found, 40, 80))
    # six pixels beside the step can be hidden, and its place is known to some more
    assert set(np.unique(full[2:-2, 40:60])) == {10.0}
    hidden = round(6 + EDGE_PX)
    np.testing.assert_array_equal(full[2:-2, 80 - hidden : 80], 10.0)
    np.testing.assert_array_equal(full[2:-2, 63 : 78 - hidden], 16.0)


def test_one_surface_spans_its_hole() -> None:
    truth = wall(0.04)
    full = fill_by_planes(with_hole(truth, 50, 62))
    # the slopes' prior takes some of them on either side
    assert np.abs(full - truth).max() < 0.2


def test_at_the_border_a_surface_goes_on_no_farther_than_it_was_told_by() -> None:
    truth = wall(0.06)
    full = fill_by_planes(with_hole(truth, 0, COLUMNS + 20))
    assert 0.5 < full[12, COLUMNS + 20] - full[12, 20] < 0.06 * COLUMNS + 0.1
    assert np.ptp(full[12, 2:18]) < 1e-5
    assert full[12, 0] > truth[12, 0]


def test_rows_without_any_are_filled_along_columns_and_nothing_stays_nothing() -> None:
    found = wall(0.0)
    found[10:14] = np.nan
    np.testing.assert_array_equal(fill_by_planes(found), 10.0)
    assert np.isnan(fill_by_planes(np.full((HEIGHT, WIDTH), np.nan, np.float32))).all()
