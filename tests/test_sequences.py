"""Sequences of every layout, made up in small, whole and broken; and the real one."""

from __future__ import annotations

import gc
import itertools
import json
import struct
import threading
import zlib
from collections.abc import Sequence as Several
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfmapp.camera.camera import CameraModel, project
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Event, Events
from sfmapp.formats.trajectory import write_kitti, write_tum
from sfmapp.formats.trajectory_input import read_trajectory
from sfmapp.geometry import rigid3
from sfmapp.images.frame_reader import read_ahead
from sfmapp.images.sequence import Frame, Sequence
from sfmapp.sequences.files import ascending, confined, frame_numbers
from sfmapp.sequences.open import MissingCameraError, SequenceOptions, open_sequence

SIZE = (64, 48)
PINHOLE = "PINHOLE,50,50,32,24"


class Told(list[Event]):
    """What was told, and the Events object that tells it."""

    def __init__(self) -> None:
        super().__init__()
        self.events = Events(self.append)

    def of(self, kind: str) -> list[str]:
        return [event.message for event in self if event.kind == kind]


@pytest.fixture
def told() -> Told:
    return Told()


def noise(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, size[::-1], np.uint8)


def write_images(folder: Path, names: Several[str], seed: int = 0, size: tuple[int, int] = SIZE) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), noise(1000 * seed + i, size))


def numbered(count: int, ending: str = "png") -> list[str]:
    return [f"{i:06d}.{ending}" for i in range(count)]


def some_poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    quaternions = rigid3.quaternion(rigid3.exp_so3(rng.normal(size=(count, 3))))
    return np.concatenate([quaternions, rng.normal(size=(count, 3))], 1)


def assert_same_poses(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-6) -> None:
    difference = rigid3.compose(a, rigid3.inverse(b))
    np.testing.assert_allclose(
        rigid3.rotation_matrix(difference), np.broadcast_to(np.eye(3), (len(a), 3, 3)), atol=tolerance
    )
    np.testing.assert_allclose(difference[:, 4:], 0, atol=tolerance)


def assert_frames_ascend(frames: list[Frame], sequence: Sequence) -> None:
    assert all(a.timestamp_s < b.timestamp_s and a.idx < b.idx for a, b in itertools.pairwise(frames))
    for frame in frames:
        assert len(frame.images) == len(sequence.rig.cameras)
        for image, camera in zip(frame.images, sequence.rig.cameras, strict=True):
            assert image.dtype == np.uint8
            assert image.shape == (camera.height, camera.width)


# ------------------------------------------------------------------------------------------------------------- KITTI

P_GRAY = ["50 0 31.5 0 0 50 23.5 0 0 0 1 0", "50 0 31.5 -27 0 50 23.5 0 0 0 1 0"]
P_COLOR = ["50 0 31.5 3 0 50 23.5 0.5 0 0 1 0.01", "50 0 31.5 -24 0 50 23.5 0.5 0 0 1 0.01"]


def make_kitti(root: Path, folders: Several[str] = ("image_0", "image_1"), count: int = 6) -> tuple[Path, np.ndarray]:
    """The benchmark's tree, and cam_from_world (N, 7) of camera 0."""
    sequence = root / "sequences" / "07"
    for seed, name in enumerate(folders):
        write_images(sequence / name, numbered(count), seed)
    lines = "".join(f"P{i}: {numbers}\n" for i, numbers in enumerate(P_GRAY + P_COLOR))
    (sequence / "calib.txt").write_text(lines + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * i + 0.003 * (i % 2):e}\n" for i in range(count)))
    poses = some_poses(count)
    write_kitti(root / "poses" / "07.txt", poses)
    return sequence, rigid3.compose(poses, rigid3.inverse(poses[:1]))


def test_kitti_stereo_has_rig_times_and_ground_truth(tmp_path: Path, told: Told) -> None:
    folder, ground_truth = make_kitti(tmp_path)
    sequence = open_sequence(folder, SequenceOptions(), told.events)
    frames = list(sequence.frames())
    assert (sequence.kind, sequence.num_frames, len(frames)) == ("kitti", 6, 6)
    assert_frames_ascend(frames, sequence)
    assert frames[1].name == "image_0/000001.png"
    assert frames[1].timestamp_s == pytest.approx(0.103)
    np.testing.assert_array_equal(frames[2].images[1], noise(1002))
    camera = sequence.rig.cameras[0]
    assert camera.model == CameraModel.PINHOLE
    np.testing.assert_allclose(camera.params, [50, 50, 32, 24])
    # a point is seen further to the left by the right camera: the disparity is f b / z
    np.testing.assert_allclose(sequence.rig.cam_from_rig[1], [0, 0, 0, 1, -0.54, 0, 0])
    left, right = (project(camera, rigid3.apply(pose, [[0.3, 0.1, 5.0]])) for pose in sequence.rig.cam_from_rig)
    np.testing.assert_allclose(left - right, [[50 * 0.54 / 5, 0]])
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, [frame.timestamp_s for frame in frames])
    assert_same_poses(sequence.ground_truth.cam_from_world, ground_truth)
    assert not told.of("warned")


def test_kitti_colour_pair_stands_beside_camera_0(tmp_path: Path, told: Told) -> None:
    folder, ground_truth = make_kitti(tmp_path, ("image_2", "image_3"))
    sequence = open_sequence(folder, SequenceOptions(), told.events)
    np.testing.assert_allclose(sequence.rig.cam_from_rig[1, 4:], [-0.54, 0, 0], atol=1e-12)
    # P2 = K [I | t]: where camera 2 sees a point of the world, P2 has it
    matrix = np.array([float(v) for v in P_COLOR[0].split()]).reshape(3, 4)
    point = np.array([0.2, -0.1, 4.0])
    seen = matrix @ np.append(point, 1.0)
    assert sequence.ground_truth is not None
    in_camera_2 = rigid3.apply(
        rigid3.compose(sequence.ground_truth.cam_from_world, rigid3.inverse(ground_truth)), point
    )
    pixels = project(sequence.rig.cameras[0], in_camera_2)
    np.testing.assert_allclose(pixels, np.tile(seen[:2] / seen[2] + 0.5, (6, 1)), atol=1e-5)


