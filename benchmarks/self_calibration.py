"""How far ``--self-calibrate`` is off, and what it says: rendered rooms, halls and streets with random lenses.

    python benchmarks/self_calibration.py --sequences 40 OUT

Prints a row for each sequence and, over those that were not refused, the share whose focal length is within two stated
standard deviations, and the worst error of those that were called settled. A sequence takes minutes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from machine import RESULTS, describe_machine
from rendered_worlds import sequences as rendered
from rendered_worlds.sequences import RenderedSequence
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.pipelines.odometry.self_calibrate import self_calibrated
from sfmapp.scene.rig import Rig
from sfmapp.workspace.options import load_options

# place: frames rendered, every how many of them is kept, size of a picture
PLACES = {"room": (360, 6, (640, 480)), "hall": (240, 4, (752, 480)), "street": (200, 2, (1241, 376))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for the pictures, which are used again")
    parser.add_argument("--sequences", type=int, default=40)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "self_calibration.json")
    args = parser.parse_args()
    runs: list[dict[str, Any]] = []
    for number in range(args.sequences):
        place = list(PLACES)[number % len(PLACES)]
        rng = np.random.default_rng([number, 0x5E1F])
        size = PLACES[place][2]
        # from a wide car camera to a phone's, with barrel distortion that still has an inverse in the corners
        focal, k1 = rng.uniform(0.55, 1.1) * size[0], rng.choice([0.0, -0.05, -0.1]) * (place != "street")
        folder = args.out / f"{place}-{number}"
        write_frames(folder, place, number, Camera(CameraModel.SIMPLE_RADIAL, *size, lens(focal, k1, size)))
        try:
            _, found = self_calibrated(str(folder), load_options(settings=["sequence.fps=10"]), Events())
        except InputError as refusal:
            runs.append({"sequence": folder.name, "focal_px": focal, "is_refused": True, "reason": str(refusal)})
            print(f"{folder.name}: {focal:.1f} px, refused: {refusal}", flush=True)
            continue
        error = next(found["params"][name] for name in ("f", "fx") if name in found["params"]) / focal - 1
        run = {"sequence": folder.name, "focal_px": focal, "is_refused": False, "error_percent": 100 * error}
        runs.append(run | {"sigma_percent": 100 * found["focal_sigma_relative"], "is_settled": found["is_settled"]})
        print(described(runs[-1]), flush=True)
    args.output.write_text(json.dumps(describe_machine() | {"runs": runs}, indent=1) + "\n")
    print(summary([run for run in runs if not run["is_refused"]]))


def described(run: dict[str, Any]) -> str:
    """A sequence in a line."""
    error, sigma, word = run["error_percent"], run["sigma_percent"], "settled" if run["is_settled"] else "not settled"
    return f"{run['sequence']}: {run['focal_px']:.1f} px, {error:+.2f} % of {sigma:.2f} %, {word}"


def summary(runs: list[dict[str, Any]]) -> str:
    """Those that were not refused, in two lines."""
    within = sum(abs(run["error_percent"]) < 2 * run["sigma_percent"] for run in runs)
    settled = [abs(run["error_percent"]) for run in runs if run["is_settled"]]
    return (
        f"{within} of {len(runs)} within two sigmas\n"
        f"{len(settled)} settled, at worst {max(settled, default=0.0):.2f} % off"
    )


def lens(focal: float, k1: float, size: tuple[int, int]) -> np.ndarray:
    """Parameters of a SIMPLE_RADIAL camera with its centre in the middle."""
    return np.array([focal, size[0] / 2, size[1] / 2, k1])


def write_frames(folder: Path, place: str, seed: int, camera: Camera) -> None:
    """Render what is not there yet."""
    count, step, _ = PLACES[place]
    sequence: RenderedSequence = (
        rendered.room(count, seed, camera=camera)
        if place == "room"
        else getattr(rendered, place)(count, seed, rig=Rig.single(camera))
    )
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(0, count, step):
        path = folder / f"{frame:06d}.png"
        if not path.exists():
            cv2.imwrite(str(path), sequence.image(frame))


if __name__ == "__main__":
    main()
