"""The whole job on real photographs: what it writes, what it does not do twice, and how it ends when it cannot."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import sfmapp
from schemas import check_schema
from sfmapp.errors import InputError, InterruptedRunError, NoReconstructionError, TooFewImagesError
from sfmapp.events import Event, Events
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.world_frame import read_georeference
from sfmapp.pipelines.sparse.reconstruct import RunResult, reconstruct
from sfmapp.viewer.recording import RecordingReport
from sfmapp.workspace.options import Options, load_options

MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")


def model_bytes(output: Path) -> dict[str, bytes]:
    return {name: (output / "sparse" / "0" / name).read_bytes() for name in MODEL_FILES}


def run(photos: Path, output: Path, options: Options | None = None, *listeners: Callable[[Event], None]) -> RunResult:
    return reconstruct(photos, output, options, events=Events(*listeners), record=False)


class Counter:
    """Listener that counts the images and pairs a run really works on."""

    def __init__(self) -> None:
        self.worked: dict[str, int] = {}
        self.reports: dict[str, dict] = {}

    def __call__(self, event: Event) -> None:
        if event.kind == "finished":
            self.reports[event.stage] = dict(event.data)

    @property
    def num_extracted(self) -> int:
        return self.reports["features"]["num_images"] - self.reports["features"]["num_known"]

    @property
    def num_matched(self) -> int:
        return self.reports["matching"]["num_pairs"] - self.reports["matching"]["num_resumed_pairs"]


@pytest.fixture(scope="module")
def finished(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of one run that nothing disturbed; not to be changed."""
    output = tmp_path_factory.mktemp("finished") / "out"
    run(photos, output)
    return output


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished output, to be worked on."""
    return Path(shutil.copytree(finished, tmp_path / "out"))


def test_all_photographs_are_registered_and_the_report_says_so(photos: Path, finished: Path) -> None:
    report = json.loads((finished / "report.json").read_text())
    check_schema("reconstruct", report)
    assert report["outcome"]["exit_code"] == 0
    assert report["models"][0]["num_registered"] == 7
    assert 0.05 < report["models"][0]["mean_reprojection_error_px"] < 1.0
    assert [image["name"] for image in report["images"]] == sorted(path.name for path in photos.iterdir())
    for image in report["images"]:
        funnel = image["funnel"]
        assert image["is_registered"]
        assert image["model"] == 0
        assert funnel["features"] > 100
        assert funnel["candidate_pairs"] == 6
        assert 0 < funnel["verified_pairs"] <= 6
        assert 0 < funnel["verified_matches"] <= funnel["putative_matches"]
        assert 0 < funnel["observations"] <= funnel["features"]
    assert {check["light"] for check in report["checks"]} <= {"green", "amber", "red"}
    for stage in ("images", "features", "pairs", "matching", "mapping"):
        assert report["usage"][stage]["cpu_s"] >= 0
        assert stage in report["stages"]
    for key in ("wall_s", "cpu_s", "peak_memory_mb"):
        assert report["run"][key] > 0
    assert (
        sum(entry["wall_s"] for name, entry in report["usage"].items() if name != "kernels") < report["run"]["wall_s"]
    )
    assert report["decisions"]


def test_the_manifest_tells_how_it_was_made(photos: Path, finished: Path) -> None:
    manifest = json.loads((finished / "run.json").read_text())
    assert manifest["source"] == str(photos)
    assert manifest["versions"]["sfmapp"] == sfmapp.__version__
    assert {"numpy", "numba", "gtsam", "opencv-contrib-python-headless"} <= set(manifest["versions"])
    assert load_options(settings=[]) == sfmapp.workspace.options.options_from_dict(manifest["options"])
    assert len(manifest["inputs"]) == 7
    assert all(entry["is_done"] for entry in manifest["stages"].values())


def test_the_log_has_a_line_of_json_for_every_event(finished: Path) -> None:
    lines = [json.loads(line) for line in (finished / "log.jsonl").read_text().splitlines()]
    assert lines[0]["kind"] == "run"
    assert {"started", "advanced", "decided", "finished"} <= {line["kind"] for line in lines}
    assert not any("snapshot" in line.get("data", {}) for line in lines)


class Page(HTMLParser):
    """Checks that tags are balanced and that nothing is fetched."""

    VOID = ("meta", "br", "path")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert not {"src", "href"} & {name for name, _ in attrs}
        assert tag not in ("script", "link", "img")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert not {"src", "href"} & {name for name, _ in attrs}

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_is_whole_small_and_fetches_nothing(finished: Path) -> None:
    text = (finished / "report.html").read_text()
    page = Page()
    page.feed(text)
    page.close()
    assert page.open == []
    assert len(text) < 300_000
    assert "7 of 7 images registered" in page.text
    assert text.count("<polygon") == 7
    begun = json.loads((finished / "report.json").read_text())["stages"]["mapping"]["initial_pairs"][0]["pairs"][-1]
    assert f"sfmapp pair OUT {' '.join(begun['images'])}" in page.text


def test_the_same_command_again_does_nothing(photos: Path, copy: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*") if path.name != "log.jsonl"}
    counter = Counter()
    result = run(photos, copy, None, counter)
    assert result.report["run"]["is_up_to_date"]
    assert set(counter.reports) == {"images"}
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert result.reconstruction.is_registered.all()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_bytes_do_not_depend_on_the_number_of_threads(
    photos: Path, finished: Path, tmp_path: Path, threads: int
) -> None:
    run(photos, tmp_path / "out", Options(threads=threads))
    assert model_bytes(tmp_path / "out") == model_bytes(finished)


@pytest.mark.parametrize(
    ("setting", "extracts", "matches"),
    [
        ("mapping.min_pose_inliers=25", False, False),
        ("adjust.max_iterations=49", False, False),
        ("pairs.num_neighbors=10", False, False),
        ("images.focal_px=380", False, True),
        ("matching.max_ratio=0.79", False, True),
        ("seed=1", False, True),
        ("features.max_num_features=2000", True, True),
    ],
)
def test_a_changed_option_runs_again_only_what_it_touches(
    photos: Path, copy: Path, setting: str, extracts: bool, matches: bool
) -> None:
    counter = Counter()
    result = run(photos, copy, load_options(settings=[setting]), counter)
    assert (counter.num_extracted > 0, counter.num_matched > 0) == (extracts, matches)
    assert not result.report["run"]["is_up_to_date"]


def test_a_kept_stage_gives_the_same_bytes_as_a_fresh_one(photos: Path, copy: Path, tmp_path: Path) -> None:
    options = load_options(settings=["mapping.min_pose_inliers=25"])
    run(photos, copy, options)
    run(photos, tmp_path / "fresh", options)
    assert model_bytes(copy) == model_bytes(tmp_path / "fresh")


def test_a_new_photograph_is_the_only_one_extracted(photos: Path, tmp_path: Path) -> None:
    some, counter = tmp_path / "some", Counter()
    some.mkdir()
    paths = sorted(photos.iterdir())
    for path in paths[1:5]:
        shutil.copy(path, some)
    run(some, tmp_path / "out")
    shutil.copy(paths[0], some)
    run(some, tmp_path / "out", None, counter)
    assert counter.num_extracted == 1
    run(some, tmp_path / "fresh")
    assert model_bytes(tmp_path / "out") == model_bytes(tmp_path / "fresh")


def cancel_at(events: Events, stage: str, steps: int) -> Callable[[Event], None]:
    def listener(event: Event) -> None:
        if event.kind == "advanced" and event.stage == stage and event.done >= steps:
            events.cancel()

    return listener


@pytest.mark.parametrize(("stage", "steps"), [("images", 3), ("features", 3), ("matching", 9), ("mapping", 3)])
def test_a_run_that_was_stopped_anywhere_resumes_to_the_same_bytes(
    photos: Path, finished: Path, tmp_path: Path, stage: str, steps: int
) -> None:
    events, output = Events(), tmp_path / "out"
    events.subscribe(cancel_at(events, stage, steps))
    with pytest.raises(InterruptedRunError):
        reconstruct(photos, output, Options(threads=1), events=events, record=False)
    counter = Counter()
    run(photos, output, None, counter)
    done = {"images": 0, "features": 0, "matching": 1, "mapping": 2}[stage]
    assert (counter.num_extracted == 0) == (done >= 1)
    assert (counter.num_matched == 0) == (done >= 2)
    if stage == "features":
        assert counter.num_extracted <= 7 - steps
    if stage == "matching":
        assert counter.num_matched <= 21 - steps
    assert model_bytes(output) == model_bytes(finished)


@pytest.mark.parametrize("lost", ["sparse/0/points3D.bin", "report.json", "report.html", "database.db", "run.json"])
def test_what_was_lost_is_made_again(photos: Path, copy: Path, finished: Path, lost: str) -> None:
    (copy / lost).unlink()
    if lost == "run.json":  # then it is nobody's workspace
        with pytest.raises(sfmapp.errors.UsageError):
            run(photos, copy)
        return
    run(photos, copy)
    assert model_bytes(copy) == model_bytes(finished)
    if lost != "database.db":  # everything that it would be needed for still holds
        assert (copy / lost).is_file()


def test_a_damaged_database_is_named(photos: Path, copy: Path) -> None:
    (copy / "database.db").write_bytes(b"this is no database")
    with pytest.raises(InputError, match=r"database\.db"):
        run(photos, copy, Options(seed=5))


def test_too_few_registered_images_fail_with_everything_written(photos: Path, copy: Path) -> None:
    with pytest.raises(TooFewImagesError, match="7 images are registered, 8 were asked for"):
        run(photos, copy, Options(min_registered=8))
    assert (copy / "sparse" / "0" / "images.bin").is_file()


def test_the_python_interface_is_the_documented_one(photos: Path, copy: Path) -> None:
    options = sfmapp.load_options(presets=["default"], settings=["threads=1"])
    reconstruction, report = sfmapp.reconstruct(str(photos), str(copy), options, record=False)
    assert isinstance(reconstruction, sfmapp.Reconstruction)
    assert reconstruction.cam_from_world.shape == (7, 7)
    assert report["models"][0]["num_registered"] == 7


# ---------------------------------------------------------------------------------------------------------- recording


def test_a_recording_is_made_when_it_is_wanted_and_missing(photos: Path, copy: Path, finished: Path) -> None:
    for is_up_to_date in (False, True):
        counter = Counter()
        report = reconstruct(photos, copy, events=Events(counter)).report
        assert report["run"]["is_up_to_date"] == is_up_to_date
        assert report["warnings"] == []
        assert (copy / "recording.rrd").read_bytes()[:4] == b"RRF2"
    assert model_bytes(copy) == model_bytes(finished)


@pytest.mark.parametrize("is_cancelled", [False, True])
def test_a_recording_that_fails_is_a_warning(
    photos: Path, copy: Path, monkeypatch: pytest.MonkeyPatch, is_cancelled: bool
) -> None:
    events = Events()

    def fail(*_: object, **__: object) -> RecordingReport:
        if is_cancelled:  # a terminal sends Ctrl-C to the child too
            events.cancel()
        return RecordingReport(None, 0, 0.0, "exit code 1: broken")

    monkeypatch.setattr("sfmapp.viewer.recording.write_recording", fail)
    if is_cancelled:
        with pytest.raises(InterruptedRunError):
            reconstruct(photos, copy, events=events)
        return
    report = reconstruct(photos, copy, events=events).report
    assert [warning["message"] for warning in report["warnings"]] == ["no recording: exit code 1: broken"]
    assert reconstruct(photos, copy).report["run"]["is_up_to_date"]


# ------------------------------------------------------------------------------------------------- no reconstruction


def texture(seed: int) -> np.ndarray:
    """(300, 400, 3) uint8 of blobs on several scales: full of features, and like no other seed."""
    from PIL import Image

    rng = np.random.default_rng(seed)
    total = np.zeros((300, 400))
    for size in (8, 16, 40, 100):
        noise = Image.fromarray(rng.random((300 * size // 400, size)).astype(np.float32))
        total += np.asarray(noise.resize((400, 300), Image.Resampling.BICUBIC))
    scaled = (total - total.min()) / (total.max() - total.min()) * 255
    return np.repeat(scaled.astype(np.uint8)[..., None], 3, 2)


def write_images(folder: Path, *pixels: np.ndarray) -> Path:
    from PIL import Image

    folder.mkdir()
    for i, array in enumerate(pixels):
        Image.fromarray(array).save(folder / f"{i}.png")
    return folder


def hostile(folder: Path, kind: str) -> Path:
    one = texture(0)
    images = {
        "no images": [],
        "one image": [one],
        "two identical images": [one, one],
        "no overlap": [texture(seed) for seed in range(4)],
        "no texture": [np.full((300, 400, 3), 90 + i, np.uint8) for i in range(3)],
    }
    return write_images(folder, *images[kind])


KINDS = ("no images", "one image", "two identical images", "no overlap", "no texture")


@pytest.mark.parametrize("kind", KINDS)
def test_photographs_without_a_reconstruction_end_with_a_report(tmp_path: Path, kind: str) -> None:
    photos, output = hostile(tmp_path / "photos", kind), tmp_path / "out"
    with pytest.raises(NoReconstructionError) as caught:
        run(photos, output)
    assert caught.value.advice
    report = json.loads((output / "report.json").read_text())
    check_schema("reconstruct", report)
    assert report["outcome"] == {"exit_code": 4, "message": str(caught.value), "advice": caught.value.advice}
    assert len(report["images"]) == len(list(photos.iterdir()))
    assert all(image["remedy"] and image["reason"] and not image["is_registered"] for image in report["images"])
    assert report["models"] == []
    page = Page()
    page.feed((output / "report.html").read_text())
    assert page.open == []
    assert str(caught.value) in page.text
    assert not (output / "sparse" / "0").exists()
    # again: the same answer without the work
    counter = Counter()
    with pytest.raises(NoReconstructionError):
        run(photos, output, None, counter)
    assert set(counter.reports) == {"images"}


@pytest.mark.real
@pytest.mark.slow
def test_a_pure_rotation_is_refused(data_root: Path, tmp_path: Path) -> None:
    with pytest.raises(NoReconstructionError):
        run(data_root / "pano-sponza-rot", tmp_path / "out")
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_failure_takes_the_place_of_an_earlier_model(photos: Path, copy: Path) -> None:
    with pytest.raises(NoReconstructionError):
        run(photos, copy, load_options(settings=["matching.min_inliers=100000"]))
    assert not (copy / "sparse" / "0").exists()


def test_photographs_that_are_not_there_are_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        run(tmp_path / "none", tmp_path / "out")


@pytest.fixture
def raising(monkeypatch: pytest.MonkeyPatch) -> None:
    def bug(*_: object, **__: object) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr("sfmapp.pipelines.sparse.matches.select_pairs", bug)


@pytest.mark.usefixtures("raising")
def test_a_bug_leaves_its_traceback_in_the_log_and_a_workspace_that_resumes(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, counter = tmp_path / "out", Counter()
    with pytest.raises(RuntimeError):
        run(photos, output)
    last = json.loads((output / "log.jsonl").read_text().splitlines()[-1])
    assert (last["kind"], last["error"]) == ("raised", "RuntimeError")
    assert "Traceback" in last["traceback"]
    monkeypatch.undo()
    run(photos, output, None, counter)
    assert counter.num_extracted == 0


def test_positions_of_a_file_bring_the_model_into_the_world_and_none_take_it_back(
    photos: Path, copy: Path, tmp_path: Path
) -> None:
    model = read_model(copy / "sparse" / "0")[0]
    frame, rng = LocalFrame(47.4, 8.5, 430.0), np.random.default_rng(0)
    # the model's own places, ten units to the metre and turned, as a receiver would measure them to a centimetre
    turn = rigid3.exp_so3([0.3, -0.2, 1.0])
    places = 10.0 * model.centers @ turn.T + rng.normal(0.0, 0.01, (7, 3))
    rows = [
        f"{name},{latitude:.9f},{longitude:.9f},{height:.3f},0.01,0.01"
        for name, (latitude, longitude, height) in zip(
            model.image_names, frame.geodetic_from_enu(places).tolist(), strict=True
        )
    ]
    table = tmp_path / "gps.csv"
    table.write_text("\n".join(["image,latitude,longitude,height,sigma,sigma_up", *rows]) + "\n")
    before = model_bytes(copy)
    run(photos, copy, load_options(settings=[f"gps.source={table}"]))
    found = read_georeference(copy)
    assert found is not None
    place = found.place_of(0)
    assert place is not None
    spread = np.linalg.norm(places - places.mean(0), axis=1).max()
    assert place.scale == pytest.approx(10.0, abs=10.0 * (5 * place.scale_sigma_share + 0.02 / spread))
    moved = read_model(copy / "sparse" / "0")[0].centers
    np.testing.assert_allclose(frame.enu_from_geodetic(found.frame.geodetic_from_enu(moved)), places, rtol=0, atol=0.06)
    report = json.loads((copy / "report.json").read_text())
    check_schema("reconstruct", report)
    assert report["stages"]["georeference"]["models"][0]["num_used"] == 7
    assert "North is up" in (copy / "report.html").read_text()
    run(photos, copy)
    assert read_georeference(copy) is None
    assert model_bytes(copy) == before
