"""The stage that finds and describes keypoints in every image."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.executor import Executor, Threads
from sfmapp.features.octaves import Scratch, bytes_of_scale_space
from sfmapp.features.orb import extract_orb
from sfmapp.features.report import FEW_FEATURES, FeaturesReport, ImageFeatures
from sfmapp.features.sift import compile_kernels, extract_sift
from sfmapp.formats.feature_files import feature_file, read_feature_file, write_feature_file
from sfmapp.option_checks import RESOURCE, Range, check_options, positive
from sfmapp.scene.features import DescriptorMetric, Features

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord, ImageSet
    from sfmapp.images.pixels import Picture

__all__ = ["FeatureOptions", "compile_kernels", "extract_features", "extract_image", "features_from_picture"]

STAGE = "features"
_METRICS = {"sift": DescriptorMetric.ROOT_SIFT, "orb": DescriptorMetric.HAMMING}

_RANGES = {
    "max_num_features": Range(1),
    "max_size_px": Range(1),
    "contrast_threshold": positive(),
    "edge_threshold": positive(),
    "max_num_orientations": Range(1),
    "memory_mb": Range(1),
}


@dataclass(frozen=True)
class FeatureOptions:
    """Options of the stage ``features``.

    Attributes:
        kind: Detector and descriptor; orb is some ten times faster and less exact.
        max_num_features: Keypoints per image, at most; the strongest are kept.
        max_size_px: Larger images are scaled down to this longer side for detection; coordinates stay those of the full
            image.
        contrast_threshold: SIFT: least difference of Gaussians, grey levels in [0, 1]; a third of COLMAP's, so that the
            budget fills.
        edge_threshold: SIFT: largest ratio of principal curvatures; larger keeps more keypoints along edges.
        max_num_orientations: SIFT: descriptors at one place, at most; more than one only where the budget has room.
        memory_mb: Memory that all workers together may take; None for half of what is free at the start.
    """

    kind: Literal["sift", "orb"] = "sift"
    max_num_features: int = 8192
    max_size_px: int = 3200
    contrast_threshold: float = 0.02 / 9
    edge_threshold: float = 10.0
    max_num_orientations: int = 2
    memory_mb: int | None = field(default=None, metadata=RESOURCE)

    def __post_init__(self) -> None:
        check_options("features", self, _RANGES)


def extract_features(
    image_set: ImageSet,
    options: FeatureOptions,
    *,
    threads: int,
    events: Events,
    known: Mapping[int, Features] | None = None,
    store: Callable[[int, Features], Features] | None = None,
    executor: Executor | None = None,
) -> tuple[list[Features], FeaturesReport]:
    """Find and describe the keypoints of all images.

    Args:
        image_set: the images.
        options: see :class:`FeatureOptions`.
        threads: images worked on at a time, at most; fewer where memory is short. The result does not depend on it.
        events: receives the progress, image by image, and warnings that name the file.
        known: features by position of the image that need not be extracted again.
        store: called with position and features of each newly extracted image, in the calling thread, in the order in
            which images are done. What it returns stands in their place in the result.
        executor: who works on images; None: ``threads`` of this process.

    Returns:
        Features in the order of the images, empty for an image that cannot be read, and the report.
    """
    known = known or {}
    images = image_set.images
    result = [known.get(i) for i in range(len(images))]
    todo = [i for i in range(len(images)) if result[i] is None]
    lines: dict[int, ImageFeatures] = {}
    start, start_cpu = time.perf_counter(), time.process_time()
    events.started(STAGE, f"{options.kind} on {len(todo)} images", total=len(todo), num_known=len(images) - len(todo))
    executor = executor or Threads(threads, bytes_for_extraction(options))
    needs = [bytes_of_extraction(images[i], options) for i in todo]
    with (
        _single_threaded_opencv(),
        closing(executor.run(_work(executor, options), [images[i] for i in todo], bytes_needed=needs)) as results,
    ):
        for n, (features, line) in results:
            i = todo[n]
            if features is None:
                assert executor.folder is not None
                features = read_feature_file(feature_file(executor.folder, images[i].name))
            result[i], lines[i] = features if store is None else store(i, features), line
            for warning in line.warnings:
                events.warned(STAGE, warning, image=images[i].name)
            events.advanced(STAGE, message=images[i].name, image_idx=i, num_features=len(features))
    done = [features for features in result if features is not None]
    cpu_s = time.process_time() - start_cpu
    if executor.folder is not None:  # others have worked
        cpu_s += sum(line.cpu_s or 0.0 for line in lines.values())
    took = time.perf_counter() - start, cpu_s
    report = _report(images, done, lines, options, took)
    events.finished(STAGE, f"{report.num_features} keypoints in {len(images)} images", **report)
    return done, report


def _work(
    executor: Executor, options: FeatureOptions
) -> Callable[[ImageRecord], tuple[Features | None, ImageFeatures]]:
    """What an executor does with one image."""
    if executor.folder is not None:
        return partial(_extract_into, executor.folder, options)
    local = threading.local()

    def extract(record: ImageRecord) -> tuple[Features, ImageFeatures]:
        if not hasattr(local, "scratch"):
            local.scratch = Scratch()
        return extract_image(record, options, local.scratch)

    return extract


def _extract_into(folder: Path, options: FeatureOptions, record: ImageRecord) -> tuple[None, ImageFeatures]:
    """Features of one image into a file; the line of the report about it."""
    if not record.path.exists():
        raise InputError(f"{record.path}: the photograph is not there", "workers need all folders at the same paths")
    features, line = extract_image(record, options)
    write_feature_file(feature_file(folder, record.name), features)
    return None, line


def extract_image(
    record: ImageRecord, options: FeatureOptions, scratch: Scratch | None = None
) -> tuple[Features, ImageFeatures]:
    """Features of one image and the line of the report about it; no features if it cannot be read."""
    from sfmapp.images.pixels import read_picture

    start = time.thread_time()
    try:
        picture = read_picture(record)
    except InputError as error:
        warning = f"{record.name}: no features, {error}"
        return empty_features(options.kind), ImageFeatures(name=record.name, num_features=0, warnings=[warning])
    features, scale, threshold = features_from_picture(picture, options, scratch)
    warnings = []
    if len(features) == 0:
        warnings.append(f"{record.name}: no features found ({_why_none(picture)})")
    elif len(features) < min(FEW_FEATURES, options.max_num_features):
        warnings.append(f"{record.name}: only {len(features)} features found: too little texture or contrast")
    return features, ImageFeatures(
        name=record.name, num_features=len(features), warnings=warnings, scale=scale, contrast_threshold=threshold,
        cpu_s=time.thread_time() - start,
    )  # fmt: skip


def features_from_picture(
    picture: Picture, options: FeatureOptions, scratch: Scratch | None = None
) -> tuple[Features, float, float | None]:
    """Features of pixels in memory, the factor that the image was scaled by, and the contrast threshold in use (None
    for ORB)."""
    import cv2

    height, width = picture.gray.shape
    gray, usable = picture.gray, picture.mask
    scale = min(1.0, options.max_size_px / max(height, width))
    if scale < 1.0:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        if usable is not None:
            usable = cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) != 0
    threshold, is_dark = None, None
    if options.kind == "sift":
        keypoints, descriptors, is_dark, threshold = extract_sift(
            gray,
            usable,
            max_num_features=options.max_num_features,
            max_num_orientations=options.max_num_orientations,
            contrast_threshold=options.contrast_threshold,
            edge_threshold=options.edge_threshold,
            scratch=scratch,
        )
    else:
        keypoints, descriptors = extract_orb(gray, usable, max_num_features=options.max_num_features)
    if scale < 1.0:
        # COLMAP's pixels have their origin at the corner of the image, so scaling is a plain product
        factor = np.array([width / gray.shape[1], height / gray.shape[0]], np.float32)
        keypoints[:, :2] *= factor
        keypoints[:, 2] *= factor.mean()
    x = np.clip(keypoints[:, 0].astype(np.int64), 0, width - 1)
    y = np.clip(keypoints[:, 1].astype(np.int64), 0, height - 1)
    found = Features(keypoints, descriptors, picture.rgb[y, x], _METRICS[options.kind], is_dark)
    return found, scale, threshold


def empty_features(kind: str) -> Features:
    """No keypoints."""
    length = 32 if kind == "orb" else 128
    descriptors = np.zeros((0, length), np.uint8)
    return Features(np.zeros((0, 4), np.float32), descriptors, np.zeros((0, 3), np.uint8), _METRICS[kind])


def _why_none(picture: Picture) -> str:
    height, width = picture.gray.shape
    if min(height, width) < 16:
        return f"it is {width} x {height} pixels"
    if picture.mask is not None and not picture.mask.any():
        return "the mask covers all of it"
    if int(picture.gray.max()) - int(picture.gray.min()) <= 2:
        return "all pixels have the same brightness"
    return "too little texture or contrast"


def _report(
    images: tuple[ImageRecord, ...], done: list[Features], lines: Mapping[int, ImageFeatures], options: FeatureOptions,
    took: tuple[float, float],
) -> FeaturesReport:  # fmt: skip
    per_image = [
        lines.get(i) or ImageFeatures(name=image.name, num_features=len(done[i]), warnings=[], known=True)
        for i, image in enumerate(images)
    ]
    return FeaturesReport(
        kind=options.kind,
        num_images=len(images),
        num_known=len(images) - len(lines),
        num_features=sum(len(features) for features in done),
        images=per_image,
        warnings=[warning for line in per_image for warning in line.warnings],
        wall_s=took[0],
        cpu_s=took[1],
    )


def bytes_of_extraction(record: ImageRecord, options: FeatureOptions) -> int:
    """Estimate of the memory that one image takes at the peak of its extraction."""
    pixels = record.width * record.height
    scale = min(1.0, options.max_size_px / max(record.width, record.height))
    width, height = round(scale * record.width), round(scale * record.height)
    # three channels, grey and mask of the full image
    work = bytes_of_scale_space(height, width) if options.kind == "sift" else 12 * height * width
    return 5 * pixels + work


def bytes_for_extraction(options: FeatureOptions) -> int:
    """Memory that all workers together may take."""
    if options.memory_mb is not None:
        return options.memory_mb << 20
    try:
        with open("/proc/meminfo") as lines:
            free_kb = next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        free_kb = 4 << 20
    return free_kb << 9


@contextmanager
def _single_threaded_opencv() -> Iterator[None]:
    """Images are the unit of parallel work: OpenCV's own threads would only compete with it."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
