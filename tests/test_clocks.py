"""Clocks of every layout: where they begin, in which unit they are written, and names that are no times."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from datetime import datetime, timedelta
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfmapp.errors import InputError
from sfmapp.events import Event, Events
from sfmapp.formats.clocks import are_dates, parse_time, read_column, times_of_names
from sfmapp.formats.trajectory_input import read_trajectory
from sfmapp.geometry import rigid3
from sfmapp.pipelines.evaluate import evaluate
from sfmapp.sequences.open import SequenceOptions, open_sequence

PINHOLE = "PINHOLE,50,50,16,12"
UNITS = {"s": 0, "ms": 3, "us": 6, "ns": 9}
# nanoseconds since the clock began
STARTS = {
    "zero": 0,
    "just on": 10**9,
    "boot": 612_345_000_000,
    "a week": 7 * 86_400 * 10**9,
    "a month": 30 * 86_400 * 10**9,
    "1970": 1_714_564_797 * 10**9,
}
COUNT = 12


def stamps_ns(start: str, rate: int) -> list[int]:
    return [STARTS[start] + i * 10**9 // rate for i in range(COUNT)]


def written(ns: int, unit: str) -> str:
    """Whole numbers, rounded; seconds with nine digits."""
    return f"{Decimal(ns).scaleb(-9):.9f}" if unit == "s" else str(round(Decimal(ns).scaleb(UNITS[unit] - 9)))


def seconds(texts: list[str], unit: str) -> list[float]:
    return [float(Decimal(text).scaleb(-UNITS[unit])) for text in texts]


def write_frames(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), np.random.default_rng(i).integers(0, 256, (24, 32), np.uint8))


def pose_rows(texts: list[str], separator: str = " ", w_first: bool = False) -> str:
    quaternions = rigid3.quaternion(rigid3.exp_so3(np.random.default_rng(0).normal(size=(len(texts), 3))))
    order = [3, 0, 1, 2] if w_first else [0, 1, 2, 3]
    return "".join(
        separator.join([text, str(i), "0", str(i * i), *map(repr, q[order].tolist())]) + "\n"
        for i, (text, q) in enumerate(zip(texts, quaternions, strict=True))
    )


def as_kitti(root: Path, texts: list[str]) -> None:
    write_frames(root / "image_0", [f"{i:06d}.png" for i in range(COUNT)])
    (root / "times.txt").write_text("\n".join(texts))


def as_tum(root: Path, texts: list[str]) -> None:
    write_frames(root / "rgb", [f"{i}.png" for i in range(COUNT)])
    (root / "rgb.txt").write_text("".join(f"{text} rgb/{i}.png\n" for i, text in enumerate(texts)))
    (root / "groundtruth.txt").write_text(pose_rows(texts))


def as_folder(root: Path, texts: list[str]) -> None:
    write_frames(root, [f"{text}.png" for text in texts])


def as_list(root: Path, texts: list[str]) -> None:
    write_frames(root, [f"a{i}.png" for i in range(COUNT)])
    (root / "timestamps.txt").write_text("".join(f"a{i}.png {text}\n" for i, text in enumerate(texts)))


def as_euroc(root: Path, texts: list[str], imu_step: int = 0) -> None:
    mav = root / "mav0"
    write_frames(mav / "cam0" / "data", [f"{text}.png" for text in texts])
    (mav / "cam0" / "data.csv").write_text("#timestamp [ns],filename\r\n" + "".join(f"{t},{t}.png\r\n" for t in texts))
    (mav / "cam0" / "sensor.yaml").write_text(
        "T_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
        "resolution: [32, 24]\ncamera_model: pinhole\nintrinsics: [50, 50, 15.5, 11.5]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
    )
    (mav / "state_groundtruth_estimate0").mkdir()
    (mav / "state_groundtruth_estimate0" / "data.csv").write_text(pose_rows(texts, ",", w_first=True))
    (mav / "imu0").mkdir()
    (mav / "imu0" / "data.csv").write_text("".join(f"{text},0,0,0,9.8,0,0\n" for text in texts))


def opened(root: Path, told: list[Event] | None = None, **options: object):  # type: ignore[no-untyped-def]
    events = Events(told.append) if told is not None else Events()
    return open_sequence(root, SequenceOptions(camera=PINHOLE, **options), events)  # type: ignore[arg-type]


@pytest.mark.parametrize("layout", [as_kitti, as_tum, as_folder, as_list])
@pytest.mark.parametrize(("unit", "rate"), [("s", 10), ("ms", 20), ("us", 30), ("ns", 10), ("ns", 100)])
def test_times_are_as_given(tmp_path: Path, layout: Callable[[Path, list[str]], None], unit: str, rate: int) -> None:
    for start in STARTS:
        texts = [written(ns, unit) for ns in stamps_ns(start, rate)]
        layout(tmp_path / start, texts)
        sequence = opened(tmp_path / start)
        assert [frame.timestamp_s for frame in sequence.frames()] == seconds(texts, unit), start
        if sequence.ground_truth is not None:
            assert sequence.ground_truth.timestamps_s.tolist() == seconds(texts, unit)
            assert rigid3.center(sequence.ground_truth.cam_from_world)[:, 0] == pytest.approx(range(COUNT))


@pytest.mark.parametrize(
    ("rate", "unit"), [(10, "ns"), (20, "ns"), (200, "ns"), (1, "ns"), (20, "us"), (20, "ms"), (10, "s")]
)
def test_whole_numbers_of_euroc_are_nanoseconds(tmp_path: Path, rate: int, unit: str) -> None:
    for start in STARTS:
        told: list[Event] = []
        texts = [written(ns, unit) for ns in stamps_ns(start, rate)]
        as_euroc(tmp_path / start, texts)
        sequence = opened(tmp_path / start, told)
        expected = seconds(texts, unit)
        assert [frame.timestamp_s for frame in sequence.frames()] == expected, start
        assert sequence.imu is not None
        assert sequence.imu.timestamps_s.tolist() == expected
        assert sequence.ground_truth is not None
        assert sequence.ground_truth.timestamps_s.tolist() == expected
        # another unit is read where nanoseconds would be 20 kHz and more, and said
        assert any("are read as" in event.message for event in told) == (unit in ("us", "ms"))
        (tmp_path / start / "mav0/cam0/data.csv").unlink()
        assert [frame.timestamp_s for frame in opened(tmp_path / start).frames()] == expected


@pytest.mark.parametrize("options", [{}, {"reverse": True}, {"start": 3, "step": 2}])
def test_where_a_clock_begins_has_no_part_in_what_has_elapsed(tmp_path: Path, options: dict[str, object]) -> None:
    """Times since 1970 are known to a quarter of a microsecond: the last digits of a trajectory would be others."""
    found = []
    for start in STARTS:
        as_euroc(tmp_path / start, [written(ns, "ns") for ns in stamps_ns(start, 30)])
        sequence = opened(tmp_path / start, **options)
        assert sequence.imu is not None
        assert sequence.imu.elapsed_s is not None
        times = np.array([[frame.timestamp_s, frame.elapsed_s] for frame in sequence.frames()])
        np.testing.assert_allclose(np.diff(times[:, 0]), np.diff(times[:, 1]), atol=1e-6)
        found.append((times[:, 1].tolist(), sequence.imu.elapsed_s.tolist()))
    assert all(other == found[0] for other in found)


def test_an_imu_is_read_in_the_unit_in_which_it_fits_the_frames(tmp_path: Path) -> None:
    as_euroc(tmp_path, [written(ns, "us") for ns in stamps_ns("boot", 20)])
    ticks = [612_345_000 + 1000 * i for i in range(560)]  # 1 kHz: as milliseconds, frames of 1 a second
    (tmp_path / "mav0/imu0/data.csv").write_text("".join(f"{tick},0,0,0,9.8,0,0\n" for tick in ticks))
    sequence = opened(tmp_path)
    assert sequence.imu is not None
    assert sequence.imu.timestamps_s[[0, -1]].tolist() == [612.345, 612.904]


T0 = datetime(2024, 5, 1, 11, 59, 57)


def moments(step_s: float) -> list[datetime]:
    return [T0 + timedelta(seconds=i * step_s) for i in range(40)]


NO_TIMES = {
    "17 digits": [f"{m:%Y%m%d%H%M%S%f}"[:17] for m in moments(0.1)],
    "14 digits": [f"{m:%Y%m%d%H%M%S}" for m in moments(1)],
    "12 digits": [f"{m:%y%m%d%H%M%S}" for m in moments(1)],
    "20 digits": [f"{m:%Y%m%d%H%M%S%f}" for m in moments(0.1)],
    "separated": [f"{m:%Y-%m-%d_%H-%M-%S.%f}"[:23] for m in moments(0.1)],
    "iso": [f"{m:%Y-%m-%dT%H.%M.%S}" for m in moments(2)],
    "phone": [f"{m:IMG_%Y%m%d_%H%M%S%f}"[:22] for m in moments(0.1)],
    "within a minute": [f"{m:%Y%m%d%H%M%S%f}"[:17] for m in moments(0.05)],
    "counter of 12": [f"{i:012d}" for i in range(40)],
    "from 10^11": [f"{100_000_000_000 + i}" for i in range(40)],
    "from 10^9": [f"{1_000_000_000 + i}" for i in range(40)],
    "from 10^18": [f"{10**18 + i}" for i in range(40)],
    "a day and a counter": [f"VID_20240501_115957_{i:06d}" for i in range(40)],
    "plain": [f"frame{i}" for i in range(40)],
}  # fmt: skip


@pytest.mark.parametrize("kind", NO_TIMES)
def test_dates_and_counters_are_no_times(tmp_path: Path, kind: str) -> None:
    write_frames(tmp_path, [f"{stem}.png" for stem in NO_TIMES[kind]])
    for fps in (None, 10):
        frames = list(opened(tmp_path, fps=fps).frames())
        assert [Path(frame.name).stem for frame in frames] == NO_TIMES[kind]
        assert [frame.timestamp_s for frame in frames] == [i / (fps or 30) for i in range(40)]


@pytest.mark.parametrize(("unit", "rate"), [("s", 20), ("ms", 20), ("us", 30), ("ns", 10)])
def test_text_around_times_since_1970(tmp_path: Path, unit: str, rate: int) -> None:
    texts = [written(ns, unit) for ns in stamps_ns("1970", rate)]
    for form in ("left_{}_rect", "cam0_{}", "{}-cam1"):
        write_frames(tmp_path / form, [f"{form.format(text)}.png" for text in texts])
        assert [frame.timestamp_s for frame in opened(tmp_path / form).frames()] == seconds(texts, unit)
    write_frames(tmp_path / "b", [f"left_{50 * i}.png" for i in range(COUNT)])
    assert [frame.timestamp_s for frame in opened(tmp_path / "b").frames()] == [50 * i / 30 for i in range(COUNT)]


def test_every_third_of_a_counter_is_time_that_went_by(tmp_path: Path) -> None:
    write_frames(tmp_path, [f"{i:06d}.png" for i in range(0, 60, 3)])
    assert [frame.timestamp_s for frame in opened(tmp_path, fps=30).frames()] == [i / 30 for i in range(0, 60, 3)]


@pytest.mark.parametrize("layout", [as_kitti, as_tum, as_folder, as_list, as_euroc])
def test_a_given_rate_wins(tmp_path: Path, layout: Callable[[Path, list[str]], None]) -> None:
    told: list[Event] = []
    layout(tmp_path, [written(ns, "ns") for ns in stamps_ns("1970", 10)])
    sequence = opened(tmp_path, told, fps=25)
    assert [frame.timestamp_s for frame in sequence.frames()] == [i / 25 for i in range(COUNT)]
    assert any("times of the sequence are not used: 25 frames a second" in event.message for event in told)
    assert sequence.imu is None
    if layout in (as_tum, as_euroc):  # the ground truth comes along: the pose of frame i is still its pose
        assert sequence.ground_truth is not None
        np.testing.assert_allclose(sequence.ground_truth.timestamps_s, np.arange(COUNT) / 25, atol=1e-6)
        assert rigid3.center(sequence.ground_truth.cam_from_world)[:, 0] == pytest.approx(range(COUNT))


def test_times_in_the_names_that_a_list_names_too(tmp_path: Path) -> None:
    texts = [written(ns, "ns") for ns in stamps_ns("boot", 10)]
    write_frames(tmp_path, [f"{text}.png" for text in texts])
    (tmp_path / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in texts))
    assert [frame.timestamp_s for frame in opened(tmp_path).frames()] == seconds(texts, "ns")


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("form", ["whole", "six decimals", "exponent"])
def test_nanoseconds_in_tums_form(tmp_path: Path, start: str, form: str) -> None:
    """As ORB-SLAM3 writes them for EuRoC, held against the same poses in seconds."""
    stamps = stamps_ns(start, 20)
    texts = {
        "whole": [str(ns) for ns in stamps], "six decimals": [f"{ns}.000000" for ns in stamps],
        "exponent": [f"{ns:.18e}" for ns in stamps],
    }[form]  # fmt: skip
    (tmp_path / "orb.txt").write_text(pose_rows(texts))
    (tmp_path / "ground_truth.tum").write_text(pose_rows([written(ns, "s") for ns in stamps]))
    result = evaluate(tmp_path / "orb.txt", tmp_path / "ground_truth.tum")
    assert len(result.pairs) == COUNT
    assert result.errors["se3"].absolute.translation_m.max() < 1e-9
    assert any("read as nanoseconds" in note for note in result.notes)
    write_frames(tmp_path / "frames", [f"{written(ns, 's')}.png" for ns in stamps])
    sequence = opened(tmp_path / "frames", ground_truth=str(tmp_path / "orb.txt"))
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.timestamps_s == pytest.approx([ns / 1e9 for ns in stamps], abs=1e-6)


def test_commas_and_seconds_need_titles_that_tell_the_order(tmp_path: Path) -> None:
    texts = [written(ns, "s") for ns in stamps_ns("boot", 20)]
    for titles, w_first in (("#t,px,py,pz,qw,qx,qy,qz\n", True), ("time,tx,ty,tz,q_x,q_y,q_z,q_w\n", False)):
        (tmp_path / "a.csv").write_text(titles + pose_rows(texts, ",", w_first))
        (tmp_path / "b.tum").write_text(pose_rows(texts))
        found = read_trajectory(tmp_path / "a.csv").trajectory
        np.testing.assert_allclose(found.rotation, read_trajectory(tmp_path / "b.tum").trajectory.rotation, atol=1e-12)
        assert found.timestamps_s is not None
        assert found.timestamps_s.tolist() == seconds(texts, "s")
    (tmp_path / "a.csv").write_text(pose_rows(texts, ","))
    with pytest.raises(InputError, match="whole nanoseconds"):
        read_trajectory(tmp_path / "a.csv")


def test_rows_of_whole_matrices(tmp_path: Path) -> None:
    rows = "1 0 0 5 0 1 0 6 0 0 1 7"
    (tmp_path / "a.txt").write_text(f"{rows} 0 0 0 1\n")
    assert read_trajectory(tmp_path / "a.txt").trajectory.position.tolist() == [[5, 6, 7]]
    for text, found in ((f"{rows} 0 0 0 2\n", "16 columns"), (f"0 {rows}\n", "13 columns")):
        (tmp_path / "a.txt").write_text(text)
        with pytest.raises(InputError, match=found):
            read_trajectory(tmp_path / "a.txt")


@given(st.text(alphabet="0123456789.e+-naif _", max_size=40))
def test_times_are_finite_or_refused(text: str) -> None:
    with contextlib.suppress(ValueError):
        assert np.isfinite(float(parse_time(text)))


@given(st.lists(st.integers(0, 10**19), min_size=1, max_size=8), st.sampled_from(["s", "ns"]))
def test_a_column_is_one_clock(values: list[int], unit: str) -> None:
    found = read_column("test", [Decimal(value) for value in values], unit)  # type: ignore[arg-type]
    assert found.seconds.tolist() == [float(Decimal(value).scaleb(-UNITS[found.unit])) for value in values]
    assert bool(found.note) == (found.unit != unit)


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("1305031102.1 1305031162.2 1305031222.3", "s"),  # poses a minute apart
        ("0 5 10 15", "s"), ("0.5 12.5 24", "s"), ("0 33.3 66.7", "ms"), ("0 33 67 100", "ms"), ("0 8 17 25", "ms"),
        ("2592000000 2592000033 2592000067", "ms"), ("2592000000000 2592000005000", "us"),
        ("0.000000e+00 1.036e-01 2.07e-01", "s"), ("1.403636579763555584e+18 1.403636579813555456e+18", "ns"),
        ("1305031102175", "ms"), ("17", "s"),
    ],
)  # fmt: skip
def test_units_of_columns_in_seconds(text: str, unit: str) -> None:
    assert read_column("test", [parse_time(field) for field in text.split()], "s").unit == unit


def test_a_single_name_and_none() -> None:
    assert times_of_names([]) is None
    assert times_of_names(["17"]) is None
    assert times_of_names(["1714564797123456789"]).seconds.tolist() == [1714564797.123456789]  # type: ignore[union-attr]
    assert not are_dates([])
