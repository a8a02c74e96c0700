"""Hold a trajectory against the ground truth: the errors of the literature in one table, and a picture."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.evaluation.report import Statistics
from sfmapp.evaluation.trajectory import (
    KITTI_LENGTHS_M,
    MAX_DIFFERENCE_S,
    MIN_PAIRS,
    AbsoluteError,
    Alignment,
    DeltaUnit,
    Drift,
    Pairs,
    RelativeError,
    Trajectory,
    absolute_error,
    associate,
    is_straight,
    kitti_drift,
    path_shares_m,
    relative_error,
    statistics,
)
from sfmapp.formats.trajectory_input import TrajectoryFile, read_trajectory
from sfmapp.report.evaluation import (
    AlignmentReport,
    DriftAtLength,
    EvaluationReport,
    KittiDrift,
    MeanDrift,
    PoseErrors,
    RelativePoseErrors,
    TrajectoryReport,
    metres,
)

Array = NDArray[np.float64]

# with less of the ground truth covered the table says that its errors are not comparable; KITTI's devkit takes whole
# runs only
_COMPARABLE_COVERAGE = 0.99
# a unit of length that is off by more than this is none: visual odometry with a scale has a few percent at most
_METRIC_SCALE = 0.1
# beyond, squares of errors overflow; the orbit of the earth is shorter
_LONGEST_PATH_M = 1e15
_DELTA = re.compile(r"(\d+\.?\d*|\.\d+)\s*(f|s|m)")
_UNITS: dict[str, DeltaUnit] = {"f": "frames", "s": "s", "m": "m"}


@dataclass(frozen=True)
class EvaluateOptions:
    """How to compare."""

    alignments: tuple[Alignment, ...] = ("sim3", "se3")
    """One block of the table each."""
    deltas: tuple[tuple[float, DeltaUnit], ...] | None = None
    """Of the relative error; None: a frame, a second, and about a tenth of the path in metres, at most 100."""
    max_difference_s: float = MAX_DIFFERENCE_S
    """Poses further apart in time are no pair."""
    offset_s: float = 0.0
    """Added to the timestamps of the estimate."""
    is_overlapping: bool = False
    """A relative motion begins at every pose, not where the one before has ended."""
    is_by_estimate: bool = False
    """Deltas in metres are measured along the estimate, not along the ground truth."""


@dataclass(frozen=True)
class Errors:
    """All errors of one alignment.

    Attributes:
        absolute: after the alignment.
        relative: one for each delta, with the scale of the alignment.
        drift: over KITTI's lengths, or over shares of the path if it is too short for them (``is_by_share``).
    """

    absolute: AbsoluteError
    relative: tuple[RelativeError, ...]
    drift: Drift
    is_by_share: bool


@dataclass(frozen=True)
class Evaluation:
    """An estimate against the ground truth.

    Attributes:
        estimate, ground_truth: what was read.
        pairs: the poses that were compared.
        errors: by alignment, in the order that was asked for.
        notes: what a reader of the numbers has to know.
    """

    estimate: TrajectoryFile
    ground_truth: TrajectoryFile
    pairs: Pairs
    errors: dict[Alignment, Errors]
    notes: list[str] = field(default_factory=list)

    @property
    def telling_alignment(self) -> Alignment:
        """The one to draw: ``se3`` where the estimate has a unit, ``sim3`` where it has not; else the first."""
        if "sim3" in self.errors and "se3" in self.errors:
            return "se3" if abs(math.log(self.errors["sim3"].absolute.scale)) < _METRIC_SCALE else "sim3"
        return next(iter(self.errors))

    def report(self) -> EvaluationReport:
        """The errors in numbers: metres (the ground truth's unit), degrees, seconds."""
        pairs, times = self.pairs, self.pairs.ground_truth.timestamps_s
        return EvaluationReport(
            estimate=_file_report(self.estimate, pairs.num_estimate),
            ground_truth=_file_report(self.ground_truth, pairs.num_ground_truth),
            num_pairs=len(pairs),
            num_gaps=int(pairs.is_gap.sum()),
            coverage=pairs.coverage,
            duration_s=None if times is None else float(np.ptp(times)),
            path_m=pairs.ground_truth.path_m,
            alignments={how: _alignment_report(errors) for how, errors in self.errors.items()},
            notes=self.notes,
        )

    def table(self) -> str:
        """The errors as plain text, a block for each alignment; no newline at its end."""
        return self.report().table()


def evaluate(
    estimate: str | os.PathLike[str],
    ground_truth: str | os.PathLike[str],
    options: EvaluateOptions | None = None,
    *,
    times: str | os.PathLike[str] | None = None,
) -> Evaluation:
    """Compare a trajectory file with a file of the true poses.

    Args:
        estimate: TUM, KITTI or EuRoC text (see :mod:`sfmapp.formats.trajectory_input`), or the folder of an odometry
            run, of which ``trajectory.tum`` is taken (``trajectory.kitti`` if the ground truth has no timestamps).
        ground_truth: a file of the same formats, not necessarily the same one, or the folder of a sequence (see
            :func:`sfmapp.sequences.open.open_sequence`): then it is of the first camera on the clock of the frames,
            and played as the run was if ``estimate`` is the folder of one.
        times: file with the seconds of the lines of KITTI trajectories.

    Raises:
        InputError: a file cannot be read, the two have no poses in common, or they do not determine an alignment.
        UsageError: an option that cannot be obeyed.
    """
    options = options or EvaluateOptions()
    if not options.max_difference_s >= 0 or not math.isfinite(options.max_difference_s + options.offset_s):
        raise UsageError("expected a maximum difference of at least 0 s and a finite offset")
    seconds = None if times is None else Path(times)
    true_file = (
        read_trajectory(Path(ground_truth), seconds)
        if not Path(ground_truth).is_dir()
        else _of_sequence(Path(ground_truth), Path(estimate))
    )
    ours_path = _trajectory_of(Path(estimate), true_file.trajectory)
    our_file = read_trajectory(ours_path, seconds, like=true_file.trajectory.timestamps_s)
    ours, theirs = _same_length(our_file, true_file)
    pairs = associate(ours, theirs, max_difference_s=options.max_difference_s, offset_s=options.offset_s)
    if len(pairs) < 2:
        raise InputError(f"{our_file.path} and {true_file.path} have one pose in common, which tells nothing")
    for file, path in ((our_file, pairs.estimate), (true_file, pairs.ground_truth)):
        if not path.path_m < _LONGEST_PATH_M:
            raise InputError(f"{file.path}: expected positions in metres, found a path of {path.path_m:.3g} m")
    deltas = options.deltas or _deltas(pairs)
    errors = {how: _errors(pairs, how, deltas, options) for how in dict.fromkeys(options.alignments)}
    result = Evaluation(our_file, true_file, pairs, errors)
    result.notes.extend(_notes(result, options))
    return result


def draw(result: Evaluation, path: str | os.PathLike[str]) -> None:
    """Draw the estimate against the ground truth as a PNG, after the alignment that tells most.

    Raises:
        InputError: the file cannot be written.
    """
    from sfmapp.report.trajectory_plot import write_trajectory_plot

    how = result.telling_alignment
    errors, pairs = result.errors[how], result.pairs
    rmse = float(np.sqrt((errors.absolute.translation_m**2).mean()))
    title = f"{result.estimate.path.name} against {result.ground_truth.path.name}"
    facts = [
        f"ATE rmse {rmse:.3g} m"
        + (f", {100 * rmse / pairs.ground_truth.path_m:.2g} % of path" if pairs.ground_truth.path_m else ""),
        _ALIGNMENT_NAMES[how] + (f" {errors.absolute.scale:.4g}" if how == "sim3" else ""),
        f"{len(pairs)} poses",
        f"coverage {100 * pairs.coverage:.1f} %",
        f"{metres(pairs.ground_truth.path_m)} of path",
    ]
    if len(errors.drift.first):
        facts.append(f"{'drift' if errors.is_by_share else 't_rel'} {errors.drift.t_rel_percent:.3g} %")
    write_trajectory_plot(Path(path), pairs, errors.absolute, result.ground_truth.trajectory, title, facts)


_ALIGNMENT_NAMES = {
    "se3": "aligned without scale",
    "sim3": "aligned with scale",
    "origin": "aligned at the first pose",
    "none": "not aligned",
}


def parse_delta(text: str) -> tuple[float, DeltaUnit]:
    """``1f``, ``0.5s`` or ``10m`` as a number and its unit.

    Raises:
        UsageError: it is none of these.
    """
    found = _DELTA.fullmatch(text.strip())
    if found is None or float(found[1]) <= 0:
        raise UsageError(f"delta {text!r}: expected frames, seconds or metres, such as 1f, 0.5s or 10m")
    return float(found[1]), _UNITS[found[2]]


def _trajectory_of(path: Path, ground_truth: Trajectory) -> Path:
    if not path.is_dir():
        return path
    from sfmapp.workspace.layout import MANIFEST
    from sfmapp.workspace.manifest import read_manifest

    if (path / MANIFEST).is_file():
        read_manifest(path)  # says so if the run was cut off
    tum, kitti = path / "trajectory.tum", path / "trajectory.kitti"
    if not tum.is_file():
        raise InputError(f"{path}: expected a trajectory, found a folder without trajectory.tum")
    return kitti if ground_truth.timestamps_s is None and kitti.is_file() else tum


def _of_sequence(folder: Path, estimate: Path) -> TrajectoryFile:
    """The ground truth of a sequence, played backwards or in steps as the run was."""
    from sfmapp.events import Events
    from sfmapp.images.sequence import SequenceOptions
    from sfmapp.sequences.open import open_sequence
    from sfmapp.workspace.layout import MANIFEST
    from sfmapp.workspace.manifest import read_manifest
    from sfmapp.workspace.options import options_from_dict

    options = SequenceOptions()
    if (estimate / MANIFEST).is_file():
        options = options_from_dict(read_manifest(estimate).options).sequence
    sequence = open_sequence(folder, options, Events(), require_camera=False)
    if sequence.ground_truth is None:
        raise InputError(
            f"{folder}: expected true poses beside the frames, found none", "name the file that holds them"
        )
    ground_truth = sequence.ground_truth
    return TrajectoryFile(
        folder, sequence.kind, Trajectory.from_cam_from_world(ground_truth.cam_from_world, ground_truth.timestamps_s)
    )


def _same_length(estimate: TrajectoryFile, ground_truth: TrajectoryFile) -> tuple[Trajectory, Trajectory]:
    """Both without timestamps: frames that a numbered file does not reach are gaps at its end."""
    if estimate.trajectory.timestamps_s is not None or ground_truth.trajectory.timestamps_s is not None:
        return estimate.trajectory, ground_truth.trajectory
    length = max(len(estimate.trajectory), len(ground_truth.trajectory))

    def padded(file: TrajectoryFile) -> Trajectory:
        missing = length - len(file.trajectory) if file.is_numbered else 0
        position = np.concatenate([file.trajectory.position, np.full((missing, 3), np.nan)])
        return Trajectory(position, np.concatenate([file.trajectory.rotation, np.full((missing, 3, 3), np.nan)]))

    return padded(estimate), padded(ground_truth)


def _deltas(pairs: Pairs) -> tuple[tuple[float, DeltaUnit], ...]:
    """A frame; a second, if poses come faster and there are two of them; metres, a power of ten near path / 10."""
    deltas: list[tuple[float, DeltaUnit]] = [(1.0, "frames")]
    times = pairs.ground_truth.timestamps_s
    if times is not None and np.median(np.diff(times)) <= 0.5 and np.ptp(times) >= 2:
        deltas.append((1.0, "s"))
    if pairs.ground_truth.path_m > 0:
        deltas.append((min(10.0 ** round(math.log10(pairs.ground_truth.path_m / 10)), 100.0), "m"))
    return tuple(deltas)


def _errors(
    pairs: Pairs, how: Alignment, deltas: Sequence[tuple[float, DeltaUnit]], options: EvaluateOptions
) -> Errors:
    absolute = absolute_error(pairs, how)
    relative = []
    for delta, unit in deltas:
        try:
            relative.append(
                relative_error(
                    pairs, delta, unit, scale=absolute.scale,
                    is_overlapping=options.is_overlapping, is_by_estimate=options.is_by_estimate,
                )
            )  # fmt: skip
        except InputError:  # nobody asked for this delta: gaps can leave no two poses a second apart
            if options.deltas is not None:
                raise
    is_short = pairs.ground_truth.path_m <= KITTI_LENGTHS_M[0]
    if is_short:
        drift = kitti_drift(pairs, scale=absolute.scale, lengths_m=path_shares_m(pairs), step=1)
    else:
        drift = kitti_drift(pairs, scale=absolute.scale)
    return Errors(absolute, tuple(relative), drift, is_short)


def _notes(result: Evaluation, options: EvaluateOptions) -> list[str]:
    pairs, notes = result.pairs, []
    if pairs.coverage < _COMPARABLE_COVERAGE:
        notes.append(
            f"the estimate covers {100 * pairs.coverage:.1f} % of the ground truth: these errors say nothing about the "
            "rest, "
            "and are not comparable with those of a run that covers more"
        )
    if len(pairs) < MIN_PAIRS:
        notes.append("two poses say nothing of a trajectory: a similarity lays any two positions on the true ones")
    left = pairs.num_estimate - len(np.unique(pairs.estimate_idx))
    if left and pairs.num_ground_truth > pairs.num_estimate:
        notes.append(f"{left} poses of the estimate have no true one within {options.max_difference_s:g} s")
    for name, file in (("estimate", result.estimate), ("ground truth", result.ground_truth)):
        notes += [file.note] if file.note else []
        times = file.trajectory.timestamps_s
        steps = np.diff(times) if times is not None else np.ones(0)
        if (steps < 0).any():
            notes.append(f"the timestamps of the {name} do not ascend ({(steps < 0).sum()} steps back): sorted by time")
        if (steps == 0).any():
            notes.append(f"{(steps == 0).sum()} poses of the {name} have the timestamp of the one before")
    if (
        result.ground_truth.format == "euroc"
        and result.estimate.format != "euroc"
        and not result.ground_truth.path.is_dir()
    ):
        notes.append(
            "EuRoC's ground truth is of the IMU, whose axes are not the camera's: against it the rotations, RPE and "
            "drift of "
            "a camera's trajectory say nothing, and the ATE holds the lever between the two; give the folder of the "
            "sequence instead"
        )
    if {"sim3", "se3"} & set(result.errors) and is_straight(pairs):
        notes.append(
            "the path is straight within its errors: the alignment of positions leaves the turn about it open, and the "
            "ATE of rotations with it"
        )
    if "sim3" in result.errors and "se3" in result.errors and result.telling_alignment == "sim3":
        notes.append(
            f"lengths of the estimate are {1 / result.errors['sim3'].absolute.scale:.3g} of true ones: without a scale "
            "only sim3 tells something"
        )
    notes.append(_drift_note(result))
    return notes


def _drift_note(result: Evaluation) -> str:
    errors = next(iter(result.errors.values()))
    if errors.is_by_share:
        return (
            f"no t_rel and r_rel: KITTI's stretches are 100 to 800 m long, this path is "
            f"{metres(result.pairs.ground_truth.path_m)}; the drift is over stretches of "
            "10, 20, ..., 80 % of it instead"
        )
    longest = errors.drift.length_m.max(initial=0)
    if not longest:
        return "no t_rel and r_rel: no stretch of 100 m is followed by another pose"
    lengths = "100 m" if longest == KITTI_LENGTHS_M[0] else f"100 to {longest:g} m"
    return f"t_rel and r_rel are means over {len(errors.drift.first)} stretches of {lengths}"


def _file_report(file: TrajectoryFile, num_poses: int) -> TrajectoryReport:
    return TrajectoryReport(path=os.fspath(file.path), format=file.format, num_poses=num_poses)


def _alignment_report(errors: Errors) -> AlignmentReport:
    drift = errors.drift
    by_length = []
    for length in drift.lengths_m:
        chosen = drift.length_m == length
        if chosen.any():
            by_length.append(
                DriftAtLength(
                    length_m=float(length), num=int(chosen.sum()),
                    t_percent=float(100 * drift.translation[chosen].mean()),
                    r_deg_per_m=float(drift.rotation_deg_per_m[chosen].mean()),
                )
            )  # fmt: skip
    kitti = mean = None
    if len(drift.first):
        mean = MeanDrift(
            t_percent=drift.t_rel_percent, r_deg_per_m=drift.r_rel_deg_per_m, is_by_share=errors.is_by_share
        )
    if by_length and not errors.is_by_share:
        kitti = KittiDrift(
            t_rel_percent=drift.t_rel_percent, r_rel_deg_per_m=drift.r_rel_deg_per_m,
            r_rel_deg_per_100m=100 * drift.r_rel_deg_per_m, num=len(drift.first),
        )  # fmt: skip
    absolute = errors.absolute
    return AlignmentReport(
        ground_truth_from_estimate=absolute.ground_truth_from_estimate.tolist(),
        scale=absolute.scale,
        ate=PoseErrors(**_statistics(absolute.translation_m, absolute.rotation_deg)),
        rpe=[
            RelativePoseErrors(
                delta=error.delta, unit=error.unit, num=len(error.first),
                **_statistics(error.translation_m, error.rotation_deg),
            )
            for error in errors.relative
        ],
        kitti=kitti,
        drift=mean,
        drift_by_length=by_length,
    )  # fmt: skip


def _statistics(translation_m: Array, rotation_deg: Array) -> dict[str, Statistics]:
    """Of errors, of which there are some."""
    found = {"translation_m": statistics(translation_m), "rotation_deg": statistics(rotation_deg)}
    return {name: numbers for name, numbers in found.items() if numbers is not None}
