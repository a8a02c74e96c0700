"""Frames that show what the last one shows: which are taken for such, and what they get."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import odometry_sequences as played
from odometry_sequences import run
from rendered_worlds import sequences as rendered
from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid
from sfmapp.odometry.frontend.twins import is_twin
from sfmapp.odometry.result import FrameState

Array = np.ndarray

HEIGHT, WIDTH, NOISE = 120, 160, 1.0
# a point is known to a tenth of a pixel, and four hundred of them put a pose to 0.1 sqrt(3 / 400)
POINT_PX, TOGETHER_PX = 0.1, 0.0087


def picture(seed: int, shift_px: float = 0.0, zoom: float = 1.0, brighter: float = 0.0) -> Pyramid:
    """The same texture each time, moved, under noise of its own."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).uniform(-1, 1, (HEIGHT, WIDTH)), (0, 0), 2.0)
    move = np.array([[zoom, 0, shift_px + (1 - zoom) * WIDTH / 2], [0, zoom, (1 - zoom) * HEIGHT / 2]])
    moved = cv2.warpAffine(
        200 * texture, move, (WIDTH, HEIGHT), flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT
    )
    noisy = 120 + brighter + moved + np.random.default_rng([1, seed]).normal(0, NOISE, moved.shape)
    return build_pyramid(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


def points() -> Array:
    return np.random.default_rng(2).uniform(8, [WIDTH - 8, HEIGHT - 8], (400, 2))


def taken(*seeds: int, **change: float) -> list[bool]:
    return [is_twin(picture(0), picture(seed, **change), points(), POINT_PX, TOGETHER_PX) for seed in seeds]


def test_noise_and_brightness_make_no_other_frame() -> None:
    assert sum(taken(*range(1, 21))) >= 18
    assert sum(taken(*range(1, 21), brighter=6.0)) >= 18


@pytest.mark.parametrize("change", [{"shift_px": 0.05}, {"shift_px": -0.5}, {"zoom": 1.001}])
def test_what_a_pose_would_show_is_no_twin(change: dict[str, float]) -> None:
    assert not any(taken(*range(1, 21), **change))


def test_pictures_that_have_nothing_in_common_are_no_twins_however_badly_points_are_known() -> None:
    noise = np.random.default_rng(5).integers(0, 255, (2, HEIGHT, WIDTH)).astype(np.uint8)
    first, second = (build_pyramid(image) for image in noise)
    assert not is_twin(first, second, points(), 2.0, 1.0)
    assert not is_twin(picture(0), picture(1, shift_px=11.0), points(), 2.0, 1.0)


def test_too_few_points_and_black_frames_tell_nothing() -> None:
    black = build_pyramid(np.zeros((HEIGHT, WIDTH), np.uint8))
    assert not is_twin(picture(0), picture(1), points()[:10], POINT_PX, TOGETHER_PX)
    assert not is_twin(black, black, points(), POINT_PX, TOGETHER_PX)
    assert not is_twin(picture(0), build_pyramid(np.zeros((80, 90), np.uint8)), points(), POINT_PX, TOGETHER_PX)


def test_frames_of_a_standing_camera_get_the_pose_of_the_first_with_its_sigma() -> None:
    sequence = played.play(rendered.stand(played.room_walk(40), 30, 5))
    result = run(sequence)
    assert result.report is not None
    assert result.report.twins == 5
    assert (result.frame_state[31:36] == FrameState.TRACKED).all()
    assert result.measured_covariance is not None
    for array in (result.live_cam_from_world, result.measured_covariance):
        assert np.isfinite(array[31:36]).all()
        assert np.allclose(array[31:36], array[31])
    assert np.allclose(result.cam_from_world[31:36], result.cam_from_world[30], atol=1e-3)
    assert played.absolute_error(result, sequence)[0] < 0.01
