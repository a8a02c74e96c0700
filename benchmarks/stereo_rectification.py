"""How well rows of rectified pairs are epipolar lines, beside OpenCV's stereoRectify, and rigs that have turned.

    python benchmarks/stereo_rectification.py            # results/stereo_rectification.md
    python benchmarks/stereo_rectification.py --seeds 2 -o /tmp/new/stereo_rectification.md

*Fountain*: neighbouring photographs of Strecha's fountain-P11 through the registered cameras, and with nothing known
of them. *Boards*: corners of the thirteen pairs of OpenCV's samples, each program through its own calibration of the
same corners. *Rendered*: two cameras of different lenses that converge, at several places of rendered worlds.
Vertical parallax is y_left - y_right of matches, those of rendered pairs aligned to hundredths of a pixel in the
rectified pictures of either program, divided by how much its rectification enlarges the photograph, so that pixels
are those of the photographs. *Turned*: the right camera of a rendered rig is turned by 0.05 degrees after its
calibration.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dense_pairs import looking
from machine import RESULTS, ROOT, describe_machine
from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.sequences import RenderedSequence, hall, hall_rig, street, street_rig
from rendered_worlds.worlds import gallery_world, hall_world, room_world, street_world
from rigs import calibrate_samples
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.geometry.epipolar import sampson_errors
from sfmapp.geometry.two_rays import fundamental_of
from sfmapp.scene.rig import Rig
from sfmapp.stereo.alignment import aligned_matches
from sfmapp.stereo.depth import depth_of_disparity
from sfmapp.stereo.disparity_error import disparity_error
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.polar import on_photograph
from sfmapp.stereo.polar_pair import prepare_polar
from sfmapp.stereo.prepare import PairCameras, PreparedPair, PrepareOptions, prepare_pair, turn_of_rig
from sfmapp.stereo.rectification import Rectification, plan_rectification, rectify
from sfmapp.stereo.sparse_matches import PairMatches, match_pictures
from sfmapp.stereo.uncalibrated import rig_from_matches

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

NAMES = ("left", "right")
TURN_DEG = 0.05
WORLDS: dict[str, tuple[Callable[..., RenderedSequence], Rig]] = {
    "street": (street, street_rig()), "hall": (hall, hall_rig())
}  # fmt: skip
# where the first camera stands, its heading and tilt, where the second is from it (right, down, forward), focal length
FORWARD = (
    ("street", street_world(1), (-24.0, -1.6, 1.65), (0.0, -1.0), (0.05, 0.02, 1.0), 700.0),
    ("street, other way", street_world(3), (-10.0, 1.2, 1.6), (180.0, 0.0), (0.02, 0.0, 1.4), 700.0),
    ("hall", hall_world(1), (2.0, -5.0, 1.8), (75.0, -8.0), (0.1, 0.0, 0.8), 600.0),
    ("hall, other way", hall_world(2), (-2.5, 4.0, 2.2), (-70.0, -12.0), (-0.05, 0.05, 0.6), 600.0),
    ("gallery", gallery_world(1), (-1.2, -1.5, 1.4), (60.0, -10.0), (0.03, 0.0, 0.25), 620.0),
    ("room, backwards", room_world(1), (1.6, -1.9, 1.5), (120.0, -12.0), (-0.02, 0.02, -0.3), 600.0),
)
# two lenses of one size, which is all that stereoRectify takes
_TURN = rigid3.exp_so3(np.radians([1.0, -8.0, 1.5]))
CONVERGING = Rig(
    (
        Camera(CameraModel.OPENCV, 752, 480, np.array([520.0, 522.0, 381.0, 236.0, -0.24, 0.06, 4e-4, -3e-4])),
        Camera(CameraModel.OPENCV, 752, 480, np.array([640.0, 638.0, 366.0, 247.0, -0.12, 0.02, -2e-4, 5e-4])),
    ),
    np.array([rigid3.IDENTITY, rigid3.from_matrix(_TURN, -_TURN @ [0.25, 0.01, 0.02])]),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6, help="places of each rendered world")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "stereo_rectification.md")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    data = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
    report = describe_machine()
    report["fountain"] = list(fountain(data / "fountain-P11"))
    report["boards"] = boards(data / "opencv-doc-samples" / "calib")
    report["rendered"] = [rendered(seed) for seed in range(arguments.seeds)]
    report["turned"] = [row for seed in range(arguments.seeds) for row in turned(seed)]
    report["together"] = [together(place, range(arguments.seeds)) for place in WORLDS]
    report["forward"] = [forward(*case) for case in FORWARD]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    arguments.output.write_text(tables(report), encoding="utf-8")
    print(tables(report))


# ---------------------------------------------------------------------------------------------------------- OpenCV's


@dataclass(frozen=True)
class Theirs:
    """stereoRectify with its defaults: rotations and projections of both cameras."""

    rig: Rig
    rotations: tuple[Array, Array]
    projections: tuple[Array, Array]

    @classmethod
    def of(cls, rig: Rig) -> Theirs:
        matrices, coefficients = _terms(rig)
        pose = rig.cam_from_rig[1]
        size = rig.cameras[0].width, rig.cameras[0].height
        found = cv2.stereoRectify(
            matrices[0], coefficients[0], matrices[1], coefficients[1], size, rigid3.rotation_matrix(pose),
            pose[4:].reshape(3, 1).copy(),
        )  # fmt: skip
        return cls(rig, (found[0], found[1]), (found[2], found[3]))

    def points(self, side: int, xy: Array) -> Array:
        matrices, coefficients = _terms(self.rig)
        flat = cv2.undistortPoints(
            np.ascontiguousarray(xy[:, None] - 0.5), matrices[side], coefficients[side], R=self.rotations[side],
            P=self.projections[side], criteria=(3, 100, 1e-10),
        )  # fmt: skip
        return np.asarray(flat[:, 0] + 0.5, np.float64)

    def picture(self, side: int, photograph: Pixels) -> Pixels:
        matrices, coefficients = _terms(self.rig)
        maps = cv2.initUndistortRectifyMap(
            matrices[side], coefficients[side], self.rotations[side], self.projections[side],
            photograph.shape[1::-1], cv2.CV_32FC1,
        )  # fmt: skip
        return np.asarray(cv2.remap(photograph, maps[0], maps[1], cv2.INTER_CUBIC))


def _terms(rig: Rig) -> tuple[list[Array], list[Array]]:
    matrices = [camera.k_matrix for camera in rig.cameras]
    for matrix in matrices:
        matrix[:2, 2] -= 0.5
    return matrices, [camera.canonical[4:8] for camera in rig.cameras]


def enlargement(plan: Rectification | Theirs, side: int) -> float:
    """Pixels of the result for one of the photograph, along a side: the median over its middle half."""
    camera = plan.rig.cameras[side]
    x, y = np.meshgrid(np.linspace(0.25, 0.75, 15) * camera.width, np.linspace(0.25, 0.75, 15) * camera.height)
    middle = np.stack([x.ravel(), y.ravel()], 1)
    along, down = (plan.points(side, middle + step) - plan.points(side, middle - step) for step in ([0.5, 0], [0, 0.5]))
    return float(np.sqrt(np.median(np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0]))))


def parallax(plan: Rectification | Theirs, matches: PairMatches) -> float:
    """Root of the mean square of y_left - y_right of matches of the photographs, in pixels of these."""
    left, right = plan.points(0, matches.left), plan.points(1, matches.right)
    off = (left[:, 1] - right[:, 1]) / np.sqrt(enlargement(plan, 0) * enlargement(plan, 1))
    return float(np.sqrt(np.nanmean(off**2)))


def seen_parallax(plan: Rectification | Theirs, pictures: tuple[Pixels, Pixels], matches: PairMatches) -> Array:
    """(N,) the same of each match when it is aligned in the rectified pictures; NaN where that fails or is gross."""
    mapped = PairMatches(plan.points(0, matches.left), plan.points(1, matches.right))
    found = aligned_matches(*pictures, mapped)
    place = {tuple(xy): k for k, xy in enumerate(mapped.left.tolist())}
    off = np.full(len(matches), np.nan)
    off[[place[tuple(xy)] for xy in found.left.tolist()]] = found.row_differences
    off /= np.sqrt(enlargement(plan, 0) * enlargement(plan, 1))
    return np.where(np.abs(off) < 0.5, off, np.nan)


# -------------------------------------------------------------------------------------------------------- photographs


def fountain(folder: Path) -> Iterator[dict[str, Any]]:
    """Neighbouring photographs through the cameras of the ground truth, and with nothing known."""
    told = json.loads((folder / "cameras.json").read_text())["cameras"]
    for one, other in zip(told[1:], told, strict=False):  # the camera went from the right to the left
        rig = _rig_of(one, other)
        pictures = [cv2.imread(str(folder / each["file"]), cv2.IMREAD_GRAYSCALE) for each in (one, other)]
        matches = match_pictures(*pictures)
        projections = [
            camera.k_matrix @ np.column_stack([rigid3.rotation_matrix(pose), pose[4:]])
            for camera, pose in zip(rig.cameras, rig.cam_from_rig, strict=True)
        ]
        errors = sampson_errors(fundamental_of(*projections), matches.left, matches.right)
        matches = matches.of(errors < 2.0**2)
        ours, theirs = plan_rectification(rig), Theirs.of(rig)
        alone = plan_rectification(rig_from_matches(matches, ((1536, 1024), (1536, 1024))).rig)
        yield {
            "pair": f"{Path(one['file']).stem}, {Path(other['file']).stem}", "matches": len(matches),
            "sfmapp": parallax(ours, matches), "OpenCV": parallax(theirs, matches),
            "uncalibrated": parallax(alone, matches), "kept": min(ours.kept),
        }  # fmt: skip


def _rig_of(one: dict[str, Any], other: dict[str, Any]) -> Rig:
    cameras = tuple(
        Camera(
            CameraModel.PINHOLE, 1536, 1024,
            np.array([k[0][0], k[1][1], k[0][2] + 0.5, k[1][2] + 0.5]),
        )
        for k in (one["K"], other["K"])
    )  # fmt: skip
    poses = [rigid3.from_matrix(np.array(each["R_w2c"]), np.array(each["t_w2c"]).ravel()) for each in (one, other)]
    return Rig(cameras, np.array([rigid3.IDENTITY, rigid3.compose(poses[1], rigid3.inverse(poses[0]))]))


def boards(folder: Path) -> dict[str, Any]:
    """Corners of the thirteen pairs, each program with its own calibration, and both with ours."""
    samples = calibrate_samples(folder)
    left, right = (np.concatenate([samples.corners[side, t] for t in range(samples.num)]) for side in (0, 1))
    matches = PairMatches(left, right)
    ours, theirs = samples.ours, samples.theirs
    return {
        "corners": len(matches),
        "sfmapp": parallax(plan_rectification(ours), matches),
        "OpenCV": parallax(Theirs.of(theirs), matches),
        "OpenCV with our calibration": parallax(Theirs.of(ours), matches),
        "sfmapp with OpenCV's calibration": parallax(plan_rectification(theirs), matches),
    }


# ----------------------------------------------------------------------------------------------------------- rendered


def _photographs(world: World, rig: Rig, pose: Array, seed: int) -> tuple[Pixels, Pixels]:
    pictures = [
        Renderer(world, camera).photograph(rigid3.compose(mount, pose), Optics(noise_sigma=2.0), [seed, side])
        for side, (camera, mount) in enumerate(zip(rig.cameras, rig.cam_from_rig, strict=True))
    ]
    return pictures[0], pictures[1]


def rendered(seed: int) -> dict[str, Any]:
    """A converging rig of two lenses in a hall."""
    sequence = hall(60, seed, rig=hall_rig())
    photographs = _photographs(sequence.worlds[0], CONVERGING, sequence.cam_from_world[40], seed)
    ours, theirs = plan_rectification(CONVERGING), Theirs.of(CONVERGING)
    pair = rectify(ours, *photographs)
    matches = match_pictures(*photographs)
    rows = ours.points(0, matches.left)[:, 1] - ours.points(1, matches.right)[:, 1]
    matches = matches.of(np.abs(rows) < 2.0)
    mine = seen_parallax(ours, (pair.left, pair.right), matches)
    pictures = theirs.picture(0, photographs[0]), theirs.picture(1, photographs[1])
    other = seen_parallax(theirs, pictures, matches)
    both = np.isfinite(mine) & np.isfinite(other)
    rms = [float(np.sqrt((off[both] ** 2).mean())) for off in (mine, other)]
    return {"seed": seed, "matches": int(both.sum()), "sfmapp": rms[0], "OpenCV": rms[1], "kept": min(ours.kept)}


def together(place: str, seeds: Iterable[int]) -> dict[str, Any]:
    """Pairs of one rig, turned about the vertical, each of another world, together."""
    make, rig = WORLDS[place]
    axis = np.array([0.0, 1.0, 0.0])
    moved = rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(np.radians(TURN_DEG) * axis), np.zeros(3)),
                           rig.cam_from_rig[1])  # fmt: skip
    truth = Rig(rig.cameras, np.array([rigid3.IDENTITY, moved]))
    pairs = []
    for seed in seeds:
        sequence = make(60, seed, rig=rig)
        pairs.append(_photographs(sequence.worlds[0], truth, sequence.cam_from_world[20 + 7 * (seed % 5)], seed))
    found = turn_of_rig(pairs, PairCameras(rig)).found
    assert found is not None
    away = found.turn_deg - plan_rectification(rig).right_from_camera @ (TURN_DEG * axis)
    sigma = float(np.linalg.norm(found.sigma_deg[:3]))
    return {"place": place, "pairs": len(pairs), "error_deg": float(np.linalg.norm(away)), "sigma_deg": sigma}


def forward(
    name: str, world: World, center: Sequence[float], angles_deg: Sequence[float], move: Sequence[float], focal: float
) -> dict[str, Any]:
    """Two pictures of a camera that goes forward or back, and turns a little, by polar rectification. Shares of the
    pixels whose depth is known: matched, right to a tenth of it, and inside both intervals."""
    width, height = 752, 480
    camera = Camera(CameraModel.PINHOLE, width, height, np.array([focal, focal, 0.5 * width, 0.5 * height]))
    first = looking(np.asarray(center, np.float64), *angles_deg)
    there = np.asarray(center) + np.asarray(move) @ rigid3.rotation_matrix(first)
    second = looking(there, angles_deg[0] + 0.5, angles_deg[1] - 1.0)
    rig = Rig((camera, camera), np.array([rigid3.IDENTITY, rigid3.compose(second, rigid3.inverse(first))]))
    renderer = Renderer(world, camera)
    photographs = tuple(
        np.repeat(renderer.photograph(pose, Optics(noise_sigma=2.0), [5, side])[..., None], 3, 2)
        for side, pose in enumerate((first, second))
    )
    prepared, plan = prepare_polar(photographs[0], photographs[1], PairCameras(rig))
    found = match_pair(prepared.pair, StereoOptions(), matches=prepared.matches)
    error = disparity_error(prepared.pair, found)
    pair, _, measured = on_photograph(plan, prepared.pair, found, error, (photographs[0], photographs[1]), "m")
    assert pair.geometry is not None
    assert measured.depth is not None
    assert measured.depth_sigma is not None
    true = renderer.view(first, edge_samples=False).depth
    off = np.abs(measured.depth - true)
    both = np.isfinite(off)
    half = true**2 / (focal * float(pair.geometry.baseline or 0.0)) * measured.error.half_width_95
    return {
        "case": name, "matched": float(both.sum() / np.isfinite(true).sum()),
        "median": float(np.median((off / true)[both])), "right": float(((off / true)[both] < 0.1).mean()),
        "inside_68": float((off < measured.depth_sigma)[both].mean()), "inside_95": float((off < half)[both].mean()),
    }  # fmt: skip


def turned(seed: int) -> Iterator[dict[str, Any]]:
    """A car's rectified rig and a drone's of two barrel lenses, turned about the vertical and about any axis."""
    for place, (make, rig) in WORLDS.items():
        sequence = make(60, seed, rig=rig)
        pose, world = sequence.cam_from_world[20 + 7 * (seed % 5)], sequence.worlds[0]
        any_axis = np.random.default_rng(seed).normal(size=3)
        for axis, name in ((np.array([0.0, 1.0, 0.0]), "vertical"), (any_axis / np.linalg.norm(any_axis), "any")):
            turn = rigid3.exp_so3(np.radians(TURN_DEG) * axis)
            moved = rigid3.compose(rigid3.from_matrix(turn, np.zeros(3)), rig.cam_from_rig[1])
            truth = Rig(rig.cameras, np.array([rigid3.IDENTITY, moved]))
            calibrated, photographs = PairCameras(rig), _photographs(world, truth, pose, seed)
            still = prepare_pair(
                *_photographs(world, rig, pose, seed), calibrated, NAMES, PrepareOptions(corrects="no")
            )
            found = prepare_pair(*photographs, calibrated, NAMES, PrepareOptions(corrects="turn"))
            left_alone = prepare_pair(*photographs, calibrated, NAMES, PrepareOptions(corrects="no"))
            row: dict[str, Any] = {"place": place, "seed": seed, "axis": name}
            plan, measured = plan_rectification(rig), found.misalignment
            if measured is not None:
                away = measured.turn_deg - plan.right_from_camera @ (TURN_DEG * axis)
                row["error_deg"] = float(np.linalg.norm(away))
                row["sigma_deg"] = float(np.linalg.norm(measured.sigma_deg[:3]))
                row["told"] = bool(measured.is_told[1])
            for when, one in (("undisturbed", still), ("turned", left_alone), ("corrected", found)):
                row[f"depth_{when}"] = depth_error(world, pose, one)
            yield row


def depth_error(world: World, pose: Array, prepared: PreparedPair) -> float:
    """Median relative error of depth where the matcher answers."""
    assert prepared.plan is not None
    assert prepared.pair.geometry is not None
    g = prepared.pair.geometry
    disparity = match_pair(prepared.pair, StereoOptions(matcher="opencv-sgbm"), matches=prepared.matches).disparity
    flat = Camera(CameraModel.PINHOLE, g.width, g.height, np.array([g.focal, g.focal, g.cx, g.cy]))
    turn = rigid3.from_matrix(prepared.plan.left_from_camera, np.zeros(3))
    true = Renderer(world, flat).view(rigid3.compose(turn, pose), edge_samples=False).depth
    error = np.abs(depth_of_disparity(disparity, g) / true - 1.0)
    return float(np.median(error[np.isfinite(error)]))


# ------------------------------------------------------------------------------------------------------------- tables


def tables(report: dict[str, Any]) -> str:
    """The results as markdown."""
    text = ["# Rectification of pairs", ""]
    text += [f"{report['date']}, {report['commit']}, {report['cpu']}", "", (__doc__ or "").split("\n\n")[2], ""]
    text += [
        "| fountain-P11, rms parallax in px | matches | sfmapp | OpenCV | nothing known | kept |",
        "|---|---|---|---|---|---|",
    ]
    for row in report["fountain"]:
        text.append(
            f"| {row['pair']} | {row['matches']} | {row['sfmapp']:.4f} | {row['OpenCV']:.4f} | "
            f"{row['uncalibrated']:.4f} | {row['kept']:.0%} |"
        )
    text += ["", "| thirteen boards, rms parallax in px | |", "|---|---|"]
    text += [f"| {name} | {value:.4f} |" for name, value in report["boards"].items() if name != "corners"]
    text += ["", "| rendered, converging, two lenses | matches | sfmapp | OpenCV | kept |", "|---|---|---|---|---|"]
    for row in report["rendered"]:
        text.append(
            f"| {row['seed']} | {row['matches']} | {row['sfmapp']:.4f} | {row['OpenCV']:.4f} | {row['kept']:.0%} |"
        )
    text += [
        "",
        f"| turned by {TURN_DEG} degrees | axis | error, deg | sigma | depth error undisturbed | turned | corrected |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in report["turned"]:
        found = f"{row['error_deg']:.4f} | {row['sigma_deg']:.4f}" if "error_deg" in row else "too few matches |"
        depths = " | ".join(f"{row[f'depth_{when}']:.2%}" for when in ("undisturbed", "turned", "corrected"))
        text.append(f"| {row['place']} {row['seed']} | {row['axis']} | {found} | {depths} |")
    text += ["", "| pairs of one rig together, vertical | pairs | error, deg | sigma |", "|---|---|---|---|"]
    for row in report["together"]:
        text.append(f"| {row['place']} | {row['pairs']} | {row['error_deg']:.4f} | {row['sigma_deg']:.4f} |")
    text += [
        "", "| forward, polar | matched | median error of depth | within a tenth | inside 68 | inside 95 |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["forward"]:
        shares = " | ".join(f"{row[key]:.1%}" for key in ("matched", "median", "right", "inside_68", "inside_95"))
        text.append(f"| {row['case']} | {shares} |")
    return "\n".join(text) + "\n"


if __name__ == "__main__":
    main()
