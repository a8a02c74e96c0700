"""Videos among the photographs of a reconstruction: their frames are chosen, and are photographs from then on."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.images.folder import load_found
from sfmapp.images.headers import UnusableImage, read_header
from sfmapp.images.load import GivenImages, Images, are_paths, load_images
from sfmapp.images.pixels import decode_bytes
from sfmapp.images.sources import Found, find_files, find_images, printable
from sfmapp.images.video import is_stream, is_video
from sfmapp.pipelines.sparse.photographs import link_photographs
from sfmapp.report.drawing import jpeg_url
from sfmapp.report.video_html import frames_of_strip
from sfmapp.reporting import from_plain, to_json
from sfmapp.video.options import VideoOptions
from sfmapp.video.report import VideoReport
from sfmapp.workspace.keys import stage_key
from sfmapp.workspace.manifest import read_json

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.images.report import ImagesReport
    from sfmapp.pipelines.sparse.run import Run
    from sfmapp.workspace.options import Options

IMAGES = "images"
"""The folder of a workspace with the frames of videos, and links to photographs that were given beside them."""
# What was chosen of a video, and with which key.
_CHOSEN = ".video.json"
_ENTRIES = ("sfmapp.video.frames",)
_THUMBNAIL_PX = 150


class Sources(NamedTuple):
    """What was given, apart: video files, and folders, patterns, lists and files of photographs."""

    videos: tuple[Path, ...]
    photographs: tuple[str, ...]


def sources_of(images: GivenImages) -> Images | Sources:
    """The sources of a run by what they are; a single one that is no video as it is.

    Raises:
        InputError: one of them is a stream or a camera.
    """
    if isinstance(images, str | os.PathLike):
        given = [os.fspath(images)]
    elif are_paths(images):
        given = [os.fspath(one) for one in images]
    else:
        return images
    for one in given:
        if is_stream(one):
            raise InputError(f"{one}: expected photographs or a video file, found a stream", "record it first")
    films = [one for one in given if is_video(one) and not os.path.isdir(one)]
    if not films and len(given) == 1:
        return given[0]
    missing = [one for one in films if not os.path.isfile(one)]
    if missing:
        raise InputError(f"{missing[0]}: expected a video, found no such file")
    rest = tuple(one for one in dict.fromkeys(given) if one not in films)
    return Sources(tuple(Path(one).absolute() for one in dict.fromkeys(films)), rest)


def load_sources(run: Run) -> tuple[ImageSet, ImagesReport]:
    """The photographs of a run, frames of its videos among them, which are chosen now where they were not before."""
    sources = sources_of(run.images)
    if not isinstance(sources, Sources):
        return load_images(sources, run.options.images, run.events, threads=run.threads)
    found, videos = frames_and_photographs(sources, run.workspace.folder, run.options, run.events)
    run.stages = replace(run.stages, videos=videos)
    return load_found(printable(run.source), found, run.options.images, run.events, run.threads)


def frames_and_photographs(
    sources: Sources, folder: Path, options: Options, events: Events, taken: Collection[str] = ()
) -> tuple[Found, list[VideoReport]]:
    """Frames of videos and links to photographs in one folder of a workspace.

    Args:
        folder: the workspace. taken: names of folders that others have there.
    """
    root = (folder / IMAGES).absolute()
    names = _folder_names([*(path.stem for path in sources.videos), *map(_name_of, sources.photographs)], taken)
    of_videos, of_photographs = names[: len(sources.videos)], names[len(sources.videos) :]
    found = Found(root)
    reports = []
    for video, name in zip(sources.videos, of_videos, strict=True):
        reports.append(_frames_of(video, root / name, options.video, events))
        found.paths += [root / frame.name for frame in reports[-1].chosen]
    for source, name in zip(sources.photographs, of_photographs, strict=True):
        there = find_files([source]) if _is_file(source) else find_images(source, options.images.mask_path)
        links = {f"{name}/{path.relative_to(there.root).as_posix()}": path for path in there.paths}
        link_photographs(root, links)
        found.paths += [root / link for link in links]
        found.skipped += [(f"{name}/{skipped}", reason) for skipped, reason in there.skipped]
        found.results += there.results
    return found, reports


def _frames_of(video: Path, folder: Path, options: VideoOptions, events: Events) -> VideoReport:
    """What was chosen of a video before, where that still holds; else it is chosen now."""
    from sfmapp.video.frames import STAGE, choose_frames

    status = video.stat()
    key = stage_key(_ENTRIES, options, os.fspath(video), status.st_size, status.st_mtime_ns)
    known = read_json(folder / _CHOSEN)
    if isinstance(known, dict) and known.get("key") == key:
        try:
            report = from_plain(VideoReport, known)
        except ValueError:
            report = None
        if report is not None and all((folder.parent / frame.name).is_file() for frame in report.chosen):
            events.decided(STAGE, f"{video.name}: {len(report.chosen)} frames were chosen before")
            return report
    (folder / _CHOSEN).unlink(missing_ok=True)
    report = replace(choose_frames(video, folder, options, events), key=key)
    (folder / _CHOSEN).write_text(to_json(report, indent=1) + "\n", encoding="utf-8")
    return report


def strips(folder: Path, videos: Sequence[VideoReport] | None) -> dict[str, str]:
    """URLs of small pictures of frames of videos that the page of a workspace shows, by name."""
    root = folder / IMAGES
    urls = {}
    for name in (name for report in videos or () for name in frames_of_strip(report)):
        with suppress(OSError, UnusableImage):
            data = (root / name).read_bytes()
            pixels = decode_bytes(data, read_header(data))
            if pixels is not None:
                urls[name] = jpeg_url(pixels, _THUMBNAIL_PX)
    return urls


# -------------------------------------------------------------------------------------------------------------- names


def _is_file(source: str) -> bool:
    return os.path.isfile(source) and not source.lower().endswith(".txt")


def _name_of(source: str) -> str:
    """Of the folder that photographs are linked in: that of the folder they are in."""
    if os.path.isdir(source):
        return Path(source).absolute().name
    return Path(source).absolute().parent.name


def _folder_names(wanted: Sequence[str], taken: Collection[str]) -> list[str]:
    """Names of folders, all different, and none hidden, strange or taken."""
    names: list[str] = []
    for one in wanted:
        plain = re.sub(r"[^\w.+-]+", "_", printable(one), flags=re.ASCII).strip("._") or "images"
        name, count = plain, 2
        while name.casefold() in (other.casefold() for other in (*names, *taken)):
            name, count = f"{plain}-{count}", count + 1
        names.append(name)
    return names
