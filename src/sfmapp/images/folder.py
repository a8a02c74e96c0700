"""From a folder, a glob pattern or a list file to the photographs of a run.

Nothing is decoded here: headers and EXIF are read, and every byte once, for the digest. A file that cannot be used is
skipped with its reason and the rest goes on.
"""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from sfmapp.errors import InputError, listed
from sfmapp.events import Events
from sfmapp.geometry.orientation import MIRRORED
from sfmapp.images.cameras import Shot, group_cameras, tell_cameras
from sfmapp.images.exif import ExifFacts, read_exif
from sfmapp.images.headers import Header, UnusableImage, read_header
from sfmapp.images.image_set import ImageOptions, ImageRecord, ImageSet
from sfmapp.images.pixels import mask_fit
from sfmapp.images.report import CameraPrior, ImageFacts, ImageProblem, ImagesReport
from sfmapp.images.sources import Found, find_files, find_images, natural_key, printable
from sfmapp.images.xmp import with_xmp
from sfmapp.reporting import NamedReason

__all__ = ["ImageOptions", "ImageRecord", "ImageSet", "load_images"]

STAGE = "images"
# Fewer pixels than this hold no feature: SIFT needs a neighbourhood of about that size.
_MIN_SIDE_PX = 16
_NAMES_SHOWN = 8


@dataclass(frozen=True)
class _Scan:
    """A file that was looked into and found good."""

    record: ImageRecord
    header: Header
    facts: ExifFacts
    num_bytes: int
    problems: tuple[str, ...]


def load_images(
    source: str | os.PathLike[str] | Sequence[str], options: ImageOptions, events: Events, *, threads: int | None = None
) -> tuple[ImageSet, ImagesReport]:
    """List, check and describe the photographs of a source.

    Args:
        source: a folder (searched recursively; hidden files and folders are left out, and those that sfmapp and other
            programs made of photographs), a glob pattern (``**`` goes into folders), or a ``.txt`` file with a path per
            line (relative to the list, or absolute; ``#`` begins a comment). Files without an ending are photographs
            if they begin as one. Or the files themselves, in a list or tuple.
        options: what to read and what is known about the cameras.
        events: told about progress, every file that is skipped, and how cameras were assigned.
        threads: how many files are read at a time; None: as many as there are processors, 8 at most.

    Returns:
        The set, which may be empty, and the report.

    Raises:
        InputError: the source or the mask folder does not exist, no mask fits any image, or the given cameras do not.
        UsageError: ``camera_params`` with images of several sizes.
        InterruptedRunError: a stop was asked for.
    """
    if isinstance(source, str | os.PathLike):
        found = find_images(os.fspath(source), options.mask_path)
        return load_found(os.fspath(source), found, options, events, threads)
    return load_found(", ".join(source), find_files(source), options, events, threads)


def load_found(
    name: str, found: Found, options: ImageOptions, events: Events, threads: int | None = None
) -> tuple[ImageSet, ImagesReport]:
    """Check and describe files that were found; ``name``: of where, for messages. As :func:`load_images`."""
    start = time.monotonic()
    events.started(STAGE, f"reading {len(found.paths)} files", total=len(found.paths))
    scans: list[_Scan] = []
    skipped = list(found.skipped)
    for outcome in _scan_all(found, options, threads, events):
        if isinstance(outcome, _Scan):
            scans.append(outcome)
        else:
            skipped.append(outcome)
    cameras, camera_idx, entries, focal_problems = group_cameras(
        [Shot(s.record.name, s.record.width, s.record.height, s.facts) for s in scans], options, str(found.root)
    )
    images = tuple(replace(scan.record, camera_idx=idx) for scan, idx in zip(scans, camera_idx, strict=True))
    skipped.sort(key=lambda item: natural_key(item[0]))
    image_set = ImageSet(images, tuple(cameras), tuple(skipped), found.root)
    problems = [(scan.record.name, problem) for scan in scans for problem in scan.problems] + focal_problems
    duplicates = same_pixels(images)
    if found.results:
        message = f"{_some(found.results)}: results of sfmapp, whose pictures are no photographs"
        events.decided(STAGE, message, names=found.results)
    _tell(events, image_set, scans, entries, problems, duplicates)
    if not images:
        where = f", other than in {_some(found.results)}, which holds results of sfmapp" if found.results else ""
        events.warned(STAGE, f"no usable image found{where}: expected files such as .jpg, .png, .tif, .webp")
    if options.mask_path is not None and images and not any(image.mask_path for image in images):
        name = images[0].name
        raise InputError(
            f"no mask in {options.mask_path} fits any image", f"expected for example {options.mask_path}/{name}.png"
        )
    report = _report(name, found, image_set, scans, entries, problems, duplicates, start)
    passed_over = f", results of sfmapp in {_some(found.results)} passed over" if found.results else ""
    events.finished(
        STAGE, f"{len(images)} images, {len(cameras)} cameras, {len(skipped)} files skipped{passed_over}", **report
    )
    return image_set, report


