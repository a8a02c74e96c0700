"""Features and matches of a run in ``database.db``: what is kept of an earlier run, and what is stored of this one."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

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
# Descriptors that stay in memory: those of 60 images of 8192 features, so that sets whose pairs are all matched are
# read once. Reading those of one image takes 0.4 ms, a fiftieth of matching a pair or less.
_KEPT_BYTES = 64 << 20


class StoredFeatures(Features):
    """Features whose descriptors, seven eighths of their memory, are in the database, and read when they are asked for.

    Args:
        features: as they were stored.
        read: gives their descriptors.
    """

    def __init__(self, features: Features, read: Callable[[], NDArray[Any]]) -> None:
        for name, value in {**vars(features.without_descriptors()), "_read": read}.items():
            if name != "descriptors":
                object.__setattr__(self, name, value)

    @property
    def descriptors(self) -> NDArray[Any]:
        read: Callable[[], NDArray[Any]] = vars(self)["_read"]
        return read()

    def without_descriptors(self) -> Features:
        return Features(self.keypoints, np.zeros((len(self), 0), np.uint8), self.rgb, self.metric, self.is_dark)


class Store:
    """The database of a workspace for one set of images; a context manager. Rows hold while their keys do."""

    def __init__(self, path: Path, image_set: ImageSet, feature_keys: Sequence[str], pair_key: str) -> None:
        """``feature_keys``: of each image; ``pair_key``: of all matches."""
        self._database = Database(path)
        self._pending: dict[Pair, MatchedPair] = {}
        self._pair_key = pair_key
        self._feature_keys = list(feature_keys)
        self._kept: OrderedDict[int, NDArray[Any]] = OrderedDict()
        self._kept_bytes = 0
        self._lock = threading.Lock()
        self._database.set_images(
            image_set.cameras,
            [record.name for record in image_set.images],
            [record.camera_idx for record in image_set.images],
            [(*gps[:2], gps[2] or 0.0) if (gps := record.gps) else None for record in image_set.images],
        )

    def known_features(self) -> dict[int, Features]:
        """Features by image position that were computed from the same pixels with the same options."""
        keys = self._database.feature_keys()
        good = [i for i, key in keys.items() if key == self._feature_keys[i]]
        return {i: self._as_stored(i, self._database.read_features(i)) for i in good}

    def put_features(self, image_idx: int, features: Features) -> Features:
        """Store features; the same ones, of which the descriptors are no longer in memory."""
        self._database.write_features(image_idx, features, self._feature_keys[image_idx])
        return self._as_stored(image_idx, features)

    def _as_stored(self, image_idx: int, features: Features) -> Features:
        self._keep(image_idx, features.descriptors)
        return StoredFeatures(features, lambda: self._descriptors(image_idx))

    def _descriptors(self, image_idx: int) -> NDArray[Any]:
        with self._lock:
            if (found := self._kept.get(image_idx)) is not None:
                self._kept.move_to_end(image_idx)
                return found
        found = self._database.read_features(image_idx).descriptors
        self._keep(image_idx, found)
        return found

    def _keep(self, image_idx: int, descriptors: NDArray[Any]) -> None:
        """Keep descriptors, and let go of those that were asked for longest ago."""
        with self._lock:
            if image_idx not in self._kept:
                self._kept_bytes += descriptors.nbytes
            self._kept[image_idx] = descriptors
            while self._kept_bytes > _KEPT_BYTES and len(self._kept) > 1:
                self._kept_bytes -= self._kept.popitem(last=False)[1].nbytes

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
