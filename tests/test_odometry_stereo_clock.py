"""Pairs of images that do not belong together: at other moments, exchanged, upside down, of another place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from odometry_sequences import Images, Played, room
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.result import OdometryResult
from sfmapp.odometry.run import run_odometry
from sfmapp.odometry.stereo_clock import Look, estimate_time_offset

FRAMES = 60


def played(edit: Callable[[list[Images], int], Images]) -> Played:
    """The walk through the room with a rig, each pair of images as an edit has it; the last frames only lend theirs."""
    walk = room(FRAMES + 4, is_stereo=True)
    part = walk.taken(np.arange(2, FRAMES))
    return replace(part, images=[edit(walk.images, k) for k in range(2, FRAMES)])


def run(sequence: Played) -> OdometryResult:
    return run_odometry(sequence, OdometryOptions(covariance=False), events=Events())


def scale_of(result: OdometryResult, sequence: Played) -> float:
    """Estimated over true length."""
    known = np.isfinite(result.cam_from_world[:, 0])
    ground_truth = rigid3.center(sequence.ground_truth.cam_from_world[result.frame_idx[known]])
    return 1 / float(similarity.umeyama(rigid3.center(result.cam_from_world[known]), ground_truth)[7])


@pytest.mark.parametrize("late", [2, -1])
def test_whole_frames_are_taken_out(late: int) -> None:
    sequence = played(lambda images, k: (images[k][0], images[k - late][1]))
    result = run(sequence)
    assert result.report["right_late_frames"] == late
    assert scale_of(result, sequence) == pytest.approx(1.0, abs=0.01)
    assert result.maps[0].contradictions == []


def test_cameras_in_step_are_left_alone() -> None:
    result = run(played(lambda images, k: images[k]))
    assert result.report["right_late_frames"] == 0
    assert result.maps[0].contradictions == []


def test_a_camera_that_falls_behind_on_the_way_is_left_out_and_told() -> None:
    sequence = played(lambda images, k: (images[k][0], images[k - (2 if k > 30 else 0)][1]))
    result = run(sequence)
    assert scale_of(result, sequence) == pytest.approx(1.0, abs=0.02)
    (found,) = result.maps[0].contradictions
    assert found.subject == "clock of the cameras"
    assert found.evidence["late_frames"] == pytest.approx(2.0, abs=0.25)
    sigma = result.maps[0].scale_sigma
    assert sigma is not None
    assert 0.005 < sigma < 0.5


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda images, k: images[k][::-1], "left and right are swapped"),
        (lambda images, k: (images[k][0], np.ascontiguousarray(images[k][1][::-1, ::-1])), "upside down"),
    ],
)
def test_a_rig_that_is_not_what_it_is_said_to_be_is_refused(edit: Callable[..., Images], words: str) -> None:
    result = run(played(edit))
    assert result.maps == []
    assert words in result.report["pairs"][0]["message"]


@pytest.mark.parametrize("late", [0.0, 0.3, -1.0])
def test_lateness_is_told_from_a_turn_of_the_rig(late: float) -> None:
    rng = np.random.default_rng(1)
    turn, looks = np.radians([0.4, -0.2, 0.3]), list[Look]()
    for frame in range(8):
        xy = rng.uniform(-1, 1, (200, 2))
        motion = 4 * xy[:, 1] * rng.uniform(0.2, 1.0, 200) + rng.normal(0, 1)
        columns = 700 * np.column_stack([1 + xy[:, 1] ** 2, xy[:, 0] * xy[:, 1], xy[:, 0], 0.1 * xy[:, 1]])
        off = -late * motion - columns[:, :3] @ turn + rng.normal(0, 0.1, 200)
        off[:20] += rng.uniform(-20, 20, 20)  # mismatches
        looks.append(Look(frame, 0.1, off, motion, columns, np.ones(200), 200, 200))
    found = estimate_time_offset(looks)
    assert found.is_known
    assert found.frames == pytest.approx(late, abs=0.02)
    np.testing.assert_allclose(found.of_looks, late, atol=0.05)
