"""The pose graph: gtsam's conventions, what it does to known drift, and what moves with it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfmapp.camera.camera import CameraModel, project, simple_camera
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.loops.pose_graph import (
    GraphEdges,
    LoopEdge,
    _node,
    _noise,
    _similarity,
    apply_corrections,
    count_shared,
    essential_edges,
    keyframe_depths,
    optimize_pose_graph,
)
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.scene.rig import Rig

Array = np.ndarray


def random_similarity(rng: np.random.Generator, spread: float = 1.0) -> Array:
    turn = rigid3.exp_so3(spread * rng.normal(size=3))
    return similarity.from_parts(turn, spread * rng.normal(size=3), float(np.exp(spread * rng.normal())))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_gtsam_similarities_are_the_house_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, x = random_similarity(rng), random_similarity(rng), rng.normal(size=3)
    assert np.allclose(_similarity(_node(a, False)), a, atol=1e-12)
    assert np.allclose(_node(a, False).transformFrom(x), similarity.apply(a, x))
    both = _similarity(_node(a, False).compose(_node(b, False)))
    assert np.allclose(similarity.apply(both, x), similarity.apply(similarity.compose(a, b), x))
    between = _similarity(_node(a, False).between(_node(b, False)))
    expected = similarity.apply(similarity.inverse(a), similarity.apply(b, x))
    assert np.allclose(similarity.apply(between, x), expected)


@pytest.mark.parametrize("kind", ["rotation", "translation", "scale"])
def test_the_noise_is_in_the_order_of_gtsam_s_tangent(kind: str) -> None:
    """One step of h in one kind costs (h / sigma)^2 / 2 with that kind's sigma, and gtsam's derivatives agree."""
    h, depth, baseline, count = 1e-3, 5.0, 0.5, 100
    step = {
        "rotation": similarity.from_parts(rigid3.exp_so3([0.0, h, 0.0]), np.zeros(3), 1.0),
        "translation": similarity.from_parts(np.eye(3), [h, 0.0, 0.0], 1.0),
        "scale": similarity.from_parts(np.eye(3), np.zeros(3), float(np.exp(h))),
    }[kind]
    ray = 1e-3 / np.sqrt(count)
    sigma = {"rotation": ray, "translation": ray * depth, "scale": ray * depth / baseline}[kind]
    rng = np.random.default_rng(0)
    a, relative = random_similarity(rng), random_similarity(rng, 0.3)
    factor = gtsam.BetweenFactorSimilarity3(0, 1, _node(relative, False), _noise(count, depth, baseline, 7))
    values = gtsam.Values()
    values.insert(0, _node(a, False))
    values.insert(1, _node(similarity.compose(a, similarity.compose(relative, step)), False))
    assert factor.error(values) == pytest.approx(0.5 * (h / sigma) ** 2, rel=1e-3)
    jacobian, right = factor.linearize(values).jacobian()
    for column in range(14):
        delta = np.zeros(7)
        delta[column % 7] = 1e-6
        moved = gtsam.Values(values)
        moved.update(column // 7, values.atSimilarity3(column // 7).retract(delta))
        change = factor.linearize(moved).jacobian()[1] - right
        # the right hand side is minus the whitened error
        assert np.allclose(-change / 1e-6, jacobian[:, column], rtol=0.02, atol=0.01 * np.abs(jacobian).max())


def walk(num: int, noise: Array, seed: int) -> tuple[Array, Array, Array, Array]:
    """A ring of keyframes with a random walk of drift: true and drifted poses, the drift (K, 8), and the loop."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, num)
    centers = np.stack([20 * np.cos(angle), 20 * np.sin(angle), np.zeros(num)], 1)
    turn = rigid3.exp_so3(np.outer(-angle, [0.0, 0.0, 1.0]))
    ground_truth = rigid3.from_matrix(turn, -np.einsum("nij,nj->ni", turn, centers))
    nodes = [np.append(rigid3.inverse(pose), 1.0) for pose in ground_truth]
    drifted = [nodes[0]]
    for k in range(1, num):
        e = noise * rng.normal(size=7)
        step = similarity.from_parts(rigid3.exp_so3(e[:3]), e[3:6], float(np.exp(e[6])))
        relative = similarity.compose(similarity.inverse(nodes[k - 1]), nodes[k])
        drifted.append(similarity.compose(drifted[-1], similarity.compose(relative, step)))
    poses = np.array([rigid3.inverse(node[:7]) for node in drifted])
    scale = np.array([node[7] for node in drifted])
    last = similarity.compose(drifted[0], similarity.compose(similarity.inverse(nodes[0]), nodes[-1]))
    return ground_truth, poses, scale, similarity.compose(last, similarity.inverse(drifted[-1]))


