"""Plans: what is counted beforehand against the run that follows, and photographs that were made bad on purpose."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfmapp
from sfmapp.cli.main import main
from sfmapp.errors import NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.features.octaves import bytes_of_scale_space
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.pixels import read_gray
from sfmapp.images.quality import picture_quality
from sfmapp.images.small import read_small_gray
from sfmapp.pipelines.planning import machine
from sfmapp.pipelines.planning.costs import num_parts
from sfmapp.pipelines.planning.links import Links, find_links
from sfmapp.pipelines.planning.look import look_at_all
from sfmapp.pipelines.planning.trial import choose_images
from sfmapp.report.model import ReconstructionReport
from sfmapp.report.plan import WHOLE, Doubt, Interval, PlanCheck, PlanReport
from sfmapp.reporting import Usage, from_plain, plain
from sfmapp.workspace import user_cache


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own for each test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def measured(reconstructed: Path) -> machine.Machine:
    """A machine, by an earlier run of seven photographs."""
    report = from_plain(ReconstructionReport, json.loads((reconstructed / "report.json").read_text()))
    return machine.machine_of(report, 0.0)


@pytest.fixture
def known(measured: machine.Machine, monkeypatch: pytest.MonkeyPatch) -> machine.Machine:
    """The machine is known and need not be measured."""
    monkeypatch.setattr("sfmapp.pipelines.planning.plan.known_machine", lambda events: measured)
    return measured


@pytest.fixture(scope="module")
def planned(photos: Path, measured: machine.Machine, tmp_path_factory: pytest.TempPathFactory) -> PlanReport:
    """The plan of seven photographs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr("sfmapp.pipelines.planning.plan.known_machine", lambda events: measured)
        return sfmapp.plan(photos)


def warnings(plan: PlanReport) -> list[Doubt]:
    return [doubt for doubt in plan.doubts if doubt.weight == "warning"]


# ------------------------------------------------------------------------------------------------- beside the run


def test_the_run_that_follows_finds_its_plan_and_what_was_counted_in_it(
    photos: Path, known: machine.Machine, tmp_path: Path
) -> None:
    plan = sfmapp.plan(photos)
    report = sfmapp.reconstruct(photos, tmp_path / "out", record=False).report
    assert report is not None
    assert report.stages.matching is not None
    assert report.stages.features is not None
    assert plan.num_pairs == report.stages.matching.num_pairs == 21
    assert plan.num_features.low <= report.stages.features.num_features <= plan.num_features.high
    assert plan.num_matches.low <= report.stages.matching.num_matches <= plan.num_matches.high
    assert plan.num_observations.low <= report.models[0].num_observations <= plan.num_observations.high
    assert plan.num_overlapping.low <= report.stages.matching.num_verified_pairs <= plan.num_overlapping.high
    written = sum(path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file()) / 1e6
    assert 0.5 * plan.disk_mb.likely < written < 1.3 * plan.disk_mb.likely
    assert report.plan is not None
    assert {row.stage for row in report.plan.rows} >= {"features", "matching", "mapping", WHOLE}
    assert "Planned and taken" in (tmp_path / "out" / "report.html").read_text()
    # another number of threads is another run, and one that goes on with what is there is not held against a plan
    assert sfmapp.reconstruct(photos, tmp_path / "one", record=False, threads=1).report.plan is None  # type: ignore[union-attr]
    resumed = sfmapp.load_options([], ["mapping.min_model_images=4"])
    again = sfmapp.reconstruct(photos, tmp_path / "out", resumed, record=False).report
    assert again is not None
    assert again.plan is None


def test_more_of_everything_costs_more(photos: Path, planned: PlanReport, known: machine.Machine) -> None:
    plan = planned
    fewer = sfmapp.plan(photos, sfmapp.load_options([], ["features.max_num_features=1000"]), mesh=True)
    assert fewer.num_features.likely <= 7000 < plan.num_features.likely
    assert fewer.disk_mb.likely < 0.5 * plan.disk_mb.likely
    for stage in (*plan.stages, plan.whole):
        for interval in (stage.cpu_s, stage.wall_s, stage.memory_mb):
            assert 0.0 <= interval.low <= interval.likely <= interval.high
        assert stage.wall_s.likely <= stage.cpu_s.likely + 1e-9
    assert plan.whole.memory_mb.likely == max(stage.memory_mb.likely for stage in plan.stages)
    assert plan.whole.cpu_s.likely >= sum(stage.cpu_s.likely for stage in plan.stages)
    assert [stage.stage for stage in fewer.surface] == ["dense", "mesh"]
    assert plan.surface == []


