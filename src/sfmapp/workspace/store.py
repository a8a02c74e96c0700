"""Features and matches of a run in ``database.db``: what is kept of an earlier run, and what is stored of this one."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.formats.database import Database
from sfmapp.matching.stage import MatchedPair, join_pairs, split_pairs
from sfmapp.scene.features import Features

if TYPE_CHECKING:
    from pathlib import Path

    from sfmapp.images.image_set import ImageSet

Pair = tuple[int, int]
# pairs per transaction: a killed run loses no more than these, and a transaction costs a hundredth of their matching
BATCH = 32


class Store:
    """The database of a workspace for one set of images; a context manager. Rows hold while their keys do."""

    def __init__(self, path: Path, image_set: ImageSet, feature_keys: Sequence[str], pair_key: str) -> None:
        """``feature_keys``: of each image; ``pair_key``: of all matches."""
        self._database = Database(path)
        self._pending: dict[Pair, MatchedPair] = {}
        self._pair_key = pair_key
        self._feature_keys = list(feature_keys)
        self._database.set_images(
            image_set.cameras,
            [record.name for record in image_set.images],
            [record.camera_idx for record in image_set.images],
            [(*gps[:2], gps[2] or 0.0) if (gps := record.gps) else None for record in image_set.images],
        )

    def known_features(self) -> dict[int, Features]:
        """Features by image position that were computed from the same pixels with the same options."""
        keys = self._database.feature_keys()
        return {i: self._database.read_features(i) for i, key in keys.items() if key == self._feature_keys[i]}

    def put_features(self, image_idx: int, features: Features) -> None:
        self._database.write_features(image_idx, features, self._feature_keys[image_idx])

    def known_pairs(self, wanted: NDArray[np.int32]) -> dict[Pair, MatchedPair]:
        """Wanted pairs that hold. If there are any others, they are removed from the database."""
        stored = self._database.pair_keys()
        pairs = [(int(i), int(j)) for i, j in wanted]
        usable = [pair for pair in pairs if stored.get(pair) == self._pair_key]
        known = self._database.read_pairs(np.array(usable, np.int32).reshape(-1, 2))
        if len(usable) < len(stored):
            self._database.clear_pairs()
            self._database.write_pairs(known, self._pair_key)
        return dict(zip(usable, split_pairs(known), strict=True))

    def put_pair(self, i: int, j: int, pair: MatchedPair) -> None:
        self._pending[i, j] = pair
        if len(self._pending) >= BATCH:
            self.flush()

    def flush(self) -> None:
        """Write the pairs that wait."""
        pairs = sorted(self._pending)
        found = join_pairs(np.array(pairs, np.int32), [self._pending[pair] for pair in pairs])
        self._database.write_pairs(found, self._pair_key)
        self._pending.clear()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.flush()
        self._database.close()
