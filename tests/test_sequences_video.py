"""Videos as sequences: times, turning, damage, limits."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfmapp.errors import InputError, UsageError
from sfmapp.events import Event, Events
from sfmapp.formats.sequences import MissingCameraError, SequenceOptions, open_sequence
from sfmapp.images.video import is_stream

PINHOLE = SequenceOptions(camera="PINHOLE,50,50,32,24")


def pictures(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (64, 48)) for _ in range(count)]


def write_video(path: Path, frames: list[np.ndarray], fps: float = 25.0, code: str = "MJPG") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), fps, (64, 48))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


@pytest.mark.parametrize(("name", "code"), [("v.avi", "MJPG"), ("v.mp4", "mp4v"), ("v.mkv", "MJPG")])
def test_video_has_frames_and_times(tmp_path: Path, name: str, code: str) -> None:
    frames = pictures(20)
    sequence = open_sequence(write_video(tmp_path / name, frames, code=code), PINHOLE, Events())
    assert (sequence.kind, sequence.num_frames, sequence.frames_per_second) == ("video", 20, pytest.approx(25))
    for _ in range(2):  # as often as one likes
        read = list(sequence.frames())
        assert [frame.idx for frame in read] == list(range(20))
        np.testing.assert_allclose([frame.timestamp_s for frame in read], np.arange(20) / 25, atol=2e-3)
        for frame, picture in zip(read, frames, strict=True):
            assert frame.name == f"{frame.idx:06d}"
            expected = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(int)
            assert np.abs(frame.images[0].astype(int) - expected).mean() < 8


def test_start_stop_and_step(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.avi", pictures(20))
    options = SequenceOptions(camera=PINHOLE.camera, start=3, stop=17, step=4)
    sequence = open_sequence(path, options, Events())
    assert sequence.num_frames == 4
    assert [frame.name for frame in sequence.frames()] == ["000003", "000007", "000011", "000015"]
    assert [frame.idx for frame in sequence.frames()] == [0, 1, 2, 3]
    np.testing.assert_allclose([f.timestamp_s for f in sequence.frames()], np.array([3, 7, 11, 15]) / 25, atol=2e-3)
    given = SequenceOptions(camera=PINHOLE.camera, fps=10)
    np.testing.assert_allclose(
        [f.timestamp_s for f in open_sequence(path, given, Events()).frames()], np.arange(20) / 10
    )


def test_video_without_a_camera_and_backwards(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.avi", pictures(3))
    with pytest.raises(MissingCameraError, match="64x48"):
        open_sequence(path, SequenceOptions(), Events())
    guess = open_sequence(path, SequenceOptions(), Events(), require_camera=False)
    assert guess.rig.cameras[0].focal_source == "default"
    with pytest.raises(UsageError, match="reverse"):
        open_sequence(path, SequenceOptions(camera=PINHOLE.camera, reverse=True), Events())
    (tmp_path / "camera.txt").write_text("50 50 31.5 23.5\n")
    np.testing.assert_allclose(open_sequence(path, SequenceOptions(), Events()).rig.cameras[0].params, [50, 50, 32, 24])


def test_video_of_a_phone_is_turned_upright(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", pictures(5), code="mp4v")
    data = bytearray(path.read_bytes())
    # the matrix of the track header (ISO 14496-12, 8.3.2), 40 bytes into the box of version 0: a quarter turn
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
    path.write_bytes(data)
    sequence = open_sequence(path, SequenceOptions(camera="PINHOLE,50,50,24,32"), Events())
    frames = list(sequence.frames())
    assert len(frames) == 5
    assert frames[0].images[0].shape == (64, 48)
    upright = cv2.rotate(cv2.cvtColor(pictures(1)[0], cv2.COLOR_BGR2GRAY), cv2.ROTATE_90_CLOCKWISE).astype(int)
    assert np.abs(frames[0].images[0].astype(int) - upright).mean() < 8


def test_repeated_frames_are_skipped(tmp_path: Path) -> None:
    told: list[Event] = []
    frames = pictures(6)
    frames[3] = frames[2]
    sequence = open_sequence(write_video(tmp_path / "v.avi", frames), PINHOLE, Events(told.append))
    assert [frame.idx for frame in sequence.frames()] == [0, 1, 2, 4, 5]
    assert any("1 of 6 frames repeat" in event.message for event in told if event.kind == "warned")


def test_a_video_that_was_cut_off(tmp_path: Path) -> None:
    told: list[Event] = []
    path = write_video(tmp_path / "v.avi", pictures(40))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    sequence = open_sequence(path, PINHOLE, Events(told.append))
    frames = list(sequence.frames())
    assert 5 < len(frames) < 30
    warned = [event.message for event in told if event.kind == "warned"]
    # the header still counts all, or the container was seen to be broken: either way no more than was read
    assert sequence.num_frames is not None
    assert sequence.num_frames <= len(frames) + 1 or any("the video ends here" in text for text in warned)


@pytest.mark.parametrize("content", [b"", b"RIFF\0\0\0\0AVI ", b"\0" * 5000, b"ftyp" * 100])
def test_files_that_are_no_video(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "v.avi").write_bytes(content)
    with pytest.raises(InputError, match=r"v\.avi: expected a video"):
        open_sequence(tmp_path / "v.avi", PINHOLE, Events())


def test_a_name_with_a_percent_sign_is_no_pattern(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a0.png"), np.zeros((48, 64), np.uint8))
    (tmp_path / "a%d.mp4").write_bytes(b"nothing")
    with pytest.raises(InputError, match="expected a video"):
        open_sequence(tmp_path / "a%d.mp4", PINHOLE, Events())


def test_streams_are_known_by_their_names() -> None:
    assert all(map(is_stream, ("rtsp://10.0.0.2/live", "http://host/v.mjpg", "camera:0", "/dev/video2")))
    assert not any(map(is_stream, ("video.mp4", "/data/camera", "C:/videos", "file:///etc/passwd", "concat:a|b")))
