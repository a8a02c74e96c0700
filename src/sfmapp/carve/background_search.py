"""The background of an object: where a camera stands still what is behind it, otherwise its colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfmapp.carve.backgrounds import ColorModel, Mask, Pixels, learn_colors, object_mask, without_specks
from sfmapp.carve.graph_cut import cut_by_mask, shrunk_picture
from sfmapp.carve.smooth_backgrounds import cut_from_smooth
from sfmapp.carve.still_backgrounds import StillBackground, cut_from_background, learn_background
from sfmapp.carve.still_cameras import still_groups
from sfmapp.carve.still_matching import edge_band
from sfmapp.errors import InputError
from sfmapp.images.folder import describe_images
from sfmapp.images.image_set import ImageOptions, ImageRecord
from sfmapp.images.pixels import read_rgb

if TYPE_CHECKING:
    from sfmapp.events import Events

STAGE = "masks"
# photographs that a background is learned from, at most
MAX_LEARNED = 48
# colours that overlap by more than this are not all: neighbours that look alike are kept together then
_TELLING = 0.005
# and by more than this, they tell little: each photograph is cut by itself, within its edges. Masks by colours came to
# 0.02 to 0.55 IoU at 2.9 to 16 % (two rendered solids before ten backgrounds), cuts to 0.84 to 0.999; by colours to
# 0.97 and more at 1.6 and 2.1 %
_ALIKE = 0.025
# before a still camera colours do where they overlap by less (Oxford's dinosaur before blue: 0.5 %, eight rendered sets
# before clutter 2.4 to 6.9 %), and take no more than this along the edges for the object
_PLAIN, _TAKEN = 0.01, 0.02
# so much of the outline of what never changes is told by its colours alone, from which on it is said: solids of
# revolution with a handle have 0.18 to 0.56, others up to 0.12 (benchmarks/masks_still.py)
_UNSURE = 0.15


@dataclass(frozen=True)
class Background:
    """What is known of it: colours, or what each place of the camera shows."""

    colors: ColorModel | None = None
    still: Sequence[StillBackground] = ()

    @property
    def source(self) -> str:
        """What tells the object, in a word for reports."""
        if self.colors is None:
            return "still background"
        return "dark background" if self.colors.is_dark else "background"

    def cut(self, picture: Pixels) -> Mask | None:
        """(H, W) the object in a photograph (H, W, 3); None if it does not show this background."""
        if self.colors is None:
            cuts = (cut_from_background(picture, scene) for scene in self.still)
            return next((cut for cut in cuts if cut is not None), None)
        mask = object_mask(picture, self.colors)
        if self.colors.error <= _TELLING:
            return mask
        cut = without_specks(cut_by_mask(picture, mask))
        # before what is dark shadows on the object fit as well
        return cut if self.colors.is_dark or self.colors.error <= _PLAIN else cut_from_smooth(picture, cut)


def spread(records: Sequence[ImageRecord], num: int) -> list[ImageRecord]:
    """So many of the photographs, evenly from first to last."""
    picked = np.unique(np.linspace(0, len(records) - 1, min(num, len(records))).round().astype(int))
    return [records[i] for i in picked]


def find_background(
    records: Sequence[ImageRecord], pictures: Sequence[Pixels], given: str | None, events: Events
) -> tuple[Background | None, float | None, list[str]]:
    """What the background is, the share of pixels that colours alone would tell wrongly, and lines for the user.

    Args:
        records: all photographs. pictures: some of them, (H, W, 3) each.
        given: file of a photograph of the background without the object, if there is one.

    Returns:
        No background where it looks too much like the object for its colours to tell, no share where these are not
        asked.

    Raises:
        InputError: nothing stands out of the background, or the photograph of it cannot be used.
    """
    model = None if given is not None else learn_colors(pictures)
    still = [] if _colors_do(model, pictures) else _still_backgrounds(records, pictures, given)
    if still:
        places = "one place" if len(still) == 1 else f"{len(still)} places"
        events.decided(
            STAGE,
            f"the camera stands still in {places}: what hides what is behind it is the object",
            num_places=len(still),
            num_photographs=len(pictures),
        )
        return Background(still=still), None, _told_of_still(still, events)
    if model is None:
        raise InputError(
            f"no object stands out of the background of {records[0].name} and {len(records) - 1} others",
            "give masks (--mask-path), or photographs with an alpha channel",
        )
    events.decided(
        STAGE, f"object and background by their colours, which overlap by {100 * model.error:.1f} %",
        color_error=model.error, num_photographs=len(pictures),
    )  # fmt: skip
    if model.error > _ALIKE:
        return None, model.error, [_cut_instead(model, events)]
    return Background(model), model.error, []


def _colors_do(model: ColorModel | None, pictures: Sequence[Pixels]) -> bool:
    """Whether colours tell the object though the camera may stand still: its background is a plain sheet, of which they
    take nothing for the object along the edges of the pictures."""
    if model is None or model.error > _PLAIN:
        return False
    small = [shrunk_picture(picture) for picture in pictures[::4]]
    taken = [object_mask(picture, model)[edge_band(picture.shape)] for picture in small]
    return bool(np.mean(np.concatenate(taken)) < _TAKEN)


def _still_backgrounds(
    records: Sequence[ImageRecord], pictures: Sequence[Pixels], given: str | None
) -> list[StillBackground]:
    """What is behind the object where the camera stands still, by a photograph of it or by what does not change; none
    if it moves.

    Raises:
        InputError: the photograph of the background cannot be used, or nothing is in front of it.
    """
    if given is None:
        groups = still_groups(pictures) or []
        found = [learn_background([pictures[i] for i in group]) for group in groups]
        return [] if any(each is None for each in found) else [each for each in found if each is not None]
    path = Path(given)
    record = describe_images(path.parent, [path.name], ImageOptions())[0][0]
    if record is None:
        raise InputError(f"{given}: expected a photograph of the background, found none that can be read")
    size = (records[0].width, records[0].height)
    if (record.width, record.height) != size:
        raise InputError(
            f"{given}: expected {size[0]}x{size[1]} pixels, as {records[0].name} has, found "
            f"{record.width}x{record.height}",
            "the background has to be photographed by the same camera from the same place",
        )
    scene = learn_background([p for p in pictures if p.shape[1::-1] == size], read_rgb(record))
    if scene is None:
        raise InputError(f"nothing is in front of {given} in {records[0].name} and {len(records) - 1} others")
    return [scene]


def _told_of_still(still: Sequence[StillBackground], events: Events) -> list[str]:
    """Say that what never changes is the object's by its colours alone."""
    unsure = max((scene.unsure for scene in still), default=0.0)
    if unsure < _UNSURE:
        return []
    line = (
        f"{100 * unsure:.0f} % of the outline of what the object never leaves is beside what never changes: there its "
        "colours alone tell it from the background"
    )
    events.warned(STAGE, f"{line}: look at the outlines, or give a photograph of the background (--background)")
    return [line]


def _cut_instead(model: ColorModel, events: Events) -> str:
    """Say that colours tell the object from its background badly."""
    line = (
        f"object and background look alike, their colours overlap by {100 * model.error:.1f} %: each photograph is cut "
        "by itself, where nothing of the object reaches its edges"
    )
    events.warned(STAGE, f"{line}: look at the outlines, or give masks (--mask-path)")
    return line
