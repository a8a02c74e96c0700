"""The command's job on a rendered room with the real tracker: tracked, read again, refined, joined by photographs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rendered_worlds import sequences as rendered
from schemas import check_schema
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.contradictions import Contradiction
from sfmapp.errors import InputError, InterruptedRunError, UsageError
from sfmapp.events import Event, Events
from sfmapp.formats.colmap import read_model
from sfmapp.formats.trajectory import write_tum
from sfmapp.formats.trajectory_input import read_tum
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import SequenceOptions
from sfmapp.odometry.result import FrameState
from sfmapp.pipelines.odometry.refine import refine
from sfmapp.pipelines.odometry.results import read_odometry
from sfmapp.pipelines.odometry.self_calibrate import choose_frames, self_calibrated
from sfmapp.pipelines.odometry.track import TrackResult, track_sequence
from sfmapp.pipelines.validate import validate
from sfmapp.reporting import plain
from sfmapp.workspace.options import Options, load_options

FPS, NUM_FRAMES, NUM_PHOTOS = 30.0, 72, 2
CAMERA = Camera(CameraModel.PINHOLE, 320, 240, np.array([262.5, 262.5, 160.0, 120.0]))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of a room, the ground truth, and photographs of it that are none of the frames."""
    from PIL import Image

    folder = tmp_path_factory.mktemp("room")
    sequence = rendered.room(NUM_FRAMES, camera=CAMERA)
    for name in ("frames", "photos"):
        (folder / name).mkdir()
    for k in range(NUM_FRAMES):
        kind = "photos" if is_photo(k) else "frames"
        Image.fromarray(sequence.image(k)).save(folder / kind / f"{k / FPS:.6f}.png")
    write_tum(folder / "ground_truth.txt", sequence.timestamps_s, sequence.ground_truth)
    return folder


