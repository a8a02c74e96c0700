"""State of an odometry run under way, and who looks at it."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sfmapp.pipelines.odometry.live import GrowingTrajectories, LatencyLog
from sfmapp.pipelines.odometry.timing import FrameLog, ThreadTimes
from sfmapp.report.model import OdometryStages
from sfmapp.viewer.live import LiveView, Screen
from sfmapp.workspace.job import Job

if TYPE_CHECKING:
    from sfmapp.images.sequence import Sequence
    from sfmapp.pipelines.odometry.scale import ScaleRequest

GIVEN_UP = "given up, for the disk is full, and the results matter more"


@dataclass(kw_only=True)
class Tracking(Job):
    """State of an odometry run under way.

    Attributes:
        scale_request: what the unit of length is to come from; None: an arbitrary one will do.
        frames: what was told of each frame.
        latencies: how old poses of a live source were.
        threads_cpu: CPU time by thread.
        live: draws what happens; None if nobody looks.
        sequence: once it is open.
        stages: what each part has said.
    """

    scale_request: ScaleRequest | None
    frames: FrameLog = field(default_factory=FrameLog)
    latencies: LatencyLog = field(default_factory=LatencyLog)
    threads_cpu: ThreadTimes = field(default_factory=ThreadTimes)
    live: LiveView | None = None
    sequence: Sequence | None = None
    stages: OdometryStages = field(default_factory=OdometryStages)

    def listen_in(self, record: bool, screen: Screen | None) -> None:
        """Let everybody listen who looks at a run while it is under way: ``recording.rrd`` and a viewer, if wanted."""
        if record or screen:
            view = LiveView(self.workspace.recording if record else None, screen)
            self.live = self.until_end.enter_context(view)
        growing = GrowingTrajectories(self.workspace.folder, self.events, self.make_room)
        self.until_end.enter_context(closing(growing))
        self.listen(growing, first=True)  # whatever happens next, this pose is on the disk
        for listener in (self.frames, self.latencies, self.live):
            self.listen(listener)

    def make_room(self) -> bool:
        """See :meth:`Job.make_room`; a recording under way is one as well, and its end will be told as such."""
        is_under_way = self.live is not None and self.live.is_recording and self.live.give_up(GIVEN_UP)
        return super().make_room() or is_under_way
