"""A lens fitted to a reconstruction of frames: right within its sigmas, and not surer than the motion allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from odometry_fakes import FakeRunner, FakeSequence
from sfmapp.events import Events
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.result import OdometryResult
from sfmapp.pipelines.lens_fit import fit_lens
from sfmapp.pipelines.odometry.self_calibrate import MAX_FOCAL_SIGMA, SETTLED_SIGMA, focal_of_pairs, widen
from sfmapp.report.model import CalibrationReport, LensEvidence
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import Layout, make_scene, perturb, synthetic_camera

FOCAL = 900.0


def bent(seed: int, layout: Layout, distortion: float = 0.0, wrong: float = 1.15) -> Reconstruction:
    """A scene of 14 images with a tenth of outliers, told of a focal length that is off, and a little disturbed."""
    camera = synthetic_camera()
    params = np.array([FOCAL, 0.5 * camera.width, 0.5 * camera.height, distortion])
    scene = make_scene(seed, 14, 400, replace(camera, params=params), sigma_px=0.3, outlier_ratio=0.1, layout=layout)
    model = perturb(scene.observed, rotation_deg=0.2, translation_fraction=0.01, point_fraction=0.01, seed=seed)
    model.cameras = [replace(model.cameras[0], params=params * [wrong, 1, 1, 0], focal_sigma=None)]
    return model


@pytest.mark.parametrize(("layout", "distortion"), [("ring", 0.0), ("ring", -0.1), ("grid", 0.0), ("forward", 0.0)])
def test_a_lens_is_found_within_its_sigmas_and_not_called_settled_where_it_is_not(
    layout: Layout, distortion: float
) -> None:
    """Whatever the motion tells: a begin 15 % off is left behind, or the standard deviation says so."""
    for seed in range(2):
        found = fit_lens(bent(seed, layout, distortion))
        error, sigma = abs(found.camera.focal / FOCAL - 1), found.focal_sigma_relative
        assert error < 3 * sigma
        assert error < 0.02 or sigma > SETTLED_SIGMA
        assert error < 0.05
        if distortion == 0:  # zero, unless the images clearly show some
            assert found.camera.params[3] == 0.0


@pytest.mark.parametrize("layout", ["ring", "grid", "forward"])
def test_pairs_of_images_tell_the_focal_length_without_the_model(layout: Layout) -> None:
    model = bent(1, layout)
    found = focal_of_pairs(model, fit_lens(model).camera)
    assert found is not None
    assert abs(found.focal - FOCAL) < 3.0 * found.sigma
    # a ring is a turntable, which tells next to nothing, and says so
    assert (found.sigma < 0.01 * FOCAL) == (layout != "ring")


def found_camera(is_settled: bool, focal_sigma_relative: float) -> CalibrationReport:
    fit = LensEvidence(
        distortion={}, is_at_rest=True, spread=1.0, has_distortion=False, parts=[1.0], independent_sigma=0.1
    )
    return CalibrationReport(
        model="PINHOLE", params={}, sigma={}, focal_sigma_relative=focal_sigma_relative, is_settled=is_settled, fit=fit,
        frames=[], num_registered=8, num_points=100, mean_reprojection_error_px=0.3, text="",
    )  # fmt: skip


@pytest.mark.parametrize("is_settled", [True, False])
def test_what_a_lens_leaves_open_is_in_the_sigmas_of_every_map_and_red_if_not_settled(is_settled: bool) -> None:
    def result() -> OdometryResult:
        return FakeRunner()(FakeSequence(), OdometryOptions(), seed=0, threads=1, events=Events(), markers=None)

    plain, wide = result(), result()
    share = 0.1 * SETTLED_SIGMA if is_settled else 0.5 * (SETTLED_SIGMA + MAX_FOCAL_SIGMA)
    widen(wide, found_camera(is_settled, share))
    before, entry = plain.maps[0], wide.maps[0]
    assert [found.subject for found in entry.contradictions] == ([] if is_settled else ["self-calibration"])
    for narrow, wider in ((before.covariance, entry.covariance), (plain.covariance, wide.covariance)):
        assert narrow is not None
        assert wider is not None
        known = np.flatnonzero(np.isfinite(narrow).all((1, 2)))
        assert len(known) > 0
        turned = np.degrees(np.sqrt(wider[known, 0, 0] - narrow[known, 0, 0]))
        assert turned == pytest.approx(90 * share)
        assert (wider[known, 3, 3] > narrow[known, 3, 3]).all()
