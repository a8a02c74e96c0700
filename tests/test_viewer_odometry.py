"""The live view: what the child is sent, what it draws, and that nothing it does disturbs the run."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from odometry_fakes import HEIGHT, WIDTH, FakeRunner, FakeSequence, path
from sfmapp.camera.camera import CameraModel, project, simple_camera
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.result import OdometryResult
from sfmapp.viewer import live as live_module
from sfmapp.viewer.live import LiveView, SendQueue, thinned_stride
from sfmapp.viewer.live_scene import POINT_BLOCK, LiveMap, frustum_lines, unbroken
from sfmapp.viewer.messages import read_message, write_message
from sfmapp.viewer.view import open_live_viewer, server_command, window_command

CAMERA = simple_camera(CameraModel.PINHOLE, WIDTH, HEIGHT, 120.0)


def keyframes_of(poses: np.ndarray, *frames: int, ids: object = (), xyz: object = (), complete: bool = False) -> dict:
    return {
        "keyframe_frame_idx": np.array(frames, np.int64),
        "keyframe_cam_from_world": poses[list(frames)],
        "point_id": np.array(ids, np.int64),
        "point_xyz": np.array(xyz, np.float32).reshape(-1, 3),
        "is_complete": complete,
    }


# ------------------------------------------------------------------------------------------------------------ messages


def test_messages_arrive_as_they_were_sent(tmp_path: Path) -> None:
    arrays = {
        "image": np.arange(12, dtype=np.uint8).reshape(3, 4), "none": np.zeros((0, 2), np.float32),
        "strided": np.arange(20.0)[::2], "text": "ü", "nothing": None,
    }  # fmt: skip
    with (tmp_path / "pipe").open("wb") as file:
        write_message(file.fileno(), arrays)
        write_message(file.fileno(), {"kind": "second"})
    stream = io.BytesIO((tmp_path / "pipe").read_bytes())
    first, second = read_message(stream.read), read_message(stream.read)
    assert first is not None
    assert set(first) == set(arrays)
    for name in ("image", "none", "strided"):
        assert first[name].dtype == arrays[name].dtype
        assert np.array_equal(first[name], arrays[name])
    assert (first["text"], first["nothing"], second) == ("ü", None, {"kind": "second"})
    assert read_message(stream.read) is None


def test_a_message_that_is_cut_off_is_the_end(tmp_path: Path) -> None:
    with (tmp_path / "pipe").open("wb") as file:
        write_message(file.fileno(), {"image": np.zeros(1000, np.uint8)})
    whole = (tmp_path / "pipe").read_bytes()
    for length in (0, 3, 8, 100, len(whole) - 1):
        assert read_message(io.BytesIO(whole[:length]).read) is None


def test_long_recordings_show_fewer_images() -> None:
    assert [thinned_stride(0, n) for n in (10, 1000, 1001, 2000, 10_000)] == [1, 1, 2, 2, 10]
    shown = sum(n % thinned_stride(n, None) == 0 for n in range(100_000))
    assert 2000 < shown < 5000


def test_a_child_that_does_not_read_is_not_waited_for() -> None:
    outbox = SendQueue([sys.executable, "-c", "import time; time.sleep(60)"])
    start = time.monotonic()
    image = np.zeros(1 << 20, np.uint8)
    for _ in range(400):
        outbox.put({"image": image})
    assert time.monotonic() - start < 5
    assert outbox.num_bytes <= live_module.MAX_BYTES
    assert "could not keep up" in outbox.close(20)


def test_a_child_that_dies_says_why() -> None:
    outbox = SendQueue([sys.executable, "-c", "raise SystemExit('no room left')"])
    outbox.put({"kind": "x"})
    assert outbox.close(20) == "exit code 1: no room left"


def test_a_child_falls_behind_first_without_images_then_without_points(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[dict] = []

    class Full:
        num_bytes = 0

        def put(self, message: dict) -> None:
            sent.append(message)

        def abandon(self) -> None: ...

    monkeypatch.setattr(live_module, "Outbox", lambda _: Full())
    with LiveView(Path("x.rrd"), None) as view:
        view.begin(FakeSequence())
        for waiting in (0, live_module.MAX_IMAGE_BYTES, live_module.MAX_POINT_BYTES):
            Full.num_bytes = waiting
            events = Events(view)
            sequence = FakeSequence(length=2, num_frames=2)
            FakeRunner()(sequence, OdometryOptions(), seed=0, threads=1, events=events)
    frames = [message for message in sent if message["kind"] == "frame"]
    assert [frame["image"] is not None for frame in frames] == [True, True, False, False, False, False]
    assert [frame["xy"] is not None for frame in frames] == [True, True, True, True, False, False]
    # what is decided at a frame is drawn with it
    kinds = [message["kind"] for message in sent]
    assert kinds[:4] == ["begin", "frame", "map", "log"]
    assert sent[2]["frame_idx"] == sent[1]["frame_idx"] == 0


# --------------------------------------------------------------------------------------------------------------- scene


def test_the_path_moves_with_the_keyframes() -> None:
    poses = path(20)
    scene = LiveMap(rigid3.IDENTITY)
    scene.change(keyframes_of(poses, 0))
    for k in range(10):
        if k == 5:
            scene.change(keyframes_of(poses, 5))
        scene.add_frame(k, k / 10, poses[k])
    assert np.allclose(scene.frame_poses(), poses[:10], atol=1e-9)
    # the second keyframe moves ten to the right: the frames on it do, those on the first stay
    moved = poses.copy()
    moved[5, 4] -= 10
    scene.change(keyframes_of(moved, 5))
    assert np.allclose(scene.frame_poses()[:5], poses[:5], atol=1e-9)
    shift = rigid3.apply(rigid3.inverse(moved[5]), [0, 0, 0]) - rigid3.center(poses[5])
    assert np.allclose(rigid3.center(scene.frame_poses()[5]) - rigid3.center(poses[5]), shift, atol=1e-9)
    assert scene.changed.frames == {0}


def test_a_new_unit_of_length_holds_for_the_path_as_well() -> None:
    poses = path(12)
    scene = LiveMap(rigid3.IDENTITY)
    for k in range(12):
        if k % 4 == 0:
            scene.change(keyframes_of(poses, k))
        scene.add_frame(k, k / 10, poses[k])
    scaled = poses.copy()
    scaled[:, 4:] *= 3
    scene.change(keyframes_of(scaled, 0, 4, 8, complete=True))
    assert np.allclose(scene.frame_poses(), scaled, atol=1e-9)


def test_a_joined_map_goes_on_in_the_other() -> None:
    poses = path(30)
    first, second = LiveMap(rigid3.IDENTITY), LiveMap(rigid3.IDENTITY)
    in_second = poses.copy()
    in_second[:, 4:] *= 0.2  # a unit of its own
    for k in range(30):
        scene, known = (first, poses) if k < 12 else (second, in_second)
        if k % 6 == 0:
            scene.change(keyframes_of(known, k))
        scene.add_frame(k, k / 10, known[k])
    first.change(keyframes_of(poses, *range(0, 30, 6), complete=True))
    first.absorb(second)
    assert np.allclose(first.frame_poses(), poses, atol=1e-9)
    assert first.frame_numbers.tolist() == list(range(30))


def test_points_are_kept_in_blocks_and_take_the_grey_of_their_keyframe() -> None:
    pose = path(1)[0]
    scene = LiveMap(rigid3.IDENTITY)
    rng = np.random.default_rng(0)
    ids = np.arange(POINT_BLOCK - 20, POINT_BLOCK + 20)
    xyz = rigid3.apply(rigid3.inverse(pose), rng.uniform([-2, -1, 4], [2, 1, 8], (40, 3)))
    scene.change(keyframes_of(path(1), 0, ids=ids, xyz=xyz))
    assert scene.changed.points == {0, 1}
    image = rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8)
    scene.colour(CAMERA, pose, image)
    shown, grey = scene.points(1)
    assert len(shown) == 20
    column, row = project(CAMERA, rigid3.apply(pose, shown.astype(np.float64))).astype(int).T
    inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    assert inside.sum() > 10
    assert np.array_equal(grey[inside], image[row[inside], column[inside]])


def test_lines_break_at_gaps() -> None:
    xyz = np.arange(21.0).reshape(7, 3)
    xyz[2] = np.nan
    lines = unbroken(xyz, np.array([0, 1, 2, 3, 4, 9, 10]))
    assert [len(line) for line in lines] == [2, 2, 2]


def test_the_ground_truth_is_laid_on_the_path_so_far() -> None:
    from sfmapp.evaluation.trajectory import Trajectory

    poses = path(40)
    scene = LiveMap(rigid3.IDENTITY)
    ground_truth_from_map = similarity.from_parts(
        rigid3.exp_so3(np.array([0.1, -0.4, 0.2])), np.array([3.0, 1, 2]), 2.5
    )
    ground_truth = Trajectory.from_cam_from_world(
        similarity.transform_poses(ground_truth_from_map, poses), np.arange(40) / 10
    )
    for k in range(30):
        scene.add_frame(k, k / 10, poses[k])
    found = scene.against(ground_truth, "sim3")
    assert found is not None
    assert np.allclose(similarity.apply(found[0], ground_truth.position[:30]), rigid3.center(poses[:30]), atol=1e-6)
    assert found[1] < 1e-6
    assert LiveMap(rigid3.IDENTITY).against(ground_truth, "sim3") is None


def test_a_frustum_ends_at_the_corners_of_the_image() -> None:
    poses = path(3)
    lines = frustum_lines(CAMERA, poses, 0.5)
    assert lines.shape == (3, 11, 3)
    for line, pose in zip(lines.astype(np.float64), poses, strict=True):
        in_cam = rigid3.apply(pose, line)
        ahead = in_cam[in_cam[:, 2] > 0.1]
        assert np.allclose(ahead[:, 2], 0.5, atol=1e-5)
        corners = {tuple(xy) for xy in project(CAMERA, ahead).round().astype(int).tolist()}
        assert corners == {(0, 0), (WIDTH, 0), (WIDTH, HEIGHT), (0, HEIGHT)}


# ----------------------------------------------------------------------------------------------------------- recording


def record(path: Path, runner: FakeRunner, sequence: FakeSequence) -> tuple[OdometryResult, str]:
    with LiveView(path, None) as view:
        view.begin(sequence)
        result = runner(sequence, OdometryOptions(), seed=0, threads=1, events=Events(view))
        errors = np.full(len(result.frame_idx), 0.1)
        problem = view.end(result, [np.append(rigid3.IDENTITY, 2.0)] * len(result.maps), errors)
    return result, problem


def rows_of(recording: Path) -> dict[str, int]:
    """Number of rows by entity, as rerun's own tool tells."""
    done = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "print", "-v", str(recording)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    rows: dict[str, int] = {}
    for line in done.stdout.splitlines():
        if " with " in line and " rows " in line:
            count = int(line.partition(" with ")[2].split()[0])
            name = next((word for word in line.split() if word.startswith("/")), "")
            rows[name] = rows.get(name, 0) + count
    return rows


