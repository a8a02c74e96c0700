"""Frames that are chosen of videos: rendered clips whose motion is known exactly."""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.events import Event, Events
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.pyramid import build_pyramid
from sfmapp.pipelines.sparse.add import add_photographs
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.pipelines.sparse.videos import Sources, sources_of
from sfmapp.video.following import Follower
from sfmapp.video.frames import choose_frames
from sfmapp.video.motion import motion_between
from sfmapp.video.options import VideoOptions
from sfmapp.video.quality import look_at
from sfmapp.video.selection import FrameRow, Selector
from sfmapp.workspace.options import load_options

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
FPS = 25.0


def texture(seed: int, size: int = 700) -> Pixels:
    """Blobs of all sizes that a corner detector likes."""
    rng = np.random.default_rng(seed)
    out = np.zeros((size, size), np.float32)
    for sigma, weight in ((1.5, 1.0), (4.0, 1.5), (12.0, 2.0)):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        out += weight * layer / layer.std()
    return np.clip(128 + 35 * out, 0, 255).astype(np.uint8)


@dataclass
class Walls:
    """Vertical strips of a wall at two depths, each as wide as the other, that a camera passes."""

    seed: int = 0
    depths: tuple[float, float] = (4.0, 7.0)

    def __post_init__(self) -> None:
        self._textures = [texture(2 * self.seed + k) for k in range(2)]

    def image(self, center: Sequence[float], yaw_deg: float = 0.0) -> Pixels:
        """What a camera at a place sees, the far wall through gaps of the near one."""
        k = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]])
        rotation = rigid3.exp_so3(np.radians([0.0, yaw_deg, 0.0]))
        out: Pixels | None = None
        for idx in (1, 0):
            size, metres = 700, 14.0
            # texture pixels to the wall's metres to the picture
            plane = np.array([[metres / size, 0, -metres / 2], [0, metres / size, -metres / 2], [0, 0, 1]])
            shift = -np.asarray(center, float) + [0, 0, self.depths[idx]]
            to_picture = k @ rotation @ np.column_stack([np.eye(3)[:, :2], shift]) @ plane
            seen = cv2.warpPerspective(self._textures[idx], to_picture, (WIDTH, HEIGHT), flags=cv2.INTER_AREA)
            if out is None:
                out = np.asarray(seen, np.uint8)
            else:
                strips = np.zeros((size, size), np.uint8)
                strips[:, (np.arange(size) // 50) % 2 == 0] = 255
                mask = cv2.warpPerspective(strips, to_picture, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
                out = np.where(mask > 127, seen, out).astype(np.uint8)
        assert out is not None
        return out

    def points(self, center: Sequence[float], yaw_deg: float = 0.0) -> Array:
        """(N, 2) pixels of a grid of points of both walls; NaN for those of the far one behind the near one, and those
        of the gaps."""
        grid = np.stack(np.meshgrid(np.linspace(-6, 6, 121), np.linspace(-4, 4, 21)), -1).reshape(-1, 2)
        xyz = np.concatenate([np.column_stack([grid, np.full(len(grid), depth)]) for depth in self.depths])
        crossing = center[0] + (xyz[:, 0] - center[0]) * self.depths[0] / xyz[:, 2]
        is_strip = np.floor(crossing + 7.0).astype(int) % 2 == 0
        xyz[is_strip != (xyz[:, 2] == self.depths[0])] = np.nan
        rotation = rigid3.exp_so3(np.radians([0.0, yaw_deg, 0.0]))
        seen = (xyz - np.asarray(center, float)) @ rotation.T
        return np.asarray(FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2])

    def depth_at(self, xy: Array, x: float) -> Array:
        """(N,) depths of what a camera at (x, 0, 0) that looks ahead sees at pixels (N, 2)."""
        crossing = x + (xy[:, 0] - WIDTH / 2) / FOCAL * self.depths[0]
        is_near = np.floor(crossing + 7.0).astype(int) % 2 == 0
        return np.where(is_near, *self.depths)


def noisy(image: Pixels, seed: int) -> Pixels:
    noise = np.random.default_rng([seed, 9]).normal(0, 2.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def select(images: Sequence[Pixels], **options: float) -> tuple[list[FrameRow], Selector[int]]:
    """The rows of the frames that are taken."""
    selector = Selector[int](VideoOptions(**options))
    taken = []
    for number, image in enumerate(images):
        taken += [one.row for one in selector.push(number, number / FPS, look_at(image), number)]
    taken += [one.row for one in selector.end()]
    assert [row.number for row in taken] == [row.number for row in selector.rows if row.is_taken]
    return taken, selector


@pytest.fixture(scope="module")
def walls() -> Walls:
    return Walls()


@pytest.fixture(scope="module")
def passing(walls: Walls) -> list[Pixels]:
    """A camera that passes the walls, 4 cm from frame to frame."""
    return [noisy(walls.image((-1.2 + 0.04 * k, 0, 0)), k) for k in range(60)]


def inside(*xy: Array) -> NDArray[np.bool_]:
    return np.logical_and.reduce([((p > 0) & (p < (WIDTH, HEIGHT))).all(axis=1) for p in xy])


def test_points_are_followed_to_where_they_are(walls: Walls, passing: list[Pixels]) -> None:
    first, last = 20, 32
    follower = Follower(build_pyramid(passing[first]))
    assert all(follower.follow(build_pyramid(passing[k])) for k in range(first + 1, last + 1))
    assert follower.share_left > 0.7
    true = follower.first_xy - [FOCAL * 0.04 * (last - first), 0] / walls.depth_at(follower.first_xy, -0.4)[:, None]
    off = np.linalg.norm(follower.xy - true, axis=1)
    assert np.median(off) < 0.3
    # the others are where a near strip hides more and more of the far wall
    assert np.mean(off < 1.0) > 0.75
    assert follower.apart().parallax == pytest.approx(
        motion_between(follower.first_xy, true, (HEIGHT, WIDTH)).parallax, rel=0.2
    )


def test_frames_are_spaced_by_what_is_wanted(walls: Walls, passing: list[Pixels]) -> None:
    taken, selector = select(passing, parallax=0.02)
    assert 4 <= len(taken) <= 15
    assert not selector.breaks
    for first, second in itertools.pairwise(taken[:-1]):  # the last is as far as the video goes
        xy1, xy2 = (walls.points((-1.2 + 0.04 * row.number, 0, 0)) for row in (first, second))
        seen = inside(xy1, xy2)
        true = motion_between(xy1[seen], xy2[seen], (HEIGHT, WIDTH))
        assert 0.5 <= max(true.parallax / 0.02, (1 - true.overlap) / 0.2) <= 1.6


def test_wider_and_narrower_spacing(passing: list[Pixels]) -> None:
    numbers = [len(select(passing, parallax=share, overlap=0.4)[0]) for share in (0.01, 0.02, 0.04)]
    assert numbers[0] > numbers[1] > numbers[2] >= 2


def test_a_camera_that_stands_still_gives_one_frame(walls: Walls) -> None:
    still = walls.image((0, 0, 0))
    taken, selector = select([noisy(still, k) for k in range(40)])
    assert [row.why.split(",")[0] for row in taken] == ["first"]
    assert all((row.parallax or 0.0) < 0.002 for row in selector.rows)


def test_a_camera_that_turns_on_the_spot_gives_frames_by_overlap_alone(walls: Walls) -> None:
    turning = [noisy(walls.image((0, 0, 0), 0.75 * k), k) for k in range(40)]
    taken, _ = select(turning, overlap=0.7)
    # 29 degrees of a field of view of 56, in steps of 30 % of it
    assert 2 <= len(taken) <= 4
    assert all(row.why.startswith("overlap") for row in taken[1:-1])
    assert all((row.parallax or 0.0) < 0.01 for row in taken)


@pytest.mark.parametrize("yaw_deg", [2.0, 8.0])
def test_a_rotation_has_no_parallax_and_a_translation_does(walls: Walls, yaw_deg: float) -> None:
    here = walls.points((0, 0, 0))
    turned, moved = walls.points((0, 0, 0), yaw_deg), walls.points((0.3, 0, 0), yaw_deg)
    seen = inside(here, turned) & inside(moved)
    alone = motion_between(here[seen], turned[seen], (HEIGHT, WIDTH))
    assert alone.parallax < 0.05 * alone.flow
    both = motion_between(here[seen], moved[seen], (HEIGHT, WIDTH))
    # 0.3 m between 4 and 7 m: half of the difference of 0.075 and 0.043 focal lengths, in sides of 320 pixels, of
    # which a rotation explains a part
    assert 0.5 * 0.016 * FOCAL / WIDTH < both.parallax < 1.1 * 0.016 * FOCAL / WIDTH


def test_blurred_frames_are_avoided(walls: Walls) -> None:
    images = []
    for k in range(60):
        image = walls.image((-1.2 + 0.04 * k, 0, 0))
        images.append(noisy(image if k % 4 == 1 else np.asarray(cv2.blur(image, (9, 1)), np.uint8), k))
    taken, _ = select(images, parallax=0.02)
    assert len(taken) >= 4
    assert all(row.number % 4 == 1 for row in taken[:-1])


def test_a_cut_is_named(walls: Walls, passing: list[Pixels]) -> None:
    other = Walls(seed=5)
    images = passing[:25] + [noisy(other.image((-0.5 + 0.04 * k, 0, 0)), k) for k in range(25)]
    taken, selector = select(images, parallax=0.02)
    assert selector.breaks == [25 / FPS]
    assert sum(row.number < 25 for row in taken) >= 2
    assert sum(row.number >= 25 for row in taken) >= 2
    assert next(row for row in taken if row.number >= 25).why.startswith("first after a break")


def test_black_bright_and_repeated_frames_are_left_out(passing: list[Pixels]) -> None:
    images = passing[:30]
    images[10:12] = [np.zeros_like(images[0])] * 2
    images[15] = np.full_like(images[0], 255)
    images[15][:20] = 100
    images[20] = images[19]
    _, selector = select(images, parallax=0.02)
    assert not selector.breaks
    assert {number: selector.rows[number].why for number in (10, 11, 15, 20)} == {
        10: "black", 11: "black", 15: "over-exposed", 20: "repeats frame 19",
    }  # fmt: skip


# ------------------------------------------------------------------------------------------------------------- files


def write_clip(path: Path, images: Sequence[Pixels], codec: str = "MJPG") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), FPS, (WIDTH, HEIGHT), isColor=False)
    for image in images:
        writer.write(image)
    writer.release()
    return path


def warnings() -> tuple[Events, list[str]]:
    told: list[str] = []

    def hear(event: Event) -> None:
        if event.kind == "warned":
            told.append(event.message)

    return Events(hear), told


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory, passing: list[Pixels]) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips") / "walk.avi", passing)