def chain(num: int, depth: Array | float = 5.0, baseline: float = 1.0) -> GraphEdges:
    pair = np.stack([np.arange(num - 1), np.arange(1, num)], 1)
    return GraphEdges(pair, np.full(num - 1, 100), np.broadcast_to(depth, num - 1) * 1.0, np.full(num - 1, baseline))


def rms(poses: Array, ground_truth: Array) -> float:
    return float(np.sqrt(((rigid3.center(poses) - rigid3.center(ground_truth)) ** 2).sum(1).mean()))


def test_translation_drift_becomes_a_bridge() -> None:
    """A random walk has a mean square of N / 2 steps; pinned at both ends it has N / 6: a third is left."""
    before, after = 0.0, 0.0
    noise = np.array([0.0, 0.0, 0.0, 0.02, 0.02, 0.02, 0.0])
    for seed in range(60):
        ground_truth, poses, _, loop = walk(60, noise, seed)
        corrections = optimize_pose_graph(poses, chain(60), [LoopEdge(0, 59, loop, 100_000)], True)
        assert np.all(corrections[:, 7] == 1.0)
        moved = np.array([similarity.transform_poses(c, p) for c, p in zip(corrections, poses, strict=True)])
        assert np.linalg.norm(rigid3.center(moved[-1]) - rigid3.center(ground_truth[-1])) < 0.01
        before += rms(poses, ground_truth) ** 2
        after += rms(moved, ground_truth) ** 2
    assert 0.25 < after / before < 0.42


def test_scale_drift_is_undone_step_by_step() -> None:
    """A constant loss of scale, seen at the end, is spread evenly over its logarithm when all edges are alike."""
    num, loss = 40, 0.99
    centers = np.zeros((num, 3))
    scale = loss ** np.arange(num)
    # straight on, every step as long as the scale makes it, looking along the way
    centers[1:, 2] = np.cumsum(scale[:-1])
    poses = rigid3.from_matrix(np.broadcast_to(np.eye(3), (num, 3, 3)), -centers)
    true_last = np.array([0.0, 0.0, float(num - 1)])
    last = similarity.from_parts(np.eye(3), true_last - centers[-1] / scale[-1], 1.0 / scale[-1])
    edges = chain(num, depth=5.0 * scale[1:])
    edges = GraphEdges(edges.pair, edges.num_shared, edges.depth, scale[:-1])
    corrections = optimize_pose_graph(poses, edges, [LoopEdge(0, num - 1, last, 1000)], False)
    assert np.allclose(corrections[:, 7] * scale, 1.0, atol=0.02)
    moved = np.array([similarity.transform_poses(c, p) for c, p in zip(corrections, poses, strict=True)])
    wrong = np.abs(rigid3.center(moved)[:, 2] - np.arange(num)).max()
    assert wrong < 0.15 * np.abs(centers[:, 2] - np.arange(num)).max()


def test_seven_kinds_of_drift_at_once() -> None:
    noise = np.array([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01, 0.01])
    before, after, log_scale = [], [], []
    for seed in range(12):
        ground_truth, poses, scale, loop = walk(80, noise, seed)
        corrections = optimize_pose_graph(poses, chain(80, 5.0 * scale[1:]), [LoopEdge(0, 79, loop, 500)], False)
        moved = np.array([similarity.transform_poses(c, p) for c, p in zip(corrections, poses, strict=True)])
        before.append(rms(poses, ground_truth))
        after.append(rms(moved, ground_truth))
        log_scale.append(abs(np.log(corrections[-1, 7] * scale[-1])))
    assert max(log_scale) < 0.02
    # a bridge: more than half of the error goes, and a third of it must stay in the middle
    assert 0.15 < np.mean(after) / np.mean(before) < 0.6


