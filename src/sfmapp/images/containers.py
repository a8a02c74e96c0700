"""Frames out of containers (MP4, Matroska, AVI, MPEG and whatever else FFmpeg knows), by way of PyAV.

Decoding is FFmpeg's own in software, so that a file gives the same pixels everywhere. Fields that were recorded one
after another (interlaced video) are made whole frames by FFmpeg's ``bwdif``, at the time of the first of the two.
"""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.images.addresses import check_address, without_credentials
from sfmapp.images.frame_reader import LARGEST_FRAME_PX
from sfmapp.images.sources import printable

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream

Pixels = NDArray[np.uint8]

_TIMEOUT_S = 15.0
# What a file may make FFmpeg open: playlists and concatenations name other places.
_PROTOCOLS_OF_FILES = "file,crypto,data"
_PROTOCOLS_OF_STREAMS = "http,https,httpproxy,tcp,tls,udp,rtp,rtsp,rtmp,rtmps,rtmpt,srt,crypto,data"
# Packets that are decoded to find a first frame: streams are tuned in to between two key frames.
_PACKETS_TO_FIRST_FRAME = 1000
# Beyond that, reading a file to count its frames takes longer than the number is worth.
_LARGEST_COUNTED_BYTES = 1 << 32
_ADVICE = "try to play it, or convert it: ffmpeg -i VIDEO -c:v libx264 video.mp4"
_FULL_RANGE = 2
# Formats whose first plane is the luma, in 8 bits or in 16 with the low byte first.
_WITH_LUMA = re.compile(r"gray((9|1[0246])le)?|yuv[aj]?4\d\dp((9|1[0246])le)?|nv(12|16|21|24|42)|p01[026]le")


@dataclass(frozen=True)
class VideoFacts:
    """What a video says of itself.

    Attributes:
        width, height: size in pixels once turned upright.
        fps: mean number of frames a second.
        num_frames: as the header says, or as packets were counted where it does not.
        end_s: time at which the header says that the last frame ends.
        Each None for unknown.
    """

    width: int
    height: int
    fps: float | None
    num_frames: int | None
    end_s: float | None = None


@dataclass(frozen=True)
class DecodedFrame:
    """A frame that may yet be turned into pixels, its time in seconds as the container has it (None: it has none), and
    how it is stored: see :func:`gray_of`."""

    frame: VideoFrame
    time_s: Fraction | None
    turn: tuple[bool, bool, bool]


@dataclass(frozen=True)
class Damaged:
    """A packet that holds no frame that can be decoded."""


def shown(source: str) -> str:
    """A source as messages name it."""
    return without_credentials(printable(source))


def open_container(source: str, *, is_stream: bool) -> InputContainer:
    """An opened file or URL. Raises InputError: it holds no video, or frames too large to be decoded."""
    import av

    if is_stream:
        check_address(source)
    protocols = _PROTOCOLS_OF_STREAMS if is_stream else _PROTOCOLS_OF_FILES
    options = {"protocol_whitelist": protocols}
    if source.lower().startswith("rtsp"):
        options["rtsp_transport"] = "tcp"  # datagrams that are lost leave holes in frames
    name = source if is_stream else f"file:{source}"  # a name with a colon in it names no protocol
    timeout = (_TIMEOUT_S, _TIMEOUT_S) if is_stream else None
    try:
        container = av.open(name, options=options, timeout=timeout, metadata_errors="replace")
    except (av.FFmpegError, OSError, ValueError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{shown(source)}: expected a video that FFmpeg can read, found none: {reason}", _ADVICE
        ) from None
    problem = _problem_of(container)
    if problem:
        container.close()
        raise InputError(f"{shown(source)}: {problem}", _ADVICE)
    stream = best_stream(container)
    stream.thread_type = "AUTO"
    # later frames may claim another size than the header
    stream.codec_context.options = {"max_pixels": str(LARGEST_FRAME_PX)}
    return container


def _problem_of(container: InputContainer) -> str:
    """Why no frames can be had of an opened container; empty if they can."""
    if container.streams.best("video") is None:
        found = ", ".join(sorted({stream.type for stream in container.streams})) or "nothing"
        return f"expected a video with pictures, found {found}"
    stream = best_stream(container)
    if stream.codec_context is None:
        return "expected a video that FFmpeg can decode, found one of an unknown codec"
    size = stream.codec_context.width, stream.codec_context.height
    if size[0] * size[1] > LARGEST_FRAME_PX:
        return f"expected frames of at most {LARGEST_FRAME_PX} pixels, found {size[0]}x{size[1]}"
    return ""


