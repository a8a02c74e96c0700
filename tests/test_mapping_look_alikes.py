"""Models held against their verified pairs, and things that look alike from several sides: right, or red."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rendered_worlds.rendering import Optics, Renderer
from rendered_worlds.worlds import look_alike_world
from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.events import Events
from sfmapp.features.extract import FeatureOptions, extract_features
from sfmapp.geometry import rigid3
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageOptions
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.verified_pairs import MIN_MATCHES_AGAINST, Chains, contradictions_of, pair_agreement, standing_pairs
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.stage import match_images
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_look_alike, make_scene, true_correspondences
from test_mapping import center_errors, inputs, reconstruct


def turned(model: Reconstruction, image_idx: int, degrees: float) -> Reconstruction:
    """A copy in which one image was carried round the middle of the scene."""
    out = model.copy()
    turn = rigid3.from_matrix(rigid3.exp_so3(np.radians([0.0, 0.0, degrees])), np.zeros(3))
    out.cam_from_world[image_idx] = rigid3.compose(model.cam_from_world[image_idx], turn)
    return out


def with_false_matches(found: Correspondences, pair_idx: int, wrong: np.ndarray) -> Correspondences:
    """A pair that has other matches (K, 2), their partners exchanged at random."""
    matches = [found.matches_of_pair(p) for p in range(found.num_pairs)]
    matches[pair_idx] = wrong.copy()
    matches[pair_idx][:, 1] = np.random.default_rng(0).permutation(wrong[:, 1])
    counts = [len(m) for m in matches]
    return replace(found, pair_ptr=np.concatenate([[0], np.cumsum(counts)]), matches=np.concatenate(matches))


def test_the_true_model_agrees_with_every_pair():
    scene = make_scene(5, 14, 1200, sigma_px=0.7)
    found = true_correspondences(scene)
    agreement = pair_agreement(scene.observed, found)
    np.testing.assert_array_equal(agreement.num_matches, found.num_inliers[agreement.pair_idx])
    assert (agreement.num_agreeing > 0.99 * agreement.num_matches).all()
    np.testing.assert_array_equal(agreement.num_shared, agreement.num_matches)  # all observations are inliers
    assert contradictions_of([scene.observed], found) == [[]]


def test_an_image_in_a_wrong_place_is_named_and_widens_every_sigma():
    scene = make_scene(5, 14, 1200)
    found = true_correspondences(scene)
    wrong = turned(scene.observed, 6, 150.0)
    agreement = pair_agreement(wrong, found)
    of_it = (agreement.image_idx == 6).any(axis=1)
    # a band of 10 px in 1000 catches some by chance, and those must lie in front of both cameras too
    assert agreement.num_agreeing[of_it].sum() < 0.1 * agreement.num_matches[of_it].sum()
    assert agreement.agrees[~of_it].all()
    wrong.obs_is_inlier[wrong.tracks.observations_of_image(6)] = False
    (contradiction,) = contradictions_of([wrong], found)[0]
    assert all("image0006.jpg" in pair["images"] for pair in contradiction.evidence["pairs"])
    assert "image0006.jpg" in contradiction.message
    enough = of_it & (agreement.num_matches >= MIN_MATCHES_AGAINST)
    assert contradiction.evidence["num_pairs"] == enough.sum()
    assert contradiction.evidence["num_matches"] == agreement.num_matches[enough].sum()
    assert contradiction.rotation_sigma_deg == pytest.approx(150.0, abs=1.0)
    # 3 sigmas along each axis hold what the image is off by, in shares of the spread of the centres
    off = np.linalg.norm(wrong.centers[6] - scene.ground_truth.centers[6])
    spread = np.sqrt(((scene.ground_truth.centers - scene.ground_truth.centers.mean(0)) ** 2).sum(1).mean())
    assert off < 3 * contradiction.position_sigma_share * spread


@pytest.mark.parametrize("seed", [6, 7, 8])
def test_a_false_pair_is_overruled_only_by_what_is_clearly_stronger(seed):
    scene = make_scene(seed, 14, 1500)
    found = true_correspondences(scene)
    p = int(np.argmax(found.num_inliers))
    matches = found.matches_of_pair(p)
    # those of one part of the picture, as of a thing in it that looks like another, against those of all of it
    along = scene.keypoints(int(found.pair_image_idx[p, 0]))[matches[:, 0], 0]
    part = matches[np.argsort(along)[: len(matches) // 3]]
    assert len(part) >= 60
    for wrong, stands in ((part, False), (matches, True)):
        standing = standing_pairs(scene.observed, with_false_matches(found, p, wrong))
        k = int(np.flatnonzero(standing.agreement.pair_idx == p)[0])
        assert standing.agreement.contradicts[k]
        assert standing.stands[k] == stands
        assert standing.stands.sum() == stands
        assert standing.overruled_by[k] > 0.6


def test_strong_pairs_between_two_models_are_red():
    scene = make_scene(7, 12, 1500)
    found = true_correspondences(scene)
    first, second = scene.observed.copy(), scene.observed.copy()
    for model, gone in ((first, range(7, 12)), (second, range(7))):
        model.cam_from_world[list(gone)] = np.nan
        model.obs_is_inlier[np.isin(model.tracks.obs_image_idx, list(gone))] = False
    of_first, of_second = contradictions_of([first, second], found)
    assert of_second == []
    assert of_first[0].evidence["other_model"] == 1
    a, b = of_first[0].evidence["pairs"][0]["images"]
    assert int(a[5:9]) < 7 <= int(b[5:9])


def test_a_photograph_that_no_model_holds_is_red_if_it_matches_one_of_the_model():
    scene = make_scene(7, 14, 1500)
    found = true_correspondences(scene)
    model = scene.observed.copy()
    model.cam_from_world[5] = np.nan
    model.obs_is_inlier[model.tracks.observations_of_image(5)] = False
    (contradiction,) = contradictions_of([model], found)[0]
    assert contradiction.evidence["num_images"] == 1
    assert all("image0005.jpg" in pair["images"] for pair in contradiction.evidence["pairs"])


def test_chains_are_the_widest_paths():
    rng = np.random.default_rng(0)
    for _ in range(30):
        num = int(rng.integers(2, 12))
        edges = rng.integers(0, num, (int(rng.integers(1, 25)), 2))
        edges = edges[edges[:, 0] != edges[:, 1]]
        strength = rng.integers(1, 6, len(edges)) / 5.0
        widest = np.zeros((num, num))
        for (a, b), w in zip(edges, strength, strict=True):
            widest[a, b] = widest[b, a] = max(widest[a, b], w)
        for k in range(num):
            widest = np.maximum(widest, np.minimum(widest[:, k : k + 1], widest[k]))
        chains = Chains.of(num, edges, strength)
        for a in range(num):
            for b in set(range(num)) - {a}:
                link = chains.weakest_link(a, b)
                assert (chains.strength[link] if link >= 0 else 0.0) == widest[a, b]


def test_without_takes_the_matches_of_pairs_out():
    found = true_correspondences(make_scene(1, 6, 300))
    fewer = found.without(np.array([0, 3]))
    assert fewer.num_inliers[[0, 3]].tolist() == [0, 0]
    assert fewer.config[[0, 3]].tolist() == [0, 0]
    np.testing.assert_array_equal(fewer.matches_of_pair(4), found.matches_of_pair(4))
    assert len(fewer.matches) == found.num_inliers[[1, 2, *range(4, found.num_pairs)]].sum()


def test_nothing_is_mapped_again_where_nothing_contradicts():
    _, report = reconstruct(make_scene(1, 10, 800))
    assert report["look_alikes"] == {}
    assert report["models"][0]["contradictions"] == []


def map_look_alike(seed: int, num_images: int, num_points: int, **kinds):
    scene, found = make_look_alike(seed, num_images, num_points, **kinds)
    image_set, features, _ = inputs(scene)
    models, report = map_images(
        image_set, features, found, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=Events()
    )
    return scene, models, report


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_background_tells_sides_that_look_alike_apart(seed):
    scene, models, report = map_look_alike(seed, 30, 4000, background=0.85)
    assert report["look_alikes"]["num_matches_against_before"] > 100  # the first map was folded
    assert report["look_alikes"]["num_matches_against"] == 0
    assert len(models) == 1
    assert models[0].is_registered.all()
    assert report["models"][0]["contradictions"] == []
    assert center_errors(models[0], scene.ground_truth).max() < 3e-3  # a fold is 1 and more


@pytest.mark.parametrize("seed", [0, 1])
def test_a_fold_that_nothing_can_resolve_is_red(seed):
    scene, models, report = map_look_alike(seed, 24, 1500, background=0.0)
    assert center_errors(models[0], scene.ground_truth).max() > 0.5  # folded
    assert report["models"][0]["contradictions"][0]["subject"] == "verified pairs"
    # centres are off by up to the diameter of the ring: three stated sigmas are more
    assert report["models"][0]["uncertainty"]["median_center_sigma_share"] > 1 / 3


def photographs(tmp_path, num: int, *, has_background: bool) -> tuple[np.ndarray, SimpleNamespace]:
    """True poses of photographs round the thing, and the files."""
    import cv2

    rng = np.random.default_rng(3)
    camera = Camera(CameraModel.PINHOLE, 480, 360, np.array([394.0, 394.0, 240.0, 180.0]))
    renderer = Renderer(look_alike_world(1, has_background=has_background), camera)
    poses = []
    for k in range(num):
        angle = 2 * np.pi * k / num
        center = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), 1.1]) + rng.normal(0.0, 0.05, 3)
        z = np.array([0.0, 0.0, 0.55]) - center
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 0.0, -1.0], z)
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        poses.append(rigid3.from_matrix(rotation, -rotation @ center))
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), renderer.photograph(poses[-1], Optics(), [3, k]))
    return np.array(poses), load_images(tmp_path, ImageOptions(), Events(), threads=1)[0]


@pytest.mark.parametrize("has_background", [True, False])
def test_rendered_photographs_round_a_thing_with_two_like_sides(tmp_path, has_background):
    num = 32 if has_background else 20
    ground_truth, image_set = photographs(tmp_path, num, has_background=has_background)
    events = Events()
    features, _ = extract_features(image_set, FeatureOptions(), threads=1, events=events)
    pairs = np.stack(np.triu_indices(num, 1), 1).astype(np.int32)
    found, _ = match_images(image_set, features, pairs, MatchingOptions(), seed=0, threads=1, events=events)
    models, report = map_images(
        image_set, features, found, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=events
    )
    reference = models[0].copy()
    reference.cam_from_world[:] = ground_truth
    error = center_errors(models[0], reference)
    red = report["models"][0]["contradictions"]
    if has_background:
        assert report["look_alikes"]["num_pairs_dropped"] > 50
        assert red == []
        assert len(models) == 1
        assert models[0].is_registered.all()
        assert error.max() < 3e-3
    else:  # nothing tells the sides apart: folded or not, whole or in parts, it must be said
        assert red[0]["evidence"]["num_pairs"] > 0
