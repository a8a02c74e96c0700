"""Photographs in memory, no more of them than fit."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import read_rgb

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord

# what the photographs that are kept may take; the one in use is kept in any case
_MOST_BYTES = 600 << 20


class Pictures:
    """Colours of photographs, read as they are needed; those used last are kept."""

    def __init__(self, records: Sequence[ImageRecord]) -> None:
        self._records = records
        self._kept: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()

    def __getitem__(self, k: int) -> NDArray[np.uint8]:
        """(H, W, 3) uint8. Raises InputError if it cannot be read any more."""
        if k not in self._kept:
            self._kept[k] = read_rgb(self._records[k])
            while len(self._kept) > 1 and sum(each.nbytes for each in self._kept.values()) > _MOST_BYTES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(k)
        return self._kept[k]
