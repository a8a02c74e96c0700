"""One call: photographs from all sides to a closed volume, and photographs of an object to its masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sfmapp.api.jobs import FilePath, options_with
from sfmapp.events import Events
from sfmapp.workspace.options import Options

if TYPE_CHECKING:
    from sfmapp.pipelines.carve.masks import MasksResult
    from sfmapp.pipelines.carve.run import CarveResult


def carve_volume(
    source: FilePath,
    output: FilePath | None = None,
    options: Options | None = None,
    *,
    images: FilePath | None = None,
    poses: FilePath | None = None,
    box: Sequence[float] | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> CarveResult:
    """Carve a closed volume out of photographs with known cameras, by what their silhouettes leave standing.

    Args:
        source: the output folder of :func:`reconstruct`, a COLMAP model, or a folder of photographs with their cameras
            (``cameras.json``, ``transforms.json``, Middlebury's ``NAME_par.txt``, a file of 3x4 projection matrices).
        output: a new folder, an empty one, or that of an earlier call; None, for a reconstruction or a model alone: its
            folder ``carve``.
        options: of these ``masks``, ``carve``, ``images`` and ``threads``.
        images: folder of the photographs, where the source does not hold them.
        poses: file of poses or projection matrices, where the source does not hold them; ``options.images.camera`` is
            the lens of poses that come without one.
        box: lower x, y, z and upper ones of the box that the object is in, units of the world; None: as the
            silhouettes say.
        events: told of progress, and can ask to stop; the same call then resumes.
        threads: photographs and parts of the volume worked on at a time; None: as ``options.threads`` says, or one for
            each core. Results do not depend on it.

    Returns:
        The folder, the report, ``octree`` (the cells) and ``mesh`` (its closed surface, in colours).

    Raises:
        UsageError: photographs without cameras, or an output that holds something else.
        InputError: photographs, cameras, masks or a box that cannot be used.
        NoReconstructionError: nothing is left of the volume; it says which photographs are to blame.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> found = sfmapp.carve_volume("turntable/", "volume/", sfmapp.load_options(settings=["carve.cells=512"]))
        >>> found.mesh.xyz.shape, found.report.surface.volume, found.octree.volume_bounds()
    """
    from sfmapp.pipelines.carve.run import CarveInput, carve

    what = CarveInput(source, images, poses, None if box is None else tuple(box))
    return carve(what, output, options_with(options, threads), events=events)


def find_masks(
    source: FilePath,
    output: FilePath,
    options: Options | None = None,
    *,
    images: FilePath | None = None,
    poses: FilePath | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> MasksResult:
    """Write masks of an object in photographs, white where it is.

    Args:
        source: as of :func:`carve_volume`, or photographs without cameras.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these ``masks``, ``images`` and ``threads``.
        images, poses: as of :func:`carve_volume`.
        events: told of progress, and can ask to stop.
        threads: photographs at a time; None: as ``options.threads`` says, or one for each core.

    Returns:
        The folder, the report and ``silhouettes``, with distances to outlines to a fraction of a pixel.

    Raises:
        UsageError: an output that holds something else.
        InputError: photographs, cameras or masks that cannot be used.

    Example:
        >>> found = sfmapp.find_masks("turntable/", "masks/")
        >>> found.silhouettes[0].inside.mean(), [mask.confidence for mask in found.report.masks.masks]
    """
    from sfmapp.pipelines.carve.masks import MasksInput, find_masks

    return find_masks(MasksInput(source, images, poses), output, options_with(options, threads), events=events)