def test_memory_follows_the_size_of_photographs_and_the_workers(photos: Path, known: machine.Machine) -> None:
    one, two = (sfmapp.plan(photos, threads=n) for n in (1, 2))
    image = cv2.imread(str(sorted(photos.iterdir())[0]))
    need = (5 * image.shape[0] * image.shape[1] + bytes_of_scale_space(*image.shape[:2])) / 1e6
    features = [next(s.memory_mb.likely for s in plan.stages if s.stage == "features") for plan in (one, two)]
    assert features[1] - features[0] == pytest.approx(need, rel=1e-6)


# ---------------------------------------------------------------------------------------- what will probably go wrong


def test_good_photographs_raise_no_warning(planned: PlanReport) -> None:
    assert warnings(planned) == []
    assert planned.groups == [7]
    assert [doubt.subject for doubt in planned.doubts if doubt.subject != "machine"] == ["focal length"]


def test_bad_photographs_are_named_each_with_what_is_wrong(
    photos: Path, known: machine.Machine, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    shutil.copytree(photos, folder)
    original = sorted(photos.iterdir())[3]
    image = cv2.imread(str(original))
    shutil.copy(original, folder / "same.png")
    made = {
        "blurred.png": cv2.GaussianBlur(image, (0, 0), 2.0),
        "shaken.png": cv2.blur(image, (11, 1)),
        "burnt.png": cv2.convertScaleAbs(image, alpha=6.0),
        "dark.png": cv2.convertScaleAbs(image, alpha=0.02),
        "again.jpg": image,
        "thumbnail.png": cv2.resize(image, None, fx=0.4, fy=0.4),
        "cap.png": np.full_like(image, 7),
    }
    for name, pixels in made.items():
        cv2.imwrite(str(folder / name), pixels)
    (folder / "broken.jpg").write_bytes((folder / "again.jpg").read_bytes()[:2000])
    found = warnings(sfmapp.plan(folder))

    def named(subject: str, word: str = "") -> set[str]:
        return {name for each in found if each.subject == subject and word in each.message for name in each.names}

    assert named("blur") == {"blurred.png", "shaken.png"}
    assert named("exposure", "burnt out") == {"burnt.png"}
    assert named("exposure", "dark") == {"dark.png"}
    assert named("copies", "the same file") == {original.name, "same.png"}
    assert named("copies", "from the same place") == {original.name, "same.png", "again.jpg", "thumbnail.png"}
    assert named("size") == {"thumbnail.png"}
    assert "cap.png" in named("texture")
    assert named("files") == {"broken.jpg"}


def textured(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return sum(
        cv2.resize(rng.integers(0, 256 // 4, (300 >> n, 400 >> n)).astype(np.uint8), (1600, 1200)) for n in range(4)
    )


def test_another_place_among_photographs_is_named(photos: Path, known: machine.Machine, tmp_path: Path) -> None:
    folder = tmp_path / "two"
    shutil.copytree(photos, folder)
    place = textured(3)
    for n in range(3):
        cv2.imwrite(str(folder / f"wall_{n}.png"), place[40 * n : 40 * n + 300, 60 * n : 60 * n + 400])
    plan = sfmapp.plan(folder)
    assert plan.groups == [7, 3]
    (found,) = [doubt for doubt in warnings(plan) if doubt.subject == "overlap"]
    assert found.names == ["wall_0.png", "wall_1.png", "wall_2.png"]
    cv2.imwrite(str(folder / "alone.png"), textured(4)[:300, :400])
    alone = [doubt.names for doubt in warnings(sfmapp.plan(folder)) if doubt.subject == "overlap"]
    assert alone == [["wall_0.png", "wall_1.png", "wall_2.png"], ["alone.png"]]


def test_memory_and_disk_that_are_not_there_are_told(
    photos: Path, known: machine.Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sfmapp.pipelines.planning.plan._memory_mb", lambda: 100.0)
    monkeypatch.setattr("sfmapp.pipelines.planning.plan._free_disk_mb", lambda: 1.0)
    found = {doubt.subject: doubt.remedy for doubt in warnings(sfmapp.plan(photos))}
    assert "--threads 1" in found["memory"]
    assert "disk" in found


@pytest.mark.real
@pytest.mark.parametrize("name", ["fountain-P11", "strecha-courtyard-21", "nerf-lego-small"])
def test_good_sets_raise_no_warning(name: str, data_root: Path, known: machine.Machine) -> None:
    assert warnings(sfmapp.plan(data_root / name / "images")) == []


@pytest.mark.real
def test_the_one_place_that_the_temple_was_photographed_from_twice_is_told(
    data_root: Path, known: machine.Machine
) -> None:
    """Its first and its eleventh view are a tenth of a pixel apart, by 500 features."""
    (found,) = warnings(sfmapp.plan(data_root / "temple-sparse-ring" / "images"))
    assert found.subject == "copies"
    assert found.names == ["templeSR0001.png", "templeSR0011.png"]


@pytest.mark.real
def test_two_places_in_one_folder_are_told_apart(data_root: Path, known: machine.Machine, tmp_path: Path) -> None:
    names: dict[str, list[str]] = {}
    for place in ("fountain-P11", "herz-jesus-P8"):
        for path in sorted((data_root / place / "images").iterdir()):
            (tmp_path / f"{place}_{path.name}").symlink_to(path)
            names.setdefault(place, []).append(f"{place}_{path.name}")
    plan = sfmapp.plan(str(tmp_path / "*.jpg"))
    (found,) = [doubt for doubt in warnings(plan) if doubt.subject == "overlap"]
    assert list(found.names) == names["herz-jesus-P8"]


# -------------------------------------------------------------------------------------------------------- the command


def test_the_command_prints_a_plan_in_words_and_as_json(
    photos: Path, known: machine.Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", str(photos)]) == 0
    text = capsys.readouterr().out
    for word in ("7 photographs", "21 pairs", "features", "mapping", WHOLE, "nothing was found that will go wrong"):
        assert word in text
    assert main(["plan", str(photos), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed.pop("exit_code") == 0
    assert from_plain(PlanReport, printed).num_pairs == 21


def test_one_photograph_is_no_set(photos: Path, known: machine.Machine) -> None:
    with pytest.raises(NoReconstructionError, match="at least two"):
        sfmapp.plan(str(photos / "*01.png"))


def test_a_video_is_no_set_of_photographs() -> None:
    with pytest.raises(UsageError, match=r"walk\.mp4 is a video"):
        sfmapp.plan("walk.mp4")


def test_the_machine_is_measured_once_and_again_when_it_was_busy(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sample").mkdir()
    (tmp_path / "sample" / "images").symlink_to(photos)
    monkeypatch.setattr(machine, "sample_folder", lambda: tmp_path / "sample")
    monkeypatch.setattr(machine, "load", lambda: 100.0)
    first = machine.known_machine(Events())
    assert first.is_busy
    assert first.num_images == 7
    assert first.run.cpu_s > sum(first.usage[stage].cpu_s for stage in ("features", "matching", "mapping"))
    monkeypatch.setattr(machine, "_measure", lambda events: replace(first, load=0.0))
    assert machine.known_machine(Events()).load == 100.0  # it is as busy as it was
    monkeypatch.setattr(machine, "load", lambda: 0.0)
    assert machine.known_machine(Events()).load == 0.0
    monkeypatch.setattr(machine, "_measure", lambda events: pytest.fail("it is known"))
    assert machine.known_machine(Events()).load == 0.0


# ---------------------------------------------------------------------------------------------------------- the parts


def usage(cpu_s: float, wall_s: float = 1.0, memory_mb: float = 100.0) -> Usage:
    return Usage(wall_s=wall_s, cpu_s=cpu_s, peak_memory_mb=memory_mb)


def test_a_run_says_in_words_whether_its_plan_was_right(planned: PlanReport) -> None:
    plan = planned
    right = usage(plan.whole.cpu_s.likely, plan.whole.wall_s.likely, plan.whole.memory_mb.likely)
    stages = {stage.stage: usage(stage.cpu_s.likely) for stage in plan.stages}
    check = PlanCheck.of(plan, stages, right)
    assert check.sentence.endswith("The plan was right.")
    assert all(row.is_within for row in check.rows)
    late = PlanCheck.of(plan, stages, replace(right, wall_s=10.0 * plan.whole.wall_s.high))
    assert "other things to do" in late.sentence
    extra = 3.0 * plan.whole.cpu_s.high
    more = stages | {"mapping": usage(stages["mapping"].cpu_s + extra)}
    wrong = PlanCheck.of(plan, more, replace(right, cpu_s=right.cpu_s + extra))
    assert "The plan was wrong: CPU time is" in wrong.sentence
    assert "most of it in mapping" in wrong.sentence
    less = PlanCheck.of(plan, stages, replace(right, peak_memory_mb=0.1 * plan.whole.memory_mb.low))
    assert "memory is 90 % below what was planned" in less.sentence
    assert plain(from_plain(PlanCheck, plain(less))) == plain(less)


def test_intervals_read_as_people_say_them() -> None:
    assert Interval.about(50.0, 0.2).text("s") == "40 to 60 s"
    assert Interval.about(1234.0, 0.0).text("MB") == "1230 MB"
    assert Interval(4.0, 99.6, 56143.0).text("features") == "4 to 56100 features"
    assert Interval.about(10.0, 0.5, 2.0) == Interval(5.0, 10.0, 30.0)
    assert Interval(1.0, 2.0, 3.0).holds(3.0)
    assert not Interval(1.0, 2.0, 3.0).holds(3.1)


def links_of(num_matches: dict[tuple[int, int], int]) -> Links:
    pairs = np.array(list(num_matches), np.int32).reshape(-1, 2)
    counts = np.array(list(num_matches.values()), np.int64)
    return Links(pairs, counts, counts, np.zeros(len(pairs), np.int8), len(pairs))


def test_groups_are_what_links_hold_together() -> None:
    links = links_of({(0, 1): 30, (1, 2): 20, (3, 4): 50, (0, 3): 0, (2, 4): 0})
    assert links.groups(6) == [[0, 1, 2], [3, 4], [5]]
    assert links.degrees(6).tolist() == [1, 2, 1, 1, 1, 0]
    assert links.with_found([(2, 4)]).groups(6) == [[0, 1, 2, 3, 4], [5]]


def test_parts_hold_together_loosely() -> None:
    inside = {(i, j): 200 for part in (0, 3) for i in range(part, part + 3) for j in range(i + 1, part + 3)}
    assert num_parts(links_of(inside | {(2, 3): 12}), 6) == 2
    assert num_parts(links_of(inside | {(2, 3): 60}), 6) == 1


def test_images_are_chosen_for_both_kinds_of_pairs() -> None:
    links = links_of({(0, 1): 30, (0, 2): 60, (1, 2): 20, (0, 3): 0, (1, 3): 0, (2, 3): 0})
    assert choose_images(links, 4, 3) == [0, 2, 3]
    assert choose_images(links, 4, 2, [(1, 3)]) == [0, 1, 2, 3]
    assert choose_images(links, 4, 10) == [0, 1, 2, 3]


def test_blur_grows_with_the_blur_and_exposure_is_counted() -> None:
    image = textured(1)[:600, :800]
    scores = [picture_quality(cv2.GaussianBlur(image, (0, 0), s) if s else image).blur for s in (0, 1.0, 2.0, 4.0)]
    assert scores == sorted(scores)
    assert scores[-1] > scores[0] + 0.1
    shaken = picture_quality(cv2.blur(image, (1, 15)))
    assert shaken.blur > scores[0] + 0.1
    half = np.full((100, 100), 128, np.uint8)
    half[:30], half[30:50] = 255, 0
    assert picture_quality(half)[1:] == (0.3, 0.2)
    assert np.isnan(picture_quality(np.full((64, 64), 9, np.uint8)).blur)


@pytest.mark.parametrize("ending", ["jpg", "png"])
def test_a_small_version_shows_what_the_whole_shows(ending: str, tmp_path: Path) -> None:
    gradient = np.add.outer(np.linspace(20, 120, 900), np.linspace(0, 100, 1200)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / f"a.{ending}"), cv2.cvtColor(gradient, cv2.COLOR_GRAY2BGR))
    (record,) = load_images(str(tmp_path), ImageOptions(), Events())[0].images
    small = read_small_gray(record, 300)
    assert small.shape == (225, 300)
    assert np.abs(small.astype(int) - cv2.resize(gradient, (300, 225), interpolation=cv2.INTER_AREA)).max() <= 3
    assert np.array_equal(read_small_gray(record, 5000), read_gray(record))


def test_the_cache_forgets_what_is_damaged_and_what_is_old(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    user_cache.remember("facts", "a", usage(1.5))
    assert user_cache.recall("facts", "a", Usage) == usage(1.5)
    assert user_cache.recall("facts", "b", Usage) is None
    (cache / "sfmapp" / "facts" / "a.json").write_text('{"cpu_s": "many"}')
    assert user_cache.recall("facts", "a", Usage) is None
    monkeypatch.setattr(user_cache, "_MOST", 3)
    for n in range(6):
        user_cache.remember("facts", f"n{n}", usage(float(n)))
    assert len(list((cache / "sfmapp" / "facts").glob("*.json"))) == 3
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/nowhere")
    user_cache.remember("facts", "a", usage(1.0))
    assert user_cache.recall("facts", "a", Usage) is None


def test_of_many_pairs_a_part_tells_and_all_of_photographs_that_it_leaves_alone(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image_set = load_images(str(photos), ImageOptions(), Events())[0]
    features = [look.features for look in look_at_all(image_set.images, threads=2, events=Events())]
    pairs = np.array([(i, j) for i in range(7) for j in range(i + 1, 7)], np.int32)
    every = find_links(image_set, features, pairs, seed=0, threads=2, events=Events())
    assert every.scale == 1.0
    monkeypatch.setattr("sfmapp.pipelines.planning.links._MOST_COMPARED", 5)
    for seed in range(3):
        some = find_links(image_set, features, pairs, seed=seed, threads=1, events=Events())
        assert 5 <= len(some.pairs) <= 21
        assert some.num_all == 21
        assert len({(i, j) for i, j in some.pairs.tolist()}) == len(some.pairs)
        assert some.groups(7) == every.groups(7)
