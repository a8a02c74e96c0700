"""The bowl of a flat block photographed straight down: heights with a wrong lens to begin with, against what an
adjustment reaches that begins at the truth and knows every sigma.

Photographs alone tell a lens from a bend of the whole so poorly that the block becomes a bowl of metres (James and
Robson, "Mitigating systematic error in topographic models derived from UAV and ground-based image networks", 2014);
positions of 2 cm, or five control points, leave none of it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying, free_params
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.events import Events
from sfmapp.geometry import similarity
from sfmapp.georeference.control.adjustment import Adjusting, adjust_to_control
from sfmapp.georeference.control.marks import check_marks
from sfmapp.georeference.control.points import survey_in_frame
from sfmapp.georeference.factors import position_graph
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.stage import georeference_models
from sfmapp.scene.reconstruction import Reconstruction

surveys = pytest.importorskip("surveys", reason="benchmarks/ is not part of an installed package")
control_surveys = pytest.importorskip("control_surveys", reason="benchmarks/ is not part of an installed package")

SEEDS = range(4)
OPTIONS = AdjustOptions(relative_cost_tolerance=1e-9, max_iterations=100)
NOISE_PX = 0.5


def bowl(model: Reconstruction, truth: Reconstruction) -> float:
    """Root mean square (metres) of the smooth part of errors of heights: a surface of second degree through them, which
    takes a hundredth of what points err each for themselves."""
    both = model.is_triangulated & truth.is_triangulated
    x, y, _ = ((truth.point_xyz[both] - truth.point_xyz[both].mean(0)) / np.ptp(truth.point_xyz[both], axis=0)).T
    surface = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    errors = (model.point_xyz - truth.point_xyz)[both, 2]
    return float(np.sqrt(((surface @ np.linalg.lstsq(surface, errors, rcond=None)[0]) ** 2).mean()))


def at_the_truth(observed: Reconstruction, truth: Reconstruction) -> Reconstruction:
    model = observed.copy()
    model.cameras[:] = truth.cameras
    model.cam_from_world[:], model.point_xyz[:] = truth.cam_from_world, truth.point_xyz
    return model


def test_photographs_alone_make_a_bowl() -> None:
    survey = surveys.make_survey("grid", 0)
    ideal, model = at_the_truth(survey.observed, survey.truth), survey.observed.copy()
    adjust_bundle(ideal, OPTIONS, varying=Varying(cameras=np.zeros(1, bool)))
    adjust_bundle(model, OPTIONS)
    errors = []
    for found in (ideal, model):
        world_from_model = similarity.umeyama(found.centers, survey.truth.centers)
        found.point_xyz[:] = similarity.apply(world_from_model, found.point_xyz)
        errors.append(bowl(found, survey.truth))
    assert errors[1] > 3.0 * errors[0]


def test_positions_of_two_centimetres_leave_no_bowl() -> None:
    ratios = []
    for seed in SEEDS:
        survey = surveys.make_survey("grid", seed)
        own = [seed, surveys.KINDS.index("grid"), list(surveys.RECEIVERS).index("rtk"), 0]
        image_set, _, measured = surveys.positions(survey, "rtk", own)
        ideal = at_the_truth(survey.observed, survey.truth)
        graph = FactorGraph(ideal, OPTIONS, noise_px=NOISE_PX)
        sigma = np.tile([0.02, 0.02, 0.03], (len(measured), 1))
        graph.add(position_graph(np.arange(len(measured)), measured, sigma, None))
        graph.optimize()
        with ThreadPoolExecutor(1) as pool:
            mapper = surveys.mapper_of(survey, pool)
            mapper.polish()
            placed = georeference_models([mapper], image_set, GpsOptions(), Events())
        assert placed.georeference is not None
        model = mapper.reconstruction
        in_frame = placed.georeference.frame.geodetic_from_enu(model.point_xyz)
        model.point_xyz[:] = surveys.FRAME.enu_from_geodetic(in_frame)
        ratios.append(bowl(model, survey.truth) / bowl(ideal, survey.truth))
    assert 0.9 < np.exp(np.mean(np.log(ratios))) < 1.1
    assert max(ratios) < 1.1


def test_five_control_points_leave_no_bowl() -> None:
    ratios = []
    for seed in SEEDS:
        survey = control_surveys.make_survey(seed, "grid")
        ideal = at_the_truth(survey.model, survey.truth)

        def graph(model: Reconstruction = ideal) -> FactorGraph:
            return FactorGraph(model, OPTIONS, noise_px=NOISE_PX)

        marked, surveyed = check_marks(ideal, survey.control), survey_in_frame(survey.control)
        free = [free_params(camera, *OPTIONS.refine) for camera in ideal.cameras]
        used = np.ones(survey.control.num_points, bool)
        adjust_to_control(ideal, survey.control, marked, surveyed, used, Adjusting(graph, graph, free))
        model, _ = control_surveys.solve(survey)
        ratios.append(bowl(model, survey.truth) / bowl(ideal, survey.truth))
    assert 0.9 < np.exp(np.mean(np.log(ratios))) < 1.1
    assert max(ratios) < 1.1
