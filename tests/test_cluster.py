"""Features and matches by workers: the same bytes whoever works and whoever is lost, and a name for what goes wrong."""

from __future__ import annotations

import multiprocessing
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import sfmapp
from dense_models import write_wall
from sfmapp.cluster.address import num_local
from sfmapp.cluster.worker import WorkerError, do_unit, facts, why_unfit
from sfmapp.dense import clusters
from sfmapp.dense.options import DenseOptions
from sfmapp.errors import InputError, InterruptedRunError, UsageError
from sfmapp.events import Event, Events
from sfmapp.executor import Threads
from sfmapp.formats.feature_files import feature_file, read_feature_file, write_feature_file
from sfmapp.matching import stage
from sfmapp.pipelines.dense.densify import dense
from sfmapp.scene.features import DescriptorMetric, Features
from sfmapp.workspace.options import Options

dask_executor = pytest.importorskip("sfmapp.cluster.dask_executor", reason="dask.distributed is not installed")


def workers() -> list[multiprocessing.process.BaseProcess]:
    """Processes that units are done in."""
    return [child for child in multiprocessing.active_children() if "Dask Worker" in child.name]


def kill_one() -> None:
    child = min(workers(), key=lambda child: child.pid or 0)
    child.kill()


def test_workers_that_are_killed_change_no_byte(
    photos: Path, reconstructed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage, "_BLOCK", 3)
    heard: list[Event] = []
    killed: set[str] = set()

    def listen(event: Event) -> None:
        heard.append(event)
        if event.kind == "advanced" and event.stage in ("features", "matching") and event.stage not in killed:
            killed.add(event.stage)
            kill_one()

    options = replace(sfmapp.load_options(), cluster="local:2")
    sfmapp.reconstruct(photos, tmp_path / "out", options, events=Events(listen), record=False)
    assert killed == {"features", "matching"}
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        ours, threads = tmp_path / "out" / "sparse" / "0" / name, reconstructed / "sparse" / "0" / name
        assert ours.read_bytes() == threads.read_bytes(), name
    assert any("is lost" in event.message for event in heard if event.stage == "cluster")
    assert not list((tmp_path / "out").glob(".cluster-*"))
    assert not workers()
    # what is done is not done again, and no worker is started for it
    again: list[Event] = []
    sfmapp.reconstruct(photos, tmp_path / "out", options, events=Events(again.append), record=False)
    assert not any(event.stage == "cluster" for event in again)


