"""How long ``sfmapp calibrate board`` takes beside OpenCV: parts of benchmarks/calibration.py."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from board_views import board_poses, board_views, render_board
from sfmapp.calibration.adjustment import TargetView, observations_of, refine, residuals_of
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.comparison import projection_difference
from sfmapp.calibration.file import read_calibration_file
from sfmapp.calibration.start import posed
from sfmapp.calibration.zhang import closed_form
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]
Row = dict[str, Any]
T = TypeVar("T")

CHESS = parse_board("chessboard:9x6:0.025")
SIZE = (1280, 960)
# a lens that two coefficients describe, so that the rational model has numbers to spare, and one that needs all of it
LENSES = {
    "two coefficients": Camera(
        CameraModel.OPENCV, *SIZE, np.array([1000.0, 1010.0, 630.0, 490.0, -0.2, 0.05, 1e-3, -5e-4])
    ),
    "six coefficients": Camera(
        CameraModel.FULL_OPENCV, *SIZE,
        np.array([610.0, 612.0, 636.0, 486.0, 0.45, -2.4, 6e-4, -3e-4, 1.4, 0.33, -2.2, 1.3]),
    ),
}  # fmt: skip
SEEDS = range(5, 11)
PHONE = Camera(CameraModel.OPENCV, 4000, 3000, np.array([3100.0, 3100.0, 2010.0, 1490.0, 0.12, -0.25, 1e-3, -5e-4]))
PHOTOGRAPHS, THREADS = 30, 2
_RENDER = "render"


def refinement() -> list[Row]:
    """The rational model on 30 views of 54 points, against ``cv2.calibrateCamera``: both from the same guess, 4 %
    short of the focal length and without distortion, and both from nothing. CPU seconds, the least of three."""
    cv2.setNumThreads(1)
    rows = []
    for name, truth in LENSES.items():
        for seed in SEEDS:
            rng = np.random.default_rng(seed)
            views = board_views(truth, CHESS, board_poses(rng, CHESS, 30, truth), 0.2, rng)
            focal = 0.96 * truth.params[0]
            guess = rational(focal, focal, 0.5 * SIZE[0], 0.5 * SIZE[1])
            matrix = np.array([[focal, 0.0, guess.params[2] - 0.5], [0.0, focal, guess.params[3] - 0.5], [0, 0, 1.0]])
            obs = observations_of(views)
            fit, ours = least(lambda guess=guess, views=views, obs=obs: refine(posed(guess, views), obs))
            rms, theirs = least(lambda views=views, matrix=matrix: opencvs(views, matrix))
            _, alone = least(lambda views=views, obs=obs: from_nothing(views, obs))
            _, theirs_alone = least(lambda views=views: opencvs(views, None))
            rows.append({
                "lens": name, "seed": seed, "cpu_ms": 1e3 * ours, "opencv_cpu_ms": 1e3 * theirs,
                "times": theirs / ours, "from_nothing_cpu_ms": 1e3 * alone,
                "opencv_from_nothing_cpu_ms": 1e3 * theirs_alone, "times_from_nothing": theirs_alone / alone,
                "rms_px": float(np.sqrt((residuals_of(fit, obs) ** 2).sum(1).mean())), "opencv_rms_px": rms,
            })  # fmt: skip
    return rows


def rational(fx: float, fy: float, cx: float, cy: float) -> Camera:
    """A camera of the rational model without distortion."""
    return Camera(CameraModel.FULL_OPENCV, *SIZE, np.array([fx, fy, cx, cy, *[0.0] * 8]))


def from_nothing(views: list[TargetView], obs: Any) -> Any:
    """Zhang's closed form, poses, and the refinement."""
    k = closed_form(views, SIZE).k_matrix
    assert k is not None
    return refine(posed(rational(k[0, 0], k[1, 1], k[0, 2], k[1, 2]), views), obs)


def opencvs(views: list[TargetView], matrix: Array | None) -> float:
    """Rms of ``cv2.calibrateCamera`` with the rational model."""
    objects = [view.xyz.astype(np.float32) for view in views]
    pixels = [(view.xy - 0.5).astype(np.float32)[:, None] for view in views]
    flags = cv2.CALIB_RATIONAL_MODEL | (0 if matrix is None else cv2.CALIB_USE_INTRINSIC_GUESS)
    begin = (None, None) if matrix is None else (matrix.copy(), np.zeros(8))
    return float(cv2.calibrateCamera(objects, pixels, SIZE, *begin, flags=flags)[0])


