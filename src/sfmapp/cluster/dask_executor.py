"""Units of work done by the workers of dask.distributed, on this machine or on many.

The workers share a folder with the run: arrays go through files in it, and what is sent are names and small results.
Only workers that have been looked at are given units: those that see the files, with the same source and libraries as
this process. Whoever is lost is replaced by another: dask does its units again, and the result is the same bytes.

The source of the ways of dask: Rocklin, Dask: Parallel Computation with Blocked algorithms and Task Scheduling, 2015,
and https://distributed.dask.org/en/stable/resilience.html.
"""

from __future__ import annotations

import logging
import queue
import secrets
import shutil
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from distributed import Client, KilledWorker, LocalCluster
from distributed.comm import CommClosedError

from sfmapp.cluster.address import ADVICE, num_local
from sfmapp.cluster.worker import Facts, WorkerError, do_unit, facts, why_unfit
from sfmapp.errors import InputError
from sfmapp.events import Events

Unit = TypeVar("Unit")
Result = TypeVar("Result")
Other = TypeVar("Other")

STAGE = "cluster"
# How often workers are looked for, and how long a scheduler, or the bearer of a result, may take to answer.
_LOOK_S, _ANSWER_S = 2.0, 20.0
# Units at the workers for each of their threads: none idles between two messages.
_AHEAD = 2
# A result that was lost with its worker before it came here.
_LOST = (TimeoutError, CancelledError, CommClosedError)


class LostWorkersError(WorkerError):
    """One worker after another was lost while it had a unit of work."""


@contextmanager
def open_cluster(address: str, workspace: Path, paths: Sequence[Path], events: Events) -> Iterator[DaskExecutor]:
    """Workers for one run, until the end of the block; the first units that there are start them, or look for them.

    Args:
        address: ``local:N`` for N processes of this machine that listen on its loopback alone, and to one another
            alone, or of a scheduler.
        workspace: folder of the run; the folder that is shared is made in it, and removed at the end.
        paths: what workers have to see beside it.
        events: told which workers there are, and asked whether to stop.

    Raises:
        UsageError: no such address.
    """
    num = num_local(address)
    folder = workspace.absolute() / f".cluster-{secrets.token_hex(8)}"
    folder.mkdir()
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        yield DaskExecutor(
            lambda: _client(stack, address, num), folder, tuple(str(path) for path in (folder, *paths)), events
        )


def _client(stack: ExitStack, address: str, num_local: int | None) -> Client:
    """A client, and where they are local its workers, until the end of the stack."""
    where: str | LocalCluster = address
    if num_local is not None:
        # without its dashboard, a server that nobody asked for; with TLS by keys that only these processes have, as
        # loopback is open to all users of a machine, and who may send units may run anything
        quiet = {"dashboard_address": None, "worker_dashboard_address": None, "silence_logs": logging.CRITICAL}
        where = stack.enter_context(
            LocalCluster(
                n_workers=num_local, threads_per_worker=1, processes=True, host="127.0.0.1", security=True, **quiet
            )
        )
    try:
        return stack.enter_context(Client(where, timeout=_ANSWER_S, set_as_default=False))
    except OSError as error:  # among them TimeoutError
        raise InputError(f"{address}: no scheduler of dask answers there: {error}", ADVICE) from error


