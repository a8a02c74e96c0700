"""State of a reconstruction under way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.load import GivenImages
from sfmapp.report.model import AddedReport, MergedReport, Stages
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
    from sfmapp.scene.reconstruction import Reconstruction
    from sfmapp.viewer.recording import Drawer


@dataclass(frozen=True)
class Before:
    """What there was before photographs were added.

    Attributes:
        num_images: photographs, which come first.
        pairs: (P, 2) int32 of them that were compared, i < j, sorted.
        models: finished, the largest first.
        is_apart: photographs of one model come to another with it, and not one by one.
    """

    num_images: int
    pairs: NDArray[np.int32]
    models: list[Reconstruction]
    is_apart: bool = False


@dataclass(kw_only=True)
class Run(Job):
    """State of a reconstruction under way.

    Attributes:
        images: what was given to reconstruct.
        recorder: watches the run for a recording; None if none is wanted.
        drawer: has the recording drawn; None: one that is started then.
        image_set, features, correspondences: results so far.
        stages: what each stage has said.
        control: ground control points that it was given; known: lengths; poses: of photographs.
        georeference: where models lie in the world; None where they do not.
        before: what photographs are added to; None where they are all new.
        added: tells what came of those by the models.
        merged: tells the same of a reconstruction that was joined to another one.
        judge: raises NoReconstructionError where the models are not what they should be.
    """

    images: GivenImages
    recorder: RecordingListener | None = None
    drawer: Drawer | None = None
    image_set: ImageSet | None = None
    features: list[Features] = field(default_factory=list)
    correspondences: Correspondences | None = None
    stages: Stages = field(default_factory=Stages)
    control: ControlPoints | None = None
    known: list[KnownLength] = field(default_factory=list)
    poses: PoseFile | None = None
    georeference: Georeference | None = None
    before: Before | None = None
    added: Callable[[Sequence[Reconstruction]], AddedReport] | None = None
    merged: MergedReport | None = None
    judge: Callable[[Sequence[Reconstruction]], None] | None = None
