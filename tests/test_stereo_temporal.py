"""Whether depths of a film stay where nothing moves."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import sfmapp
from schemas import check_schema
from sfmapp.pipelines.stereo.sources import KnownCameras
from sfmapp.stereo.temporal import ConsistencyReport, Moment, compare_moments, film_report, still_pixels

HEIGHT, WIDTH = 160, 240
DISPARITIES = 12.0, 24.0


def texture(seed: int, width: int = WIDTH) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (HEIGHT, width))
    return (128.0 + 150.0 * cv2.GaussianBlur(noise, (0, 0), 1.5)).astype(np.float32)


def picture(values: NDArray[np.float32], noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
    grey = values + np.random.default_rng(seed).normal(0.0, noise, values.shape) if noise else values
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def moved(values: NDArray[np.float32], x: float, y: float) -> NDArray[np.float32]:
    shift = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
    out: NDArray[np.float32] = cv2.warpAffine(
        values, shift, values.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    return out


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_moves_is_told_from_what_does_not(seed: int) -> None:
    values = texture(seed)
    before = picture(values, 3.0, 10)
    assert still_pixels(before, picture(values, 3.0, 11)).mean() > 0.95
    assert still_pixels(before, picture(values + 12.0, 3.0, 11)).mean() > 0.95  # the exposure changes
    assert still_pixels(before, picture(moved(values, 0.05, 0.03), 3.0, 11)).mean() > 0.8
    for x, y in ((0.5, 0.0), (0.0, -0.5), (1.0, 1.0), (3.0, 0.0), (-8.0, 5.0)):
        assert still_pixels(before, picture(moved(values, x, y), 3.0, 11)).mean() == 0.0
    assert still_pixels(before, picture(texture(seed + 100), 3.0, 11)).mean() == 0.0
    flat = np.full_like(values, 128.0)
    assert still_pixels(picture(flat, 3.0, 10), picture(flat, 3.0, 11)).mean() == 0.0  # nothing but noise


def moment(name: str, disparity: NDArray[np.float32], left: NDArray[np.float32]) -> Moment:
    shown = np.ones((HEIGHT, WIDTH), np.bool_)
    half_width = np.where(np.isfinite(disparity), np.float32(1.96 * 0.2), np.float32(np.nan))
    return Moment(name, picture(left), shown, disparity, half_width)


def test_disparities_that_err_by_their_sigma_agree_in_ninety_five_of_a_hundred() -> None:
    rng, left = np.random.default_rng(4), texture(5)
    truth = np.linspace(10.0, 30.0, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    first, second = (truth + rng.normal(0.0, 0.2, truth.shape).astype(np.float32) for _ in range(2))
    second[:, :60] = np.nan
    told = compare_moments(moment("a", first, left), moment("b", second, left))
    assert told.compared_with == "a"
    assert told.still_share > 0.95
    assert told.kept_share == pytest.approx(0.75, abs=0.01)
    assert told.agreeing_share == pytest.approx(0.95, abs=0.01)
    # the median of |N(0, 2 sigma^2)|
    assert told.median_change_px == pytest.approx(0.6745 * 0.2 * 2**0.5, rel=0.03)
    shuffled = rng.permutation(second.ravel()).reshape(second.shape)
    told = compare_moments(moment("a", first, left), moment("b", shuffled, left))
    assert told.agreeing_share is not None
    assert told.agreeing_share < 0.1


def test_a_film_says_nothing_of_itself_where_everything_moves() -> None:
    disparity = np.full((HEIGHT, WIDTH), 12.0, np.float32)
    told = compare_moments(moment("a", disparity, texture(5)), moment("b", disparity, texture(6)))
    assert told.agreeing_share is None
    assert told.still_share == 0.0
    assert film_report([]) is None
    film = film_report([("b", told)])
    assert film is not None
    assert (film.num_following, film.num_compared, film.worst) == (1, 0, None)
    good = ConsistencyReport(
        compared_with="b", still_share=0.5, kept_share=0.9, agreeing_share=0.97, median_change_px=0.1
    )
    film = film_report([("b", told), ("c", good)])
    assert film is not None
    assert (film.num_following, film.num_compared, film.worst, film.agreeing_share) == (2, 1, "c", 0.97)


def test_a_wall_that_jumps_while_the_left_camera_sees_the_same(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    wall = texture(7, WIDTH + 60)
    left = wall[:, 30 : 30 + WIDTH]
    near_and_far = [int(DISPARITIES[n]) for n in (0, 0, 1, 1)]  # only the right camera can tell
    with av.open(str(tmp_path / "film.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 2 * WIDTH, HEIGHT, "bgr0"
        for n, shift in enumerate(near_and_far):
            right = wall[:, 30 + shift : 30 + shift + WIDTH]
            both = np.concatenate([picture(left, 2.0, 2 * n), picture(right, 2.0, 2 * n + 1)], axis=1)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(np.repeat(both[:, :, None], 3, axis=2)), "rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    found = sfmapp.match_stereo(
        [tmp_path / "film.mkv"], tmp_path / "out", camera=KnownCameras(focal_px=200.0, baseline_m=0.1)
    )
    assert [np.nanmedian(found.last.measured.depth)] == pytest.approx([200.0 * 0.1 / DISPARITIES[1]], rel=0.02)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    check_schema("stereo", report)
    told = [pair.get("consistency") for pair in report["pairs"]]
    assert told[0] is None
    assert [each["compared_with"] for each in told[1:]] == ["000000", "000001", "000002"]
    assert all(each["still_share"] > 0.7 for each in told[1:])
    assert told[1]["agreeing_share"] > 0.95 < told[3]["agreeing_share"]
    assert told[2]["agreeing_share"] < 0.05
    assert report["film"]["worst"] == "000002"
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Least agrees 000002" in page
    assert "they showed in 000000" in (tmp_path / "out" / "000001" / "report.html").read_text()