def test_a_loop_that_says_nothing_new_moves_nothing() -> None:
    _, poses, _, _ = walk(20, np.full(7, 0.01), 1)
    for fix_scale in (True, False):
        corrections = optimize_pose_graph(poses, chain(20), [LoopEdge(0, 19, similarity.IDENTITY, 50)], fix_scale)
        assert np.allclose(corrections, similarity.IDENTITY, atol=1e-9)


def test_the_same_twice() -> None:
    _, poses, _, loop = walk(30, np.full(7, 0.01), 2)
    first, second = (optimize_pose_graph(poses, chain(30), [LoopEdge(0, 29, loop, 50)], False) for _ in range(2))
    assert first.tobytes() == second.tobytes()


@pytest.fixture
def small_map() -> KeyframeMap:
    """Twelve keyframes on a line; each sees the points ahead of it, 60 in all."""
    rng = np.random.default_rng(3)
    keyframes = KeyframeMap(Rig.single(simple_camera(CameraModel.SIMPLE_PINHOLE, 640, 480, 500.0)))
    ids = keyframes.new_points(60)
    keyframes.point_xyz[ids] = np.stack([rng.uniform(-2, 2, 60), rng.uniform(-2, 2, 60), 4 + 0.2 * np.arange(60)], 1)
    keyframes.point_xyz[7] = np.nan
    for k in range(12):
        pose = np.array([0, 0, 0, 1.0, 0, 0, -0.5 * k])
        seen = ids[(ids >= 2 * k) & (ids < 2 * k + 30)]
        xy = project(keyframes.rig.cameras[0], rigid3.apply(pose, keyframes.point_xyz[seen]))
        keyframe = Keyframe(3 * k, 0.1 * k, f"{k}", pose, seen, xy[:, None], np.ones((len(seen), 1), bool))
        keyframes.keyframes.append(keyframe)
    return keyframes


def test_shared_points_and_edges(small_map: KeyframeMap) -> None:
    counts = count_shared(small_map)
    for i, a in enumerate(small_map.keyframes):
        for j, b in enumerate(small_map.keyframes):
            assert counts[i, j] == len(np.setdiff1d(np.intersect1d(a.point_id, b.point_id), [7]))
    edges = essential_edges(small_map)
    pairs = [tuple(p) for p in edges.pair]
    assert len(set(pairs)) == len(pairs)
    assert all((k, k + 1) in pairs for k in range(11))
    assert all(n == counts[i, j] and (n >= 15 or j == i + 1) for (i, j), n in zip(pairs, edges.num_shared, strict=True))
    spacing = np.diff(edges.pair, axis=1)[:, 0]
    assert np.allclose(edges.baseline, 0.5 * spacing)
    assert np.allclose(edges.depth, keyframe_depths(small_map)[edges.pair[:, 1]])


def test_what_moves_as_one_keeps_its_images(small_map: KeyframeMap) -> None:
    before = [k.xy[:, 0].copy() for k in small_map.keyframes]
    move = random_similarity(np.random.default_rng(5))
    apply_corrections(small_map, np.tile(move, (12, 1)))
    assert small_map.num_points == 60
    assert np.isnan(small_map.point_xyz[7]).all()
    for keyframe, xy in zip(small_map.keyframes, before, strict=True):
        in_camera = rigid3.apply(keyframe.rig_from_world, small_map.point_xyz[keyframe.point_id])
        assert np.allclose(project(small_map.rig.cameras[0], in_camera), xy, atol=1e-8, equal_nan=True)


def test_points_move_with_the_first_keyframe_that_sees_them(small_map: KeyframeMap) -> None:
    before = small_map.point_xyz.copy()
    corrections = np.tile(similarity.IDENTITY, (12, 1))
    corrections[3, 4] = 10.0
    apply_corrections(small_map, corrections)
    moved = np.flatnonzero(small_map.point_xyz[:60, 0] > before[:60, 0] + 5)
    assert list(moved) == [34, 35]
