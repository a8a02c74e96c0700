"""Large sets mapped in parts: how they are divided, what submaps say of each other, and what becomes of it all."""

from __future__ import annotations

import os
import pickle
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sfmapp.adjust.covariance import moved_to_gauge, pose_errors_in_gauge
from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import project, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.executor import Threads
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.mapping import divided, division
from sfmapp.mapping.assembly import assemble, union
from sfmapp.mapping.divided import PartsWork, find_seams
from sfmapp.mapping.division import divide, links
from sfmapp.mapping.incremental import Ends, map_images, map_part
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.part_files import KeptParts
from sfmapp.mapping.report import FailedPartReport, PartsReport
from sfmapp.mapping.submaps import Part, Submap
from sfmapp.report.parts_html import parts_section
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene, true_correspondences
from sfmapp.scene.tracks import make_tracks

# ------------------------------------------------------------------------------------------------------------ division


def graph_of(places: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of places within reach, and matches that fall off with their distance."""
    i, j = np.triu_indices(len(places), 1)
    distance = np.linalg.norm(places[i] - places[j], axis=1)
    near = distance <= reach
    return np.stack([i, j], 1)[near], (600 * (1.1 - distance / reach)).astype(np.int64)[near]


def is_connected(part: np.ndarray, pairs: np.ndarray) -> bool:
    inside = pairs[np.isin(pairs, part).all(axis=1)]
    reached = np.isin(part, part[:1])
    for _ in range(len(part)):
        both = np.isin(inside, part[reached]).any(axis=1)
        more = reached | np.isin(part, inside[both])
        if more.sum() == reached.sum():
            break
        reached = more
    return bool(reached.all())


@pytest.mark.parametrize("kind", ["street", "field", "loop"])
def test_links_are_inside_of_parts_that_hang_together_and_are_small(kind: str) -> None:
    rng = np.random.default_rng(3)
    t = np.arange(600.0)
    places = {
        "street": np.stack([t, np.zeros(600)], 1),
        "field": rng.uniform(0.0, 60.0, (600, 2)),
        "loop": 100.0 * np.stack([np.cos(2 * np.pi * t / 600), np.sin(2 * np.pi * t / 600)], 1),
    }[kind]
    pairs, matches = graph_of(places, {"street": 6.0, "field": 5.0, "loop": 6.0}[kind])
    parts = divide(600, pairs, matches)
    kept = pairs[links(600, pairs, matches)]
    holds = np.zeros((600, len(parts)), bool)
    for n, part in enumerate(parts):
        holds[part, n] = True
        assert is_connected(part, kept)
        np.testing.assert_array_equal(part, np.unique(part))
    is_lost = ~(holds[kept[:, 0]] & holds[kept[:, 1]]).any(axis=1)
    weight = matches[links(600, pairs, matches)]
    lost, total = (np.bincount(kept.ravel(), np.repeat(w, 2), 600) for w in (weight * is_lost, weight))
    # of one of the two images they are next to nothing
    assert (lost < 0.1 * total)[kept[is_lost]].any(axis=1).all()
    assert is_lost.sum() <= 0.005 * len(kept)
    assert holds.any(axis=1).all()
    assert 5 <= len(parts) <= 12
    sizes = holds.sum(0)
    assert sizes.max() <= division.LARGEST_PART
    assert sizes.min() >= 30
    assert holds.sum() < 1.45 * 600  # few are mapped twice


def test_a_division_does_not_hang_on_the_order_of_pairs() -> None:
    rng = np.random.default_rng(5)
    pairs, matches = graph_of(rng.uniform(0.0, 50.0, (400, 2)), 5.0)
    parts = divide(400, pairs, matches)
    order = rng.permutation(len(pairs))
    for first, second in zip(parts, divide(400, pairs[order], matches[order]), strict=True):
        np.testing.assert_array_equal(first, second)


def test_two_towns_are_cut_at_the_street_between_them() -> None:
    rng = np.random.default_rng(0)
    towns = [rng.uniform(0.0, 10.0, (90, 2)), rng.uniform([40.0, 0.0], [50.0, 10.0], (110, 2))]
    street = np.stack([np.linspace(10.5, 39.5, 12), np.full(12, 5.0)], 1)
    places = np.concatenate([*towns, street])
    parts = divide(len(places), *graph_of(places, 4.0))
    assert len(parts) == 2
    assert np.isin(np.arange(90), parts[0]).all()
    assert np.isin(np.arange(90, 200), parts[1]).all()
    shared = np.intersect1d(*parts)
    assert 6 <= len(shared) <= 8
    assert (shared >= 200).sum() >= 5  # of the street


def test_what_has_no_good_cut_is_one_part() -> None:
    i, j = np.triu_indices(220, 1)
    (room,) = divide(220, np.stack([i, j], 1), np.full(len(i), 200))
    np.testing.assert_array_equal(room, np.arange(220))
    # a smaller set is not cut, however well it could be
    (short,) = divide(100, *graph_of(np.stack([np.arange(100.0), np.zeros(100)], 1), 5.0))
    assert len(short) == 100
    assert divide(4, np.zeros((0, 2), np.int64), np.zeros(0, np.int64)) == []


@pytest.mark.parametrize("num_matches", [[45, 40, 50], [75, 80, 70]])
def test_a_few_weak_pairs_between_far_places_do_not_bring_them_into_one_part(num_matches: list[int]) -> None:
    places = np.stack([np.arange(400.0), np.zeros(400)], 1)
    pairs, matches = graph_of(places, 6.0)
    false = np.array([[10, 350], [40, 300], [100, 390]])
    pairs, matches = np.concatenate([pairs, false]), np.concatenate([matches, num_matches])
    # links or not, by themselves they are a thirtieth of what an image has
    assert links(400, pairs, matches)[-3:].all() == (min(num_matches) > 60)
    parts = divide(400, pairs, matches)
    assert all(np.ptp(part) < 200 for part in parts)
    np.testing.assert_array_equal(np.unique(np.concatenate(parts)), np.arange(400))
    for first, second in pairwise(parts):
        assert len(np.intersect1d(first, second)) >= 5


# ------------------------------------------------------------------------------------------------------ a street loop

NUM_IMAGES, NUM_POINTS, FOCAL, SIGMA_PX = 72, 3600, 500.0, 0.5


def street_scene(seed: int = 0) -> SyntheticScene:
    """A walk around a block, looking at the houses on the other side of the street; each image sees a few metres."""
    rng = np.random.default_rng(seed)
    camera = simple_camera(CameraModel.SIMPLE_PINHOLE, 640, 480, FOCAL)
    around = 2 * np.pi * np.arange(NUM_IMAGES) / NUM_IMAGES
    angle = rng.uniform(0.0, 2 * np.pi, NUM_POINTS)
    far = rng.uniform(24.0, 28.0, NUM_POINTS)
    xyz = np.stack([far * np.cos(angle), far * np.sin(angle), rng.uniform(-2.5, 2.5, NUM_POINTS)], 1)
    centers = 18.0 * np.stack([np.cos(around), np.sin(around), np.zeros(NUM_IMAGES)], 1)
    centers += rng.normal(0.0, 0.15, centers.shape)
    forward = np.stack([np.cos(around), np.sin(around), np.zeros(NUM_IMAGES)], 1)
    down = np.broadcast_to([0.0, 0.0, -1.0], forward.shape)
    axes = rigid3.exp_so3(rng.normal(0.0, 0.04, (NUM_IMAGES, 3))) @ np.stack(
        [np.cross(down, forward), down, forward], 1
    )
    poses = rigid3.from_matrix(axes, -np.einsum("nij,nj->ni", axes, centers))
    image, track, xy = [], [], []
    for i, pose in enumerate(poses):
        in_camera = rigid3.apply(pose, xyz)
        ahead = np.flatnonzero(in_camera[:, 2] > 1.0)
        pixel = project(camera, in_camera[ahead])
        inside = ((pixel > 0) & (pixel < [640, 480])).all(axis=1) & (rng.random(len(ahead)) < 0.85)
        image.append(np.full(int(inside.sum()), i))
        track.append(ahead[inside])
        xy.append(pixel[inside])
    feature = np.concatenate([np.arange(len(t)) for t in track])
    exact, whose, seen = np.concatenate(xy), np.concatenate(image), np.concatenate(track)
    names = [f"{i:03d}.jpg" for i in range(NUM_IMAGES)]

    def model(pixels: np.ndarray) -> Reconstruction:
        tracks = make_tracks(NUM_IMAGES, NUM_POINTS, seen, whose, feature, pixels)
        return Reconstruction(
            [camera], names, np.zeros(NUM_IMAGES, np.int32), poses.copy(), tracks, xyz.copy(),
            np.ones(tracks.num_observations, bool),
        )  # fmt: skip

    observed = model(exact + SIGMA_PX * rng.standard_normal(exact.shape))
    return SyntheticScene(model(exact), observed, np.zeros(len(exact), bool))


def features_of(scene: SyntheticScene) -> list[Features]:
    return [
        Features(
            np.column_stack([xy, np.full(len(xy), 2.0), np.zeros(len(xy))]).astype(np.float32),
            np.zeros((len(xy), 0), np.uint8), np.full((len(xy), 3), 128, np.uint8),
        )
        for xy in map(scene.keypoints, range(NUM_IMAGES))
    ]  # fmt: skip


class Backwards(Threads):
    """Gives the results of units in the opposite order."""

    def run(self, work, units, *, bytes_needed=None, instead=None):
        yield from reversed(list(enumerate(map(work, units))))


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return street_scene()


def mapped(scene, executor=None, threads=1, kept=None):
    """The models, the report, and what was warned of."""
    warnings: list[str] = []
    events = Events(lambda event: warnings.append(event.message) if event.kind == "warned" else None)
    size = {"width": 640, "height": 480}
    records = tuple(ImageRecord(n, Path(n), **size) for n in scene.observed.image_names)
    models, report = map_images(
        ImageSet(records, tuple(scene.observed.cameras)), features_of(scene), true_correspondences(scene),
        MappingOptions(), adjust_options=AdjustOptions(), threads=threads, events=events,
        ends=Ends(parts=None if executor is None else PartsWork(executor, kept)),
    )  # fmt: skip
    return models, report, warnings


@pytest.fixture(scope="module")
def small_parts():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(division, "LARGEST_PART", 30)
        patch.setattr(divided, "FEWEST", 60)
        yield


@pytest.fixture(scope="module")
def in_parts(scene, small_parts):
    return mapped(scene)


def errors_in_sigmas(model: Reconstruction, report, other: Reconstruction, other_report=None) -> np.ndarray:
    """(I,) distances of centres after a similarity in the standard deviation of both along an axis."""
    images = np.arange(NUM_IMAGES)
    off = pose_errors_in_gauge(model, other, images, 7)
    variance = np.zeros(NUM_IMAGES)
    for one, told in ((model, report), (other, other_report)):
        if told is not None:
            size = np.linalg.norm(one.centers - one.centers.mean(0), axis=1).max()
            scale = 1.0 if one is model else _scale(model, one)
            variance += [(scale * size * told.images[n].center_sigma_share) ** 2 for n in one.image_names]
    return np.linalg.norm(off[:, 3:], axis=1) / np.sqrt(variance)


def _scale(target: Reconstruction, source: Reconstruction) -> float:
    return float(similarity.align_poses(source.cam_from_world, target.cam_from_world).b_from_a[7])


def test_a_set_mapped_in_parts_is_that_mapped_as_a_whole_within_its_sigmas(scene, in_parts) -> None:
    (model,), report, warnings = in_parts
    (whole,), whole_report, _ = mapped_as_a_whole(scene)
    assert warnings == []
    assert len(report.parts.submaps) >= 3
    assert not any(row.reason for row in report.parts.submaps)
    held = [seam for seam in report.parts.seams if not seam.reason]
    assert len(held) >= len(report.parts.submaps) - 1
    assert all(0.15 < seam.sigmas < 1.5 and seam.num_elsewhere == 0 for seam in held)
    assert whole_report.parts.submaps is None
    assert model.is_registered.all()
    assert whole.is_registered.all()
    told, whole_told = report.models[0].uncertainty, whole_report.models[0].uncertainty
    assert errors_in_sigmas(model, told, whole, whole_told).max() < 3.0
    # and both are as far from the ground truth as they say
    for one, known in ((model, told), (whole, whole_told)):
        off = errors_in_sigmas(one, known, scene.ground_truth)
        assert 0.4 < np.sqrt((off**2).mean() / 3.0) < 1.8


def test_the_page_tells_parts_and_seams(in_parts) -> None:
    _, report, _ = in_parts
    page = parts_section(report.parts)
    for number, row in enumerate(report.parts.submaps):
        assert f"<td>{row.num_images_of_part}</td><td>{row.num_images}</td>" in page
        assert f"{number}: {row.first_image} ..." in page
    for seam in report.parts.seams:
        names = " and ".join(f"{n}: {report.parts.submaps[n].first_image} ..." for n in seam.submaps)
        rows = [text for text in page.split("<tr>") if names in text]
        assert len(rows) == 1
        light = "green" if not seam.reason else "grey" if seam.num_images < 3 else "red"
        assert f'"t {light}"' in rows[0]
        assert f"{seam.num_points_agreeing} of {seam.num_points}" in rows[0] or not seam.num_points
    assert "as a whole" not in page
    assert "nan" not in page
    failed = FailedPartReport(first_image="a<b.jpg", num_images=17, reason="ValueError: x > y")
    page = parts_section(replace(report.parts, failed=[failed], given_up="they bend"))
    assert "a&lt;b.jpg ..." in page
    assert "x &gt; y" in page
    assert "as a whole after all: they bend" in page
    assert parts_section(PartsReport()) == ""


def mapped_as_a_whole(scene):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(divided, "FEWEST", 10**6)
        return mapped(scene)


def test_who_is_done_first_and_how_many_threads_there_are_is_in_no_result(scene, in_parts) -> None:
    (expected,), _, _ = in_parts
    for again in (mapped(scene, threads=3), mapped(scene, Backwards(1))):
        (model,), _, _ = again
        np.testing.assert_array_equal(model.cam_from_world, expected.cam_from_world)
        np.testing.assert_array_equal(model.point_xyz, expected.point_xyz)


class InFiles(Backwards):
    """Has a folder, as those have whose workers share no memory, and sends all units through bytes."""

    def __init__(self, folder):
        super().__init__(1)
        self.folder, self.num_done = folder, 0

    def run(self, work, units, *, bytes_needed=None, instead=None):
        for n, answer in super().run(pickle.loads(pickle.dumps(work)), pickle.loads(pickle.dumps(list(units)))):
            self.num_done += 1
            yield n, answer


def test_parts_in_files_and_such_as_were_kept_come_to_the_same_bytes(scene, in_parts, tmp_path):
    (expected,), report, _ = in_parts
    kept = KeptParts(tmp_path / "kept", "this code")
    shared = tmp_path / "shared"
    shared.mkdir()
    first, again, other = (InFiles(shared) for _ in range(3))
    runs = [mapped(scene, first, kept=kept), mapped(scene, again, kept=kept)]
    assert first.num_done == len(report.parts.submaps)
    assert again.num_done == 0
    stored = sorted(kept.folder.iterdir())
    assert len(stored) == first.num_done
    stored[0].write_bytes(b"torn")  # it is made again, the others are not
    runs.append(mapped(scene, other, kept=kept))
    assert other.num_done == 1
    for (model,), _, _ in runs:
        np.testing.assert_array_equal(model.cam_from_world, expected.cam_from_world)
        np.testing.assert_array_equal(model.point_xyz, expected.point_xyz)
    part = submaps_of(scene, range(10))[0][0].part
    assert KeptParts(kept.folder, "other code").read(part) is None


class Tampering(Threads):
    """Does units, and something to the models of one of them."""

    def __init__(self, number: int, tamper) -> None:
        super().__init__(1)
        self._number, self._tamper = number, tamper

    def run(self, work, units, *, bytes_needed=None, instead=None):
        for n, unit in enumerate(units):
            models = work(unit)
            yield n, self._tamper(models) if n == self._number else models


def bent(models: list[Reconstruction]) -> list[Reconstruction]:
    """The model with the second half of its images turned about the first one's last."""
    model = models[0]
    half = len(model.image_names) // 2
    turn = similarity.from_parts(rigid3.exp_so3([0.0, 0.0, 0.5]), np.zeros(3), 0.8)
    model.cam_from_world[half:] = similarity.transform_poses(turn, model.cam_from_world[half:])
    seen_late = np.zeros(model.tracks.num_tracks, bool)
    seen_late[model.tracks.obs_track_idx[model.tracks.obs_image_idx >= half]] = True
    model.point_xyz[seen_late] = similarity.apply(turn, model.point_xyz[seen_late])
    return models


def test_a_part_that_contradicts_its_neighbours_is_named_and_mapped_from_their_side(scene, small_parts) -> None:
    (model,), report, warnings = mapped(scene, Tampering(1, bent))
    assert model.is_registered.all()
    off = errors_in_sigmas(model, report.models[0].uncertainty, scene.ground_truth)
    assert off.max() < 6.0
    assert any(row.reason for row in report.parts.seams)
    left_out = [row for row in report.parts.submaps if row.reason]
    assert all(any(row.first_image in text for text in warnings) for row in left_out)


class Raising(Threads):
    """Raises instead of doing some of the units."""

    def __init__(self, error: Exception, *numbers: int) -> None:
        super().__init__(2)
        self._error, self._numbers = error, numbers

    def run(self, work, units, *, bytes_needed=None, instead=None):
        def done_or_raised(n: int):
            if n in self._numbers:
                raise self._error
            return work(units[n])

        yield from super().run(done_or_raised, range(len(units)), instead=instead)


@pytest.mark.parametrize(
    ("number", "executor", "reason"),
    [
        (0, Tampering(0, lambda models: []), "begin a model"),
        (2, Tampering(2, lambda models: []), "begin a model"),
        (1, Raising(ZeroDivisionError("by nothing"), 1), "ZeroDivisionError: by nothing"),
    ],
)
def test_a_part_that_comes_to_nothing_is_named_and_mapped_from_its_neighbours(
    scene, small_parts, in_parts, number: int, executor: Threads, reason: str
) -> None:
    (model,), report, warnings = mapped(scene, executor)
    assert model.is_registered.all()
    assert errors_in_sigmas(model, report.models[0].uncertainty, scene.ground_truth).max() < 6.0
    (failed,) = report.parts.failed
    assert reason in failed.reason
    assert failed.first_image == in_parts[1].parts.submaps[number].first_image
    assert failed.num_images == in_parts[1].parts.submaps[number].num_images_of_part
    assert [text for text in warnings if failed.first_image in text and reason in text]
    assert len(report.parts.submaps) == len(in_parts[1].parts.submaps) - 1


def test_a_set_of_which_no_part_can_be_mapped_is_mapped_as_a_whole(scene, small_parts) -> None:
    (model,), report, warnings = mapped(scene, Raising(MemoryError(), *range(20)))
    (whole,), _, _ = mapped_as_a_whole(scene)
    np.testing.assert_array_equal(model.cam_from_world, whole.cam_from_world)
    assert report.parts.submaps == []
    assert len(report.parts.failed) >= 3
    assert report.parts.given_up
    assert any(report.parts.given_up in text for text in warnings)


def test_a_stop_that_is_asked_for_while_parts_are_mapped_is_no_failure_of_a_part(scene, small_parts, tmp_path) -> None:
    kept = KeptParts(tmp_path / "kept", "this code")
    with pytest.raises(InterruptedRunError):
        mapped(scene, Raising(InterruptedRunError("stopped"), 1), kept=kept)


def ended_or_mapped(work, marks, stored):
    """Ends its process with part 1 again and again, with part 2 once; maps the others."""
    if stored.path.name == "part_1.npz":
        os.kill(os.getpid(), signal.SIGKILL)
    if stored.path.name == "part_2.npz" and not (mark := marks / "ended").exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return work(stored)


class Ending:
    """Workers that some parts end."""

    def __init__(self, executor, marks: Path) -> None:
        self._executor, self._marks, self.folder = executor, marks, executor.folder

    def run(self, work, units, *, bytes_needed=None, instead=None):
        yield from self._executor.run(partial(ended_or_mapped, work, self._marks), units, instead=instead)


def test_a_part_that_ends_its_workers_is_named_and_those_in_its_company_are_mapped(scene, small_parts, tmp_path):
    pytest.importorskip("distributed")
    import dask

    from sfmapp.cluster.dask_executor import open_cluster

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),  # of a unit, before dask gives it up
        open_cluster("local:2", tmp_path, [], Events()) as executor,
    ):
        (model,), report, warnings = mapped(scene, Ending(executor, tmp_path))
    (failed,) = report.parts.failed
    assert "workers were lost" in failed.reason
    assert any(failed.first_image in text for text in warnings)
    (expected,), other, _ = mapped(scene, Raising(OSError(), 1))
    assert [row.first_image for row in other.parts.failed] == [failed.first_image]
    np.testing.assert_array_equal(model.cam_from_world, expected.cam_from_world)
    np.testing.assert_array_equal(model.point_xyz, expected.point_xyz)


