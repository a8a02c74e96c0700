"""What a calibration's covariance makes of depths, and what is left unknown of a rig that may have turned."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.reading import read_calibration
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.calibration_error import geometry_covariance, without_turn
from sfmapp.stereo.depth import depth_of_disparity
from sfmapp.stereo.rectification import Rectification, plan_rectification
from sfmapp.stereo.uncertainty import depth_sigma

Array = NDArray[np.float64]

LEFT = Camera(CameraModel.OPENCV, 752, 480, np.array([520.0, 522.0, 381.0, 236.0, -0.24, 0.06, 4e-4, -3e-4]))
RIGHT = Camera(CameraModel.PINHOLE, 752, 480, np.array([640.0, 638.0, 366.0, 247.0]))
TURN = rigid3.exp_so3(np.radians([1.0, -8.0, 1.5]))
CONVERGING = Rig((LEFT, RIGHT), np.array([rigid3.IDENTITY, rigid3.from_matrix(TURN, -TURN @ [0.25, 0.01, 0.02])]))


def a_covariance(rng: np.random.Generator) -> Array:
    """Of the unknowns of the rig, correlated as those of a calibration are."""
    sigma = [0.4, 0.4, 0.5, 0.5, 1e-3, 1e-3, 1e-4, 1e-4, 0.5, 0.5, 0.6, 0.6, 3e-4, 4e-4, 1e-4, 2e-4, 2e-4, 4e-4]
    mixed = rng.normal(size=(18, 30))
    mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
    return np.asarray((mixed @ mixed.T) * np.outer(sigma, sigma))


def rig_at(rig: Rig, step: Array) -> Rig:
    """Another rig, by a step of all unknowns of two cameras with 8 and 4 parameters."""
    cameras = rig.cameras[0].with_params(rig.cameras[0].params + step[:8]), rig.cameras[1].with_params(
        rig.cameras[1].params + step[8:12]
    )  # fmt: skip
    motion = rigid3.from_matrix(rigid3.exp_so3(step[12:15]), step[15:])
    return Rig(cameras, np.array([rigid3.IDENTITY, rigid3.compose(motion, rig.cam_from_rig[1])]))


def pulls(plan: Rectification, rigs: list[Rig], covariance: Array, rng: np.random.Generator) -> Array:
    """(R, N) errors in sigmas of the depths that the plan makes of exact pixels of other rigs, the nearest first."""
    g = dataclasses.replace(plan.geometry, covariance=covariance)
    z = np.sort(rng.uniform(1.5, 12.0, 400))
    flat = np.stack([(rng.uniform(0, g.width, 400) - g.cx) / g.focal, (rng.uniform(0, g.height, 400) - g.cy) / g.focal])
    points = np.column_stack([*(flat * z), z]) @ plan.left_from_camera
    seen = [project(c, rigid3.apply(p, points)) for c, p in zip(plan.rig.cameras, plan.rig.cam_from_rig, strict=True)]
    kept = np.all([((xy > 0.0) & (xy < [752.0, 480.0])).all(1) for xy in seen], axis=0)
    out = []
    for rig in rigs:
        xy = [
            plan.points(side, project(rig.cameras[side], rigid3.apply(rig.cam_from_rig[side], points)))[:, 0]
            for side in (0, 1)
        ]
        d = xy[0] - xy[1]
        out.append(((depth_of_disparity(d, g) - z) / depth_sigma(g, d, np.zeros(len(d))))[kept])
    return np.array(out)


def test_depths_of_drawn_rigs_are_as_far_off_as_their_sigma_says() -> None:
    rng = np.random.default_rng(1)
    joint, plan = a_covariance(rng), plan_rectification(CONVERGING)
    steps = rng.multivariate_normal(np.zeros(18), joint, 250)
    found = pulls(plan, [rig_at(CONVERGING, step) for step in steps], geometry_covariance(plan, joint), rng)
    assert found.shape[1] > 100
    assert np.sqrt(np.mean(found**2)) == pytest.approx(1.0, abs=0.12)
    assert (np.abs(found) < 1.96).mean() == pytest.approx(0.95, abs=0.03)
    for third in np.array_split(found, 3, axis=1):  # near and far; in corners of the picture it is up to twice as much
        assert np.sqrt(np.mean(third**2)) == pytest.approx(1.0, abs=0.2)


def test_a_rectified_pair_has_the_covariance_of_its_numbers() -> None:
    left, right = (RIGHT.with_params(np.array([600.0, 600.0, cx, 240.0])) for cx in (376.0, 390.0))
    rig = Rig((left, right), np.array([rigid3.IDENTITY, [0.0, 0.0, 0.0, 1.0, -0.2, 0.0, 0.0]]))
    plan = plan_rectification(rig)
    assert plan.is_identity
    joint = np.zeros((14, 14))
    joint[2, 2], joint[6, 6], joint[2, 6] = 0.3**2, 0.4**2, 0.06
    joint[6, 2] = 0.06
    joint[11, 11] = 1e-3**2
    expected = np.diag([0.0, 1e-6, 0.3**2 + 0.4**2 - 2 * 0.06])
    np.testing.assert_allclose(geometry_covariance(plan, joint), expected, atol=1e-9)
    # a turn about the vertical is one of doffs, and larger towards the sides of the picture
    joint = np.zeros((14, 14))
    joint[9, 9] = 1e-4**2
    found = geometry_covariance(plan, joint)
    assert 0.06 < np.sqrt(found[2, 2]) < 0.075
    assert not without_turn(joint).any()


def test_cameras_given_in_the_other_order_have_the_same_covariance() -> None:
    joint = a_covariance(np.random.default_rng(2))
    straight = geometry_covariance(plan_rectification(CONVERGING), joint)
    # the same rig, told from its right camera
    other = CONVERGING.reversed_pair()
    order = [*range(8, 12), *range(8), *range(12, 18)]
    pose = other.cam_from_rig[1]
    by = np.eye(18)  # a motion of one camera is the opposite one of the other, seen through the pose between them
    rotation = rigid3.rotation_matrix(pose)
    by[12:15, 12:15] = by[15:, 15:] = -rotation
    by[15:, 12:15] = -rigid3.skew(pose[4:]) @ rotation
    told = (by @ joint @ by.T)[np.ix_(order, order)]
    found = geometry_covariance(plan_rectification(other.reversed_pair()), told, is_swapped=True)
    np.testing.assert_allclose(found, straight, rtol=1e-3, atol=1e-9)


def test_a_rig_file_brings_its_covariance(tmp_path: Path) -> None:
    joint = a_covariance(np.random.default_rng(3))
    names = [f"cam0.{n}" for n in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")]
    names += [f"cam1.{n}" for n in ("fx", "fy", "cx", "cy")]
    names += [f"cam1.{n}" for n in ("turn_x", "turn_y", "turn_z", "x", "y", "z")]
    mixed = np.random.default_rng(4).permutation(18)
    rows = np.eye(4)
    rows[:3, :3], rows[:3, 3] = TURN, CONVERGING.cam_from_rig[1, 4:]
    document = {
        f"cam{n}": {"model": c.model.name, "width": 752, "height": 480, "params": c.params.tolist()}
        for n, c in enumerate((LEFT, RIGHT))
    }
    document["cam1"]["T_cn_cnm1"] = rows.tolist()
    document |= {"unknowns": [names[k] for k in mixed], "covariance": joint[np.ix_(mixed, mixed)].tolist()}
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(document))
    found = read_calibration(path, [(752, 480)] * 2).covariance
    assert found is not None
    np.testing.assert_allclose(found, joint)
    half = read_calibration(path, [(376, 240)] * 2).covariance
    assert half is not None
    by = np.array([0.5] * 4 + [1.0] * 4 + [0.5] * 4 + [1.0] * 6)
    np.testing.assert_allclose(half, joint * np.outer(by, by))
    path.write_text(json.dumps({**document, "unknowns": names[:5]}))
    with pytest.raises(InputError, match=r"rig\.json"):
        read_calibration(path, [(752, 480)] * 2)
