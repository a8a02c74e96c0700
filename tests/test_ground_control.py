"""Ground control: against plain gtsam, against brute force, and by how often intervals hold the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pyproj
import pytest
from gtsam.symbol_shorthand import C, P, X
from scipy.stats import binom

from control_surveys import SIGMA_MARK_PX, SyntheticSurvey, make_survey
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import free_params
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.errors import InputError
from sfmapp.formats.control_points import ControlPoints
from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.control.adjustment import Adjusting, ControlSolution, adjust_to_control
from sfmapp.georeference.control.landmarks import Positions
from sfmapp.georeference.control.marks import check_marks
from sfmapp.georeference.control.points import align_to_survey, leave_out, survey_in_frame
from sfmapp.scene.reconstruction import Reconstruction

OPTIONS = AdjustOptions(relative_cost_tolerance=1e-10, initial_damping=1e-6, max_iterations=100)
NOISE_PX = 0.5


def on_its_own(survey: SyntheticSurvey) -> Reconstruction:
    """The model that photographs make without control."""
    model = survey.model.copy()
    adjust_bundle(model, OPTIONS)
    return model


def adjusting(model: Reconstruction) -> Adjusting:
    def graph() -> FactorGraph:
        return FactorGraph(model, OPTIONS, noise_px=NOISE_PX)

    return Adjusting(graph, graph, [free_params(camera, *OPTIONS.refine) for camera in model.cameras])


def solve(model: Reconstruction, control: ControlPoints) -> ControlSolution:
    """A model brought to its control points, in place."""
    marked, survey = check_marks(model, control), survey_in_frame(control)
    found = align_to_survey(marked.place, survey.place)
    assert found.world_from_model is not None, found.problem
    model.cam_from_world[:] = similarity.transform_poses(found.world_from_model, model.cam_from_world)
    model.point_xyz[:] = similarity.apply(found.world_from_model, model.point_xyz)
    return adjust_to_control(model, control, marked, survey, found.is_inlier, adjusting(model))


def test_the_adjustment_is_that_of_a_plain_gtsam_graph() -> None:
    """Points as variables beside all others, one factor a mark, a prior for the survey: gtsam's own from end to end."""
    survey = make_survey(0, "orbit")
    model = on_its_own(survey)
    solution = solve(model, survey.control)
    control = survey.control
    graph, values = FactorGraph(model, OPTIONS, noise_px=NOISE_PX).to_gtsam()
    for p in range(control.num_points):
        values.insert(P(p), control.xyz[p])
        graph.add(gtsam.PriorFactorPoint3(P(p), control.xyz[p], gtsam.noiseModel.Diagonal.Sigmas(control.sigma_m[p])))
    noise = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_MARK_PX)
    for o in range(len(control.obs_xy)):
        image, point = int(control.obs_image_idx[o]), int(control.obs_point_idx[o])
        graph.add(gtsam.GeneralSFMFactor2Cal3Bundler(control.obs_xy[o], noise, X(image), P(point), C(0)))
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setRelativeErrorTol(1e-14)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    for i in range(len(model.image_names)):
        wanted = result.atPose3(X(i))
        ours = rigid3.inverse(model.cam_from_world[i])
        np.testing.assert_allclose(ours[4:], wanted.translation(), rtol=0, atol=1e-6 * 35)
        np.testing.assert_allclose(rigid3.rotation_matrix(ours), wanted.rotation().matrix(), rtol=0, atol=1e-6)
    for p in range(control.num_points):
        np.testing.assert_allclose(solution.place[p], result.atPoint3(P(p)), rtol=0, atol=1e-6 * 35)
    # the covariance of a point, its survey included, told from what leaving it out makes of it
    (p, left_out) = next((p, one) for p, one in enumerate(solution.left_out) if one is not None)
    survey_covariance = np.diag(control.sigma_m[p] ** 2)
    covariance = gtsam.Marginals(graph, result).marginalCovariance(P(p))
    wanted = leave_out(result.atPoint3(P(p)), covariance, control.xyz[p], survey_covariance)
    assert wanted is not None
    np.testing.assert_allclose(left_out.covariance, wanted.covariance, rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(left_out.residual, wanted.residual, rtol=0, atol=1e-5)


def test_points_left_out_at_once_are_those_left_out_one_by_one() -> None:
    """The closed form against an adjustment without each point: up to the curvature of the problem."""
    survey = make_survey(3, "orbit")
    model = on_its_own(survey)
    at_once = solve(model, survey.control)
    marked, surveyed = check_marks(model, survey.control), survey_in_frame(survey.control)
    for p in range(survey.control.num_points):
        # as good as no survey at all
        covariance = surveyed.covariance.copy()
        covariance[p] *= 1e8
        again = model.copy()
        found = adjust_to_control(
            again, survey.control, marked, replace(surveyed, covariance=covariance), np.ones(5, bool), adjusting(again)
        )
        left_out = at_once.left_out[p]
        assert left_out is not None
        sigma = np.sqrt(np.diag(left_out.covariance))
        np.testing.assert_array_less(np.abs(left_out.residual - (found.place[p] - surveyed.place[p])), 0.02 * sigma)


def test_intervals_hold_the_truth() -> None:
    """Left-out control lies inside of its 95 % as often as that; benchmarks/control_surveys.py counts more."""
    flat, up, num = 0, 0, 0
    for seed in range(6):
        for layout in ("grid", "orbit"):
            survey = make_survey(100 + seed, layout, num_points=400)
            solution = solve(on_its_own(survey), survey.control)
            found = [one for one in solution.left_out if one is not None]
            num += len(found)
            flat += sum(one.normalized_horizontal <= 2.448 for one in found)
            up += sum(one.normalized_vertical <= 1.960 for one in found)
    assert num == 60
    # two-sided at one in a thousand
    low, high = binom.interval(0.999, num, 0.95)
    assert low <= flat <= high
    assert low <= up <= high


def test_few_points_place_what_positions_hold_in_shape() -> None:
    """RTK of 2 cm whose base is off by metres, and two points: the others agree, cameras lie better than by all six."""
    survey = make_survey(6, "grid", 6)
    model, control, truth = on_its_own(survey), survey.control, survey.truth
    rng = np.random.default_rng(0)
    base, sigma = np.array([1.0, -2.0, 3.0]), np.array([0.02, 0.02, 0.03])
    places = truth.centers + base + sigma * rng.normal(size=truth.centers.shape)
    positions = Positions(np.arange(len(places)), places, sigma, np.full(3, 10.0))
    world_from_model = similarity.umeyama(model.centers, places)
    model.cam_from_world[:] = similarity.transform_poses(world_from_model, model.cam_from_world)
    model.point_xyz[:] = similarity.apply(world_from_model, model.point_xyz)

    def graph() -> FactorGraph:
        made = FactorGraph(model, OPTIONS, noise_px=NOISE_PX)
        positions.add_to(made)
        return made

    marked, surveyed = check_marks(model, control), survey_in_frame(control)
    used = np.arange(6) < 2
    found = adjust_to_control(model, control, marked, surveyed, used, Adjusting(graph, graph, adjusting(model).free))
    # all six agree, and come in
    assert found.is_used.all()
    for one in found.left_out:
        assert one is not None
        assert one.normalized_horizontal < 4
        assert one.normalized_vertical < 4
    np.testing.assert_allclose(model.centers, truth.centers, atol=5 * 0.03)
    alone = on_its_own(survey)
    solve(alone, control)
    error = [np.abs((one.centers - truth.centers)[:, 2]).max() for one in (model, alone)]
    assert error[0] < 0.5 * error[1]


def test_a_slip_of_the_hand_is_named() -> None:
    survey = make_survey(1, "orbit")
    model, control = on_its_own(survey), survey.control
    o = int(control.observations_of(2)[1])
    xy = control.obs_xy.copy()
    xy[o] += [25.0, -12.0]
    marked = check_marks(model, replace(control, obs_xy=xy))
    (slip,) = marked.slips
    assert (slip.point, slip.image) == ("P3", model.image_names[control.obs_image_idx[o]])
    assert slip.line == control.obs_line[o]
    np.testing.assert_allclose(slip.expected_px, control.obs_xy[o], atol=5 * SIGMA_MARK_PX)
    assert slip.distance_px == pytest.approx(np.hypot(25, 12), abs=5 * SIGMA_MARK_PX)
    assert not marked.is_used[o]
    assert marked.is_used.sum() == len(xy) - 1
    assert marked.is_placed.all()


def test_no_mark_of_a_careful_hand_is_a_slip() -> None:
    for seed in range(3):
        survey = make_survey(20 + seed, "grid", 8)
        marked = check_marks(on_its_own(survey), survey.control)
        assert not marked.slips
        assert not marked.unplaced
        assert marked.spread == 1.0


def test_a_point_in_one_photograph_of_the_model_has_no_place() -> None:
    survey = make_survey(1, "orbit")
    model = on_its_own(survey)
    model.cam_from_world[survey.control.obs_image_idx[survey.control.observations_of(0)[1:]]] = np.nan
    assert "two are needed" in check_marks(model, survey.control).unplaced[0]


def test_a_wrong_coordinate_is_named_and_bends_nothing() -> None:
    survey = make_survey(4, "orbit", 6)
    right, wrong = on_its_own(survey), on_its_own(survey)
    xyz = survey.control.xyz.copy()
    xyz[3] += [0.0, 1.0, 0.0]  # a metre: a digit
    expected = solve(right, survey.control)
    found = solve(wrong, replace(survey.control, xyz=xyz))
    assert found.is_used.tolist() == [True, True, True, False, True, True]
    left_out = found.left_out[3]
    assert left_out is not None
    assert left_out.residual[1] == pytest.approx(-1.0, abs=0.15)
    for p in (0, 1, 2, 4, 5):
        one = expected.left_out[p]
        assert one is not None
        assert (np.abs(found.place[p] - expected.place[p]) < np.sqrt(np.diag(one.covariance))).all()


def test_a_survey_that_boasts_is_widened_not_believed() -> None:
    """Sigmas of a millimetre on coordinates that scatter by centimetres."""
    survey = make_survey(5, "orbit", 7)
    control = replace(survey.control, sigma_m=survey.control.sigma_m / 20)
    solution = solve(on_its_own(survey), control)
    assert solution.survey_spread > 5
    assert solution.is_used.sum() >= 5
    found = [one.square for one in solution.left_out if one is not None]
    assert np.median(found) < 12


def test_what_points_cannot_tell() -> None:
    rng = np.random.default_rng(0)
    place = rng.normal(size=(5, 3))
    place[2:] = np.nan
    assert "three that are not on a line" in align_to_survey(place, place).problem
    line = np.outer(np.arange(5.0), [1.0, 2.0, 0.5]) + 1e-3 * rng.normal(size=(5, 3))
    assert "line" in align_to_survey(line, line + 1e-3 * rng.normal(size=(5, 3))).problem
    # two points hold no third one: what they say of it has no end
    sure = np.diag([1e-4, 1e-4, 1e-4])
    assert leave_out(np.zeros(3), sure * (1 - 1e-9), np.zeros(3), sure) is None


def test_a_robust_alignment_lets_go_of_a_third() -> None:
    rng = np.random.default_rng(1)
    model = rng.normal(size=(9, 3))
    truth = similarity.from_parts(rigid3.exp_so3([0.3, -0.4, 1.0]), [500.0, 20.0, 3.0], 30.0)
    world = similarity.apply(truth, model) + 0.02 * rng.normal(size=(9, 3))
    world[[1, 4, 7]] += [[10.0, 0.0, 0.0], [0.0, 0.0, -3.0], [1.0, 1.0, 1.0]]
    found = align_to_survey(model, world)
    assert found.is_inlier.tolist() == [True, False, True, True, False, True, True, False, True]
    np.testing.assert_allclose(
        similarity.apply(found.world_from_model, model), similarity.apply(truth, model), atol=0.1
    )


def of_file(crs: str, xyz: np.ndarray) -> ControlPoints:
    survey = make_survey(0, "orbit").control
    return replace(survey, path=Path("gcp_list.txt"), crs_line=1, crs=crs, xyz=xyz)


def test_coordinates_come_to_the_frame_by_their_system() -> None:
    geodetic = np.array([48.2, 16.4, 170.0]) + np.random.default_rng(2).uniform(-1, 1, (5, 3)) * [1e-3, 1e-3, 5.0]
    frame = LocalFrame(48.2, 16.4, 170.0)
    utm = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
    east, north, _ = utm.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2])
    control = of_file("WGS84 UTM 33N", np.column_stack([east, north, geodetic[:, 2]]))
    control = replace(control, sigma_m=np.tile([0.01, 0.05, 0.02], (5, 1)))
    survey = survey_in_frame(control, frame)
    np.testing.assert_allclose(survey.place, frame.enu_from_geodetic(geodetic), rtol=0, atol=1e-6)
    # grid north is east of true north by the convergence, (longitude - 15) sin(latitude)
    turn = np.radians(1.4 * np.sin(np.radians(48.2)))
    axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    wanted = axes @ np.diag([1e-4, 25e-4, 4e-4]) @ axes.T
    np.testing.assert_allclose(survey.covariance[0], wanted, rtol=0, atol=1e-6)
    degrees = of_file("EPSG:4326", geodetic[:, [1, 0, 2]])
    np.testing.assert_allclose(survey_in_frame(degrees, frame).place, survey.place, rtol=0, atol=1e-6)
    middle = survey_in_frame(degrees)
    assert middle.frame is not None
    assert np.abs(middle.place.mean(0)).max() < 1e-2


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:2229", "in US survey feet"), ("EPSG:99999", "line 1: expected a coordinate system"),
        ("Gauss Krueger", "line 1: expected a coordinate system"), ("WGS84 UTM 61N", "zone from 1 to 60"),
        ("EPSG:4326", "line 3: expected longitude, latitude in degrees"),
    ],
)  # fmt: skip
def test_systems_that_will_not_do(crs: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected) as refused:
        survey_in_frame(of_file(crs, np.full((5, 3), 5e5) + np.arange(15).reshape(5, 3)))
    assert "gcp_list.txt" in str(refused.value)
    assert refused.value.advice
