"""Places, relocalisation, loops and joined maps, before textured walls whose images are known exactly."""

from __future__ import annotations

import copy
import math
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.stats import binom

from sfmapp.camera.camera import CameraModel, project, simple_camera
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.frontend.pyramid import build_pyramid
from sfmapp.odometry.loops import relocalize as relocalization
from sfmapp.odometry.loops.closing import apply_closure, fuse_points, join_maps
from sfmapp.odometry.loops.detection import LoopFinder, LoopOptions
from sfmapp.odometry.loops.evidence import MAX_DOUBT, log_ratio_of_share
from sfmapp.odometry.loops.gaps import Way, log_ratio_of_gap, log_ratio_of_seam
from sfmapp.odometry.loops.place_recognition import Candidate, PlaceIndex, PlaceOptions, View
from sfmapp.odometry.loops.pose_graph import apply_corrections
from sfmapp.odometry.loops.relocalize import (
    RelocalizeOptions,
    is_beyond_chance,
    is_convincing,
    locate,
    relocalize,
    twist,
)
from sfmapp.odometry.loops.repetition import Repetition
from sfmapp.odometry.loops.rivals import are_seen_apart, believe_place, log_ratio_of_shift
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.map.local_map import View as FrameView
from sfmapp.odometry.recognition import Recognition
from sfmapp.scene.rig import Rig

Array = np.ndarray

CAMERA = simple_camera(CameraModel.SIMPLE_PINHOLE, 320, 240, 280.0)
PX_PER_M = 80.0
UNSURE = np.full((6, 6), np.nan)
OPTIONS = RelocalizeOptions()


