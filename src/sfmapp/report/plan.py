"""What a run is expected to take, said beforehand, and how that compares with what it took."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from sfmapp.reporting import Report, Usage

FORMAT = "sfmapp plan 1"
Weight = Literal["note", "warning"]
# what a plan says of all stages together
WHOLE = "whole run"


class Interval(Report, kw_only=False):
    """A number that is not known yet: nine times in ten it turns out to be between ``low`` and ``high``."""

    low: float
    likely: float
    high: float

    @classmethod
    def about(cls, likely: float, below: float, above: float | None = None) -> Interval:
        """Off by at most these shares of it, below and above; the same where one is told."""
        above = below if above is None else above
        return cls(likely * max(0.0, 1.0 - below), likely, likely * (1.0 + above))

    def holds(self, value: float) -> bool:
        """Whether a number is within it."""
        return self.low <= value <= self.high

    def text(self, unit: str) -> str:
        """In words: ``40 to 60 s``; one number where both ends are written alike."""
        low, high = _short(self.low), _short(self.high)
        return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def _short(value: float) -> str:
    """Two digits below a hundred, three above."""
    return f"{value:.2g}" if value < 99.5 else f"{float(f'{value:.3g}'):.0f}"


class StagePlan(Report):
    """What a stage is expected to take; memory is the peak of the process during it, 1e6 bytes."""

    stage: str
    cpu_s: Interval
    wall_s: Interval
    memory_mb: Interval


class Doubt(Report):
    """Something that will probably go wrong, or that is worth knowing.

    Attributes:
        weight: ``warning`` where a result suffers, ``note`` where it may not.
        subject: a keyword, such as ``blur``.
        message: what was found; remedy: what to do about it.
        names: of the photographs.
    """

    weight: Weight
    subject: str
    message: str
    remedy: str
    names: Sequence[str]


class PlannedCamera(Report):
    """A camera and the photographs that it took; ``focal_source``: as in the report of a run."""

    num_images: int
    width: int
    height: int
    model: str
    focal_px: float
    focal_source: str
    name: str


class MachineFacts(Report):
    """What the estimate knows of the machine.

    Attributes:
        processor, cores, memory_mb: the cores that this process may use, and its memory, 1e6 bytes.
        free_disk_mb: of the working folder.
        load: processes that wanted a core when the plan was made, over the last minute.
        calibrated: date and time in UTC of the measurement of the machine.
        calibration_load: the same of that time.
        is_calibration_busy: others were at work beside it, so that its seconds may be too many.
    """

    processor: str
    cores: int
    memory_mb: float
    free_disk_mb: float
    load: float
    calibrated: str
    calibration_load: float
    is_calibration_busy: bool


class PlanReport(Report):
    """What a reconstruction will take, and what will probably go wrong in it.

    Attributes:
        key: of photographs and options, by which a run finds its plan.
        groups: sizes of the groups of photographs that show something in common, the largest first.
        num_pairs: that are compared; ``num_overlapping``: of these, that show the same.
        pairs_reason: how they are chosen, in words.
        num_features, num_matches, num_observations: in all.
        stages: in their order; ``whole``: all of them, with the start of the program.
        surface: patches and mesh after them, if they were asked for: roughly. ``surface_disk_mb``: what they write.
        peak_stage: whose memory is the peak.
        disk_mb: that the output takes.
        took: what planning itself took.
    """

    format: str
    source: str
    key: str
    num_images: int
    num_skipped: int
    megapixels: float
    threads: int
    cameras: Sequence[PlannedCamera]
    groups: Sequence[int]
    num_pairs: int
    num_overlapping: Interval
    pairs_reason: str
    num_features: Interval
    num_matches: Interval
    num_observations: Interval
    stages: Sequence[StagePlan]
    whole: StagePlan
    peak_stage: str
    disk_mb: Interval
    surface: Sequence[StagePlan]
    surface_disk_mb: Interval
    doubts: Sequence[Doubt]
    machine: MachineFacts
    took: Usage


class PlannedAndTaken(Report):
    """A number as it was planned and as it was; ``unit``: of both."""

    stage: str
    quantity: str
    unit: str
    planned: Interval
    took: float
    is_within: bool


class PlanCheck(Report):
    """A run beside its plan.

    Attributes:
        rows: CPU seconds of each stage and of the whole, wall seconds and memory of the whole.
        sentence: in words, whether the plan was right.
    """

    rows: Sequence[PlannedAndTaken]
    sentence: str

    @classmethod
    def of(cls, plan: PlanReport, usage: Mapping[str, Usage], run: Usage) -> PlanCheck:
        """Hold what stages, by name, and the whole run took against a plan."""
        rows = list(_rows(plan, usage, run))
        whole = {row.quantity: row for row in rows if row.stage == WHOLE}
        return cls(rows=rows, sentence=_sentence(whole, [row for row in rows if row.stage != WHOLE]))


def _rows(plan: PlanReport, usage: Mapping[str, Usage], run: Usage) -> Iterator[PlannedAndTaken]:
    def row(stage: str, quantity: str, unit: str, planned: Interval, took: float) -> PlannedAndTaken:
        is_within = planned.holds(took)
        return PlannedAndTaken(
            stage=stage, quantity=quantity, unit=unit, planned=planned, took=took, is_within=is_within
        )

    for each in plan.stages:
        if each.stage in usage:
            yield row(each.stage, "CPU time", "s", each.cpu_s, usage[each.stage].cpu_s)
    yield row(WHOLE, "CPU time", "s", plan.whole.cpu_s, run.cpu_s)
    yield row(WHOLE, "time", "s", plan.whole.wall_s, run.wall_s)
    yield row(WHOLE, "memory", "MB", plan.whole.memory_mb, run.peak_memory_mb or 0.0)


def _sentence(whole: Mapping[str, PlannedAndTaken], stages: Sequence[PlannedAndTaken]) -> str:
    cpu, wall, memory = whole["CPU time"], whole["time"], whole["memory"]
    told = (
        f"planned {wall.planned.text('s')} and {cpu.planned.text('CPU s')}, took {_short(wall.took)} s and "
        f"{_short(cpu.took)} CPU s; {memory.planned.text('MB')} of memory, took {memory.took:.0f}"
    )
    wrong = []
    if not cpu.is_within:
        wrong.append(f"CPU time is {_off(cpu)}")
        worst = max(stages, key=lambda row: abs(row.took - row.planned.likely), default=None)
        if worst is not None:
            wrong[-1] += f", most of it in {worst.stage}: {worst.planned.text('s')} planned, {_short(worst.took)} taken"
    if not memory.is_within:
        wrong.append(f"memory is {_off(memory)}")
    if wrong:
        return f"{told}. The plan was wrong: {'; '.join(wrong)}."
    if not wall.is_within:
        if wall.took > wall.planned.high:
            return f"{told}. The work was as planned; it took longer as the machine had other things to do."
        return f"{told}. The work was as planned, and took less time than that."
    return f"{told}. The plan was right."


def _off(row: PlannedAndTaken) -> str:
    """How far a number is outside of its interval."""
    bound = row.planned.high if row.took > row.planned.high else row.planned.low
    share = abs(row.took - bound) / bound if bound > 0.0 else float("inf")
    where = "above" if row.took > row.planned.high else "below"
    return f"{100 * share:.0f} % {where} what was planned" if share != float("inf") else f"{where} what was planned"
