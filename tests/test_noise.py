"""The noise of image coordinates from the lengths of residuals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from sfmapp.geometry.noise import exceeded_by_chance, sigma_of_lengths


def test_the_sigma_of_normal_residuals_is_found_and_outliers_hardly_count() -> None:
    rng = np.random.default_rng(0)
    lengths = np.linalg.norm(rng.normal(0.0, 0.7, (200_000, 2)), axis=1)
    # the median is off by sqrt(pi / 2) times as much as the mean, and then some: a third of a percent is five sigmas
    assert sigma_of_lengths(lengths) == pytest.approx(0.7, rel=5e-3)
    lengths[:10_000] = 1e4
    assert sigma_of_lengths(lengths) == pytest.approx(0.7, rel=0.06)


@pytest.mark.parametrize("num", [1, 2, 3, 4, 9, 16, 100])
@pytest.mark.parametrize("chance", [0.5, 1e-3, 1e-6])
def test_what_chance_exceeds_is_the_quantile_of_chi_square(num: int, chance: float) -> None:
    assert exceeded_by_chance(num, chance) == pytest.approx(chi2.isf(chance, num), rel=1e-9)
