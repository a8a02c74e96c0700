"""Choosing frames of files as they come: formats, odd sizes, turned pictures, uneven times, fields, stops, nothing."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.errors import InterruptedRunError, NoReconstructionError
from sfmapp.events import Event, Events
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.pipelines.sparse.videos import IMAGES, Sources, frames_and_photographs
from sfmapp.video.frames import choose_frames
from sfmapp.video.options import VideoOptions
from sfmapp.workspace.options import load_options
from test_sequences_video import encode
from test_video_frames import Walls, noisy, read_table, select, warnings

Pixels = NDArray[np.uint8]

WANTED = VideoOptions(parallax=0.02)


@pytest.fixture(scope="module")
def colors() -> list[Pixels]:
    """A camera that passes two walls, the picture in blue, green and red that differ."""
    walls = Walls()
    grays = [noisy(walls.image((-1.2 + 0.04 * k, 0, 0)), k) for k in range(50)]
    return [np.stack([255 - gray // 2, gray, gray // 2 + 60], axis=2) for gray in grays]


def numbers_of(video: Path, folder: Path) -> list[int]:
    return [one.number for one in choose_frames(video, folder, WANTED, Events()).chosen]


@pytest.mark.parametrize(
    ("codec", "pix", "name", "size"),
    [
        ("ffv1", "bgr0", "odd.mkv", (239, 319)), ("libx264", "yuv420p", "a.mp4", (240, 320)),
        ("libx265", "yuv420p10le", "ten_bit.mp4", (240, 320)), ("mjpeg", "yuvj444p", "odd.avi", (239, 319)),
        ("ffv1", "gray12le", "grey.mkv", (237, 320)), ("prores_ks", "yuv422p10le", "a.mov", (240, 320)),
    ],
)  # fmt: skip
def test_every_format_gives_the_frames_that_the_pictures_give(
    colors: list[Pixels], tmp_path: Path, codec: str, pix: str, name: str, size: tuple[int, int]
) -> None:
    pictures = [np.ascontiguousarray(color[: size[0], : size[1]]) for color in colors]
    quality = {"libx265": {"x265-params": "crf=12:log-level=none"}, "libx264": {"crf": "12"}}
    video = encode(tmp_path / name, pictures, codec, pix, **quality.get(codec, {}))
    events, told = warnings()
    report = choose_frames(video, tmp_path / "out", WANTED, events)
    assert not told
    assert (report.height, report.width, report.num_frames) == (*size, 50)
    plain = [row.number for row in select([cv2.cvtColor(p, cv2.COLOR_BGR2GRAY) for p in pictures], parallax=0.02)[0]]
    # compression makes frames more or less sharp than their neighbours; places are the same
    assert len(report.chosen) == pytest.approx(len(plain), abs=1)
    assert all(min(abs(one.number - number) for number in plain) <= 4 for one in report.chosen)
    for one in report.chosen:
        seen = cv2.imread(str(tmp_path / one.name), cv2.IMREAD_COLOR)
        assert seen is not None
        assert seen.shape[:2] == size
        true = pictures[one.number]
        if pix.startswith("gray"):
            true = np.repeat(cv2.cvtColor(true, cv2.COLOR_BGR2GRAY)[:, :, None], 3, axis=2)
        # colours are kept at half the resolution by some, and the finest noise by few
        off = cv2.blur(seen, (5, 5)).astype(int) - cv2.blur(true, (5, 5))
        assert np.abs(off).mean() < 5
        assert np.abs(off.mean(axis=(0, 1))).max() < 4  # a range or a matrix that is not the file's shifts more


def test_times_that_are_not_even_change_no_choice(colors: list[Pixels], tmp_path: Path) -> None:
    steps = np.random.default_rng(3).choice([17, 33, 50, 240], len(colors) - 1)
    times = np.concatenate([[0], np.cumsum(steps)])
    even = encode(tmp_path / "even.mkv", colors, "ffv1", "bgr0")
    uneven = encode(tmp_path / "uneven.mkv", colors, "ffv1", "bgr0", pts=times)
    assert numbers_of(uneven, tmp_path / "uneven") == numbers_of(even, tmp_path / "even")
    rows = list(read_table(tmp_path / "uneven"))
    assert [float(row["time_s"]) for row in rows] == pytest.approx(times / 1000, abs=1e-3)
    # the camera moves as far from frame to frame: its speed is less where more time goes by
    speed = np.array([float(row["speed"] or "nan") for row in rows])[1:]
    walked = speed * steps / 1000
    good = np.isfinite(walked)
    assert good.sum() > 30
    assert np.ptp(np.quantile(walked[good], [0.1, 0.9])) < 0.3 * np.median(walked[good])


@pytest.mark.parametrize(
    ("matrix", "code"), [((0, 1, -1, 0), cv2.ROTATE_90_CLOCKWISE), ((0, -1, 1, 0), cv2.ROTATE_90_COUNTERCLOCKWISE)]
)
def test_a_film_that_was_held_upright_gives_upright_frames(
    colors: list[Pixels], tmp_path: Path, matrix: tuple[int, int, int, int], code: int
) -> None:
    video = encode(tmp_path / "v.mp4", colors, crf="12")
    data, (a, b, c, d) = bytearray(video.read_bytes()), matrix
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    video.write_bytes(data)
    report = choose_frames(video, tmp_path / "out", WANTED, Events())
    assert report.is_turned
    assert (report.width, report.height) == (240, 320)
    assert len(report.chosen) >= 4
    for one in report.chosen:
        seen = cv2.imread(str(tmp_path / one.name), cv2.IMREAD_COLOR)
        assert seen is not None
        assert np.abs(seen.astype(int) - cv2.rotate(colors[one.number], code)).mean() < 6


def test_fields_are_made_whole_before_anything_is_chosen(tmp_path: Path) -> None:
    walls = Walls()
    fields = [noisy(walls.image((-1.2 + 0.03 * k, 0, 0)), k) for k in range(60)]
    woven = []
    for early, late in zip(fields[::2], fields[1::2], strict=True):
        frame = early.copy()
        frame[1::2] = late[1::2]
        woven.append(np.repeat(frame[:, :, None], 3, axis=2))
    video = encode(tmp_path / "v.mp4", woven, fields="tff", crf="3", flags="+ilme+ildct")
    report = choose_frames(video, tmp_path / "out", WANTED, Events())
    assert len(report.chosen) >= 4
    for one in report.chosen:
        seen = cv2.imread(str(tmp_path / one.name), cv2.IMREAD_GRAYSCALE)
        assert seen is not None
        off = [
            np.abs(seen.astype(int) - other).mean() for other in (fields[2 * one.number], woven[one.number][:, :, 0])
        ]
        assert off[0] < 0.7 * off[1]


def test_a_stop_leaves_nothing_that_is_taken_for_a_choice(colors: list[Pixels], tmp_path: Path) -> None:
    video = encode(tmp_path / "v.mkv", colors, "ffv1", "bgr0")
    options = load_options([], ["video.parallax=0.02"])
    whole, _ = frames_and_photographs(Sources((video,), ()), tmp_path / "whole", options, Events())
    stopped = Events()

    def stop(event: Event) -> None:
        if event.kind == "advanced" and event.done == 35:
            stopped.cancel()

    stopped.subscribe(stop)
    with pytest.raises(InterruptedRunError):
        frames_and_photographs(Sources((video,), ()), tmp_path / "again", options, stopped)
    assert list((tmp_path / "again" / IMAGES / "v").glob("*.jpg"))  # it was on its way
    found, reports = frames_and_photographs(Sources((video,), ()), tmp_path / "again", options, Events())
    assert [path.name for path in found.paths] == [path.name for path in whole.paths]
    assert [path.read_bytes() for path in found.paths] == [path.read_bytes() for path in whole.paths]
    # another run keeps them; frames that somebody took away, another film and other options do not
    before = [path.stat().st_mtime_ns for path in found.paths]
    kept, _ = frames_and_photographs(Sources((video,), ()), tmp_path / "again", options, Events())
    assert [path.stat().st_mtime_ns for path in kept.paths] == before
    found.paths[1].unlink()
    made, _ = frames_and_photographs(Sources((video,), ()), tmp_path / "again", options, Events())
    assert all(path.is_file() for path in made.paths)
    wider = load_options([], ["video.parallax=0.04"])
    fewer, (report,) = frames_and_photographs(Sources((video,), ()), tmp_path / "again", wider, Events())
    assert 2 <= len(fewer.paths) < len(whole.paths)
    assert report.key != reports[0].key
    assert len(list((tmp_path / "again" / IMAGES / "v").glob("*.jpg"))) == len(fewer.paths)


@pytest.mark.parametrize(("count", "value"), [(1, None), (12, 0), (12, 255)])
def test_films_that_show_nothing_are_told_of(
    colors: list[Pixels], tmp_path: Path, count: int, value: int | None
) -> None:
    pictures = colors[:1] if value is None else [np.full_like(colors[0], value)] * count
    video = encode(tmp_path / "v.mkv", pictures, "ffv1", "bgr0")
    report = choose_frames(video, tmp_path / "frames", WANTED, Events())
    assert (report.num_frames, len(report.chosen)) == (count, 1 if value is None else 0)
    with pytest.raises(NoReconstructionError) as caught:
        reconstruct(video, tmp_path / "out", record=False)
    assert caught.value.advice
