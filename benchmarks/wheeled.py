"""What ``odometry.motion=planar`` and ``ackermann`` bring a camera on wheels, and whether they stay honest elsewhere.

    python benchmarks/wheeled.py --seeds 0 1 2

A car drives along a rendered street, one camera of 620x188. Level; leaning by two degrees in its turns; over a ramp;
behind pieces of its own pictures that move about on their own and cover 20, 40 and 60 % of every picture; with a fifth
of the contrast. Each is tracked in the three ways. ATE is after the best similarity, of the frames that have a pose in
the largest map; NEES is of its keyframes, a degree of freedom, in the gauge of their covariances.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import sfmapp
from machine import RESULTS, describe_machine
from rendered_worlds import sequences as rendered
from sfmapp.adjust.covariance import pose_errors_in_gauge
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate
from sfmapp.geometry import similarity
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.run import run_odometry
from sfmapp.scene.rig import Rig

Images = list[NDArray[np.uint8]]
Array = NDArray[np.float64]

CAMERA = Camera(CameraModel.PINHOLE, 620, 188, np.array([359.428, 359.428, 303.85, 92.86]))
KINDS = ("level", "leaning", "ramp", "20 % outliers", "40 % outliers", "60 % outliers", "low contrast")
MOTIONS: tuple[Literal["free", "planar", "ackermann"], ...] = ("free", "planar", "ackermann")
FPS = 10.0
_PIECE_PX = 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "wheeled.json")
    args = parser.parse_args()
    machine, runs = describe_machine(), list[dict[str, Any]]()
    for seed in args.seeds:
        made: dict[str, tuple[Images, rendered.RenderedSequence]] = {}
        for kind in args.kinds:
            runs.append(drive(kind, seed, args.frames, made))
            print(described(runs[-1]), flush=True)
            args.output.write_text(json.dumps(machine | {"num_frames": args.frames, "runs": runs}, indent=1) + "\n")
    args.output.with_suffix(".md").write_text(table(runs))
    print(table(runs))


def drive(
    kind: str, seed: int, num_frames: int, made: dict[str, tuple[Images, rendered.RenderedSequence]]
) -> dict[str, Any]:
    """One drive, tracked in all ways; ``made``: what was rendered of this seed."""
    way = kind if kind in ("leaning", "ramp") else "level"
    if way not in made:
        lean, ramp = (2.0 if way == "leaning" else 0.0), (4.0 if way == "ramp" else 0.0)
        street = rendered.street(num_frames, seed, rig=Rig.single(CAMERA), lean_deg=lean, ramp_m=ramp)
        made[way] = [street.image(k) for k in range(num_frames)], street
    images, street = made[way]
    if kind.endswith("outliers"):
        images = covered(images, 0.01 * int(kind.split()[0]), seed)
    elif kind == "low contrast":
        images = [np.round(110.0 + 0.2 * (image - 110.0)).astype(np.uint8) for image in images]
    run: dict[str, Any] = {"kind": kind, "seed": seed}
    for motion in MOTIONS:
        source = sfmapp.ArraySequence(images, Rig.single(CAMERA), timestamps_s=street.timestamps_s, fps=FPS)
        run[motion] = judged(run_odometry(source, OdometryOptions(motion=motion), threads=2), street)
    return run


def covered(images: Images, share: float, seed: int) -> Images:
    """The pictures behind pieces of others that move about, each at its own steady speed, over a share of the area."""
    rng = np.random.default_rng([seed, 0xC0])
    height, width = images[0].shape
    # pieces overlap: n of them leave exp(-n a / A) of the area
    count = int(-np.log(1.0 - share) * height * width / _PIECE_PX**2)
    place = rng.uniform(0.0, [width, height], (count, 2))
    speed = rng.normal(0.0, 2.0, (count, 2))
    # cut from pictures of the drive, so that they have as many corners as what they cover
    cuts = np.floor(rng.uniform(0.0, [len(images), width - _PIECE_PX, height - _PIECE_PX], (count, 3))).astype(int)
    skins = [images[k][y : y + _PIECE_PX, x : x + _PIECE_PX] for k, x, y in cuts]
    out = []
    for number, image in enumerate(images):
        picture = np.pad(image, _PIECE_PX)
        at = np.floor((place + number * speed) % [width + _PIECE_PX, height + _PIECE_PX]).astype(int)
        for (x, y), skin in zip(at, skins, strict=True):
            picture[y : y + _PIECE_PX, x : x + _PIECE_PX] = skin
        out.append(np.ascontiguousarray(picture[_PIECE_PX:-_PIECE_PX, _PIECE_PX:-_PIECE_PX]))
    return out


def judged(result: Any, street: rendered.RenderedSequence) -> dict[str, Any]:
    """The largest map against the ground truth."""
    if not len(result.maps):
        return {"num_frames": 0}
    number = int(np.bincount(result.frame_map[result.frame_map >= 0]).argmax())
    frames = np.flatnonzero(result.frame_map == number)
    times = street.timestamps_s[result.frame_idx[frames]]
    pairs = associate(
        Trajectory.from_cam_from_world(result.cam_from_world[frames], times),
        Trajectory.from_cam_from_world(street.cam_from_world, street.timestamps_s),
    )
    ate = absolute_error(pairs, "sim3").translation_m
    entry = result.maps[number]
    row: dict[str, Any] = {"num_frames": len(frames), "ate_m": float(np.sqrt((ate**2).mean()))}
    row["nees"] = nees(entry, street.cam_from_world)
    return row if entry.plane is None else row | {"plane": dict(entry.plane)}


def nees(entry: Any, cam_from_world: Array) -> float | None:
    """Mean squared normalised error of the keyframes, a degree of freedom; None without covariances."""
    if entry.covariance is None:
        return None
    images, model = entry.keyframe_image_idx, entry.reconstruction
    truth = model.copy()
    ours, theirs = model.cam_from_world[images], cam_from_world[entry.keyframe_frame_idx]
    truth.cam_from_world[images] = similarity.transform_poses(similarity.align_poses(theirs, ours).b_from_a, theirs)
    errors = pose_errors_in_gauge(model, truth, images, 7)
    known = np.isfinite(entry.covariance).all((1, 2))
    scores = [e @ np.linalg.solve(c, e) / 6.0 for e, c in zip(errors[known], entry.covariance[known], strict=True)]
    return float(np.mean(scores)) if scores else None


def described(run: dict[str, Any]) -> str:
    """A drive in a line."""
    words = [f"{run['kind']}, seed {run['seed']}:"]
    for motion in MOTIONS:
        row = run[motion]
        words.append(f"{motion} {row['num_frames']} frames")
        if "ate_m" in row:
            words.append(f"ATE {row['ate_m']:.3f} m, NEES {row['nees'] or float('nan'):.2f}")
        if "plane" in row:
            words.append(f"({row['plane']['state']}: {row['plane'].get('reason', '')})")
    return " ".join(words)


def table(runs: list[dict[str, Any]]) -> str:
    """Each kind of drive in a row."""
    lines = [
        "Rendered drives of one camera on a car (`python benchmarks/wheeled.py`): tracked freely, and with",
        "`odometry.motion=planar` and `ackermann`. Medians over the seeds, frames with a pose as sums; ATE Sim3 of the",
        "frames with a pose, ratios where both have some; NEES a degree of freedom. A share of outliers is that of",
        "every picture that is covered by pieces of others, which move.",
        "",
        "| drive | seeds | frames with a pose, free | planar | ackermann | ATE free | planar | ackermann "
        "| planar / free | ackermann / free | NEES free | planar | ackermann | plane held | dropped | offered |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in dict.fromkeys(run["kind"] for run in runs):
        mine = [run for run in runs if run["kind"] == kind]
        states = [run[motion].get("plane", {}).get("state") for run in mine for motion in MOTIONS]
        cells = [str(sum(run[motion]["num_frames"] for run in mine)) for motion in MOTIONS]
        cells += [_median([run[m]["ate_m"] for run in mine if "ate_m" in run[m]], "m", 3) for m in MOTIONS]
        for motion in MOTIONS[1:]:
            both = [run for run in mine if "ate_m" in run["free"] and "ate_m" in run[motion]]
            cells.append(_median([run[motion]["ate_m"] / run["free"]["ate_m"] for run in both], "", 2))
        cells += [_median([run[m]["nees"] for run in mine if run[m].get("nees") is not None], "", 2) for m in MOTIONS]
        cells += [str(states.count(state)) for state in ("held", "dropped", "offered")]
        lines.append("| " + " | ".join([kind, str(len(mine)), *cells]) + " |")
    return "\n".join(lines) + "\n"


def _median(values: list[float], unit: str, digits: int) -> str:
    return f"{np.median(values):.{digits}f} {unit}".strip() if values else ""


if __name__ == "__main__":
    main()
