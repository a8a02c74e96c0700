"""Photographs that come to those of a finished reconstruction: where they lie, and which cameras took them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.formats.database import Database
from sfmapp.images.image_set import ImageRecord, ImageSet

PHOTOGRAPHS = "photographs"
"""The folder of links in a workspace, which names are then relative to."""


def link_photographs(folder: Path, files: dict[str, Path]) -> None:
    """Put links to files into a folder, so that names in several folders are those in one.

    Raises:
        InputError: the system has no links, or something else is there.
    """
    for name, path in files.items():
        link = folder / name
        try:
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.is_symlink():
                link.symlink_to(path.resolve())
        except OSError as error:
            raise InputError(
                f"{link}: expected to put a link to {path} there: {error.strerror}",
                "move all photographs into one folder, and add those",
            ) from error


def as_before(
    database: Path, names: Sequence[str], records: Sequence[ImageRecord], cameras: Sequence[Camera]
) -> ImageSet:
    """The photographs of a reconstruction in the order of its database and with its cameras, as they were beforehand.

    Args:
        names: as the database has them. records: of each; cameras: that ``camera_idx`` of these points to, by which is
            told what no database holds.
    """
    with Database(database, read_only=True) as stored:
        own, _, camera_idx = stored.read_images()
    prior = {int(c): cameras[record.camera_idx] for record, c in zip(records, camera_idx, strict=True)}
    known = [
        replace(prior[c], params=camera.params) if c in prior and prior[c].model == camera.model else camera
        for c, camera in enumerate(own)
    ]
    images = [
        replace(record, name=name, camera_idx=int(c))
        for record, name, c in zip(records, names, camera_idx, strict=True)
    ]
    return ImageSet(tuple(images), tuple(known))


def with_new(before: ImageSet, groups: Sequence[int], new: Iterable[tuple[ImageRecord, Camera]]) -> ImageSet:
    """Photographs of before and new ones behind them.

    A new one is of a camera of before where EXIF, names and sizes of all together say so, and of that one alone.

    Args:
        groups: of those of before, which photographs are of one camera by these rules; ``camera_idx`` of the new ones
            says the same. new: each with the camera that it has if it is of none of before.
    """
    whose: dict[int, set[int]] = {}
    for image, group in zip(before.images, groups, strict=True):
        whose.setdefault(group, set()).add(image.camera_idx)
    place = {group: min(those) for group, those in whose.items() if len(those) == 1}
    cameras, images = list(before.cameras), list(before.images)
    for record, camera in new:
        if record.camera_idx not in place:
            place[record.camera_idx] = len(cameras)
            cameras.append(camera)
        images.append(replace(record, camera_idx=place[record.camera_idx]))
    return ImageSet(tuple(images), tuple(cameras))