def test_a_recording_holds_frames_map_and_plots(tmp_path: Path) -> None:
    recording = tmp_path / "recording.rrd"
    _, problem = record(recording, FakeRunner(lost=range(20, 25), breaks_at=35), FakeSequence())
    assert problem == ""
    assert [entry.name for entry in tmp_path.iterdir()] == ["recording.rrd"]
    rows = rows_of(recording)
    assert rows["/image"] == 50
    assert rows["/plots/points/mapped"] >= 50
    assert rows["/plots/time/tracking"] >= 50
    assert rows["/plots/error/final"] >= 50
    assert rows["/log"] >= 9
    for name in ("live/map0/points/0", "live/map0/keyframes/0", "live/map0/path/0", "live/map1/path/0", "live/camera"):
        assert rows[f"/world/scene/{name}"] > 0, rows
    for name in ("map0/points", "map0/path", "map0/keyframes", "map0/ground_truth", "map1/path"):
        assert rows[f"/world/scene/final/{name}"] == 1


def test_a_run_that_fails_leaves_neither_child_nor_file(tmp_path: Path) -> None:
    recording = tmp_path / "recording.rrd"
    view = LiveView(recording, None)
    view.begin(FakeSequence())
    assert view._send_queue is not None
    child = view._send_queue._child
    waited = time.monotonic()
    while not list(tmp_path.iterdir()) and time.monotonic() - waited < 20:
        time.sleep(0.05)  # until the child has begun its file
    view.__exit__(RuntimeError, RuntimeError(), None)
    assert child.poll() is not None
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_cannot_be_written_is_a_problem_in_words(tmp_path: Path) -> None:
    _, problem = record(tmp_path / "none" / "recording.rrd", FakeRunner(), FakeSequence())
    assert problem