def test_kitti_grey_is_taken_before_colour_and_mono_takes_one(tmp_path: Path, told: Told) -> None:
    folder, _ = make_kitti(tmp_path, ("image_0", "image_1", "image_2", "image_3"))
    sequence = open_sequence(folder, SequenceOptions(mono=True), told.events)
    assert not sequence.rig.is_stereo
    frame = next(iter(sequence.frames()))
    assert len(frame.images) == 1
    np.testing.assert_array_equal(frame.images[0], noise(0))
    right = open_sequence(folder / "image_1", SequenceOptions(), told.events)
    np.testing.assert_array_equal(next(iter(right.frames())).images[0], noise(1000))
    assert right.ground_truth is not None
    # the right camera's own poses
    assert sequence.ground_truth is not None
    expected = rigid3.compose([0, 0, 0, 1, -0.54, 0, 0], sequence.ground_truth.cam_from_world)
    assert_same_poses(right.ground_truth.cam_from_world, expected)


def test_kitti_frames_without_a_partner_are_left_out(tmp_path: Path, told: Told) -> None:
    folder, _ = make_kitti(tmp_path)
    (folder / "image_1" / "000003.png").unlink()
    (folder / "image_1" / "000004.png").write_bytes(b"not an image")
    sequence = open_sequence(folder, SequenceOptions(), told.events)
    frames = list(sequence.frames())
    assert [frame.name[-10:-4] for frame in frames] == ["000000", "000001", "000002", "000005"]
    # times and poses are found by number
    assert frames[-1].timestamp_s == pytest.approx(0.503)
    assert any("no partner" in text and "000003.png" in text for text in told.of("warned"))
    assert any("000004.png of camera 1" in text for text in told.of("warned"))


def test_calib_json_with_poses_beside(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path / "image_0", numbered(5, "jpg"))
    calibration = {"fx": 50.0, "fy": 51.0, "cx": 31.0, "cy": 23.0, "width": 64, "height": 48, "fps": 9.5}
    (tmp_path / "calib.json").write_text(json.dumps(calibration))
    write_kitti(tmp_path / "poses.txt", some_poses(5))
    sequence = open_sequence(str(tmp_path), SequenceOptions(), told.events)
    np.testing.assert_allclose(sequence.rig.cameras[0].params, [50, 51, 31.5, 23.5])
    assert sequence.frames_per_second == pytest.approx(9.5)
    assert sequence.ground_truth is not None
    assert len(sequence.ground_truth.timestamps_s) == 5
    assert open_sequence(tmp_path / "calib.json", SequenceOptions(), told.events).num_frames == 5


