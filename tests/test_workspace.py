"""The workspace: what it refuses, what it never touches, its keys and its lock."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.contradictions import Contradiction
from sfmapp.dense.options import DenseOptions
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Event, Events
from sfmapp.features.extract import FeatureOptions
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.matching.options import MatchingOptions
from sfmapp.odometry.report import MapFacts
from sfmapp.pipelines.sparse.keys import stage_keys
from sfmapp.reporting import Usage
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks
from sfmapp.workspace.keys import stage_key
from sfmapp.workspace.manifest import read_manifest
from sfmapp.workspace.options import Options
from sfmapp.workspace.workspace import open_workspace


def tiny_model(num_images: int = 3) -> Reconstruction:
    """Cameras in a row before eight points, all seen by all."""
    points = np.random.default_rng(1).normal(size=(8, 3)) + np.array([0.0, 0.0, 6.0])
    track, image = np.divmod(np.arange(8 * num_images), num_images)
    camera = simple_camera(CameraModel.PINHOLE, 640, 480, 500.0)
    poses = np.zeros((num_images, 7))
    poses[:, 3], poses[:, 4] = 1, np.arange(num_images)
    local = points[track] + np.array([1.0, 0, 0]) * image[:, None]
    xy = local[:, :2] / local[:, 2:] * 500 + [320, 240]
    tracks = make_tracks(num_images, 8, track, image, track, xy)
    names = [f"{i}.jpg" for i in range(num_images)]
    model = Reconstruction.empty([camera], names, np.zeros(num_images, np.int32), tracks)
    model.cam_from_world[:], model.point_xyz[:], model.obs_is_inlier[:] = poses, points, True
    return model


@pytest.mark.parametrize("model", [CameraModel.PINHOLE_SKEW, CameraModel.OPENCV_THIN_PRISM, CameraModel.EUCM])
def test_cameras_that_colmap_refuses_are_named_with_a_remedy(model: CameraModel, tmp_path: Path) -> None:
    import pycolmap

    told: list[Event] = []
    written = tiny_model()
    written.cameras = [simple_camera(model, 640, 480, 500.0)]
    with open_workspace(tmp_path / "out") as workspace:
        workspace.write_models([written], events=Events(told.append))
    messages = [event.message for event in told if event.kind == "warned"]
    folder = tmp_path / "out" / "sparse" / "0"
    if model.is_colmaps:
        assert not messages
        assert pycolmap.Reconstruction(folder).num_reg_images() == 3
        return
    assert len(messages) == 1
    for word in (model.name, str(int(model)), "COLMAP", "sfmapp undistort"):
        assert word in messages[0]


def test_a_new_workspace_can_be_opened_again(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with open_workspace(out) as workspace:
        workspace.begin("features", "k1")
        assert workspace.has_key("features", "k1")
        assert not workspace.is_current("features", "k1")
        workspace.finish("features", Usage(wall_s=1.0, cpu_s=2.0))
        workspace.save()
    with open_workspace(out) as workspace:
        assert workspace.is_current("features", "k1")
        assert not workspace.is_current("features", "k2")
    assert read_manifest(out)["stages"]["features"]["wall_s"] == 1.0
    assert sorted(path.name for path in out.iterdir()) == ["run.json"]


@pytest.mark.parametrize("content", ["holiday.jpg", "run.json", ".hidden"])
def test_folders_of_others_are_refused_and_left_alone(tmp_path: Path, content: str) -> None:
    (tmp_path / content).write_text("{}")
    with pytest.raises(UsageError, match="not empty"), open_workspace(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == [content]
    assert (tmp_path / content).read_text() == "{}"


def test_a_file_and_a_path_through_a_file_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    for path in (file, file / "below"):
        with pytest.raises(UsageError, match="is a file"), open_workspace(path):
            pass
    assert file.read_text() == "mine"


@pytest.mark.skipif(os.getuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_bad_input(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError), open_workspace(tmp_path / "out"):
        pass


def test_another_format_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"format": "sfmapp workspace 99"}))
    with pytest.raises(UsageError, match="another version"), open_workspace(tmp_path):
        pass


def test_what_is_noted_comes_back_and_a_damaged_manifest_is_told(tmp_path: Path) -> None:
    facts = MapFacts(scale_source="imu", scale_sigma=0.01, contradictions=[Contradiction("a", "b", evidence={"n": 3})])
    with open_workspace(tmp_path, "odometry") as workspace:
        workspace.note(source="/walk.mp4", seed=3, recording="written")
        workspace.begin("odometry", "k")
        workspace.finish("odometry", Usage(wall_s=2.0, cpu_s=3.0, peak_memory_mb=4.0), maps=[facts])
        workspace.save()
    found = read_manifest(tmp_path, "odometry")
    assert found == workspace.manifest
    assert (found.source, found.seed, found.recording, found.image_root) == ("/walk.mp4", 3, "written", None)
    entry = found.stage("odometry")
    assert entry.is_done
    assert (entry.wall_s, entry.cpu_s, entry.peak_memory_mb) == (2.0, 3.0, 4.0)
    assert entry.maps == [facts]
    assert found.stage("mapping") == {}
    document = json.loads((tmp_path / "run.json").read_text())
    for key, value, message in (
        ("seed", "three", "seed: expected int, found str"), ("stages", [], "stages: expected dict"),
        ("stages", {"odometry": {"is_done": 1}}, "is_done: expected bool"),
        ("speed", 1, "'speed' is not one of its fields"),
    ):  # fmt: skip
        (tmp_path / "run.json").write_text(json.dumps({**document, key: value}))
        with pytest.raises(InputError, match=message):
            read_manifest(tmp_path)
        with pytest.raises(InputError, match=r"run\.json"), open_workspace(tmp_path, "odometry"):
            pass


def test_looking_at_a_folder_that_is_no_workspace_is_bad_input(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match="not a workspace"):
            read_manifest(folder)


def test_two_runs_in_one_folder_exclude_each_other(tmp_path: Path) -> None:
    with open_workspace(tmp_path):
        with pytest.raises(UsageError, match=f"process {os.getpid()}"), open_workspace(tmp_path):
            pass
        assert (tmp_path / ".lock").exists()
    with open_workspace(tmp_path):
        pass
    assert not (tmp_path / ".lock").exists()


def test_the_lock_of_a_killed_run_is_no_obstacle(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from sfmapp.workspace.workspace import open_workspace\n"
        "with open_workspace(Path(sys.argv[1])): print('locked', flush=True); time.sleep(60)"
    )
    child = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == "locked\n"
    with pytest.raises(UsageError, match=f"process {child.pid}"), open_workspace(tmp_path):
        pass
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    assert (tmp_path / ".lock").exists()
    with open_workspace(tmp_path):
        pass


def test_fewer_models_take_the_place_of_more_and_nothing_else(tmp_path: Path) -> None:
    with open_workspace(tmp_path) as workspace:
        workspace.write_models([tiny_model(), tiny_model(2), tiny_model(2)])
        (workspace.model(0) / "notes.txt").write_text("mine")
        (workspace.model(1) / "notes.txt").write_text("mine too")
        (tmp_path / "sparse" / "aligned").mkdir()
        workspace.write_models([tiny_model(2)])
    found = sorted(str(path.relative_to(tmp_path / "sparse")) for path in (tmp_path / "sparse").rglob("*"))
    files = [
        f"0/{name}" for name in ("cameras.bin", "frames.bin", "images.bin", "notes.txt", "points3D.bin", "rigs.bin")
    ]
    assert found == ["0", *files, "1", "1/notes.txt", "aligned"]


def test_files_appear_whole(tmp_path: Path) -> None:
    with open_workspace(tmp_path) as workspace:
        workspace.write_json("report.json", {"a": 1})
        with pytest.raises(TypeError):
            workspace.write_text("report.json", 3)  # type: ignore[arg-type]
        assert workspace.read_json("report.json") == {"a": 1}
        (tmp_path / "report.json").write_text('{"a": ')
        assert workspace.read_json("report.json") is None
        assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", "report.json", "run.json"]


def test_keys_depend_on_options_inputs_and_source() -> None:
    base = stage_key(["sfmapp.matching.stage"], MatchingOptions(), "input")
    assert base == stage_key(["sfmapp.matching.stage"], MatchingOptions(), "input")
    others = [
        stage_key(["sfmapp.matching.stage"], MatchingOptions(max_ratio=0.7), "input"),
        stage_key(["sfmapp.matching.stage"], MatchingOptions(), "other"),
        stage_key(["sfmapp.features.extract"], MatchingOptions(), "input"),
        stage_key(["sfmapp.matching.stage"], MatchingOptions()),
        stage_key(["sfmapp.matching.stage"], None, "input"),
    ]
    assert len({base, *others}) == 6


def test_what_a_stage_may_take_is_in_no_key() -> None:
    for options, budget in ((FeatureOptions(), "memory_mb"), (DenseOptions(), "max_memory_mb")):
        more = dataclasses.replace(options, **{budget: 8000})  # type: ignore[arg-type]
        assert stage_key(["sfmapp.events"], options) == stage_key(["sfmapp.events"], more)


def two_images() -> ImageSet:
    camera = simple_camera(CameraModel.SIMPLE_RADIAL, 640, 480, 700.0, 300.0)
    return ImageSet(tuple(ImageRecord(n, Path(n), 640, 480, digest=n) for n in ("a.jpg", "b.jpg")), (camera,))


@pytest.mark.parametrize(
    ("stage", "option", "value", "touched"),
    [
        ("features", "max_num_features", 99, {"features", "pairs", "matching", "mapping"}),
        ("features", "memory_mb", 99, set()),
        ("pairs", "num_neighbors", 99, {"pairs", "mapping"}),
        ("matching", "max_ratio", 0.7, {"matching", "mapping"}),
        ("mapping", "min_pose_inliers", 99, {"mapping"}),
        ("adjust", "max_iterations", 99, {"mapping"}),
        (None, "seed", 99, {"pairs", "matching", "mapping"}),
        (None, "threads", 99, set()),
        (None, "min_registered", 99, set()),
    ],
)
def test_an_option_touches_its_stage_and_those_after_it(
    stage: str | None, option: str, value: object, touched: set[str]
) -> None:
    options = Options()
    if stage is None:
        changed = dataclasses.replace(options, **{option: value})  # type: ignore[arg-type]
    else:
        changed = dataclasses.replace(
            options, **{stage: dataclasses.replace(getattr(options, stage), **{option: value})}
        )
    before, after = stage_keys(options, two_images()), stage_keys(changed, two_images())
    names = ("features", "pairs", "matching", "mapping")
    assert {name for name in names if getattr(before, name) != getattr(after, name)} == touched


def test_a_changed_image_camera_or_mask_touches_what_uses_it(tmp_path: Path) -> None:
    images, options = two_images(), Options()
    before = stage_keys(options, images)
    other = dataclasses.replace(images.images[1], digest="other")
    after = stage_keys(options, dataclasses.replace(images, images=(images.images[0], other)))
    assert after.features == before.features
    assert [after.inputs[name] == before.inputs[name] for name in ("a.jpg", "b.jpg")] == [True, False]
    assert after.matching != before.matching
    camera = dataclasses.replace(images.cameras[0], focal_sigma=1.0)
    after = stage_keys(options, dataclasses.replace(images, cameras=(camera,)))
    assert after.matching == before.matching
    assert after.mapping != before.mapping
    mask = tmp_path / "mask.png"
    keys = []
    for content in (b"one", b"two"):
        mask.write_bytes(content)
        masked = dataclasses.replace(images.images[0], mask_path=mask)
        keys.append(stage_keys(options, dataclasses.replace(images, images=(masked, images.images[1]))).inputs["a.jpg"])
    assert len({*keys, before.inputs["a.jpg"]}) == 3
