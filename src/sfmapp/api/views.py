"""One call: two photographs explained, or matched in every pixel; two in the place of a third; and models without a
calibration."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sfmapp.api.jobs import FilePath, options_with
from sfmapp.events import Events
from sfmapp.images.load import Images
from sfmapp.workspace.options import Options

if TYPE_CHECKING:
    from sfmapp.pipelines.pair import PairResult
    from sfmapp.pipelines.stereo.run import StereoResult
    from sfmapp.pipelines.stereo.sources import ChosenPairs, KnownCameras
    from sfmapp.pipelines.transfer import TransferResult
    from sfmapp.pipelines.uncalibrated import UncalibratedResult


def explain_pair(
    sources: Sequence[FilePath],
    output: FilePath | None = None,
    options: Options | None = None,
    *,
    events: Events | None = None,
) -> PairResult:
    """Tell why two photographs give a reconstruction, or why not, from their keypoints to the choice of the pose.

    Args:
        sources: two photographs; or the output folder of :func:`reconstruct` and the names of two of its images, whose
            features, matches and cameras are then used.
        output: a new folder, an empty one, or that of an earlier call; None: in that folder, ``pairs/NAME--NAME``.
        options: those of images, features, matching and seed; a reconstruction's own are used where there is one.
        events: told of progress, and can ask to stop.

    Returns:
        The folder, the report, and the story with matches, F, E and H, the four poses and the kind of pair.

    Raises:
        UsageError: another number of sources, no output for photographs, or one that holds something else.
        InputError: photographs that are not there or cannot be used, or a lens without a fundamental matrix.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> told = sfmapp.explain_pair(["left.jpg", "right.jpg"], "story/")
        >>> told.report.story.kind, told.report.story.kind_reason
    """
    from sfmapp.pipelines.pair import tell_pair

    return tell_pair(sources, output, options, events=events)


def match_stereo(
    sources: Sequence[FilePath],
    output: FilePath | None = None,
    options: Options | None = None,
    *,
    camera: FilePath | KnownCameras | None = None,
    chosen: ChosenPairs | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> StereoResult:
    """Rectify pairs of photographs, match every pixel, and measure depths and how far off they may be.

    Args:
        sources: two photographs; two folders, whose files belong together by name; a folder of KITTI; a video with both
            pictures side by side; or the output folder of :func:`reconstruct`.
        output: a new folder, an empty one, or that of an earlier call; of several pairs, each gets a folder in it.
            None, for a reconstruction alone: its folder ``stereo``.
        options: of these, ``stereo``.
        camera: file of a calibration of both cameras, or ``sfmapp.pipelines.stereo.sources.KnownCameras`` with focal
            length and baseline of a rectified pair; None: nothing is known, and there are disparities and no depths.
        chosen: ``sfmapp.pipelines.stereo.sources.ChosenPairs``: which of many pairs; None: all of folders and videos,
            the best one of a reconstruction.
        events: told of progress, and can ask to stop.
        threads: bands of rows measured at a time; None: as ``options.threads`` says, or one for each core.

    Returns:
        The folder, the report of all pairs, and ``last``, the arrays of the last: ``last.prepared.pair`` the rectified
        pictures, ``last.disparity.disparity`` (H, W) pixels, ``last.measured.depth`` and ``last.measured.depth_sigma``
        (H, W) in the unit of the baseline, NaN where unknown.

    Raises:
        UsageError: sources that are none, or an output that holds something else.
        InputError: photographs or a calibration that cannot be used; of several pairs, all of them.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> found = sfmapp.match_stereo(["left.jpg", "right.jpg"], "depth/", camera="rig/rig.json")
        >>> found.last.measured.depth.shape, found.report.pairs[0].measured.median_sigma_px
    """
    from sfmapp.pipelines.stereo.run import stereo
    from sfmapp.pipelines.stereo.sources import KnownCameras

    known = camera if isinstance(camera, KnownCameras) or camera is None else KnownCameras(os.fspath(camera))
    return stereo(sources, output, options_with(options, threads), known=known, chosen=chosen, events=events)


def transfer_views(
    photographs: Sequence[FilePath],
    output: FilePath,
    options: Options | None = None,
    *,
    events: Events | None = None,
) -> TransferResult:
    """Transfer points, and a whole photograph, of two views into a third, with no calibration.

    Args:
        photographs: three files: two that are transferred, and the third.
        output: a new folder, an empty one, or that of an earlier call.
        options: those of images, features, matching and seed.
        events: told of progress, and can ask to stop.

    Returns:
        The folder, the synthesised photograph, the report, and ``views`` with the cameras (3, 3, 4) of a projective
        frame, the trifocal tensor (3, 3, 3) and the points.

    Raises:
        UsageError: not three photographs, one given twice, or an output that holds something else.
        InputError: photographs that are not there or cannot be used.
        NoReconstructionError: too little in common, copies of one picture, a plane, or a camera that only turned.
        InterruptedRunError: ``events`` was asked to stop.
    """
    from sfmapp.pipelines import transfer as pipeline

    return pipeline.transfer_views(photographs, output, options, events=events)


def reconstruct_uncalibrated(
    images: Images,
    output: FilePath,
    options: Options | None = None,
    *,
    points: FilePath | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> UncalibratedResult:
    """Reconstruct photographs in a projective frame, and make it metric by known points or one camera.

    Args:
        images: as of :func:`reconstruct`.
        output: a new folder, an empty one, or that of an earlier call.
        options: those of images, features, pairs, matching, seed and threads.
        points: file of known points and where photographs show them, as of ``reconstruct --gcp``; None: one camera with
            square pixels and its principal point in the middle is looked for.
        events: told of progress, and can ask to stop.
        threads: photographs worked on at a time; None: as ``options.threads`` says, or one for each core.

    Returns:
        The folder, the report, the projective model with cameras (V, 3, 4) and points (N, 4), and the metric one or the
        frame of the known points; both None where the photographs do not tell one.

    Raises:
        UsageError: an output that holds something else.
        InputError: no photographs, or known points that cannot be read.
        NoReconstructionError: the pixels do not tell a projective model, or the known points not its frame.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> found = sfmapp.reconstruct_uncalibrated("photos/", "open/")
        >>> found.projective.model.cameras.shape, found.report.refused
    """
    from sfmapp.pipelines import uncalibrated as pipeline

    return pipeline.reconstruct_uncalibrated(
        images, output, options_with(options, threads), points=points, events=events
    )
