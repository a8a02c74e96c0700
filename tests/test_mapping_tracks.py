"""Tracks from matches: transitivity, conflicts, and order independence of what is certain."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sfmapp.mapping.tracks import build_tracks, track_colors
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.features import Features


def features_of(num: int) -> Features:
    xy = np.stack([np.arange(num), 10.0 * np.arange(num)], 1)
    keypoints = np.concatenate([xy, np.ones((num, 1)), np.zeros((num, 1))], 1).astype(np.float32)
    return Features(keypoints, np.zeros((num, 128), np.uint8), np.full((num, 3), [10, 20, 30], np.uint8))


def correspondences_of(pairs: dict[tuple[int, int], list[tuple[int, int]]], config=None) -> Correspondences:
    keys = sorted(pairs)
    num = len(keys)
    counts = [len(pairs[k]) for k in keys]
    nan = np.full((num, 3, 3), np.nan)
    matches = np.array([m for k in keys for m in pairs[k]], np.int32).reshape(-1, 2)
    return Correspondences(
        np.array(keys, np.int32).reshape(-1, 2), np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), matches,
        np.full(num, TwoViewConfig.CALIBRATED if config is None else config, np.int8), nan, nan, nan,
        np.full((num, 7), np.nan), np.full(num, np.nan), *[np.array(counts, np.int32)] * 4,
    )  # fmt: skip


def members(tracks) -> set[frozenset[tuple[int, int]]]:
    return {
        frozenset(
            zip(
                tracks.obs_image_idx[a:b].tolist(), tracks.obs_feature_idx[a:b].tolist(), strict=True
            )
        )
        for a, b in zip(tracks.track_ptr[:-1], tracks.track_ptr[1:], strict=True)
    }  # fmt: skip


def test_matches_chain_into_one_track():
    tracks, report = build_tracks(
        correspondences_of({(0, 1): [(0, 1)], (1, 2): [(1, 2)], (0, 3): [(2, 2)]}), [features_of(3)] * 4
    )
    assert members(tracks) == {frozenset({(0, 0), (1, 1), (2, 2)}), frozenset({(0, 2), (3, 2)})}
    assert report["num_conflicting_matches"] == 0
    np.testing.assert_array_equal(tracks.obs_xy[:, 1], 10.0 * tracks.obs_feature_idx)
    np.testing.assert_array_equal(track_colors(tracks, [features_of(3)] * 4), [[10, 20, 30]] * 2)


def test_a_conflict_splits_at_the_weaker_pair():
    pairs = {(0, 1): [(0, 0), (1, 1), (2, 2)], (1, 2): [(0, 0), (1, 1)], (0, 2): [(1, 0)]}
    tracks, report = build_tracks(correspondences_of(pairs), [features_of(3)] * 3)
    assert report["num_conflicting_matches"] == 1
    assert frozenset({(0, 0), (1, 0), (2, 0)}) in members(tracks)


def test_useless_pairs_make_no_tracks():
    for config in (TwoViewConfig.WATERMARK, TwoViewConfig.UNDEFINED, TwoViewConfig.DEGENERATE):
        tracks, _ = build_tracks(correspondences_of({(0, 1): [(0, 0)]}, config), [features_of(2)] * 2)
        assert tracks.num_tracks == 0


def test_nothing_matched_is_no_track():
    tracks, report = build_tracks(correspondences_of({}), [features_of(0), features_of(3)])
    assert tracks.num_tracks == report["num_tracks"] == 0
    assert tracks.num_images == 2


matches = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=6)


@given(st.dictionaries(st.sampled_from([(0, 1), (0, 2), (1, 2), (2, 3), (1, 3)]), matches, max_size=5))
def test_no_track_holds_an_image_twice_and_every_keypoint_is_in_at_most_one(pairs):
    tracks, _ = build_tracks(correspondences_of(pairs), [features_of(6)] * 4)
    seen: set[tuple[int, int]] = set()
    for track in members(tracks):
        assert len({image for image, _ in track}) == len(track) >= 2
        assert not seen & track
        seen |= track
    # two keypoints that a match joins end in the same track unless that would be a conflict
    for (i, j), pair in pairs.items():
        for a, b in pair:
            assert (i, a) in seen or (j, b) in seen
