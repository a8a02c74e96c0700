"""What keeps mapping near linear: ranks counted where they change, starts that come to the same; a rendered town."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rendered_worlds.towns import NUM_CROSSINGS, PITCH_M, STEP_M, _route, walk
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.mapping.incremental import ENOUGH_AGREEMENT, SAME_AGREEMENT, Starts
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.register import NextImages
from sfmapp.scene.synthetic import make_scene


def test_images_are_ranked_as_if_all_were_counted_anew_however_points_come_and_go():
    model, rng = make_scene(3, 12, 400).observed, np.random.default_rng(0)
    xyz, kept = model.point_xyz.copy(), NextImages(model)
    for share in (0.0, 0.02, 0.02, 0.5, 0.45, 0.0, 1.0):
        hidden = rng.random(len(xyz)) >= share
        model.point_xyz[:] = np.where(hidden[:, None], np.nan, xyz)
        for candidates in (np.arange(12), rng.permutation(12)[:7]):  # also such as were left out before
            ranked = kept.rank(model, np.sort(candidates))
            anew = NextImages(model).rank(model, np.sort(candidates))
            for ours, theirs in zip(ranked, anew, strict=True):
                np.testing.assert_array_equal(ours, theirs)
            sees = ~hidden[model.tracks.obs_track_idx]
            counts = np.bincount(model.tracks.obs_image_idx[sees], minlength=12)
            np.testing.assert_array_equal(ranked[2], counts[ranked[0]])


def test_observations_of_tracks_are_those_of_each_in_turn():
    tracks = make_scene(3, 5, 40).observed.tracks
    chosen = np.array([7, 0, 39, 7])
    expected = np.concatenate([np.flatnonzero(tracks.obs_track_idx == t) for t in chosen])
    np.testing.assert_array_equal(tracks.observations_of_tracks(chosen), expected)
    assert len(tracks.observations_of_tracks(chosen[:0])) == 0


def test_a_third_start_is_not_made_where_two_came_to_the_same():
    model = make_scene(3, 5, 40).observed
    fewer = model.copy()
    fewer.cam_from_world[2] = np.nan
    starts = Starts(MappingOptions(), Events())
    assert starts.is_last(model, None, [0.99])
    assert not starts.is_last(model, None, [0.86])
    assert not starts.is_last(model, model.copy(), [0.75, 0.86])  # the first was bent
    assert not starts.is_last(fewer, model, [0.86, 0.86])  # which holds other images
    assert starts.enough == ENOUGH_AGREEMENT
    assert starts.is_last(model, model.copy(), [0.86, 0.75, 0.86 - 0.5 * SAME_AGREEMENT])
    # and what can be had from these pairs is enough for maps that follow
    assert starts.is_last(model, None, [0.86])
    assert not starts.is_last(model, None, [0.84])


def test_a_walk_through_the_town_begins_as_a_shorter_one_and_closes_loops():
    route = _route(60)
    assert all(abs(i - k) + abs(j - m) == 1 for (i, j), (k, m) in pairwise(route))
    assert all(first != third for first, third in zip(route, route[2:], strict=False))
    assert np.array(route).min() == 0
    assert np.array(route).max() < NUM_CROSSINGS
    assert len(set(route)) < 0.75 * len(route)  # crossings come back
    long, short = walk(240), walk(60)
    np.testing.assert_array_equal(long.cam_from_world[:60], short.cam_from_world)
    centers = rigid3.center(long.cam_from_world)
    steps = np.linalg.norm(centers[2::2] - centers[:-2:2], axis=1)
    assert (steps < STEP_M + 1.0).all()
    assert np.median(steps) > 0.8 * STEP_M
    # what is seen again after a way round a block is seen from nearly the same place
    again = np.linalg.norm(centers[2 * int(3.5 * PITCH_M / STEP_M) :] - centers[0], axis=1)
    assert again.min() < STEP_M
