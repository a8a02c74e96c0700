"""Pose errors: exact values, invariance, known perturbations, names and failures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfmapp.evaluation import poses as evaluation
from sfmapp.geometry import rigid3, similarity

seeds = st.integers(0, 2**31)
examples = settings(deadline=None, max_examples=40)


def poses_at(centers: np.ndarray, rotation: np.ndarray | None = None) -> np.ndarray:
    centers = np.asarray(centers, float)
    rotation = np.tile(np.eye(3), (len(centers), 1, 1)) if rotation is None else rotation
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    return poses_at(rng.normal(size=(count, 3)), rigid3.exp_so3(rng.normal(size=(count, 3))))


def random_similarity(rng: np.random.Generator) -> np.ndarray:
    return similarity.from_parts(rigid3.exp_so3(rng.normal(size=3)), rng.normal(size=3), float(np.exp(rng.normal())))


def names_of(count: int) -> list[str]:
    return [f"{i:03d}.jpg" for i in range(count)]


# ------------------------------------------------------------------------------------------------------------ the AUC


@pytest.mark.parametrize(
    ("errors", "threshold", "expected"),
    [
        ([0, 0, 0], 5, 1.0),
        ([np.inf, np.inf], 5, 0.0),
        ([0, np.inf], 5, 0.5),
        ([2.5], 5, 0.5),
        ([1, 4], 5, (0.8 + 0.2) / 2),
        ([5, 5.0001], 5, 0.0),
        ([np.nan, 0], 1, 0.5),
        ([0.25, 0.75, 2.0, np.inf], 1, (0.75 + 0.25) / 4),
    ],
)
def test_auc_by_hand(errors: list[float], threshold: float, expected: float) -> None:
    assert evaluation.auc(errors, [threshold]) == [pytest.approx(expected, abs=1e-15)]


@examples
@given(seeds, st.integers(1, 60))
def test_auc_is_the_integral_of_the_recall(seed: int, count: int) -> None:
    """Oracle: the recall at a fine grid of thresholds, averaged."""
    errors = np.random.default_rng(seed).exponential(3.0, count)
    grid = (np.arange(20000) + 0.5) / 20000 * 5.0
    recall = np.searchsorted(np.sort(errors), grid, side="right") / count
    assert evaluation.auc(errors, [5.0])[0] == pytest.approx(recall.mean(), abs=1e-4)


@examples
@given(seeds, st.integers(2, 60))
def test_auc_is_near_the_trapezium_of_the_literature(seed: int, count: int) -> None:
    """SuperGlue's script joins the steps by straight lines; that adds at most half a step."""
    errors = np.sort(np.random.default_rng(seed).exponential(3.0, count))
    kept = errors < 5.0
    x = np.concatenate([[0.0], errors[kept], [5.0]])
    recall = np.concatenate([[0.0], (np.arange(count) + 1)[kept] / count])
    y = np.append(recall, recall[-1])
    trapezium = float(((y[1:] + y[:-1]) / 2 * np.diff(x)).sum() / 5.0)
    exact = evaluation.auc(errors, [5.0])[0]
    assert exact - 1e-12 <= trapezium <= exact + 0.5 / count + 1e-12


def test_auc_of_nothing_is_not_a_number() -> None:
    assert np.isnan(evaluation.auc([], [1.0])[0])


# ------------------------------------------------------------------------------------------------------ pairs of images