def test_every_second_file_taken_out_keeps_time_and_ground_truth(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path / "image_0", numbered(9))
    (tmp_path / "calib.json").write_text(json.dumps({"fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}))
    write_kitti(tmp_path / "poses.txt", some_poses(9))
    whole = open_sequence(tmp_path, SequenceOptions(), told.events)
    for i in range(1, 9, 2):
        (tmp_path / "image_0" / f"{i:06d}.png").unlink()
    half = open_sequence(tmp_path, SequenceOptions(), told.events)
    assert whole.ground_truth is not None
    assert half.ground_truth is not None
    np.testing.assert_allclose(half.ground_truth.timestamps_s, [0, 0.2, 0.4, 0.6, 0.8])
    assert_same_poses(half.ground_truth.cam_from_world, whole.ground_truth.cam_from_world[::2])


def test_ground_truth_that_does_not_fit_is_left_aside(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path / "image_0", numbered(5))
    write_kitti(tmp_path / "poses.txt", some_poses(3))
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    assert sequence.ground_truth is None
    assert any("poses.txt: expected a pose for each of 5 frames, found 3" in text for text in told.of("warned"))
    with pytest.raises(InputError, match="found 3"):
        open_sequence(tmp_path, SequenceOptions(camera=PINHOLE, ground_truth=str(tmp_path / "poses.txt")), told.events)


@given(st.integers(1, 30), st.integers(0, 2**31), st.booleans())
def test_kitti_poses_round_trip(tmp_path_factory: pytest.TempPathFactory, count: int, seed: int, gaps: bool) -> None:
    path = tmp_path_factory.mktemp("kitti") / "trajectory.kitti"
    poses = some_poses(count, seed)
    if gaps:
        poses[np.random.default_rng(seed).random(count) < 0.3] = np.nan
    write_kitti(path, poses)
    has_pose = np.isfinite(poses).all(1)
    assert path.with_name("trajectory.kitti.frames").exists() == (not has_pose.all())
    assert len(path.read_text().splitlines()) == has_pose.sum()
    if not has_pose.any():
        with pytest.raises(InputError, match="found no line of numbers"):
            read_trajectory(path)
        return
    read = read_trajectory(path).cam_from_world
    last = np.flatnonzero(has_pose)[-1] + 1
    np.testing.assert_array_equal(np.isfinite(read).all(1), has_pose[:last])
    first = poses[has_pose][0]
    assert_same_poses(read[has_pose[:last]], rigid3.compose(poses[has_pose], rigid3.inverse(first)), 1e-7)


def test_kitti_poses_of_frames_that_were_left_out(tmp_path: Path) -> None:
    path = tmp_path / "t.kitti"
    write_kitti(path, some_poses(3), [0, 2, 5])
    assert np.isfinite(read_trajectory(path).cam_from_world[:, 0]).tolist() == [True, False, True, False, False, True]
    write_kitti(path, some_poses(3))
    assert not (tmp_path / "t.kitti.frames").exists()
    # the first row of a trajectory is the identity, as the benchmark has it
    np.testing.assert_allclose([float(v) for v in path.read_text().split()[:12]], np.eye(4)[:3].ravel(), atol=1e-12)


@pytest.mark.parametrize(
    "text",
    ["1 2 3\n", "2 0 0 0 0 2 0 0 0 0 2 0", "1 0 0 0 0 1 0 0 0 0 -1 0", "1 0 0 0 0 1 0 0 0 0 1 1_0", "1 " + "a " * 11],
)
def test_kitti_poses_that_are_none_are_refused(tmp_path: Path, told: Told, text: str) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(InputError, match=r"poses\.txt:1"):
        read_trajectory(tmp_path / "poses.txt")
    write_images(tmp_path / "image_0", numbered(1))
    with pytest.raises(InputError, match=r"poses\.txt:1"):
        open_sequence(tmp_path, SequenceOptions(camera=PINHOLE, ground_truth=str(tmp_path / "poses.txt")), told.events)


@pytest.mark.parametrize(("digits", "is_read"), [(6, True), (3, True), (1, False)])
def test_rotations_of_few_digits_are_read_alike_for_odometry_and_for_evaluation(
    tmp_path: Path, told: Told, digits: int, is_read: bool
) -> None:
    """The benchmark's own files have six digits; people write three."""
    poses = some_poses(4, 3)
    matrices = np.concatenate([rigid3.rotation_matrix(poses), poses[:, 4:, None]], 2).reshape(-1, 12)
    path = tmp_path / "given.txt"
    path.write_text("".join(" ".join(f"{v:.{digits}f}" for v in row) + "\n" for row in matrices))
    write_images(tmp_path / "image_0", numbered(4))
    options = SequenceOptions(camera=PINHOLE, ground_truth=str(path))
    if not is_read:
        for read in (lambda: read_trajectory(path), lambda: open_sequence(tmp_path, options, told.events)):
            with pytest.raises(InputError, match="expected a rotation"):
                read()
        return
    found = open_sequence(tmp_path, options, told.events).ground_truth
    assert found is not None
    np.testing.assert_array_equal(found.cam_from_world, read_trajectory(path).cam_from_world)
    rotation = rigid3.rotation_matrix(found.cam_from_world)
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)
    assert_same_poses(found.cam_from_world, rigid3.inverse(poses), 3 * 10.0**-digits)


# --------------------------------------------------------------------------------------------------------------- TUM


def make_tum(folder: Path, count: int = 5) -> tuple[list[str], np.ndarray]:
    stamps = [f"{1305031102.175304 + i / 30:.6f}" for i in range(count)]
    write_images(folder / "rgb", [f"{stamp}.png" for stamp in stamps])
    rows = "".join(f"{stamp} rgb/{stamp}.png\n" for stamp in stamps)
    (folder / "rgb.txt").write_text("# color images\n# timestamp filename\n" + rows)
    poses = some_poses(count)
    write_tum(folder / "groundtruth.txt", [float(stamp) for stamp in stamps], poses)
    return stamps, poses


def test_tum_reads_list_and_ground_truth(tmp_path: Path, told: Told) -> None:
    stamps, poses = make_tum(tmp_path)
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    frames = list(sequence.frames())
    assert sequence.kind == "tum"
    assert [frame.timestamp_s for frame in frames] == [float(stamp) for stamp in stamps]
    assert sequence.ground_truth is not None
    assert_same_poses(sequence.ground_truth.cam_from_world, poses)
    for inside in ("rgb", "rgb.txt"):
        assert open_sequence(tmp_path / inside, SequenceOptions(camera=PINHOLE), told.events).num_frames == 5


def test_tum_without_a_list_takes_times_from_the_names(tmp_path: Path, told: Told) -> None:
    stamps, _ = make_tum(tmp_path)
    (tmp_path / "rgb.txt").unlink()
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    assert [frame.timestamp_s for frame in sequence.frames()] == [float(stamp) for stamp in stamps]


@pytest.mark.parametrize(
    "entry", ["../../etc/passwd.png", "/etc/passwd.png", "rgb/../../x.png", "C:\\x.png", "..\\x.png"]
)
def test_tum_list_may_not_point_elsewhere(tmp_path: Path, told: Told, entry: str) -> None:
    make_tum(tmp_path / "s")
    with open(tmp_path / "s" / "rgb.txt", "a") as file:
        file.write(f"1305031200.0 {entry}\n")
    with pytest.raises(InputError, match=r"rgb.txt:8: expected a file inside"):
        open_sequence(tmp_path / "s", SequenceOptions(camera=PINHOLE), told.events)


@given(st.text(max_size=30))
def test_confined_files_stay_inside(entry: str) -> None:
    root = Path("/data/sequence")
    try:
        path = confined(root, entry, "list")
    except InputError:
        return
    assert path.parts[: len(root.parts)] == root.parts
    assert ".." not in path.parts


def test_tum_names_files_that_are_missing(tmp_path: Path, told: Told) -> None:
    stamps, _ = make_tum(tmp_path)
    (tmp_path / "rgb" / f"{stamps[2]}.png").unlink()
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    assert sequence.num_frames == 4
    assert any(stamps[2] in text for text in told.of("warned"))


@pytest.mark.parametrize("text", ["x rgb/a.png", "1.5", "inf rgb/a.png", "1" * 5000 + " rgb/a.png"])
def test_tum_list_with_a_broken_line(tmp_path: Path, told: Told, text: str) -> None:
    make_tum(tmp_path)
    (tmp_path / "rgb.txt").write_text(text + "\n")
    with pytest.raises(InputError, match=r"rgb.txt:1: expected a time and a file name"):
        open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)


@pytest.mark.parametrize("name", ["rgbd_dataset_freiburg1_room", "fr1-room", "tum_fr1"])
def test_tum_freiburg1_has_the_published_lens(tmp_path: Path, told: Told, name: str) -> None:
    """A frame with a bright dot, drawn through the published lens, is where our camera has it."""
    folder = tmp_path / name
    (folder / "rgb").mkdir(parents=True)
    matrix = np.array([[517.306408, 0, 318.643040], [0, 516.469215, 255.313989], [0, 0, 1]])
    lens = np.array([0.262383, -0.953104, -0.005358, 0.002628, 1.163314])
    rays = np.array([[-0.5, -0.4, 1], [0.5, 0.35, 1], [0.0, 0.0, 1], [0.3, -0.35, 1], [-0.55, 0.4, 1], [0.1, 0.2, 1]])
    dots = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, lens)[0].reshape(-1, 2)
    y, x = np.mgrid[:480, :640]
    image = sum(200 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18) for u, v in dots)
    cv2.imwrite(str(folder / "rgb" / "1.000000.png"), np.round(image).astype(np.uint8))
    (folder / "rgb.txt").write_text("1.000000 rgb/1.000000.png\n")
    sequence = open_sequence(folder, SequenceOptions(), told.events)
    seen = next(iter(sequence.frames())).images[0].astype(float)
    for u, v in project(sequence.rig.cameras[0], rays):
        near = (np.abs(x + 0.5 - u) < 12) & (np.abs(y + 0.5 - v) < 12)
        weight = seen * near
        center = np.array([(weight * (x + 0.5)).sum(), (weight * (y + 0.5)).sum()]) / weight.sum()
        np.testing.assert_allclose(center, [u, v], atol=0.05)
    assert any("0.64 px rms" in text for text in told.of("decided"))