def read_table(folder: Path) -> Iterator[dict[str, str]]:
    with (folder / "frames.csv").open(encoding="utf-8", newline="") as file:
        yield from csv.DictReader(file)


def test_frames_and_their_table_are_written_and_do_not_depend_on_threads(clip: Path, tmp_path: Path) -> None:
    options, before = VideoOptions(parallax=0.02), cv2.getNumThreads()
    events, told = warnings()
    reports = []
    try:
        for threads in (1, 2):
            cv2.setNumThreads(threads)
            reports.append(choose_frames(clip, tmp_path / f"{threads}" / "walk", options, events))
    finally:
        cv2.setNumThreads(before)
    assert not told
    assert reports[0].num_frames == 60
    assert reports[0].chosen == reports[1].chosen
    names = sorted(path.name for path in (tmp_path / "1" / "walk").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "2" / "walk").iterdir())
    for name in names:
        assert (tmp_path / "1" / "walk" / name).read_bytes() == (tmp_path / "2" / "walk" / name).read_bytes()
    rows = list(read_table(tmp_path / "1" / "walk"))
    assert [int(row["frame"]) for row in rows] == list(range(60))
    assert [f"walk/{row['file']}" for row in rows if row["file"]] == [one.name for one in reports[0].chosen]
    assert {row["file"] for row in rows} - {""} == set(names) - {"frames.csv"}
    assert float(rows[50]["time_s"]) == pytest.approx(2.0)


