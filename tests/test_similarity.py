"""Similarities: exact fits, degenerate cameras, outliers, and three independent oracles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfmapp.geometry import rigid3, similarity

seeds = st.integers(0, 2**31)
# wall clock says nothing on a busy machine
examples = settings(deadline=None, max_examples=50)


def random_similarity(rng: np.random.Generator) -> np.ndarray:
    rotation = rigid3.exp_so3(rng.normal(size=3) * 2)
    return similarity.from_parts(rotation, rng.normal(size=3) * 10, float(np.exp(rng.normal())))


def random_poses(rng: np.random.Generator, count: int, centers: np.ndarray | None = None) -> np.ndarray:
    rotation = rigid3.exp_so3(rng.normal(size=(count, 3)))
    centers = rng.normal(size=(count, 3)) if centers is None else centers
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def difference(sim_1: np.ndarray, sim_2: np.ndarray) -> float:
    """Largest change of the corners of the unit cube."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return float(np.abs(similarity.apply(sim_1, corners) - similarity.apply(sim_2, corners)).max())


@examples
@given(seeds)
def test_group_axioms(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = (random_similarity(rng) for _ in range(3))
    x = rng.normal(size=(5, 3))
    np.testing.assert_allclose(
        similarity.apply(similarity.compose(a, b), x), similarity.apply(a, similarity.apply(b, x)), atol=1e-9
    )
    assert difference(similarity.compose(a, similarity.inverse(a)), similarity.IDENTITY) < 1e-10
    left = similarity.compose(similarity.compose(a, b), c)
    assert difference(left, similarity.compose(a, similarity.compose(b, c))) < 1e-9


@examples
@given(seeds)
def test_transformed_cameras_see_transformed_points_in_the_same_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sim, poses, x = random_similarity(rng), random_poses(rng, 4), rng.normal(size=3)
    seen = rigid3.apply(poses, x)
    seen_after = rigid3.apply(similarity.transform_poses(sim, poses), similarity.apply(sim, x))
    np.testing.assert_allclose(seen_after, seen * sim[7], atol=1e-9 * sim[7])


@examples
@given(seeds, st.integers(3, 20))
def test_umeyama_is_exact_without_noise(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    sim, x = random_similarity(rng), rng.normal(size=(count, 3))
    assert difference(similarity.umeyama(x, similarity.apply(sim, x)), sim) < 1e-7


@examples
@given(seeds)
def test_umeyama_is_exact_on_a_plane(seed: int) -> None:
    """Rank two: the sign of the third axis follows from the determinant."""
    rng = np.random.default_rng(seed)
    sim, x = random_similarity(rng), rng.normal(size=(8, 3)) * [1, 1, 0]
    assert difference(similarity.umeyama(x, similarity.apply(sim, x)), sim) < 1e-7


def test_umeyama_on_the_example_of_the_paper() -> None:
    """Umeyama 1991, section III, with its 2D points laid in the plane z = 0 of a reflected set."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]])
    mirrored = x * [1, 1, -1]
    sim = similarity.umeyama(x, mirrored)
    assert np.linalg.det(rigid3.rotation_matrix(sim)) == pytest.approx(1.0)
    assert sim[7] < 1.0  # a mirror image can only be matched by shrinking


@examples
@given(seeds)
def test_umeyama_is_the_least_squares_minimum(seed: int) -> None:
    """Oracle: no small change of the seven parameters lowers the cost."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(10, 3))
    y = similarity.apply(random_similarity(rng), x) + rng.normal(size=(10, 3)) * 0.3
    sim = similarity.umeyama(x, y)
    cost = ((similarity.apply(sim, x) - y) ** 2).sum()
    for direction in rng.normal(size=(20, 7)):
        step = 1e-3 * direction
        nudge = similarity.from_parts(rigid3.exp_so3(step[:3]), step[3:6], float(np.exp(step[6])))
        assert ((similarity.apply(similarity.compose(nudge, sim), x) - y) ** 2).sum() > cost


def test_umeyama_agrees_with_scipy_and_pycolmap() -> None:
    from scipy.spatial.transform import Rotation

    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(3)
    x = rng.normal(size=(30, 3))
    y = similarity.apply(random_similarity(rng), x) + rng.normal(size=(30, 3)) * 0.1
    sim = similarity.umeyama(x, y)
    rotation, _ = Rotation.align_vectors(y - y.mean(0), x - x.mean(0))  # the same rotation for any scale
    np.testing.assert_allclose(rigid3.rotation_matrix(sim), rotation.as_matrix(), atol=1e-10)
    other = pycolmap.estimate_sim3d(x, y)
    np.testing.assert_allclose(np.c_[sim[7] * rigid3.rotation_matrix(sim), sim[4:7]], other.matrix()[:3], atol=1e-10)


@pytest.mark.parametrize("x", [np.zeros((5, 3)), np.outer(np.arange(5.0), [1, 2, 3]), np.ones((1, 3)), np.eye(3)[:2]])
def test_umeyama_refuses_what_does_not_determine_it(x: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"similarity|place"):
        similarity.umeyama(x, x)


@examples
@given(seeds, st.integers(2, 12), st.sampled_from(["general", "plane", "line"]))
def test_alignment_of_cameras_is_exact_in_every_arrangement(seed: int, count: int, arrangement: str) -> None:
    """Two cameras and straight paths included: there the twist comes from the orientations."""
    rng = np.random.default_rng(seed)
    flat = {"general": [1, 1, 1], "plane": [1, 1, 0], "line": [1, 0, 0]}[arrangement]
    spin = rigid3.exp_so3(rng.normal(size=3))
    poses = random_poses(rng, count, (rng.normal(size=(count, 3)) * flat) @ spin.T)
    sim = random_similarity(rng)
    moved = similarity.transform_poses(sim, poses)
    for align in (similarity.align_poses, similarity.align_poses_robust):
        result = align(poses, moved)
        assert result.is_inlier.all()
        assert result.is_twist_from_orientations == (count == 2 or arrangement == "line")
        recovered = similarity.transform_poses(result.b_from_a, poses)
        np.testing.assert_allclose(rigid3.center(recovered), rigid3.center(moved), atol=1e-7 * max(1, sim[7]))
        angle = rigid3.rotation_angle_deg(
            rigid3.rotation_matrix(recovered) @ rigid3.rotation_matrix(moved).swapaxes(-1, -2)
        )
        assert angle.max() < 1e-4


def test_line_with_noise_takes_its_twist_from_the_orientations() -> None:
    """The centres stray from the line by their noise only; a twist from them would be arbitrary."""
    rng = np.random.default_rng(0)
    line = np.outer(np.linspace(0, 10, 12), [1.0, 0, 0])
    rotation = rigid3.exp_so3(rng.normal(size=(12, 3)))

    def poses(centers: np.ndarray, tilt: np.ndarray) -> np.ndarray:
        turned = rigid3.exp_so3(tilt) @ rotation
        return rigid3.from_matrix(turned, -np.einsum("nij,nj->ni", turned, centers))

    a = poses(line + rng.normal(size=line.shape) * 0.02, np.zeros((12, 3)))
    b = poses(line + rng.normal(size=line.shape) * 0.02, np.radians(rng.normal(size=(12, 3)) * 0.5))
    result = similarity.align_poses(a, b)
    assert result.is_twist_from_orientations
    # twelve orientations with half a degree of noise: 0.15 degrees, and the line itself 0.05
    assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(result.b_from_a)) < 0.6
    # the plain fit to the centres twists at will
    plain = similarity.umeyama(rigid3.center(a), rigid3.center(b))
    assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(plain)) > 5