def test_tum_freiburg3_is_undistorted_and_a_file_beside_wins(tmp_path: Path, told: Told) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg3_office"
    write_images(folder / "rgb", ["1.5.png"], size=(640, 480))
    (folder / "rgb.txt").write_text("1.5 rgb/1.5.png\n")
    camera = open_sequence(folder, SequenceOptions(), told.events).rig.cameras[0]
    assert camera.model == CameraModel.PINHOLE
    np.testing.assert_allclose(camera.params, [535.4, 539.2, 320.6, 248.1])
    (folder / "camera.txt").write_text("500 501 319.5 239.5\n")
    camera = open_sequence(folder, SequenceOptions(), told.events).rig.cameras[0]
    np.testing.assert_allclose(camera.params, [500, 501, 320, 240])


# ------------------------------------------------------------------------------------------------------------- EuRoC

T_BS0 = rigid3.from_matrix(rigid3.exp_so3([0.1, -1.5, 0.3]), [-0.02, -0.06, 0.01])
T_BS1 = rigid3.from_matrix(rigid3.exp_so3([0.11, -1.49, 0.31]), [-0.02, 0.05, 0.01])
NANOSECONDS = [1403636579763555584 + 50_000_000 * i for i in range(6)]


def sensor_yaml(body_from_sensor: np.ndarray, text: str) -> str:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rigid3.rotation_matrix(body_from_sensor), body_from_sensor[4:]
    rows = ",\n         ".join(", ".join(map(repr, row)) for row in matrix.tolist())
    return f"#Default sensor yaml\ncomment: VI-Sensor: (MT9M034)\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n{text}"


def make_euroc(root: Path) -> np.ndarray:
    """The mav0 tree, and world_from_body (N, 7)."""
    for i, body_from_cam in enumerate((T_BS0, T_BS1)):
        camera = root / "mav0" / f"cam{i}"
        write_images(camera / "data", [f"{stamp}.png" for stamp in NANOSECONDS], i)
        rows = "".join(f"{stamp},{stamp}.png\r\n" for stamp in NANOSECONDS)
        (camera / "data.csv").write_text("#timestamp [ns],filename\r\n" + rows)
        intrinsics = (
            "rate_hz: 20\nresolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [45.8, 45.7, 31.0, 24.0] #fu, fv\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [-0.283, 0.0739, 0.00019, 1.76e-05]\n"
        )
        (camera / "sensor.yaml").write_text(sensor_yaml(body_from_cam, intrinsics))
    imu = root / "mav0" / "imu0"
    imu.mkdir()
    rows = "".join(f"{stamp},0.1,0.2,0.3,9.7,0.5,-0.25\n" for stamp in NANOSECONDS)
    (imu / "data.csv").write_text("#timestamp [ns],w_RS_S_x [rad s^-1],...\n" + rows)
    noise_text = (
        "rate_hz: 200\ngyroscope_noise_density: 1.6968e-04 # [ rad / s / sqrt(Hz) ]\n"
        "gyroscope_random_walk: 1.9393e-05\naccelerometer_noise_density: 2.0000e-3\naccelerometer_random_walk: 3.0e-3\n"
    )
    (imu / "sensor.yaml").write_text(sensor_yaml(rigid3.IDENTITY, noise_text))
    ground_truth = root / "mav0" / "state_groundtruth_estimate0"
    ground_truth.mkdir()
    poses = some_poses(6)
    rows = "".join(
        f"{stamp},{','.join(map(repr, [*p[4:], p[3], *p[:3]]))},0,0,0,0,0,0,0,0,0\n"
        for stamp, p in zip(NANOSECONDS, poses.tolist(), strict=True)
    )
    (ground_truth / "data.csv").write_text("#timestamp, p_RS_R_x [m], ...\n" + rows)
    return poses