def test_no_more_frames_than_are_wanted(clip: Path, tmp_path: Path) -> None:
    events, told = warnings()
    report = choose_frames(clip, tmp_path / "walk", VideoOptions(parallax=0.005, max_frames=6), events)
    assert 3 <= len(report.chosen) <= 6
    assert report.every in (2, 4, 8)
    assert len(list((tmp_path / "walk").glob("*.jpg"))) == len(report.chosen)
    assert any("video.max_frames" in message for message in told)
    gaps = np.diff([one.number for one in report.chosen])
    assert gaps.max() <= 2 * gaps.min() + 2


def test_a_truncated_video_is_named_and_read_as_far_as_it_goes(passing: list[Pixels], tmp_path: Path) -> None:
    data = write_clip(tmp_path / "whole.mkv", passing).read_bytes()
    short = tmp_path / "short.mkv"
    short.write_bytes(data[: int(0.6 * len(data))])
    events, told = warnings()
    report = choose_frames(short, tmp_path / "short", VideoOptions(parallax=0.02), events)
    assert 25 <= report.num_frames <= 45
    assert len(report.chosen) >= 2
    assert report.missing_end.endswith("of 2.4 s")
    assert any("ends too early" in message for message in told)


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    fake = tmp_path / "fake.mp4"
    fake.write_bytes(b"no video" * 100)
    with pytest.raises(InputError, match=r"fake\.mp4: expected a video"):
        choose_frames(fake, tmp_path / "fake", VideoOptions(), Events())
    with pytest.raises(InputError, match=r"gone\.mp4: expected a video, found no such file"):
        sources_of(str(tmp_path / "gone.mp4"))
    with pytest.raises(InputError, match="found a stream"):
        sources_of("camera:0")