def test_pair_errors_by_hand() -> None:
    """Three cameras in a row; the last is moved so that two directions turn by 45 and by atan(1/2) degrees."""
    ground_truth = poses_at([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    estimate = poses_at([[0, 0, 0], [1, 0, 0], [2, 1, 0]])
    errors = evaluation.pair_errors_deg(estimate, ground_truth)
    np.testing.assert_allclose(errors, [0, np.degrees(np.arctan(0.5)), 45], atol=1e-12)


def test_pair_error_is_the_larger_of_rotation_and_direction() -> None:
    """Turning a camera in place by 2 degrees about the baseline changes no direction; about another axis it does."""
    ground_truth = poses_at([[0, 0, 0], [1, 0, 0]])
    for axis in np.eye(3):
        turned = rigid3.exp_so3(np.radians(2) * np.stack([0 * axis, axis]))
        estimate = poses_at([[0, 0, 0], [1, 0, 0]], turned)
        assert evaluation.pair_errors_deg(estimate, ground_truth) == pytest.approx([2.0], abs=1e-9)


def test_reversed_baseline_is_a_full_error() -> None:
    ground_truth, estimate = poses_at([[0, 0, 0], [1, 0, 0]]), poses_at([[0, 0, 0], [-1, 0, 0]])
    assert evaluation.pair_errors_deg(estimate, ground_truth) == pytest.approx([180.0])


def test_pairs_without_baseline() -> None:
    """Where the reference stands still only the rotation counts; where only the estimate does, the pair fails."""
    ground_truth = poses_at([[0, 0, 0], [0, 0, 0], [1, 0, 0]])
    turned = rigid3.exp_so3(np.radians([[0, 0, 0], [0, 0, 3.0], [0, 0, 0]]))
    estimate = poses_at([[0, 0, 0], [0, 0.1, 0], [0, 0, 0]], turned)
    errors = evaluation.pair_errors_deg(estimate, ground_truth)
    assert errors[0] == pytest.approx(3.0)
    assert np.isinf(errors[1])
    rotation_only = poses_at(np.zeros((3, 3)), turned)
    np.testing.assert_allclose(evaluation.pair_errors_deg(rotation_only, rotation_only), 0, atol=1e-9)


def test_unregistered_images_fail_all_their_pairs() -> None:
    ground_truth = random_poses(np.random.default_rng(0), 5)
    estimate = ground_truth.copy()
    estimate[2] = np.nan
    errors = evaluation.pair_errors_deg(estimate, ground_truth)
    i, j = np.triu_indices(5, 1)
    np.testing.assert_array_equal(np.isinf(errors), (i == 2) | (j == 2))
    assert evaluation.auc(errors) == [pytest.approx(0.6)] * 4


@examples
@given(seeds, st.floats(0.01, 179))
def test_angles_are_exact_from_tiny_to_wide(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    for degrees in (angle, angle * 1e-6):
        ground_truth = poses_at(np.zeros((2, 3)), rigid3.exp_so3(rng.normal(size=(2, 3))))
        estimate = ground_truth.copy()
        turned = rigid3.exp_so3(np.radians(degrees) * axis) @ rigid3.rotation_matrix(ground_truth[1])
        estimate[1] = rigid3.from_matrix(turned, np.zeros(3))
        assert evaluation.pair_errors_deg(estimate, ground_truth)[0] == pytest.approx(degrees, rel=1e-6, abs=1e-12)


# ----------------------------------------------------------------------------------------------------------- invariance


@examples
@given(seeds, st.integers(3, 12))
def test_perfect_up_to_a_similarity_is_perfect(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    ground_truth = random_poses(rng, count)
    estimate = similarity.transform_poses(random_similarity(rng), ground_truth)
    result = evaluation.evaluate_poses(names_of(count), estimate, names_of(count), ground_truth)
    assert result.center_error.max() < 1e-8
    assert result.rotation_error_deg.max() < 1e-5
    assert evaluation.auc(result.pair_error_deg) == [pytest.approx(1.0, abs=1e-4)] * 4


@examples
@given(seeds, st.integers(4, 10), st.booleans())
def test_all_numbers_are_invariant_under_a_similarity_of_the_estimate(seed: int, count: int, is_robust: bool) -> None:
    rng = np.random.default_rng(seed)
    ground_truth, names = random_poses(rng, count), names_of(count)
    estimate = rigid3.compose(poses_at(rng.normal(size=(count, 3)) * 0.02), ground_truth)
    moved = similarity.transform_poses(random_similarity(rng), estimate)
    a = evaluation.evaluate_poses(names, estimate, names, ground_truth, is_robust=is_robust)
    b = evaluation.evaluate_poses(names, moved, names, ground_truth, is_robust=is_robust)
    np.testing.assert_allclose(a.center_error, b.center_error, atol=1e-7)
    np.testing.assert_allclose(a.rotation_error_deg, b.rotation_error_deg, atol=1e-5)
    np.testing.assert_allclose(a.pair_error_deg, b.pair_error_deg, atol=1e-5)


@examples
@given(seeds, st.integers(4, 10))
def test_a_similarity_of_the_reference_scales_the_centre_errors_alone(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    ground_truth, names, sim = random_poses(rng, count), names_of(count), random_similarity(rng)
    estimate = rigid3.compose(poses_at(rng.normal(size=(count, 3)) * 0.02), ground_truth)
    a = evaluation.evaluate_poses(names, estimate, names, ground_truth)
    b = evaluation.evaluate_poses(names, estimate, names, similarity.transform_poses(sim, ground_truth))
    np.testing.assert_allclose(b.center_error, sim[7] * a.center_error, atol=1e-7 * sim[7])
    assert b.scene_size == pytest.approx(sim[7] * a.scene_size)
    np.testing.assert_allclose(a.rotation_error_deg, b.rotation_error_deg, atol=1e-5)
    np.testing.assert_allclose(a.pair_error_deg, b.pair_error_deg, atol=1e-5)


@examples
@given(seeds, st.integers(3, 10))
def test_order_and_strangers_do_not_matter(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    ground_truth, names = random_poses(rng, count), names_of(count)
    estimate = rigid3.compose(poses_at(rng.normal(size=(count, 3)) * 0.02), ground_truth)
    a = evaluation.evaluate_poses(names, estimate, names, ground_truth)
    order = rng.permutation(count)
    shuffled = [names[i] for i in order] + ["stranger.jpg"]
    b = evaluation.evaluate_poses(shuffled, np.vstack([estimate[order], random_poses(rng, 1)]), names, ground_truth)
    np.testing.assert_allclose(a.center_error, b.center_error, atol=1e-9)
    np.testing.assert_allclose(a.pair_error_deg, b.pair_error_deg, atol=1e-7)


# ------------------------------------------------------------------------------------------------- known perturbations


def test_centre_noise_comes_out_as_it_went_in() -> None:
    """rms of 0.01 per axis over 400 cameras: sqrt(3) 0.01, less the seven parameters of the fit."""
    rng = np.random.default_rng(2)
    ground_truth = random_poses(rng, 400)
    rotation = rigid3.rotation_matrix(ground_truth)
    estimate = poses_at(rigid3.center(ground_truth) + rng.normal(size=(400, 3)) * 0.01, rotation)
    result = evaluation.evaluate_poses(names_of(400), estimate, names_of(400), ground_truth)
    rms = result.summary()["center_error"]["rmse"]
    assert 0.95 < rms / (0.01 * np.sqrt(3 * (1 - 7 / 1200))) < 1.05
    assert result.rotation_error_deg.max() < 0.2  # only what the fit itself turns


def test_rotation_noise_comes_out_as_it_went_in() -> None:
    rng = np.random.default_rng(3)
    ground_truth = random_poses(rng, 300)
    angles = rng.uniform(0.1, 2.0, 300)
    axes = rng.normal(size=(300, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turned = rigid3.exp_so3(np.radians(angles)[:, None] * axes) @ rigid3.rotation_matrix(ground_truth)
    result = evaluation.evaluate_poses(
        names_of(300), poses_at(rigid3.center(ground_truth), turned), names_of(300), ground_truth
    )
    np.testing.assert_allclose(result.rotation_error_deg, angles, atol=1e-5)
    assert result.center_error.max() < 1e-9


def test_one_wrong_camera_shows_as_one_wrong_camera_in_the_robust_fit() -> None:
    rng = np.random.default_rng(4)
    ground_truth, names = random_poses(rng, 9), names_of(9)
    estimate = similarity.transform_poses(random_similarity(rng), ground_truth)
    estimate[3, 4:] += 40 * similarity.IDENTITY[7]
    robust = evaluation.evaluate_poses(names, estimate, names, ground_truth, is_robust=True)
    assert np.flatnonzero(robust.center_error > 1e-6).tolist() == [3]
    assert np.flatnonzero(~robust.is_inlier).tolist() == [3]
    assert robust.summary()["num_outliers"] == 1
    assert np.median(evaluation.evaluate_poses(names, estimate, names, ground_truth).center_error) > 0.01


# ------------------------------------------------------------------------------------------- names, gaps, degenerate


def test_names_match_in_full_then_by_file_then_by_stem() -> None:
    names = ["a/1.jpg", "b/1.jpg", "c/2.jpg", "3.png", "4.jpg"]
    reference = ["b/1.jpg", "images/2.jpg", "images/3.jpg", "images/1.jpg", "5.jpg", "4.jpg"]
    # images/1.jpg is a/1.jpg: the other 1.jpg is taken already
    assert evaluation.match_names(names, reference).tolist() == [1, 2, 3, 0, -1, 4]
    assert evaluation.match_names(["a/1.jpg", "b/1.jpg"], ["c/1.jpg"]).tolist() == [-1]
    assert evaluation.match_names([], []).tolist() == []


def test_missing_images_and_missing_ground_truth() -> None:
    rng = np.random.default_rng(5)
    ground_truth, names = random_poses(rng, 6), names_of(6)
    estimate, ground_truth_with_gap = ground_truth.copy(), ground_truth.copy()
    estimate[0] = np.nan
    ground_truth_with_gap[1] = np.nan
    result = evaluation.evaluate_poses(names[:-1], estimate[:-1], names, ground_truth_with_gap)
    assert result.names == ("000.jpg", "002.jpg", "003.jpg", "004.jpg", "005.jpg")
    assert result.is_common.tolist() == [False, True, True, True, False]
    assert np.isnan(result.center_error).tolist() == [True, False, False, False, True]
    # 3 of 10 pairs are whole
    assert evaluation.auc(result.pair_error_deg) == [pytest.approx(0.3)] * 4
    assert result.summary()["num_common"] == 3


@pytest.mark.parametrize("count", [0, 1])
def test_too_little_to_align(count: int) -> None:
    ground_truth = random_poses(np.random.default_rng(6), 4)
    result = evaluation.evaluate_poses(names_of(count), ground_truth[:count], names_of(4), ground_truth)
    summary = result.summary()
    assert result.reference_from_estimate is None
    assert summary["center_error"] is None
    assert summary["auc"] == {"0.5": 0.0, "1": 0.0, "3": 0.0, "5": 0.0}
    assert summary["num_common"] == count


def test_pure_rotation_has_an_auc_but_no_centre_error() -> None:
    rng = np.random.default_rng(7)
    ground_truth = poses_at(np.zeros((5, 3)), rigid3.exp_so3(rng.normal(size=(5, 3))))
    result = evaluation.evaluate_poses(names_of(5), ground_truth, names_of(5), ground_truth)
    assert result.summary()["center_error"] is None
    assert result.summary()["auc"]["0.5"] == pytest.approx(1.0, abs=1e-6)


def test_two_cameras_have_a_rotation_error() -> None:
    """The twist about the baseline comes from the orientations: turning one camera by 2 degrees leaves 1 on each."""
    ground_truth = poses_at([[0, 0, 0], [1, 0, 0]])
    turned = rigid3.exp_so3(np.radians([[0, 0, 0], [2.0, 0, 0]]))
    result = evaluation.evaluate_poses(names_of(2), poses_at([[0, 0, 0], [1, 0, 0]], turned), names_of(2), ground_truth)
    np.testing.assert_allclose(result.rotation_error_deg, [1, 1], atol=1e-9)
    np.testing.assert_allclose(result.center_error, 0, atol=1e-12)


def test_scene_size_is_the_largest_distance() -> None:
    assert evaluation.scene_size(poses_at([[0, 0, 0], [3, 0, 0], [0, 4, 0]])) == pytest.approx(5.0)
    assert evaluation.scene_size(np.zeros((0, 7))) == 0.0


def test_names_by_the_end_of_their_paths() -> None:
    ours = ["a/1.jpg", "b/1.jpg", "b/2.jpg", "frame.0001.png", "frame.0002.png", "shoot/c/9.jpg"]
    theirs = [
        "/data/x/b/1.jpg",
        "C:/photos/a/1.jpg",
        "../photos/b/2.jpg",
        "train/frame.0002",
        "./frame.0001",
        "c/9.jpg",
    ]
    assert evaluation.match_names(ours, theirs).tolist() == [1, 0, 2, 4, 3, 5]
    # two that end alike belong to nobody
    assert evaluation.match_names(["a/1.jpg", "b/1.jpg"], ["x/a/1.jpg", "y/a/1.jpg"]).tolist() == [-1, -1]
