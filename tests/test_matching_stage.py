"""The matching stage as a whole: threads, resuming, cancelling, odd inputs, and real photographs."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfmapp.camera.camera import Camera, CameraModel, project, simple_camera
from sfmapp.errors import InputError, InterruptedRunError
from sfmapp.events import Event, Events
from sfmapp.geometry import rigid3
from sfmapp.matching import euclidean
from sfmapp.matching.report import MatchingReport
from sfmapp.matching.stage import MatchedPair, MatchingOptions, compile_kernels, join_pairs, match_images, split_pairs
from sfmapp.reporting import from_plain, plain
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.features import DescriptorMetric, Features

CAMERA = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 800, 900.0, 20.0, "exif_35mm")


def image_set(num: int, camera: Camera = CAMERA) -> Any:
    return SimpleNamespace(images=tuple(SimpleNamespace(camera_idx=0) for _ in range(num)), cameras=(camera,))


def all_pairs(num: int) -> np.ndarray:
    return np.stack(np.triu_indices(num, 1), 1).astype(np.int32)


def make_features(
    num_images: int, num_points: int, seed: int = 0
) -> tuple[list[Features], list[np.ndarray], np.ndarray]:
    """Views along an arc of points that look the same from everywhere; also which point each feature shows."""
    rng = np.random.default_rng(seed)
    histogram = rng.gamma(0.6, size=(num_points, 128))
    looks = 512 * np.sqrt(histogram / histogram.sum(1, keepdims=True))
    xyz = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (num_points, 3))
    poses = np.array([
        rigid3.from_matrix(rigid3.exp_so3([0.0, -0.06 * i, 0.01 * i]), [0.4 * i, 0.02 * i, 0.05 * i])
        for i in range(num_images)
    ])  # fmt: skip
    features, shown = [], []
    for pose in poses:
        xy = project(CAMERA, rigid3.apply(pose, xyz)) + rng.normal(0, 0.4, (num_points, 2))
        idx = rng.permutation(np.flatnonzero(((xy > 0) & (xy < [1000, 800])).all(1)))
        noisy = np.abs(looks[idx] + rng.normal(0, 6, (len(idx), 128)))
        noisy *= 512 / np.linalg.norm(noisy, axis=1, keepdims=True)
        keypoints = np.concatenate([xy[idx], np.full((len(idx), 1), 2.0), np.zeros((len(idx), 1))], 1)
        features.append(
            Features(keypoints.astype(np.float32), np.minimum(np.rint(noisy), 255).astype(np.uint8),
                     np.zeros((len(idx), 3), np.uint8))
        )  # fmt: skip
        shown.append(idx)
    return features, shown, poses


def run(
    features: list[Features], options: MatchingOptions | None = None, **kwargs: Any
) -> tuple[Correspondences, dict]:
    arguments: dict[str, Any] = {"seed": 0, "threads": 1, "events": Events()} | kwargs
    num = len(features)
    return match_images(image_set(num), features, all_pairs(num), options or MatchingOptions(), **arguments)


def as_bytes(correspondences: Correspondences) -> dict[str, bytes]:
    return {f.name: getattr(correspondences, f.name).tobytes() for f in fields(correspondences)}


@pytest.mark.parametrize("num_common", [0, 60])
def test_pairs_with_nothing_in_common_are_given_up_after_a_look(num_common: int) -> None:
    features, shown, _ = make_features(2, 1500)
    others, _, _ = make_features(1, 1500, seed=1)
    is_common = np.isin(shown[1], np.intersect1d(*shown)[:num_common])
    descriptors = np.where(is_common[:, None], features[1].descriptors, others[0].descriptors[: len(shown[1])])
    second = Features(features[1].keypoints, descriptors, features[1].rgb)
    found, report = run([features[0], second], MatchingOptions(coarse_features=300))
    pair = report["pairs"][0]
    assert (pair["num_compared"], report["num_unlike_pairs"]) == ((None, 0) if num_common else (600, 1))
    assert not pair["is_guided"]
    assert (len(found.matches) > 0.9 * num_common) == bool(num_common)


@pytest.mark.parametrize("coarse_features", [300, 100_000], ids=["guided", "full"])
def test_matches_and_poses_are_right(coarse_features: int) -> None:
    features, shown, poses = make_features(4, 1500)
    found, report = run(features, MatchingOptions(coarse_features=coarse_features))
    assert (found.config == TwoViewConfig.CALIBRATED).all()
    assert all(pair["is_guided"] == (coarse_features == 300) for pair in report["pairs"])
    for p, (i, j) in enumerate(found.pair_image_idx):
        matches = found.matches_of_pair(p)
        common = len(np.intersect1d(shown[i], shown[j]))
        assert len(matches) > 0.9 * common
        assert (shown[i][matches[:, 0]] == shown[j][matches[:, 1]]).mean() > 0.995
        assert len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)
        ground_truth = rigid3.compose(poses[j], rigid3.inverse(poses[i]))
        pose = found.cam2_from_cam1[p]
        assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(ground_truth).T) < 0.15
        assert pose[4:] @ ground_truth[4:] / np.linalg.norm(ground_truth[4:]) > np.cos(np.radians(1.0))
    assert from_plain(MatchingReport, plain(report)) == report


@pytest.mark.parametrize("coarse_features", [300, 100_000], ids=["guided", "full"])
def test_any_number_of_threads_gives_the_same_bytes(coarse_features: int) -> None:
    features, _, _ = make_features(5, 1200, seed=1)
    options = MatchingOptions(coarse_features=coarse_features)
    one, two, four = (as_bytes(run(features, options, threads=threads)[0]) for threads in (1, 2, 4))
    assert one == two == four
    # the answer to a pair depends on no other pair
    alone, _ = match_images(
        image_set(5), features, np.array([[1, 3]], np.int32), options, seed=0, threads=1, events=Events()
    )
    everything, _ = run(features, options)
    p = int(np.flatnonzero((everything.pair_image_idx == [1, 3]).all(1))[0])
    np.testing.assert_array_equal(alone.matches, everything.matches_of_pair(p))
    assert alone.fundamental[0].tobytes() == everything.fundamental[p].tobytes()


def test_known_pairs_are_not_matched_again() -> None:
    features, _, _ = make_features(4, 400, seed=2)
    done: dict[tuple[int, int], MatchedPair] = {}
    full, _ = run(features, on_pair=lambda i, j, pair: done.__setitem__((i, j), pair))
    assert set(done) == {(int(i), int(j)) for i, j in all_pairs(4)}
    known = {pair: done[pair] for pair in [(0, 1), (1, 3)]}
    told: list[tuple[int, int]] = []
    again, report = run(features, known=known, on_pair=lambda i, j, pair: told.append((i, j)))
    assert as_bytes(again) == as_bytes(full)
    assert sorted(told) == [(0, 2), (0, 3), (1, 2), (2, 3)]
    assert report["num_resumed_pairs"] == 2
    assert as_bytes(join_pairs(full.pair_image_idx, split_pairs(full))) == as_bytes(full)


def test_a_stop_keeps_what_is_done_and_tells_of_progress() -> None:
    features, _, _ = make_features(6, 300, seed=3)
    seen: list[Event] = []
    events, told = Events(seen.append), []

    def on_pair(i: int, j: int, pair: MatchedPair) -> None:
        told.append((i, j))
        if len(told) == 4:
            events.cancel()

    with pytest.raises(InterruptedRunError):
        run(features, events=events, on_pair=on_pair, threads=2)
    assert len(told) == 4
    assert [event.done for event in seen if event.kind == "advanced"] == [1, 2, 3, 4]
    assert seen[0].total == 15


def test_odd_inputs_give_empty_pairs() -> None:
    features, _, _ = make_features(2, 300, seed=4)
    empty = Features(np.empty((0, 4), np.float32), np.empty((0, 128), np.uint8), np.empty((0, 3), np.uint8))
    one = Features(features[0].keypoints[:1], features[0].descriptors[:1], features[0].rgb[:1])
    alike = Features(
        features[0].keypoints, np.tile(features[0].descriptors[:1], (len(features[0]), 1)), features[0].rgb
    )
    found, _ = run([features[0], empty, one, alike])
    assert (found.config == TwoViewConfig.UNDEFINED).all()
    assert len(found.matches) == 0
    assert np.isnan(found.cam2_from_cam1).all()
    nothing, report = run([features[0]])
    assert nothing.num_pairs == 0
    assert report["num_pairs"] == 0


def test_identical_images_show_no_motion() -> None:
    features, _, _ = make_features(1, 600, seed=5)
    found, _ = run([features[0], features[0]])
    assert found.config[0] == TwoViewConfig.PANORAMIC
    matches = found.matches_of_pair(0)
    np.testing.assert_array_equal(matches[:, 0], matches[:, 1])
    assert found.median_angle_deg[0] == 0.0
    np.testing.assert_allclose(found.cam2_from_cam1[0, :4], [0, 0, 0, 1], atol=1e-6)


def test_features_of_a_repeated_motif_do_not_upset_it() -> None:
    """Ten looks for all points: the ratio test leaves nothing, or what is left fits nothing."""
    features, _, _ = make_features(2, 800, seed=6)
    motif = [Features(f.keypoints, features[0].descriptors[np.arange(len(f)) % 10], f.rgb) for f in features]
    found, _ = run(motif, MatchingOptions(coarse_features=100))
    assert found.config[0] in (TwoViewConfig.UNDEFINED, TwoViewConfig.DEGENERATE)


def test_binary_descriptors_match_as_well() -> None:
    rng = np.random.default_rng(7)
    features, shown, _ = make_features(2, 500, seed=7)
    bits = rng.integers(0, 256, (500, 32)).astype(np.uint8)
    binary = [
        Features(f.keypoints, bits[idx], f.rgb, DescriptorMetric.HAMMING)
        for f, idx in zip(features, shown, strict=True)
    ]
    found, _ = run(binary)
    assert found.config[0] == TwoViewConfig.CALIBRATED
    matches = found.matches_of_pair(0)
    assert (shown[0][matches[:, 0]] == shown[1][matches[:, 1]]).all()


@pytest.mark.parametrize("length", [64, 128, 256])
@pytest.mark.parametrize("size", [1.0, 37.0])
def test_descriptors_of_a_network_match_by_their_own_metric(length: int, size: float) -> None:
    rng = np.random.default_rng(8)
    features, shown, _ = make_features(2, 500, seed=8)
    unit = rng.normal(0, 1, (500, length))
    unit *= size / np.linalg.norm(unit, axis=1, keepdims=True)
    noise = 0.1 * size / np.sqrt(length)
    learned = [
        Features.from_arrays(f.keypoints, unit[idx] + rng.normal(0, noise, (len(idx), length)))
        for f, idx in zip(features, shown, strict=True)
    ]
    assert learned[0].descriptors.dtype == np.float32
    found, _ = run(learned)
    assert found.config[0] == TwoViewConfig.CALIBRATED
    matches = found.matches_of_pair(0)
    assert len(matches) > 100
    assert (shown[0][matches[:, 0]] == shown[1][matches[:, 1]]).all()


def test_euclidean_matches_are_those_of_plain_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(9)
    a = rng.normal(0, 1, (230, 16)).astype(np.float32)
    b = np.concatenate([a[40:] + rng.normal(0, 0.3, (190, 16)).astype(np.float32), a[:5]])
    monkeypatch.setattr(euclidean, "_BLOCK_PRODUCTS", 7 * len(b))  # many blocks, the last one short
    distance = np.linalg.norm(a[:, None].astype(np.float64) - b[None], axis=2)
    unit = np.sqrt((np.square(a).sum() + np.square(b).sum()) / (len(a) + len(b)))
    expected = []
    for i in range(len(a)):
        j = int(distance[i].argmin())
        of_row, of_column = np.sort(distance[i]), np.sort(distance[:, j])
        is_mutual = distance[:, j].argmin() == i and of_row[0] <= 0.5 * unit
        if is_mutual and of_row[0] < 0.8 * of_row[1] and of_column[0] < 0.8 * of_column[1]:
            expected.append((i, j))
    assert 50 < len(expected) < 200
    np.testing.assert_array_equal(euclidean.match_euclidean(a, b, 0.8, 0.5), expected)
    assert euclidean.match_euclidean(a[:0], b, 0.8, 0.5).shape == (0, 2)
    assert euclidean.match_euclidean(a[:1], a[:1], 0.8, 0.5).tolist() == [[0, 0]]


def test_features_of_two_kinds_and_wrong_arrays_are_refused() -> None:
    xy = np.zeros((3, 2))
    learned = Features.from_arrays(xy, np.ones((3, 64)))
    bits = Features.from_arrays(xy, np.ones((3, 32), np.uint8), metric="hamming")
    with pytest.raises(InputError, match="two kinds"):
        run([learned, bits])
    for wrong in (
        {"keypoints": np.zeros((3, 5))},
        {"keypoints": np.array([[np.nan, 0.0]])},
        {"keypoints": xy, "descriptors": np.ones((2, 64))},
        {"keypoints": xy, "descriptors": np.ones((3, 128)), "metric": "root_sift"},
        {"keypoints": xy, "descriptors": np.ones((3, 64), np.uint8), "metric": "root_sift"},
        {"keypoints": xy, "descriptors": np.ones((3, 32)), "metric": "hamming"},
        {"keypoints": xy, "descriptors": np.ones((3, 64)), "metric": "cosine"},
        {"keypoints": xy, "rgb": np.ones((3, 3))},
    ):
        with pytest.raises(InputError, match="expected"):
            Features.from_arrays(**wrong)


def test_kernels_compile_on_their_own() -> None:
    compile_kernels()


@pytest.mark.real
@pytest.mark.slow
def test_photographs_match_and_guidance_agrees_with_the_full_product(data_root: Path) -> None:
    """Three views of fountain-P11: nearly all matches obey the laser-registered cameras, guided or not."""
    import cv2

    folder = data_root / "fountain-P11"
    ground_truth = json.loads((folder / "cameras.json").read_text())["cameras"][:3]
    features, projections = [], []
    for camera in ground_truth:
        keypoints, descriptors = cv2.SIFT_create(0, 3, 0.02).detectAndCompute(
            cv2.imread(str(folder / camera["file"]), 0), None
        )
        table = np.array([(*k.pt, k.size / 2, np.radians(k.angle)) for k in keypoints], np.float32)
        table[:, :2] += 0.5
        order = np.argsort(-table[:, 2], kind="stable")[:6000]
        root = np.sqrt(descriptors[order] / descriptors[order].sum(1, keepdims=True))
        descriptors = np.minimum(np.rint(512 * root), 255).astype(np.uint8)
        features.append(Features(table[order], descriptors, np.zeros((len(order), 3), np.uint8)))
        k = np.array(camera["K"])
        k[:2, 2] += 0.5
        projections.append((k, np.array(camera["R_w2c"]), np.array(camera["t_w2c"])))
    images = image_set(3, simple_camera(CameraModel.SIMPLE_RADIAL, 1536, 1024, 1843.0))
    kept = {}
    for coarse_features in (1536, 100_000):
        found, report = match_images(
            images, features, all_pairs(3), MatchingOptions(coarse_features=coarse_features), seed=0, threads=2,
            events=Events(),
        )  # fmt: skip
        assert all(pair["is_guided"] == (coarse_features == 1536) for pair in report["pairs"])
        for p, (i, j) in enumerate(found.pair_image_idx):
            (k1, r1, t1), (k2, r2, t2) = projections[i], projections[j]
            rotation = r2 @ r1.T
            f = np.linalg.inv(k2).T @ rigid3.skew(t2 - rotation @ t1) @ rotation @ np.linalg.inv(k1)
            matches = found.matches_of_pair(p)
            a, b = (
                np.append(features[image].keypoints[matches[:, side], :2], np.ones((len(matches), 1)), 1)
                for side, image in enumerate((i, j))
            )
            line2, line1 = a @ f.T, b @ f
            error = np.abs((b * line2).sum(1)) / np.sqrt((line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1))
            assert (error < 2).mean() > 0.98
            kept[coarse_features, p] = {tuple(m) for m in matches[error < 2]}
    for p in range(3):
        guided, full = kept[1536, p], kept[100_000, p]
        assert len(guided) > len(full)
        assert len(guided & full) > 0.97 * len(full)