def texture(seed: int, height: int = 1024, width: int = 2048) -> Array:
    """Blotches of all sizes and hard-edged patches: corners everywhere, no two alike."""
    rng = np.random.default_rng(seed)
    out = np.zeros((height, width), np.float32)
    for level in range(2, 8):
        coarse = rng.normal(size=(height >> level, width >> level)).astype(np.float32)
        out += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    out *= 18.0
    for _ in range(height * width // 2500):
        x, y = rng.integers(0, width), rng.integers(0, height)
        w, h = rng.integers(8, 40, 2)
        out[y : y + h, x : x + w] += rng.uniform(-60, 60)
    return np.clip(out + 128, 0, 255).astype(np.uint8)


class Wall:
    """The plane z = 0, its texture's corner at the origin; cameras stand at negative z and look along z."""

    def __init__(self, image: Array) -> None:
        self.image = image

    def photograph(self, pose: Array, seed: int, gain: float = 1.0) -> Array:
        rotation = rigid3.rotation_matrix(pose)
        plane = np.column_stack([rotation[:, 0], rotation[:, 1], pose[4:]])
        shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
        to_wall = np.diag([1 / PX_PER_M, 1 / PX_PER_M, 1.0]) @ np.linalg.inv(shift)
        h = shift @ CAMERA.k_matrix @ plane @ to_wall
        seen = cv2.warpPerspective(self.image, h, (CAMERA.width, CAMERA.height), flags=cv2.INTER_LINEAR)
        noise = np.random.default_rng(seed).normal(0.0, 2.0, seen.shape)
        return np.clip(gain * seen.astype(np.float64) + noise, 0, 255).astype(np.uint8)

    @staticmethod
    def points(pose: Array, xy: Array) -> Array:
        """Where the rays of pixels meet the wall."""
        rays = np.column_stack([(xy - [160.0, 120.0]) / 280.0, np.ones(len(xy))]) @ rigid3.rotation_matrix(pose)
        center = rigid3.center(pose)
        return center - rays * (center[2] / rays[:, 2:])


def corners(image: Array, count: int = 250) -> Array:
    found = cv2.goodFeaturesToTrack(image, count, 0.01, 7)
    return found[:, 0].astype(np.float64) + 0.5


def pose_at(x: float, y: float, distance: float = 3.0, roll_deg: float = 0.0, yaw_deg: float = 0.0) -> Array:
    turn = rigid3.exp_so3([0, 0, np.radians(roll_deg)]) @ rigid3.exp_so3([0, np.radians(yaw_deg), 0])
    return rigid3.from_matrix(turn, -turn @ np.array([x, y, -distance]))


class Walker:
    """Makes a map keyframe by keyframe: points are followed as long as they stay in view, exactly but for noise."""

    def __init__(self, wall: Wall, map_idx: int = 0, noise_px: float = 0.3) -> None:
        self.wall, self.map_idx, self.noise_px = wall, map_idx, noise_px
        self.keyframes = KeyframeMap(Rig.single(CAMERA))
        self.rng = np.random.default_rng(17 + map_idx)
        self.images: dict[int, Array] = {}
        self._alive = np.zeros(0, np.int64)

    def step(self, frame_idx: int, pose: Array) -> Keyframe:
        image = self.wall.photograph(pose, frame_idx)
        self.images[frame_idx] = image
        xy = project(CAMERA, rigid3.apply(pose, self.keyframes.point_xyz[self._alive]))
        inside = ((xy > 4) & (xy < [316, 236])).all(1)
        ids, xy = self._alive[inside], xy[inside]
        fresh = corners(image)
        if len(xy):
            fresh = fresh[np.linalg.norm(fresh[:, None] - xy[None], axis=2).min(1) > 6]
        new = self.keyframes.new_points(len(fresh))
        self.keyframes.point_xyz[new] = self.wall.points(pose, fresh)
        self._alive = np.concatenate([ids, new])
        xy = np.concatenate([xy, fresh]) + self.noise_px * self.rng.normal(size=(len(self._alive), 2))
        seen = np.ones((len(xy), 1), bool)
        keyframe = Keyframe(frame_idx, 0.1 * frame_idx, f"{frame_idx:04d}", pose, self._alive.copy(), xy[:, None], seen)
        self.keyframes.keyframes.append(keyframe)
        return keyframe

    def add_to(self, places: PlaceIndex, keyframe: Keyframe) -> View:
        image = self.images[keyframe.frame_idx]
        return places.add(self.map_idx, keyframe.frame_idx, image, keyframe.xy[:, 0], keyframe.point_id)


def round_trip() -> list[Array]:
    """Right along the wall, down, back to the left, up to where it began, and on for a while."""
    way = [(4 + 0.6 * k, 4.0) for k in range(20)]
    way += [(16.0, 4 + 0.6 * k) for k in range(1, 7)]
    way += [(16 - 0.6 * k, 8.2) for k in range(20)]
    way += [(4.0, 8.2 - 0.6 * k) for k in range(1, 7)]
    way += [(4 + 0.6 * k, 4.2) for k in range(6)]
    return [
        pose_at(x, y, 3.0 + 0.2 * np.sin(k), 2 * np.sin(0.7 * k), 3 * np.cos(0.4 * k)) for k, (x, y) in enumerate(way)
    ]


@pytest.fixture(scope="module")
def wall() -> Wall:
    return Wall(texture(1))


@pytest.fixture(scope="module")
def _walked(wall: Wall) -> tuple[Walker, PlaceIndex]:
    walker, places = Walker(wall), PlaceIndex()
    for n, pose in enumerate(round_trip()[:30]):
        walker.add_to(places, walker.step(n, pose))
    return walker, places


@pytest.fixture
def walked(_walked: tuple[Walker, PlaceIndex]) -> tuple[KeyframeMap, PlaceIndex]:
    walker, places = copy.deepcopy((_walked[0].keyframes, _walked[1]))
    return walker, places


# ------------------------------------------------------------------------------------------------------ views, places


def test_descriptors_bear_noise_scale_and_a_known_roll(wall: Wall) -> None:
    """The right corner is the nearest one for nine in ten, at the right scale and roll, and for few without them."""
    here = pose_at(8, 6)
    before = View(wall.photograph(here, 0), corners(wall.photograph(here, 0)))
    xyz = wall.points(here, before.xy)

    def hits(there: Array, scale: float, roll: float) -> float:
        xy = project(CAMERA, rigid3.apply(there, xyz))
        inside = ((xy > 15) & (xy < [305, 225])).all(1)
        after = View(wall.photograph(there, 1, 0.8), xy[inside])
        products = after.descriptors(scale, roll).astype(np.float32) @ before.descriptors().T.astype(np.float32)
        return float((products.argmax(1) == np.flatnonzero(inside)).mean())

    assert hits(here, 1.0, 0.0) > 0.97
    assert hits(pose_at(8, 6, 3.0 / 1.35), 1.35, 0.0) > 0.85
    assert hits(pose_at(8, 6, 3.0 * 1.35), 1 / 1.35, 0.0) > 0.85
    turned = pose_at(8, 6, roll_deg=40)
    assert hits(turned, 1.0, np.radians(40)) > 0.85
    assert hits(turned, 1.0, 0.0) < 0.3
    assert hits(turned, 1.0, np.radians(-40)) < 0.3


def test_twist_is_the_roll_between_cameras() -> None:
    rng = np.random.default_rng(0)
    for angle in (-3.0, -0.7, 0.0, 0.4, 2.9):
        base = rigid3.exp_so3(rng.normal(size=3))
        assert twist(rigid3.exp_so3([0, 0, angle]) @ base, base) == pytest.approx(angle)
        tilted = rigid3.exp_so3([0.2, -0.3, 0.0]) @ rigid3.exp_so3([0, 0, angle]) @ base
        assert np.cos(twist(tilted, base) - angle) > np.cos(0.05)


def test_places_find_the_revisit(walked: tuple[KeyframeMap, PlaceIndex], wall: Wall) -> None:
    keyframes, places = walked
    for n in (2, 9, 17, 25):
        pose = keyframes.keyframes[n].rig_from_world.copy()
        pose[4] += 0.25
        image = wall.photograph(pose, 999, 1.2)
        found = places.query_view(View(image, corners(image)), 0.0, (0,))
        assert abs(found[0].frame_idx - n) <= 1
        assert found[0].similarity > 2 * found[-1].similarity


def test_places_are_small_and_the_same_twice(wall: Wall) -> None:
    rng = np.random.default_rng(0)
    tables = []
    for executor in (None, ThreadPoolExecutor(1)):
        places = PlaceIndex(PlaceOptions(learn_after=4), executor=executor)
        rng = np.random.default_rng(0)
        for n in range(20):
            image = rng.integers(0, 255, (60, 80), np.uint8)
            ids = np.arange(1000)
            places.add(0, n, image, rng.uniform(5, 55, (1000, 2)), ids)
            # learnt from four places, and taken over with the sixth, however long that has taken
            assert (places._words is None) == (n < 5)
        kept = places[3]
        size = kept.point_id.nbytes + kept.xy.nbytes + kept.descriptors.nbytes + places._vectors[0].nbytes
        assert size < 100_000
        assert len(kept.point_id) == PlaceOptions().max_points
        tables.append(places._vectors[: len(places)].tobytes())
    assert tables[0] == tables[1]


def test_places_follow_what_happens_to_keyframes_and_points(walked: tuple[KeyframeMap, PlaceIndex]) -> None:
    _, places = walked
    before = places[5]
    a, b = int(before.point_id[3]), int(before.point_id[10])
    places.rename_points(0, np.array([b]), np.array([a]))
    assert b not in places[5].point_id
    assert len(places[5].point_id) == len(before.point_id) - 1
    assert (np.diff(places[5].point_id) > 0).all()
    at = np.searchsorted(places[5].point_id, a)
    assert np.array_equal(places[5].descriptors[at], before.descriptors[3])
    vector = places._vectors[places._row[9]].copy()
    places.remove(5)
    assert 5 not in places
    assert len(places) == 29
    assert np.array_equal(places._vectors[places._row[9]], vector)
    assert all(c.frame_idx != 5 for c in places.query(4))
    places.move_map(0, 3, 1000)
    assert places[9].map_idx == 3
    assert places[9].point_id.min() >= 1000
    assert places.query(4, other_maps=True) == []


# ------------------------------------------------------------------------------------------------------ relocalisation


def test_a_lost_image_is_found_again(walked: tuple[KeyframeMap, PlaceIndex], wall: Wall) -> None:
    keyframes, places = walked
    for x, y, distance, roll in [(7.3, 4.4, 3.0, 0), (10.2, 3.7, 3.6, 8), (15.2, 5.9, 2.5, -6), (13.0, 8.0, 2.6, 0)]:
        pose = pose_at(x, y, distance, roll, 4.0)
        image = wall.photograph(pose, 999, 1.2)
        located = relocalize({0: keyframes}, places, View(image, corners(image)), OPTIONS)[0].located
        error = np.linalg.norm(rigid3.center(located.cam_from_world) - rigid3.center(pose))
        # corners are found again to about a pixel: 0.01 m at 3 m, over 50 points and more less
        assert error < 0.03
        assert len(located.point_id) >= 40
        assert located.agreement > 0.7
        seen = project(CAMERA, rigid3.apply(pose, keyframes.point_xyz[located.point_id]))
        assert np.median(np.linalg.norm(seen - corners(image)[located.corner_idx], axis=1)) < 1.5


def frame_of(frame_idx: int, image: Array) -> FrameView:
    return FrameView(frame_idx, 0.1 * frame_idx, f"{frame_idx:04d}", (image,), (build_pyramid(image),))


def test_recognition_remembers_what_is_new_and_finds_lost_frames_roll_by_roll(wall: Wall) -> None:
    """Steps of 0.3 m before 3.4 m of wall: half of the points are new after five of them or six."""
    walker, recognition = Walker(wall), Recognition(seed=0)
    local = SimpleNamespace(map_idx=0, keyframes=walker.keyframes, newest=-1)
    maps = {0: local}
    assert recognition.find(maps, frame_of(0, wall.photograph(pose_at(4.0, 4.0), 0))) is None  # nothing is known yet
    for n in range(41):
        keyframe = walker.step(n, pose_at(4.0 + 0.3 * n, 4.0))
        local.newest = n
        view = frame_of(n, walker.images[n])
        assert recognition.remember(maps, local, view, keyframe.xy[:, 0], keyframe.point_id, UNSURE) is None
    places = recognition._places
    known = sorted(places._row)
    assert known[0] == 0
    assert 6 <= len(known) <= 10
    shared = [np.isin(places[b].point_id, places[a].point_id).mean() for a, b in pairwise(known)]
    assert 0.3 < max(shared) <= 0.5
    # a frame with a roll of 27 degrees: the first search looks straight, the second at a roll that fits
    pose = pose_at(16.2, 4.1, 3.1, 27.0)
    lost = frame_of(44, wall.photograph(pose, 99))
    found = [recognition.find(maps, lost) for _ in range(3)]
    assert [one is not None for one in found] == [False, True, False]
    assert found[1] is not None
    assert found[1][0] is local
    assert np.linalg.norm(rigid3.center(found[1][2]) - rigid3.center(pose)) < 0.03
    seen = project(CAMERA, rigid3.apply(pose, walker.keyframes.point_xyz[found[1][3]]))
    assert np.median(np.linalg.norm(seen - found[1][4], axis=1)) < 1.5
    # a white frame has nothing to be known by, and a place that was forgotten is no candidate
    assert recognition.find(maps, frame_of(100, np.full((240, 320), 255, np.uint8))) is None
    near = found[1][1]
    assert recognition.forget(near)
    assert near not in places
    again = [recognition.find(maps, lost) for _ in range(3)]
    assert all(one is None or one[1] != near for one in again)


def test_a_turned_image_is_found_at_the_roll_it_is_tried_with(
    walked: tuple[KeyframeMap, PlaceIndex], wall: Wall
) -> None:
    keyframes, places = walked
    image = wall.photograph(pose_at(8.0, 4.1, 3.0, 28.0), 999)
    assert relocalize({0: keyframes}, places, View(image, corners(image)), OPTIONS, np.radians(25))


def test_an_unknown_place_is_not_found(walked: tuple[KeyframeMap, PlaceIndex]) -> None:
    keyframes, places = walked
    other = Wall(texture(77))
    for n in range(6):
        image = other.photograph(pose_at(4 + 2 * n, 5, 3.0), n)
        assert not relocalize({0: keyframes}, places, View(image, corners(image)), OPTIONS)


def test_the_same_poster_elsewhere_is_refused(walked: tuple[KeyframeMap, PlaceIndex], wall: Wall) -> None:
    """A third of the image is exactly what was there, all else is not: many matches agree, and the rest contradicts."""
    keyframes, places = walked
    here = pose_at(8.2, 4.0)
    elsewhere = texture(78)
    xy = (np.array([8.2, 4.0]) * PX_PER_M).astype(int)
    part = (slice(xy[1] - 45, xy[1] + 45), slice(xy[0] - 65, xy[0] + 65))
    elsewhere[part] = wall.image[part]
    image = Wall(elsewhere).photograph(here, 5)
    view = View(image, corners(image))
    found = [locate(keyframes, places, view, Candidate(0, n, 1.0), OPTIONS, 0.0) for n in (6, 7, 8)]
    assert any(f is not None and len(f.point_id) >= OPTIONS.min_inliers for f in found)
    assert not any(f is not None and is_convincing(f, view, OPTIONS) for f in found)
    assert not relocalize({0: keyframes}, places, view, OPTIONS)
    # the same image on its own wall is believed
    image = wall.photograph(here, 5)
    assert relocalize({0: keyframes}, places, View(image, corners(image)), OPTIONS)


def believed(
    walker: Walker, places: PlaceIndex, pose: Array, timestamp_s: float, repetition: Repetition
) -> tuple[int, float | None]:  # fmt: skip
    """How many places an image fits that is seen at a time, and by how many metres the one that is believed is off."""
    image = walker.wall.photograph(pose, 999)
    maps, view = {0: walker.keyframes}, View(image, corners(image))
    fitting = relocalize(maps, places, view, OPTIONS)
    found = believe_place(fitting, maps, places, view, timestamp_s, OPTIONS, repetition)
    off = None if found is None else rigid3.center(found.located.cam_from_world) - rigid3.center(pose)
    return len(fitting), None if off is None else float(np.linalg.norm(off))


def test_a_lost_image_is_placed_where_nothing_else_can_be(wall: Wall) -> None:
    """3 m a second before 3.4 m of wall, and half a second unseen. Where all is there once a camera that has stopped is
    placed; among bays of 4 m it is not, nor one that has gone on, or was carried back."""
    bays = Wall(np.tile(wall.image[:, 320:640], (1, 6)))
    for scene, num, x, is_believed in (
        (wall, 15, 8.3, True), (bays, 15, 9.7, False), (bays, 15, 5.7, False), (wall, 51, 19.2, True),
        (bays, 51, 6.2, False),
    ):  # fmt: skip
        walker, places = Walker(scene), PlaceIndex()
        for n in range(num):
            keyframe = walker.step(n, pose_at(4.0 + 0.3 * n, 4.0))
            if n % 5 == 0:
                walker.add_to(places, keyframe)
        num_fitting, off = believed(walker, places, pose_at(x, 4.1), 0.1 * (num + 4), Repetition())
        assert num_fitting >= 1
        assert (off is not None) == is_believed
        assert off is None or off < 0.03


def test_a_carried_image_is_placed_where_the_map_has_shown_that_it_does_not_repeat_itself(wall: Wall) -> None:
    """What is in view has its like in part, so landmarks alone do not tell; that no place fits another one does."""
    half = wall.image.copy()
    half[475:, 1200:1680] = half[475:, 320:800]  # lower halves of two stretches, 11 m apart
    bays = np.tile(wall.image[:, 320:640], (1, 6))
    for image, num_single, num_repeated in ((half, 12, 0), (bays, 0, 12)):
        walker, places, finder = Walker(Wall(image)), PlaceIndex(), LoopFinder()
        for n in range(30):
            keyframe = walker.step(n, pose_at(4 + 0.6 * n, 5.5))
            finder.find({0: walker.keyframes}, 0, places, n, walker.add_to(places, keyframe))
        asked, likes = finder.repetition._asked, finder.repetition._likes
        assert len(asked.difference(likes)) >= num_single
        assert len(likes) >= num_repeated
        assert num_single == 0 or not likes
        by_maps = finder.repetition.log_ratio([walker.keyframes], 3)
        assert by_maps == pytest.approx(0.0 if num_repeated else len(asked) * math.log(2.0))
        there, ends_s = pose_at(6.1, 5.6), 0.1 * 40
        assert believed(walker, places, there, ends_s, Repetition())[1] is None
        off = believed(walker, places, there, ends_s, finder.repetition)[1]
        assert off is None if num_repeated else off is not None and off < 0.03


def test_a_map_says_nothing_of_its_likes_before_it_has_other_places() -> None:
    keyframes, repetition = KeyframeMap(Rig.single(CAMERA)), Repetition()
    for n in range(20):
        ids = keyframes.new_points(3)
        keyframes.append(Keyframe(n, 0.0, str(n), rigid3.IDENTITY, ids, np.zeros((3, 1, 2)), np.ones((3, 1), bool)))
        repetition.ask(n, n)
    maps = [keyframes]
    assert repetition.log_ratio(maps, 0) == pytest.approx(15 * math.log(2.0))  # five have too few others
    for n, other in ((8, 2), (12, 6), (13, 6)):
        repetition.note_like(n, other)
    some = repetition.log_ratio(maps, 0)  # 8, 12, 13, 2 and 6 are there twice, and 11 once
    assert some == pytest.approx(binom.logpmf(11, 16, 11 / 16) - binom.logpmf(11, 16, 0.5))
    assert repetition.log_ratio(maps, 12) == repetition.log_ratio(maps, 2) == 0.0
    repetition.forgive([8, 12])
    assert repetition.log_ratio(maps, 0) == pytest.approx(binom.logpmf(11, 13, 11 / 13) - binom.logpmf(11, 13, 0.5))
    for n in range(15, 20):
        repetition.note_like(n, n - 6)
    assert repetition.log_ratio(maps, 0) == 0.0
    assert repetition.log_ratio([KeyframeMap(Rig.single(CAMERA))], 0) == 0.0


def test_a_gap_leads_where_the_camera_can_have_come() -> None:
    """A metre a second along x; two seconds are not seen. Around where it would be it may be anywhere within 2 m."""
    way = Way(np.arange(5.0), np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)]))
    for center, leads in (
        ([6, 0, 0], True),
        ([4, 0, 0], True),
        ([5, 1.7, 0], True),
        ([3.9, 0, 0], False),
        ([6, 2.1, 0], False),
    ):
        assert (log_ratio_of_gap(way, 6.0, np.array(center, float), 4.0) is not None) == leads
    # both are densities over a plane, and look-alikes are as many in a circle as wide as the depth
    assert log_ratio_of_gap(way, 6.0, np.array([6.0, 0, 0]), 4.0) == pytest.approx(math.log((4.0 / 2.0) ** 2))
    assert log_ratio_of_gap(way, 6.0, np.array([6.0, 0, 0]), 1.0) == pytest.approx(-math.log(4.0))
    assert log_ratio_of_gap(way.before(1.0), 6.0, np.array([6.0, 0, 0]), 4.0) is None  # it was seen once
    # of two maps, whichever is earlier, the ends that are next to each other in time
    later = Way(7.0 + np.arange(3.0), way.center[:3] + np.array([7.0, 0, 0]))
    for pair in ((way, later), (later, way)):
        assert log_ratio_of_seam(*pair, 4.0) == pytest.approx(math.log((4.0 / 3.0) ** 2))
    aside = Way(later.timestamps_s, later.center + np.array([0, 3.1, 0]))
    assert log_ratio_of_seam(way, aside, 4.0) is None