def test_drawing_does_not_load_rerun_here() -> None:
    code = "import sys, sfmapp.viewer.live, sfmapp.pipelines.odometry.track; print('rerun' in sys.modules)"
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.strip() == "False"


# ---------------------------------------------------------------------------------------------------------- live viewer


def test_a_live_viewer_is_for_this_machine_alone_and_ends_whole(tmp_path: Path) -> None:
    said: list[str] = []
    viewer = open_live_viewer(tell=said.append, serve=True)
    try:
        assert viewer.screen.url.startswith("rerun+http://127.0.0.1:")
        assert said[0].startswith("watch it at http://127.0.0.1:")
        sequence = FakeSequence(length=12, num_frames=12)
        with LiveView(tmp_path / "recording.rrd", viewer.screen) as view:
            view.begin(sequence)
            result = FakeRunner()(sequence, OdometryOptions(), seed=0, threads=1, events=Events(view))
            assert view.end(result, [], np.full(12, np.nan)) == ""
        assert rows_of(tmp_path / "recording.rrd")["/image"] == 12
    finally:
        viewer.leave()
    port = int(viewer.screen.url.rpartition(":")[2].partition("/")[0])
    ended = time.monotonic()
    while time.monotonic() - ended < 10:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)):
                return
        time.sleep(0.1)
    pytest.fail("something still listens")


def test_the_commands_of_live_viewers_listen_on_this_machine_alone() -> None:
    for command in (window_command(None, "1234"), server_command(None, 9090, 9876)):
        assert command[command.index("--bind") + 1] == "127.0.0.1"
        assert not any(word.endswith(".rrd") for word in command)
