"""Where photographs come from: folders, glob patterns and list files, and names for what is in them."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sfmapp.errors import InputError
from sfmapp.images.headers import picture_format
from sfmapp.images.products import foreign_product, holds_results

EXTENSIONS = frozenset({
    ".jpg", ".jpeg", ".jpe", ".jfif", ".jif", ".png", ".tif", ".tiff", ".bmp", ".dib", ".webp", ".ppm", ".pgm", ".pnm",
})  # fmt: skip
# Pictures and videos that people do put into such folders, and that are not read.
_FOREIGN_PICTURES = {".gif", ".heic", ".heif", ".avif", ".jp2", ".jxl", ".exr", ".hdr", ".psd", ".pbm"}
_RAW_PICTURES = {
    ".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".orf", ".rw2", ".rwl", ".raf", ".pef", ".srw", ".3fr",
    ".iiq", ".erf", ".mef", ".mos", ".kdc", ".dcr", ".x3f", ".gpr",
}  # fmt: skip
VIDEOS = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts", ".m2ts", ".mpg", ".mpeg", ".3gp", ".wmv"}
_THUMBNAIL_FOLDERS = frozenset({"__MACOSX", "@eaDir"})
_MAX_LIST_BYTES = 64 << 20


@dataclass
class Found:
    """What a source holds.

    Attributes:
        root: the folder that all names are relative to.
        paths: the files to look into.
        skipped: (name, reason) of those known to be of no use; the names of folders end with a slash.
        results: names of the folders with results of sfmapp that were passed over, with a slash at the end.
    """

    root: Path
    paths: list[Path] = field(default_factory=list)
    skipped: list[tuple[str, str]] = field(default_factory=list)
    results: list[str] = field(default_factory=list)


def find_images(source: str, mask_path: str | None = None) -> Found:
    """List the files of a folder, a glob pattern or a list file, in natural order of their names.

    Args:
        source: see :func:`sfmapp.images.folder.load_images`.
        mask_path: folder of masks, which are no images even if they lie inside the source; None for none.

    Raises:
        InputError: the source or the mask folder does not exist, or the list cannot be read.
    """
    mask_root = Path(mask_path).absolute() if mask_path is not None else None
    if mask_root is not None and not mask_root.is_dir():
        raise InputError(f"mask_path {mask_path} is not a folder", "masks are looked for as mask_path/NAME.png")
    if os.path.isdir(source):
        found = _find_in_folder(Path(source).absolute(), mask_root)
    elif os.path.isfile(source):
        if not source.lower().endswith(".txt"):
            raise InputError(
                f"{source} is a single file", "give a folder of images, a glob pattern in quotes, or a .txt list"
            )
        found = _find_in_list(Path(source).absolute())
    elif glob.has_magic(source):
        found = _find_by_pattern(source, mask_root)
    else:
        raise InputError(
            f"image source {source!r} does not exist",
            "give a folder of images, a glob pattern in quotes, or a .txt list",
        )
    found.paths.sort(key=lambda path: natural_key(os.path.relpath(path, found.root).replace(os.sep, "/")))
    if mask_root == found.root:  # photo.jpg.png beside photo.jpg is its mask
        every = set(found.paths)
        found.paths = [p for p in found.paths if not (p.suffix.lower() == ".png" and p.with_suffix("") in every)]
    return found


def natural_key(name: str) -> tuple[Any, ...]:
    """Sort key in which ``img9`` comes before ``img10`` and a folder's files stay together; no two names are equal."""
    parts = re.split("([0-9]+)", name.casefold().replace("/", "\0"))
    return tuple((int(part), "") if i % 2 else (-1, part) for i, part in enumerate(parts)), name


def position_of_name(name: str, names: Sequence[str], whose: str) -> int:
    """Of an image by its name, or by the end of it where only one ends so.

    Args:
        whose: ``of`` what the images are, for the message.

    Raises:
        InputError: no image has that name, or several end so.
    """
    if name in names:
        return names.index(name)
    ending = [n for n, one in enumerate(names) if one.endswith("/" + name) or Path(one).stem == name]
    if len(ending) == 1:
        return ending[0]
    some = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    found = f"{len(ending)} that end so" if ending else f"none; it has {some}"
    raise InputError(f"{name}: expected the name of one image {whose}, found {found}")


def is_picture(path: Path) -> bool:
    """Whether a file is a picture by its ending; one without an ending, by its first bytes."""
    ending = path.suffix.lower()
    return ending in EXTENSIONS or (not ending and picture_format(path) is not None)


def _find_in_folder(root: Path, mask_root: Path | None) -> Found:
    found = Found(root)
    visited: set[tuple[int, int]] = set()
    pending, links = [root], list[Path]()
    while pending or links:
        # a folder goes by its own name rather than by that of a link to it
        folder = pending.pop() if pending else links.pop(0)
        name = os.path.relpath(folder, root)
        try:
            status = os.stat(folder)
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError as error:
            found.skipped.append((printable(name) + "/", f"folder cannot be read: {error.strerror}"))
            continue
        # links are followed, but not in circles
        if (status.st_dev, status.st_ino) in visited:
            continue
        visited.add((status.st_dev, status.st_ino))
        for entry in entries:
            if entry.name.startswith(".") or entry.name in _THUMBNAIL_FOLDERS:
                continue
            path = Path(entry.path)
            if os.path.isdir(path) and path.suffix.lower() not in EXTENSIONS:
                if path != mask_root and not _is_product(found, path):
                    (links if entry.is_symlink() else pending).append(path)
            else:
                _take(found, path)
    return found