class DaskExecutor:
    """An :class:`~sfmapp.executor.Executor` over a client of dask; :func:`open_cluster` makes one.

    Attributes:
        folder: where units hand arrays to one another.
    """

    folder: Path | None

    def __init__(
        self, connect: Callable[[], Client], folder: Path, paths: tuple[str, ...], events: Events
    ) -> None:  # fmt: skip
        self.folder = folder
        self._connect, self._paths, self._events = connect, paths, events
        self._own = facts(paths)
        self._judged: dict[str, bool] = {}  # workers by address, and whether they are given work
        self._fit: dict[str, int] = {}  # those that are there and fit, and their threads
        self._looked_s = -_LOOK_S
        self._is_waiting = False

    def run(
        self, work: Callable[[Unit], Result], units: Sequence[Unit], *,
        bytes_needed: Sequence[int] | None = None, instead: Callable[[Exception], Other] | None = None,
    ) -> Generator[tuple[int, Result | Other], None, None]:  # fmt: skip
        """See :meth:`~sfmapp.executor.Executor.run`; how much memory a unit may take is for the workers to say.

        A unit that lost its workers may have been in the company of the one that ended them, and is tried again alone
        before something stands for its result.

        Raises:
            WorkerError: a worker's memory is too small for a unit, or units end their workers again and again.
            InterruptedRunError: a stop was asked for while there was nobody to work.
        """
        answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        jobs: dict[Any, tuple[int, frozenset[str]]] = {}
        waiting, blamed = deque(range(len(units))), deque[int]()
        num_left, is_alone = len(units), False
        try:
            while num_left:
                self._look_for_workers()
                if blamed and not waiting and not jobs:
                    waiting.append(blamed.popleft())
                    is_alone = True
                for job in [job for job, (_, workers) in jobs.items() if not workers & self._fit.keys()]:
                    waiting.appendleft(jobs.pop(job)[0])  # all that may do it are gone: it would wait for ever
                    job.cancel()
                while waiting and len(jobs) < _AHEAD * sum(self._fit.values()):
                    n, workers = waiting.popleft(), frozenset(self._fit)
                    job = self._client.submit(do_unit, work, units[n], workers=sorted(workers), pure=False)
                    jobs[job] = n, workers
                    job.add_done_callback(answers.put)
                job = _next(answers)
                if job not in jobs:
                    self._events.raise_if_cancelled()
                    continue
                n, _ = jobs.pop(job)
                result: Result | Other
                try:
                    result = _result(job)
                except _LOST:
                    waiting.appendleft(n)
                    continue
                except Exception as error:
                    if instead is None:
                        raise
                    if isinstance(error, LostWorkersError) and not is_alone:
                        blamed.append(n)
                        continue
                    result = instead(error)
                num_left -= 1
                yield n, result
        finally:
            if jobs:
                self._client.cancel(list(jobs))

    @cached_property
    def _client(self) -> Client:
        return self._connect()

    def _look_for_workers(self) -> None:
        """Which workers there are now; those that are new are looked at first."""
        now_s = time.monotonic()
        if now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        try:
            threads: dict[str, int] = self._client.nthreads()
        except OSError as error:
            raise WorkerError(
                f"the scheduler of the cluster is gone: {error}", "run the same command again to resume"
            ) from error
        new = sorted(threads.keys() - self._judged.keys())
        answers = self._client.run(facts, self._paths, workers=new, on_error="return") if new else {}
        for worker in new:
            answer = answers.get(worker)
            if isinstance(answer, CommClosedError) or answer is None:  # it has gone again
                continue
            problem = why_unfit(self._own, answer, self._paths) if isinstance(answer, Facts) else f"it fails: {answer}"
            self._judged[worker] = not problem
            where = f"{worker} on {answer.host}" if isinstance(answer, Facts) else worker
            if problem:
                self._events.warned(STAGE, f"worker {where} is given no work: {problem}", worker=worker)
            else:
                self._events.decided(STAGE, f"worker {where} works, {threads[worker]} units at a time", worker=worker)
        fit = {worker: threads[worker] for worker in threads if self._judged.get(worker)}
        for worker in self._fit.keys() - fit.keys():
            self._events.warned(STAGE, f"worker {worker} is lost; others do its work again", worker=worker)
        self._fit = fit
        if not fit and not self._is_waiting:
            self._events.warned(STAGE, "there is no worker to give work to: waiting for one")
        self._is_waiting = not fit


def _next(answers: queue.SimpleQueue[Any]) -> Any:
    """The next job that is done; None where none is before it is time to look about."""
    try:
        return answers.get(timeout=_LOOK_S)
    except queue.Empty:
        return None


def _result(job: Any) -> Any:
    """What a job that is done has brought; raises one of ``_LOST`` where it went with its worker."""
    try:
        return job.result(timeout=_ANSWER_S)
    except KilledWorker as error:
        raise LostWorkersError(
            f"{error.allowed_failures + 1} workers were lost over one unit of work, {error.last_worker.address} last",
            "the reason is in their logs; often it is memory: give workers more, or fewer threads each",
        ) from error