def test_euroc_stereo_imu_and_ground_truth(tmp_path: Path, told: Told) -> None:
    world_from_body = make_euroc(tmp_path)
    sequence = open_sequence(tmp_path, SequenceOptions(), told.events)
    frames = list(sequence.frames())
    assert (sequence.kind, len(frames), len(sequence.rig.cameras)) == ("euroc", 6, 2)
    assert_frames_ascend(frames, sequence)
    assert sequence.frames_per_second == pytest.approx(20, rel=1e-4)
    np.testing.assert_array_equal(frames[3].images[1], noise(1003))
    np.testing.assert_allclose(
        sequence.rig.cameras[0].params, [45.8, 45.7, 31.5, 24.5, -0.283, 0.0739, 0.00019, 1.76e-05]
    )
    # a point in the body's frame, by way of either camera
    in_body = np.array([0.3, 2.0, -1.0])
    in_cams = [rigid3.apply(rigid3.inverse(pose), in_body) for pose in (T_BS0, T_BS1)]
    np.testing.assert_allclose(rigid3.apply(sequence.rig.cam_from_rig[1], in_cams[0]), in_cams[1], atol=1e-9)
    assert sequence.ground_truth is not None
    assert sequence.imu is not None
    in_world = rigid3.apply(world_from_body, in_body)
    np.testing.assert_allclose(
        rigid3.apply(sequence.ground_truth.cam_from_world, in_world), np.tile(in_cams[0], (6, 1)), atol=1e-9
    )
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, [frame.timestamp_s for frame in frames], atol=1e-6)
    np.testing.assert_allclose(rigid3.apply(sequence.imu.imu_from_cam, in_cams[0]), in_body, atol=1e-9)
    np.testing.assert_allclose(sequence.imu.accel[0], [9.7, 0.5, -0.25])
    assert (sequence.imu.gyro_noise, sequence.imu.gyro_walk) == (1.6968e-4, 1.9393e-5)
    assert not told.of("warned")
    assert open_sequence(tmp_path / "mav0", SequenceOptions(), told.events).num_frames == 6
    one = open_sequence(tmp_path / "mav0" / "cam1", SequenceOptions(), told.events)
    assert one.imu is not None
    assert not one.rig.is_stereo
    np.testing.assert_allclose(rigid3.apply(one.imu.imu_from_cam, in_cams[1]), in_body, atol=1e-9)


def test_euroc_tolerates_missing_partners_and_lists(tmp_path: Path, told: Told) -> None:
    make_euroc(tmp_path)
    lines = (tmp_path / "mav0/cam1/data.csv").read_text().splitlines(keepends=True)
    (tmp_path / "mav0/cam1/data.csv").write_text("".join(lines[:3] + lines[4:]))
    (tmp_path / f"mav0/cam0/data/{NANOSECONDS[5]}.png").unlink()
    sequence = open_sequence(tmp_path, SequenceOptions(), told.events)
    assert sequence.num_frames == 5
    assert [len(frame.images) for frame in sequence.frames()] == [2, 2, 1, 2, 2]
    assert any("no partner" in text and str(NANOSECONDS[2]) in text for text in told.of("warned"))
    assert any("not there" in text and str(NANOSECONDS[5]) in text for text in told.of("warned"))
    for camera in ("cam0", "cam1"):
        (tmp_path / "mav0" / camera / "data.csv").unlink()
    assert open_sequence(tmp_path, SequenceOptions(), told.events).num_frames == 5


def test_euroc_vicon_ground_truth_is_of_a_marker(tmp_path: Path, told: Told) -> None:
    poses = make_euroc(tmp_path)
    mav = tmp_path / "mav0"
    (mav / "state_groundtruth_estimate0").rename(mav / "vicon0")
    body_from_marker = rigid3.from_matrix(rigid3.exp_so3([0.0, 0.2, 0.0]), [0.0, 0.1, 0.2])
    (mav / "vicon0" / "sensor.yaml").write_text(sensor_yaml(body_from_marker, ""))
    sequence = open_sequence(tmp_path, SequenceOptions(), told.events)
    assert sequence.ground_truth is not None
    world_from_cam = rigid3.compose(rigid3.compose(poses, rigid3.inverse(body_from_marker)), T_BS0)
    assert_same_poses(sequence.ground_truth.cam_from_world, rigid3.inverse(world_from_cam))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cam0/data.csv", "1403636579763555584,a.png\nx,b.png\n", r"data.csv:2: expected a time and a file name"),
        ("cam0/data.csv", "1403636579763555584,../../a.png\n", r"data.csv:1: expected a file inside"),
        ("cam0/sensor.yaml", "T_BS: &a [1]\n", r"sensor.yaml:1: expected plain values"),
        ("cam0/sensor.yaml", "intrinsics: [1, 2]\n", r"sensor.yaml: intrinsics: expected fx, fy, cx, cy"),
        ("cam0/sensor.yaml", "comment: none\n", r"sensor.yaml: expected a calibration"),
        (
            "imu0/data.csv",
            "1403636579763555584,0,0,0,0,0\n1403636579763555585,0,0\n",
            r"data.csv:1: expected 7 numbers",
        ),
        ("imu0/sensor.yaml", "gyroscope_noise_density: much\n", r"gyroscope_noise_density: expected a number"),
    ],
)
def test_euroc_files_that_are_broken(tmp_path: Path, told: Told, name: str, text: str, message: str) -> None:
    make_euroc(tmp_path)
    (tmp_path / "mav0" / name).write_text(text)
    with pytest.raises(InputError, match=message):
        open_sequence(tmp_path, SequenceOptions(), told.events)


def test_imu_and_ground_truth_from_elsewhere(tmp_path: Path, told: Told) -> None:
    make_euroc(tmp_path / "euroc")
    mav = tmp_path / "euroc" / "mav0"
    write_images(tmp_path / "photos", [f"{stamp}.png" for stamp in NANOSECONDS])
    options = SequenceOptions(
        camera=str(mav / "cam0/sensor.yaml"), imu=str(mav / "imu0"),
        ground_truth=str(mav / "state_groundtruth_estimate0/data.csv"),
    )  # fmt: skip
    here = open_sequence(tmp_path / "photos", options, told.events)
    there = open_sequence(tmp_path / "euroc", SequenceOptions(), told.events)
    assert here.imu is not None
    assert there.imu is not None
    assert here.ground_truth is not None
    assert there.ground_truth is not None
    np.testing.assert_allclose(here.imu.imu_from_cam, there.imu.imu_from_cam)
    np.testing.assert_allclose(here.ground_truth.cam_from_world, there.ground_truth.cam_from_world)
    with pytest.raises(InputError, match="expected the pose of the IMU"):
        open_sequence(tmp_path / "photos", SequenceOptions(camera=PINHOLE, imu=str(mav / "imu0")), told.events)


