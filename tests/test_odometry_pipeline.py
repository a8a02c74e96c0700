"""Everything around the tracker: what is written, what the report says, scale, gaps, and how a run ends early."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from odometry_fakes import FPS, FakeRunner, FakeSequence, path
from schemas import check_schema
from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.errors import InterruptedRunError, NoReconstructionError, UsageError
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate
from sfmapp.events import Event, Events
from sfmapp.formats.colmap import read_model
from sfmapp.formats.trajectory_input import read_tum
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu, SequenceOptions
from sfmapp.odometry.inertial.scale import ScaleEstimate
from sfmapp.odometry.inertial.visual_inertial import contradicted
from sfmapp.odometry.options import MAX_COVARIANCE_KEYFRAMES
from sfmapp.odometry.records import _covariance_gap
from sfmapp.odometry.refinement.final_adjustment import FinalAdjustment
from sfmapp.odometry.report import InertialEvidence
from sfmapp.odometry.result import FrameState
from sfmapp.pipelines.odometry import track as pipeline
from sfmapp.pipelines.odometry.scale import parse_scale
from sfmapp.pipelines.odometry.timing import ThreadTimes
from sfmapp.pipelines.odometry.track import TrackResult, track_sequence
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.pipelines.validate import validate
from sfmapp.report.model import MedianMax
from sfmapp.report.odometry_document import FrameTable, make_checks
from sfmapp.report.plots import Curve, plot_svg, ticks
from sfmapp.reporting import Usage
from sfmapp.scene.rig import Rig
from sfmapp.workspace.options import Options, load_options, options_from_dict

Patch = pytest.MonkeyPatch


def test_the_gtsam_backend_is_refused_with_the_reason(tmp_path):
    options = Options(adjust=AdjustOptions(backend="gtsam"))
    with pytest.raises(UsageError, match="windows while it tracks") as failure:
        track_sequence(tmp_path, tmp_path / "out", options)
    assert "sfmapp refine" in failure.value.advice


def use(monkeypatch: Patch, sequence: FakeSequence, runner: object) -> None:
    monkeypatch.setattr(pipeline, "open_sequence", lambda *_, **__: sequence)
    monkeypatch.setattr(pipeline, "run_odometry", runner)
    monkeypatch.setattr(pipeline, "compile_odometry_kernels", lambda *_, **__: Usage(wall_s=0.0, cpu_s=0.0))


def run(output: Path, *settings: str, events: Events | None = None) -> TrackResult:
    return track_sequence("fake", output, load_options(settings=settings), events=events, record=False)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def finished(tmp_path: Path, monkeypatch: Patch) -> tuple[Path, TrackResult]:
    """A run of fifty frames with a gap of five."""
    use(monkeypatch, FakeSequence(), FakeRunner(lost=range(20, 25)))
    return tmp_path / "out", run(tmp_path / "out")


def test_all_files_are_written_and_nothing_else(finished: tuple[Path, TrackResult]) -> None:
    names = {path.name for path in finished[0].iterdir()}
    trajectories = {"trajectory.tum", "trajectory_live.tum", "trajectory.kitti", "trajectory.kitti.frames"}
    others = {
        "frames.csv",
        "covariance.csv",
        "frame_covariance.csv",
        "sparse",
        "report.json",
        "report.html",
        "log.jsonl",
        "run.json",
    }
    assert names == trajectories | others
    assert sorted(path.name for path in (finished[0] / "sparse").iterdir()) == ["0"]


def test_the_trajectory_has_the_poses_that_are_there(finished: tuple[Path, TrackResult]) -> None:
    times, poses = read_tum(finished[0] / "trajectory.tum")
    tracked = [k for k in range(50) if not 20 <= k < 25]
    assert np.allclose([float(t) for t in times], np.array(tracked) / FPS)
    pairs = associate(Trajectory.from_cam_from_world(poses), Trajectory.from_cam_from_world(path(50)[tracked]))
    error = absolute_error(pairs, "sim3")
    # a centimetre of noise in each direction, in a unit of two metres
    assert 0.01 < np.sqrt((error.translation_m**2).mean()) < 0.06
    assert error.scale == pytest.approx(2, rel=0.01)


def test_every_frame_has_its_row_and_gaps_are_marked(finished: tuple[Path, TrackResult]) -> None:
    rows = rows_of(finished[0] / "frames.csv")
    assert [int(row["index"]) for row in rows] == list(range(50))
    assert [row["state"] for row in rows] == ["lost" if 20 <= k < 25 else "tracked" for k in range(50)]
    assert [row["map"] for row in rows] == ["" if 20 <= k < 25 else "0" for k in range(50)]
    assert (rows[0]["tracked_points"], rows[0]["mapped_points"], rows[22]["tracked_points"]) == ("60", "40", "0")
    assert float(rows[0]["tracking_ms"]) == 10
    (gap,) = finished[1].report["frames"]["gaps"]
    assert (gap["first_frame"], gap["last_frame"], gap["num_frames"]) == (20, 24, 5)
    assert gap["duration_s"] == pytest.approx(0.6)
    assert (finished[0] / "trajectory.kitti.frames").read_text().split() == [r["index"] for r in rows if r["map"]]


def test_keyframes_have_covariances(finished: tuple[Path, TrackResult]) -> None:
    rows = rows_of(finished[0] / "covariance.csv")
    assert len(rows) == len(finished[1].odometry.maps[0].keyframe_frame_idx)
    assert float(rows[0]["rx_rx"]) == 1e-6
    assert float(rows[0]["tz_tz"]) == 1e-4
    assert float(rows[0]["rx_tz"]) == 0
    assert len(rows[0]) == 4 + 21
    of_frames = rows_of(finished[0] / "frame_covariance.csv")
    assert [int(row["index"]) for row in of_frames] == [k for k in range(50) if not 20 <= k < 25]
    assert float(of_frames[0]["ty_ty"]) == 1e-4
    sigma = finished[1].report["maps"][0]["position_sigma"]
    assert sigma["median"] == pytest.approx(np.sqrt(3e-4))


def test_missing_covariances_are_said_and_not_green(finished: tuple[Path, TrackResult]) -> None:
    """None at all is red, some amber; all, or none asked for, is no row."""
    report = finished[1].report
    facts = FrameTable(np.full(1, np.nan), np.full(1, np.nan), np.full(1, np.nan), np.full(1, -1))
    known = MedianMax(median=1.0, max=1.0)
    for gap, sigma, light in (("", known, None), ("2 of 9", known, "amber"), ("open", None, "red")):
        maps = [replace(report["maps"][0], covariance_gap=gap, position_sigma=sigma)]
        rows = [row for row in make_checks(report["frames"], maps, None, facts) if "uncertainty" in row["name"]]
        assert [row["light"] for row in rows] == ([] if light is None else [light])
        assert [row["value"] for row in rows] == ([] if light is None else [gap])


@pytest.mark.parametrize(
    ("covariance", "num", "said"),
    [
        (None, 7, ""),  # not asked for
        (None, MAX_COVARIANCE_KEYFRAMES + 1, "too many"),
        (np.full((7, 6, 6), np.nan), 7, "do not determine"),
        (np.where(np.arange(7)[:, None, None] < 2, np.nan, np.eye(6)), 7, "2 of 7"),
        (np.tile(np.eye(6), (7, 1, 1)), 7, ""),
    ],
)
def test_why_there_is_no_covariance(covariance: np.ndarray | None, num: int, said: str) -> None:
    gap = _covariance_gap(FinalAdjustment(covariance, "", {}), num)
    assert said in gap
    assert bool(gap) == bool(said)


def test_the_map_is_a_model_with_grey_points(finished: tuple[Path, TrackResult]) -> None:
    model, _ = read_model(finished[0] / "sparse" / "0")
    assert model.image_names == [f"{k:06d}.png" for k in range(0, 50, 5) if not 20 <= k < 25]
    assert model.summary()["mean_reprojection_error_px"] < 0.1
    rgb = model.point_rgb
    assert (rgb == rgb[:, :1]).all()
    assert len(np.unique(rgb)) > 20


def test_a_stereo_map_holds_both_cameras(tmp_path: Path, monkeypatch: Patch) -> None:
    camera = simple_camera(CameraModel.PINHOLE, 160, 100, 120.0)
    rig = Rig((camera, camera), np.array([rigid3.IDENTITY, [0, 0, 0, 1, -0.5, 0, 0]]))
    use(monkeypatch, FakeSequence(rig=rig), FakeRunner())
    result = run(tmp_path / "out")
    model, _ = read_model(tmp_path / "out" / "sparse" / "0")
    assert len(model.image_names) == 20
    assert len({name.rpartition("/")[2] for name in model.image_names}) == 10
    assert result.report["sequence"]["stereo"]


def test_the_report_compares_with_the_ground_truth(finished: tuple[Path, TrackResult]) -> None:
    report = json.loads((finished[0] / "report.json").read_text())
    check_schema("odometry", report)
    final, live = report["ground_truth"]
    assert (final["poses"], final["alignment"], final["num_pairs"], live["poses"]) == ("final", "sim3", 45, "live")
    assert 0.01 < final["ate_m"]["rmse"] < 0.06
    assert final["scale"] == pytest.approx(2, rel=0.01)
    assert report["frames"]["lost"] == 5
    assert report["outcome"]["exit_code"] == 0
    assert report["warnings"][0]["message"] == "tracking is lost at frame 20"
    assert len([line for line in report["decisions"] if line["message"].startswith("a keyframe")]) == 9
    timing = report["timing"]
    assert timing["num_frames"] == 50
    assert timing["cpu_ms_per_frame"] > 0
    assert timing["parts_cpu_ms"]["tracking"] == 10
    assert {check["light"] for check in report["checks"]} <= {"green", "amber", "red"}


class Page(HTMLParser):
    """Checks that tags are balanced and that nothing is fetched."""

    VOID = ("meta", "br", "path", "circle", "rect")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in ("script", "link", "img")
        assert not {"src", "href"} & {name for name, _ in attrs}
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_is_whole_and_says_what_counts(finished: tuple[Path, TrackResult]) -> None:
    page = Page()
    page.feed((finished[0] / "report.html").read_text())
    assert page.open == []
    for words in (
        "45 of 50 frames with a pose",
        "Gaps: frames without a pose",
        "From above",
        "Against the ground truth",
    ):
        assert words in page.text
    assert "arbitrary" in page.text


def test_the_manifest_tells_how_it_was_made(finished: tuple[Path, TrackResult]) -> None:
    manifest = json.loads((finished[0] / "run.json").read_text())
    assert manifest["command"] == "odometry"
    assert options_from_dict(manifest["options"]) == Options()
    assert {"odometry", "output"} <= set(manifest["usage"])


def test_separate_maps_get_files_of_their_own_and_old_ones_vanish(tmp_path: Path, monkeypatch: Patch) -> None:
    use(monkeypatch, FakeSequence(), FakeRunner(lost=range(18, 20), breaks_at=20))
    report = run(tmp_path / "out").report
    assert [row["num_frames"] for row in report["maps"]] == [30, 18]
    assert len(read_tum(tmp_path / "out" / "trajectory.tum")[0]) == 30
    assert len(read_tum(tmp_path / "out" / "trajectory-1.tum")[0]) == 18
    assert len(read_tum(tmp_path / "out" / "trajectory_live-1.tum")[0]) == 18
    assert (tmp_path / "out" / "sparse" / "1" / "images.bin").is_file()
    assert {row["map"] for row in rows_of(tmp_path / "out" / "frames.csv")} == {"0", "1", ""}
    assert report["frames"]["gaps"][0]["map_before"] == 1
    assert report["frames"]["gaps"][0]["map_after"] == 0
    (tmp_path / "out" / "trajectory-mine.tum").write_text("mine")
    use(monkeypatch, FakeSequence(), FakeRunner())
    run(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert "trajectory-mine.tum" in names
    assert not {"trajectory-1.tum", "trajectory_live-1.tum", "trajectory.kitti.frames"} & names
    assert not (tmp_path / "out" / "sparse" / "1").exists()


def test_the_same_seed_gives_the_same_bytes_another_does_not(tmp_path: Path, monkeypatch: Patch) -> None:
    use(monkeypatch, FakeSequence(), FakeRunner())
    files = ("trajectory.tum", "trajectory.kitti", "covariance.csv", "sparse/0/points3D.bin")
    written = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        run(tmp_path / name, f"seed={seed}")
        written.append([(tmp_path / name / file).read_bytes() for file in files])
    assert written[0] == written[1]
    assert written[0][0] != written[2][0]


def test_no_map_at_all_is_a_failure_with_a_report(tmp_path: Path, monkeypatch: Patch) -> None:
    use(monkeypatch, FakeSequence(), FakeRunner())
    run(tmp_path / "out")
    use(monkeypatch, FakeSequence(), FakeRunner(finds_nothing=True))
    with pytest.raises(NoReconstructionError, match="50 frames were read, but no map"):
        run(tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["outcome"]["exit_code"] == 4
    assert report["maps"] == []
    assert "no map could be initialized" in (tmp_path / "out" / "report.html").read_text()
    # nothing of the earlier run is left that could be taken for a result of this one
    assert not list((tmp_path / "out").glob("trajectory*"))
    assert not list((tmp_path / "out").glob("sparse/*"))


def test_an_empty_sequence_is_a_failure_too(tmp_path: Path, monkeypatch: Patch) -> None:
    sequence = FakeSequence()
    sequence.length = 0
    use(monkeypatch, sequence, FakeRunner())
    with pytest.raises(NoReconstructionError, match="no frame could be read"):
        run(tmp_path / "out")
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_wish_to_stop_writes_what_was_tracked(tmp_path: Path, monkeypatch: Patch) -> None:
    use(monkeypatch, FakeSequence(), FakeRunner())
    events = Events()

    def stop_at_thirty(event: Event) -> None:
        seen = event.data.get("snapshot")
        if getattr(seen, "state", None) == FrameState.TRACKED and event.kind == "advanced" and event.done == 30:
            events.cancel()

    events.subscribe(stop_at_thirty)
    with pytest.raises(InterruptedRunError):
        run(tmp_path / "out", events=events)
    assert len(read_tum(tmp_path / "out" / "trajectory.tum")[0]) == 30
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["outcome"]["exit_code"] == 130
    assert report["frames"]["num_frames"] == 30
    assert not (tmp_path / "out" / ".lock").exists()


def test_workspaces_of_other_commands_are_refused(
    finished: tuple[Path, TrackResult], photos: Path, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="holds the results of sfmapp odometry"):
        reconstruct(photos, finished[0], record=False)
    with pytest.raises(UsageError, match="holds the results of sfmapp odometry"):
        validate(finished[0])
    (tmp_path / "photos").mkdir()
    with pytest.raises(NoReconstructionError):
        reconstruct(tmp_path / "photos", tmp_path / "other", record=False)
    with pytest.raises(UsageError, match="holds the results of sfmapp reconstruct"):
        run(tmp_path / "other")


# ------------------------------------------------------------------------------------------------------------- filter


def test_live_poses_are_filtered_and_the_gap_bridged(tmp_path: Path, monkeypatch: Patch) -> None:
    use(monkeypatch, FakeSequence(), FakeRunner(lost=range(20, 25)))
    report = run(tmp_path / "out", "odometry.filter=true").report
    check_schema("odometry", json.loads((tmp_path / "out" / "report.json").read_text()))
    told = report["stages"]["filter"]
    assert (told["prediction"], told["num_used"], told["rejected"]) == ("constant velocity", 45, [])
    (gap,) = told["gaps"]
    assert gap["last_s"] - gap["first_s"] == pytest.approx(5 / FPS)
    times, poses = read_tum(tmp_path / "out" / "trajectory_filtered.tum")
    rows = rows_of(tmp_path / "out" / "trajectory_filtered.csv")
    assert [float(row["timestamp_s"]) for row in rows] == [float(time) for time in times]
    assert [int(row["is_bridged"]) for row in rows] == [0] * 20 + [1] * 5 + [0] * 25
    # a centimetre of noise, in the unit of the map, and so are the sigmas
    sigma = np.array([float(row["position_sigma"]) for row in rows])
    assert sigma[30:].max() < 0.01 * np.sqrt(3) + 1e-6
    assert sigma[24] > 2 * sigma[30]
    found = Trajectory.from_cam_from_world(poses, np.array([float(time) for time in times]))
    truth = Trajectory.from_cam_from_world(path(50), np.arange(50) / FPS + float(times[0]))
    # the path bends and the prediction does not, as the sigma knows
    error = absolute_error(associate(found, truth), "sim3")
    assert error.scale == pytest.approx(2.0, rel=0.01)  # live poses have the unit of their time
    assert (error.translation_m < 3 * 2.0 * sigma).all()
    # another run takes them away
    run(tmp_path / "out")
    assert not list((tmp_path / "out").glob("trajectory_filtered*"))


# -------------------------------------------------------------------------------------------------------------- scale


@pytest.mark.parametrize("source", ["distance:000000.png:000040:{:.4f}", "distance:0:40:{:.4f}"])
def test_a_known_distance_makes_metres(source: str, tmp_path: Path, monkeypatch: Patch) -> None:
    use(monkeypatch, FakeSequence(), FakeRunner())
    centers = rigid3.center(path(50))
    length = float(np.linalg.norm(centers[40] - centers[0]))
    result = run(tmp_path / "out", f"scale.source={source.format(length)}")
    row = result.report["maps"][0]
    assert (row["unit"], row["scale_source"]) == ("m", "distance")
    assert result.report["ground_truth"][0]["alignment"] == "se3"
    # the centres of the two frames are a centimetre off in a unit of two metres
    assert result.report["ground_truth"][0]["ate_m"]["rmse"] < 0.06
    assert row["path_length"] == pytest.approx(24, rel=0.05)
    assert result.report["stages"]["scale"][0]["metres_per_unit"] == pytest.approx(2, rel=0.01)
    # covariances are in metres as well
    assert row["position_sigma"]["median"] == pytest.approx(2 * np.sqrt(3e-4), rel=0.01)
    model, _ = read_model(tmp_path / "out" / "sparse" / "0")
    assert model.summary()["mean_reprojection_error_px"] < 0.1


def inertial_sequence() -> FakeSequence:
    sequence = FakeSequence()
    sequence.imu = Imu(np.zeros(2), np.zeros((2, 3)), np.zeros((2, 3)), rigid3.IDENTITY, 1e-4, 1e-3, 1e-5, 1e-3)
    return sequence


def test_a_sensor_that_contradicts_the_map_is_red_and_gives_no_metres(tmp_path: Path, monkeypatch: Patch) -> None:
    evidence = InertialEvidence(num_poses=9, num_intervals=8, residual=99.0)
    refusal = contradicted("the accelerometer is upside down", "turn it", evidence)
    use(monkeypatch, inertial_sequence(), FakeRunner(inertial=refusal))
    report = run(tmp_path / "out").report
    assert report["maps"][0]["unit"] == ""
    assert report["maps"][0]["scale_sigma"] is None
    assert any("upside down" in warning["message"] for warning in report["warnings"])
    red = [row for row in report["checks"] if row["light"] == "red"]
    assert [(row["name"], row["thresholds"]) for row in red] == [("contradiction: inertial measurements", "turn it")]


def test_a_sensor_that_took_part_gives_metres_unless_others_are_asked_for(tmp_path: Path, monkeypatch: Patch) -> None:
    evidence = InertialEvidence(
        num_poses=9, num_intervals=8, residual=1.1, clock_offset_s=0.03, clock_sigma_s=1e-4,
        mounting_turn_deg=[0.1, -0.2, 0.1], mounting_turn_sigma_deg=[0.01] * 3,
        mounting_shift_m=[0.0, 0.05, 0.001], mounting_shift_sigma_m=[0.004] * 3,
    )  # fmt: skip
    use(monkeypatch, inertial_sequence(), FakeRunner(inertial=ScaleEstimate(2.0, 0.004, "imu", evidence)))
    report = run(tmp_path / "imu").report
    assert (report["maps"][0]["scale_source"], report["maps"][0]["scale_sigma"]) == ("imu", 0.004)
    assert report["maps"][0]["path_length"] == pytest.approx(24, rel=0.05)
    assert any("stamped 30.0 ms late" in warning["message"] for warning in report["warnings"])
    (away,) = (warning["message"] for warning in report["warnings"] if "mounting" in warning["message"])
    assert "0.050 +- 0.004" in away
    assert "turned" not in away  # no calibration is better than that
    for source in ("arbitrary", "distance:0:40:3"):
        report = run(tmp_path / source[:4], f"scale.source={source}").report
        assert report["maps"][0]["scale_source"] == source.partition(":")[0].replace("arbitrary", "none")


def test_a_scale_that_cannot_be_had_is_a_warning(tmp_path: Path, monkeypatch: Patch) -> None:
    use(monkeypatch, FakeSequence(), FakeRunner(lost=range(40, 42)))
    for name in ("nowhere", "41"):
        report = run(tmp_path / "out", f"scale.source=distance:0:{name}:5").report
        assert report["maps"][0]["scale_source"] == "none"
        assert any("keeps an arbitrary unit" in line["message"] for line in report["warnings"])


@pytest.mark.parametrize(
    "text",
    ["", "marker", "marker:DICT_4X4_50", "marker:NONSENSE:1", "distance:5", "distance:a:b:-1", "height:1", "imu:2"],
)
def test_impossible_scales_are_usage_errors_before_anything_is_written(text: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        parse_scale(text)
    with pytest.raises(UsageError):
        run(tmp_path / "out", f"scale.source={text}")
    assert not (tmp_path / "out").exists()


def test_scales_that_the_sequence_rules_out(tmp_path: Path, monkeypatch: Patch) -> None:
    camera = simple_camera(CameraModel.PINHOLE, 160, 100, 120.0)
    rig = Rig((camera, camera), np.array([rigid3.IDENTITY, [0, 0, 0, 1, -0.5, 0, 0]]))
    use(monkeypatch, FakeSequence(rig=rig), FakeRunner())
    with pytest.raises(UsageError, match="stereo"):
        run(tmp_path / "a", "scale.source=distance:0:1:1")
    use(monkeypatch, FakeSequence(), FakeRunner())
    with pytest.raises(UsageError, match="no inertial measurements"):
        run(tmp_path / "b", "scale.source=imu")


# ------------------------------------------------------------------------------------------------------------- details


def test_paths_in_the_options_hold_in_any_folder(tmp_path: Path, monkeypatch: Patch) -> None:
    (tmp_path / "calib.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    use(monkeypatch, FakeSequence(), FakeRunner())
    run(tmp_path / "out", "sequence.ground_truth=ground_truth.txt", "sequence.camera=calib.json")
    options = json.loads((tmp_path / "out" / "run.json").read_text())["options"]["sequence"]
    assert options["ground_truth"] == str(tmp_path / "ground_truth.txt")
    assert options["camera"] == str(tmp_path / "calib.json")
    run(tmp_path / "out", "sequence.camera=PINHOLE,1,1,1,1")
    options = json.loads((tmp_path / "out" / "run.json").read_text())["options"]["sequence"]
    assert options["camera"] == "PINHOLE,1,1,1,1"
    assert SequenceOptions(**options).camera == "PINHOLE,1,1,1,1"


def test_time_of_threads_is_told_apart() -> None:
    import threading
    import time

    times = ThreadTimes()
    times.sample()

    def work(seconds: float) -> None:
        end = time.thread_time() + seconds
        while time.thread_time() < end:
            pass
        done.wait()

    done = threading.Event()
    threads = [
        threading.Thread(target=work, args=(seconds,), name=name)
        for name, seconds in (("adjust_0", 0.1), ("frames_0", 0.05), ("recording_0", 0.1))
    ]
    for thread in threads:
        thread.start()
    while times.total("recording") < 0.1 or times.total("adjust") < 0.1 or times.total("frames") < 0.05:
        times.sample()
    done.set()
    for thread in threads:
        thread.join()
    timing = times.timing(10, 0.0, 10.0)
    assert timing["parts_cpu_ms"]["back end"] == pytest.approx(10, abs=3)
    assert timing["parts_cpu_ms"]["reading"] == pytest.approx(5, abs=3)
    assert timing["cpu_s"] < times._end[0] - times._begin[0] - 0.09  # drawing is not counted


def test_ticks_are_round() -> None:
    assert ticks(0, 10, 5) == [0, 2, 4, 6, 8, 10]
    assert ticks(0, 0.013, 4) == [0, 0.005, 0.01]
    assert ticks(3, 3, 4) == [3]


def test_a_long_curve_keeps_its_peaks() -> None:
    values = np.zeros(100_000)
    values[54_321] = 7.0
    svg = plot_svg(np.arange(100_000.0), [Curve("x", values, "#000")], [(5.0, 10.0)], "frame")
    assert len(svg) < 60_000
    assert svg.count("<rect") == 1
    assert ">6<" in svg  # the axis reaches the peak