# ------------------------------------------------------------------------------------------------------------- seams


def submaps_of(scene: SyntheticScene, *ranges: range) -> tuple[list[Submap], Reconstruction]:
    """Parts of a scene, mapped by themselves, and all its images without poses."""
    observed = scene.observed
    empty = Reconstruction.empty(observed.cameras, observed.image_names, observed.image_camera_idx, observed.tracks)
    found = true_correspondences(scene)
    parts = [Part.of(empty, found, np.array(one)) for one in ranges]
    models = [map_part(MappingOptions(), AdjustOptions(), Events(), part)[0] for part in parts]
    return [Submap(part, model) for part, model in zip(parts, models, strict=True)], empty


def mapper_of(submap: Submap) -> Mapper:
    part = submap.part
    return Mapper(
        reconstruction=submap.model, correspondences=part.correspondences, options=MappingOptions(),
        adjust_options=AdjustOptions(), events=Events(), pool=ThreadPoolExecutor(1), prior_cameras=list(part.cameras),
        locked=np.zeros(len(part.image_idx), bool),
    )  # fmt: skip


def submap_from_world(submap: Submap, truth: Reconstruction) -> np.ndarray:
    """The similarity from the true world to that of a submap, in the gauge that its covariance is in."""
    at = submap.part.image_idx
    own = replace(submap.model.copy(), cam_from_world=truth.cam_from_world[at])
    moved = moved_to_gauge(submap.model, own, np.arange(len(at)), 7)
    return similarity.align_poses(truth.cam_from_world[at], moved.cam_from_world).b_from_a