def _find_by_pattern(pattern: str, mask_root: Path | None) -> Found:
    fixed = []
    for part in Path(pattern).parts:
        if glob.has_magic(part):
            break
        fixed.append(part)
    found = Found(Path(*fixed).absolute() if fixed else Path.cwd())
    products: dict[Path, bool] = {}

    def is_in_product(folder: Path) -> bool:
        if folder == found.root or found.root not in folder.parents:
            return False
        if folder not in products:
            products[folder] = is_in_product(folder.parent) or _is_product(found, folder)
        return products[folder]

    matches = sorted(set(glob.glob(pattern, recursive=True)))
    for match in matches:
        path = Path(os.path.abspath(match))
        is_masked = mask_root is not None and mask_root != found.root and mask_root in path.parents
        is_folder = os.path.isdir(path) and path.suffix.lower() not in EXTENSIONS
        if not is_masked and not is_folder and not is_in_product(path.parent):
            _take(found, path)
    _add_other_case(found, pattern, matches)
    if not found.paths and not found.skipped:
        if found.results:
            raise InputError(
                f"the pattern {pattern} matches only results of sfmapp, in {', '.join(found.results[:3])}",
                "name the folder of the photographs",
            )
        raise InputError(f"the pattern {pattern} matches no image", "put it in quotes, and check it with ls")
    return found


def _is_product(found: Found, folder: Path) -> bool:
    """Whether the pictures of a folder are no photographs but made of them; if so, that is noted."""
    name = printable(os.path.relpath(folder, found.root)) + "/"
    if holds_results(folder, found.root):
        found.results.append(name)
        return True
    reason = foreign_product(folder)
    if reason is not None:
        found.skipped.append((name, reason))
    return reason is not None


def _add_other_case(found: Found, pattern: str, matches: list[str]) -> None:
    """Note images that a pattern misses because it has letters of the other case, as *.jpg has for a.JPG."""
    folder, name = os.path.split(pattern)
    any_case = re.sub(r"[a-zA-Z](?![^\[]*\])", lambda letter: f"[{letter[0].lower()}{letter[0].upper()}]", name)
    for match in sorted(set(glob.glob(os.path.join(folder, any_case), recursive=True)) - set(matches)):
        if Path(match).suffix.lower() in EXTENSIONS and os.path.isfile(match):
            shown = printable(os.path.relpath(match, found.root))
            found.skipped.append((shown, f"the pattern differs from its name in upper and lower case: {pattern}"))


def _take(found: Found, path: Path) -> None:
    """Sort a file in by its ending; by its content where it has none, or nothing but a number for one."""
    ending = path.suffix.lower()
    if ending in EXTENSIONS:
        found.paths.append(path)
        return
    name = printable(os.path.relpath(path, found.root))
    if ending in _FOREIGN_PICTURES | _RAW_PICTURES | VIDEOS:
        advice = "name the video itself beside the folder" if ending in VIDEOS else "convert them to JPEG or PNG"
        found.skipped.append((name, f"{ending} files are not read: {advice}"))
        return
    content = picture_format(path)
    if content is None:
        return
    if not ending or ending[1:].isdecimal():
        found.paths.append(path)
    else:  # thumbnails and backups are called such things
        found.skipped.append((name, f"holds a {content} picture but ends in {ending}: rename it if it is a photograph"))


def find_files(paths: Sequence[str]) -> Found:
    """Files that are named one by one; twice the same is one.

    Raises:
        InputError: one of them does not exist, or is a folder.
    """
    for path in paths:
        if not os.path.isfile(path):
            found = "a folder" if os.path.isdir(path) else "no such file"
            raise InputError(f"{path}: expected a photograph, found {found}")
    absolute = list(dict.fromkeys(Path(os.path.abspath(path)) for path in paths))
    return Found(Path(os.path.commonpath([path.parent for path in absolute])), absolute)


def _find_in_list(list_path: Path) -> Found:
    try:
        if list_path.stat().st_size > _MAX_LIST_BYTES:
            raise InputError(f"{list_path} is too large for a list of images")
        text = list_path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{list_path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{list_path} is not a text file in UTF-8", "write one path per line") from error
    skipped, paths = [], dict[Path, None]()
    for number, line in enumerate(text.splitlines(), 1):
        entry = line.strip()
        if not entry or entry.startswith("#"):
            continue
        if "\0" in entry or re.match(r"[a-zA-Z][a-zA-Z0-9+.-]+://", entry):
            skipped.append((printable(entry[:200]), f"line {number} of the list is not a path"))
            continue
        path = Path(os.path.abspath(list_path.parent / entry))
        if path in paths:
            skipped.append((printable(entry), f"listed twice (line {number} of the list)"))
        paths[path] = None
    root = Path(os.path.commonpath([path.parent for path in paths])) if paths else list_path.parent
    return Found(root, list(paths), skipped)


def printable(name: str) -> str:
    """A name that can be printed and written as UTF-8, whatever bytes the file system holds."""
    name = name.replace(os.sep, "/").encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in name)
