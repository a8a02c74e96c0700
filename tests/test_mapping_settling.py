"""Closing adjustments come to rest, or say that they have not."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from sfmapp.adjust.covariance import reduced_matrix
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import make_engine
from sfmapp.events import Event, Events
from sfmapp.geometry import rigid3
from sfmapp.mapping import structure
from sfmapp.mapping.keypoint_noise import keypoint_noise
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.settling import Round, adjust_until_settled
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, perturb

SIGMA_PX = 0.3
ROBUST = AdjustOptions(loss="cauchy", loss_scale_px=2 * SIGMA_PX, initial_damping=1e-6, max_iterations=500)


def with_tails(seed: int) -> Reconstruction:
    """Eight photographs near their places, a tenth of whose keypoints are off by pixels."""
    scene = make_scene(seed, 8, 300, sigma_px=SIGMA_PX)
    model = perturb(scene.observed, rotation_deg=0.05, translation_fraction=0.001, focal_fraction=0.003)
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(model.obs_is_inlier)) < 0.1
    model.tracks.obs_xy[wrong] += rng.normal(scale=4.0, size=(int(wrong.sum()), 2)).astype(np.float32)
    return model


def sigmas_between(a: Reconstruction, b: Reconstruction) -> float:
    """The most that any combination of poses and focal length differs by, in standard deviations."""
    engine = make_engine(a.copy(), replace(ROBUST, relative_cost_tolerance=0.0))
    engine.linearize(0.0, map)
    problem = engine.problem
    step = np.zeros(problem.num_blocks * 8)
    relative = rigid3.compose(b.cam_from_world, rigid3.inverse(a.cam_from_world))
    blocks = problem.pose_block[:, None] * 8
    step[blocks + np.arange(3)] = rigid3.log_so3(rigid3.rotation_matrix(relative))
    step[blocks + np.arange(3, 6)] = relative[:, 4:]
    camera = problem.camera_block[0] * 8
    for n, k in enumerate(problem.free.params[0]):
        step[camera + n] = b.cameras[0].params[k] - a.cameras[0].params[k]
    return float(np.sqrt(step @ reduced_matrix(engine) @ step)) / SIGMA_PX


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_has_settled_is_near_the_minimum_long_before_single_points_are(seed: int) -> None:
    start = with_tails(seed)
    settled, minimum = start.copy(), start.copy()
    quick = FactorGraph(settled, replace(ROBUST, settled_sigmas=0.05, relative_cost_tolerance=0.0), noise_px=1.0)
    whole = FactorGraph(minimum, replace(ROBUST, relative_cost_tolerance=1e-10), noise_px=1.0)
    short, long = quick.optimize(), whole.optimize()
    assert short.termination == long.termination == "converged"
    assert short.num_iterations < 0.6 * long.num_iterations
    assert sigmas_between(settled, minimum) < 0.5 < sigmas_between(start, minimum)


@pytest.mark.parametrize("views", [4, 14])
def test_noise_is_that_of_the_keypoints_however_short_the_tracks_are(views: int) -> None:
    """The median of the residuals is low by what the fit has taken of them, which of short tracks is half."""
    found = []
    for seed in range(4):
        model = make_scene(40 + seed, views, 300, sigma_px=SIGMA_PX).observed
        FactorGraph(model, ROBUST, noise_px=1.0).optimize()
        robust = keypoint_noise(model, ROBUST, Varying(), 0.01)
        median_px = structure.residual_scale_px(model)
        FactorGraph(model, replace(ROBUST, loss="trivial"), noise_px=1.0).optimize()
        squares = keypoint_noise(model, replace(ROBUST, loss="trivial"), Varying(), 0.01)
        found.append([*robust, *squares, median_px])
    sigma, weight, of_squares, same, of_median = np.mean(found, 0) / SIGMA_PX
    assert of_squares == same == pytest.approx(1.0, rel=0.04)
    assert 0.9 < sigma < 1.1  # 1.045 where tracks are long: Cauchy's loss at two deviations wastes 9 % of the variance
    assert 0.72 < weight < 0.9  # 0.78 there
    assert of_median < 0.75


def rounds_of(*changed: int, termination: str = "converged"):
    """Rounds in which so many of a thousand observations change sides, the last over and over; and their steps."""
    steps: list[int] = []

    def adjust(num_steps: int) -> Round:
        after = np.ones(1000, bool)
        after[: changed[min(len(steps), len(changed) - 1)]] = False
        steps.append(num_steps)
        return Round(AdjustReport(termination=termination), np.ones(1000, bool), after)

    return adjust, steps


def test_rounds_end_when_the_observations_rest_and_say_so_when_they_never_do() -> None:
    heard: list[Event] = []
    events = Events()
    events.subscribe(heard.append)
    adjust, steps = rounds_of(50, 7, 0)
    assert adjust_until_settled(adjust, "mapping", events).termination == "converged"
    assert len(steps) == 3
    assert not heard
    adjust, steps = rounds_of(50)
    assert adjust_until_settled(adjust, "mapping", events).termination == "unsettled"
    adjust, steps = rounds_of(0, termination="iterations")
    assert adjust_until_settled(adjust, "mapping", events).termination == "unsettled"
    assert steps[1] > steps[0]  # at rest, the next goes to the end
    assert [event.kind for event in heard] == ["warned"] * 2
    assert "did not settle" in heard[0].message


def mapper_of(model: Reconstruction, pool: ThreadPoolExecutor, events: Events) -> Mapper:
    """That closes a model, lens and all."""
    return Mapper(
        reconstruction=model, correspondences=[], options=MappingOptions(refine_principal_point="never"),
        adjust_options=AdjustOptions(), events=events, pool=pool, prior_cameras=list(model.cameras),
        locked=np.zeros(len(model.image_names), bool),
    )  # fmt: skip


@pytest.mark.parametrize("seed", [1, 2])
def test_points_whose_two_rays_miss_each_other_stay_lost(seed: int) -> None:
    """Half of the points are seen by two photographs. Where both rays miss by more than the loss bends at, their middle
    is no minimum: a point that is left there would slide away in the next adjustment."""
    scene = make_scene(seed, 8, 1500, sigma_px=SIGMA_PX)
    model, rng = scene.observed.copy(), np.random.default_rng(seed)
    tracks = model.tracks
    rank = np.arange(tracks.num_observations) - tracks.track_ptr[tracks.obs_track_idx]
    is_short = tracks.obs_track_idx % 2 == 0
    tracks.obs_xy[is_short & (rank >= 2)] = np.nan
    wrong = is_short & (rng.random(len(rank)) < 0.1)
    tracks.obs_xy[wrong] += rng.normal(scale=1.5, size=(int(wrong.sum()), 2)).astype(np.float32)
    with ThreadPoolExecutor(1) as pool:
        mapper = mapper_of(model, pool, Events())
        mapper.finish()
        mapper.polish()
        assert mapper.loss_scale_px is not None
        length = np.linalg.norm(model.residuals_px(), axis=1)
        least = np.full(tracks.num_tracks, np.inf)
        np.minimum.at(least, tracks.obs_track_idx[model.obs_is_inlier], length[model.obs_is_inlier])
    # but for such as were triangulated for the first time in the end; 31 and 45 where all are triangulated again
    assert np.sum(np.isfinite(least) & (least > 2 * mapper.loss_scale_px)) <= 5
    assert model.is_triangulated.mean() > 0.94


def test_one_more_adjustment_of_a_finished_map_changes_nothing() -> None:
    model = with_tails(4)
    with ThreadPoolExecutor(1) as pool:
        mapper = mapper_of(model, pool, Events())
        assert mapper.polish().termination == "converged"
        before = model.copy()
        assert mapper.loss_scale_px is not None
        robust = AdjustOptions(initial_damping=1e-6).robust(mapper.loss_scale_px)
        FactorGraph(model, robust, varying=Varying(), noise_px=1.0).optimize()
    assert sigmas_between(before, model) < 0.5
