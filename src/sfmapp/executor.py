"""Where units of work are done: in threads of this process, or by the workers of a cluster.

A unit is a pure function of what it is given: where it is done, in which order and how often, is in no result. A stage
cuts its work into units, hands them to an executor, and takes the results as they come.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, TypeVar

from sfmapp.errors import InterruptedRunError

Unit = TypeVar("Unit")
Result = TypeVar("Result")
Other = TypeVar("Other")


class Executor(Protocol):
    """Does units of work, several at a time."""

    @property
    def folder(self) -> Path | None:
        """Where units hand arrays to one another as files, seen by all workers; None: they share the memory."""
        ...

    def run(
        self, work: Callable[[Unit], Result], units: Sequence[Unit], *,
        bytes_needed: Sequence[int] | None = None, instead: Callable[[Exception], Other] | None = None,
    ) -> Generator[tuple[int, Result | Other], None, None]:  # fmt: skip
        """Do all units; results as they come, each with the position of its unit.

        Closing the iterator drops what has not begun and waits for what has.

        Args:
            work: done once for each unit or, where a worker is lost, more than once. Where there is a folder, a
                function of a module, or a partial of one, that can be sent to another process, as can the units.
            bytes_needed: of memory by each unit, to be kept within what there is.
            instead: makes what stands for the result of a unit that failed from what it raised; a stop that the user
                asked for is none. None: the first failure is that of all.

        Raises:
            Exception: what ``work`` raised, for the first unit that failed, where nothing stands for its result.
        """
        ...


class Threads:
    """Does units in threads of this process.

    Args:
        threads: units worked on at a time, at most.
        budget_bytes: what units may need together; a single one may exceed it, alone. None: whatever they need.
    """

    folder: Path | None = None

    def __init__(self, threads: int, budget_bytes: int | None = None) -> None:
        self._threads = max(threads, 1)
        self._budget = None if budget_bytes is None else _MemoryBudget(budget_bytes)

    def run(
        self, work: Callable[[Unit], Result], units: Sequence[Unit], *,
        bytes_needed: Sequence[int] | None = None, instead: Callable[[Exception], Other] | None = None,
    ) -> Generator[tuple[int, Result | Other], None, None]:  # fmt: skip
        """See :meth:`Executor.run`."""

        def held(n: int) -> Result:
            if self._budget is None or bytes_needed is None:
                return work(units[n])
            with self._budget.hold(bytes_needed[n]):
                return work(units[n])

        with ThreadPoolExecutor(self._threads) as pool:
            jobs: dict[Future[Result], int] = {pool.submit(held, n): n for n in range(len(units))}
            try:
                for job in as_completed(jobs):
                    n = jobs.pop(job)
                    result: Result | Other
                    try:
                        result = job.result()
                    except InterruptedRunError:
                        raise
                    except Exception as error:
                        if instead is None:
                            raise
                        result = instead(error)
                    yield n, result
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


class _MemoryBudget:
    """Lets workers go ahead while their needs together fit; a single one may exceed it, alone."""

    def __init__(self, num_bytes: int) -> None:
        self._free = self._total = num_bytes
        self._changed = threading.Condition()

    @contextmanager
    def hold(self, num_bytes: int) -> Iterator[None]:
        need = min(num_bytes, self._total)
        with self._changed:
            self._changed.wait_for(lambda: self._free >= need)
            self._free -= need
        try:
            yield
        finally:
            with self._changed:
                self._free += need
                self._changed.notify_all()