def best_stream(container: InputContainer) -> VideoStream:
    """The stream of pictures that FFmpeg would play: no cover art, the largest of several."""
    return cast("VideoStream", container.streams.best("video"))


def read_container_facts(source: str, *, is_stream: bool) -> VideoFacts:
    """Size, rate and length of a video; its first frame is decoded to be sure of its size.

    Raises:
        InputError: it cannot be opened, holds no frame, or its size cannot be believed.
    """
    with closing(open_container(source, is_stream=is_stream)) as container:
        stream = best_stream(container)
        first = None
        for number, item in enumerate(decoded_frames(container)):
            if isinstance(item, DecodedFrame):
                first = item
            if first is not None or number > _PACKETS_TO_FIRST_FRAME:
                break
        if first is None:
            raise InputError(f"{shown(source)}: expected a video with frames, found none that can be decoded", _ADVICE)
        height, width = gray_of(first).shape
        fps, count = _rate(stream.average_rate or stream.guessed_rate), stream.frames or None
        if is_stream:
            return VideoFacts(width, height, fps, None)
        end_s = _end_of(container, stream)
    if count is None:  # Matroska and transport streams do not tell; the rate of Matroska's header is a mere wish
        count, counted_fps = _count_packets(source)
        fps = counted_fps or fps
    return VideoFacts(width, height, fps, count, end_s)


def _rate(rate: Fraction | None) -> float | None:
    return float(rate) if rate and 0.01 <= rate <= 1e4 else None


def _end_of(container: InputContainer, stream: VideoStream) -> float | None:
    if stream.duration is not None and stream.time_base is not None:
        return float(((stream.start_time or 0) + stream.duration) * stream.time_base)
    # Matroska counts both from the beginning of its clock
    tag = str(stream.metadata.get("DURATION", "")).split(":")
    try:
        hours, minutes, seconds = tag
        return 3600 * float(hours) + 60 * float(minutes) + float(seconds)
    except ValueError:
        return container.duration / 1e6 if container.duration else None


def _count_packets(source: str) -> tuple[int | None, float | None]:
    """Number of frames and their mean rate, from the packets: the file is read once, and nothing is decoded; None of a
    file too large for that."""
    import av

    if os.path.getsize(source) > _LARGEST_COUNTED_BYTES:
        return None, None
    count, first, last = 0, None, None
    with closing(open_container(source, is_stream=False)) as container:
        stream = best_stream(container)
        try:
            for packet in container.demux(stream):
                count += packet.size > 0
                if packet.size and packet.pts is not None:
                    first = packet.pts if first is None else min(first, packet.pts)
                    last = packet.pts if last is None else max(last, packet.pts)
        except (av.FFmpegError, OSError):  # it was cut off: what is there counts
            pass
        if first is None or last is None or last == first or stream.time_base is None:
            return count or None, None
        return count or None, _rate((count - 1) / ((last - first) * stream.time_base))


def decoded_frames(container: InputContainer) -> Iterator[DecodedFrame | Damaged]:
    """The frames of a container in the order in which they are shown, deinterlaced; damage in between is told."""
    times: deque[Fraction | None] = deque()
    turns: deque[tuple[bool, bool, bool]] = deque()
    filters = None
    for item in _raw_frames(container):
        if isinstance(item, Damaged):
            yield item
            continue
        time_s = item.pts * item.time_base if item.pts is not None and item.time_base is not None else None
        if filters is None and not item.interlaced_frame:
            yield DecodedFrame(item, time_s, _turn_of(item))
            continue
        if filters is not None and (item.width, item.height, item.format.name) != filters.form:
            yield from _paired(filters.rest(), times, turns)
            filters = None
        times.append(time_s)
        turns.append(_turn_of(item))
        filters = filters or _Deinterlacer(item)
        yield from _paired(filters.push(item), times, turns)
    if filters is not None:
        yield from _paired(filters.rest(), times, turns)


def _paired(
    frames: Iterator[VideoFrame], times: deque[Fraction | None], turns: deque[tuple[bool, bool, bool]]
) -> Iterator[DecodedFrame]:
    for frame in frames:
        yield DecodedFrame(frame, times.popleft(), turns.popleft())


