"""``sfmapp uncalibrated`` and ``sfmapp transfer`` on photographs whose truth is known.

    python benchmarks/uncalibrated.py [--dinosaur OUT]

The turntable of Oxford's dinosaur is reconstructed from its photographs alone (``--dinosaur``: a workspace in which
that was done). Its points, triangulated from the same pixels by the committed P matrices, are the reference: five of
them bring the projective model to it, and the rest is compared, a hundred times: of sixty points by chance, those five
of which no four lie near a plane. Self-calibration knows no P at all and is compared up to a similarity.
The reference's own frame is mirrored, and has two numbers that a turntable leaves open (RQ of its P gives pixels of 1.4
to 1 and a principal point 1,070 px above the picture): the comparison is made again with these two freed. What does not
hang on the reference is the turntable itself, which stepped by ten degrees: steps, radius and height of the circle of
cameras are told of ours and of the reference's. Of the eight numbers that lead from a projective frame to a metric one
they tell six, all but those two, which our camera's square pixels and middle tell.
Triples of the courtyard are transferred; the errors are those of keypoints that were held back.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.optimize import least_squares

from machine import RESULTS, describe_machine
from sfmapp.errors import NoReconstructionError
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.projective import dehomogenized, triangulate_views
from sfmapp.geometry.projective_adjustment import ProjectiveModel, Sightings, adjust_projective
from sfmapp.geometry.upgrade import find_space_homography
from sfmapp.pipelines.transfer import transfer_views
from sfmapp.pipelines.uncalibrated import reconstruct_uncalibrated

Array = NDArray[np.float64]

DATA = Path(os.environ.get("SFMAPP_DATA", "data"))
TRIPLES = (
    ("fountain_0004", "fountain_0006", "fountain_0005"), ("fountain_0002", "fountain_0007", "fountain_0004"),
    ("fountain_0000", "fountain_0003", "fountain_0007"), ("fountain_0008", "fountain_0010", "fountain_0009"),
    ("entry_0002", "entry_0005", "entry_0003"), ("entry_0001", "entry_0004", "entry_0007"),
)  # fmt: skip
# points that somebody would choose five of
_CHOICE = 60


def _points(cameras: Array, seen: Sightings, count: int) -> Array:
    """(N, 4) of least reprojection error in fixed cameras."""
    table = seen.table(count, len(cameras))
    start = ProjectiveModel(cameras, triangulate_views(cameras, table)[0])
    fixed = np.ones(len(cameras), np.bool_)
    return adjust_projective(start, seen, fixed_views=fixed, max_iterations=20)[0].points


def dinosaur(output: Path) -> dict[str, Any]:
    """Errors of the upgraded models, in shares of the object's size."""
    report = json.loads((output / "report.json").read_text())
    model, _ = read_model(output / "sparse" / "0")
    images = json.loads((output / "cameras_projective.json").read_text())["images"]
    matrices = {image["name"]: np.array(image["P"]) for image in images}
    ours = np.array([matrices[name] for name in model.image_names])
    number = {name: n for n, name in enumerate(sorted(matrices))}
    given = loadmat(DATA / "oxford-dinosaur" / "dino_Ps.mat")["P"].ravel()
    # theirs count pixels from the centre of the first
    half = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    theirs = np.array([half @ given[number[name]] for name in model.image_names])
    tracks = model.tracks
    used = model.obs_is_inlier
    seen = Sightings(
        tracks.obs_image_idx[used].astype(np.int64), tracks.obs_track_idx[used].astype(np.int64), tracks.obs_xy[used]
    )
    truth = dehomogenized(_points(theirs, seen, tracks.num_tracks))
    left = ProjectiveModel(theirs, np.c_[truth, np.ones(len(truth))]).left(seen)
    worst = np.zeros(tracks.num_tracks)
    np.maximum.at(worst, seen.point_idx, np.linalg.norm(left, axis=1))
    counts = np.bincount(seen.point_idx, minlength=tracks.num_tracks)
    good = (counts >= 3) & (worst < 2.0) & np.isfinite(truth).all(1)
    seen = Sightings(*(each[good[seen.point_idx]] for each in (seen.view_idx, seen.point_idx, seen.xy)))
    points = _points(ours, seen, tracks.num_tracks)[good]
    true, metric = truth[good], model.point_xyz[good]
    size = float(np.linalg.norm(np.ptp(true[np.argsort(true[:, 2])[5:-5]], axis=0)))
    return {
        "projective": report["projective"], "self_calibration": report["self_calibration"], "num_compared": len(true),
        "size": size, **_five_points(points, true, size), **_metric(metric, true, size),
        "turntable": _turntable(rigid3.center(model.cam_from_world)),
        "reference_turntable": reference_turntable(),
    }  # fmt: skip


