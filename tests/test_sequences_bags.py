"""Bags of ROS 1 and 2 and MCAP files as sequences: what rosbags and mcap write is read back, whole and broken."""

from __future__ import annotations

import itertools
import json
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bag_writers import (
    FORMATS,
    Maker,
    Sent,
    camera_info,
    compressed,
    image,
    imu,
    store,
    transform,
    write_bag,
)
from odometry_sequences import room
from sfmapp.camera.camera import project
from sfmapp.cli.main import main
from sfmapp.errors import InputError, SfmError, UsageError
from sfmapp.events import Event, Events
from sfmapp.formats.ros_messages import (
    Message,
    MessageError,
    read_camera_info,
    read_compressed_image,
    read_imu_sample,
    read_raw_image,
    read_transforms,
)
from sfmapp.geometry import rigid3
from sfmapp.images.bag_sequence import decode_raw
from sfmapp.images.headers import UnusableImage
from sfmapp.images.sequence import Frame
from sfmapp.sequences.open import MissingCameraError, SequenceOptions, open_sequence

SIZE = (64, 48)
K = (50.0, 50.0, 31.5, 23.5)
PINHOLE = "PINHOLE,50,50,32,24"
START_NS = 1_700_000_000_123_456_789
STEP_NS = 50_000_001


def noise(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, size[::-1], np.uint8)


def stamps(count: int) -> list[int]:
    return [START_NS + STEP_NS * i for i in range(count)]


def mono(count: int = 4, topic: str = "/cam0/image_raw", seed: int = 0) -> list[Sent]:
    return [image(noise(100 * seed + i), "mono8", ns, topic) for i, ns in enumerate(stamps(count))]


def stereo(count: int = 4) -> list[Sent]:
    return [
        *mono(count), *mono(count, "/cam1/image_raw", 1),
        camera_info(SIZE, K, log_ns=START_NS),
        camera_info(SIZE, K, 0.54, "/cam1/camera_info", log_ns=START_NS),
    ]  # fmt: skip


class Told(list[Event]):
    def __init__(self) -> None:
        super().__init__()
        self.events = Events(self.append)

    def of(self, kind: str) -> str:
        return "\n".join(event.message for event in self if event.kind == kind)


@pytest.fixture
def told() -> Told:
    return Told()


# ---------------------------------------------------------------------------------------------------------- messages