def describe_images(
    root: str | os.PathLike[str], names: Sequence[str], options: ImageOptions, *, threads: int | None = None
) -> tuple[list[ImageRecord | None], list[tuple[str, str]]]:
    """Describe photographs that are known by name, such as those of a model.

    Args:
        root: folder that the names are relative to.
        names: of N photographs, with forward slashes.
        options: masks and limits; nothing is said about cameras.
        threads: how many files are read at a time.

    Returns:
        N records, None for a file that cannot be used, and (name, reason) of those.
    """
    folder = Path(root).absolute()
    mask_root = Path(options.mask_path).absolute() if options.mask_path is not None else None
    with ThreadPoolExecutor(threads or min(8, os.cpu_count() or 1)) as pool:
        outcomes = list(pool.map(lambda name: _scan_by_name(name, folder, mask_root, options), names))
    records = [outcome.record if isinstance(outcome, _Scan) else None for outcome in outcomes]
    reasons = [(name, o[1]) for name, o in zip(names, outcomes, strict=True) if not isinstance(o, _Scan)]
    return records, reasons


# ------------------------------------------------------------------------------------------------ looking into files


def _scan_all(
    found: Found, options: ImageOptions, threads: int | None, events: Events
) -> Iterator[_Scan | tuple[str, str]]:
    mask_root = Path(options.mask_path).absolute() if options.mask_path is not None else None
    pool = ThreadPoolExecutor(threads or min(8, os.cpu_count() or 1))
    try:
        for outcome in pool.map(lambda path: _scan(path, found.root, mask_root, options), found.paths):
            events.advanced(STAGE)
            yield outcome
    finally:
        pool.shutdown(cancel_futures=True)


def _scan_by_name(name: str, folder: Path, mask_root: Path | None, options: ImageOptions) -> _Scan | tuple[str, str]:
    """As :func:`_scan`, of a name that a file of others gives: results are written under it as well."""
    pure = PurePosixPath(name)
    if pure.is_absolute() or ".." in pure.parts:
        return name, "its name leads out of the folder of the photographs"
    return _scan(folder / name, folder, mask_root, options)


def _scan(path: Path, root: Path, mask_root: Path | None, options: ImageOptions) -> _Scan | tuple[str, str]:
    """Read one file: a scan, or (name, reason) if it cannot be used."""
    name = os.path.relpath(path, root).replace(os.sep, "/")
    if name != printable(name):
        return printable(name), "its name is not plain text in UTF-8: rename it"
    try:
        data = _read_file(path, options.max_image_bytes)
        header = read_header(data)
        _check_size(header, options)
    except UnusableImage as reason:
        return name, str(reason)
    except FileNotFoundError:
        return name, "a link to a file that does not exist" if path.is_symlink() else "no such file"
    except OSError as error:
        return name, f"cannot be read: {error.strerror or error}"
    facts = read_exif(header.exif)
    problems = list(facts.problems)
    record = ImageRecord(
        name=name,
        path=path,
        width=header.width,
        height=header.height,
        orientation=facts.orientation,
        digest=hashlib.blake2b(data, digest_size=16).hexdigest(),
        has_alpha=header.has_alpha and options.use_alpha,
        timestamp=facts.timestamp,
        position=with_xmp(facts.position, header.xmp, problems),
        make=facts.make,
        model=facts.model,
    )
    if mask_root is not None:
        record, mask_problem = _with_mask(record, mask_root)
        problems += mask_problem
    return _Scan(record, header, facts, len(data), tuple(problems))


