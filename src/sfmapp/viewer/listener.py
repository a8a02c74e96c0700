"""Watches a run and remembers what a recording of it needs, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Event
from sfmapp.mapping.snapshot import ModelSnapshot

# What is kept of a run of any length: with these, poses of 1000 images take 7 MB and clouds 10 MB.
MAX_CLOUDS = 40
MAX_CLOUD_POINTS = 15_000
MAX_POSES = 250
MAX_MESSAGES = 5000

_LEVELS = {"decided": "INFO", "finished": "DEBUG", "warned": "WARN"}


@dataclass(frozen=True)
class Step:
    """One decision of the mapper that changed the map.

    Attributes:
        step: number of the decision, ascending.
        image_idx: images registered by it.
        num_registered, num_points, mean_error_px: the map after it.
        cam_from_world: (I, 7) float32, NaN where unregistered; None where it was not kept.
        point_track_idx: (K,) int32 and point_xyz: (K, 3) float32, a sample of the points; None where not kept.
    """

    step: int
    image_idx: tuple[int, ...]
    num_registered: int
    num_points: int
    mean_error_px: float
    cam_from_world: NDArray[np.float32] | None = None
    point_track_idx: NDArray[np.int32] | None = None
    point_xyz: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Message:
    """A line of the log: the step it belongs to (-1: before the first), its level as rerun names it, and its text."""

    step: int
    level: str
    text: str


class RecordingListener:
    """Collects the snapshots of mapping and all messages; subscribe it to the Events of a run.

    Arrays are copied in part, never kept. When there are more than fit, the steps that remain are spread geometrically:
    much happens in the first ones, and each later one changes less.
    """

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.messages: list[Message] = []
        self._priority: NDArray[np.int32] | None = None

    def __call__(self, event: Event) -> None:
        if isinstance(snapshot := event.data.get("snapshot"), ModelSnapshot):
            self._add(snapshot)
        if event.kind in _LEVELS and event.message and len(self.messages) < MAX_MESSAGES:
            step = self.steps[-1].step if self.steps else -1
            text = f"[{event.time_s:7.2f} s] {event.stage}: {event.message}"
            self.messages.append(Message(step, _LEVELS[event.kind], text))

    def _add(self, snapshot: ModelSnapshot) -> None:
        track_idx, xyz = self._sample(snapshot.point_xyz)
        self.steps.append(
            Step(
                self.steps[-1].step + 1 if self.steps else 0, snapshot.image_idx, snapshot.num_registered,
                snapshot.num_points, snapshot.mean_error_px, snapshot.cam_from_world.astype(np.float32), track_idx, xyz,
            )
        )  # fmt: skip
        self._thin(lambda s: s.point_xyz is not None, MAX_CLOUDS, point_track_idx=None, point_xyz=None)
        # clouds are drawn among the cameras of their step, so those keep their poses
        self._thin(
            lambda s: s.cam_from_world is not None and s.point_xyz is None, MAX_POSES - MAX_CLOUDS, cam_from_world=None
        )

    def _sample(
        self, point_xyz: NDArray[np.float32] | None
    ) -> tuple[NDArray[np.int32] | None, NDArray[np.float32] | None]:
        """Up to MAX_CLOUD_POINTS points that exist, the same ones every time as far as they do."""
        if point_xyz is None:
            return None, None
        present = np.flatnonzero(~np.isnan(point_xyz[:, 0]))
        if len(present) > MAX_CLOUD_POINTS:
            if self._priority is None or len(self._priority) != len(point_xyz):
                self._priority = np.random.default_rng(0).permutation(len(point_xyz)).astype(np.int32)
            chosen = np.argpartition(self._priority[present], MAX_CLOUD_POINTS)[:MAX_CLOUD_POINTS]
            present = np.sort(present[chosen])
        return present.astype(np.int32), np.asarray(point_xyz[present], np.float32)

    def _thin(self, holds: Callable[[Step], bool], limit: int, **without: None) -> None:
        """Take the arrays from one step if more than limit hold them: the one that leaves the smallest relative gap."""
        held = [k for k, step in enumerate(self.steps) if holds(step)]
        if len(held) <= limit:
            return
        gaps = [math.log((after + 2) / (before + 1)) for before, after in zip(held[:-2], held[2:], strict=True)]
        k = held[1 + int(np.argmin(gaps))]
        self.steps[k] = replace(self.steps[k], **without)  # type: ignore[arg-type]
