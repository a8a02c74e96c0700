"""Compile the kernels of this package ahead of their use."""

from __future__ import annotations

import numpy as np

from sfmapp.adjust.covariance import estimate_covariances
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.pose import refine_pose
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle


def compile_kernels() -> None:
    """Compile, or load from the cache, the kernels of this package that any reconstruction needs, by running each on
    next to nothing."""
    from sfmapp.scene.synthetic import make_scene

    scene = make_scene(0, 3, 8)
    model = scene.observed.copy()
    adjust_bundle(model, AdjustOptions(max_iterations=2), varying=Varying(images=np.array([True, True, False])))
    fixed = AdjustOptions(refine_focal=False, refine_distortion=False)
    estimate_covariances(model, fixed)
    camera, tracks = model.cameras[0], model.tracks
    refine_pose(camera.canonical, model.cam_from_world[0], model.point_xyz, tracks.obs_xy[:8])