def is_photo(number: int) -> bool:
    return number % (NUM_FRAMES // (NUM_PHOTOS + 1)) == 1 and number > 1


def options_of(room: Path, *settings: str) -> Options:
    camera = "PINHOLE,262.5,262.5,160,120"
    return load_options(
        settings=[f"sequence.camera={camera}", f"sequence.ground_truth={room / 'ground_truth.txt'}", *settings]
    )


@pytest.fixture(scope="module")
def tracked(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrackResult]:
    """A finished run; not to be changed."""
    output = tmp_path_factory.mktemp("tracked") / "out"
    return output, track_sequence(room / "frames", output, options_of(room), record=False)


def errors_m(names: list[str], poses: NDArray[np.float64], room: Path) -> NDArray[np.float64]:
    """Distance of each image's centre from the ground truth of its moment, after a similarity over all of them."""
    times, ground_truth = read_tum(room / "ground_truth.txt")
    moments = np.array([float(Path(name).stem) for name in names])
    near = np.abs(np.array([float(t) for t in times])[None] - moments[:, None]).argmin(1)
    fit = similarity.align_poses(poses, ground_truth[near]).b_from_a
    return np.asarray(
        np.linalg.norm(similarity.apply(fit, rigid3.center(poses)) - rigid3.center(ground_truth[near]), axis=1)
    )


def test_a_rendered_room_is_tracked(room: Path, tracked: tuple[Path, TrackResult]) -> None:
    report = tracked[1].report
    assert report["frames"]["num_with_pose"] >= report["frames"]["num_frames"] - 2
    assert len(report["maps"]) == 1
    (final, *_) = report["ground_truth"]
    # a percent of the path: ten times what it takes, a tenth of what a drifting or mirrored path would have
    assert final["ate_m"]["rmse"] < 0.01 * final["true_path_m"]
    assert 0.01 < report["maps"][0]["mean_reprojection_error_px"] < 0.5
    assert report["timing"]["parts_cpu_ms"]["tracking"] > 0
    assert np.nanmedian(read_odometry(tracked[0]).timestamps_s) > 0


def test_what_is_written_can_be_read_again(tracked: tuple[Path, TrackResult]) -> None:
    output, (result, _) = tracked
    again = read_odometry(output)
    for name in ("frame_idx", "timestamps_s", "frame_map", "frame_state"):
        assert np.array_equal(getattr(again, name), getattr(result, name))
    assert again.frame_names == result.frame_names
    assert np.allclose(again.cam_from_world, result.cam_from_world, atol=1e-12, equal_nan=True)
    for ours, theirs in zip(again.maps, result.maps, strict=True):
        assert np.array_equal(ours.keyframe_frame_idx, theirs.keyframe_frame_idx)
        poses = [entry.reconstruction.cam_from_world[entry.keyframe_image_idx] for entry in (ours, theirs)]
        assert np.allclose(poses[0], poses[1], atol=1e-12)


def test_a_second_run_is_localised_in_the_first_and_a_third_in_both(
    room: Path, tracked: tuple[Path, TrackResult], tmp_path: Path
) -> None:
    second, third = tmp_path / "second", tmp_path / "third"
    options = options_of(room, "sequence.start=20", f"odometry.known_map={tracked[0]}")
    found, report = track_sequence(room / "frames", second, options, record=False)
    assert report.stages.odometry is not None
    told = report.stages.odometry.known_map
    assert told is not None
    assert told.num_localised == report["frames"]["num_with_pose"] == report["frames"]["num_frames"]
    check_schema("odometry", json.loads((second / "report.json").read_text()))
    assert [row["light"] for row in report["checks"] if row["name"] == f"found in {tracked[0]}"] == ["green"]
    assert "frames localised in" in (second / "report.html").read_text()
    # the same moments in the same place, without an alignment
    names, poses = tracked[1].odometry.frame_names, tracked[1].odometry.cam_from_world
    before = rigid3.center(np.array([poses[names.index(name)] for name in found.frame_names]))
    assert np.linalg.norm(rigid3.center(found.cam_from_world) - before, axis=1).max() < 0.05 * np.ptp(before, 0).max()
    assert all(name in read_odometry(second).frame_names for name in found.frame_names)
    # a map in a map has pictures of both
    options = options_of(room, "sequence.stop=12", f"odometry.known_map={second}")
    _, report = track_sequence(room / "frames", third, options, record=False)
    assert report.stages.odometry is not None
    again = report.stages.odometry.known_map
    assert again is not None
    assert again.is_found
    assert again.num_places == again.num_keyframes > told.num_keyframes
    options = options_of(room, "scale.source=camera_height:1.5", f"odometry.known_map={second}")
    with pytest.raises(UsageError, match="the unit of length is that of the map"):
        track_sequence(room / "frames", tmp_path / "other", options)
    with pytest.raises(UsageError, match="is the map itself"):
        track_sequence(room / "frames", second, options_of(room, f"odometry.known_map={second}"))


def test_what_contradicts_a_map_is_read_again_with_it(tracked: tuple[Path, TrackResult], tmp_path: Path) -> None:
    output = tmp_path / "out"
    found = Contradiction("given calibration", "f is too long", "calibrate", {"sigmas": 9.0}, 0.3)
    shutil.copytree(tracked[0], output)
    manifest = json.loads((output / "run.json").read_text())
    manifest["stages"]["odometry"]["maps"][0]["contradictions"] = [plain(found)]
    (output / "run.json").write_text(json.dumps(manifest))
    (output / "report.json").unlink()  # nothing is read back from it
    assert read_odometry(output).maps[0].contradictions == [found]
    assert read_odometry(tracked[0]).maps[0].contradictions == tracked[1].odometry.maps[0].contradictions == []


def test_threads_do_not_change_a_byte(room: Path, tracked: tuple[Path, TrackResult], tmp_path: Path) -> None:
    track_sequence(room / "frames", tmp_path / "out", options_of(room, "threads=1"), record=True)
    for name in (
        "trajectory.tum",
        "trajectory_live.tum",
        "trajectory.kitti",
        "covariance.csv",
        "sparse/0/points3D.bin",
    ):
        assert (tmp_path / "out" / name).read_bytes() == (tracked[0] / name).read_bytes(), name


def test_nothing_is_compiled_while_frames_are_tracked(room: Path, tmp_path: Path) -> None:
    from numba.core import event as numba_event

    class Watch(numba_event.Listener):
        is_tracking = False

        def __init__(self) -> None:
            self.compiled: list[str] = []

        def on_start(self, event: numba_event.Event) -> None:
            if self.is_tracking:
                self.compiled.append(str(event.data["dispatcher"]))

        def on_end(self, event: numba_event.Event) -> None: ...

    watch = Watch()

    def follow(event: Event) -> None:
        if event.stage == "odometry" and event.kind in ("started", "finished"):
            watch.is_tracking = event.kind == "started"

    numba_event.register("numba:compile", watch)
    try:
        options = options_of(room, "sequence.stop=20")
        track_sequence(room / "frames", tmp_path / "out", options, events=Events(follow), record=False)
    finally:
        numba_event.unregister("numba:compile", watch)
    assert watch.compiled == []


def test_frames_that_repeat_the_one_before_have_its_pose(room: Path, tmp_path: Path) -> None:
    """In the trajectory, as it was given out, smoothed, with its covariance, and after a refinement."""
    from PIL import Image

    (tmp_path / "frames").mkdir()
    originals = sorted((room / "frames").iterdir())[:30]
    twins: dict[str, str] = {}
    for k, path in enumerate(originals):
        last = f"{2 * k / FPS:.6f}.png"
        shutil.copy(path, tmp_path / "frames" / last)
        if k in (0, 7, 8, 20, 29):  # byte for byte, and the same pixels written otherwise
            name = f"{(2 * k + 1) / FPS:.6f}.png"
            twins[name] = last
            if k == 8:
                Image.open(path).save(tmp_path / "frames" / name, compress_level=1)
            else:
                shutil.copy(path, tmp_path / "frames" / name)
    output = tmp_path / "out"
    told: list[Event] = []
    options = options_of(room, "odometry.smooth=true", "sequence.ground_truth=" + str(room / "ground_truth.txt"))
    result, report = track_sequence(tmp_path / "frames", output, options, record=False, events=Events(told.append))
    row = {Path(name).name: k for k, name in enumerate(result.frame_names)}
    assert len(row) == 35
    assert report["frames"]["repeated"] == 5
    assert report["frames"]["num_unreadable"] == 0
    assert any("5 of 35 frames repeat the one before them" in event.message for event in told)
    refine(output, tmp_path / "refined", options_of(room))
    tables = {name: read_tum(output / name) for name in ("trajectory.tum", "trajectory_live.tum")}
    tables |= {"smooth": read_tum(output / "trajectory_smooth.tum")}
    tables |= {"refined": read_tum(tmp_path / "refined" / "trajectory.tum")}
    assert result.covariance is not None
    for twin, original in twins.items():
        a, b = row[twin], row[original]
        assert result.frame_state[a] == FrameState.REPEATED != result.frame_state[b]
        assert np.array_equal(result.cam_from_world[a], result.cam_from_world[b])
        assert np.array_equal(result.covariance[a], result.covariance[b])
        for name, (times, poses) in tables.items():
            of_time = dict(zip(times, poses, strict=True))
            ours, theirs = (of_time.get(repr(float(result.timestamps_s[k]))) for k in (a, b))
            if name == "trajectory_live.tum" and theirs is None:  # nothing was known yet
                assert ours is None
                continue
            assert ours is not None, name
            assert np.array_equal(ours, theirs), name
    assert len(tables["trajectory_live.tum"][0]) > 10
    assert np.isfinite(result.cam_from_world).all()
    assert not (output / "trajectory.kitti.frames").exists()
    names = [Path(line.split(",")[3]).name for line in (output / "frame_covariance.csv").read_text().splitlines()[1:]]
    assert set(twins) <= set(names)


# ------------------------------------------------------------------------------------------------------------- refined


def test_a_refined_map_is_no_worse_and_the_frames_move_with_it(
    room: Path, tracked: tuple[Path, TrackResult], tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in tracked[0].rglob("*") if path.is_file()}
    result, report = refine(tracked[0], tmp_path / "refined", options_of(room))
    assert {path: path.read_bytes() for path in tracked[0].rglob("*") if path.is_file()} == before
    errors = [report["ground_truth"][when][0]["ate_m"]["rmse"] for when in ("before", "after")]
    assert errors[1] < 1.2 * errors[0]
    maps = [report["maps"][when][0] for when in ("before", "after")]
    assert maps[1]["num_points"] > 0.9 * maps[0]["num_points"]
    # keyframes of the trajectory are those of the model
    times, poses = read_tum(tmp_path / "refined" / "trajectory.tum")
    model, _ = read_model(tmp_path / "refined" / "sparse" / "0")
    of_time = dict(zip(times, poses, strict=True))
    entry = result.maps[0]
    moments = result.timestamps_s[np.searchsorted(result.frame_idx, entry.keyframe_frame_idx)]
    for moment, image_idx in zip(moments.tolist(), entry.keyframe_image_idx, strict=True):
        assert np.allclose(of_time[repr(moment)], model.cam_from_world[image_idx], atol=1e-9)
    assert not (tmp_path / "refined" / "trajectory_live.tum").exists()
    assert "Before and after" in (tmp_path / "refined" / "report.html").read_text()


def test_a_disturbed_map_is_put_right(room: Path, tracked: tuple[Path, TrackResult], tmp_path: Path) -> None:
    """Keyframes pushed about by a hundredth of the path come back, and with them the frames between."""
    import shutil

    from sfmapp.formats.colmap import write_model

    output = Path(shutil.copytree(tracked[0], tmp_path / "out"))
    model, keypoints = read_model(output / "sparse" / "0")
    size = float(np.linalg.norm(np.ptp(model.centers, axis=0)))
    model.cam_from_world[:, 4:] += np.random.default_rng(0).normal(0, 0.01 * size, (len(model.image_names), 3))
    write_model(output / "sparse" / "0", model, keypoints)
    report = refine(output, options=options_of(room)).report
    errors = [report["maps"][when][0]["mean_reprojection_error_px"] for when in ("before", "after")]
    assert errors[0] > 5 * errors[1]
    again, _ = read_model(output / "refined" / "sparse" / "0")
    assert errors_m(again.image_names, again.cam_from_world, room).max() < 0.02


def test_photographs_join_the_map(room: Path, tracked: tuple[Path, TrackResult], tmp_path: Path) -> None:
    _, report = refine(tracked[0], tmp_path / "refined", options_of(room), photos=room / "photos")
    check_schema("refine", json.loads((tmp_path / "refined" / "report.json").read_text()))
    assert [row["is_registered"] for row in report["photographs"]] == [True] * NUM_PHOTOS
    model, _ = read_model(tmp_path / "refined" / "sparse" / "0")
    is_photo = np.array([name.startswith("photos/") for name in model.image_names])
    assert is_photo.sum() == NUM_PHOTOS
    errors = errors_m(model.image_names, model.cam_from_world, room)
    # a walk of most of two metres; the photographs lie no further off it than keyframes may
    assert errors[~is_photo].max() < 0.03
    assert errors[is_photo].max() < 0.03
    assert report["maps"]["after"][0]["num_points"] > report["maps"]["before"][0]["num_points"]


def test_only_odometry_can_be_refined(room: Path, tracked: tuple[Path, TrackResult], tmp_path: Path) -> None:
    with pytest.raises(InputError):
        refine(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no usable photograph"):
        refine(tracked[0], tmp_path / "refined", photos=tmp_path / "empty")
    with pytest.raises(UsageError, match="holds the results of sfmapp odometry"):
        refine(tracked[0], tracked[0])
    refine(tracked[0], tmp_path / "refined", options_of(room))
    with pytest.raises(UsageError, match="sfmapp refine"):
        validate(tmp_path / "refined")
    events = Events()
    events.cancel()
    with pytest.raises(InterruptedRunError):
        refine(tracked[0], tmp_path / "refined", events=events)


# ---------------------------------------------------------------------------------------------------------- calibrated


@pytest.mark.slow
def test_the_first_seconds_tell_the_focal_length(room: Path, tmp_path: Path) -> None:
    options = load_options(settings=[f"sequence.ground_truth={room / 'ground_truth.txt'}"])
    result = track_sequence(room / "frames", tmp_path / "out", options, record=False, self_calibrate=True)
    found = result.report["stages"]["self_calibration"]
    # two seconds of a small picture do not tell it better than to some percent
    assert found["params"]["f"] == pytest.approx(262.5, rel=0.05)
    assert found["focal_sigma_relative"] < 0.03
    assert result.report["ground_truth"][0]["ate_m"]["rmse"] < 0.02 * result.report["ground_truth"][0]["true_path_m"]
    assert "calibrated with the first minute" in (tmp_path / "out" / "report.html").read_text()


def test_a_camera_that_stands_cannot_be_calibrated(room: Path, tmp_path: Path) -> None:
    from PIL import Image

    (tmp_path / "frames").mkdir()
    rng = np.random.default_rng(0)
    with Image.open(sorted((room / "frames").iterdir())[0]) as image:
        pixels = np.asarray(image).astype(np.int64)
    for k in range(12):
        noisy = np.clip(pixels + rng.normal(0, 2, pixels.shape), 0, 255).astype(np.uint8)
        Image.fromarray(noisy).save(tmp_path / "frames" / f"{k:03d}.png")
    with pytest.raises(InputError, match="moves too little") as caught:
        self_calibrated(str(tmp_path / "frames"), Options(), Events())
    assert "--camera" in str(caught.value.advice)


def test_frames_for_the_calibration_are_apart(room: Path) -> None:
    from sfmapp.sequences.open import open_sequence

    sequence = open_sequence(room / "frames", SequenceOptions(), Events(), require_camera=False)
    chosen = [frame.idx for frame in choose_frames(sequence)]
    assert chosen[0] == 0
    assert 6 <= len(chosen) <= 16
    assert np.diff(chosen).min() >= 1
    again = [frame.idx for frame in choose_frames(sequence)]
    assert again == chosen


def test_a_run_without_a_camera_says_how_to_get_one(room: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        track_sequence(room / "frames", tmp_path / "out", record=False)
    assert "--self-calibrate" in str(caught.value.advice)


def test_states_are_those_that_the_table_names(tracked: tuple[Path, TrackResult]) -> None:
    lines = (tracked[0] / "frames.csv").read_text().splitlines()[1:]
    assert {line.split(",")[3] for line in lines} <= {state.name.lower() for state in FrameState}
    report = json.loads((tracked[0] / "report.json").read_text())
    assert report["format"] == "sfmapp odometry report 2"
    check_schema("odometry", report)
