"""Features and matches in the database of a run: what stays in memory, and that they come back the same."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.scene.features import DescriptorMetric, Features
from sfmapp.workspace import store as store_module
from sfmapp.workspace.store import Store

NUM = 6


def some_features(seed: int, metric: DescriptorMetric) -> Features:
    rng = np.random.default_rng(seed)
    count = 50 + seed
    descriptors = {
        DescriptorMetric.ROOT_SIFT: rng.integers(0, 100, (count, 128), np.uint8),
        DescriptorMetric.HAMMING: rng.integers(0, 256, (count, 32), np.uint8),
        DescriptorMetric.L2: rng.random((count, 64), np.float32),
    }[metric]
    return Features(rng.random((count, 4), np.float32), descriptors, rng.integers(0, 256, (count, 3), np.uint8), metric)


def opened(folder: Path, keys: list[str]) -> Store:
    camera = simple_camera(CameraModel.PINHOLE, 640, 480, 500.0)
    records = tuple(ImageRecord(f"{i}.png", folder / f"{i}.png", 640, 480) for i in range(NUM))
    return Store(folder / "database.db", ImageSet(records, (camera,)), keys, "pairs")


def same(one: Features, other: Features) -> bool:
    names = ("keypoints", "descriptors", "rgb")
    return one.metric == other.metric and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in names
    )


@pytest.mark.parametrize("metric", DescriptorMetric)
def test_stored_features_are_the_same_and_few_descriptors_stay_in_memory(
    metric: DescriptorMetric, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [some_features(i, metric) for i in range(NUM)]
    room = 2 * given[-1].descriptors.nbytes
    monkeypatch.setattr(store_module, "_KEPT_BYTES", room)
    keys = [f"key {i}" for i in range(NUM)]
    with opened(tmp_path, keys) as store:
        stored = [store.put_features(i, given[i]) for i in range(NUM)]
        assert sum(d.nbytes for d in store._kept.values()) <= room
        with ThreadPoolExecutor(4) as pool:  # as those who match ask for them
            found = list(pool.map(lambda i: same(stored[i % NUM], given[i % NUM]), range(8 * NUM)))
        assert all(found)
        assert sum(d.nbytes for d in store._kept.values()) == store._kept_bytes <= room
        np.testing.assert_array_equal(stored[1].whole_numbers(7), given[1].whole_numbers(7))
        assert stored[2].without_descriptors().descriptors.shape == (len(given[2]), 0)
    keys[3] = "another key"
    with opened(tmp_path, keys) as store:
        known = store.known_features()
        assert sorted(known) == [0, 1, 2, 4, 5]
        assert all(same(known[i], given[i]) for i in known)
        assert store._kept_bytes <= room


def test_one_image_with_more_descriptors_than_there_is_room_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_module, "_KEPT_BYTES", 1)
    given = some_features(0, DescriptorMetric.ROOT_SIFT)
    with opened(tmp_path, ["key"] * NUM) as store:
        assert same(store.put_features(0, given), given)
