"""``sfmapp calibrate board FILM`` with default options on rendered films of a ChArUco board, a part of
benchmarks/calibration.py."""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from machine import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from board_views import filmed_board
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.comparison import projection_difference
from sfmapp.calibration.file import read_calibration_file
from sfmapp.calibration.uncertainty import projection_sigma
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main

Array = NDArray[np.float64]
Row = dict[str, Any]

BOARD = parse_board("charuco:6x5:0.03:0.022")
# an action camera: barrel distortion
TRUE = Camera(CameraModel.OPENCV, 400, 300, np.array([230.0, 231.0, 203.0, 148.0, -0.24, 0.045, 5e-4, -4e-4]))
# seeds, frames of one round of the board, and which of them are exposed while it moves
FILMS: dict[str, tuple[Sequence[int], int, range]] = {
    "five frames blurred": ((*range(8), *range(100, 108)), 36, range(12, 17)),
    "blurred throughout": (range(4), 72, range(72)),
}


def films() -> list[Row]:
    """The error of the camera that a film gives, over the picture, and in its own sigmas; a row for each film, and one
    for each kind: the rms in sigmas, and the NEES of the eight parameters with the band that right sigmas keep."""
    rows = []
    for kind, (seeds, num, blurred) in FILMS.items():
        own = [of_film(kind, seed, num, blurred) for seed in seeds]
        known = [row for row in own if "error_px" in row]
        nees = [row["nees"] for row in known if row["nees"] is not None]
        low, high = chi2.ppf([0.025, 0.975], 8 * len(nees)) / (8 * max(len(nees), 1))
        rows += own
        rows.append({
            "film": f"{kind}, all", "seed": f"{len(known)} of {len(own)}",
            "error_px": float(np.median([row["error_px"] for row in known])),
            "sigma_px": float(np.median([row["sigma_px"] for row in known])),
            "error_sigmas": float(np.sqrt(np.mean([row["error_sigmas"] ** 2 for row in known]))),
            "nees": float(np.mean(nees)), "nees_band": f"{low:.2f} to {high:.2f}",
        })  # fmt: skip
    return rows


def of_film(kind: str, seed: int, num: int, blurred: range) -> Row:
    """One film, written as MPEG-4, and what comes of it."""
    with tempfile.TemporaryDirectory() as folder:
        film, output = Path(folder) / "board.mp4", Path(folder) / "out"
        writer = cv2.VideoWriter(str(film), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (400, 300))
        for frame in filmed_board(TRUE, BOARD, num, set(blurred), seed=seed):
            writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
        writer.release()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as told:
            code = main(["calibrate", "board", str(film), "-o", str(output), "--no-recording"])
        if code:
            return {"film": kind, "seed": seed, "model": f"refused: {told.getvalue().splitlines()[-2]}"}
        made, board = read_calibration_file(output), json.loads((output / "report.json").read_text())["board"]
    xy, off, _ = projection_difference(TRUE, made.camera)
    sigma = projection_sigma(made, xy)
    error = made.camera.params - TRUE.params if made.camera.model == TRUE.model else None
    return {
        "film": kind, "seed": seed, "model": made.camera.model.name, "views": board["num_views"],
        "noise_px": made.noise_px, "error_px": float(np.nanmedian(np.hypot(*off.T))),
        "sigma_px": float(np.nanmedian(sigma)),
        "error_sigmas": float(np.sqrt(np.nanmean((off**2).sum(1) / (2.0 * sigma**2)))),
        "nees": None if error is None else float(error @ np.linalg.solve(made.covariance, error)) / len(error),
    }  # fmt: skip