def _read_file(path: Path, max_bytes: int) -> bytes:
    status = os.stat(path)
    if stat.S_ISDIR(status.st_mode):
        raise UnusableImage("a folder, not a file")
    if not stat.S_ISREG(status.st_mode):  # opening a pipe would wait forever
        raise UnusableImage("not a regular file")
    with open(path, "rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise UnusableImage(f"larger than max_image_bytes ({max_bytes} bytes)")
    return data


def _check_size(header: Header, options: ImageOptions) -> None:
    size = f"{header.width}x{header.height}"
    if header.width * header.height > options.max_pixels:
        raise UnusableImage(f"{size} is more than max_pixels ({options.max_pixels} pixels)")
    if min(header.width, header.height) < _MIN_SIDE_PX:
        raise UnusableImage(f"too small: {size}, at least {_MIN_SIDE_PX} pixels a side are needed")


def _with_mask(record: ImageRecord, mask_root: Path) -> tuple[ImageRecord, tuple[str, ...]]:
    """The record with its mask, or with None and the reason why a mask that is there cannot be used."""
    stem = os.path.splitext(record.name)[0]
    for path in (mask_root / f"{record.name}.png", mask_root / f"{stem}.png"):
        if path == record.path or not os.path.isfile(path):
            continue
        try:
            header = read_header(_read_file(path, 1 << 30))
        except UnusableImage as reason:
            return record, (f"its mask {path.name} is not used: {reason}",)
        except OSError as error:
            return record, (f"its mask {path.name} is not used: {error.strerror}",)
        size, wanted = f"{header.width}x{header.height}", f"{record.width}x{record.height}"
        if mask_fit(header, record) is None:
            return record, (f"its mask is not used: {size} pixels, the image has {wanted}",)
        masked = replace(record, mask_path=path)
        if mask_fit(header, record) == "turned":
            return masked, (f"its mask fits the picture as EXIF turns it ({size} pixels) and is turned back",)
        if {header.width, header.height} != {record.width, record.height}:
            return masked, (f"its mask is scaled: {size} pixels, the image has {wanted}",)
        return masked, ()
    return record, ()


# ------------------------------------------------------------------------------------------------- telling about it


def same_pixels(images: Iterable[ImageRecord]) -> list[list[str]]:
    """Names of images that are the same, byte for byte, set by set."""
    by_digest: defaultdict[str, list[str]] = defaultdict(list)
    for image in images:
        by_digest[image.digest].append(image.name)
    return [names for names in by_digest.values() if len(names) > 1]


def _tell(
    events: Events,
    image_set: ImageSet,
    scans: list[_Scan],
    entries: Sequence[CameraPrior],
    problems: list[tuple[str, str]],
    duplicates: list[list[str]],
) -> None:
    """One event per kind of thing, with the names in it, so that a thousand bad files do not make a thousand lines."""
    for reason, names in _by_reason(image_set.skipped).items():
        events.warned(STAGE, f"skipped {_some(names)}: {reason}", names=names, reason=reason)
    for problem, names in _by_reason(problems).items():
        events.warned(STAGE, f"{_some(names)}: {problem}", names=names, reason=problem)
    for names in duplicates:
        events.warned(STAGE, f"{_some(names)} are the same file: copies add nothing to a reconstruction", names=names)
    deep = [scan.record.name for scan in scans if scan.header.bits > 8]
    if deep:
        events.decided(STAGE, f"{len(deep)} images of 16 bits are scaled to 8 bits", names=deep)
    banded = [scan.record.name for scan in scans if scan.header.num_left_out]
    if banded:
        text = f"{len(banded)} images have bands beside colour and alpha (near infrared?), which are left out"
        events.decided(STAGE, text, names=banded)
    _tell_orientation(events, [scan.record for scan in scans])
    without = [image.name for image in image_set.images if image.mask_path is None]
    if 0 < len(without) < len(image_set.images):
        events.decided(STAGE, f"{len(without)} of {len(image_set.images)} images have no mask", names=without)
    tell_cameras(entries, STAGE, events)


def _tell_orientation(events: Events, records: list[ImageRecord]) -> None:
    turned = [record.name for record in records if record.orientation != 1]
    if turned:
        text = f"{len(turned)} images have an EXIF orientation: the model and what is exported fit the pixels of the "
        events.decided(STAGE, text + "files, as other programs read them; only what is shown is turned", names=turned)
    mirrored = [record.name for record in records if record.orientation in MIRRORED]
    if not mirrored:
        return
    advice = "to have it as it is, write the files anew: exiftran -ai, mogrify -auto-orient, or PIL's exif_transpose"
    if len(mirrored) == len(records):
        text = f"all images are stored as mirror images (EXIF orientation 2, 4, 5, 7), as will be their model; {advice}"
    else:
        text = (
            f"{_some(mirrored)}: stored as mirror images (EXIF orientation 2, 4, 5, 7), unlike the others, with which "
            f"they are not matched; {advice}"
        )
    events.warned(STAGE, text, names=mirrored)


def _by_reason(items: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, reason in items:
        groups.setdefault(reason, []).append(name)
    return groups


def _some(names: list[str]) -> str:
    return listed(names, _NAMES_SHOWN)


def _report(
    source: str,
    found: Found,
    image_set: ImageSet,
    scans: list[_Scan],
    entries: Sequence[CameraPrior],
    problems: list[tuple[str, str]],
    duplicates: list[list[str]],
    start: float,
) -> ImagesReport:
    return ImagesReport(
        source=printable(source),
        root=printable(str(found.root)),
        results_passed_over=found.results,
        num_found=len(scans) + len(image_set.skipped),
        num_used=len(scans),
        num_skipped=len(image_set.skipped),
        num_bytes=sum(scan.num_bytes for scan in scans),
        num_with_gps=sum(image.gps is not None for image in image_set.images),
        num_with_time=sum(image.timestamp is not None for image in image_set.images),
        num_with_mask=sum(image.mask_path is not None for image in image_set.images),
        skipped=[NamedReason(name=name, reason=reason) for name, reason in image_set.skipped],
        problems=[ImageProblem(name=name, problem=problem) for name, problem in problems],
        duplicates=duplicates,
        cameras=entries,
        images=[_facts(image, scan.header) for image, scan in zip(image_set.images, scans, strict=True)],
        wall_s=round(time.monotonic() - start, 3),
    )


def _facts(image: ImageRecord, header: Header) -> ImageFacts:
    return ImageFacts(
        name=image.name,
        width=image.width,
        height=image.height,
        orientation=image.orientation,
        camera_idx=image.camera_idx,
        digest=image.digest,
        mask=None if image.mask_path is None else printable(str(image.mask_path)),
        format=header.format,
        kind=header.kind,
        bits=header.bits,
        timestamp=image.timestamp,
        gps=image.gps and list(image.gps),
    )
