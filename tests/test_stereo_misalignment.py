"""A rig that has turned since its calibration, and photographs of which no calibration is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.alignment import aligned_matches
from sfmapp.stereo.misalignment import Misalignment, measure_misalignment
from sfmapp.stereo.prepare import corrected_rig
from sfmapp.stereo.rectification import plan_rectification
from sfmapp.stereo.sparse_matches import PairMatches
from sfmapp.stereo.uncalibrated import rig_from_matches

Array = NDArray[np.float64]
CAMERA = Camera(CameraModel.PINHOLE, 1000, 600, np.array([700.0, 700.0, 500.0, 300.0]))
RIG = Rig((CAMERA, CAMERA), np.array([rigid3.IDENTITY, [0.0, 0.0, 0.0, 1.0, -0.4, 0.0, 0.0]]))


def turned(turn_deg: tuple[float, float, float]) -> Rig:
    turn = rigid3.from_matrix(rigid3.exp_so3(np.radians(turn_deg)), np.zeros(3))
    return Rig(RIG.cameras, np.array([rigid3.IDENTITY, rigid3.compose(turn, RIG.cam_from_rig[1])]))


def seen(rig: Rig, rng: np.random.Generator, count: int, noise_px: float, wrong: float = 0.0) -> PairMatches:
    """Points from 4 to 40 m before a rig, with normal noise; some matches are wrong."""
    z = 1.0 / rng.uniform(1 / 40.0, 1 / 4.0, count)
    points = np.stack([*(rng.uniform(-0.7, 0.7, (2, count)) * [[1.0], [0.6]] * z), z], 1)
    ends = [project(c, rigid3.apply(pose, points)) for c, pose in zip(rig.cameras, rig.cam_from_rig, strict=True)]
    ends = [xy + rng.normal(0.0, noise_px, xy.shape) for xy in ends]
    bad = rng.uniform(size=count) < wrong
    ends[1][bad] += rng.normal(0.0, 40.0, (int(bad.sum()), 2))
    kept = np.ones(count, bool)
    for xy in ends:
        kept &= ((xy > 0.0) & (xy < [1000.0, 600.0])).all(1)
    return PairMatches(ends[0][kept], ends[1][kept])


def measured(matches: PairMatches) -> Misalignment:
    found = measure_misalignment(matches, plan_rectification(RIG).geometry)
    assert found is not None
    return found


def test_a_turned_camera_is_found_within_its_sigmas() -> None:
    truths = [(0.0, 0.05, 0.0), (0.04, -0.06, 0.02), (-0.05, 0.0, 0.0), (0.02, 0.1, -0.2)]
    pulls = []
    for seed, truth in enumerate(truths * 2):
        found = measured(seen(turned(truth), np.random.default_rng(seed), 2500, 0.05, wrong=0.1))
        assert found.is_significant
        assert np.abs(found.turn_deg - truth)[[0, 2]].max() < 0.002
        assert abs(found.turn_deg[1] - truth[1]) < 0.008
        if found.is_told[1]:
            pulls.append((found.turn_deg - truth)[1] / found.sigma_deg[1])
    assert len(pulls) >= 4
    # an error that the lens may have is in the sigma, and not in these matches
    assert 0.02 < np.sqrt(np.mean(np.square(pulls))) < 1.5


def test_a_rig_that_holds_is_left_alone() -> None:
    found = [measured(seen(RIG, np.random.default_rng(seed), 1500, 0.1, wrong=0.1)) for seed in range(8)]
    assert not any(one.is_significant for one in found)
    assert not any(one.is_told[1] for one in found)


def test_what_is_left_of_a_turn_that_is_held_is_as_large_as_its_sigma() -> None:
    """Rigs that turned about any axis, too few matches to tell how far about the vertical."""
    pulls, sigmas = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        truth = tuple(rng.normal(0.0, 0.03, 3))
        found = measured(seen(turned(truth), rng, 300, 0.4))
        if found.is_significant and not found.is_told[1]:
            assert found.turn_deg[1] == 0.0
            pulls.append(truth[1] / found.sigma_deg[1])
            sigmas.append(found.sigma_deg[1])
    assert len(pulls) >= 15
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.3
    assert np.mean(np.abs(pulls) < 1.96) >= 0.85
    assert np.median(sigmas) < 0.05


def test_what_a_pair_does_not_tell_is_held() -> None:
    found = measured(seen(turned((0.05, 0.02, 0.0)), np.random.default_rng(1), 150, 0.5))
    assert found.turn_deg[0] == pytest.approx(0.05, abs=0.02)
    assert not found.is_told[1]
    assert found.turn_deg[1] == 0.0
    assert 0.02 < found.sigma_deg[1] <= 0.5
    assert measure_misalignment(seen(RIG, np.random.default_rng(2), 40, 0.1), plan_rectification(RIG).geometry) is None


def test_the_correction_is_the_true_rig_and_a_lens_is_no_turn() -> None:
    truth = turned((0.03, 0.08, -0.05))
    found = measured(seen(truth, np.random.default_rng(3), 4000, 0.02))
    rig = corrected_rig(plan_rectification(RIG), found)
    off = rigid3.compose(rig.cam_from_rig[1], rigid3.inverse(truth.cam_from_rig[1]))
    assert float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(off))) < 0.005
    assert found.is_turn
    other = measured(seen(turned((0.0, 0.6, 0.0)), np.random.default_rng(4), 2000, 0.05))
    assert not other.is_turn
    # rows alone: the right picture's rows become those of the left one, columns stay
    g = plan_rectification(RIG).geometry
    matches = seen(turned((0.0, 0.6, 0.0)), np.random.default_rng(5), 400, 0.0)
    rows = other.source_rows(g)
    column, row = (np.floor(xy).astype(int) for xy in (matches.right[:, 0], matches.left[:, 1]))
    source = (
        rows[np.clip(row, 0, 599), np.clip(column, 0, 999)] + matches.left[:, 1] - np.floor(matches.left[:, 1]) - 0.5
    )
    assert np.abs(source - matches.right[:, 1]).max() < 0.1


def test_matches_are_aligned_across_rows_without_bias() -> None:
    """A slanted surface of fine detail whose rows differ by up to a quarter of a pixel."""
    rng, shape = np.random.default_rng(6), (200, 500)
    frequency, phase, angle = rng.uniform(0.02, 0.4, 150), rng.uniform(0, 6.3, 150), rng.uniform(0, np.pi, 150)
    wave = 2 * np.pi * frequency[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)

    def shown(x: Array, y: Array) -> Array:
        return sum((4.0 * np.cos(w[0] * x + w[1] * y + p) for w, p in zip(wave, phase, strict=True)), 128.0 + 0.0 * x)

    def moved_down(x: Array) -> Array:
        return np.asarray(0.25 * (x - 250.0) / 250.0)

    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    source = (x + 15.0 + 0.05 * y) / 0.97
    pictures = [
        np.clip(np.rint(one + rng.normal(0.0, 2.0, shape)), 0, 255).astype(np.uint8)
        for one in (shown(x, y), shown(source, y + moved_down(source)))
    ]
    left = rng.uniform((60.0, 20.0), (440.0, 180.0), (600, 2))
    row = left[:, 1] - moved_down(left[:, 0])
    right = np.stack([0.97 * left[:, 0] - 15.0 - 0.05 * row, row], 1)
    start = PairMatches(left, right + rng.normal(0.0, 0.3, right.shape))
    found = aligned_matches(pictures[0], pictures[1], start)
    assert len(found) > 500
    place = {tuple(xy): k for k, xy in enumerate(left.tolist())}
    error = found.right - right[[place[tuple(xy)] for xy in found.left.tolist()]]
    assert np.median(np.abs(error), 0).max() < 0.03
    assert abs(np.polyfit(moved_down(found.left[:, 0]), error[:, 1], 1)[0]) < 0.015


def test_photographs_of_unknown_cameras_become_a_rig_with_common_rows() -> None:
    second = rigid3.from_matrix(rigid3.exp_so3(np.radians([2.0, -9.0, 3.0])), [-0.9, 0.1, 0.1])
    wide = Camera(CameraModel.PINHOLE, 900, 700, np.array([800.0, 800.0, 460.0, 345.0]))
    truth = Rig((CAMERA, wide), np.array([rigid3.IDENTITY, second]))
    matches = seen(truth, np.random.default_rng(7), 900, 0.3, wrong=0.2)
    found = rig_from_matches(matches, ((1000, 600), (900, 700)))
    assert found.rms_px < 0.5
    plan = plan_rectification(found.rig)
    clean = seen(truth, np.random.default_rng(8), 600, 0.0)
    rows = [plan.points(side, xy)[:, 1] for side, xy in enumerate((clean.left, clean.right))]
    assert np.nanmedian(np.abs(rows[0] - rows[1])) < 0.15
    assert min(plan.kept) > 0.5
    plane = cv2.perspectiveTransform(clean.left[None], np.array([[1.0, 0.01, 5.0], [0.0, 1.0, 3.0], [1e-5, 0.0, 1.0]]))
    with pytest.raises(InputError, match="one plane"):
        rig_from_matches(PairMatches(clean.left, plane[0]), ((1000, 600), (1000, 600)))
    with pytest.raises(InputError, match="fit together"):
        rig_from_matches(PairMatches(clean.left[:100], clean.right[::-1][:100]), ((1000, 600), (900, 700)))