# ------------------------------------------------------------------------------------------------------------ folders


def test_folder_in_natural_order_with_a_rate(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, [f"frame{i}.png" for i in (1, 2, 9, 10, 11)])
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE, fps=20), told.events)
    frames = list(sequence.frames())
    assert [frame.name for frame in frames] == ["frame1.png", "frame2.png", "frame9.png", "frame10.png", "frame11.png"]
    # frames 3 to 8 are missing, not the time
    np.testing.assert_allclose([frame.timestamp_s for frame in frames], [0, 0.05, 0.4, 0.45, 0.5])
    assert sequence.frames_per_second == pytest.approx(20)
    told.clear()
    open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    assert any("30 frames a second (assumed" in text for text in told.of("decided"))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["0.10.png", "0.25.png"], [0.10, 0.25]),
        (["1403636579763555584.png", "1403636579813555456.png"], [1403636579.763555584, 1403636579.813555456]),
        (["1403636579763555.png", "1403636579813555.png"], [1403636579.763555, 1403636579.813555]),
        (["1403636579763.png", "1403636579813.png"], [1403636579.763, 1403636579.813]),
        (["b.png", "a.png"], [0, 1 / 30]),
        (["x1y2.png", "x3y5.png"], [0, 1 / 30]),
    ],
)
def test_times_in_names(tmp_path: Path, told: Told, names: list[str], expected: list[float]) -> None:
    write_images(tmp_path, names)
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    np.testing.assert_allclose([frame.timestamp_s for frame in sequence.frames()], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("times.txt", "0.5\n0.75\n1.5\n"),
        ("timestamps.txt", "# time file\n1.5 000002.png\n0.5 000000.png\n0.75 000001.png\n"),
        ("times.txt", "000000 0.5 0.01\n000001 0.75 0.01\n000002 1.5 0.01\n"),
        ("data.csv", "#timestamp [ns],filename\n0.5,000000.png\n0.75,000001.png\n1.5,000002.png\n"),
        ("timestamps.txt", "1970-01-01 00:00:00.500000000\n1970-01-01 00:00:00.750\n1970-01-01 00:00:01.5\n"),
    ],
)
def test_times_in_a_list_beside(tmp_path: Path, told: Told, name: str, text: str) -> None:
    write_images(tmp_path / "images", numbered(3))
    (tmp_path / name).write_text(text)
    for source in (tmp_path, tmp_path / "images"):
        sequence = open_sequence(source, SequenceOptions(camera=PINHOLE), told.events)
        np.testing.assert_allclose([frame.timestamp_s for frame in sequence.frames()], [0.5, 0.75, 1.5])


@pytest.mark.parametrize(("text", "message"), [("0.5\n0.75\n", "found 2"), ("0.5\nsoon\n1.5\n", "times.txt:2")])
def test_times_that_do_not_fit_are_refused(tmp_path: Path, told: Told, text: str, message: str) -> None:
    write_images(tmp_path, numbered(3))
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)


@pytest.mark.parametrize("names", [("left", "right"), ("cam0", "cam1"), ("image_left", "image_right")])
def test_pair_of_folders(tmp_path: Path, told: Told, names: tuple[str, str]) -> None:
    for seed, name in enumerate(names):
        write_images(tmp_path / name, [f"{name}_{i}.png" for i in range(4)], seed)
    fields = {"fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
    (tmp_path / "calib.json").write_text(json.dumps(fields | {"baseline": 0.12}))
    sequence = open_sequence(tmp_path, SequenceOptions(), told.events)
    frames = list(sequence.frames())
    assert_frames_ascend(frames, sequence)
    np.testing.assert_array_equal(frames[1].images[1], noise(1001))
    np.testing.assert_allclose(sequence.rig.cam_from_rig[1], [0, 0, 0, 1, -0.12, 0, 0])
    (tmp_path / "calib.json").write_text(json.dumps(fields))
    mono = open_sequence(tmp_path, SequenceOptions(), told.events)
    assert not mono.rig.is_stereo
    assert len(next(iter(mono.frames())).images) == 1
    assert any("no calibration of the pair" in text for text in told.of("warned"))


def test_glob_and_list(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(4))
    options = SequenceOptions(camera=PINHOLE)
    assert open_sequence(str(tmp_path / "00000[0-2].png"), options, told.events).num_frames == 3
    (tmp_path / "list.txt").write_text("000003.png\n000001.png\n")
    assert open_sequence(tmp_path / "list.txt", options, told.events).num_frames == 2


def test_what_is_no_sequence_is_refused(tmp_path: Path, told: Told) -> None:
    (tmp_path / "empty").mkdir()
    write_images(tmp_path / "two" / "a", ["1.png"])
    write_images(tmp_path / "two" / "b", ["1.png"])
    (tmp_path / "notes.mp4").write_text("this is no video")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "a.png").write_bytes(b"")
    for source, message in [
        (tmp_path / "nowhere", "expected a sequence, found nothing"),
        (tmp_path / "empty", "found nothing"),
        (tmp_path / "two", "expected one sequence, found folders of images: a, b"),
        (tmp_path / "two" / "a" / "1.png", "found a single image"),
        (tmp_path / "notes.mp4", "expected a video"),
        (tmp_path / "broken", "a.png: empty"),
        ("a\0b", "no file can have"),
    ]:
        with pytest.raises(InputError, match=message):
            open_sequence(source, SequenceOptions(camera=PINHOLE), told.events)


# --------------------------------------------------------------------------------------------------- cameras, options


def test_without_a_camera_there_is_advice_or_a_guess(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(2))
    with pytest.raises(MissingCameraError, match="64x48") as failure:
        open_sequence(tmp_path, SequenceOptions(), told.events)
    assert "--self-calibrate" in (failure.value.advice or "")
    sequence = open_sequence(tmp_path, SequenceOptions(), told.events, require_camera=False)
    assert sequence.rig.cameras[0].focal_source == "default"
    assert len(list(sequence.frames())) == 2


