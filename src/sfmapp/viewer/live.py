"""Shows an odometry run while it is under way, and records it: the end that stays with the run.

Everything is drawn by a child process (:mod:`sfmapp.viewer.live_process`), which is sent what happens through a pipe by
a thread of its own. Tracking never waits for it: when the child falls behind, images are left out, then tracked points,
and only a child that reads nothing at all is given up.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Event
from sfmapp.geometry import rigid3
from sfmapp.images.addresses import without_credentials
from sfmapp.odometry.result import FrameState
from sfmapp.odometry.snapshot import BeliefState, FrameSnapshot, MapSnapshot
from sfmapp.packages import MissingPackageError, require
from sfmapp.viewer.listener import MAX_MESSAGES
from sfmapp.viewer.messages import write_message

if TYPE_CHECKING:
    from sfmapp.images import sequence as sequences
    from sfmapp.odometry.result import OdometryResult

Array = NDArray[np.float64]

# What may wait for the child: images go first, then tracked points, then the child.
MAX_IMAGE_BYTES, MAX_POINT_BYTES, MAX_BYTES = 1 << 25, 1 << 26, 1 << 28
# Frames of a recording that are shown with their image: every one of a thousand, every second of two thousand.
MAX_IMAGES = 1000
_COLOURS = re.compile(r"\x1b\[[\d;]*m")  # of rerun's messages
_LEVELS = {"decided": "INFO", "warned": "WARN"}
# the child opens rerun (seconds on a busy machine) and, at the end, writes what still waits
END_TIMEOUT_S = 300.0


@dataclass(frozen=True)
class Screen:
    """Where a live run is shown: the address that rerun's viewer receives data on."""

    url: str


