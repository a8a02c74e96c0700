"""Live sources: what is dropped, counted and kept, by a clock that the test winds."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import sfmapp
from odometry_sequences import PINHOLE, room
from schemas import check_schema
from sfmapp.cli.main import main
from sfmapp.events import Event, Events
from sfmapp.images import live_buffer, video
from sfmapp.images.addresses import without_credentials
from sfmapp.images.frame_reader import Skipped
from sfmapp.images.live_buffer import LiveBuffer, read_newest, taken_from
from sfmapp.images.live_sequence import LiveSequence
from sfmapp.images.sequence import Frame, Imu, SequenceOptions
from sfmapp.odometry.inertial.filtering import FilteredPose
from sfmapp.odometry.snapshot import FrameSnapshot
from sfmapp.scene.rig import Rig
from sfmapp.sequences.open import open_sequence

SMALL = sfmapp.Camera(sfmapp.CameraModel.PINHOLE, 60, 40, np.array([50.0, 50.0, 30.0, 20.0]))
PICTURE = np.zeros((40, 60), np.uint8)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def frame(idx: int) -> Frame:
    return Frame(idx, f"{idx:06d}", idx / 30, (PICTURE,))


def test_the_newest_frames_wait_and_the_oldest_are_dropped() -> None:
    buffer = LiveBuffer(max_waiting=2)
    for idx in range(5):
        buffer.put(frame(idx))
    buffer.end("closed")
    buffer.put(frame(5))  # too late
    assert [item.idx for item in taken_from(buffer, lambda: True) if isinstance(item, Frame)] == [3, 4]
    counts = buffer.counts
    assert (counts.num_arrived, counts.num_dropped, counts.max_waiting, counts.end) == (5, 3, 2, "closed")


@pytest.mark.parametrize(("period", "work"), [(1, 1), (1, 2), (1, 5), (3, 2)])
def test_age_and_drops_are_bounded_by_what_a_frame_takes(period: int, work: int) -> None:
    """A camera with a frame every ``period`` ticks, and a tracker that takes ``work`` of them for each."""
    clock, ages, busy_until = Clock(), [], 0.0
    buffer = LiveBuffer(clock=clock)
    for tick in range(600):
        clock.now = float(tick)
        if tick % period == 0:
            buffer.put(Frame(tick, "", tick, (PICTURE,), captured_s=clock.now))
        if tick >= busy_until and (item := buffer.take(0.0)) is not None:
            assert isinstance(item, Frame)
            assert item.captured_s is not None
            ages.append(tick + work - item.captured_s)
            busy_until = tick + work
    counts = buffer.counts
    # whoever is quick enough loses nothing, and else as much is lost as there is no time for
    assert counts.num_dropped == pytest.approx(max(0.0, 1 - period / work) * counts.num_arrived, abs=2)
    assert max(ages) <= 3 * work
    assert counts.longest_silence_s == period


def test_a_silent_source_has_ended_and_what_came_is_kept() -> None:
    clock = Clock()
    buffer = LiveBuffer(clock=clock)
    buffer.put(frame(0))
    items = taken_from(buffer, lambda: True, stall_s=5.0)
    assert isinstance(next(items), Frame)
    clock.now += 5.5
    assert list(items) == []
    assert buffer.counts.end == "no frame came for 5 s"
    assert buffer.counts.longest_silence_s == 5.5
    never = LiveBuffer(clock=clock)  # one that gives nothing at all
    assert never.silence_s() == 0.0
    clock.now += 7.0
    assert never.silence_s() == 7.0


class Reader:
    """Frames from a list; None hangs until it is closed by the test."""

    def __init__(self, items: list[Frame | Skipped | Exception]) -> None:
        self.items, self.is_closed = items, threading.Event()

    def __call__(self) -> Frame | Skipped | None:
        item = self.items.pop(0) if self.items else None
        if isinstance(item, Exception):
            raise item
        return item

    def close(self) -> None:
        self.is_closed.set()


def test_a_reader_is_read_on_beside_and_closed_there() -> None:
    reader, buffer = Reader([frame(0), Skipped("000001", "damaged"), frame(2)]), LiveBuffer(max_waiting=10)
    assert len(list(read_newest(reader, buffer, lambda: True, 5.0))) == 3
    assert reader.is_closed.is_set()
    assert buffer.counts.end == "the source has ended"
    broken, buffer = Reader([frame(0), RuntimeError("cable")]), LiveBuffer()
    assert len(list(read_newest(broken, buffer, lambda: True, 5.0))) == 1
    assert buffer.counts.end == "the source has failed: cable"
    with pytest.raises(sfmapp.InputError, match="no camera"):
        list(read_newest(Reader([sfmapp.InputError("no camera")]), LiveBuffer(), lambda: True, 5.0))


def test_a_wish_to_stop_ends_a_source_that_gives_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    hang, events, buffer, asked = threading.Event(), Events(), LiveBuffer(), []

    class Hanging(Reader):
        def __call__(self) -> Frame | Skipped | None:
            hang.wait()
            return None

    def is_wanted() -> bool:
        asked.append(events.is_cancelled)
        if len(asked) == 2:
            events.cancel()
        return not events.is_cancelled

    monkeypatch.setattr(live_buffer, "_END_S", 0.0)  # it is left behind
    reader = Hanging([])
    assert list(read_newest(reader, buffer, is_wanted, 60.0)) == []
    assert buffer.counts.end == "stopped on request"
    assert not reader.is_closed.is_set()
    hang.set()
    assert reader.is_closed.wait(60.0)  # closed by its own thread


class FakeCapture:
    """cv2.VideoCapture of a camera that gives ten frames and then none, one of them of another size."""

    def __init__(self, device: int) -> None:
        self.count = 0

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def get(self, key: int) -> float:
        return {3: 60.0, 4: 40.0}.get(key, 30.0)

    def grab(self) -> bool:
        self.count += 1
        return self.count <= 10

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((40, 60 if self.count != 5 else 61, 3), self.count, np.uint8)

    def read(self) -> tuple[bool, np.ndarray]:
        return self.grab(), self.retrieve()[1]

    def release(self) -> None:
        pass


def test_a_camera_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cv2.VideoCapture", FakeCapture)
    monkeypatch.setattr(video, "LiveBuffer", lambda: LiveBuffer(max_waiting=20))  # so that none is dropped
    told: list[str] = []
    events = Events(lambda event: told.append(event.message))
    sequence = opened("camera:0", events)
    frames = list(sequence.frames())
    assert [int(item.images[0][0, 0]) for item in frames] == [1, 2, 3, 4, 6, 7, 8, 9, 10]
    assert [item.idx for item in frames] == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert all(item.captured_s is not None for item in frames)
    assert (np.diff([item.timestamp_s for item in frames]) > 0).all()
    assert "skipped 000004: 61x40 pixels, where the video began with other ones" in told
    assert "camera:0: the source has ended" in told


def opened(source: str, events: Events) -> video.VideoSequence:
    sequence = open_sequence(source, SequenceOptions(camera="PINHOLE,50,50,30,20"), events)
    assert isinstance(sequence, video.VideoSequence)
    return sequence


def test_pushed_frames_are_stamped_and_wrong_ones_are_left_out() -> None:
    clock = Clock()
    sequence = LiveSequence(Rig.single(SMALL), Events(), LiveBuffer(max_waiting=9, clock=clock))
    sequence.push(PICTURE, None)
    clock.now += 0.5
    sequence.push(np.zeros((40, 60, 3), np.uint16), None)
    with pytest.raises(sfmapp.InputError, match="frame 000002: 61x40 pixels, but its camera has 60x40"):
        sequence.push(np.zeros((40, 61), np.uint8), None)
    with pytest.raises(sfmapp.InputError, match=r"expected a time after 0\.5 s"):
        sequence.push(PICTURE, 0.5)
    sequence.push(PICTURE, 7.0)
    sequence.end("closed")
    found = list(sequence.frames())
    assert [(item.idx, item.timestamp_s, item.captured_s) for item in found] == [
        (0, 0.0, 100.0), (1, 0.5, 100.5), (2, 7.0, 100.5),
    ]  # fmt: skip


# ------------------------------------------------------------------------------------------------------- whole runs


def waiting_for_each(odometry: sfmapp.LiveOdometry, images: list[np.ndarray]) -> Iterator[np.ndarray]:
    """The images, the next one when the last one has its pose: nothing is dropped, on any machine."""
    for number, image in enumerate(images, 1):
        yield image
        while odometry.report.num_tracked < number:
            threading.Event().wait(0.002)


def test_what_is_pushed_is_tracked_as_it_would_be_from_a_list(tmp_path: Path) -> None:
    images = [images[0] for images in room(30).images]
    listed, _ = sfmapp.track_sequence(sfmapp.ArraySequence(images, PINHOLE), threads=1, seed=3)
    seen: list[FrameSnapshot] = []
    with sfmapp.LiveOdometry(PINHOLE, tmp_path / "out", on_pose=seen.append, record=False, seed=3) as odometry:
        for number, image in enumerate(waiting_for_each(odometry, images)):
            odometry.push(image, number / 30)
    assert odometry.latest is seen[-1]
    found, report = odometry.close()
    np.testing.assert_array_equal(found.cam_from_world, listed.cam_from_world)
    assert report is not None
    assert report["live"]["num_arrived"] == report["live"]["num_tracked"] == 30
    assert report["live"]["end"] == "closed"
    (check,) = (row for row in report["checks"] if row["name"] == "frames that were tracked in time")
    assert (check["value"], check["light"]) == ("100.0 %", "green")
    assert 0 < report["live"]["latency_ms"]["median"] <= report["live"]["latency_ms"]["max"]
    check_schema("odometry", json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8")))
    assert "30 frames came, 0 of them were dropped" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    with pytest.raises(sfmapp.UsageError, match="a run that has ended: closed"):
        odometry.push(images[0])


def sensor(**changed: object) -> Imu:
    still = {
        "timestamps_s": np.zeros(0), "gyro": np.zeros((0, 3)), "accel": np.zeros((0, 3)),
        "imu_from_cam": np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), "gyro_noise": 1e-4, "accel_noise": 1e-3,
        "gyro_walk": 1e-5, "accel_walk": 1e-3,
    }  # fmt: skip
    return Imu(**(still | changed))  # type: ignore[arg-type]


def test_inertial_samples_are_pushed_beside_frames(tmp_path: Path) -> None:
    """A sensor that says it hardly moves while the camera walks: the report says why it does not predict."""
    images = [images[0] for images in room(80).images]
    filtered = list[FilteredPose]()
    with sfmapp.LiveOdometry(
        PINHOLE, tmp_path / "out", imu=sensor(), on_filtered=filtered.append, record=False
    ) as odometry:
        for number, image in enumerate(waiting_for_each(odometry, images)):
            for k in range(4):
                odometry.push_imu((number + 0.25 * k) / 20, np.zeros(3), [0.0, -9.81, 0.0])
            odometry.push(image, (number + 0.8) / 20)
            if number == 0:
                for wrong in ((0.0, np.zeros(3), np.zeros(3)), (9.0, np.zeros(2), np.zeros(3))):
                    with pytest.raises(sfmapp.InputError, match="IMU: expected"):
                        odometry.push_imu(*wrong)
                with pytest.raises(sfmapp.InputError, match="clock of the IMU"):
                    odometry.push(image)
    report = odometry.close().report
    assert report is not None
    told = report["stages"]["filter"]
    assert told["prediction"] == "constant velocity"
    assert told["reason"].startswith("the motion tells the scale to ")  # so that it is no start
    assert not filtered
    with pytest.raises(sfmapp.UsageError, match="a run that has ended"):
        odometry.push_imu(99.0, np.zeros(3), np.zeros(3))


def test_a_sensor_is_named_before_it_is_heard() -> None:
    with pytest.raises(sfmapp.UsageError, match="need a sensor"):
        sfmapp.LiveOdometry(PINHOLE, on_filtered=print)
    for wrong in ({"accel_noise": 0.0}, {"gyro_walk": np.nan}, {"imu_from_cam": np.zeros(7)}):
        with pytest.raises(sfmapp.InputError, match="IMU: expected"):
            sfmapp.LiveOdometry(PINHOLE, imu=sensor(**wrong))
    odometry = sfmapp.LiveOdometry(PINHOLE)
    with pytest.raises(sfmapp.UsageError, match="no IMU was named"):
        odometry.push_imu(0.0, np.zeros(3), np.zeros(3))
    with pytest.raises(sfmapp.NoReconstructionError):
        odometry.close()


def test_a_program_that_fails_or_a_callback_that_does(tmp_path: Path) -> None:
    images = [images[0] for images in room(30).images]
    odometry = sfmapp.LiveOdometry(PINHOLE, tmp_path / "out", record=False)

    def push_until_interrupted() -> None:
        with odometry:
            for image in waiting_for_each(odometry, images):
                odometry.push(image)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        push_until_interrupted()
    assert odometry.report.end == "KeyboardInterrupt in the program that pushes"
    assert odometry.close().report is not None
    assert (tmp_path / "out" / "trajectory.tum").is_file()

    def fail(_: object) -> None:
        raise ValueError("of mine")

    broken = sfmapp.LiveOdometry(PINHOLE, on_pose=fail)
    broken.push(images[0])
    with pytest.raises(ValueError, match="of mine"):
        broken.close()
    with pytest.raises(ValueError, match="of mine"):
        broken.push(images[1])
    with pytest.raises(sfmapp.NoReconstructionError, match="0 frames"):
        sfmapp.LiveOdometry(PINHOLE).close()
    with pytest.raises(sfmapp.UsageError):
        sfmapp.LiveOdometry(PINHOLE, Path(__file__).parent)


def test_a_stop_is_how_a_live_run_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = [images[0] for images in room(30).images]

    tracked = [0]

    class Walking(FakeCapture):
        """The walk through the room, as quickly as it is tracked, so that nothing is dropped."""

        def get(self, key: int) -> float:
            return {3: float(PINHOLE.width), 4: float(PINHOLE.height)}.get(key, 30.0)

        def grab(self) -> bool:
            while self.count > tracked[0]:
                threading.Event().wait(0.002)
            self.count += 1
            return self.count <= len(images)

        def retrieve(self) -> tuple[bool, np.ndarray]:
            return True, np.repeat(images[self.count - 1][..., None], 3, 2)

    def follow(event: Event) -> None:
        if event.stage == "odometry" and event.kind == "advanced":
            tracked[0] = event.done
            if event.done == 25:
                events.cancel()

    monkeypatch.setattr("cv2.VideoCapture", Walking)
    events = Events(follow)
    camera = f"sequence.camera=PINHOLE,{','.join(str(value) for value in PINHOLE.params)}"
    options = sfmapp.load_options(settings=[camera])
    _, report = sfmapp.track_sequence("camera:0", tmp_path / "out", options, record=False, events=events)
    assert report is not None
    assert report["outcome"]["exit_code"] == 0
    assert report["live"]["end"] == "stopped on request"
    assert (report["live"]["num_tracked"], report["live"]["num_dropped"]) == (25, 0)
    assert (tmp_path / "out" / "sparse" / "0").is_dir()


# ---------------------------------------------------------------------------------------------------- addresses


@pytest.mark.parametrize(
    ("address", "told"),
    [
        ("rtsp://admin:pa@ss@10.0.0.2:554/h264?channel=1", "rtsp://***@10.0.0.2:554/h264?channel=1"),
        ("http://cam/v.mjpg?token=abc&fps=5&Password=x#p", "http://cam/v.mjpg?token=***&fps=5&Password=***#p"),
        ("rtsp://cam/user=admin&password=x&channel=1?a=b", "rtsp://cam/user=***&password=***&channel=1?a=b"),
        ("rtsp://10.0.0.2/live", "rtsp://10.0.0.2/live"),
        ("/data/a@b/token=1", "/data/a@b/token=1"),
        ("camera:0", "camera:0"),
    ],
)
def test_passwords_are_not_told(address: str, told: str) -> None:
    assert without_credentials(address) == told


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("rtsp://u:secret@", "with a host"),
        ("rtsp://u:secret@cam:99999/", "Port out of range"),
        ("rtsp://u:secret@cam/a b", "without blanks"),
        ("rtsp://u:secret@cam/\r\nHost:", "control characters"),
        ("rtsp://u:secret@cam/" + "x" * 3000, "at most 2048"),
    ],
)
def test_addresses_that_cannot_be_are_refused_without_telling_secrets(address: str, said: str) -> None:
    with pytest.raises(sfmapp.InputError, match=said) as caught:
        opened(address, Events())
    assert "secret" not in str(caught.value)


def test_what_is_written_of_a_stream_holds_no_password(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["odometry", "rtsp://u:secret@127.0.0.1:9/", "-o", str(tmp_path / "out"), "-v"]
    assert main([*arguments, "--camera", "PINHOLE,50,50,30,20"]) == 3
    assert "secret" not in "".join(capsys.readouterr())
    written = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert written
    assert not any(b"secret" in text for text in written)
