"""What the steps of one run share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from sfmapp.events import Events
from sfmapp.pipelines.listeners import DecisionLog
from sfmapp.pipelines.options import Options
from sfmapp.pipelines.usage import Stopwatch
from sfmapp.pipelines.workspace import Workspace
from sfmapp.viewer.listener import RecordingListener

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.scene.correspondences import Correspondences
    from sfmapp.scene.features import Features


@dataclass
class Run:
    """State of a reconstruction under way.

    Attributes:
        source: what the user gave as images.
        threads: workers.
        recorder: watches the run for a recording; None if none is wanted.
        usage: wall and CPU seconds and peak memory of each stage, by name.
        stages: the report of each stage, by name.
        image_set, features, correspondences: results so far.
    """

    source: str
    workspace: Workspace
    options: Options
    events: Events
    watch: Stopwatch
    log: DecisionLog
    threads: int
    recorder: RecordingListener | None
    usage: dict[str, dict[str, Any]] = field(default_factory=dict)
    stages: dict[str, Any] = field(default_factory=dict)
    image_set: ImageSet | None = None
    features: list[Features] = field(default_factory=list)
    correspondences: Correspondences | None = None
    started: datetime = field(default_factory=lambda: datetime.now(UTC))

    @contextmanager
    def stage(self, name: str, key: str | None = None) -> Iterator[None]:
        """Measure a step; with a key, note in the manifest when it begins and ends. Obeys a wish to stop."""
        self.events.raise_if_cancelled()
        watch = Stopwatch()
        if key is not None:
            self.workspace.begin(name, key)
        yield
        self.usage[name] = watch.read()
        if key is not None:
            self.workspace.finish(name, self.usage[name])