def thinned_stride(frame_number: int, num_frames: int | None) -> int:
    """Every n-th frame is shown with its image, so that a recording of any length stays modest.

    Of a sequence of unknown length the first thousand, then every second of as many more, then every fourth.
    """
    if num_frames is not None:
        return max(1, -(-num_frames // MAX_IMAGES))
    return 1 << max(0, (frame_number // MAX_IMAGES).bit_length())


def _title(source: str) -> str:
    """A stream without its passwords; of a path the last part."""
    return without_credentials(source) if "://" in source else os.path.basename(os.path.abspath(source)) or source


class LiveView:
    """Listener of a run; a context manager that ends its child in any case."""

    def __init__(self, recording: Path | None, screen: Screen | None) -> None:
        self._recording, self._screen = recording, screen
        self._send_queue: SendQueue | None = None
        self._num_frames: int | None = None
        self._count = self._num_messages = 0
        self._with_next_frame: list[dict[str, Any]] = []
        self._problem = ""
        self._has_belief = False

    @property
    def is_recording(self) -> bool:
        return self._recording is not None

    def begin(self, sequence: sequences.Sequence) -> None:
        """Start the child, which first learns what will be played."""
        try:
            require("rerun")
        except MissingPackageError as missing:
            self._problem = f"{missing}: {missing.advice}"
            return
        camera = sequence.rig.cameras[0]
        self._num_frames = sequence.num_frames
        ground_truth = sequence.ground_truth
        command = [
            sys.executable, "-P", "-m", "sfmapp.viewer.live_process",
            str(self._recording.absolute()) if self._recording else "", self._screen.url if self._screen else "",
        ]  # fmt: skip
        self._send_queue = SendQueue(command)
        self._send(
            "begin", title=_title(sequence.source), camera=camera,
            ground_truth_times=None if ground_truth is None else ground_truth.timestamps_s,
            ground_truth_cam_from_world=None if ground_truth is None else ground_truth.cam_from_world,
            is_metric=sequence.rig.is_stereo, orientation=sequence.orientation,
        )  # fmt: skip

    def __call__(self, event: Event) -> None:
        if self._send_queue is None:
            return
        snapshot = event.data.get("snapshot")
        if isinstance(snapshot, FrameSnapshot):
            self._send_frame(snapshot)
        # what is decided at a frame is told before the frame, but drawn with it
        elif isinstance(snapshot, MapSnapshot):
            self._with_next_frame.append({"kind": "map", **_map_message(snapshot)})
        if event.kind in _LEVELS and event.message and self._num_messages < MAX_MESSAGES:
            self._num_messages += 1
            text = f"{event.stage}: {event.message}"
            self._with_next_frame.append({"kind": "log", "level": _LEVELS[event.kind], "text": text})

    def end(self, result: OdometryResult, ground_truth_from_map: Sequence[Array | None], errors_m: Array) -> str:
        """Show the final result and close; returns what went wrong, empty for nothing.

        Args:
            ground_truth_from_map: (8,) similarity of each map, None for one that has too little in common with the
                ground truth; empty without ground truth.
            errors_m: (F,) distance of each frame from the ground truth, NaN where it is not known.
        """
        if self._send_queue is None:
            return self._problem
        self._send_decisions()
        self._send(
            "end", frame_idx=result.frame_idx, timestamps_s=result.timestamps_s, frame_map=result.frame_map,
            cam_from_world=result.cam_from_world, ground_truth_from_map=list(ground_truth_from_map), errors=errors_m,
            maps=_final_maps(result),
        )  # fmt: skip
        outbox, self._send_queue = self._send_queue, None
        return outbox.close(END_TIMEOUT_S)

    def give_up(self, problem: str) -> bool:
        """End the child and take away what it has recorded so far; whether there was one."""
        if self._send_queue is None:
            return False
        self._problem = problem
        self._stop()
        return True

    def __enter__(self) -> LiveView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._send_queue is not None:
            self._send_queue.abandon()
            self._send_queue = None
        if self._recording is not None:  # of a child that was ended, now or for want of time
            for unfinished in self._recording.parent.glob(f".{self._recording.name}.*.part"):
                unfinished.unlink(missing_ok=True)

    def _send_frame(self, seen: FrameSnapshot) -> None:
        assert self._send_queue is not None
        stride = thinned_stride(self._count, self._num_frames)
        is_shown = self._count % stride == 0
        self._count += 1
        waiting = self._send_queue.num_bytes
        image = seen.image if is_shown and waiting < MAX_IMAGE_BYTES else None
        # what was tracked before a loss is not tracked any more
        is_lost = seen.state == FrameState.LOST
        has_points = is_shown and waiting < MAX_POINT_BYTES and not is_lost
        self._send(
            "frame", frame_idx=seen.frame_idx, timestamp_s=seen.timestamp_s, state=int(seen.state), image=image,
            xy=seen.xy if has_points else None, is_mapped=seen.is_mapped if has_points else None,
            num_tracked=0 if is_lost else len(seen.xy),
            num_mapped=0 if is_lost else int(np.count_nonzero(seen.is_mapped)), map_idx=seen.map_idx,
            cam_from_world=seen.cam_from_world, cpu_s=seen.cpu_s,
        )  # fmt: skip
        if seen.belief is not None:
            self._send("belief", **_belief_message(seen.belief, with_landmarks=not self._has_belief))
            self._has_belief = True
        self._send_decisions()

    def _send_decisions(self) -> None:
        assert self._send_queue is not None
        for message in self._with_next_frame:
            self._send_queue.put(message)
        self._with_next_frame.clear()

    def _send(self, kind: str, **content: Any) -> None:
        assert self._send_queue is not None
        self._send_queue.put({"kind": kind, **content})


def _belief_message(seen: BeliefState, *, with_landmarks: bool) -> dict[str, Any]:
    return {
        "center": rigid3.center(seen.pose).astype(np.float32),
        "weight": seen.weight.astype(np.float32),
        "mode": seen.mode,
        "probability": seen.probability,
        "best": seen.best,
        "decided": seen.decided,
        "not_in_map": seen.not_in_map,
        "point_xyz": seen.point_xyz.astype(np.float32) if with_landmarks else None,
    }


def _map_message(seen: MapSnapshot) -> dict[str, Any]:
    return {
        "frame_idx": seen.frame_idx,
        "map_idx": seen.map_idx,
        "keyframe_frame_idx": seen.keyframe_frame_idx,
        "keyframe_cam_from_world": seen.keyframe_cam_from_world,
        "point_id": seen.point_id,
        "point_xyz": np.asarray(seen.point_xyz, np.float32),
        "is_complete": seen.is_complete,
    }


def _final_maps(result: OdometryResult) -> list[dict[str, Any]]:
    maps = []
    for entry in result.maps:
        model = entry.reconstruction
        kept = np.flatnonzero(model.is_triangulated)
        maps.append(
            {
                "keyframe_cam_from_world": model.cam_from_world[entry.keyframe_image_idx],
                "point_xyz": model.point_xyz[kept].astype(np.float32),
                "point_rgb": model.point_rgb[kept],
                "unit": "" if entry.scale_source == "none" else "m",
            }
        )
    return maps


# ------------------------------------------------------------------------------------------------------------- the pipe


class SendQueue:
    """Messages on their way to a child's standard input: dicts of plain values and arrays."""

    def __init__(self, command: Sequence[str]) -> None:
        # a session of its own: a Ctrl-C in the terminal is for the run, which then tells the child how it ended
        self._child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
        )
        self._waiting: deque[dict[str, Any] | None] = deque()
        self._changed = threading.Condition()
        self._error_text: list[bytes] = []
        self._has_failed = False
        self.num_bytes = 0
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True)
            for work, name in ((self._write_all, "recording_0"), (self._read_errors, "recording_1"))
        ]
        for thread in self._threads:
            thread.start()

    def put(self, message: dict[str, Any]) -> None:
        """Send a message when the child has time; never waits."""
        with self._changed:
            if self._has_failed:
                return
            self._waiting.append(message)
            self.num_bytes += _size(message)
            if self.num_bytes > MAX_BYTES:
                self._give_up()
            self._changed.notify()

    def close(self, timeout_s: float) -> str:
        """Let the child finish; returns what went wrong, empty for nothing."""
        with self._changed:
            self._waiting.append(None)
            self._changed.notify()
        self._threads[0].join(timeout_s)
        try:
            code = self._child.wait(0.0 if self._threads[0].is_alive() else timeout_s)
        except subprocess.TimeoutExpired:
            self.abandon()
            return f"not finished after {timeout_s:g} s"
        self._threads[1].join(timeout_s)
        if code == 0 and not self._has_failed:
            return ""
        lines = _COLOURS.sub("", b"".join(self._error_text).decode(errors="replace")).strip().splitlines()
        return f"exit code {code}: {lines[-1] if lines else 'it could not keep up'}"

    def abandon(self) -> None:
        """End the child at once."""
        with self._changed:
            self._give_up()
            self._changed.notify()
        for thread in self._threads:
            thread.join(10.0)

    def _give_up(self) -> None:
        self._has_failed = True
        self._waiting.clear()
        self._waiting.append(None)
        self.num_bytes = 0
        self._child.kill()

    def _write_all(self) -> None:
        assert self._child.stdin is not None
        try:
            while (message := self._next()) is not None:
                write_message(self._child.stdin.fileno(), message)
            self._child.stdin.close()
        except OSError:  # the child has died; how is asked for at the end
            with self._changed:
                self._has_failed = True
                self._waiting.clear()

    def _next(self) -> dict[str, Any] | None:
        with self._changed:
            while not self._waiting:
                self._changed.wait()
            message = self._waiting.popleft()
            self.num_bytes -= 0 if message is None else _size(message)
            return message

    def _read_errors(self) -> None:
        assert self._child.stderr is not None
        while data := os.read(self._child.stderr.fileno(), 1 << 14):
            self._error_text = [*self._error_text[-3:], data]
        self._child.wait()


def _size(message: dict[str, Any]) -> int:
    return 200 + sum(value.nbytes for value in message.values() if isinstance(value, np.ndarray))
