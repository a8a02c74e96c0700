"""The recording: what the listener keeps, what the replay shows, what the file holds, and who may fetch it."""

from __future__ import annotations

import signal
import socket
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.upright import up_direction
from sfmapp.images.image_set import ImageOptions, ImageRecord, ImageSet
from sfmapp.images.load import load_images
from sfmapp.images.pixels import read_rgb
from sfmapp.mapping.snapshot import ModelSnapshot
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks
from sfmapp.viewer import listener as listener_module
from sfmapp.viewer import view as view_module
from sfmapp.viewer.listener import RecordingListener
from sfmapp.viewer.photos import load_screen_photo
from sfmapp.viewer.recording import Drawer, write_recording
from sfmapp.viewer.replay import Replay, make_replay
from sfmapp.viewer.stage import set_stage
from sfmapp.viewer.view import free_port, server_command, server_url, view, window_command

NUM_IMAGES, NUM_POINTS = 7, 60
WIDTH, HEIGHT = 160, 120


def look_at(center: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(7,) cam_from_world of a level camera."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid3.from_matrix(rotation, -rotation @ center)


def ring(up: NDArray[np.float64], count: int = NUM_IMAGES) -> NDArray[np.float64]:
    """(count, 7) poses on a circle of radius 4 about the origin, a little above it."""
    a = np.cross(up, [0.3, 0.5, 0.8])
    a /= np.linalg.norm(a)
    b = np.cross(up, a)
    angles = np.linspace(0, 5, count)
    centers = 4 * (np.cos(angles)[:, None] * a + np.sin(angles)[:, None] * b) + up
    return np.array([look_at(c, np.zeros(3), up) for c in centers])


def make_model(poses: NDArray[np.float64], registered: NDArray[np.bool_]) -> Reconstruction:
    """Cameras that see all of a cloud of points, exactly but for a known residual of 0.3, 0.4 px."""
    rng = np.random.default_rng(1)
    xyz = rng.uniform(-1, 1, (NUM_POINTS, 3))
    camera = simple_camera(CameraModel.SIMPLE_RADIAL, WIDTH, HEIGHT, 150.0)
    image_idx, track_idx = (a.ravel() for a in np.meshgrid(np.arange(len(poses)), np.arange(NUM_POINTS), indexing="ij"))
    tracks = make_tracks(
        len(poses), NUM_POINTS, track_idx, image_idx, track_idx, np.zeros((len(track_idx), 2))
    )  # the pixels are filled in below
    shown = np.where(registered[:, None], poses, np.nan)
    model = Reconstruction(
        [camera], [f"{k}.jpg" for k in range(len(poses))], np.zeros(len(poses), np.int32), shown, tracks, xyz,
        registered[tracks.obs_image_idx], np.full((NUM_POINTS, 3), 90, np.uint8),
    )  # fmt: skip
    xy = np.nan_to_num(model.residuals_px()) - [0.3, 0.4]
    return replace(model, tracks=replace(tracks, obs_xy=xy))


@pytest.fixture
def job(tmp_path: Path) -> tuple[ImageSet, list[Features], Reconstruction]:
    """Seven small photographs, the last two of which are in no model."""
    rng = np.random.default_rng(0)
    records = []
    for k in range(NUM_IMAGES):
        name = f"a b/{k} ü.jpg"
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(path)
        records.append(ImageRecord(name, path, WIDTH, HEIGHT))
    registered = np.arange(NUM_IMAGES) < NUM_IMAGES - 2
    model = make_model(ring(np.array([0.0, 0.0, 1.0])), registered)
    features = [
        Features(
            np.concatenate([model.tracks.obs_xy[model.tracks.observations_of_image(k)], np.ones((5, 2))])
            .repeat(2, axis=1)[:, [0, 2, 1, 3]]
            .astype(np.float32),
            np.zeros((NUM_POINTS + 5, 128), np.uint8), np.zeros((NUM_POINTS + 5, 3), np.uint8),
        )
        for k in range(NUM_IMAGES)
    ]  # fmt: skip
    return ImageSet(tuple(records), tuple(model.cameras)), features, model


def replayed(model: Reconstruction) -> RecordingListener:
    """What a listener hears if the images join one by one, in other gauges that drift from step to step."""
    listener = RecordingListener()
    events = Events(listener)
    rng = np.random.default_rng(3)
    events.decided("pairs", "all of them")
    for count in range(2, int(model.is_registered.sum()) + 1):
        turn = rigid3.exp_so3(rng.normal(0, 1, 3))
        gauge = similarity.from_parts(turn, rng.normal(0, 5, 3), float(rng.uniform(0.2, 5)))
        poses = np.full_like(model.cam_from_world, np.nan)
        poses[:count] = similarity.transform_poses(gauge, model.cam_from_world[:count])
        xyz = similarity.apply(gauge, model.point_xyz).astype(np.float32)
        xyz[:: count + 1] = np.nan
        events.decided(
            "mapping", f"registered {count - 1}", num_points=3,
            snapshot=ModelSnapshot((0, 1) if count == 2 else (count - 1,), count, 40, 0.5, poses, xyz),
        )  # fmt: skip
    events.warned("mapping", "two images are left")
    return listener


def test_replay_brings_every_step_into_the_final_frame(job: tuple[ImageSet, list[Features], Reconstruction]) -> None:
    image_set, features, model = job
    listener = replayed(model)
    replay = make_replay(image_set, features, [model], listener.steps, listener.messages, title="t")
    # the first two join together and take two times, the final model one more
    assert replay.step.tolist() == [2, 3, 4, 5, 6]
    assert replay.image_step.tolist() == [1, 2, 3, 4, 5, -1, -1]
    assert [step for step, _, _ in replay.messages] == [0, 2, 3, 4, 5, 5, 6]
    for k, count in enumerate((2, 3, 4, 5)):
        np.testing.assert_allclose(
            rigid3.rotation_matrix(replay.pose_cam_from_world[k, :count]),
            rigid3.rotation_matrix(model.cam_from_world[:count]), atol=1e-4,
        )  # fmt: skip
        xyz = replay.cloud_xyz[replay.cloud_ptr[k] : replay.cloud_ptr[k + 1]]
        expected = np.delete(model.point_xyz, np.s_[:: count + 1], axis=0)
        np.testing.assert_allclose(xyz, expected, atol=2e-3)
    np.testing.assert_allclose(replay.obs_residual, np.tile([0.3, 0.4], (5 * NUM_POINTS, 1)), atol=1e-5)
    assert np.diff(replay.keypoint_ptr).tolist() == [5] * 5 + [NUM_POINTS + 5] * 2


def test_steps_of_a_long_run_still_know_their_images(job: tuple[ImageSet, list[Features], Reconstruction]) -> None:
    image_set, features, model = job
    steps = replayed(model).steps
    thinned = replace(steps[2], cam_from_world=None, point_xyz=None, point_track_idx=None)
    replay = make_replay(image_set, features, [model], [*steps[:2], thinned, *steps[3:]])
    assert replay.image_step.tolist() == [1, 2, 3, 4, 5, -1, -1]
    assert replay.pose_step.tolist() == replay.cloud_step.tolist() == [2, 3, 5]


def test_an_attempt_that_came_to_nothing_leaves_no_cameras(
    job: tuple[ImageSet, list[Features], Reconstruction],
) -> None:
    image_set, features, model = job
    steps = replayed(model).steps
    poses = np.full((NUM_IMAGES, 7), np.nan, np.float32)
    poses[[5, 6]] = [0, 0, 0, 1, 0, 0, 0]
    lost = replace(steps[0], image_idx=(5, 6), cam_from_world=poses)
    replay = make_replay(image_set, features, [model], [lost, *(replace(s, step=s.step + 1) for s in steps)])
    assert replay.image_step.tolist() == [3, 4, 5, 6, 7, -1, -1]
    assert replay.pose_model.tolist() == [0] * 4


def test_points_of_a_step_with_other_tracks_are_grey(job: tuple[ImageSet, list[Features], Reconstruction]) -> None:
    image_set, features, model = job
    steps = replayed(model).steps
    ids = steps[1].point_track_idx
    assert ids is not None
    others = replace(steps[1], point_track_idx=ids + len(model.point_rgb))  # of a round of mapping that was given up
    replay = make_replay(image_set, features, [model], [steps[0], others, *steps[2:]])
    rgb = replay.cloud_rgb[replay.cloud_ptr[1] : replay.cloud_ptr[2]]
    assert len(rgb) == len(ids)
    assert (rgb == 128).all()


def test_replay_survives_the_way_to_the_other_process(
    job: tuple[ImageSet, list[Features], Reconstruction], tmp_path: Path
) -> None:
    image_set, features, model = job
    listener = replayed(model)
    replay = make_replay(image_set, features, [model], listener.steps, listener.messages)
    replay.save(tmp_path)
    loaded = Replay.load(tmp_path)
    for name, value in vars(replay).items():
        np.testing.assert_array_equal(getattr(loaded, name), value, err_msg=name)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.6, 0, -0.8)])
