"""Which pairs are matched: exact counts, true neighbours, sequences with gaps, and the same bytes on any thread."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from sfmapp.errors import UsageError
from sfmapp.events import Event, Events
from sfmapp.features.extract import FeatureOptions, features_from_picture
from sfmapp.images.headers import read_header
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.pixels import read_picture
from sfmapp.images.position import Position
from sfmapp.matching.pairs import PairOptions, find_sequences, image_vector, learn_vocabulary, select_pairs
from sfmapp.scene.features import Features


def records(names: list[str], **more: object) -> tuple[ImageRecord, ...]:
    return tuple(ImageRecord(name, Path(name), 100, 100, **more) for name in names)  # type: ignore[arg-type]


def features_of(descriptors: np.ndarray) -> Features:
    num = len(descriptors)
    metric = "root_sift" if descriptors.shape[1] == 128 else "hamming"
    return Features.from_arrays(np.zeros((num, 2)), descriptors, metric=metric)


def plain(num: int) -> list[Features]:
    """Features that say nothing: the same single descriptor everywhere."""
    return [features_of(np.full((1, 128), 45, np.uint8)) for _ in range(num)]


def ring(num_images: int, num_seen: int, seed: int, width: int = 128) -> list[Features]:
    """A closed ring of points with random descriptors; image i sees those from its place on, half of them shared with
    the next image, each a little changed."""
    rng = np.random.default_rng(seed)
    step = num_seen // 2
    points = rng.gamma(0.5, 1.0, (num_images * step, width))
    result = []
    for i in range(num_images):
        seen = points[(i * step + np.arange(num_seen)) % len(points)]
        if width == 128:
            changed = seen * rng.uniform(0.7, 1.3, seen.shape)
            descriptors = np.rint(512 * np.sqrt(changed / changed.sum(axis=1, keepdims=True))).clip(0, 255)
        elif width == 64:
            result.append(Features.from_arrays(np.zeros((num_seen, 2)), seen * rng.uniform(0.7, 1.3, seen.shape) - 0.5))
            continue
        else:
            bits = (seen > np.median(points)) ^ (rng.random(seen.shape) < 0.05)
            descriptors = np.packbits(bits, axis=1)
        result.append(features_of(descriptors.astype(np.uint8)))
    return result


def select(
    images: tuple[ImageRecord, ...], features: list[Features], options: PairOptions, seed: int = 0, threads: int = 2
) -> tuple[np.ndarray, dict]:
    return select_pairs(ImageSet(images, ()), features, options, seed=seed, threads=threads, events=Events())


@pytest.mark.parametrize("method", ["exhaustive", "sequential", "retrieval"])
def test_files_that_are_mirror_images_are_not_matched_with_others(method: str) -> None:
    orientation = [1, 2, 3, 4, 5, 6, 7, 8]
    images = tuple(
        replace(r, orientation=o) for r, o in zip(records([f"{i}.jpg" for i in orientation]), orientation, strict=True)
    )
    pairs, _ = select(images, ring(8, 60, 0), PairOptions(method=method))  # type: ignore[arg-type]
    assert_well_formed(pairs)
    assert len(pairs)
    for i, j in pairs.tolist():
        assert (orientation[i] in (2, 4, 5, 7)) == (orientation[j] in (2, 4, 5, 7))
    if method == "exhaustive":
        assert len(pairs) == 12


def as_set(pairs: np.ndarray) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in pairs}


def assert_well_formed(pairs: np.ndarray) -> None:
    assert pairs.dtype == np.int32
    assert pairs.shape[1:] == (2,)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    np.testing.assert_array_equal(pairs, np.unique(pairs, axis=0))


@pytest.mark.parametrize("num", [0, 1, 2, 17, 60])
def test_small_sets_are_matched_exhaustively(num: int) -> None:
    pairs, report = select(records([f"{i}.jpg" for i in range(num)]), plain(num), PairOptions())
    assert_well_formed(pairs)
    assert as_set(pairs) == {(i, j) for j in range(num) for i in range(j)}
    assert report["method"] == "exhaustive"
    assert report["num_pairs"] == report["num_possible"] == num * (num - 1) // 2
    assert "pairs.exhaustive_limit = 60" in report["reason"]


def test_images_without_features_are_left_out_and_named() -> None:
    features = plain(5)
    features[2] = features_of(np.zeros((0, 128), np.uint8))
    pairs, report = select(records(list("abcde")), features, PairOptions())
    assert as_set(pairs) == {(i, j) for j in (1, 3, 4) for i in (0, 1, 3) if i < j}
    assert report["images_without_features"] == ["c"]


@pytest.mark.parametrize("width", [64, 128, 256])
def test_retrieval_finds_the_neighbours_of_a_ring(width: int) -> None:
    num = 70
    features = ring(num, 120, seed=3, width=width)
    order = np.random.default_rng(0).permutation(num)
    shuffled = [features[i] for i in order]
    options = PairOptions(num_neighbors=4, num_words=32)
    # names that tell nothing about the order
    pairs, report = select(records([f"{crc32(bytes([int(i)]))}.jpg" for i in order]), shuffled, options)
    assert_well_formed(pairs)
    found = {tuple(sorted((int(order[i]), int(order[j])))) for i, j in pairs}
    true = {tuple(sorted((i, (i + 1) % num))) for i in range(num)}
    assert len(true & found) / len(true) > 0.95
    assert len(found) < 4.5 * num
    assert report["num_by_source"]["retrieval"] <= len(pairs)
    assert report["min_pairs_per_image"] >= 4


@pytest.mark.parametrize("width", [64, 128, 256])
def test_same_pairs_on_any_number_of_threads(width: int) -> None:
    from threadpoolctl import threadpool_limits

    features = ring(64, 80, seed=5, width=width)
    images = records([f"{i}.jpg" for i in range(64)])
    options = PairOptions(method="retrieval", num_neighbors=5, num_words=16)
    expected, _ = select(images, features, options, threads=1)
    # more threads of a BLAS than cores spin: 7 took 7.5 CPU s for what one does in 0.1
    for threads, blas_threads in ((2, 2), (7, 1)):
        with threadpool_limits(blas_threads):
            pairs, _ = select(images, features, options, threads=threads)
        assert pairs.tobytes() == expected.tobytes()
    other, _ = select(images, features, options, seed=1)
    assert {(i, i + 1) for i in range(63)} <= as_set(other) & as_set(expected)


def test_every_product_is_a_whole_number_that_float32_holds() -> None:
    """What the promise of the same bytes rests on."""
    features = ring(8, 400, seed=1)
    words = learn_vocabulary(features, PairOptions(), seed=0)
    np.testing.assert_array_equal(words, np.rint(words))
    assert (words**2).sum(axis=1, dtype=np.float64).max() < 2**24
    vectors = np.stack([image_vector(f.descriptors.astype(np.float32), words) for f in features])
    np.testing.assert_array_equal(vectors, np.rint(vectors))
    squares = (vectors.astype(np.float64) ** 2).sum(axis=1)
    assert squares.max() < 2**24
    assert squares.min() > 0.9 * 4000**2
    np.testing.assert_array_equal(vectors @ vectors.T, vectors.astype(np.int64) @ vectors.astype(np.int64).T)


def test_images_with_a_handful_of_features_do_not_stop_retrieval() -> None:
    pairs, _ = select(records([f"x{i}" for i in range(80)]), plain(80), PairOptions(num_neighbors=3))
    assert_well_formed(pairs)
    assert len(pairs) >= 80


def test_sequences_follow_the_numbers_over_gaps() -> None:
    """Neighbours are those next in order, however many frames were dropped between them."""
    numbers = [1, 2, 3, 7, 8, 30, 31, 32, 100]
    names = [f"cam/frame_{n}.jpg" for n in numbers]
    order = np.random.default_rng(2).permutation(len(names))
    options = PairOptions(method="sequential", sequence_overlap=2, sequence_quadratic=False)
    pairs, report = select(records([names[i] for i in order]), plain(len(names)), options)
    found = {tuple(sorted((numbers[order[i]], numbers[order[j]]))) for i, j in pairs}
    expected = {(numbers[k], numbers[k + d]) for d in (1, 2) for k in range(len(numbers) - d)}
    assert found == expected
    assert report["method"] == "sequential"


def test_quadratic_overlap_reaches_back_by_powers_of_two() -> None:
    names = [f"{i:04d}.png" for i in range(100)]
    options = PairOptions(method="sequential", sequence_overlap=5)
    pairs, _ = select(records(names), plain(100), options)
    assert {j - i for i, j in as_set(pairs)} == {1, 2, 3, 4, 5, 8, 16, 32}
    assert as_set(pairs) >= {(i, i + 1) for i in range(99)}


def test_sequences_do_not_cross_folders() -> None:
    names = [f"left/{i}.jpg" for i in range(40)] + [f"right/{i}.jpg" for i in range(40)]
    assert find_sequences(records(names)) == [list(range(40)), list(range(40, 80))]


def test_names_of_many_hands_are_no_sequence() -> None:
    rng = np.random.default_rng(0)
    names = [f"{n}_o.jpg" for n in rng.integers(10**8, 10**9, 80)]
    assert find_sequences(records(names)) == []
    # a camera's roll with photographs deleted, and every thirtieth frame of a video, are
    assert find_sequences(records([f"IMG_{n:04d}.JPG" for n in (3, 4, 5, 9, 10, 12, 13, 17)])) == [list(range(8))]
    assert find_sequences(records([f"f{30 * n:06d}.jpg" for n in range(50)])) == [list(range(50))]


def test_chosen_frames_of_a_video_are_a_sequence_however_far_apart() -> None:
    numbers = np.cumsum(np.random.default_rng(2).integers(5, 400, 30))
    names = [f"{video}/frame_{n:06d}.jpg" for video in ("back", "walk") for n in numbers]
    assert find_sequences(records(names)) == [list(range(30)), list(range(30, 60))]


def test_time_stamps_order_what_names_do_not() -> None:
    rng = np.random.default_rng(1)
    names = [f"{n:032x}.jpg" for n in rng.integers(2**60, 2**62, 10)]
    times = rng.permutation(10).astype(float)
    images = tuple(
        ImageRecord(n, Path(n), 9, 9, timestamp=t, make="Make", model="One") for n, t in zip(names, times, strict=True)
    )
    assert find_sequences(images) == [list(np.argsort(times))]


def test_gps_joins_what_looks_different() -> None:
    """On a line of 70 photographs 11 m apart, without altitude, the next ones are paired."""
    images = tuple(
        ImageRecord(f"{crc32(bytes([i]))}.jpg", Path("x"), 9, 9, position=Position(47.0 + i * 1e-4, 8.0, None))
        for i in range(70)
    )
    rng = np.random.default_rng(0)
    features = [features_of(rng.integers(0, 90, (50, 128), np.uint8)) for _ in range(70)]
    pairs, report = select(images, features, PairOptions(num_gps_neighbors=4, num_neighbors=1))
    assert as_set(pairs) >= {(i, i + 1) for i in range(69)} | {(i, i + 2) for i in range(68)}
    # the outermost two at either end look three and four ahead
    assert report["num_by_source"]["gps"] == 69 + 68 + 2 * 3
    assert len(pairs) <= 69 + 68 + 2 * 3 + 70


def test_report_and_events_say_which_and_why() -> None:
    heard: list[Event] = []
    image_set = ImageSet(records([f"{i}.jpg" for i in range(61)]), ())
    pairs, report = select_pairs(image_set, plain(61), PairOptions(), seed=0, threads=1, events=Events(heard.append))
    assert [e.kind for e in heard] == ["started", "decided", "finished"]
    assert report["method"] == "auto"
    assert set(report["num_by_source"]) == {"retrieval", "sequence", "gps"}
    assert "61 images" in report["reason"]
    assert report["num_pairs"] == len(pairs) < report["num_possible"]


@pytest.mark.parametrize("wrong", [{"method": "all"}, {"num_words": 0}, {"exhaustive_limit": -1}])
def test_impossible_options_name_the_field(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=f"pairs.{next(iter(wrong))}"):
        PairOptions(**wrong)  # type: ignore[arg-type]


@pytest.mark.real
def test_scenes_that_are_mixed_up_stay_apart(data_root: Path) -> None:
    """Five scenes in one heap: each image's nearest ones are of its own scene, and the next view is among them."""
    folders = {"fountain-P11": 11, "herz-jesus-P8": 8, "lund-door": 12, "temple-sparse-ring": 16, "pano-sponza-rot": 18}
    options = FeatureOptions(max_size_px=640, max_num_features=2000)
    images: list[ImageRecord] = []
    features: list[Features] = []
    scene: list[int] = []
    for number, (folder, count) in enumerate(folders.items()):
        paths = sorted((data_root / folder / "images").iterdir())
        assert len(paths) == count
        for path in paths:
            header = read_header(path.read_bytes())
            name = f"{crc32(folder.encode()) ^ len(images):08x}.jpg"
            images.append(ImageRecord(name, path, header.width, header.height))
            features.append(features_from_picture(read_picture(images[-1]), options)[0])
            scene.append(number)
    num_neighbors = 5
    pairs, report = select(tuple(images), features, PairOptions(method="retrieval", num_neighbors=num_neighbors))
    assert_well_formed(pairs)
    found, scenes = as_set(pairs), np.array(scene)
    across = (scenes[pairs[:, 0]] != scenes[pairs[:, 1]]).mean()
    assert across < 0.05
    following = {(i, i + 1) for i in range(len(scene) - 1) if scene[i] == scene[i + 1]}
    assert len(following & found) / len(following) > 0.85
    assert report["min_pairs_per_image"] >= num_neighbors