@examples
@given(seeds, st.integers(5, 30), st.floats(0, 0.49))
def test_gross_outliers_do_not_spoil_the_robust_fit(seed: int, count: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    poses, sim = random_poses(rng, count), random_similarity(rng)
    num_bad = min(int(share * count), (count - 1) // 2)
    moved = similarity.transform_poses(sim, poses)
    moved[:num_bad] = random_poses(rng, num_bad, rigid3.center(moved[:num_bad]) + 50 * rng.normal(size=(num_bad, 3)))
    result = similarity.align_poses_robust(poses, moved)
    recovered = rigid3.center(similarity.transform_poses(result.b_from_a, poses))
    np.testing.assert_allclose(recovered[num_bad:], rigid3.center(moved)[num_bad:], atol=1e-6 * max(1, sim[7]))
    assert not result.is_inlier[:num_bad].any()
    assert result.is_inlier[num_bad:].all()


def test_outliers_among_many_noisy_cameras() -> None:
    """More pairs than are tried: 200 cameras, 40 of them wrong, 1 % noise on the rest."""
    rng = np.random.default_rng(5)
    poses = random_poses(rng, 200)
    centers = rigid3.center(poses) + rng.normal(size=(200, 3)) * 0.01
    centers[:40] += rng.normal(size=(40, 3)) * 5
    moved = np.c_[poses[:, :4], -np.einsum("nij,nj->ni", rigid3.rotation_matrix(poses), centers)]
    result = similarity.align_poses_robust(poses, moved)
    assert not result.is_inlier[:40].any()
    assert result.is_inlier[40:].mean() > 0.95
    # 160 cameras of 0.01 noise determine the similarity to about 0.01 / sqrt(160) per axis
    assert 1e-5 < difference(result.b_from_a, similarity.IDENTITY) < 0.01
    again = similarity.align_poses_robust(poses, moved)
    np.testing.assert_array_equal(result.b_from_a, again.b_from_a)


def test_cameras_in_one_place_have_no_scale() -> None:
    rng = np.random.default_rng(1)
    poses = random_poses(rng, 6, np.tile(rng.normal(size=3), (6, 1)))
    for align in (similarity.align_poses, similarity.align_poses_robust):
        with pytest.raises(ValueError, match="place"):
            align(poses, poses)
        with pytest.raises(ValueError, match="two"):
            align(poses[:1], poses[:1])


@examples
@given(seeds)
def test_half_of_the_cameras_in_one_place(seed: int) -> None:
    """A tripod's panorama among other photographs is no trap for the better half."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(10, 3))
    centers[:7] = centers[0]
    poses, sim = random_poses(rng, 10, centers), random_similarity(rng)
    result = similarity.align_poses_robust(poses, similarity.transform_poses(sim, poses))
    assert difference(result.b_from_a, sim) < 1e-4 * max(1, sim[7])