def test_up_is_found_from_level_cameras_however_they_are_held(up: tuple[float, float, float]) -> None:
    ground_truth = np.array(up, np.float64)
    poses = ring(ground_truth)
    quarter = rigid3.from_matrix(rigid3.exp_so3([0, 0, np.pi / 2]), np.zeros(3))
    poses[0] = rigid3.compose(quarter, poses[0])  # one portrait among them
    assert up_direction(poses) @ ground_truth > np.cos(np.radians(25))
    assert up_direction(ring(ground_truth)) @ ground_truth > np.cos(np.radians(0.1))
    lying = rigid3.compose(np.tile(quarter, (NUM_IMAGES, 1)), ring(ground_truth))
    assert up_direction(lying) @ ground_truth > np.cos(np.radians(0.1))


def test_up_of_cameras_side_by_side_is_the_top_of_the_images() -> None:
    up = np.array([0.0, 0.0, 1.0])
    poses = np.array([look_at(np.array([x, -5.0, 0]), np.array([x, 0.0, 0]), up) for x in range(4)])
    np.testing.assert_allclose(up_direction(poses), up, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(up_direction(np.full((3, 7), np.nan))), 1)


def test_the_first_view_shows_all_models_upright(job: tuple[ImageSet, list[Features], Reconstruction]) -> None:
    image_set, features, model = job
    gauge = similarity.from_parts(rigid3.exp_so3([0.3, 2, 1]), np.array([5.0, 6, 7]), 30.0)
    other = replace(
        model,
        cam_from_world=np.full_like(model.cam_from_world, np.nan),
        point_xyz=similarity.apply(gauge, model.point_xyz),
        obs_is_inlier=np.zeros_like(model.obs_is_inlier),
    )
    all_poses = ring(np.array([0.0, 0.0, 1.0]))
    other.cam_from_world[5:] = similarity.transform_poses(gauge, all_poses[5:])
    replay = make_replay(image_set, features, [model, other], [], up=np.array([0.0, 0.0, 1.0]))
    stage = set_stage(replay)
    np.testing.assert_allclose(stage.rotation, np.eye(3))
    assert (stage.scale[0], *stage.shift[0]) == (1, 0, 0, 0)
    # a camera of the opening that the viewer has, at the eye
    eye_from_world = look_at(stage.eye, stage.target, np.array([0.0, 0.0, 1.0]))
    shown = []
    for m, xyz in enumerate((model.point_xyz, other.point_xyz)):
        centers = rigid3.center(replay.model_cam_from_world[m].astype(np.float64))
        body = np.concatenate([xyz, centers[~np.isnan(centers[:, 0])]])
        shown.append(stage.scale[m] * body @ stage.rotation.T + stage.shift[m])
        seen = rigid3.apply(eye_from_world, shown[m])
        assert (seen[:, 2] > 0).all()
        inside = np.abs(seen[:, :2] / seen[:, 2:]) < np.tan(np.radians(27.5)) * np.array([1.3, 1.0])
        assert inside.mean() > 0.97  # but for the tails of the points
    size = [np.linalg.norm(np.ptp(body, axis=0)) for body in shown]
    assert 0.4 < size[1] / size[0] < 0.9
    assert 0.02 < stage.frustum < 1


