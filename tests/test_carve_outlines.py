"""Outlines against exact ones, to a fraction of a pixel, and distances against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from carving_photographs import coverage_of, fine_mask, photograph
from carving_scenes import Solid, around, ball, both, box, ring, without
from sfmapp.carve.outlines import coverage_of_mask, outline_pieces, refined_coverage, signed_distance

FINER = 6
SOLIDS = {
    "ball": ball(),
    "box": box(),
    "ring": ring(),
    "bitten": without(box(), ball(0.5, (0.6, 0.3, 0.4))),
    "two": both(ball(0.5, (0.5, 0.2, 0.1)), box((0.3, 0.4, 0.6), (-0.4, 0.0, 0.0))),
}
VIEW = around(12, width=80, height=60)[3]


def along(pieces: NDArray[np.float32]) -> NDArray[np.float64]:
    """Points of an outline, four on each piece."""
    t = ((np.arange(4) + 0.5) / 4)[None, :, None]
    return (pieces[:, None, :2] * (1.0 - t) + pieces[:, None, 2:] * t).reshape(-1, 2).astype(np.float64)


def rms_both_ways(found: NDArray[np.float32], solid: Solid) -> tuple[float, float]:
    """Of distances from an outline to the true one, and from that to it."""
    true = along(outline_pieces(fine_mask(VIEW, solid, FINER).astype(np.float32))) / FINER
    points = along(outline_pieces(found))
    there, back = cKDTree(true).query(points)[0], cKDTree(points).query(true)[0]
    return float(np.sqrt(np.mean(there**2))), float(np.sqrt(np.mean(back**2)))


@pytest.mark.parametrize("name", SOLIDS)
def test_outlines_are_told_to_a_fraction_of_a_pixel(name: str) -> None:
    solid = SOLIDS[name]
    coverage = coverage_of(VIEW, solid, FINER)
    from_alpha = rms_both_ways(coverage, solid)
    from_steps = rms_both_ways(coverage_of_mask(coverage > 0.5), solid)
    picture = photograph(coverage, seed=len(name))
    from_picture = rms_both_ways(refined_coverage(picture, coverage > 0.5), solid)
    # the true outline has steps of a sixth of a pixel, 0.05 px rms by themselves; corners are what is left above it
    assert max(from_alpha) < 0.13
    assert from_alpha[0] > 0.03
    assert 0.13 < from_steps[0] < 0.25
    assert max(from_picture) < 0.16
    # the picture brings what the mask had lost
    assert from_picture[0] < 0.6 * from_steps[0]


def test_distances_are_those_to_the_nearest_piece() -> None:
    coverage = coverage_of(VIEW, SOLIDS["bitten"], 3)
    pieces = outline_pieces(coverage).astype(np.float64)
    centers = np.stack(np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5), axis=-1).reshape(-1, 1, 2)
    step = pieces[:, 2:] - pieces[:, :2]
    t = ((centers - pieces[:, :2]) * step).sum(axis=2) / np.maximum((step**2).sum(axis=1), 1e-12)
    feet = pieces[:, :2] + np.clip(t, 0.0, 1.0)[..., None] * step
    exact = np.linalg.norm(feet - centers, axis=2).min(axis=1).reshape(60, 80)
    found = signed_distance(coverage)
    # sweeps miss a nearest piece that is hidden from all neighbours, by hundredths of a pixel
    assert np.abs(np.abs(found) - exact).max() < 0.05
    assert np.array_equal(found > 0.0, coverage > 0.5)


def test_without_an_outline_all_is_far() -> None:
    empty = np.zeros((5, 7), np.float32)
    assert (signed_distance(empty) == -np.inf).all()
    assert (signed_distance(empty + 1.0) == np.inf).all()


def test_corners_that_touch_cut_a_cell_twice() -> None:
    # a saddle: with a dark middle its two bright corners are apart, with a bright one its dark ones
    for level, joined in ((0.2, False), (0.8, True)):
        cell = np.full((4, 4), level, np.float32)
        cell[:2, :2], cell[2:, 2:], cell[:2, 2:], cell[2:, :2] = 1.0, 1.0, 0.0, 0.0
        cell[1, 1] = cell[2, 2] = 0.9 if joined else 0.6
        cell[1, 2] = cell[2, 1] = 0.4 if joined else 0.1
        middle = [piece for piece in outline_pieces(cell) if np.all((piece > 1.4) & (piece < 2.6))]
        assert len(middle) == 2
        sides = [np.sign((p[0] + p[2]) / 2 - (p[1] + p[3]) / 2) for p in middle]
        # pieces of a joined diagonal lie on its two sides; those of an open one lie across it
        assert (sorted(sides) == [-1.0, 1.0]) == joined