def test_a_seam_is_as_far_off_as_it_says() -> None:
    squares = []
    for seed in range(5):
        scene = street_scene(seed)
        submaps, _ = submaps_of(scene, range(24), range(18, 42))
        (seam,) = find_seams(submaps, mapper_of, MappingOptions())
        assert seam.reason == ""
        assert len(seam.image_idx) == 6
        assert seam.num_seen > 0.9 * seam.num_points > 50
        first, second = (submap_from_world(submap, scene.ground_truth) for submap in submaps)
        true = similarity.compose(first, similarity.inverse(second))
        apart = similarity.compose(seam.first_from_second, similarity.inverse(true))
        shift = (similarity.apply(apart, seam.middle) - seam.middle) / seam.size
        turn = rigid3.log_so3(rigid3.rotation_matrix(apart))
        error = np.concatenate([turn, shift, [np.log(apart[7])]])
        squares.append(error @ seam.information @ error / 7.0)
    # what both saw is the same in both, which is taken for twice as much to be off by as it is
    assert 0.15 < np.mean(squares) < 2.0


def test_a_submap_that_is_moved_turned_and_scaled_is_put_where_it_was() -> None:
    submaps, empty = submaps_of(street_scene(1), range(24), range(18, 42))
    sim = similarity.from_parts(rigid3.exp_so3([0.4, -1.0, 2.0]), [3.0, -7.0, 1.0], 4.0)
    other = submaps[1].model.copy()
    other.cam_from_world[:] = similarity.transform_poses(sim, other.cam_from_world)
    other.point_xyz[:] = similarity.apply(sim, other.point_xyz)
    models = []
    for second in (submaps[1], Submap(submaps[1].part, other)):
        both = [submaps[0], second]
        (world,), _ = assemble(both, find_seams(both, mapper_of, MappingOptions()))
        models.append(union(world, both, empty))
    assert models[0].is_registered[:42].all()
    assert not models[0].is_registered[42:].any()
    np.testing.assert_allclose(models[1].centers[:42], models[0].centers[:42], rtol=0, atol=1e-6)