def test_listener_stays_small_in_a_long_run() -> None:
    listener = RecordingListener()
    events = Events(listener)
    num_tracks, num_images, num_steps = 40_000, 50, 600
    xyz = np.zeros((num_tracks, 3), np.float32)
    poses = np.tile([0.0, 0, 0, 1, 0, 0, 0], (num_images, 1))
    for k in range(num_steps):
        events.decided(
            "mapping", "m",
            snapshot=ModelSnapshot((), 2, num_tracks, 1.0, poses, xyz if k % 3 == 0 else None),
        )  # fmt: skip
    steps = [step.step for step in listener.steps]
    assert len(steps) == num_steps
    assert (np.diff(steps) > 0).all()
    clouds = [k for k, step in enumerate(listener.steps) if step.point_xyz is not None]
    assert len(clouds) == listener_module.MAX_CLOUDS
    assert sum(step.cam_from_world is not None for step in listener.steps) == listener_module.MAX_POSES
    assert all(listener.steps[k].cam_from_world is not None for k in clouds)
    assert all(len(listener.steps[k].point_xyz) == listener_module.MAX_CLOUD_POINTS for k in clouds)  # type: ignore[arg-type]
    # thinned geometrically: the first stay, later gaps grow with the step, the last stays
    assert clouds[:4] == [0, 3, 6, 9]
    assert clouds[-1] == num_steps - 3
    ratio = (np.array(clouds[1:]) + 1.0) / (np.array(clouds[:-1]) + 1.0)
    assert ratio[10:].max() < 1.5
    # the same points all along, so that a replay does not flicker
    np.testing.assert_array_equal(listener.steps[clouds[5]].point_track_idx, listener.steps[clouds[-1]].point_track_idx)


