"""Whatever users have for photographs, as one thing: files, arrays, a source of their own, a set described before."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.images import folder
from sfmapp.images.arrays import ArraySource, describe_source
from sfmapp.images.cameras import tell_cameras
from sfmapp.images.folder import STAGE, same_pixels
from sfmapp.images.image_set import ImageOptions, ImageRecord, ImageSet, ImageSource
from sfmapp.images.products import IN_MEMORY
from sfmapp.images.report import CameraPrior, ImageFacts, ImagesReport
from sfmapp.reporting import NamedReason

if TYPE_CHECKING:
    from typing_extensions import TypeIs

Images = str | os.PathLike[str] | ImageSet | ImageSource | Mapping[str, NDArray[Any]]
"""What every function takes for photographs."""
GivenImages = Images | Sequence[str | os.PathLike[str]]
"""The same, and several files and folders."""


def are_paths(images: GivenImages) -> TypeIs[Sequence[str | os.PathLike[str]]]:
    """Whether several files and folders are given."""
    return isinstance(images, list | tuple) and all(isinstance(one, str | os.PathLike) for one in images)


def name_of(images: GivenImages) -> str:
    """What is written down as the source of the photographs."""
    if are_paths(images):
        return ", ".join(os.path.abspath(one) for one in images)
    if isinstance(images, str | os.PathLike):
        return os.fspath(images)
    root = images.root if isinstance(images, ImageSet) else None
    return IN_MEMORY if root is None else os.fspath(root)


def load_images(
    images: Images,
    options: ImageOptions,
    events: Events,
    *,
    masks: Mapping[str, NDArray[Any]] | None = None,
    threads: int | None = None,
) -> tuple[ImageSet, ImagesReport]:
    """Describe photographs: their names, sizes and cameras.

    Args:
        images: a folder, a glob pattern or a ``.txt`` list; arrays by name; an :class:`ImageSource`; or a set, which is
            taken as it is.
        options: what is known about the cameras, and masks of files; of no effect on a set.
        masks: of arrays, by name.
        events: told of progress, of files that are skipped, and of how cameras were assigned.
        threads: files that are read at a time.

    Returns:
        The set and the report.

    Raises:
        InputError: the source does not exist, is none of these, or an array is no picture.
        UsageError: options that contradict the images.
    """
    if isinstance(images, str | os.PathLike):
        return folder.load_images(images, options, events, threads=threads)
    start = time.monotonic()
    entries: Sequence[CameraPrior]
    if isinstance(images, ImageSet):
        found, entries = images, _as_given(images)
    elif isinstance(images, Mapping):
        found, entries = describe_source(ArraySource(images, masks or {}), options)
    elif all(hasattr(images, name) for name in ("names", "pixels", "mask")):
        found, entries = describe_source(images, options)
    else:
        raise InputError(
            f"images: expected a path, arrays by name, an ImageSource or an ImageSet, found {type(images).__name__}"
        )
    events.started(STAGE, f"{len(found.images)} photographs in memory", total=len(found.images))
    tell_cameras(entries, STAGE, events)
    report = _report(name_of(images), found, entries, start)
    events.finished(STAGE, f"{len(found.images)} images, {len(found.cameras)} cameras", **report)
    return found, report


def _as_given(images: ImageSet) -> list[CameraPrior]:
    whose = [record.camera_idx for record in images.images]
    return [
        CameraPrior(
            camera_idx=idx, num_images=whose.count(idx), model=camera.model.name, width=camera.width,
            height=camera.height, params=[float(value) for value in camera.params], focal_px=camera.focal,
            focal_sigma_px=camera.focal_sigma, focal_source=camera.focal_source,
            focal_reason="as it was given", is_fixed=camera.is_fixed, make="", camera="", sharing="as it was given",
        )
        for idx, camera in enumerate(images.cameras)
    ]  # fmt: skip


def _report(source: str, found: ImageSet, entries: Sequence[CameraPrior], start: float) -> ImagesReport:
    images = found.images
    return ImagesReport(
        source=source,
        root=os.fspath(found.root or ""),
        results_passed_over=[],
        num_found=len(images) + len(found.skipped),
        num_used=len(images),
        num_skipped=len(found.skipped),
        num_bytes=sum(record.path.stat().st_size for record in images if record.source is None),
        num_with_gps=sum(record.gps is not None for record in images),
        num_with_time=sum(record.timestamp is not None for record in images),
        num_with_mask=sum(record.mask_path is not None or _is_masked(record) for record in images),
        skipped=[NamedReason(name=name, reason=reason) for name, reason in found.skipped],
        problems=[],
        duplicates=same_pixels(images),
        cameras=entries,
        images=[_facts(record) for record in images],
        wall_s=round(time.monotonic() - start, 3),
    )


def _is_masked(record: ImageRecord) -> bool:
    return record.source is not None and record.source.mask(record.name) is not None


def _facts(record: ImageRecord) -> ImageFacts:
    return ImageFacts(
        name=record.name, width=record.width, height=record.height, orientation=record.orientation,
        camera_idx=record.camera_idx, digest=record.digest,
        mask=None if record.mask_path is None else os.fspath(record.mask_path), timestamp=record.timestamp,
        gps=record.gps and list(record.gps),
    )  # fmt: skip
