"""How the benchmark of stereo scores: exact cases."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.stereo.result import RectifiedPair

stereo = pytest.importorskip("stereo", reason="benchmarks/ is not part of an installed package")
stereo_pairs = pytest.importorskip("stereo_pairs")
NAN = np.nan


def test_what_is_nearer_covers_what_is_behind_it() -> None:
    # a strip at columns 6 and 7 moves by four and covers the wall, which moves by one, at columns 3 and 4
    truth = np.array([[1, 1, 1, 1, 1, 1, 4, 4, 1, NAN]], np.float32)
    assert stereo_pairs.visible_from_right(truth).tolist() == [
        [False, True, True, False, False, True, True, True, True, False]
    ]


def test_a_slanted_surface_of_whole_disparities_covers_nothing_of_itself() -> None:
    truth = np.repeat(np.arange(4, 14), 2)[None].astype(np.float32)
    assert stereo_pairs.visible_from_right(truth)[0, 8:].all()


def test_scores_of_a_known_map() -> None:
    truth = np.array([[2.0] * 8 + [4.0] * 4], np.float32)
    found = np.array([[2, 2, 2, 3.5, NAN, 2, 2, 7, 4, 4, NAN, 4]], np.float32)
    picture, shown = np.zeros((1, 12), np.uint8), np.ones((1, 12), np.bool_)
    visible = np.arange(12)[None] >= 2
    case = stereo_pairs.StereoSet("", RectifiedPair(picture, picture, shown, shown), truth, visible, (0, 16))
    scores = stereo.scores(found, case)
    assert scores["density_visible"] == pytest.approx(80.0)
    assert scores["bad1_answered_visible"] == pytest.approx(25.0)
    assert scores["bad2_answered_visible"] == pytest.approx(12.5)
    assert scores["mean_answered_visible"] == pytest.approx(6.5 / 8)
    assert scores["wrong_or_none_visible"] == pytest.approx(40.0)
    assert scores["bad1_complete_all"] == pytest.approx(100.0 * 2 / 12)
    # filled: 2 2 2 3.5 2 2 2 7 4 4 4 4; all of it searched, and 3.5 rounds to 4
    assert scores["searched_all"] == pytest.approx(100.0)
    assert scores["mean_searched_all"] == pytest.approx(6.5 / 12)
    assert scores["mean_whole_all"] == pytest.approx(7.0 / 12)
    narrow = stereo.scores(found, stereo_pairs.StereoSet("", case.pair, truth + 0.25, visible, (0, 3)))
    assert narrow["searched_all"] == pytest.approx(100.0 * 8 / 12)
    assert narrow["mean_searched_all"] == pytest.approx((1.25 + 4.75 + 6 * 0.25) / 8)
    assert "mean_whole_all" not in narrow