def test_camera_given_replaces_what_is_there(tmp_path: Path, told: Told) -> None:
    folder, _ = make_kitti(tmp_path)
    options = SequenceOptions(camera="SIMPLE_RADIAL, 55, 32, 24, 0.01", mono=True)
    camera = open_sequence(folder, options, told.events).rig.cameras[0]
    assert (camera.model, camera.focal, camera.focal_source) == (CameraModel.SIMPLE_RADIAL, 55, "user")
    assert camera.focal_sigma == pytest.approx(0.55)


@pytest.mark.parametrize(
    ("camera", "error"),
    [
        ("PINHOLE,1,2,3", UsageError), ("PINHOLE,1,2,3,x", UsageError), ("LENS,1", UsageError),
        ("PINHOLE,-1,2,3,4", UsageError), ("PINHOLE,nan,2,3,4", UsageError), ("camera.yaml", InputError),
    ],
)  # fmt: skip
def test_cameras_that_cannot_be(tmp_path: Path, told: Told, camera: str, error: type[Exception]) -> None:
    write_images(tmp_path, numbered(2))
    with pytest.raises(error):
        open_sequence(tmp_path, SequenceOptions(camera=camera), told.events)


def test_odd_calibrations_are_told(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(2))
    open_sequence(tmp_path, SequenceOptions(camera="PINHOLE,0.8,1.1,0.5,0.5"), told.events)
    assert any("unlike that of any camera" in text for text in told.of("warned"))


