"""Videos as sequences: times, turning, damage, limits."""

from __future__ import annotations

import functools
import http.server
import struct
import threading
from collections.abc import Sequence as Several
from fractions import Fraction
from pathlib import Path

import av
import av.filter
import cv2
import numpy as np
import pytest

from sfmapp.errors import InputError, UsageError
from sfmapp.events import Event, Events
from sfmapp.images.video import is_stream
from sfmapp.sequences.open import MissingCameraError, SequenceOptions, open_sequence

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
    (repeated,) = sequence.repeated  # type: ignore[attr-defined]  # of files
    assert (repeated.idx, repeated.name, repeated.twin_idx) == (3, "000003", 2)
    assert repeated.timestamp_s == pytest.approx(3 / 25)
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


def encode(
    path: Path, frames: list[np.ndarray], codec: str = "libx264", pix: str = "yuv420p", pts: Several[int] = (),
    fields: str = "", **options: str,
) -> Path:  # fmt: skip
    """BGR frames at times in milliseconds, or 25 a second unless they are given."""
    base = Fraction(1, 1000) if len(pts) else Fraction(1, 25)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options or None)
        stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], pix
        stream.codec_context.time_base = base
        for i, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), "bgr24")
            picture.pts, picture.time_base = int(pts[i]) if len(pts) else i, base
            container.mux(stream.encode(marked(picture, fields)))
        container.mux(stream.encode())
    return path


def marked(picture: av.VideoFrame, fields: str) -> av.VideoFrame:
    """The frame as one of two fields, ``tff`` (the upper lines first) or ``bff``."""
    if not fields:
        return picture
    picture = picture.reformat(format="yuv420p")
    graph = av.filter.Graph()
    buffer = graph.add_buffer(
        width=picture.width, height=picture.height, format=picture.format, time_base=picture.time_base
    )
    graph.link_nodes(buffer, graph.add("setfield", fields), graph.add("buffersink")).configure()
    graph.push(picture)
    return graph.vpull()


def moving(count: int, step: float = 2.0, size: tuple[int, int] = (96, 64)) -> list[np.ndarray]:
    """A soft texture that moves sideways, ``step`` pixels a frame."""
    wide = cv2.resize(np.random.default_rng(0).integers(0, 256, (8, 60, 3), np.uint8), (480, size[1]))
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1).astype(np.float32)
    return [cv2.remap(wide, grid + np.float32([step * i + 10, 0]), None, cv2.INTER_LINEAR) for i in range(count)]


def gray(frame: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).astype(int)


@pytest.mark.parametrize("first", ["tff", "bff"])
def test_fields_become_whole_frames_at_the_time_of_the_first(tmp_path: Path, first: str) -> None:
    fields = moving(40)
    woven = []
    for early, late in zip(fields[::2], fields[1::2], strict=True):
        frame = early.copy()
        frame[1 if first == "tff" else 0 :: 2] = late[1 if first == "tff" else 0 :: 2]
        woven.append(frame)
    path = encode(tmp_path / "v.mp4", woven, fields=first, crf="3", flags="+ilme+ildct")
    sequence = open_sequence(path, SequenceOptions(camera="PINHOLE,50,50,48,32"), Events())
    frames = list(sequence.frames())
    assert [frame.timestamp_s for frame in frames] == pytest.approx(np.arange(20) / 25)
    for frame, early, comb in zip(frames, fields[::2], woven, strict=True):
        error = np.abs(frame.images[0] - gray(early))[:, 8:-8].mean()
        assert error < 3
        assert error < 0.5 * np.abs(gray(comb) - gray(early))[:, 8:-8].mean()