def test_sources_are_told_apart(tmp_path: Path) -> None:
    film, photos = tmp_path / "a.MOV", tmp_path / "photos"
    film.write_bytes(b"")
    photos.mkdir()
    assert sources_of(photos) == str(photos)
    assert sources_of([str(photos)]) == str(photos)
    assert sources_of([film, photos, film]) == Sources((film,), (str(photos),))
    assert sources_of([photos, tmp_path]) == Sources((), (str(photos), str(tmp_path)))


def true_pose(center: Sequence[float]) -> Array:
    """(7,) cam_from_world of a camera that looks ahead."""
    return rigid3.from_matrix(np.eye(3), -np.asarray(center, float))


def test_videos_and_photographs_become_one_model_and_more_is_added(
    walls: Walls, clip: Path, tmp_path: Path
) -> None:  # fmt: skip
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    heights = {"a.png": -0.3, "b.png": 0.3}
    for name, y in heights.items():
        cv2.imwrite(str(photos / name), walls.image((0.1, y, 0.2)))
    camera = f"PINHOLE,{FOCAL},{FOCAL},{WIDTH / 2},{HEIGHT / 2}"
    options = load_options([], [f"images.camera={camera}", "video.parallax=0.03", "video.overlap=0.7"])
    found = reconstruct([clip, photos], out, options, record=False)
    videos = found.report.stages.videos
    assert videos is not None
    names = [frame.name for frame in videos[0].chosen]
    assert list(found.reconstruction.image_names) == [*names, "photos/a.png", "photos/b.png"]
    truth = {name: true_pose((-1.2 + 0.04 * int(name[-10:-4]), 0, 0)) for name in names}
    truth |= {f"photos/{name}": true_pose((0.1, y, 0.2)) for name, y in heights.items()}
    poses = np.array(list(truth.values()))
    errors = evaluate_poses(
        found.reconstruction.image_names, found.reconstruction.cam_from_world, list(truth), poses
    )  # fmt: skip
    assert errors.is_common.all()
    assert np.nanmax(errors.center_error) < 0.02 * 2.4
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<h2>Videos</h2>" in page
    assert page.count("data:image/jpeg") >= len(names)
    frames = {path: path.stat().st_mtime_ns for path in (out / "images").rglob("*.jpg")}
    assert reconstruct([clip, photos], out, options, record=False).report.run.is_up_to_date
    assert frames == {path: path.stat().st_mtime_ns for path in (out / "images").rglob("*.jpg")}

    back = write_clip(tmp_path / "walk.avi", [walls.image((1.0 - 0.05 * k, 0.15, 0)) for k in range(25)])
    more = add_photographs(os.fspath(back), out, record=False)
    added = more.report.added
    assert added is not None
    assert {one.name.split("/")[0] for one in added.photographs} == {"walk-2"}
    assert all(one.model == 0 for one in added.photographs)
    assert set(truth) < set(more.reconstruction.image_names)
