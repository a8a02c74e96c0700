"""Disparity files: round trips, other readers, and what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.disparity_files import fits_kitti, read_disparity, write_disparity


@pytest.fixture
def disparity() -> NDArray[np.float32]:
    """On KITTI's grid of 1/256 pixel, a tenth unknown."""
    rng = np.random.default_rng(3)
    values = rng.integers(1, 65536, (7, 11)) / 256.0
    values[rng.random(values.shape) < 0.1] = np.nan
    return values.astype(np.float32)


@pytest.mark.parametrize("suffix", [".pfm", ".png", ".npy"])
def test_what_is_written_is_read_back(tmp_path: Path, disparity: NDArray[np.float32], suffix: str) -> None:
    write_disparity(tmp_path / f"d{suffix}", disparity)
    found = read_disparity(tmp_path / f"d{suffix}")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, disparity)


def test_opencv_reads_the_same(tmp_path: Path, disparity: NDArray[np.float32]) -> None:
    write_disparity(tmp_path / "d.pfm", disparity)
    write_disparity(tmp_path / "d.png", disparity)
    theirs = cv2.imread(str(tmp_path / "d.pfm"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(np.where(np.isinf(theirs), np.nan, theirs), disparity)
    steps = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(steps, np.nan_to_num(256 * disparity))


def test_a_pfm_file_whose_highest_byte_comes_first(tmp_path: Path) -> None:
    (tmp_path / "d.pfm").write_bytes(b"Pf\n2 2\n1.0\n" + np.array([3, 4, 1, np.inf], ">f4").tobytes())
    np.testing.assert_array_equal(read_disparity(tmp_path / "d.pfm"), [[1, np.nan], [3, 4]])


def test_disparities_below_zero(tmp_path: Path) -> None:
    values = np.array([[-3.25, 0.0], [np.nan, 300.5]], np.float32)
    for suffix in (".pfm", ".npy"):
        write_disparity(tmp_path / f"d{suffix}", values)
        np.testing.assert_array_equal(read_disparity(tmp_path / f"d{suffix}"), values)
    assert not fits_kitti(values)
    with pytest.raises(InputError, match=r"d\.png.*-3\.25 to 300\.5"):
        write_disparity(tmp_path / "d.png", values)
    assert not (tmp_path / "d.png").exists()


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("d.pfm", b"PF\n1 1\n-1\n" + b"\0" * 12, "three channels"),
        ("d.pfm", b"P5\n1 1\n255\n\0", "begins with Pf"),
        ("d.pfm", b"Pf\n2 1\n-1\n" + b"\0" * 4, "expected 8 bytes"),
        ("d.pfm", b"Pf\n1 1\n0\n" + b"\0" * 4, "scale other than zero"),
        ("d.png", b"", "found no picture"),
        ("d.png", cv2.imencode(".png", np.ones((2, 2), np.uint8))[1].tobytes(), "found uint8"),
        ("d.npy", b"\x93NUMPY", "NumPy array file"),
        ("d.tif", b"", "found .tif"),
    ],
)
def test_other_files_are_refused_by_name(tmp_path: Path, name: str, data: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=said) as raised:
        read_disparity(tmp_path / name)
    assert name in str(raised.value)


def test_an_array_of_three_dimensions_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.zeros((2, 2, 3)))
    with pytest.raises(InputError, match=r"two dimensions.*\(2, 2, 3\)"):
        read_disparity(tmp_path / "d.npy")
    with pytest.raises(InputError, match="cannot be read"):
        read_disparity(tmp_path / "none.npy")