def _five_points(points: Array, true: Array, size: float) -> dict[str, Any]:
    rms = []
    for seed in range(100):
        some = np.random.default_rng(seed).choice(len(true), _CHOICE, replace=False)
        five = some[_far_apart(true[some])]
        frame, _ = find_space_homography(points[five], true[five])
        rest = np.setdiff1d(np.arange(len(true)), five)
        gap = dehomogenized(points[rest] @ frame.T) - true[rest]
        rms.append(float(np.sqrt((gap**2).sum(1).mean())) / size)
    frame, _ = find_space_homography(points, true)
    gap = dehomogenized(points @ frame.T) - true
    return {
        "five_points_percent": [100.0 * float(np.percentile(rms, q)) for q in (50, 90)],
        "five_points_within_1_percent": sum(one < 0.01 for one in rms),
        "all_points_percent": 100.0 * float(np.sqrt((gap**2).sum(1).mean())) / size,
    }  # fmt: skip


def _far_apart(xyz: Array) -> NDArray[np.int64]:
    """Five of them of which the flattest four are as little flat as can be: what one would choose by eye."""
    best, chosen = 0.0, np.arange(5)
    for seed in range(400):
        five = np.random.default_rng(seed).choice(len(xyz), 5, replace=False)
        volumes = [
            abs(np.linalg.det(xyz[four[1:]] - xyz[four[0]])) for four in (np.delete(five, n) for n in range(5))
        ]  # fmt: skip
        if min(volumes) > best:
            best, chosen = min(volumes), five
    return np.asarray(chosen, np.int64)


def _metric(metric: Array, true: Array, size: float) -> dict[str, Any]:
    mirrored = true * [1.0, 1.0, -1.0]

    def left(numbers: Array) -> Array:
        stretched = np.c_[mirrored[:, :2], np.exp(numbers[0]) * mirrored[:, 2]] / (1.0 + numbers[1] * mirrored[:, 2:])
        unit = np.linalg.norm(stretched.std(0)) / np.linalg.norm(mirrored.std(0))
        gap = similarity.apply(similarity.umeyama(metric, stretched), metric) - stretched
        return np.asarray((gap / unit / size).ravel(), np.float64)

    def percent(gap: Array) -> float:
        return 100.0 * float(np.sqrt((gap.reshape(-1, 3) ** 2).sum(1).mean()))

    freed = min((least_squares(left, [0.0, b]) for b in (-0.5, 0.0, 0.5)), key=lambda found: float(found.cost))
    return {
        "similarity_percent": percent(left(np.zeros(2))), "two_numbers_freed_percent": percent(freed.fun),
        "two_numbers": [float(np.exp(freed.x[0])), float(freed.x[1])],
    }  # fmt: skip


def reference_turntable() -> dict[str, float]:
    """The circle of the cameras of the committed P matrices."""
    given = loadmat(DATA / "oxford-dinosaur" / "dino_Ps.mat")["P"].ravel()
    return _turntable(dehomogenized(np.array([np.linalg.svd(matrix)[2][-1] for matrix in given])))


def _turntable(centers: Array) -> dict[str, float]:
    """Of the camera's circle: steps against ten degrees, radius against its mean, height against the radius."""
    around = centers - centers.mean(0)
    _, _, axes = np.linalg.svd(around)
    flat = around @ axes.T
    angles = np.degrees(np.abs(np.diff(np.unwrap(np.arctan2(flat[:, 1], flat[:, 0])))))
    radius = np.hypot(flat[:, 0], flat[:, 1])
    return {
        "step_rms_deg": float(np.sqrt(((angles - 10.0) ** 2).mean())),
        "radius_percent": 100.0 * float(radius.std() / radius.mean()),
        "height_percent": 100.0 * float(flat[:, 2].std() / radius.mean()),
    }  # fmt: skip