@pytest.mark.parametrize("order", ["ros1", "little", "big"])
def test_messages_are_read_as_rosbags_writes_them(order: str) -> None:
    make = Maker(is_ros1=order == "ros1")

    def message(sent: Sent) -> Message:
        if order != "big":
            return Message(sent.topic, 0, make.bytes_of(sent), order != "ros1")
        made = make(sent.type, **make._nested(sent.fields))
        return Message(sent.topic, 0, bytes(store(False).serialize_cdr(made, sent.type, little_endian=False)), True)

    pixels = noise(3)
    raw = read_raw_image(message(image(pixels, "mono8", START_NS, frame_id="left/optical")))
    assert raw.stamp == (START_NS, "left/optical")
    assert (raw.width, raw.height, raw.encoding, raw.step) == (64, 48, "mono8", 68)
    np.testing.assert_array_equal(np.frombuffer(raw.data, np.uint8).reshape(48, 68)[:, :64], pixels)
    small = read_compressed_image(message(compressed(b"\xff\xd8 not a picture", "jpeg", START_NS)))
    assert (bytes(small.data), small.format) == (b"\xff\xd8 not a picture", "jpeg")
    turn = rigid3.rotation_matrix(rigid3.quaternion(rigid3.exp_so3(np.array([0.1, -0.2, 0.3]))))
    # a model whose name has an odd length, so that CDR has to align
    info = read_camera_info(message(camera_info(SIZE, K, 0.1, d=[0.1, -0.2, 0, 0, 0.3], rotation=turn)))
    assert (info.width, info.height, info.distortion_model, info.d.tolist()) == (
        64,
        48,
        "plumb_bob",
        [0.1, -0.2, 0, 0, 0.3],
    )
    np.testing.assert_array_equal(info.k, [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
    np.testing.assert_array_equal(info.r, turn)
    assert info.p[0, 3] == -5
    sample = read_imu_sample(message(imu(START_NS, [1, 2, 3], [4, 5, 6])))
    assert sample.gyro is not None
    assert sample.accel is not None
    assert (sample.gyro.tolist(), sample.accel.tolist()) == ([1, 2, 3], [4, 5, 6])
    pose = np.array([0.5, -0.5, 0.5, 0.5, 1, 2, 3])
    (found,) = read_transforms(message(transform("base", "cam0", pose)))
    assert (found.parent, found.child, found.parent_from_child.tolist()) == ("base", "cam0", pose.tolist())


@settings(deadline=None, max_examples=150)
@given(st.booleans(), st.integers(0, 200), st.binary(max_size=6), st.integers(0, 4))
def test_damaged_messages_are_refused_or_read(is_ros1: bool, at: int, put: bytes, which: int) -> None:
    sent = [*mono(1), compressed(b"abc", "jpeg", 5), camera_info(SIZE, K), imu(5, [1, 2, 3], [4, 5, 6]),
            transform("a", "b", rigid3.IDENTITY)][which]  # fmt: skip
    whole = Maker(is_ros1).bytes_of(sent)
    read = (read_raw_image, read_compressed_image, read_camera_info, read_imu_sample, read_transforms)[which]
    for data in (whole[:at] + put + whole[at + len(put) :], whole[:at]):
        with suppress(MessageError, UnusableImage):
            found = read(Message("/t", 0, data, not is_ros1))
            if which == 0:
                decode_raw(found, 255)


def test_headers_that_claim_gigabytes_take_no_memory() -> None:
    whole = bytearray(Maker(is_ros1=True).bytes_of(mono(1)[0]))
    place = whole.index((48).to_bytes(4, "little") + (64).to_bytes(4, "little"))
    whole[place : place + 8] = b"\xff\xff\xff\x7f" * 2
    with pytest.raises(UnusableImage, match="2147483647x2147483647"):
        decode_raw(read_raw_image(Message("/t", 0, bytes(whole), False)), 255)
    whole[-48 * 68 - 4 : -48 * 68] = b"\xff\xff\xff\xff"
    with pytest.raises(MessageError, match="4294967"):
        read_raw_image(Message("/t", 0, bytes(whole), False))


# ------------------------------------------------------------------------------------------------------------ pixels


def decoded(pixels: np.ndarray, encoding: str, is_big_endian: bool = False, white: int = 255) -> np.ndarray:
    sent = image(pixels, encoding, 5, is_big_endian=is_big_endian)
    raw = read_raw_image(Message("/t", 0, Maker(is_ros1=False).bytes_of(sent), True))
    return decode_raw(raw, white)[0]


def test_colours_are_made_grey_as_opencv_does() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    alpha = np.full((48, 64, 1), 7, np.uint8)
    for encoding, pixels in (
        ("rgb8", rgb), ("bgr8", rgb[..., ::-1]), ("8UC3", rgb[..., ::-1]), ("rgba8", np.concatenate([rgb, alpha], 2)),
        ("bgra8", np.concatenate([rgb[..., ::-1], alpha], 2)),
    ):  # fmt: skip
        np.testing.assert_array_equal(decoded(pixels, encoding), gray, encoding)
    wide = rgb.astype(np.uint16) * 257
    assert np.abs(decoded(wide, "rgb16").astype(int) - gray).max() <= 1


@pytest.mark.parametrize("is_big_endian", [False, True])
def test_deep_images_are_scaled_by_the_bits_that_they_use(is_big_endian: bool) -> None:
    deep = np.random.default_rng(1).integers(0, 4096, (48, 64)).astype(np.uint16)
    deep[0, 0] = 4095
    for encoding in ("mono16", "16UC1"):
        found = decoded(deep, encoding, is_big_endian)
        assert np.abs(found - deep * (255 / 4095)).max() <= 0.5


def test_luminance_of_yuv_is_taken_as_it_is() -> None:
    y = noise(1)
    other = np.full_like(y, 128)
    np.testing.assert_array_equal(decoded(np.stack([y, other], 2), "yuv422_yuy2"), y)
    np.testing.assert_array_equal(decoded(np.stack([other, y], 2), "yuv422"), y)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_show_the_colour_that_lies_below_them(pattern: str) -> None:
    # one colour all over: every pixel of its mosaic has that channel of it, and grey is 0.299 R + 0.587 G + 0.114 B
    color = {"r": 200, "g": 90, "b": 30}
    tile = np.array([[color[pattern[0]], color[pattern[1]]], [color[pattern[2]], color[pattern[3]]]], np.uint8)
    expected = 0.299 * 200 + 0.587 * 90 + 0.114 * 30
    mosaic = np.tile(tile, (24, 32))
    assert np.abs(decoded(mosaic, f"bayer_{pattern}8")[2:-2, 2:-2] - expected).max() <= 1
    deep = decoded(mosaic.astype(np.uint16) * 257, f"bayer_{pattern}16", white=65535)
    assert np.abs(deep[2:-2, 2:-2] - expected).max() <= 1


def test_encodings_that_are_not_read_are_named() -> None:
    with pytest.raises(UnusableImage, match="'32FC1'"):
        decoded(np.zeros((48, 64), np.float32), "32FC1")


# --------------------------------------------------------------------------------------------------------- sequences


@pytest.mark.parametrize("kind", FORMATS)
def test_a_stereo_bag_is_what_its_frames_in_a_folder_are(kind: str, tmp_path: Path, told: Told) -> None:
    bag = open_sequence(write_bag(tmp_path, kind, stereo(6)), SequenceOptions(), told.events)
    for name in ("cam0", "cam1"):
        (tmp_path / "mav0" / name / "data").mkdir(parents=True)
    for i, ns in enumerate(stamps(6)):
        assert cv2.imwrite(str(tmp_path / "mav0" / "cam0" / "data" / f"{ns}.png"), noise(i))
        assert cv2.imwrite(str(tmp_path / "mav0" / "cam1" / "data" / f"{ns}.png"), noise(100 + i))
    (tmp_path / "calib.json").write_text(
        '{"fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "baseline": 0.54}'
    )
    folder = open_sequence(tmp_path / "mav0", SequenceOptions(camera=str(tmp_path / "calib.json")), Events())
    assert (bag.kind, bag.num_frames, bag.frames_per_second) == ("bag", 6, folder.frames_per_second)
    np.testing.assert_allclose(bag.rig.cam_from_rig, folder.rig.cam_from_rig, rtol=0, atol=1e-15)
    for ours, theirs in zip(bag.rig.cameras, folder.rig.cameras, strict=True):
        np.testing.assert_array_equal(ours.params, theirs.params)
    for _ in range(2):  # as often as one likes
        for ours, theirs in itertools.zip_longest(bag.frames(), folder.frames()):
            assert (ours.timestamp_s, ours.elapsed_s, ours.idx) == (theirs.timestamp_s, theirs.elapsed_s, theirs.idx)
            assert len(ours.images) == len(theirs.images) == 2
            np.testing.assert_array_equal(ours.images, theirs.images)
    assert not told.of("warned")
    assert "images of /cam0/image_raw and /cam1/image_raw" in told.of("decided")


def test_parts_of_a_bag_are_those_of_the_whole(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", stereo(9))
    whole = list(open_sequence(path, SequenceOptions(), Events()).frames())
    part = list(open_sequence(path, SequenceOptions(start=1, stop=8, step=3), Events()).frames())
    assert [frame.name for frame in part] == ["000001", "000004", "000007"]
    for frame, same in zip(part, whole[1:8:3], strict=True):
        np.testing.assert_array_equal(frame.images, same.images)
        assert frame.timestamp_s == same.timestamp_s
    alone = open_sequence(path, SequenceOptions(mono=True), Events())
    assert len(alone.rig.cameras) == len(next(alone.frames()).images) == 1
    with pytest.raises(UsageError, match="reverse"):
        open_sequence(path, SequenceOptions(reverse=True), Events())


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_compressed_images_are_those_of_their_files(ending: str, tmp_path: Path) -> None:
    files = [cv2.imencode(f".{ending}", noise(i))[1].tobytes() for i in range(3)]
    sent = [compressed(file, f"mono8; {ending} compressed", ns) for file, ns in zip(files, stamps(3), strict=True)]
    path = write_bag(tmp_path, "ros1", [*sent, camera_info(SIZE, K, topic="/cam0/image_raw/camera_info")])
    frames = list(open_sequence(path, SequenceOptions(), Events()).frames())
    for frame, file in zip(frames, files, strict=True):
        np.testing.assert_array_equal(
            frame.images[0], cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
        )


def test_of_one_camera_the_raw_images_are_taken_and_depths_are_left(tmp_path: Path, told: Told) -> None:
    file = cv2.imencode(".png", noise(5))[1].tobytes()
    depths = [image(noise(7).astype(np.uint16), "16UC1", ns, "/cam0/aligned") for ns in stamps(3)]
    sent = [
        *mono(3), *mono(3, "/cam0/image_rect", 4), *(compressed(file, "png", ns) for ns in stamps(3)), *depths,
        camera_info(SIZE, K),
    ]  # fmt: skip
    path = write_bag(tmp_path, "ros2-sqlite3", sent)
    sequence = open_sequence(path, SequenceOptions(), told.events)
    np.testing.assert_array_equal(next(sequence.frames()).images[0], noise(0))
    assert "not /cam0/aligned" in told.of("decided")
    named = open_sequence(path, SequenceOptions(image_topic="/cam0/aligned"), Events())
    assert next(named.frames()).images[0].shape == (48, 64)


def test_several_cameras_have_to_be_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", [*mono(3), *mono(3, "/cam1/image_raw", 1), *mono(3, "/cam2/image_raw", 2)])
    with pytest.raises(InputError, match=r"found 3 cameras.*/cam0/image_raw \(64x48\)") as caught:
        open_sequence(path, SequenceOptions(camera=PINHOLE), Events())
    assert "--image-topic /cam0/image_raw,/cam1/image_raw" in (caught.value.advice or "")
    named = open_sequence(path, SequenceOptions(camera=PINHOLE, image_topic="/cam2/image_raw"), Events())
    np.testing.assert_array_equal(next(named.frames()).images[0], noise(200))
    with pytest.raises(InputError, match="found '/cam9'"):
        open_sequence(path, SequenceOptions(camera=PINHOLE, image_topic="/cam9"), Events())
    (tmp_path / "rig.json").write_text(
        '{"fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "baseline": 0.3}'
    )
    options = SequenceOptions(camera=str(tmp_path / "rig.json"), image_topic="/cam2/image_raw,/cam1/image_raw")
    pair = open_sequence(path, options, Events())
    np.testing.assert_array_equal(next(pair.frames()).images, [noise(200), noise(100)])
    assert pair.rig.cam_from_rig[1, 4] == -0.3


def test_a_raw_pair_is_turned_as_its_rectification_says(tmp_path: Path) -> None:
    left, right = (rigid3.exp_so3(np.array(w)) for w in ([0.01, 0.02, -0.01], [-0.02, 0.01, 0.03]))
    left, right = (m if m.shape == (3, 3) else rigid3.rotation_matrix(m) for m in (left, right))
    other = (52.0, 51.0, 30.0, 25.0)
    sent = [
        *mono(3), *mono(3, "/cam1/image_raw", 1),
        camera_info(SIZE, K, rotation=left, rectified=(45, 45, 32, 24), log_ns=START_NS),
        camera_info(SIZE, other, 0.2, "/cam1/camera_info", rotation=right, rectified=(45, 45, 32, 24), log_ns=START_NS),
    ]  # fmt: skip
    rig = open_sequence(write_bag(tmp_path, "ros1", sent), SequenceOptions(), Events()).rig
    points = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 8], (20, 3))
    # rectified points differ by the baseline alone
    ours = rigid3.apply(rig.cam_from_rig[1], points)
    np.testing.assert_allclose(ours @ right.T, points @ left.T - [0.2, 0, 0], atol=1e-12)
    pixels = project(rig.cameras[1], ours)
    expected, _ = cv2.projectPoints(
        ours, np.zeros(3), np.zeros(3), np.array([[52, 0, 30], [0, 51, 25], [0, 0, 1.0]]), None
    )
    np.testing.assert_allclose(pixels, expected[:, 0] + 0.5, atol=1e-9)


def test_rectified_images_have_the_camera_of_p(tmp_path: Path) -> None:
    info = camera_info(SIZE, K, d=[-0.3, 0.1, 0, 0, 0], rectified=(45, 45, 30, 20), topic="/cam0/camera_info")
    path = write_bag(tmp_path, "mcap", [*mono(3, "/cam0/image_rect"), info])
    camera = open_sequence(path, SequenceOptions(), Events()).rig.cameras[0]
    np.testing.assert_allclose(camera.params, [45, 45, 30.5, 20.5])


def test_a_camera_without_calibration_is_asked_for(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", [*mono(3), camera_info(SIZE, (0, 0, 0, 0))])
    with pytest.raises(MissingCameraError):
        open_sequence(path, SequenceOptions(), Events())
    assert open_sequence(path, SequenceOptions(camera=PINHOLE), Events()).num_frames == 3


# ------------------------------------------------------------------------------------------------------------- clocks


def test_without_stamps_the_times_of_the_recording_are_used(tmp_path: Path, told: Told) -> None:
    sent = [image(noise(i), "mono8", 0, log_ns=ns) for i, ns in enumerate(stamps(4))]
    sequence = open_sequence(write_bag(tmp_path, "ros1", sent), SequenceOptions(camera=PINHOLE), told.events)
    assert [frame.timestamp_s for frame in sequence.frames()] == [ns / 1e9 for ns in stamps(4)]
    assert "the headers of /cam0/image_raw hold no times" in told.of("decided")


def test_stamps_go_before_the_times_of_the_recording(tmp_path: Path) -> None:
    late = [3, 80, 1, 30]  # milliseconds on the way
    sent = [
        image(noise(i), "mono8", ns, log_ns=ns + ms * 10**6)
        for i, (ns, ms) in enumerate(zip(stamps(4), late, strict=True))
    ]
    sequence = open_sequence(write_bag(tmp_path, "mcap", sent), SequenceOptions(camera=PINHOLE), Events())
    # the second arrived after the third: one of the two is left out, and no time runs back
    found = [frame.timestamp_s for frame in sequence.frames()]
    times = [ns / 10**9 for ns in stamps(4)]
    assert found in ([times[0], times[1], times[3]], [times[0], times[2], times[3]])


def test_pairs_are_of_one_moment(tmp_path: Path, told: Told) -> None:
    sent = [one for one in stereo(6) if not (one.topic == "/cam1/image_raw" and one.log_ns == stamps(6)[2])]
    sequence = open_sequence(write_bag(tmp_path, "ros1", sent), SequenceOptions(), told.events)
    frames = list(sequence.frames())
    assert [len(frame.images) for frame in frames] == [2, 2, 1, 2, 2, 2]
    np.testing.assert_array_equal(frames[3].images[1], noise(103))
    assert "1 images of /cam0/image_raw have no partner of the same time in /cam1/image_raw: 000002" in told.of(
        "warned"
    )
    apart = [*mono(3), camera_info(SIZE, K), camera_info(SIZE, K, 0.5, "/cam1/camera_info")]
    apart += [image(noise(i), "mono8", ns + 20_000_000, "/cam1/image_raw") for i, ns in enumerate(stamps(3))]
    told = Told()
    sequence = open_sequence(write_bag(tmp_path / "apart", "ros1", apart), SequenceOptions(), told.events)
    assert not sequence.rig.is_stereo
    assert "/cam1/image_raw is not used" in told.of("warned")


# --------------------------------------------------------------------------------------------------------------- IMU


def with_imu(*transforms: Sent) -> list[Sent]:
    samples = [imu(START_NS - 10**7 + 5 * 10**6 * i, [i, 2, 3], [0, 9.81, 0.1]) for i in range(60)]
    return [*mono(4), camera_info(SIZE, K, log_ns=START_NS), *samples, *transforms]


@pytest.mark.parametrize("kind", ["ros1", "ros2-sqlite3"])
def test_an_imu_is_placed_by_static_transforms(kind: str, tmp_path: Path, told: Told) -> None:
    rng = np.random.default_rng(0)
    poses = [
        np.concatenate([q / np.linalg.norm(q), t])
        for q, t in zip(rng.normal(size=(3, 4)), rng.normal(size=(3, 3)), strict=True)
    ]
    base_from_mast, mast_from_cam, base_from_imu = poses
    path = write_bag(
        tmp_path, kind,
        with_imu(
            transform("base", "mast", base_from_mast), transform("mast", "cam0", mast_from_cam, 2),
            transform("base", "imu", base_from_imu, 3),
        ),
    )  # fmt: skip
    sequence = open_sequence(path, SequenceOptions(), told.events)
    assert sequence.imu is not None
    point = np.array([0.3, -0.2, 4.0])
    in_base = rigid3.apply(base_from_mast, rigid3.apply(mast_from_cam, point))
    np.testing.assert_allclose(
        rigid3.apply(sequence.imu.imu_from_cam, point), rigid3.apply(rigid3.inverse(base_from_imu), in_base), atol=1e-12
    )
    assert sequence.imu.gyro[:, 0].tolist() == list(range(60))
    assert sequence.imu.elapsed_s is not None
    assert sequence.imu.elapsed_s[:2].tolist() == [-0.01, -0.005]
    assert sequence.imu.timestamps_s[0] == (START_NS - 10**7) / 10**9
    assert not told.of("warned")


def test_an_imu_that_nothing_places_is_left_out_unless_the_user_says_where(tmp_path: Path, told: Told) -> None:
    path = write_bag(tmp_path, "mcap", with_imu(transform("base", "cam0", rigid3.IDENTITY)))
    assert open_sequence(path, SequenceOptions(), told.events).imu is None
    assert "no /tf_static says where it is" in told.of("warned")
    (tmp_path / "camchain.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [50, 50, 31.5, 23.5]\n  distortion_model: none\n"
        "  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [64, 48]\n"
        "  T_cam_imu:\n  - [1, 0, 0, 0.1]\n  - [0, 1, 0, 0.2]\n  - [0, 0, 1, 0.3]\n  - [0, 0, 0, 1]\n"
    )
    sequence = open_sequence(path, SequenceOptions(camera=str(tmp_path / "camchain.yaml")), Events())
    assert sequence.imu is not None
    np.testing.assert_allclose(sequence.imu.imu_from_cam, [0, 0, 0, 1, -0.1, -0.2, -0.3], atol=1e-15)
    told = Told()
    assert open_sequence(path, SequenceOptions(fps=10), told.events).imu is None
    with pytest.raises(InputError, match="called /imu9, found /imu/data"):
        open_sequence(path, SequenceOptions(imu_topic="/imu9"), Events())


def test_an_imu_in_other_units_is_left_out(tmp_path: Path, told: Told) -> None:
    samples = [imu(START_NS + 10**7 * i, [0, 0, 0.1], [0, 1.0, 0.02]) for i in range(20)]
    sent = [*mono(4), camera_info(SIZE, K, log_ns=START_NS), *samples, transform("imu", "cam0", rigid3.IDENTITY)]
    assert open_sequence(write_bag(tmp_path, "ros1", sent), SequenceOptions(), told.events).imu is None
    assert "accelerations are 1 m/s^2 in the median" in told.of("warned")


# ------------------------------------------------------------------------------------------------------------- damage


@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "drive.db3"])
@pytest.mark.parametrize("content", [b"", b"\0" * 300, b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"])
def test_what_is_no_bag_is_named(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        open_sequence(tmp_path / name, SequenceOptions(camera=PINHOLE), Events())


def test_a_bag_without_images_says_what_it_holds(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", [imu(5, [1, 2, 3], [4, 5, 6])])
    with pytest.raises(InputError, match=r"found /imu/data \(sensor_msgs/Imu\)"):
        open_sequence(path, SequenceOptions(), Events())
    with pytest.raises(InputError, match="found no messages"):
        open_sequence(write_bag(tmp_path / "empty", "mcap", []), SequenceOptions(), Events())


def data_file(path: Path) -> Path:
    return path if path.is_file() else next(file for file in path.iterdir() if file.suffix != ".yaml")


def frames_or_named(path: Path, told: Told) -> list[Frame]:
    """The frames of a bag; none where it is refused by its name."""
    failures: list[SfmError] = []
    try:
        return list(open_sequence(path, SequenceOptions(camera=PINHOLE), told.events).frames())
    except SfmError as error:
        failures.append(error)
    assert "drive" in str(failures[0])
    return []


@pytest.mark.parametrize("kind", FORMATS)
def test_bags_that_were_cut_off_are_named_or_played_as_far_as_they_go(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, kind, stereo(30))
    file = data_file(path)
    whole = file.read_bytes()
    played = []
    for share in (0.02, 0.5, 0.9, 0.999):
        file.write_bytes(whole[: int(share * len(whole))])
        told = Told()
        frames = frames_or_named(path, told)
        if frames:
            assert told.of("warned")
            np.testing.assert_array_equal(frames[0].images[0], noise(0))
            played.append(len(frames))
    if kind.startswith("mcap"):  # a recording whose power was cut is of use
        assert played == sorted(played)
        assert played[-1] >= 27


@pytest.mark.parametrize("kind", FORMATS)
def test_bytes_that_were_changed_never_end_in_anything_but_a_name(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, kind, stereo(3))
    file = data_file(path)
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(25):
        damaged = bytearray(whole)
        at = int(rng.integers(len(whole) - 8))
        damaged[at : at + 8] = rng.bytes(8)
        file.write_bytes(damaged)
        frames_or_named(path, Told())


def test_a_folder_whose_parts_are_missing_is_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros2-mcap", stereo(3))
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}\n")
    with pytest.raises(InputError, match="drive"):
        open_sequence(path, SequenceOptions(), Events())


def test_a_damaged_image_costs_one_frame(tmp_path: Path, told: Told) -> None:
    sent = [*mono(5), camera_info(SIZE, K)]
    sent[2] = image(noise(2, (32, 24)), "mono8", stamps(5)[2])
    sent[3] = image(np.zeros((48, 64), np.float32), "32FC1", stamps(5)[3])
    frames = list(open_sequence(write_bag(tmp_path, "mcap", sent), SequenceOptions(), told.events).frames())
    assert [frame.idx for frame in frames] == [0, 1, 4]
    assert "skipped 000002: 32x24 pixels, where the camera has 64x48" in told.of("warned")
    assert "skipped 000003: of the encoding '32FC1'" in told.of("warned")


def test_topics_are_of_bags(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    command = ["odometry", str(tmp_path), "-o", str(tmp_path / "out"), "--image-topic", "/cam0/image_raw"]
    assert main(command) == 2
    assert "topics are of bags" in capfd.readouterr().err


# ----------------------------------------------------------------------------------------------------------- odometry


def trajectories(bag: Path, folder: Path, output: Path, *options: str) -> tuple[str, str]:
    """What ``sfmapp odometry`` writes of a bag, and of its frames in a folder."""
    found = []
    for source in (bag, folder):
        command = ["odometry", str(source), "-o", str(output / source.name), "--no-recording", "-q", *options]
        assert main(command) == 0
        found.append((output / source.name / "trajectory.tum").read_text(encoding="utf-8"))
    return found[0], found[1]


def test_the_trajectory_of_a_bag_is_that_of_its_frames(tmp_path: Path) -> None:
    count, fps = 24, 30.0
    rendered = room(count)
    (tmp_path / "frames").mkdir()
    sent = []
    for idx, frame in enumerate(rendered.frames()):
        micros = round(1e6 * idx / fps)
        assert cv2.imwrite(str(tmp_path / "frames" / f"{micros / 1e6:.6f}.png"), frame.images[0])
        sent.append(image(frame.images[0], "mono8", 1000 * micros, log_ns=START_NS + 1000 * micros))
    info = camera_info((320, 240), (262.0, 262.0, 159.5, 119.5), log_ns=START_NS)
    path = write_bag(tmp_path, "ros2-sqlite3", [*sent, info])
    (tmp_path / "frames" / "calib.json").write_text(
        '{"fx": 262, "fy": 262, "cx": 159.5, "cy": 119.5, "width": 320, "height": 240}'
    )
    ours, theirs = trajectories(path, tmp_path / "frames", tmp_path / "out")
    assert len(ours.splitlines()) >= count - 4
    assert ours == theirs


@pytest.mark.real
@pytest.mark.parametrize("kind", ["ros1-lz4", "mcap"])
def test_the_trajectory_of_a_drive_in_a_bag_is_that_of_the_drive(kind: str, data_root: Path, tmp_path: Path) -> None:
    folder, count = data_root / "kitti00-200", 40
    known = json.loads((folder / "calib.json").read_text(encoding="utf-8"))
    k = [known[name] for name in ("fx", "fy", "cx", "cy")]
    sent = [camera_info((known["width"], known["height"]), k, log_ns=START_NS)]
    for i, ns in enumerate(stamps(count)):
        file = (folder / "image_0" / f"{i:06d}.jpg").read_bytes()
        pixels = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
        sent.append(compressed(file, "jpeg", ns) if kind == "mcap" else image(pixels, "mono8", ns))
    options = (f"--stop={count}", "--fps=10")
    ours, theirs = trajectories(write_bag(tmp_path, kind, sent), folder, tmp_path / "out", *options)
    assert len(ours.splitlines()) >= count
    assert ours == theirs
