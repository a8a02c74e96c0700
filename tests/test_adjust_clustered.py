"""Covariances of poses from whole tracks: as large as the errors, also where a track's observations err together."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.adjust.clustered import ClusteredCovariances, clustered_covariances
from sfmapp.adjust.covariance import errors_in_gauge, estimate_covariances
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera

SIGMA_PX = 0.5
FIXED = AdjustOptions(
    loss="cauchy", loss_scale_px=2 * SIGMA_PX, refine_focal=False, refine_distortion=False,
    relative_cost_tolerance=1e-10, max_iterations=100,
)  # fmt: skip


def sliding(model: Reconstruction, seed: int) -> None:
    """Give the observations of each track, in place, errors that walk on from image to image."""
    rng, tracks = np.random.default_rng(seed), model.tracks
    for t in range(tracks.num_tracks):
        part = slice(tracks.track_ptr[t], tracks.track_ptr[t + 1])
        steps = rng.normal(0, 0.4, (part.stop - part.start, 2))
        tracks.obs_xy[part] += np.cumsum(steps, 0)


def simulated(seed: int, *, slides: bool) -> tuple[ClusteredCovariances, float, float]:
    """What is found; NEES a degree of freedom by it, and by the covariances of independent noise."""
    scene = make_scene(seed, 8, 200, synthetic_camera(), sigma_px=0.05 if slides else SIGMA_PX, layout="forward")
    found = scene.observed.copy()
    if slides:
        sliding(found, seed)
    adjust_bundle(found, FIXED)
    clustered, independent = clustered_covariances(found, FIXED), estimate_covariances(found, FIXED)
    errors, _, _ = errors_in_gauge(found, scene.ground_truth, independent)
    values = [
        float(np.mean([e @ np.linalg.solve(c, e) / 6 for e, c in zip(errors, poses, strict=True)]))
        for poses in (clustered.poses, independent.poses)
    ]
    return clustered, values[0], values[1]


def test_independent_errors_give_what_the_information_gives() -> None:
    runs = [simulated(seed, slides=False) for seed in range(30)]
    assert 0.8 < np.mean([ours for _, ours, _ in runs]) < 1.25
    assert all(0.6 < found.correlation < 1.0 for found, _, _ in runs)


def test_errors_that_slide_along_their_tracks_are_seen() -> None:
    runs = [simulated(seed, slides=True) for seed in range(30)]
    assert 0.8 < np.mean([ours for _, ours, _ in runs]) < 1.25
    assert np.mean([plain for _, _, plain in runs]) > 1.8  # what taking them for independent would have said
    assert np.mean([found.correlation for found, _, _ in runs]) > 1.1
    assert all(found.correlation > 1.0 for found, _, _ in runs)


def test_the_gauge_is_that_of_the_other_covariances_and_images_are_counted() -> None:
    found = perturb(make_scene(3, 6, 150, synthetic_camera(), sigma_px=SIGMA_PX).observed, rotation_deg=0.05)
    adjust_bundle(found, FIXED)
    ours, plain = clustered_covariances(found, FIXED), estimate_covariances(found, FIXED)
    np.testing.assert_array_equal(ours.image_idx, plain.image_idx)
    ratio = np.einsum("nii->ni", ours.poses) / np.einsum("nii->ni", plain.poses)
    assert ratio.min() > 0.3
    assert ratio.max() < 3.0
    assert ours.observations_per_image == pytest.approx(found.obs_is_inlier.sum() / 6, rel=0.02)


def test_free_intrinsics_are_refused_and_too_few_tracks_tell_nothing() -> None:
    found = make_scene(0, 6, 30).observed.copy()
    with pytest.raises(ValueError, match="constant"):
        clustered_covariances(found, AdjustOptions())
    assert np.isinf(clustered_covariances(found, FIXED).poses).all()