def transfers() -> list[dict[str, Any]]:
    """Each triple: held-out errors by both ways, and the synthesised photograph."""
    folder, out = DATA / "strecha-courtyard-21" / "images", []
    for triple in TRIPLES:
        with tempfile.TemporaryDirectory() as name:
            row: dict[str, Any] = {"triple": triple}
            try:
                told = transfer_views([folder / f"{one}.jpg" for one in triple], Path(name) / "out").report.transfer
            except NoReconstructionError as refusal:
                out.append(row | {"refused": str(refusal)})
                continue
            assert told.new_view is not None
            for way, key in zip(told.ways, ("lines", "tensor"), strict=True):
                share = 100.0 * way.num_refused / way.num_points
                told_px = [None if math.isnan(value) else value for value in (way.median_px, way.p90_px)]
                row[key] = {"median_px": told_px[0], "p90_px": told_px[1], "refused_percent": share}
            out.append(row | {"coverage": told.new_view.coverage, "correlation": told.new_view.correlation})
    return out


def markdown(report: dict[str, Any]) -> str:
    """The tables."""
    dino = report["dinosaur"]
    told, turned, given = dino["projective"], dino["turntable"], dino["reference_turntable"]
    camera = dino["self_calibration"]
    five = dino["five_points_percent"]
    lines = [
        "# No calibration", "", f"{report['cpu']}, {report['commit']}, {report['date'][:10]}.", "",
        "## Oxford's dinosaur, from its photographs alone", "",
        "| what | measured |", "|---|---|",
        f"| cameras, points, sightings | {told['num_cameras']} of {told['num_images']}, {told['num_points']:,}, "
        f"{told['num_sightings']:,} |",
        f"| projective model, rms of a coordinate | {told['rms_px']:.3f} px |",
        f"| {dino['num_compared']:,} points in three photographs or more, one map of space to the reference, rms | "
        f"{dino['all_points_percent']:.3f} % of the object |",
        f"| five known points, rms of the rest: median, 90 % of 100 choices | {five[0]:.2f} %, {five[1]:.2f} % "
        f"(asked 1 %: {dino['five_points_within_1_percent']} of 100) |",
        f"| self-calibration: focal length | {camera['focal_px']:.0f} +- {camera['focal_sigma_px']:.0f} px |",
        f"| similarity to the reference (mirrored), rms | {dino['similarity_percent']:.2f} % (asked 2 %) |",
        f"| with the two numbers that a turntable leaves open freed | {dino['two_numbers_freed_percent']:.2f} % |",
        f"| the turntable's own steps of ten degrees, rms | {turned['step_rms_deg']:.3f} degrees (of the reference's "
        f"cameras {given['step_rms_deg']:.3f}) |",
        f"| its circle: radius, height | {turned['radius_percent']:.3f} %, {turned['height_percent']:.3f} % "
        f"({given['radius_percent']:.3f}, {given['height_percent']:.3f}) |",
        "", "## Transfer to a third view, courtyard; keypoints that were held back, median px", "",
        "| triple | by lines | refused | by the tensor | refused | synthesised: filled, correlation |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["transfers"]:
        name = " ".join(row["triple"])
        if "refused" in row:
            lines.append(f"| {name} | refused: {row['refused']} | | | | |")
            continue
        a, b = row["lines"], row["tensor"]
        lines.append(
            f"| {name} | {_px(a['median_px'])} | {a['refused_percent']:.0f} % | {b['median_px']:.2f} | "
            f"{b['refused_percent']:.0f} % | {row['coverage']:.0%}, {row['correlation']:.3f} |"
        )
    return "\n".join(lines) + "\n"


def _px(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def main() -> None:
    """Run, and write ``results/uncalibrated.json`` and ``.md``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dinosaur", type=Path, help="workspace of sfmapp uncalibrated on the photographs")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        output = args.dinosaur or Path(name) / "out"
        if args.dinosaur is None:
            reconstruct_uncalibrated(DATA / "oxford-dinosaur" / "images", output)
        report = {**describe_machine(), "dinosaur": dinosaur(output), "transfers": transfers()}
    (RESULTS / "uncalibrated.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "uncalibrated.md").write_text(markdown(report), encoding="utf-8")


if __name__ == "__main__":
    main()