@pytest.mark.parametrize(
    "options",
    [{"start": -1}, {"step": 0}, {"start": 5, "stop": 5}, {"fps": 0.0}, {"fps": float("nan")}, {"fps": float("inf")}],
)
def test_options_that_cannot_be(options: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        SequenceOptions(**options)  # type: ignore[arg-type]


def test_start_stop_step_and_reverse(tmp_path: Path, told: Told) -> None:
    make_euroc(tmp_path)
    forth = open_sequence(tmp_path, SequenceOptions(), told.events)
    back = open_sequence(tmp_path, SequenceOptions(reverse=True, mono=True), told.events)
    frames, backwards = list(forth.frames()), list(back.frames())
    assert_frames_ascend(backwards, back)
    assert [frame.name for frame in backwards] == [frame.name for frame in frames[::-1]]
    assert [frame.idx for frame in backwards] == list(range(6))
    assert forth.ground_truth is not None
    assert back.ground_truth is not None
    # the pose that belongs to a picture still does
    by_name = dict(zip([frame.name for frame in frames], forth.ground_truth.cam_from_world, strict=True))
    at = (
        np.interp([frame.timestamp_s for frame in backwards], back.ground_truth.timestamps_s, np.arange(6))
        .round()
        .astype(int)
    )
    expected = np.array([by_name[frame.name] for frame in backwards])
    assert_same_poses(back.ground_truth.cam_from_world[at], expected)
    assert forth.imu is not None
    assert back.imu is not None
    np.testing.assert_allclose(back.imu.gyro, -forth.imu.gyro[::-1])
    np.testing.assert_allclose(back.imu.accel, forth.imu.accel[::-1])
    some = open_sequence(tmp_path, SequenceOptions(start=1, stop=6, step=2), told.events)
    assert [frame.name for frame in some.frames()] == [frame.name for frame in frames[1:6:2]]
    with pytest.raises(InputError, match="found 6 in all"):
        open_sequence(tmp_path, SequenceOptions(start=6), told.events)


# ------------------------------------------------------------------------------------------------------ broken frames


def test_broken_frames_are_skipped_and_told_once(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(12))
    whole = (tmp_path / "000001.png").read_bytes()
    (tmp_path / "000001.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "000003.png").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "000005.png"), noise(5, (32, 24)))
    flipped = bytearray((tmp_path / "000007.png").read_bytes())
    flipped[len(flipped) // 2] ^= 0xFF
    (tmp_path / "000007.png").write_bytes(flipped)
    (tmp_path / "000009.png").unlink()
    (tmp_path / "000009.png").mkdir()
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    frames = list(sequence.frames())
    assert [frame.idx for frame in frames] == [0, 2, 4, 6, 8, 10, 11]
    warnings = told.of("warned")
    assert len(warnings) == 6
    for name, reason in [("01", "truncated"), ("03", "empty"), ("05", "32x24"), ("07", "checksum"), ("09", "regular")]:
        assert any(f"0000{name}.png" in text and reason in text for text in warnings)
    assert "5 of 12 frames could not be used" in warnings[-1]
    assert [frame.idx for frame in sequence.frames()] == [frame.idx for frame in frames]
    assert len(told.of("warned")) == 6


def test_a_thousand_broken_frames_do_not_make_a_thousand_lines(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(1))
    for name in numbered(100)[1:]:
        (tmp_path / name).write_bytes(b"\0" * 100)
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    assert len(list(sequence.frames())) == 1
    assert len(told.of("warned")) == 9
    assert len([event for event in told if event.kind == "warned"][-1].data["names"]) == 99


def test_absurd_sizes_are_not_decoded(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(3))
    # a picture that claims 60000 x 60000 pixels, with its checksum right
    data = bytearray((tmp_path / "000001.png").read_bytes())
    data[16:24] = struct.pack(">II", 60000, 60000)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    (tmp_path / "000001.png").write_bytes(data)
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    assert [frame.idx for frame in sequence.frames()] == [0, 2]
    assert any("60000x60000" in text for text in told.of("warned"))
    for name in numbered(3):
        (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match="it claims 60000x60000 pixels"):
        open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)


def test_repeated_frames_are_skipped_and_counted(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(8))
    for i in (3, 4):
        (tmp_path / f"{i:06d}.png").write_bytes((tmp_path / "000002.png").read_bytes())
    # the same pixels in other bytes; and the same as two before, which is no repetition
    cv2.imwrite(str(tmp_path / "000006.png"), noise(5), [cv2.IMWRITE_PNG_COMPRESSION, 0])
    (tmp_path / "000007.png").write_bytes((tmp_path / "000000.png").read_bytes())
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    assert [frame.idx for frame in sequence.frames()] == [0, 1, 2, 5, 7]
    assert len(told.of("warned")) == 1
    assert "3 of 8 frames repeat the one before them" in told.of("warned")[0]


def test_times_that_do_not_ascend(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(7))
    # one repeats, one is a year ahead, one goes back
    (tmp_path / "times.txt").write_text("0\n1\n1\n30000000\n2\n1.5\n3\n")
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    frames = list(sequence.frames())
    assert_frames_ascend(frames, sequence)
    assert len(frames) == 4
    assert (frames[0].timestamp_s, frames[-1].timestamp_s) == (0, 3)
    assert any("3 of 7 frames are skipped, whose times do not ascend" in text for text in told.of("warned"))


@given(st.lists(st.integers(0, 20), max_size=30))
def test_ascending_is_the_longest(values: list[int]) -> None:
    chosen = ascending(np.array(values, np.float64))
    assert (np.diff(np.array(values)[chosen]) > 0).all() if len(chosen) else not values
    longest: list[int] = []
    for i, value in enumerate(values):
        longest.append(1 + max((longest[k] for k in range(i) if values[k] < value), default=0))
    assert len(chosen) == max(longest, default=0)


def test_16_bits_keep_their_brightness_over_the_sequence(tmp_path: Path, told: Told) -> None:
    values = np.tile(np.arange(64, dtype=np.uint16) * 16, (48, 1))
    for i, scale in enumerate((1, 4, 1)):
        cv2.imwrite(str(tmp_path / f"{i}.png"), values * scale + np.uint16(i))
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    images = [frame.images[0] for frame in sequence.frames()]
    assert abs(int(images[0].max()) - 252) <= 1  # 10 bits, as far as one could know
    assert abs(int(images[1].max()) - 252) <= 1  # 12 bits
    assert abs(int(images[2].max()) - 63) <= 1  # the same light as in the first, now known to be of 12 bits


def test_grey_of_every_file_is_opencvs(tmp_path: Path, told: Told) -> None:
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    for name in ("0.png", "1.jpg", "2.tif", "3.bmp", "4.webp", "5.ppm"):
        cv2.imwrite(str(tmp_path / name), smooth + np.uint8(int(name[0])))
    alpha = np.dstack([smooth, rng.integers(0, 256, SIZE[::-1], np.uint8)])
    cv2.imwrite(str(tmp_path / "6.png"), alpha + np.uint8([6, 6, 6, 0]))
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    frames = list(sequence.frames())
    assert len(frames) == 7
    for frame in frames:
        expected = cv2.cvtColor(smooth + np.uint8(int(frame.name[0])), cv2.COLOR_BGR2GRAY).astype(int)
        assert np.abs(frame.images[0].astype(int) - expected).mean() < (3 if frame.name[0] in "14" else 1)


# --------------------------------------------------------------------------------------------------------- the thread


def frame_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("frames")]


def test_a_consumer_that_stops_early_leaves_no_thread(tmp_path: Path, told: Told) -> None:
    write_images(tmp_path, numbered(30))
    sequence = open_sequence(tmp_path, SequenceOptions(camera=PINHOLE), told.events)
    frames = sequence.frames()
    assert next(frames).idx == 0
    assert frame_threads()
    frames.close()  # type: ignore[attr-defined]
    assert not frame_threads()
    for frame in sequence.frames():
        if frame.idx == 3:
            break
    gc.collect()
    assert not frame_threads()

    def fail_at(frame: Frame) -> None:
        raise RuntimeError(f"consumer, at {frame.idx}")

    with pytest.raises(RuntimeError, match="consumer, at 0"):
        list(map(fail_at, sequence.frames()))
    gc.collect()
    assert not frame_threads()


def test_reading_ahead_is_bounded_in_order_and_passes_failures_on() -> None:
    made: list[int] = []

    def read_next() -> Frame | None:
        if len(made) == 20:
            raise OSError("disk")
        made.append(len(made))
        return Frame(made[-1], "", 0.0, ())

    reader = read_ahead(read_next)
    seen = []
    for item in itertools.islice(reader, 20):
        assert isinstance(item, Frame)
        seen.append(item.idx)
        assert len(made) <= len(seen) + 4
    assert seen == list(range(20))
    with pytest.raises(OSError, match="disk"):
        next(reader)
    assert not frame_threads()


# ------------------------------------------------------------------------------------------------------------- values


@given(st.lists(st.integers(0, 300), min_size=2, max_size=20, unique=True))
def test_numbers_of_frames(numbers: list[int]) -> None:
    numbers.sort()
    paths = [Path(f"cam2_take1_{number:04d}.jpg") for number in numbers]
    found = frame_numbers(paths)
    if numbers[-1] - numbers[0] > 100 * len(numbers):
        assert found is None
    else:
        assert found is not None
        np.testing.assert_array_equal(found, numbers)


# ---------------------------------------------------------------------------------------------------------- real data


def test_real_kitti(data_root: Path, told: Told) -> None:
    folder = data_root / "kitti00-200"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    sequence = open_sequence(folder, SequenceOptions(), told.events)
    assert (sequence.kind, sequence.num_frames) == ("kitti", 200)
    np.testing.assert_allclose(sequence.rig.cameras[0].params, [718.856, 718.856, 607.6928, 185.7157])
    assert sequence.ground_truth is not None
    centers = rigid3.center(sequence.ground_truth.cam_from_world)
    assert np.linalg.norm(np.diff(centers, axis=0), axis=1).sum() == pytest.approx(145, abs=3)
    frames = list(sequence.frames())
    assert len(frames) == 200
    assert_frames_ascend(frames, sequence)
    assert not told.of("warned")
