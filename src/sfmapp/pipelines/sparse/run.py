"""State of a reconstruction under way."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sfmapp.images.load import Images
from sfmapp.report.model import Stages
from sfmapp.viewer.listener import RecordingListener
from sfmapp.workspace.job import Job

if TYPE_CHECKING:
    from sfmapp.formats.control_points import ControlPoints
    from sfmapp.georeference.poses.stage import PoseFile
    from sfmapp.georeference.world_frame import Georeference
    from sfmapp.images.image_set import ImageSet
    from sfmapp.pipelines.sparse.known_lengths import KnownLength
    from sfmapp.scene.correspondences import Correspondences
    from sfmapp.scene.features import Features


@dataclass(kw_only=True)
class Run(Job):
    """State of a reconstruction under way.

    Attributes:
        images: what was given to reconstruct.
        recorder: watches the run for a recording; None if none is wanted.
        image_set, features, correspondences: results so far.
        stages: what each stage has said.
        control: ground control points that it was given; known: lengths; poses: of photographs.
        georeference: where models lie in the world; None where they do not.
    """

    images: Images
    recorder: RecordingListener | None = None
    image_set: ImageSet | None = None
    features: list[Features] = field(default_factory=list)
    correspondences: Correspondences | None = None
    stages: Stages = field(default_factory=Stages)
    control: ControlPoints | None = None
    known: list[KnownLength] = field(default_factory=list)
    poses: PoseFile | None = None
    georeference: Georeference | None = None
