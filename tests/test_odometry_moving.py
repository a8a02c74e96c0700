"""Something that moves before the camera: told, and in every sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from odometry_sequences import Images, room, run_room
from sfmapp.adjust.covariance import pose_errors_in_gauge
from sfmapp.events import Event, Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.run import run_odometry

FIRST, LAST = 30, 60


def covered(images: Images, frame: int, texture: np.ndarray) -> Images:
    """A board that sways before the camera and fills 60 % of the view for some frames."""
    if not FIRST <= frame < LAST:
        return images
    image = images[0].copy()
    height, width = image.shape
    y, x = int(0.2 * height), int(width * (0.12 + 0.1 * np.sin(frame / 9)))
    h, w = int(0.79 * height), int(0.76 * width)
    image[y : y + h, x : x + w] = texture[:h, :w]
    return (image,)


def test_a_board_that_sways_before_the_camera_is_told() -> None:
    walk = room(80)
    board = np.kron(np.random.default_rng(0).integers(20, 235, (60, 80)), np.ones((4, 4))).astype(np.uint8)
    images = [covered(seen, k, board) for k, seen in enumerate(walk.images)]
    result = run_odometry(replace(walk, images=images), OdometryOptions(), events=Events())
    entry = result.maps[0]
    (found,) = entry.contradictions
    assert found.subject == "what moves"
    assert FIRST - 1 <= found.evidence["first_frame"] <= FIRST + 8
    assert found.evidence["last_frame"] <= LAST + 4
    centers = rigid3.center(result.cam_from_world[entry.keyframe_frame_idx])
    ground_truth = rigid3.center(walk.ground_truth.cam_from_world[result.frame_idx[entry.keyframe_frame_idx]])
    unit = similarity.umeyama(centers, ground_truth)
    error = np.linalg.norm(similarity.apply(unit, centers) - ground_truth, axis=1)
    assert entry.covariance is not None
    sigma = float(unit[7]) * np.sqrt(np.trace(entry.covariance[:, 3:, 3:], axis1=1, axis2=2))
    assert np.median(error) < 3 * np.median(sigma)


def blurred(images: Images, frame: int, width: int = 25, first: int = FIRST) -> Images:
    """The picture smeared along a row, by a twelfth of its width."""
    if not first <= frame < LAST:
        return images
    half = width // 2
    sums = np.cumsum(np.pad(images[0].astype(np.float64), ((0, 0), (half + 1, half)), "edge"), 1)
    noise = np.random.default_rng(frame).normal(0.0, 2.0, images[0].shape)
    return (np.clip((sums[:, width:] - sums[:, :-width]) / width + noise, 0, 255).astype(np.uint8),)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_blurred_picture_is_not_taken_for_something_that_covers_the_view(seed: int) -> None:
    walk = room(80, seed=seed)
    images = [blurred(seen, k) for k, seen in enumerate(walk.images)]
    result = run_odometry(replace(walk, images=images), OdometryOptions(covariance=False), events=Events())
    (found,) = result.maps[0].contradictions
    assert found.subject == "sharpness"
    assert FIRST <= found.evidence["first_frame"] < LAST
    assert found.evidence["share_sharp"] < 0.5
    assert 0.02 < found.scale_sigma < 0.05


def test_sigmas_reckon_with_pictures_that_are_blurred_and_nothing_else_tells() -> None:
    """Half of the points are found still, and what is left agrees with itself; the places are ten sigmas off."""
    walk = room(80, seed=3)
    images = [blurred(seen, k, 15, 20) for k, seen in enumerate(walk.images)]
    said: list[Event] = []
    result = run_odometry(replace(walk, images=images), OdometryOptions(), events=Events(said.append))
    entry = result.maps[0]
    assert entry.contradictions == []
    (adjusted,) = [event.data for event in said if (event.kind, event.stage) == ("finished", "adjustment")]
    assert adjusted["covariance"]["wider_loss_sigmas"] > 5.0
    truth, keyframes = entry.reconstruction.copy(), entry.keyframe_image_idx
    truth.cam_from_world[keyframes] = walk.ground_truth.cam_from_world[result.frame_idx[entry.keyframe_frame_idx]]
    off = pose_errors_in_gauge(entry.reconstruction, truth, keyframes, 7)[:, 3:]
    assert entry.covariance is not None
    squares = (off**2).sum(1) / np.trace(entry.covariance[:, 3:, 3:], axis1=1, axis2=2)
    assert 0.2 < np.sqrt(squares.mean()) < 3.0


def test_a_walk_through_a_still_room_is_not_doubted() -> None:
    assert run_room().maps[0].contradictions == []