def test_submaps_that_fold_or_share_too_little_have_no_seam() -> None:
    scene = street_scene(2)
    submaps, _ = submaps_of(scene, range(24), range(18, 42), range(40, 60))
    half_off = submaps[1].model.copy()
    half_off.cam_from_world[3:] = similarity.transform_poses(
        similarity.from_parts(rigid3.exp_so3([0.0, 0.0, 0.3]), np.zeros(3), 1.0), half_off.cam_from_world[3:]
    )
    folded = [submaps[0], Submap(submaps[1].part, half_off), submaps[2]]
    first, second = find_seams(folded, mapper_of, MappingOptions())
    assert first.reason
    assert "share 2 of the 3 images" in second.reason
    worlds, _ = assemble(folded, [first, second])
    assert [world.members for world in worlds] == [[0], [1], [2]]


def test_a_way_around_that_does_not_close_costs_the_seam_that_fits_worst() -> None:
    submaps, _ = submaps_of(street_scene(3), range(30), range(24, 54), np.r_[0:6, 48:72])
    seams = find_seams(submaps, mapper_of, MappingOptions())
    assert [seam.submaps for seam in seams if not seam.reason] == [(0, 1), (0, 2), (1, 2)]
    (world,), judged = assemble(submaps, seams)
    assert not any(seam.reason for seam in judged)
    assert world.misfit.max() < 3.0
    wrong = similarity.from_parts(rigid3.exp_so3([0.0, 0.0, 0.6]), [0.5, 0.0, 0.0], 1.2)
    # a seam that few points speak for, and that says something else
    told = replace(seams[2], first_from_second=similarity.compose(wrong, seams[2].first_from_second))
    told = replace(told, information=0.03 * told.information)
    (world,), judged = assemble(submaps, [*seams[:2], told])
    assert [bool(seam.reason) for seam in judged] == [False, False, True]
    assert world.members == [0, 1, 2]