@pytest.fixture(scope="module")
def client() -> Iterator[object]:
    """One worker, in a thread of this process."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, worker_dashboard_address=None
        ) as local,
        Client(local, set_as_default=False) as found,
    ):
        yield found


def executor_over(client: object, folder: Path, events: Events, *paths: str) -> dask_executor.DaskExecutor:
    return dask_executor.DaskExecutor(lambda: client, folder, (str(folder), *paths), events)


def square(number: int) -> int:
    return number * number


def fail(number: int) -> int:
    if number == 3:
        raise InputError("number 3 is bad", "take another")
    return number


def test_units_come_home_with_their_positions(client: object, tmp_path: Path) -> None:
    executor = executor_over(client, tmp_path, Events())
    assert dict(executor.run(square, range(20))) == dict(Threads(3).run(square, range(20)))
    assert list(executor.run(square, [])) == []


def test_a_failure_comes_home_whole(client: object, tmp_path: Path) -> None:
    for executor in (executor_over(client, tmp_path, Events()), Threads(2)):
        with pytest.raises(InputError, match="number 3 is bad") as caught:
            list(executor.run(fail, range(6)))
        assert caught.value.advice == "take another"


def test_a_worker_that_does_not_see_the_files_is_named_and_given_nothing(client: object, tmp_path: Path) -> None:
    heard: list[Event] = []
    events = Events(heard.append)
    executor = executor_over(client, tmp_path, events, "/not/there")
    threading.Timer(0.5, events.cancel).start()
    with pytest.raises(InterruptedRunError):
        list(executor.run(square, range(3)))
    warnings = [event.message for event in heard if event.kind == "warned"]
    assert "does not see /not/there" in warnings[0]
    assert "waiting" in warnings[1]


def test_workers_with_other_code_are_unfit() -> None:
    own = facts(("/",))
    assert own.seen == ("/",)
    assert why_unfit(own, own, ("/",)) == ""
    assert "does not see" in why_unfit(own, replace(own, seen=()), ("/",))
    assert "numba 0.1" in why_unfit(own, replace(own, versions={**own.versions, "numba": "0.1"}), ("/",))
    assert "sfmapp 0.0" in why_unfit(own, replace(own, versions={**own.versions, "sfmapp": "0.0"}), ("/",))
    assert "is another" in why_unfit(own, replace(own, code="0"), ("/",))


def test_a_unit_without_memory_says_where() -> None:
    def too_much(_: int) -> int:
        raise MemoryError

    with pytest.raises(WorkerError, match="ran out of memory"):
        do_unit(too_much, 0)


def test_nobody_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_executor, "_ANSWER_S", 0.5)
    with (
        pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9"),
        dask_executor.open_cluster("tcp://127.0.0.1:9", tmp_path, [], Events()) as executor,
    ):
        list(executor.run(square, [1]))
    assert not list(tmp_path.iterdir())


def test_a_unit_that_ends_its_workers_is_named() -> None:
    from distributed import KilledWorker

    class Job:
        def result(self, timeout: float) -> None:
            raise KilledWorker("unit", SimpleNamespace(address="tls://127.0.0.1:1234"), 3)  # type: ignore[arg-type]

    with pytest.raises(WorkerError, match=r"4 workers were lost over one unit of work, tls://127\.0\.0\.1:1234 last"):
        dask_executor._result(Job())


def test_clusters_of_views_are_the_same_patches_by_workers(
    client: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_wall(tmp_path)
    monkeypatch.setattr(clusters, "BASE_MB", 498.8)  # so that two or three of these small views fit
    monkeypatch.setattr(dask_executor, "_client", lambda *_: client)
    options = Options(dense=DenseOptions(cell_px=2, max_neighbors=2, max_memory_mb=500), threads=1)
    files = []
    for name, address in (("threads", None), ("workers", "local:1")):
        chosen, images = replace(options, cluster=address), tmp_path / "images"
        result = dense(tmp_path / "sparse" / "0", tmp_path / name, chosen, images=images, record=False)
        assert len(result.report["clusters"]) >= 2
        files.append((tmp_path / name / "dense" / "patches.npz").read_bytes())
    assert files[0] == files[1]
    assert not list((tmp_path / "workers").glob(".cluster-*"))


@pytest.mark.parametrize("address", ["local", "local:0", "local:1000", "http://a:1", "tcp://a", "tcp://a:b", "a:1"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="cluster"):
        replace(sfmapp.load_options(), cluster=address)


def test_addresses() -> None:
    assert num_local("local:4") == 4
    assert num_local("tcp://10.0.0.1:8786") is None
    assert num_local("tls://scheduler.example:8786") is None


def test_photographs_in_memory_are_refused(tmp_path: Path) -> None:
    pictures = {f"{n}.png": np.full((64, 64), 40 * n, np.uint8) for n in range(3)}
    with pytest.raises(UsageError, match="in memory"):
        sfmapp.reconstruct(pictures, tmp_path / "out", replace(sfmapp.load_options(), cluster="local:1"), record=False)


def test_feature_files_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    features = Features(
        rng.random((7, 4), np.float32), rng.integers(0, 255, (7, 32), np.uint8), rng.integers(0, 255, (7, 3), np.uint8),
        DescriptorMetric.HAMMING,
    )  # fmt: skip
    path = feature_file(tmp_path, "a/../b\udcff.jpg")
    assert path.parent == tmp_path
    write_feature_file(path, features)
    found = read_feature_file(path)
    assert found.metric is features.metric
    assert found.is_dark is None
    for name in ("keypoints", "descriptors", "rgb"):
        np.testing.assert_array_equal(getattr(found, name), getattr(features, name))
    write_feature_file(path, replace(features, is_dark=features.rgb[:, 0] < 100))
    np.testing.assert_array_equal(read_feature_file(path).is_dark, features.rgb[:, 0] < 100)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="expected the features"):
        read_feature_file(path)
    shutil.copy(__file__, path)
    with pytest.raises(InputError, match="expected the features"):
        read_feature_file(path)


def test_pairs_that_follow_one_another_have_images_in_common() -> None:
    place = np.random.default_rng(0).permutation(200)  # along a street, whose photographs have names by chance
    pairs = [
        (i, j) for i in range(200) for j in range(i + 1, 200) if abs(int(place[i]) - int(place[j])) <= 8
    ]  # fmt: skip

    def num_images(ordered: list[tuple[int, int]]) -> float:
        blocks = [ordered[start : start + 64] for start in range(0, len(ordered), 64)]
        return float(np.mean([len({i for pair in block for i in pair}) for block in blocks]))

    ordered = stage._by_squares(pairs, 200, is_sparse=True)
    assert sorted(ordered) == pairs
    assert num_images(pairs) > 45
    assert num_images(ordered) < 20


def test_threads_drop_what_has_not_begun_when_closed() -> None:
    begun: list[int] = []

    def work(number: int) -> int:
        begun.append(number)
        time.sleep(0.01)
        return number

    with closing(Threads(2).run(work, range(100))) as results:
        next(results)
    assert len(begun) < 50


def test_a_budget_lets_one_large_unit_through_alone() -> None:
    lock, most = threading.Lock(), []
    together: list[int] = []

    def work(need: int) -> None:
        with lock:
            together.append(need)
            most.append(sum(min(each, 100) for each in together))
        time.sleep(0.01)
        with lock:
            together.remove(need)

    needs = [60, 60, 500, 30, 10, 100, 40]
    list(Threads(7, budget_bytes=100).run(work, needs, bytes_needed=needs))
    assert 60 < max(most) <= 100