def test_six_wrong_matches_in_ten(
    walked: tuple[KeyframeMap, PlaceIndex], wall: Wall, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyframes, places = walked
    right = relocalization.match_points

    def mostly_wrong(*args: object) -> tuple[Array, Array]:
        point, corner = right(*args)  # type: ignore[arg-type]
        wrong = np.random.default_rng(0).permutation(len(point))[: int(0.6 * len(point))]
        corner[wrong] = np.roll(corner[wrong], 7)
        return point, corner

    monkeypatch.setattr(relocalization, "match_points", mostly_wrong)
    pose = pose_at(9.1, 4.2, 3.2)
    image = wall.photograph(pose, 999)
    (found, *_) = relocalize({0: keyframes}, places, View(image, corners(image)), OPTIONS)
    assert np.linalg.norm(rigid3.center(found.located.cam_from_world) - rigid3.center(pose)) < 0.03


def test_chance_is_told_from_agreement() -> None:
    """Of random matches no pose explains enough, whatever its best; a handful of exact ones is enough."""
    from sfmapp.geometry.resection import estimate_pose

    rng = np.random.default_rng(0)
    limit, most = OPTIONS.error_px(CAMERA), 0
    for _ in range(20):
        xyz = rng.uniform([-3, -2, 3], [3, 2, 9], (100, 3))
        xy = rng.uniform([0, 0], [320, 240], (100, 2))
        found = estimate_pose(xyz, (xy - [160, 120]) / 280.0, limit / 280.0, max_iterations=1000)
        if found is not None:
            most = max(most, found.num_inliers)
            assert not is_beyond_chance(found.num_inliers, 100, limit, CAMERA)
    assert 4 <= most <= 8
    assert is_beyond_chance(14, 100, limit, CAMERA)
    assert is_beyond_chance(8, 12, limit, CAMERA)


# ------------------------------------------------------------------------------------------------------ loops


def drift(num: int, sigma: float, seed: int, poses: list[Array]) -> Array:
    """(K, 8) a random walk of similarities, each step about the keyframe's own centre."""
    rng = np.random.default_rng(seed)
    out = [similarity.IDENTITY]
    for k in range(1, num):
        e = sigma * rng.normal(size=7)
        step = similarity.from_parts(rigid3.exp_so3(0.3 * e[:3]), e[3:6], float(np.exp(e[6])))
        here = np.append(rigid3.inverse(poses[k]), 1.0)
        local = similarity.compose(here, similarity.compose(step, similarity.inverse(here)))
        out.append(similarity.compose(out[-1], local))
    return np.array(out)


def rms_error(keyframes: KeyframeMap, ground_truth: list[Array]) -> float:
    poses = np.array([k.rig_from_world for k in keyframes.keyframes])
    b_from_a = similarity.align_poses(poses, np.array(ground_truth)).b_from_a
    error = similarity.apply(b_from_a, rigid3.center(poses)) - rigid3.center(np.array(ground_truth))
    return float(np.sqrt((error**2).sum(1).mean()))


def walk_with_drift(wall: Wall, sigma: float, seed: int) -> tuple[Walker, list[Array], list[Array]]:
    """All keyframes of the round trip in a map that has drifted, their true poses, and the similarity of the end."""
    walker, ground_truth = Walker(wall), round_trip()
    for n, pose in enumerate(ground_truth):
        walker.step(n, pose)
    moves = drift(len(ground_truth), sigma, seed, ground_truth)
    apply_corrections(walker.keyframes, moves)
    return walker, ground_truth, list(moves)


def test_a_loop_is_closed(wall: Wall) -> None:
    walker, ground_truth, moves = walk_with_drift(wall, 0.01, 4)
    keyframes, everything = walker.keyframes, walker.keyframes.keyframes
    places, finder, closure = PlaceIndex(), LoopFinder(), None
    keyframes.keyframes = []
    for n, keyframe in enumerate(everything):
        keyframes.keyframes.append(keyframe)
        closure = finder.find({0: keyframes}, 0, places, n, walker.add_to(places, keyframe))
        if closure is not None:
            break
    assert closure is not None
    last = len(keyframes.keyframes)
    views = closure.views
    assert len(views) == LoopOptions().min_views
    assert all(v.old_idx < 20 and v.new_idx >= 40 for v in views)
    assert (
        np.linalg.norm(rigid3.center(ground_truth[views[0].new_idx]) - rigid3.center(ground_truth[views[0].old_idx]))
        < 1.5
    )
    assert not finder.repetition._likes  # what is a loop is no like
    # the similarity is that of the drift between both sides
    true = similarity.compose(moves[views[-1].old_idx], similarity.inverse(moves[views[-1].new_idx]))
    center = rigid3.center(keyframes.keyframes[-1].rig_from_world)
    lost = np.linalg.norm(similarity.apply(true, center) - center)
    left = np.linalg.norm(similarity.apply(true, center) - similarity.apply(closure.old_from_new, center))
    assert left < 0.25 * lost
    assert left < 0.1
    assert abs(np.log(closure.old_from_new[7] / true[7])) < 0.05
    # each pair is one spot of the wall
    spots = wall_spots(walker, moves)
    pairs = closure.point_pairs
    assert len(pairs) > 60
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    assert np.median(np.linalg.norm(spots[pairs[:, 0]] - spots[pairs[:, 1]], axis=1)) < 0.03
    before = rms_error(keyframes, ground_truth[:last])
    closed = apply_closure(keyframes, places, closure)
    after = rms_error(keyframes, ground_truth[:last])
    # a walk pinned at its end keeps the middle's error: some of it goes, not all
    assert 0.15 * before < after < 0.75 * before
    assert closed.corrections.shape == (last, 8)
    assert np.allclose(closed.corrections[0], similarity.IDENTITY)
    for keyframe in keyframes.keyframes:
        assert (np.diff(keyframe.point_id) > 0).all()
        assert not np.isin(closed.renamed[:, 0], keyframe.point_id).any()
        assert len(keyframe.xy) == len(keyframe.is_inlier) == len(keyframe.point_id)
    assert np.isnan(keyframes.point_xyz[closed.renamed[:, 0], 0]).all()
    shared = np.intersect1d(keyframes.keyframes[-1].point_id, keyframes.keyframes[views[-1].old_idx].point_id)
    assert len(shared) >= 20
    assert all((np.diff(places[k.frame_idx].point_id) > 0).all() for k in keyframes.keyframes)


def wall_spots(walker: Walker, moves: list[Array]) -> Array:
    """True places of all points of a map that was moved."""
    out = np.full((walker.keyframes.num_points, 3), np.nan)
    for pose, keyframe in zip(round_trip(), walker.keyframes.keyframes, strict=False):
        out[keyframe.point_id] = walker.wall.points(pose, keyframe.xy[:, 0])
    return out


def walk_along(image: Array, finder: LoopFinder) -> bool:
    """Whether a loop is found on the way along a wall, on to new places all the time."""
    walker, places, found = Walker(Wall(image)), PlaceIndex(), False
    for n in range(30):
        keyframe = walker.step(n, pose_at(3 + 0.6 * n, 5.5 + 0.02 * n))
        found |= finder.find({0: walker.keyframes}, 0, places, n, walker.add_to(places, keyframe)) is not None
    return found


def test_a_wall_that_repeats_itself_is_no_loop(wall: Wall) -> None:
    """After eight metres all is as before. Only the way between can tell, and it does."""
    image = wall.image.copy()
    image[:, 960:1600] = image[:, 320:960]
    assert not walk_along(wall.image, LoopFinder())
    assert not walk_along(image, LoopFinder())
    assert walk_along(image, LoopFinder(LoopOptions(max_drift_mono=10.0)))


def test_a_wall_that_repeats_half_of_itself_is_no_loop(wall: Wall) -> None:
    """The upper half of what is in view is as before: even if the map could be anywhere, the lower half contradicts."""
    image = wall.image.copy()
    image[:475, 960:1600] = image[:475, 320:960]
    assert not walk_along(image, LoopFinder(LoopOptions(max_drift_mono=10.0)))


def test_a_wall_of_equal_bays_is_no_loop_wherever_the_map_could_be(wall: Wall) -> None:
    """Every four metres all is as before: what is seen is there alone nowhere, whatever the way could have lost."""
    finder = LoopFinder(LoopOptions(max_drift_mono=10.0))
    assert not walk_along(np.tile(wall.image[:, 320:640], (1, 6)), finder)
    assert finder.num_open >= 1


def test_points_that_one_image_shows_apart_are_two() -> None:
    keyframes = KeyframeMap(Rig.single(CAMERA))
    old, new = keyframes.new_points(20), keyframes.new_points(20)
    rng = np.random.default_rng(0)
    for n, ids in enumerate((old, np.concatenate([old[10:], new[10:]]), new)):
        xy = rng.uniform([0, 0], [320, 240], (len(ids), 1, 2))
        if n == 1:  # the last five pairs lie on each other
            xy[15:] = xy[5:10] + 1.0
        keyframes.append(Keyframe(n, 0.0, str(n), rigid3.IDENTITY, ids, xy, np.ones((len(ids), 1), bool)))
    assert are_seen_apart(keyframes, new, old, 12.0)
    assert are_seen_apart(keyframes, new[10:15], old[10:15], 12.0)
    assert not are_seen_apart(keyframes, new[:10], old[:10], 12.0)  # no image shows both
    assert not are_seen_apart(keyframes, new[15:], old[15:], 12.0)
    assert not are_seen_apart(keyframes, new[:11], old[:11], 12.0)  # one wrong match among eleven is none too many
    assert not are_seen_apart(keyframes, old, old, 12.0)
    assert not are_seen_apart(keyframes, np.full(5, -1), old[:5], 12.0)


def test_shares_and_shifts_are_weighed_as_likelihoods() -> None:
    for num, total, expected in ((7, 20, 0.1), (20, 20, 0.1), (3, 20, 0.05)):
        log = binom.logpmf(num, total, num / total) - binom.logpmf(num, total, expected)
        assert log_ratio_of_share(num, total, expected) == pytest.approx(log)
    assert log_ratio_of_share(2, 20, 0.1) == log_ratio_of_share(0, 20, 0.1) == log_ratio_of_share(0, 0, 0.1) == 0.0
    # both are densities: the ratio over all shifts of look-alikes, even over a disk, has the mean one
    edges = np.geomspace(1e-3, 1.0, 20001)
    middle = np.sqrt(edges[1:] * edges[:-1])
    ratio = np.exp([log_ratio_of_shift(shift) for shift in middle])
    assert (ratio * np.diff(edges**2)).sum() == pytest.approx(1.0, abs=1e-3)
    assert log_ratio_of_shift(0.0) == log_ratio_of_shift(1e-3) > -math.log(MAX_DOUBT)
    assert log_ratio_of_shift(1.0) < 0.0


def test_a_correction_that_nobody_could_have_lost_is_refused(wall: Wall) -> None:
    walker, _, _ = walk_with_drift(wall, 0.0, 0)
    keyframes, everything = walker.keyframes, walker.keyframes.keyframes
    # the way back is torn from the way there by more than half of its length
    tear = similarity.from_parts(np.eye(3), [40.0, 0.0, 0.0], 1.0)
    apply_corrections(keyframes, np.array([similarity.IDENTITY if n < 49 else tear for n in range(len(everything))]))
    places, finder = PlaceIndex(), LoopFinder()
    keyframes.keyframes = []
    for n, keyframe in enumerate(everything):
        keyframes.keyframes.append(keyframe)
        assert finder.find({0: keyframes}, 0, places, n, walker.add_to(places, keyframe)) is None


def test_two_halves_become_one(wall: Wall) -> None:
    places, finder = PlaceIndex(), LoopFinder()
    first, second = Walker(wall, 0), Walker(wall, 1)
    ground_truth = round_trip()
    for n, pose in enumerate(ground_truth[:28]):
        first.add_to(places, first.step(n, pose))
    there = similarity.from_parts(rigid3.exp_so3([0.3, -0.5, 0.2]), [5.0, -3.0, 1.0], 1.8)
    back = [pose_at(12 - 0.6 * k, 4.15, 3.1) for k in range(12)]
    for pose in back:
        second.step(100 + len(second.images), pose)
    apply_corrections(second.keyframes, np.tile(there, (12, 1)))
    maps, everything, closure = {0: first.keyframes, 1: second.keyframes}, second.keyframes.keyframes, None
    second.keyframes.keyframes = []
    for keyframe in everything:
        second.keyframes.keyframes.append(keyframe)
        view = second.add_to(places, keyframe)
        closure = finder.find(maps, 1, places, keyframe.frame_idx, view)
        if closure is not None:
            break
    assert closure is not None
    assert (closure.new_map, closure.old_map) == (1, 0)
    both = similarity.compose(closure.old_from_new, there)
    assert both[7] == pytest.approx(1.0, abs=0.02)
    assert np.linalg.norm(similarity.apply(both, [12.0, 4.0, 0.0]) - [12.0, 4.0, 0.0]) < 0.03
    count = len(second.keyframes.keyframes)
    joined = join_maps(maps, places, closure)
    assert (joined.kept_map, joined.absorbed_map) == (0, 1)
    frames = [k.frame_idx for k in joined.keyframes.keyframes]
    assert frames == [*range(28), *range(100, 100 + count)]
    assert rms_error(joined.keyframes, ground_truth[:28] + back[:count]) < 0.02
    assert joined.id_offset == first.keyframes.num_points
    assert joined.keyframes.num_points == first.keyframes.num_points + second.keyframes.num_points
    assert all(places[f].map_idx == 0 for f in frames)
    shared = np.intersect1d(joined.keyframes.keyframes[-1].point_id, np.arange(joined.id_offset))
    assert len(shared) >= 40
    # the maps that were given are as they were
    assert len(first.keyframes.keyframes) == 28
    assert second.keyframes.keyframes[0].point_id.max() < joined.id_offset
    with pytest.raises(ValueError, match="join_maps"):
        apply_closure(first.keyframes, places, closure)


def test_fusing_points_keeps_the_older_observation() -> None:
    keyframes = KeyframeMap(Rig.single(CAMERA))
    ids = keyframes.new_points(6)
    keyframes.point_xyz[:6] = np.arange(18.0).reshape(6, 3)
    keyframes.point_xyz[1] = np.nan
    xy = np.arange(8.0).reshape(4, 1, 2)
    keyframes.keyframes.append(Keyframe(0, 0.0, "0", rigid3.IDENTITY, ids[[0, 1, 4, 5]], xy, np.zeros((4, 1), bool)))
    fuse_points(keyframes, np.array([[4, 1], [5, 2]]))
    keyframe = keyframes.keyframes[0]
    assert list(keyframe.point_id) == [0, 1, 2]
    assert np.array_equal(keyframe.xy[:, 0, 0], [0.0, 2.0, 6.0])
    assert list(keyframe.is_inlier[:, 0]) == [False, False, True]
    assert np.array_equal(keyframes.point_xyz[1], [12.0, 13.0, 14.0])  # it had none of its own
    assert np.array_equal(keyframes.point_xyz[2], [6.0, 7.0, 8.0])
    assert np.isnan(keyframes.point_xyz[[4, 5], 0]).all()
