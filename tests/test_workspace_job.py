"""The shell that commands run in: a new command needs no more than the block."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from sfmapp.errors import InputError, InterruptedRunError, UsageError
from sfmapp.events import Event, Events
from sfmapp.images.image_set import ImageOptions
from sfmapp.workspace.job import Job
from sfmapp.workspace.options import Options
from sfmapp.workspace.workspace import open_workspace


@dataclass(kw_only=True)
class Weighing(Job):
    """A command of its own, with something of its own."""

    scale: float


def weigh(source: Path, output: Path, events: Events | None = None, options: Options | None = None) -> float:
    with Weighing.opened("weigh", source, output, options, events=events, scale=2.0) as job:
        job.note_inputs({"stone": "abc"})
        with job.stage("weighing", "key"):
            job.events.decided("weighing", "heavy")
        job.workspace.save()
        return job.scale


def lines_of(output: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (output / "log.jsonl").read_text(encoding="utf-8").splitlines()]


def test_a_command_is_a_block(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert weigh(tmp_path / "stones", out) == 2.0
    manifest = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert manifest["command"] == "weigh"
    assert manifest["source"] == str(tmp_path / "stones")
    assert manifest["inputs"] == {"stone": "abc"}
    stage = manifest["stages"]["weighing"]
    assert stage["key"] == "key"
    assert stage["is_done"]
    assert stage["wall_s"] >= 0
    assert [line["kind"] for line in lines_of(out)] == ["run", "decided"]
    with pytest.raises(UsageError, match="results of sfmapp weigh"), Job.opened("measure", tmp_path, out, None):
        pass


def test_the_workspace_is_locked_and_sums_are_of_one_thread(tmp_path: Path) -> None:
    assert np.ones((2, 2)).sum() == 4  # the library of linear algebra is loaded
    with threadpool_limits(2, "blas"):
        before = [library["num_threads"] for library in threadpool_info()]
        assert 2 in before
        with Job.opened("weigh", tmp_path, tmp_path / "out", None) as job:
            assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == {1}
            with pytest.raises(UsageError, match="is running"), open_workspace(tmp_path / "out", "weigh"):
                pass
            assert job.threads == job.options.num_workers
        assert [library["num_threads"] for library in threadpool_info()] == before
    assert not (tmp_path / "out" / ".lock").exists()


def test_paths_of_options_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    options = Options(images=ImageOptions(mask_path="masks"))
    with Job.opened("weigh", "stones", "out", options) as job:
        assert job.options.images.mask_path == str(tmp_path / "masks")
        assert job.workspace.folder == Path("out")


def test_listeners_end_with_the_job(tmp_path: Path) -> None:
    heard: list[str] = []
    events = Events(lambda event: heard.append(f"outside {event.message}"))
    with Job.opened("weigh", tmp_path, tmp_path / "out", None, events=events) as job:
        job.listen(lambda event: heard.append(f"last {event.message}"))
        job.listen(lambda event: heard.append(f"first {event.message}"), first=True)
        job.listen(None)
        # those without cancellation are heard as well, and end as well
        events.without_cancellation().warned("weighing", "one")
        log = job.log
    events.warned("weighing", "two")
    assert heard == ["first one", "outside one", "last one", "outside two"]
    assert [entry["message"] for entry in log.warnings] == ["one"]
    assert [line.get("message") for line in lines_of(tmp_path / "out")] == [None, "one"]


@pytest.mark.parametrize("error", [InputError("no stone"), ZeroDivisionError("a bug")])
def test_what_ends_a_command_is_logged_and_passed_on(tmp_path: Path, error: Exception) -> None:
    def bad(event: Event) -> None:
        raise error

    with pytest.raises(type(error)):
        weigh(tmp_path, tmp_path / "out", Events(bad))
    last = lines_of(tmp_path / "out")[-1]
    assert (last["kind"], last["error"]) == ("raised", type(error).__name__)
    assert "Traceback" in str(last["traceback"])
    assert not json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["stages"]["weighing"]["is_done"]
    assert weigh(tmp_path, tmp_path / "out") == 2.0


def test_a_wish_to_stop_is_obeyed_at_the_next_step(tmp_path: Path) -> None:
    events = Events()
    events.cancel()
    with pytest.raises(InterruptedRunError):
        weigh(tmp_path, tmp_path / "out", events)
    assert json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["stages"] == {}


def test_a_log_that_cannot_be_written_is_told_in_the_report(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with open_workspace(tmp_path / "out", "weigh"):
        pass
    (tmp_path / "out" / "log.jsonl").mkdir()
    with Job.opened("weigh", tmp_path, tmp_path / "out", None) as job:
        pass
    assert "the run goes on without it" in str(job.log.warnings[0]["message"])


def test_linear_algebra_that_is_loaded_later_keeps_to_one_thread_too():
    """In a fresh process, whose scipy brings a BLAS of its own when it is first imported."""
    code = (
        "from sfmapp.adjust.linear import one_blas_thread\n"
        "with one_blas_thread():\n"
        "    import numpy, scipy.linalg, threadpoolctl\n"
        "    print([library['num_threads'] for library in threadpoolctl.threadpool_info()])\n"
    )
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    numbers = json.loads(ran.stdout)
    assert numbers
    assert set(numbers) == {1}
