"""Large adjustments: batches, products by rows, envelope, fronts, threads, progress. Small scenes stand for large."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sfmapp.adjust import front_system as front_system_module
from sfmapp.adjust import linear, progress, solver
from sfmapp.adjust.covariance import reduced_matrix
from sfmapp.adjust.elimination import GROUP
from sfmapp.adjust.envelope import EnvelopeOrder, EnvelopeSystem
from sfmapp.adjust.front_system import FrontSystem, best_order
from sfmapp.adjust.fronts import FrontOrder
from sfmapp.adjust.linear import choose_solver, may_suit_fronts, prefers_rounds
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle, make_engine
from sfmapp.camera.camera import project
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera, synthetic_rig

OPTIONS = AdjustOptions(loss="cauchy", loss_scale_px=1.0)


def start_of(scene):
    noise = {"translation_fraction": 0.01, "point_fraction": 0.01, "focal_fraction": 0.01}
    return perturb(scene.observed, rotation_deg=0.1, **noise)


def normal_equations(model, damping):
    """The reduced system and its gradient over poses and one camera, from numerical derivatives of all residuals."""
    engine = make_engine(model, OPTIONS)
    p = engine.problem
    num, state = len(p.image_idx), (p.poses.copy(), p.canonical.copy(), p.xyz.copy())
    num_points, dims = len(p.track_idx), p.block_dim
    unknowns = int(dims.sum()) + 3 * num_points
    first = np.cumsum(dims) - dims
    cut = unknowns - 3 * num_points
    point = np.repeat(np.arange(num_points), np.diff(p.point_ptr))

    def residuals(step):
        out = np.empty((p.num_observations, 2))
        for o in range(p.num_observations):
            i = p.obs_image[o]
            w = step[first[i] : first[i] + 6]
            x = rigid3.apply(state[0][i], state[2][point[o]] + step[cut:].reshape(-1, 3)[point[o]])
            x = rigid3.exp_so3(w[:3]) @ x + w[3:]
            params = model.cameras[0].params.copy()
            params[[0, 3]] += step[first[num] : first[num] + 2]
            out[o] = project(model.cameras[0].with_params(params), x[None])[0]
        return (out - p.obs_xy).ravel()

    base, h = residuals(np.zeros(unknowns)), 1e-6
    J = np.stack([(residuals(h * e) - residuals(-h * e)) / (2 * h) for e in np.eye(unknowns)], 1)
    weight = np.repeat(1.0 / (1.0 + (base.reshape(-1, 2) ** 2).sum(1)), 2)
    H, g = J.T @ (weight[:, None] * J), J.T @ (weight * base)
    H += damping * np.diag(np.diag(H))
    through = H[:cut, cut:] @ np.linalg.inv(H[cut:, cut:])
    return H[:cut, :cut] - through @ H[cut:, :cut], g[:cut] - through @ g[cut:]


@pytest.mark.parametrize("batch", [10**6, 40])
def test_a_step_is_that_of_the_normal_equations_however_points_are_batched(monkeypatch, batch):
    """Against dense algebra on numerical derivatives."""
    monkeypatch.setattr(solver, "_BATCH_ENTRIES", batch)
    model = start_of(make_scene(2, 5, 24))
    system, gradient = normal_equations(model, 1e-3)
    for name in ("tiles", "envelope", "fronts"):
        chosen = "envelope" if name == "fronts" else name
        monkeypatch.setattr(solver, "choose_solver", lambda *_, chosen=chosen, **__: chosen)
        monkeypatch.setattr(solver, "_MAX_DENSE_BLOCKS", 0)
        if name == "fronts":
            monkeypatch.setattr(front_system_module, "may_suit_fronts", lambda *_: True)
            monkeypatch.setattr(front_system_module, "prefers_fronts", lambda *_: True)
        engine = make_engine(model, OPTIONS)
        assert engine.solver == name
        assert (len(engine.limits) > 2) == (batch == 40)
        engine.linearize(1e-3, map)
        step = engine.solve().reshape(-1, 8)[np.arange(8) < engine.problem.block_dim[:, None]]
        expected = -np.linalg.solve(system, gradient)
        np.testing.assert_allclose(step, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def random_system(rng, num, met):
    """Tiles of a positive definite system of blocks of two to eight rows, its matrix, and where tiles are."""
    dims = rng.integers(2, 9, num)
    first = np.cumsum(dims) - dims
    met = np.triu(met | met.T | np.eye(num, dtype=bool))
    size = int(dims.sum())
    matrix = np.zeros((size, size))
    for a, b in zip(*np.nonzero(met), strict=True):
        matrix[first[a] : first[a] + dims[a], first[b] : first[b] + dims[b]] = rng.normal(size=(dims[a], dims[b]))
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    matrix += np.diag(np.abs(matrix).sum(1) + 0.1)
    keys = np.flatnonzero(met)
    tiles = np.zeros((len(keys), 8, 8))
    for n, (a, b) in enumerate(zip(*np.divmod(keys, num), strict=True)):
        part = matrix[first[a] : first[a] + dims[a], first[b] : first[b] + dims[b]]
        tiles[n, : dims[a], : dims[b]] = np.triu(part) if a == b else part
    return dims, keys, tiles.ravel(), matrix


def envelope_system(dims, keys):
    return EnvelopeSystem(dims, keys, np.arange(len(keys)))


def front_system(dims, keys):
    return FrontSystem(dims, keys, np.arange(len(keys)), FrontOrder(len(dims), *np.divmod(keys, len(dims))))


@pytest.mark.parametrize("system_of", [envelope_system, front_system])
@pytest.mark.parametrize("kind", ["loop", "scattered", "full", "apart", "one", "plane"])
def test_factors_of_large_systems_solve_those_of_any_pattern(monkeypatch, kind, system_of):
    monkeypatch.setattr(front_system_module, "_ROWS", 16)  # several tasks of a front
    rng = np.random.default_rng(0)
    num = 1 if kind == "one" else 90
    apart, places = np.abs(np.arange(num)[:, None] - np.arange(num)), rng.random((num, 2))
    met = {
        "loop": np.minimum(apart, num - apart) < 5, "scattered": rng.random((num, num)) < 0.03,
        "full": apart >= 0, "apart": apart < 0, "one": apart >= 0,
        "plane": np.linalg.norm(places[:, None] - places, axis=2) < 0.16,
    }[kind]  # fmt: skip
    met[:, -1] |= kind == "loop"  # a camera that all share
    dims, keys, tiles, matrix = random_system(rng, num, met)
    system = system_of(dims, keys)
    used = np.arange(8) < dims[:, None]
    right = rng.normal(size=(num, 8))
    found = system.solve(tiles, right.ravel()).reshape(-1, 8)
    np.testing.assert_allclose(found[used], np.linalg.solve(matrix, right[used]), rtol=1e-9, atol=1e-12)
    assert not found[~used].any()
    with ThreadPoolExecutor(3) as pool:
        assert (system.solve(tiles, right.ravel(), pool.map).reshape(-1, 8) == found).all()
    if system_of is front_system:
        both = system.substitute(np.stack([right.ravel(), -2.0 * right.ravel()], 1))
        np.testing.assert_allclose(both.T, np.outer([1.0, -2.0], found), rtol=1e-9, atol=1e-12)
        assert_tiles_of_the_inverse(system, dims, keys, np.linalg.inv(matrix))
    if kind == "loop" and system_of is envelope_system:  # both ways round at once, beside the last rows
        full = EnvelopeSystem(dims, np.flatnonzero(np.triu(np.ones((num, num)))), np.arange(num * (num + 1) // 2))
        assert system.order.flops < 0.6 * full.order.flops
    # an indefinite system is told
    place = int(np.flatnonzero(keys == (num - 1) * (num + 1))[0]) * 64
    tiles[place] = -1.0
    assert system.solve(tiles, right.ravel()) is None


def assert_tiles_of_the_inverse(system, dims, keys, inverse):
    """Those of all pairs that meet, either way round."""
    first, used = np.cumsum(dims) - dims, np.arange(8) < dims[:, None]
    a, b = np.divmod(keys, len(dims))
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    found = system.inverse_tiles(a, b)
    for n in range(len(a)):
        rows, columns = (slice(first[k], first[k] + dims[k]) for k in (a[n], b[n]))
        np.testing.assert_allclose(found[n, : dims[a[n]], : dims[b[n]]], inverse[rows, columns], rtol=1e-8, atol=1e-12)
    assert not found[~(used[a][:, :, None] & used[b][:, None])].any()


def test_fronts_factor_what_lies_in_a_plane_and_envelopes_a_room(monkeypatch):
    assert may_suit_fronts(0.03, 1e11)
    assert not may_suit_fronts(0.03, 1e9)  # their order would take longer than what it saves
    assert not may_suit_fronts(0.6, 1e12)
    monkeypatch.setattr(linear, "_DEAR_FLOPS", 0.0)
    rng = np.random.default_rng(1)
    num = 900
    places = rng.random((num, 2))
    kinds = {"plane": np.linalg.norm(places[:, None] - places, axis=2) < 0.1, "room": rng.random((num, num)) < 0.6}
    for kind, met in kinds.items():
        dims = np.full(num, 6)
        a, b = np.nonzero(np.triu(met | met.T))
        order, flops = best_order(dims, a, b, 2 * len(a) / num**2)
        assert isinstance(order, FrontOrder) == (kind == "plane")
        assert flops <= EnvelopeOrder(dims, a, b).flops / (1.5 if kind == "plane" else 1.0)


def test_threads_and_batches_change_nothing(monkeypatch):
    """The same bytes of one and three threads, chunks of points and parts of rows at work, in groups and beyond one."""
    monkeypatch.setattr(solver, "_BATCH_ENTRIES", 3000)
    monkeypatch.setattr(solver, "_CHUNK_OBSERVATIONS", 500)
    monkeypatch.setattr(solver, "_PART_PRODUCTS", 2000)
    monkeypatch.setattr(solver, "choose_solver", lambda *_, **__: "envelope")
    monkeypatch.setattr(solver, "_MAX_DENSE_BLOCKS", 0)
    scene = make_scene(5, 2 * GROUP + 3, 600)
    states = []
    for threads in (1, 3):
        model = start_of(scene)
        report = adjust_bundle(model, OPTIONS, threads=threads)
        assert report.solver == "envelope"
        states.append(model)
    engine = make_engine(start_of(scene), OPTIONS)
    assert len(engine.limits) > 1
    assert engine.num_chunks > 2
    assert len(engine.parts) > 2
    assert (states[0].cam_from_world == states[1].cam_from_world).all()
    assert (states[0].point_xyz == states[1].point_xyz).all()
    assert (states[0].cameras[0].params == states[1].cameras[0].params).all()
    monkeypatch.undo()
    small = start_of(scene)
    adjust_bundle(small, OPTIONS)
    assert_same_shape(states[0], small)


def assert_same_shape(model, expected):
    """The same but for a similarity of the whole, which no observation tells."""
    found = similarity.align_poses(model.cam_from_world, expected.cam_from_world).b_from_a
    moved = similarity.transform_poses(found, model.cam_from_world)
    np.testing.assert_allclose(moved, expected.cam_from_world, atol=1e-7)
    assert model.cameras[0].params == pytest.approx(expected.cameras[0].params, rel=1e-6)


def test_large_systems_are_left_to_the_envelope():
    for is_closing in (True, False):
        assert choose_solver(161, 966, 0.01, is_closing=is_closing) == "envelope"
        assert choose_solver(161, 966, 1.0, is_closing=is_closing) == "envelope"
    assert choose_solver(160, 960, 0.1, is_closing=True) == "gtsam"
    assert choose_solver(160, 960, 1.0, is_closing=False) == "tiles"


def test_long_adjustments_tell_of_every_step_and_short_ones_of_none(monkeypatch):
    scene, told = make_scene(1, 4, 60), []
    adjust_bundle(start_of(scene), OPTIONS, events=Events(told.append))
    assert not told
    monkeypatch.setattr(progress, "_LARGE_OBSERVATIONS", 100)
    report = adjust_bundle(start_of(scene), OPTIONS, events=Events(told.append))
    assert [event.kind for event in told[:2]] == ["started", "advanced"]
    assert told[-1].kind == "finished"
    # the last step, which converges, may be told by the end alone
    assert report.num_iterations - 1 <= sum(event.kind == "advanced" for event in told) <= report.num_iterations
    costs = [float(event.message.split("cost ")[1]) for event in told]
    assert costs == sorted(costs, reverse=True)
    assert costs[0] == pytest.approx(report.initial_cost, rel=1e-5)
    assert f"of at most {OPTIONS.max_iterations}" in told[1].message
    events = Events(lambda event: events.cancel() if event.kind == "advanced" else None)
    with pytest.raises(InterruptedRunError):
        adjust_bundle(start_of(scene), OPTIONS, events=events)


def iterative_engine(monkeypatch, model, options=OPTIONS, **given):
    monkeypatch.setattr(solver, "choose_solver", lambda *_, **__: "envelope")
    monkeypatch.setattr(solver, "prefers_rounds", lambda *_: True)
    monkeypatch.setattr(solver, "_MAX_DENSE_BLOCKS", 0)
    return make_engine(model, options, may_iterate=True, **given)


@pytest.mark.parametrize("kind", ["shared", "wide", "own", "rig", "held"])
def test_a_product_with_the_system_that_is_never_made_is_that_with_its_tiles(monkeypatch, kind):
    """Against the dense reduced system, with shared, long and single intrinsics, mounted cameras and constant poses."""
    cameras = {"wide": synthetic_camera(CameraModel.FULL_OPENCV), "own": [synthetic_camera()] * 40}.get(kind)
    scene = make_scene(4, 40, 300, cameras, rig=synthetic_rig() if kind == "rig" else None)
    varying = Varying(images=np.arange(40) > 3) if kind == "held" else Varying()
    options = AdjustOptions(refine_principal_point=kind == "wide")
    direct = make_engine(scene.observed, options, varying)
    direct.linearize(0.01, map)
    engine = iterative_engine(monkeypatch, scene.observed, options, varying=varying)
    assert engine.solver == "iterative"
    engine.linearize(0.01, map)
    np.testing.assert_allclose(engine.gradient[0], direct.gradient[0], rtol=1e-12, atol=1e-12)
    used = (np.arange(8) < engine.problem.block_dim[:, None]).ravel()
    x = np.where(used, np.random.default_rng(0).normal(size=len(used)) / np.sqrt(engine.diagonal), 0.0)
    expected = (reduced_matrix(direct) @ x + 0.01 * direct.diagonal * x)[used]
    np.testing.assert_allclose(engine._product(x, map)[used], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_rounds_come_to_the_minimum_that_exact_steps_come_to(monkeypatch):
    scene = make_scene(3, 40, 500)
    exact, found = start_of(scene), []
    tight = AdjustOptions(loss="cauchy", loss_scale_px=1.0, relative_cost_tolerance=1e-10)
    expected = adjust_bundle(exact, tight)
    monkeypatch.setattr(solver, "_CHUNK_OBSERVATIONS", 1000)
    for threads in (1, 3):
        model = start_of(scene)
        engine = iterative_engine(monkeypatch, model, tight)
        assert engine.num_chunks > 2
        report = solver.run_engine(engine, model, tight, threads=threads, events=None)
        found.append(model)
    assert report.solver == "iterative"
    assert report.final_cost == pytest.approx(expected.final_cost, rel=1e-8)
    assert report.num_iterations <= expected.num_iterations + 5
    assert (found[0].cam_from_world == found[1].cam_from_world).all()
    assert found[0].cameras[0].focal == pytest.approx(exact.cameras[0].focal, rel=1e-6)


@pytest.mark.parametrize("held", ["nothing", "two images"])
def test_a_factor_that_is_held_leads_to_the_minimum_of_exact_steps_in_the_same_gauge(monkeypatch, held):
    """From a start where the first factor is far off the last, with the whole free and with two images that hold it."""
    monkeypatch.setattr(solver, "choose_solver", lambda *_, **__: "envelope")
    monkeypatch.setattr(solver, "_MAX_DENSE_BLOCKS", 0)
    scene = make_scene(3, 40, 500)
    varying = Varying(images=np.arange(40) > 1) if held == "two images" else Varying()
    tight = AdjustOptions(loss="cauchy", loss_scale_px=1.0, relative_cost_tolerance=1e-10)
    models, made, factored = [start_of(scene) for _ in range(2)], [], []
    factor = EnvelopeSystem.factor
    monkeypatch.setattr(EnvelopeSystem, "factor", lambda self, *a: factored.append(1) or factor(self, *a))
    for model, may_iterate in zip(models, (False, True), strict=True):
        factored.clear()
        engine = make_engine(model, tight, varying, may_iterate=may_iterate)
        report = solver.run_engine(engine, model, tight, threads=1, events=None)
        made.append((report.num_iterations, len(factored), report.final_cost))
    (exact_steps, exact_factors, exact_cost), (steps, factors, cost) = made
    assert cost == pytest.approx(exact_cost, rel=1e-9)
    assert exact_factors == exact_steps
    assert factors <= steps / 2
    assert steps <= exact_steps + 3
    assert_same_shape(models[1], models[0])
    sizes = [np.linalg.norm(rigid3.center(m.cam_from_world[5]) - rigid3.center(m.cam_from_world[4])) for m in models]
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-6 if held == "two images" else 2e-3)


def test_rounds_are_for_what_is_large_and_full():
    # entries, products and the factor of 300, 1,000 and 3,000 photographs of a room, and of 3,000 along a street
    assert not prefers_rounds(600_000, 20_000_000, 2e9)
    assert prefers_rounds(2_100_000, 133_000_000, 7.5e10)
    assert prefers_rounds(6_300_000, 400_000_000, 2e12)
    assert not prefers_rounds(2_000_000, 13_000_000, 2e9)
