"""The extraction stage: what it hands on, whom it tells, and what it survives."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfmapp.errors import InterruptedRunError, UsageError
from sfmapp.events import Event, Events
from sfmapp.features.extract import (
    FeatureOptions,
    bytes_of_extraction,
    extract_features,
    features_from_picture,
)
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.pixels import Picture
from sfmapp.scene.features import Features
from test_features_sift import blobs, nearest, texture

SMALL = FeatureOptions(max_num_features=300)


def picture_of(gray: np.ndarray, mask: np.ndarray | None = None) -> Picture:
    return Picture(np.repeat(gray[:, :, None], 3, axis=2), gray, mask)


def image_set(folder: Path, pictures: dict[str, np.ndarray | bytes]) -> ImageSet:
    records = []
    for name, picture in pictures.items():
        if isinstance(picture, bytes):
            (folder / name).write_bytes(picture)
            records.append(ImageRecord(name, folder / name, 200, 150))
        else:
            cv2.imwrite(str(folder / name), picture)
            records.append(ImageRecord(name, folder / name, picture.shape[1], picture.shape[0]))
    return ImageSet(tuple(records), ())


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> ImageSet:
    return image_set(tmp_path_factory.mktemp("five"), {f"{i}.png": texture((200, 150), i) for i in range(5)})


def as_bytes(features: list[Features]) -> list[bytes]:
    return [f.keypoints.tobytes() + f.descriptors.tobytes() + f.rgb.tobytes() for f in features]


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_same_bytes_on_any_number_of_threads(five: ImageSet, kind: str) -> None:
    options = FeatureOptions(kind=kind, max_num_features=300)  # type: ignore[arg-type]
    one, report = extract_features(five, options, threads=1, events=Events())
    many, _ = extract_features(five, options, threads=5, events=Events())
    short, _ = extract_features(five, FeatureOptions(kind, 300, memory_mb=1), threads=5, events=Events())  # type: ignore[arg-type]
    assert as_bytes(one) == as_bytes(many) == as_bytes(short)
    assert [line["num_features"] for line in report["images"]] == [len(f) for f in one]
    assert report["num_features"] == sum(map(len, one)) > 500
    for f in one:
        assert f.keypoints.dtype == np.float32
        assert f.descriptors.shape == (len(f), 128 if kind == "sift" else 32)
        assert f.rgb.shape == (len(f), 3)
        assert (np.diff(f.keypoints[:, 2]) <= 0).all()


def test_known_features_are_kept_and_new_ones_told_in_this_thread(five: ImageSet) -> None:
    all_of_them, _ = extract_features(five, SMALL, threads=2, events=Events())
    told: list[tuple[int, threading.Thread]] = []
    heard: list[Event] = []

    def store(i: int, features: Features) -> Features:
        told.append((i, threading.current_thread()))
        return features

    features, report = extract_features(
        five, SMALL, threads=2, events=Events(heard.append), known={1: all_of_them[1], 3: all_of_them[3]},
        store=store,
    )  # fmt: skip
    assert sorted(i for i, _ in told) == [0, 2, 4]
    assert all(thread is threading.current_thread() for _, thread in told)
    assert features[1] is all_of_them[1]
    assert as_bytes(features) == as_bytes(all_of_them)
    assert report["num_known"] == 2
    assert [e.kind for e in heard] == ["started", "advanced", "advanced", "advanced", "finished"]
    assert heard[-2].done == heard[-2].total == 3


def test_a_stop_is_obeyed_and_what_is_done_was_told(five: ImageSet) -> None:
    told: list[int] = []
    events = Events()

    def stop(i: int, features: Features) -> Features:
        told.append(i)
        events.cancel()
        return features

    threads = cv2.getNumThreads()
    with pytest.raises(InterruptedRunError):
        extract_features(five, SMALL, threads=1, events=events, store=stop)
    assert len(told) == 1
    assert cv2.getNumThreads() == threads


def test_broken_and_empty_images_warn_by_name(tmp_path: Path) -> None:
    images = image_set(
        tmp_path,
        {
            "good.png": texture((200, 150)),
            "flat.png": np.full((150, 200), 77, np.uint8),
            "broken.jpg": b"\xff\xd8\xff\xe0 no picture",
            "faint.png": blobs(np.array([[60.0, 60.0]]), np.array([5.0]), (150, 130)),
        },
    )
    heard: list[Event] = []
    features, report = extract_features(images, SMALL, threads=2, events=Events(heard.append))
    assert len(features[0]) == 300
    assert len(features[1]) == len(features[2]) == 0
    assert 0 < len(features[3]) < 100
    warned = sorted(e.message.split(":")[0] for e in heard if e.kind == "warned")
    assert warned == ["broken.jpg", "faint.png", "flat.png"]
    assert len(report["warnings"]) == 3
    assert features[2].descriptors.shape == (0, 128)


@pytest.mark.parametrize("size", [(1501, 1001), (640, 1237)])
def test_large_images_are_scaled_down_and_keypoints_back(size: tuple[int, int]) -> None:
    """House pixels scale from the corner of the image: a half pixel lost would show as a bias of half the factor."""
    grid = np.stack(np.meshgrid(np.arange(1, 6), np.arange(1, 6)), axis=-1).reshape(-1, 2)
    ground_truth = grid * (np.array(size) / 6.0)
    gray = blobs(ground_truth, np.full(len(ground_truth), 9.0), size)
    features, scale, _ = features_from_picture(picture_of(gray), FeatureOptions(max_size_px=400))
    assert scale == pytest.approx(400 / max(size))
    found = features.keypoints[nearest(features.keypoints[:, :2], ground_truth)]
    error = found[:, :2] - ground_truth
    assert np.abs(error.mean(axis=0)).max() < 0.05
    assert np.abs(error).max() < 0.2
    assert np.abs(found[:, 2] / 9.0 - 1).max() < 0.2


def test_colours_are_those_under_the_keypoints() -> None:
    gray = texture((200, 150))
    rgb = np.stack([gray, np.roll(gray, 40, axis=1), 255 - gray], axis=2)
    features, _, _ = features_from_picture(Picture(rgb, gray, None), SMALL)
    x, y = np.floor(features.keypoints[:, :2]).astype(int).T
    np.testing.assert_array_equal(features.rgb, rgb[y, x])


def test_masks_blank_orb_as_well() -> None:
    usable = np.zeros((150, 200), bool)
    usable[:, 100:] = True
    features, _, _ = features_from_picture(picture_of(texture((200, 150)), usable), FeatureOptions(kind="orb"))
    assert len(features) > 50
    assert features.keypoints[:, 0].min() >= 100


def test_memory_estimate_covers_what_is_taken() -> None:
    """Bytes that numpy hands out while a picture of two megapixels is worked on, against the estimate."""
    import tracemalloc

    picture = picture_of(texture((1600, 1250)))
    tracemalloc.start()
    features_from_picture(picture, FeatureOptions())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    estimate = bytes_of_extraction(ImageRecord("a", Path("a"), 1600, 1250), FeatureOptions())
    assert 0.6 * estimate < peak < estimate
    # fifty megapixels are scaled down first
    large = bytes_of_extraction(ImageRecord("a", Path("a"), 8660, 5773), FeatureOptions())
    assert large < 1.2e9


@pytest.mark.parametrize(
    "wrong",
    [{"kind": "surf"}, {"max_num_features": 0}, {"max_size_px": 0}, {"edge_threshold": 0.0}, {"memory_mb": 0}],
)
def test_impossible_options_name_the_field(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=f"features.{next(iter(wrong))}"):
        FeatureOptions(**wrong)  # type: ignore[arg-type]


def test_keypoints_stay_without_descriptors() -> None:
    features = features_from_picture(picture_of(texture((200, 150))), FeatureOptions(max_num_features=100))[0]
    alone = features.without_descriptors()
    assert alone.descriptors.shape == (100, 0)
    assert alone.descriptors.base is None  # which would hold them all
    np.testing.assert_array_equal(alone.keypoints, features.keypoints)
    np.testing.assert_array_equal(alone.rgb, features.rgb)