def least(job: Callable[[], T]) -> tuple[T, float]:
    """What a job gives, and the least CPU time of three runs after one that compiles."""
    result, times = job(), []
    for _ in range(3):
        start = time.process_time()
        result = job()
        times.append(time.process_time() - start)
    return result, min(times)


# ------------------------------------------------------------------------------------------- photographs of 12 MP


def photographs_12_mp() -> list[Row]:
    """Thirty photographs of 12 MP end to end, on two threads: ours as its command with default options but for the
    board, OpenCV's finders with cornerSubPix and ``calibrateCamera`` (k1, k2, p1, p2)."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="boards-") as name:
        folder = Path(name) / "photographs"
        folder.mkdir()
        # in a process of its own: what this one has used counts as what its children begin with
        run([sys.executable, __file__, _RENDER, str(folder)])
        for program in ("sfmapp", "sfmapp", "OpenCV findChessboardCorners", "OpenCV findChessboardCornersSB"):
            out = Path(name) / f"out-{len(rows)}"
            if program == "sfmapp":
                command = [
                    sys.executable, "-m", "sfmapp", "calibrate", "board", str(folder), "-o", str(out), "--board",
                    CHESS.text(), "--threads", str(THREADS), "-q",
                ]  # fmt: skip
            else:
                command = [sys.executable, __file__, program, str(folder), str(out)]
            row: Row = {"program": program, **run(command)}
            if program == "sfmapp":
                camera = read_calibration_file(out).camera
                pictures = json.loads((out / "report.json").read_text())["board"]["pictures"]
                row |= {"found": sum(one["num_points"] > 0 for one in pictures), "model": camera.model.name}
            else:
                told = json.loads(out.read_text())
                camera = Camera(CameraModel.OPENCV, PHONE.width, PHONE.height, np.array(told["params"]))
                row |= {"found": told["found"], "model": "OPENCV"}
            off = projection_difference(PHONE, camera)[1]
            row["projection_error_px"] = float(np.sqrt(np.nanmean((off**2).sum(1))))
            rows.append(row)
    # the first run of ours loads or compiles kernels
    rows[0]["program"] = "sfmapp, first run"
    return rows


def render_photographs(folder: Path) -> None:
    """Photographs of a board before a real scene where there is one, with noise, as JPEG files."""
    half = Camera(PHONE.model, 2000, 1500, np.where(np.arange(8) < 4, 0.5 * PHONE.params, PHONE.params))
    data = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
    scenes = sorted((data / "fountain-P11" / "images").glob("*.jpg"))
    rng = np.random.default_rng(12)
    for n, pose in enumerate(board_poses(rng, CHESS, PHOTOGRAPHS, half)):
        scene = cv2.imread(str(scenes[n % len(scenes)]), cv2.IMREAD_GRAYSCALE) if scenes else None
        gray = render_board(half, CHESS, pose, blur_px=0.4, background=scene)
        gray = cv2.resize(gray, (PHONE.width, PHONE.height), interpolation=cv2.INTER_CUBIC)
        noisy = gray + rng.normal(0.0, 3.0, gray.shape).astype(np.float32)
        pixels = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{n:02d}.jpg"), cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR))


def run(command: list[str]) -> Row:
    """Wall and CPU seconds and peak memory of a process."""
    start = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"expected success of {command}, found status {status}")
    cpu = usage.ru_utime + usage.ru_stime
    return {"wall_s": time.perf_counter() - start, "cpu_s": cpu, "peak_mb": usage.ru_maxrss / 1024}


def opencv_child(program: str, folder: Path, out: Path) -> None:
    """Find the board in all photographs and calibrate by OpenCV."""
    cv2.setNumThreads(THREADS)
    objects, pixels = [], []
    for path in sorted(folder.glob("*.jpg")):
        gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if program.endswith("SB"):
            is_found, corners = cv2.findChessboardCornersSB(gray, (9, 6))
        else:
            is_found, corners = cv2.findChessboardCorners(gray, (9, 6))
            if is_found:
                stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
                corners = cv2.cornerSubPix(gray, corners, (11, 11), (-1, -1), stop)
        if is_found:
            objects.append(CHESS.points.astype(np.float32))
            pixels.append(corners.reshape(-1, 1, 2).astype(np.float32))
    found = len(objects)
    _, k, d, *_ = cv2.calibrateCamera(objects, pixels, gray.shape[::-1], None, None, flags=cv2.CALIB_FIX_K3)
    params = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *d.ravel()[:4]]
    out.write_text(json.dumps({"found": found, "params": params, "rss": resource.getrusage(0).ru_maxrss}))


if __name__ == "__main__":
    if sys.argv[1] == _RENDER:
        render_photographs(Path(sys.argv[2]))
    else:
        opencv_child(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
