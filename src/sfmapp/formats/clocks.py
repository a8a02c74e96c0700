"""Times as files write them: which unit a column of them has, and whether names of files are times at all.

A format states its unit: TUM's and KITTI's files hold seconds, EuRoC's whole numbers are nanoseconds. People write
other units into them all the same. What tells them apart is how far the frames are from each other, and never how many
digits a number has: a clock may begin in 1970, when the machine was switched on, or with the recording.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from decimal import Decimal
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Unit = Literal["s", "ms", "us", "ns"]

_DIGITS: dict[Unit, int] = {"s": 0, "ms": 3, "us": 6, "ns": 9}
_NAMES: dict[Unit, str] = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
# A larger number is no time in any unit.
_LARGEST = Decimal(10) ** 20
# A file in seconds is believed while its whole numbers are less than 8 apart. Beyond that a unit is as fine as it takes
# for frames and poses to come at least once in two seconds.
_LARGEST_STEP = {"s": 8.0, "ms": 2e3, "us": 2e6}
# With digits behind the point, seconds are believed for longer: key frames that were written sparsely.
_LARGEST_STEP_WITH_FRACTION = 20.0
# EuRoC's nanoseconds are believed up to 5000 measurements a second.
_LEAST_STEP_NS = 2e5
# Clocks since 1970 in a file: 2000 to 2100. With a fraction these are seconds, also where they are minutes apart.
_EPOCH_S = (946684800.0, 4102444800.0)
_LARGEST_STEP_SINCE_1970 = 3600.0
# Two clocks of one recording overlap by more than this share; in another unit they do so by a thousandth.
_LEAST_OVERLAP = 0.005


@dataclass(frozen=True)
class Times:
    """A column of times.

    Attributes:
        seconds: (N,) in the order of the column.
        unit: what it is written in.
        note: where that is not the unit of the format, a sentence that says so; empty otherwise.
        origin: seconds of the first time, exactly. elapsed_s: (N,) since then, or since another origin: without the
            quarter of a microsecond that a clock since 1970 is rounded by. Both None where they are not known.
    """

    seconds: Array
    unit: Unit
    note: str = ""
    origin: Decimal | None = None
    elapsed_s: Array | None = None

    def at(self, rows: NDArray[np.int64]) -> Times:
        """Those at some positions."""
        elapsed = None if self.elapsed_s is None else self.elapsed_s[rows]
        return replace(self, seconds=self.seconds[rows], elapsed_s=elapsed)


def parse_time(text: str) -> Decimal:
    """A time as it is written, exactly. Raises ValueError: not a finite number, or one that no clock shows."""
    try:
        value = Decimal(text.strip())
        is_time = value.is_finite() and abs(value) < _LARGEST and "_" not in text
    except ArithmeticError:
        is_time = False
    if not is_time:
        raise ValueError(text)
    return value


def read_column(
    place: str,
    values: Sequence[Decimal],
    unit: Unit,
    like: Array | None = None,
    origin: Decimal | None = None,
) -> Times:
    """Seconds of a column of times.

    Args:
        place: begins the note.
        unit: that of the format: ``s`` or ``ns``. ``ns`` holds for whole numbers alone, those with a fraction are
            seconds in any format.
        like: (M,) seconds of another clock of the same recording; of two units that are possible, the one in which both
            are of the same time is right.
        origin: of the elapsed time; None: the first of the values.
    """
    floats = np.array([float(value) for value in values], np.float64)
    is_whole = all(value == value.to_integral_value() for value in values)
    expected: Unit = unit if is_whole else "s"
    found = _unit(floats, expected, is_whole)
    if like is not None and is_whole and len(like) > 1 and len(floats) > 1:
        others: list[Unit] = [other for other in _DIGITS if other != found]
        fitting = [u for u in (found, *others) if _overlap(floats / 10.0 ** _DIGITS[u], like) > _LEAST_OVERLAP]
        found = fitting[0] if fitting else found
    exact = [value.scaleb(-_DIGITS[found]) for value in values]
    origin = exact[0] if origin is None and exact else origin
    note = ""
    if found != expected:
        note = (
            f"{place}: times are {_step(floats):.10g} apart: they are read as {_NAMES[found]}, not {_NAMES[expected]}"
        )
    elapsed = None if origin is None else np.array([float(value - origin) for value in exact], np.float64)
    return Times(np.array([float(value) for value in exact], np.float64), found, note, origin, elapsed)


def _step(values: Array) -> float:
    """The usual distance between neighbours in time; 0 of fewer than two."""
    steps = np.diff(np.unique(values))
    return float(np.median(steps)) if len(steps) else 0.0


def _unit(values: Array, expected: Unit, is_whole: bool) -> Unit:
    step, middle = _step(values), float(np.median(values)) if len(values) else 0.0
    if step == 0.0:  # a single moment: nothing but its size can tell
        return expected if expected == "ns" else _unit_of_size(middle)
    if expected == "ns" and step >= _LEAST_STEP_NS:
        return "ns"
    is_epoch = _EPOCH_S[0] <= middle < _EPOCH_S[1]
    if not is_whole and step < (_LARGEST_STEP_SINCE_1970 if is_epoch else _LARGEST_STEP_WITH_FRACTION):
        return "s"
    return next((unit for unit in ("s", "ms", "us") if step < _LARGEST_STEP[unit]), "ns")


def _unit_of_size(value: float) -> Unit:
    return next(
        (unit for unit in ("ms", "us", "ns") if _EPOCH_S[0] <= value / 10.0 ** _DIGITS[unit] < _EPOCH_S[1]), "s"
    )


def _overlap(a: Array, b: Array) -> float:
    """The time that two clocks share, as a share of all that either covers."""
    shared = min(a.max(), b.max()) - max(a.min(), b.min())
    covered = max(a.max(), b.max()) - min(a.min(), b.min())
    return float(shared / covered) if covered > 0 else 1.0


# ------------------------------------------------------------------------------------------------------------- names

_DATE_AND_TIME = re.compile(
    r"(?<!\d)(?P<y>(?:19|20)\d\d)[-_.]?(?P<m>\d\d)[-_.]?(?P<d>\d\d)[-_.T ]*"
    r"(?P<H>\d\d)[-_.:h]?(?P<M>\d\d)[-_.:m]?(?P<S>\d\d)(?P<rest>.*)"
)
_SHORT_DATE_AND_TIME = re.compile(
    r"(?P<y>\d\d)(?P<m>\d\d)(?P<d>\d\d)[-_T]?(?P<H>\d\d)(?P<M>\d\d)(?P<S>\d\d)(?P<rest>\d{0,6})"
)
# Clocks since 1970 in a name: November 2004 to May 2033. A counter that begins at 10^9 or 10^12 is none.
_EPOCH_OF_NAMES_S = (1.1e9, 2.0e9)
# Nothing has been switched on for longer.
_LONGEST_UPTIME_S = 4e7
_LARGEST_STEP_S = 10.0
# Numbers that count in steps of fewer than that are counts of frames of which some were left out.
_LEAST_STEP_OF_TIMES = 30
# Share of the steps of a clock that are within a half of the usual one: frames are lost, and clocks jitter.
_LEAST_EVEN_SHARE = 0.7


def are_dates(stems: Sequence[str]) -> bool:
    """Whether names hold a date and a time of day that runs on from one to the next, such as ``20240501_115957123``.

    They are no numbers that could be counted with: an hour ends with minute 59. A date that all names share, with a
    counter behind it, is not meant.
    """
    for pattern in (_DATE_AND_TIME, _SHORT_DATE_AND_TIME):
        moments = [_moment(pattern, stem) for stem in stems]
        if moments and all(moment is not None for moment in moments) and len(set(moments)) > min(1, len(moments) - 1):
            return True
    return False


def _moment(pattern: re.Pattern[str], stem: str) -> tuple[datetime, str] | None:
    """The second that a name tells, and the digits that follow right behind it; None if it tells none."""
    found = pattern.search(stem) if pattern is _DATE_AND_TIME else pattern.fullmatch(stem)
    if found is None:
        return None
    year = int(found["y"]) + (2000 if len(found["y"]) == 2 else 0)
    try:
        month, day, hour, minute, second = (int(found[name]) for name in "mdHMS")
        moment = datetime(year, month, day, hour, minute, second)
    except ValueError:
        return None
    fraction = re.match(r"[.,]?\d+", found["rest"])
    return moment, fraction[0] if fraction else ""


def times_of_names(stems: Sequence[str]) -> Times | None:
    """N times, where the names of files (without ending) are times; None where they are dates, counters or text.

    Times are numbers in order, with a decimal point in seconds, without one in the unit in which the frames come at a
    plausible rate; evenly, and since 1970 or since a machine was switched on. With text around the numbers, the same in
    all names, only times since 1970 are told from counters.
    """
    before, after = _text_around(stems)
    numbers = [stem[len(before) : len(stem) - len(after)] for stem in stems]
    if not numbers or not all(re.fullmatch(r"\d{1,20}(\.\d+)?", number) for number in numbers) or are_dates(stems):
        return None
    values = [parse_time(number) for number in numbers]
    if any(b <= a for a, b in pairwise(values)):
        return None
    is_whole, is_bare = "." not in "".join(numbers), not before + after
    if not is_whole and not all("." in number for number in numbers):
        return None
    found = read_column("", values, "s")
    seconds, is_epoch = found.seconds, _EPOCH_OF_NAMES_S[0] <= found.seconds[0] < _EPOCH_OF_NAMES_S[1]
    if not is_bare and not is_epoch:
        return None
    if len(seconds) == 1:
        return found if is_epoch or not is_whole else None
    step = _step(seconds)
    if not (is_epoch or abs(seconds).max() < _LONGEST_UPTIME_S) or step > _LARGEST_STEP_S:
        return None
    if is_whole:  # nobody follows a camera from one whole second to the next
        raw = np.array([float(value) for value in values])
        if found.unit == "s" or not (is_epoch or _count_time(raw, numbers)):
            return None
    steps = np.diff(seconds)
    is_even = np.mean(np.abs(steps / step - 1) <= 0.5) >= _LEAST_EVEN_SHARE
    return found if is_epoch or not is_whole or is_even else None


def _text_around(stems: Sequence[str]) -> tuple[str, str]:
    """What all names have before and behind their numbers: ``cam0_`` and ``_rect``."""
    if len(stems) < 2:
        return "", ""
    before = re.sub(r"[\d.]*$", "", _common_beginning(stems))
    return before, re.sub(r"[\d.]*$", "", _common_beginning([stem[len(before) :][::-1] for stem in stems]))[::-1]


def _common_beginning(texts: Sequence[str]) -> str:
    first, last = min(texts), max(texts)  # what these two share, all between them do
    length = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), min(len(first), len(last)))
    return first[:length]


def _count_time(values: Array, stems: Sequence[str]) -> bool:
    """Whether whole numbers that ascend count milliseconds and finer units, and not frames of which most were left out.

    Rounding shows where the steps differ by one (33, 33, 34); else their size and leading zeros have to do.
    """
    steps = np.diff(values)
    is_rounded = len(steps) > 1 and np.ptp(steps) == 1 and np.median(steps) >= 8
    is_padded = any(len(stem) > 1 and stem[0] == "0" for stem in stems)
    usual = float(np.median(steps))
    return bool(is_rounded or usual > 100 or (usual >= _LEAST_STEP_OF_TIMES and not is_padded))
