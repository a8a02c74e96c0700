"""How far ``--self-calibrate`` is off, and what it says: rendered rooms, halls and streets with random lenses.

    python benchmarks/self_calibration.py --sequences 40 OUT

Prints a row for each sequence and, over those that were not refused, the share whose focal length is within two stated
standard deviations, and the worst error of those that were called settled. A sequence takes minutes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

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
    args = parser.parse_args()
    scores, settled = [], []
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
            print(f"{folder.name}: {focal:.1f} px, refused: {refusal}", flush=True)
            continue
        sigma = found["focal_sigma_relative"]
        error = next(found["params"][name] for name in ("f", "fx") if name in found["params"]) / focal - 1
        scores.append(abs(error) / sigma)
        settled += [abs(error)] if found["is_settled"] else []
        word = "settled" if found["is_settled"] else "not settled"
        print(f"{folder.name}: {focal:.1f} px, {100 * error:+.2f} % of {100 * sigma:.2f} %, {word}", flush=True)
    if scores:
        print(f"{np.mean(np.array(scores) < 2):.0%} of {len(scores)} within two sigmas")
        print(f"{len(settled)} settled, at worst {100 * max(settled, default=0.0):.2f} % off")


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