def _raw_frames(container: InputContainer) -> Iterator[VideoFrame | Damaged]:
    import av

    packets = container.demux(best_stream(container))
    # AVI knows when a frame is decoded alone; frames are shown at just these times, whatever their order was
    shown: deque[int] | None = deque() if container.format.name == "avi" else None
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (av.FFmpegError, OSError):  # the file is cut off here, or the connection is gone
            return
        if shown is not None and packet.size and packet.dts is not None:
            shown.append(packet.dts)
        try:
            for frame in packet.decode():
                if shown:
                    frame.pts = shown.popleft()
                yield frame
        except av.FFmpegError:
            if shown:
                shown.popleft()
            yield Damaged()


class _Deinterlacer:
    """``bwdif``: one whole frame for each two fields, one frame late. Frames that are whole already pass."""

    def __init__(self, frame: VideoFrame) -> None:
        from av.filter import Graph

        self.form = (frame.width, frame.height, frame.format.name)
        self._graph = Graph()
        source = self._graph.add_buffer(
            width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base or Fraction(1, 1000)
        )
        nodes = source, self._graph.add("bwdif", "mode=send_frame:deint=interlaced"), self._graph.add("buffersink")
        self._graph.link_nodes(*nodes).configure()
        self._count = 0

    def push(self, frame: VideoFrame) -> Iterator[VideoFrame]:
        """Add a frame; the frames that are done by then."""
        frame.pts = self._count  # the container's may be missing, and need not ascend
        self._count += 1
        self._graph.push(frame)
        return self._done()

    def rest(self) -> Iterator[VideoFrame]:
        """The frames that still are to come behind the last one."""
        self._graph.push(None)
        return self._done()

    def _done(self) -> Iterator[VideoFrame]:
        import av

        while True:
            try:
                yield self._graph.vpull()
            except (av.BlockingIOError, av.EOFError):
                return


def _turn_of(frame: VideoFrame) -> tuple[bool, bool, bool]:
    """Whether to exchange rows and columns, then to mirror left and right, then up and down, to see a frame upright.

    The display matrix (ISO 14496-12, 8.3.2) takes stored to shown pixels: x = a x' + c y', y = b x' + d y'.
    """
    from av.sidedata.sidedata import Type

    side_data: Any = frame.side_data  # a mapping of more keys than its stubs say
    data = side_data.get(Type.DISPLAYMATRIX)
    if data is None:
        return False, False, False
    a, b, _, c, d = np.frombuffer(memoryview(data), "=i4")[:5].tolist()
    return (False, a < 0, d < 0) if abs(a) + abs(d) >= abs(b) + abs(c) else (True, c < 0, b < 0)


def gray_of(decoded: DecodedFrame) -> Pixels:
    """(H, W) uint8, upright: the luma of the full range 0 to 255, or OpenCV's grey of formats without luma."""
    return _upright(_luma(decoded.frame), decoded.turn)


def rgb_of(decoded: DecodedFrame) -> Pixels:
    """(H, W, 3) uint8, upright."""
    return _upright(np.asarray(decoded.frame.to_ndarray(format="rgb24"), np.uint8), decoded.turn)


def _upright(pixels: Pixels, turn: tuple[bool, bool, bool]) -> Pixels:
    is_transposed, is_mirrored, is_upside_down = turn
    pixels = pixels.swapaxes(0, 1) if is_transposed else pixels
    pixels = pixels[:, ::-1] if is_mirrored else pixels
    return np.ascontiguousarray(pixels[::-1] if is_upside_down else pixels)


def _luma(frame: VideoFrame) -> Pixels:
    import cv2

    name = frame.format.name
    if _WITH_LUMA.fullmatch(name) is None:
        luma_of_colors: Pixels = cv2.cvtColor(frame.to_ndarray(format="rgb24"), cv2.COLOR_RGB2GRAY)
        return luma_of_colors
    bits, plane = max(component.bits for component in frame.format.components), frame.planes[0]
    stored: NDArray[Any] = np.frombuffer(memoryview(plane), np.uint8 if bits <= 8 else np.dtype("<u2"))
    luma = stored.reshape(-1, plane.line_size // stored.itemsize)[: frame.height, : frame.width]
    if name.startswith("p0"):
        bits = 16  # P010 and its kin hold theirs in the upper bits
    is_full = name.startswith(("gray", "yuvj")) or frame.color_range == _FULL_RANGE
    if is_full and bits <= 8:
        return luma
    unit = 1 << (bits - 8)
    low, high = (0, 256 * unit - 1) if is_full else (16 * unit, 235 * unit)
    values = (np.arange(256 * unit) - low) * (255.0 / (high - low))
    table = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    stretched: Pixels = cv2.LUT(luma, table) if bits <= 8 else table[luma]
    return stretched