def test_whole_frames_that_are_marked_as_fields(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.mkv", [moving(1)[0]] * 3 + moving(5)[2:], fields="tff", crf="3", flags="+ilme")
    frames = list(open_sequence(path, SequenceOptions(camera="PINHOLE,50,50,48,32"), Events()).frames())
    assert np.abs(frames[0].images[0] - gray(moving(1)[0])).mean() < 3


@pytest.mark.parametrize(
    ("codec", "pix", "name"),
    [
        ("libx264", "yuv420p", "a.mp4"), ("libx264", "yuvj420p", "a.mp4"), ("libx264", "yuv444p", "a.mkv"),
        ("libx265", "yuv420p10le", "a.mp4"), ("ffv1", "gray", "a.mkv"), ("ffv1", "gray12le", "a.mkv"),
        ("ffv1", "bgr0", "a.mkv"), ("ffv1", "gbrp10le", "a.mkv"), ("png", "rgb24", "a.mov"),
        ("rawvideo", "yuyv422", "a.avi"), ("libx264", "yuv420p", "a.avi"), ("mjpeg", "yuvj422p", "a.avi"),
        ("libvpx-vp9", "yuv420p", "a.webm"), ("prores_ks", "yuv422p10le", "a.mov"), ("mpeg2video", "yuv420p", "a.ts"),
        ("rawvideo", "nv12", "a.nut"),
    ],
)  # fmt: skip
def test_grey_of_every_pixel_format(tmp_path: Path, codec: str, pix: str, name: str) -> None:
    """The range of the file, limited or full, is undone: black is 0 and white 255."""
    pictures = moving(4)
    for picture in pictures:
        picture[:16, :32], picture[:16, 32:64] = 0, 255
    options = {"libx265": {"x265-params": "crf=5:log-level=none"}, "libx264": {"crf": "5"}, "libvpx-vp9": {"crf": "5"},
               "mpeg2video": {"qmin": "1", "qmax": "2"}}  # fmt: skip
    path = encode(tmp_path / name, pictures, codec, pix, **options.get(codec, {}))
    told: list[Event] = []
    frames = list(open_sequence(path, SequenceOptions(camera="PINHOLE,50,50,48,32"), Events(told.append)).frames())
    assert len(frames) == 4
    for frame, picture in zip(frames, pictures, strict=True):
        assert np.abs(frame.images[0] - gray(picture)).mean() < 4
        assert frame.images[0][4:12, 4:28].mean() < 3
        assert frame.images[0][4:12, 36:60].mean() > 252
    times = np.array([frame.timestamp_s for frame in frames])
    np.testing.assert_allclose(times - times[0], np.arange(4) / 25, atol=1e-3)
    assert name == "a.ts" or times[0] == 0
    assert not [event.message for event in told if event.kind == "warned"]


@pytest.mark.parametrize("ending", ["mp4", "mkv", "ts"])
@pytest.mark.parametrize("start_ms", [0, 5000, 600_000, 1_714_564_797_000])
def test_times_are_as_the_container_has_them(tmp_path: Path, ending: str, start_ms: int) -> None:
    """Of a variable rate and of a clock that begins late, and no talk of an early end."""
    if ending == "ts" and start_ms > 10**6:
        pytest.skip("its clock has 33 bits")
    steps = np.random.default_rng(1).choice([33, 66, 100, 250], 29)
    pts = start_ms + np.concatenate([[0], np.cumsum(steps)])
    path = encode(tmp_path / f"v.{ending}", moving(30), pts=pts)
    told: list[Event] = []
    sequence = open_sequence(path, SequenceOptions(camera="PINHOLE,50,50,48,32"), Events(told.append))
    times, elapsed = np.array([[frame.timestamp_s, frame.elapsed_s] for frame in sequence.frames()]).T
    if ending == "mkv":  # in whole milliseconds
        assert elapsed.tolist() == [float(Fraction(int(t - pts[0]), 1000)) for t in pts]
    if ending == "ts":  # the muxer leaves time for the buffer of a player before the first frame
        times -= times[0] - pts[0] / 1000
    np.testing.assert_allclose(times, pts / 1000, rtol=0, atol=2e-4)
    assert sequence.num_frames == 30
    assert sequence.frames_per_second == pytest.approx(29 / (times[-1] - times[0]), rel=0.06)
    assert not [event.message for event in told if event.kind == "warned"]


@pytest.mark.parametrize("ending", ["mkv", "ts"])
def test_a_file_without_an_index_that_was_cut_off(tmp_path: Path, ending: str) -> None:
    told: list[Event] = []
    path = encode(tmp_path / f"v.{ending}", moving(50, 5), pts=5000 + 40 * np.arange(50), g="5")
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    sequence = open_sequence(path, SequenceOptions(camera="PINHOLE,50,50,48,32"), Events(told.append))
    assert 20 < len(list(sequence.frames())) < 40
    if ending == "mkv":  # a transport stream does not say how long it is
        assert any("the video ends here, after 1." in event.message for event in told if event.kind == "warned")


def test_damage_in_the_middle_costs_the_frames_it_hits(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.avi", moving(30), "mjpeg", "yuvj420p")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(200)
    path.write_bytes(data)
    frames = list(open_sequence(path, SequenceOptions(camera="PINHOLE,50,50,48,32"), Events()).frames())
    assert len(frames) >= 25
    assert np.abs(frames[-1].images[0] - gray(moving(30)[-1])).mean() < 8


# linear part of the display matrix (a, b, c, d) and what it does to the picture
TURNS = {
    (1, 0, 0, 1): lambda p: p, (0, 1, -1, 0): lambda p: np.rot90(p, -1), (-1, 0, 0, -1): lambda p: np.rot90(p, 2),
    (0, -1, 1, 0): np.rot90, (-1, 0, 0, 1): np.fliplr, (1, 0, 0, -1): np.flipud,
    (0, 1, 1, 0): lambda p: p.swapaxes(0, 1),
}  # fmt: skip


@pytest.mark.parametrize("turn", TURNS)
def test_every_display_matrix(tmp_path: Path, turn: tuple[int, int, int, int]) -> None:
    picture = moving(1)[0]
    path = encode(tmp_path / "v.mp4", moving(3), crf="5")
    data = bytearray(path.read_bytes())
    at, (a, b, c, d) = data.index(b"tkhd") + 4 + 40, turn
    data[at : at + 36] = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    shown = TURNS[turn](picture)
    camera = f"PINHOLE,50,50,{shown.shape[1] / 2},{shown.shape[0] / 2}"
    frame = next(iter(open_sequence(path, SequenceOptions(camera=camera), Events()).frames()))
    assert np.abs(frame.images[0] - gray(np.ascontiguousarray(shown))).mean() < 4


def test_what_holds_no_pictures(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 4096), "f4"), format="fltp", layout="mono")
        sound.sample_rate = 44100
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    with pytest.raises(InputError, match="expected a video with pictures, found audio") as caught:
        open_sequence(tmp_path / "a.mp4", PINHOLE, Events())
    assert caught.value.advice
    # a playlist may not fetch anything
    (tmp_path / "list.m3u8").write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n")
    with pytest.raises(InputError, match="expected a video"):
        open_sequence(tmp_path / "list.m3u8", PINHOLE, Events())


def test_a_stream_is_read_as_it_comes(tmp_path: Path) -> None:
    encode(tmp_path / "v.ts", moving(10), "mpeg2video")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            source = f"http://127.0.0.1:{server.server_port}/v.ts"
            sequence = open_sequence(source, SequenceOptions(camera="PINHOLE,50,50,48,32"), Events())
            assert sequence.num_frames is None
            times = [frame.timestamp_s for frame in sequence.frames()]
        finally:
            server.shutdown()
            thread.join()
    assert len(times) == 10
    assert (np.diff(times) > 0).all()


def test_streams_are_known_by_their_names() -> None:
    assert all(map(is_stream, ("rtsp://10.0.0.2/live", "http://host/v.mjpg", "camera:0", "/dev/video2")))
    assert not any(map(is_stream, ("video.mp4", "/data/camera", "C:/videos", "file:///etc/passwd", "concat:a|b")))
