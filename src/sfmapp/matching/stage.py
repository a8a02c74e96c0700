"""The matching stage: descriptors of image pairs in, verified correspondences out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.executor import Executor, Threads
from sfmapp.formats.feature_files import feature_file, read_feature_file, write_feature_file
from sfmapp.geometry import epipolar, five_point, fundamental_refinement, homography, relative_pose, turned_views
from sfmapp.matching import guided
from sfmapp.matching.coarse_to_fine import Putative, is_guidable, match_features
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.products import Ints
from sfmapp.matching.report import MatchingReport, PairReport
from sfmapp.matching.search import Ransac
from sfmapp.matching.two_view import TwoViewGeometry, error_threshold_px, verify_pair
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.features import Features

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet

__all__ = [
    "MatchedPair",
    "MatchingOptions",
    "compile_kernels",
    "join_pairs",
    "match_images",
    "match_pair",
    "split_pairs",
    "verify_matches",
]

_STAGE = "matching"
# Pairs are done square by square of so many images by as many. Workers that share no memory get as many pairs as one
# holds at a time: they take some seconds, and progress comes as often.
_BLOCK = 8
# In one or two pairs it may be anything that went by.
_MANY_MOVING = 3


@dataclass(frozen=True)
class MatchedPair:
    """One pair when it is done: the unit of resuming.

    Attributes:
        matches: (K, 2) int32 verified matches.
        num_putative: matches before verification.
        geometry: the two-view geometry; its ``is_inlier`` is dropped for the matches above.
        num_coarse: matches among the largest features that were to guide the others, None if there was no need.
        is_guided: they did.
        num_compared: features of each image, largest first, that showed nothing in common; None: all were compared.
        cpu_s: processor seconds of the thread that did it.
    """

    matches: NDArray[np.int32]
    num_putative: int
    geometry: TwoViewGeometry
    num_coarse: int | None = None
    is_guided: bool = False
    num_compared: int | None = None
    cpu_s: float = 0.0


def match_images(
    image_set: ImageSet,
    features: Sequence[Features],
    pair_image_idx: NDArray[np.int32],
    options: MatchingOptions,
    *,
    seed: int,
    threads: int,
    events: Events,
    known: Mapping[tuple[int, int], MatchedPair] | None = None,
    on_pair: Callable[[int, int, MatchedPair], None] | None = None,
    executor: Executor | None = None,
) -> tuple[Correspondences, MatchingReport]:
    """Match and verify pairs of images. The result is the same, byte for byte, for any number of threads.

    Args:
        image_set: whose images have ``camera_idx``, and whose cameras stand in ``cameras``.
        features: one for each image.
        pair_image_idx: (P, 2) int32 positions i < j of images, sorted.
        known: pairs that an earlier run has finished; they are taken over as they are.
        on_pair: called in the calling thread with i, j and the result as each new pair is done, in any order.
        executor: who matches; None: ``threads`` of this process.

    Returns:
        The correspondences, and a report: totals, counts by configuration, and one entry for each pair.

    Raises:
        InterruptedRunError: a stop was asked for; pairs given to ``on_pair`` are complete.
    """
    cameras = [image_set.cameras[image.camera_idx] for image in image_set.images]
    pairs = [(int(i), int(j)) for i, j in pair_image_idx]
    done: dict[tuple[int, int], MatchedPair] = {p: known[p] for p in pairs if p in known} if known else {}
    num_known = len(done)
    start = time.monotonic()
    events.started(_STAGE, f"matching {len(pairs)} pairs", total=len(pairs))
    if num_known:
        events.advanced(_STAGE, num_known)
    _tell_of_blind_corners(cameras, features, events)
    executor = executor or Threads(threads)
    blocks = _blocks([pair for pair in pairs if pair not in done], image_set, executor)
    work = _work(executor, image_set, features, blocks, options, seed)
    with closing(executor.run(work, blocks)) as answers:
        for n, found in answers:
            for (i, j), matched in zip(blocks[n].pairs, found, strict=True):
                done[i, j] = matched
                if on_pair is not None:
                    on_pair(i, j, matched)
                events.advanced(_STAGE)
    results = [done[p] for p in pairs]
    report = _report(pairs, results, num_known, time.monotonic() - start)
    if (num_moving := report.num_pairs_with_moving_plane) >= _MANY_MOVING:
        events.warned(
            _STAGE,
            f"in {num_moving} pairs something flat moves differently from the scene (held into the picture, on the "
            "camera, or a background that stays while the object turns); its matches were left out. A mask over it "
            "(images.mask_path) is better",
        )
    events.finished(_STAGE, f"{report.num_verified_pairs} of {len(pairs)} pairs verified", **report)
    return join_pairs(pair_image_idx, results), report


@dataclass(frozen=True)
class _Block:
    """Pairs (i, j) that are matched at one go, and of their images, by position, names and cameras."""

    pairs: tuple[tuple[int, int], ...]
    names: Mapping[int, str]
    cameras: Mapping[int, Camera]


def _blocks(pairs: list[tuple[int, int]], image_set: ImageSet, executor: Executor) -> list[_Block]:
    """All pairs in blocks: of one each where memory is shared, else of few images, as these are read for each block.

    Pairs of the same images follow one another also in the first case, for those who read them from a database.
    """
    images = image_set.images
    ordered = _by_squares(pairs, len(images), is_sparse=executor.folder is not None)
    size = 1 if executor.folder is None else _BLOCK**2
    parts = [ordered[start : start + size] for start in range(0, len(ordered), size)]
    blocks = []
    for part in parts:
        both = sorted({i for pair in part for i in pair})
        names = {i: images[i].name for i in both} if executor.folder is not None else {}
        blocks.append(_Block(tuple(part), names, {i: image_set.cameras[images[i].camera_idx] for i in both}))
    return blocks


def _by_squares(pairs: list[tuple[int, int]], num_images: int, *, is_sparse: bool) -> list[tuple[int, int]]:
    """Pairs square by square of the table of all pairs, so that those that follow one another have images in common.

    Where ``is_sparse``, images are numbered anew if that brings those that are compared nearer to each other (Cuthill
    and McKee, Reducing the bandwidth of sparse symmetric matrices, 1969): where names say nothing of places, 64 pairs
    of 10,000 images on a plane then have 36 images and not 74; where names follow a walk over it they have 31.
    """
    table = np.array(pairs, np.int64).reshape(-1, 2)
    if is_sparse and len(table):
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        graph = coo_matrix((np.ones(len(table)), table.T), shape=(num_images, num_images)).tocsr()
        rank = np.empty(num_images, np.int64)
        rank[reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True)] = np.arange(num_images)
        numbered = rank[table]
        if np.ptp(numbered, axis=1).mean() < np.ptp(table, axis=1).mean():
            table = numbered
    square = np.sort(table, axis=1) // _BLOCK
    order = np.lexsort((table[:, 1], table[:, 0], square[:, 1], square[:, 0]))
    return [pairs[n] for n in order.tolist()]


def _work(
    executor: Executor, image_set: ImageSet, features: Sequence[Features], blocks: Sequence[_Block],
    options: MatchingOptions, seed: int,
) -> Callable[[_Block], list[MatchedPair]]:  # fmt: skip
    """What an executor does with a block; features are in files, or their backgrounds known, when it returns."""
    wanted = sorted({i for block in blocks for pair in block.pairs for i in pair})
    if (folder := executor.folder) is not None:
        for i in wanted:
            path = feature_file(folder, image_set.images[i].name)
            if not path.exists():  # those of an earlier run
                write_feature_file(path, features[i])
        return partial(_match_stored, folder, options, seed)
    guidable = [i for i in wanted if is_guidable(features[i], options)]
    with closing(executor.run(lambda i: guided.background_of(features[i]), guidable)) as found:
        backgrounds = {guidable[n]: background for n, background in found}
    return partial(_match_block, lambda i: (features[i], backgrounds.get(i)), options, seed)


def _match_block(
    side: Callable[[int], tuple[Features, Ints | None]], options: MatchingOptions, seed: int, block: _Block
) -> list[MatchedPair]:
    """The pairs of a block; ``side`` gives features and background of an image, see :func:`match_features`."""
    out = []
    for i, j in block.pairs:
        (features1, background1), (features2, background2) = side(i), side(j)
        cameras = block.cameras[i], block.cameras[j]
        out.append(match_pair((features1, features2), (background1, background2), cameras, options, (seed, i, j)))
    return out


def _match_stored(folder: Path, options: MatchingOptions, seed: int, block: _Block) -> list[MatchedPair]:
    """The pairs of a block whose features are files in a folder."""
    return _match_block(lambda i: _read_side(folder, block.names[i], options), options, seed, block)


@lru_cache(maxsize=_BLOCK**2)
def _read_side(folder: Path, name: str, options: MatchingOptions) -> tuple[Features, Ints | None]:
    features = read_feature_file(feature_file(folder, name))
    return features, guided.background_of(features) if is_guidable(features, options) else None


def _tell_of_blind_corners(cameras: Sequence[Camera], features: Sequence[Features], events: Events) -> None:
    """Say how many features lie where their lens has no inverse, as in the corners about a circular picture."""
    total = blind = 0
    for camera, each in zip(cameras, features, strict=True):
        if camera.is_wide:
            xy = each.keypoints[:, :2].astype(np.float64)
            total += len(xy)
            blind += int(np.isnan(pixels_to_rays(camera, xy)[:, 0]).sum())
    if blind:
        events.warned(
            _STAGE,
            f"{blind} of {total} features of wide lenses lie where the lens has no inverse: pairs are verified without "
            "them. If they are not in the black corners of the picture, the calibration is not of this lens",
        )


def verify_matches(
    image_set: ImageSet,
    features: Sequence[Features],
    matches: Iterable[tuple[int, int, NDArray[np.integer]]],
    options: MatchingOptions,
    *,
    seed: int,
    threads: int,
    events: Events,
) -> tuple[Correspondences, MatchingReport]:
    """Verify matches that somebody else has found; otherwise as :func:`match_images`.

    Args:
        matches: two positions i < j of images, no two pairs alike, and (K, 2) positions of their keypoints. What gives
            them is asked in the calling thread, one pair after the other.

    Raises:
        InputError: positions of images or keypoints that are not there, or a pair that comes twice.
        InterruptedRunError: a stop was asked for.
    """
    start = time.monotonic()
    cameras = [image_set.cameras[image.camera_idx] for image in image_set.images]
    events.started(_STAGE, "verifying matches", total=None)
    _tell_of_blind_corners(cameras, features, events)
    futures: dict[tuple[int, int], Future[MatchedPair]] = {}
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        try:
            for i, j, found in matches:
                if not 0 <= i < j < len(cameras) or (i, j) in futures:
                    text = f"expected each pair once, with positions i < j below {len(cameras)}"
                    raise InputError(f"matches of images {i} and {j}: {text}")
                pair = features[i], features[j]
                checked = _checked_matches(found, (len(pair[0]), len(pair[1])), (i, j))
                futures[i, j] = pool.submit(
                    match_pair, pair, (None, None), (cameras[i], cameras[j]), options, (seed, i, j), checked
                )
                events.advanced(_STAGE)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        pairs = sorted(futures)
        results = [futures[pair].result() for pair in pairs]
    report = _report(pairs, results, 0, time.monotonic() - start)
    events.finished(_STAGE, f"{report['num_verified_pairs']} of {len(pairs)} pairs verified", **report)
    return join_pairs(np.array(pairs, np.int32), results), report


def _checked_matches(
    matches: NDArray[np.integer], num_keypoints: tuple[int, int], images: tuple[int, int]
) -> NDArray[np.int32]:
    array = np.asarray(matches)
    if array.size == 0:
        return np.zeros((0, 2), np.int32)
    where = f"matches of images {images[0]} and {images[1]}"
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        raise InputError(f"{where}: expected whole numbers (K, 2), found {array.dtype} {array.shape}")
    low, high = array.min(axis=0), array.max(axis=0)
    if low.min() < 0 or (high >= num_keypoints).any():
        raise InputError(
            f"{where}: expected positions among {num_keypoints[0]} and {num_keypoints[1]} keypoints, found "
            f"{low.tolist()} to {high.tolist()}"
        )
    return np.ascontiguousarray(array, np.int32)


def match_pair(
    features: tuple[Features, Features],
    backgrounds: tuple[Ints | None, Ints | None],
    cameras: tuple[Camera, Camera],
    options: MatchingOptions,
    seed: tuple[int, int, int],
    given: NDArray[np.int32] | None = None,
) -> MatchedPair:
    """Match and verify one pair, or verify matches that are given.

    Args:
        backgrounds: see ``match_features``.
        seed: the run's seed and the positions of the two images.
        given: (K, 2) int32 matches, in place of those that we find.
    """
    start = time.thread_time()
    # 31 bits: OpenCV's state is a signed int
    ransac = Ransac(options.max_ransac_trials, int(np.random.SeedSequence(seed).generate_state(1)[0]) & 0x7FFFFFFF)
    if any(camera.is_wide for camera in cameras):
        backgrounds = (None, None)  # epipolar lines of what lies behind a camera are none
    if given is not None:
        putative = Putative(given)
    else:
        putative = match_features(features, backgrounds, error_threshold_px(*cameras, options), options, ransac)
    xy1, xy2 = (
        np.ascontiguousarray(f.keypoints[putative.matches[:, side], :2], np.float64) for side, f in enumerate(features)
    )
    geometry = verify_pair(xy1, xy2, *cameras, options, ransac, fundamental=putative.fundamental)
    matches = np.ascontiguousarray(putative.matches[geometry.is_inlier])
    geometry.is_inlier = np.empty(0, bool)
    return MatchedPair(
        matches,
        len(putative.matches),
        geometry,
        putative.num_coarse,
        putative.fundamental is not None,
        putative.num_compared,
        time.thread_time() - start,
    )


def join_pairs(pair_image_idx: NDArray[np.int32], results: Sequence[MatchedPair]) -> Correspondences:
    """Pairs that are done, in the order of pair_image_idx (P, 2), as flat arrays."""
    geometries = [r.geometry for r in results]

    def stack(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
        return np.array([getattr(g, name) for g in geometries], dtype).reshape((len(results), *shape))

    pair_ptr = np.zeros(len(results) + 1, np.int64)
    np.cumsum([len(r.matches) for r in results], out=pair_ptr[1:])
    return Correspondences(
        pair_image_idx=np.ascontiguousarray(pair_image_idx, np.int32).reshape(-1, 2),
        pair_ptr=pair_ptr,
        matches=np.concatenate([np.empty((0, 2), np.int32), *(r.matches for r in results)]),
        config=stack("config", (), np.int8),
        fundamental=stack("fundamental", (3, 3), np.float64),
        essential=stack("essential", (3, 3), np.float64),
        homography=stack("homography", (3, 3), np.float64),
        cam2_from_cam1=stack("cam2_from_cam1", (7,), np.float64),
        median_angle_deg=stack("median_angle_deg", (), np.float64),
        num_putative=np.array([r.num_putative for r in results], np.int32).reshape(-1),
        num_inliers_f=stack("num_inliers_f", (), np.int32),
        num_inliers_e=stack("num_inliers_e", (), np.int32),
        num_inliers_h=stack("num_inliers_h", (), np.int32),
    )


def split_pairs(correspondences: Correspondences) -> list[MatchedPair]:
    """The inverse of :func:`join_pairs`."""
    c = correspondences
    return [
        MatchedPair(
            c.matches_of_pair(p),
            int(c.num_putative[p]),
            TwoViewGeometry(
                TwoViewConfig(c.config[p]), np.empty(0, bool), c.fundamental[p], c.essential[p], c.homography[p],
                c.cam2_from_cam1[p], float(c.median_angle_deg[p]),
                int(c.num_inliers_f[p]), int(c.num_inliers_e[p]), int(c.num_inliers_h[p]),
            ),
        )
        for p in range(c.num_pairs)
    ]  # fmt: skip


def _report(
    pairs: Sequence[tuple[int, int]], results: Sequence[MatchedPair], num_known: int, wall_s: float
) -> MatchingReport:
    configs = [r.geometry.config.name for r in results]
    return MatchingReport(
        num_pairs=len(pairs),
        num_resumed_pairs=num_known,
        num_verified_pairs=sum(len(r.matches) > 0 for r in results),
        num_matches=sum(len(r.matches) for r in results),
        num_unlike_pairs=sum(r.num_compared is not None for r in results),
        num_pairs_with_moving_plane=sum(r.geometry.num_moving_alone > 0 for r in results),
        configs={name: configs.count(name) for name in sorted(set(configs))},
        cpu_s=sum(r.cpu_s for r in results),
        wall_s=wall_s,
        pairs=[_pair_report(pair, result) for pair, result in zip(pairs, results, strict=True)],
    )


def _pair_report(pair: tuple[int, int], result: MatchedPair) -> PairReport:
    geometry = result.geometry
    angle_deg = float(geometry.median_angle_deg)
    return PairReport(
        image_idx=pair,
        config=geometry.config.name,
        num_coarse=result.num_coarse,
        is_guided=result.is_guided,
        num_compared=result.num_compared,
        num_putative=result.num_putative,
        num_verified=len(result.matches),
        num_inliers_f=geometry.num_inliers_f,
        num_inliers_e=geometry.num_inliers_e,
        num_inliers_h=geometry.num_inliers_h,
        median_angle_deg=None if np.isnan(angle_deg) else round(angle_deg, 3),
        cpu_s=round(result.cpu_s, 4),
    )


def compile_kernels() -> None:
    """Compile the kernels that this package uses, or load them from numba's cache."""
    epipolar.compile_kernels()
    five_point.compile_kernels()
    relative_pose.compile_kernels()
    fundamental_refinement.compile_kernels()
    turned_views.compile_kernels()
    homography.compile_kernels()
    guided.compile_kernels()