def test_listener_keeps_no_reference_to_the_arrays_of_the_run() -> None:
    listener = RecordingListener()
    poses, xyz = np.zeros((2, 7)), np.zeros((5, 3), np.float32)
    Events(listener).decided(
        "mapping", "m",
        snapshot=ModelSnapshot((1,), 1, 5, 0.0, poses, xyz),
    )  # fmt: skip
    poses[:], xyz[:] = 9, 9
    assert not listener.steps[0].cam_from_world.any()  # type: ignore[union-attr]
    assert not listener.steps[0].point_xyz.any()  # type: ignore[union-attr]


def entities_of(path: Path) -> dict[str, set[str]]:
    """Entity paths of a recording and the components that they have, read back by rerun."""
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    assert [entry.application_id for entry in reader.blueprints()] == ["sfmapp"]
    found: dict[str, set[str]] = {}
    for column in reader.store().schema().component_columns():
        found.setdefault(column.entity_path, set()).add(column.component)
    return found


def test_recording_holds_the_run(job: tuple[ImageSet, list[Features], Reconstruction], tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    image_set, features, model = job
    listener = replayed(model)
    path = tmp_path / "recording.rrd"
    report = write_recording(
        path, make_replay(image_set, features, [model], listener.steps, listener.messages, title="seven")
    )
    assert report.problem == ""
    assert report.path == path
    assert report.num_bytes == path.stat().st_size
    assert sorted(p.name for p in tmp_path.iterdir()) == ["photos", "recording.rrd"]  # nothing is left over
    found = entities_of(path)
    cameras = [name for name in found if name.startswith("/world/model0/cameras/")]
    assert len(cameras) == NUM_IMAGES - 2
    for name in cameras:
        assert {"Pinhole:image_from_camera", "Transform3D:translation", "EncodedImage:blob"} <= found[name]
    assert {"Points3D:positions", "Points3D:colors"} <= found["/world/model0/points"]
    assert "EncodedImage:blob" in found["/photo"]
    assert "Points2D:positions" in found["/photo/keypoints"]
    assert "Points2D:positions" in found["/photo/observations"]
    assert "Arrows2D:vectors" in found["/photo/residuals"]
    assert all("Scalars:scalars" in found[f"/plots/{name}"] for name in ("registered", "points", "error"))
    assert "TextLog:text" in found["/log"]


def test_photographs_in_memory_are_shown_as_well(
    job: tuple[ImageSet, list[Features], Reconstruction], tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    from_files, features, model = job
    arrays = {record.name: read_rgb(record) for record in from_files.images}
    image_set, _ = load_images(arrays, ImageOptions(), Events())
    assert not any(record.path.exists() for record in image_set.images)
    path = tmp_path / "recording.rrd"
    replay = make_replay(image_set, features, [model], [])
    assert write_recording(path, replay, image_set.images).problem == ""
    found = entities_of(path)
    cameras = [name for name in found if name.startswith("/world/model0/cameras/")]
    assert cameras
    assert all("EncodedImage:blob" in found[name] for name in cameras)
    assert "EncodedImage:blob" in found["/photo"]


def test_recording_of_nothing_is_still_a_recording(
    job: tuple[ImageSet, list[Features], Reconstruction], tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    image_set, features, _ = job
    image_set.images[0].path.unlink()  # gone since
    image_set.images[1].path.write_bytes(b"\xff\xd8\xff")  # and broken
    path = tmp_path / "recording.rrd"
    assert write_recording(path, make_replay(image_set, features, [], [])).problem == ""
    assert "EncodedImage:blob" in entities_of(path)["/photo"]


def test_a_crash_of_the_other_process_is_a_report_not_an_error(
    job: tuple[ImageSet, list[Features], Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image_set, features, model = job
    path = tmp_path / "recording.rrd"
    path.write_text("older")
    monkeypatch.setattr(sys, "executable", "/bin/false")
    report = write_recording(path, make_replay(image_set, features, [model], []))
    assert report.path is None
    assert "exit code 1" in report.problem
    assert path.read_text() == "older"
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert "did not start" in write_recording(path, make_replay(image_set, features, [model], [])).problem


def test_a_drawer_that_waits_draws_once_and_ends_with_its_run(
    job: tuple[ImageSet, list[Features], Reconstruction], tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    image_set, features, model = job
    with Drawer() as drawer:
        assert drawer.get_ready() == drawer.get_ready() == ""
        child = drawer._child
        assert child is not None
        path = tmp_path / "recording.rrd"
        assert write_recording(path, make_replay(image_set, features, [model], []), drawer=drawer).problem == ""
        assert "EncodedImage:blob" in entities_of(path)["/photo"]
        assert child.returncode == 0
    with Drawer() as drawer:
        drawer.get_ready()
        child = drawer._child
        assert child is not None
        assert child.poll() is None
    assert child.returncode == -signal.SIGKILL


@pytest.mark.parametrize("orientation", range(1, 9))
def test_screen_photos_are_upright(orientation: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    image = Image.fromarray(coarse).resize((640, 480), Image.Resampling.NEAREST)
    exif = Image.Exif()
    exif[274] = orientation
    path = tmp_path / "turned.jpg"
    image.save(path, quality=95, exif=exif)
    from PIL import ImageOps

    with Image.open(path) as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored).convert("RGB").reduce(2), np.float64)
    for name in ("turned.jpg", "turned.png"):
        if name.endswith("png"):
            with Image.open(path) as stored:
                stored.save(tmp_path / name)
        photo = load_screen_photo(tmp_path / name, orientation, 320, 80)
        assert photo is not None
        assert photo.size == expected.shape[1::-1]
        assert max(photo.thumbnail_size) == 80
        (tmp_path / "out.jpg").write_bytes(photo.photo)
        with Image.open(tmp_path / "out.jpg") as out:
            assert np.abs(np.asarray(out, np.float64) - expected).mean() < 12


def test_small_jpegs_go_in_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "small.jpg"
    Image.new("RGB", (300, 200), (9, 99, 199)).save(path)
    photo = load_screen_photo(path, 1, 320, 80)
    assert photo is not None
    assert photo.photo == path.read_bytes()
    assert load_screen_photo(tmp_path / "none.jpg", 1, 320, 80) is None


def test_nothing_listens_beyond_this_machine(tmp_path: Path) -> None:
    for command in (server_command(tmp_path / "r.rrd", 9090, 9876), window_command(tmp_path / "r.rrd")):
        assert command[command.index("--bind") + 1] == "127.0.0.1"
        assert command[-1] == str(tmp_path / "r.rrd")
    assert server_url(1234, 5678) == "http://127.0.0.1:1234/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A5678%2Fproxy"


def test_a_taken_port_is_left_alone() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        assert free_port(taken) not in (taken, 0)
    assert free_port(taken) == taken


def test_view_serves_where_no_window_opens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.rrd"
    with pytest.raises(InputError):
        view(path)
    path.touch()
    ran: list[list[str]] = []

    def run(command: list[str]) -> int:
        ran.append(command)
        return 0 if "--serve-web" in command else 1

    monkeypatch.setattr(view_module, "_run", run)
    monkeypatch.setattr(view_module, "has_screen", lambda: True)
    told: list[str] = []
    view(path, tell=told.append)
    assert ["--serve-web" in command for command in ran] == [False, True]
    assert len(told) == 1
    assert "http://127.0.0.1:" in told[0]
