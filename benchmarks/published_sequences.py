"""KITTI odometry, EuRoC MAV and TUM RGB-D in the tables that papers print: which sequences a folder of each holds, how
they are played, and what of a run is put down.

KITTI: t_rel in per cent and r_rel in degrees per 100 m over 100, 200, ..., 800 m (Geiger et al., CVPR 2012), and the
ATE beside them. EuRoC and TUM: RMSE of the ATE in metres, after SE(3) where lengths are metric, else Sim(3)
(Sturm et al., IROS 2012; Zhang and Scaramuzza, IROS 2018). Of one camera all is after Sim(3).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Sensors as papers name them, with the flags of the command; a rig with an IMU uses it.
_MONO, _STEREO = ("mono", ("--mono", "--scale", "arbitrary")), ("stereo", ())
_INERTIAL = ("mono, IMU", ("--mono", "--scale", "imu"))


@dataclass(frozen=True)
class Published:
    """A sequence of a benchmark, played with one of its sensors.

    Attributes:
        benchmark: KITTI, EuRoC or TUM. sequence: as papers name it. sensor: mono, stereo, or mono with an IMU.
        folder: the sequence. flags: of ``sfmapp odometry``.
    """

    benchmark: str
    sequence: str
    sensor: str
    folder: Path
    flags: tuple[str, ...]

    @property
    def name(self) -> str:
        """Of the case."""
        return f"{self.benchmark} {self.sequence} {self.sensor}"


def find_published(kitti: Path | None, euroc: Path | None, tum: Path | None) -> list[Published]:
    """What the folders hold, by name; ends the script with a message where one of them holds nothing."""
    found = []
    for root, benchmark, search, expected in (
        (kitti, "KITTI", _kitti, "NN/image_0 or sequences/NN/image_0, with calib.txt, and poses.txt or poses/NN.txt"),
        (euroc, "EuRoC", _euroc, "NAME/mav0/cam0/data"),
        (tum, "TUM", _tum, "NAME/rgb.txt and NAME/groundtruth.txt"),
    ):
        if root is None:
            continue
        sequences = list(search(root))
        if not sequences:
            sys.exit(f"{root}: expected sequences of {benchmark} ({expected}), found none; unpack them there")
        found += sequences
    return found


def _kitti(root: Path) -> Iterator[Published]:
    below = root / "sequences" if (root / "sequences").is_dir() else root
    for folder in sorted({path.parent for path in below.glob("*/image_[02]")}):
        for sensor, flags in (_STEREO, _MONO):
            if sensor == "mono" or any((folder / right).is_dir() for right in ("image_1", "image_3")):
                yield Published("KITTI", folder.name, sensor, folder, flags)


def _euroc(root: Path) -> Iterator[Published]:
    for mav in sorted({*root.glob("*/mav0"), *root.glob("*/*/mav0")}):
        folder = mav.parent
        for sensor, flags in (_MONO, _STEREO, _INERTIAL):
            if (sensor != "stereo" or (mav / "cam1").is_dir()) and ("IMU" not in sensor or (mav / "imu0").is_dir()):
                yield Published("EuRoC", folder.name, sensor, folder, flags)


def _tum(root: Path) -> Iterator[Published]:
    for folder in sorted(path.parent for path in root.glob("*/rgb.txt")):
        yield Published("TUM", folder.name.removeprefix("rgbd_dataset_"), _MONO[0], folder, _MONO[1])


def published_tables(sequences: Sequence[Published], rows: Iterable[dict[str, Any]]) -> str:
    """A table for each benchmark, of rows as of ``odometry.py::summaries``, programs beside each other.

    A number is followed by the share of the frames that have a pose, where that is not all of them; a run that failed,
    or has no ground truth, is an X.
    """
    known = {(row["case"], row["program"]): row for row in rows}
    programs = list(dict.fromkeys(program for _, program in known))
    parts = []
    for benchmark, table in (("KITTI", _kitti_table), ("EuRoC", _ate_table), ("TUM", _ate_table)):
        mine = [s for s in sequences if s.benchmark == benchmark]
        if mine:
            parts += [f"## {benchmark}", "", *table(mine, known, programs), ""]
    return "\n".join(parts).rstrip()


_Rows = dict[tuple[str, str], dict[str, Any]]
_ALIGNMENTS = {"se3": "SE(3)", "sim3": "Sim(3)"}


def _kitti_table(sequences: Sequence[Published], rows: _Rows, programs: Sequence[str]) -> list[str]:
    heads = [f"{program} {what}" for program in programs for what in ("t_rel %", "r_rel deg/100 m", "ATE m")]
    lines = _head(["sequence", "sensor", *heads])
    for sequence in sequences:
        runs = [rows.get((sequence.name, program)) for program in programs]
        cells = [_cell(run, what, ".2f") for run in runs for what in (_t_rel, _r_rel, _ate)]
        lines.append(_line([sequence.sequence, sequence.sensor, *cells]))
    return lines


def _ate_table(sequences: Sequence[Published], rows: _Rows, programs: Sequence[str]) -> list[str]:
    """Sequences beside each other, as papers have them, and their mean where none failed."""
    names = list(dict.fromkeys(s.sequence for s in sequences))
    lines = _head(["ATE RMSE m", "after", *names, "mean"])
    for sensor in dict.fromkeys(s.sensor for s in sequences):
        played = {s.sequence: s.name for s in sequences if s.sensor == sensor}
        for program in programs:
            mine = [rows.get((played.get(name, ""), program)) for name in names]
            truths = [row["ground_truth"] for row in mine if row is not None and row.get("ground_truth")]
            after = ", ".join(sorted({_ALIGNMENTS[truth["alignment"]] for truth in truths})) or "-"
            mean = f"{sum(map(_ate, truths)) / len(truths):.3f}" if len(truths) == len(names) else "-"
            cells = [_cell(row, _ate, ".3f") for row in mine]
            lines.append(_line([f"{program}, {sensor}", after, *cells, mean]))
    return lines


def _ate(truth: dict[str, Any]) -> float:
    return float(truth["ate_m"]["rmse"])


def _t_rel(truth: dict[str, Any]) -> float | None:
    return truth["drift_percent"] if truth["is_kitti_drift"] else None


def _r_rel(truth: dict[str, Any]) -> float | None:
    return truth["drift_deg_per_100m"] if truth["is_kitti_drift"] else None


def _cell(row: dict[str, Any] | None, value: Callable[[dict[str, Any]], float | None], form: str) -> str:
    """A number of a run; X where the run failed, - where there was none or it has no such number."""
    if row is None:
        return "-"
    truth = row.get("ground_truth")
    if not truth or row["exit_code"]:
        return "X"
    number = value(truth)
    if number is None:
        return "-"
    share = row["num_in_largest_map"] / max(row["num_frames"], 1)
    return format(number, form) + (f" ({100 * share:.0f} %)" if share < 0.995 else "")


def _head(names: Sequence[str]) -> list[str]:
    return [_line(names), _line(["---"] * len(names))]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
