"""Synthetic surveys with ground control: do intervals of points left out hold the truth as often as they say?

    python benchmarks/control_surveys.py --num 200        writes results/control_surveys.json and .md

A flight over terrain and a walk round a monument, with half a pixel of noise, a wrong lens to begin with, marks of 0.7
pixels and five control points of 2 cm (3 cm in height), without and with one coordinate that is wrong by a metre.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying, free_params
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.formats.control_points import LOCAL, ControlPoints
from sfmapp.geometry import rigid3, similarity
from sfmapp.georeference.control.adjustment import Adjusting, ControlSolution, adjust_to_control
from sfmapp.georeference.control.marks import check_marks
from sfmapp.georeference.control.points import align_to_survey, survey_in_frame
from sfmapp.mapping.keypoint_noise import keypoint_noise
from sfmapp.mapping.mapper import MIN_NOISE_PX
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]
Layout = Literal["grid", "orbit"]

# metres; of points by RTK, and of marks that a hand makes
SIGMA_M, SIGMA_MARK_PX, SIGMA_PX = np.array([0.02, 0.02, 0.03]), 0.7, 0.5
CAMERA = Camera(CameraModel.SIMPLE_RADIAL, 1200, 900, np.array([1000.0, 600.0, 450.0, -0.06]))


@dataclass(frozen=True)
class SyntheticSurvey:
    """What was measured, and the truth behind it.

    Attributes:
        model: as photographs alone see it, before its adjustment: in a frame and a unit of its own, with a lens that
            is wrong. Its images and points are those of ``truth``.
        truth: in metres, z up.
        control: ground control points as a file would have them; ``places`` (P, 3) where they truly are.
    """

    model: Reconstruction
    truth: Reconstruction
    control: ControlPoints
    places: Array


def make_survey(seed: int, layout: Layout, num_control: int = 5, num_points: int = 600) -> SyntheticSurvey:
    """A survey with noise of half a pixel, marks of 0.7 pixels and control points of 2 and 3 cm.

    ``grid``: 4 x 6 photographs straight down from 60 m with 70 % overlap, which leaves heights to a wrong lens;
    ``orbit``: 24 photographs round a thing of 20 m from two heights.
    """
    rng = np.random.default_rng([seed, 0x5A7E, layout == "orbit"])
    poses = _grid(rng) if layout == "grid" else _orbit(rng)
    xyz, normals = _ground(rng, poses, num_points) if layout == "grid" else _thing(rng, num_points)
    places, control_normals = _spread_out(
        rng, *(_ground(rng, poses, 400) if layout == "grid" else _thing(rng, 400)), num_control, poses
    )
    truth = _observed(poses, xyz, normals, rng, 0.0)
    model = _observed(poses, xyz, normals, rng, SIGMA_PX)
    start = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    model_from_world = np.append(start, 1.0 / rng.uniform(10.0, 50.0))
    model.cam_from_world[:] = similarity.transform_poses(model_from_world, poses)
    model.point_xyz[:] = similarity.apply(model_from_world, xyz)
    wrong = CAMERA.params * [1.01, 1.0, 1.0, 0.0]
    model.cameras[0] = CAMERA.with_params(wrong)
    return SyntheticSurvey(model, truth, _control(poses, places, control_normals, rng), places)


def _grid(rng: np.random.Generator) -> Array:
    height = 60.0
    step = 0.3 * np.array([CAMERA.width, CAMERA.height]) / CAMERA.focal * height
    column, row = np.meshgrid(np.arange(6), np.arange(4))
    centers = np.column_stack([column.ravel() * step[0], row.ravel() * step[1], np.full(24, height)])
    centers += rng.normal(0.0, 1.0, centers.shape)
    rotation = rigid3.exp_so3(np.radians(2.0) * rng.normal(size=(24, 3))) @ np.diag([1.0, -1.0, -1.0])
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def _orbit(rng: np.random.Generator) -> Array:
    angle = np.arange(24) * 2 * np.pi / 12
    height = np.where(np.arange(24) < 12, 2.0, 12.0)
    centers = np.column_stack([35 * np.cos(angle), 35 * np.sin(angle), height]) + rng.normal(0.0, 0.5, (24, 3))
    forward = np.array([0.0, 0.0, 5.0]) + rng.normal(0.0, 0.5, (24, 3)) - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def _ground(rng: np.random.Generator, poses: Array, num: int) -> tuple[Array, Array]:
    centers = rigid3.center(poses)
    xy = rng.uniform(centers[:, :2].min(0) - 15, centers[:, :2].max(0) + 15, (num, 2))
    z = 2.0 * np.sin(xy[:, 0] / 12) * np.cos(xy[:, 1] / 15) + rng.normal(0.0, 0.3, num)
    return np.column_stack([xy, z]), np.tile([0.0, 0.0, 1.0], (num, 1))


def _thing(rng: np.random.Generator, num: int) -> tuple[Array, Array]:
    """A tower of 10 m radius and height, and the ground about it."""
    angle = rng.uniform(0, 2 * np.pi, num)
    is_wall = rng.random(num) < 0.7
    radius = np.where(is_wall, 10.0 + rng.normal(0.0, 0.2, num), rng.uniform(10, 25, num))
    z = np.where(is_wall, rng.uniform(0, 10, num), rng.normal(0.0, 0.1, num))
    out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(num)])
    return out * radius[:, None] + [0, 0, 1] * z[:, None], np.where(is_wall[:, None], out, [0.0, 0.0, 1.0])


def _seen(poses: Array, xyz: Array, normals: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which photographs see which points (N, I), and where (N, I, 2)."""
    pixels = np.array([project(CAMERA, rigid3.apply(pose, xyz)) for pose in poses]).transpose(1, 0, 2)
    view = rigid3.center(poses) - xyz[:, None]
    facing = np.einsum("nik,nk->ni", view, normals) > 0.3 * np.linalg.norm(view, axis=2)
    inside = ((pixels > 10) & (pixels < [CAMERA.width - 10, CAMERA.height - 10])).all(2)
    ahead = np.array([rigid3.apply(pose, xyz)[:, 2] > 1 for pose in poses]).T
    return inside & facing & ahead, pixels


def _spread_out(rng: np.random.Generator, xyz: Array, normals: Array, num: int, poses: Array) -> tuple[Array, Array]:
    """Points far from each other that three photographs see, as surveyors put them: one more, where it is farthest."""
    good = _seen(poses, xyz, normals)[0].sum(1) >= 3
    xyz, normals = xyz[good], normals[good]
    chosen = [int(rng.integers(len(xyz)))]
    while len(chosen) < num:
        chosen.append(int(np.linalg.norm(xyz[:, None] - xyz[chosen], axis=2).min(1).argmax()))
    return xyz[chosen], normals[chosen]


def _observed(poses: Array, xyz: Array, normals: Array, rng: np.random.Generator, sigma: float) -> Reconstruction:
    visible, pixels = _seen(poses, xyz, normals)
    visible &= np.random.default_rng(7).random(visible.shape) < 0.8
    visible[visible.sum(1) < 2] = False
    point, image = np.nonzero(visible)
    feature = np.empty(len(point), np.int64)
    order = np.argsort(image, kind="stable")
    feature[order] = np.concatenate([np.arange(n) for n in np.bincount(image, minlength=len(poses))])
    xy = pixels[point, image] + sigma * rng.normal(size=(len(point), 2))
    tracks = make_tracks(len(poses), len(xyz), point, image, feature, xy)
    names = [f"image{i:04d}.jpg" for i in range(len(poses))]
    model = Reconstruction.empty([CAMERA], names, np.zeros(len(poses), np.int32), tracks)
    model.cam_from_world[:], model.point_xyz[:], model.obs_is_inlier[:] = poses, xyz, True
    model.point_xyz[~visible.any(1)] = np.nan
    return model


def _control(poses: Array, places: Array, normals: Array, rng: np.random.Generator) -> ControlPoints:
    visible, pixels = _seen(poses, places, normals)
    point, image = np.nonzero(visible)
    return ControlPoints(
        path=Path("synthetic.csv"),
        crs_line=1,
        crs=LOCAL,
        names=tuple(f"P{n + 1}" for n in range(len(places))),
        xyz=places + SIGMA_M * rng.normal(size=places.shape),
        sigma_m=np.tile(SIGMA_M, (len(places), 1)),
        obs_point_idx=point,
        obs_image_idx=image,
        obs_xy=pixels[point, image] + SIGMA_MARK_PX * rng.normal(size=(len(point), 2)),
        obs_sigma_px=np.full(len(point), SIGMA_MARK_PX),
        obs_line=np.arange(len(point)) + 3,
    )


# ---------------------------------------------------------------------------------------------------------- measurement

OPTIONS = AdjustOptions(relative_cost_tolerance=1e-7, initial_damping=1e-6, max_iterations=100)


def solve(survey: SyntheticSurvey) -> tuple[Reconstruction, ControlSolution]:
    """The model that photographs make, brought to its control points, and what came of these."""
    model, control = survey.model.copy(), survey.control
    adjust_bundle(model, OPTIONS)
    noise = keypoint_noise(model, OPTIONS, Varying(), MIN_NOISE_PX)
    marked, surveyed = check_marks(model, control), survey_in_frame(control)
    found = align_to_survey(marked.place, surveyed.place)
    if found.world_from_model is None:
        raise RuntimeError(found.problem)
    model.cam_from_world[:] = similarity.transform_poses(found.world_from_model, model.cam_from_world)
    model.point_xyz[:] = similarity.apply(found.world_from_model, model.point_xyz)

    def graph() -> FactorGraph:
        return FactorGraph(model, OPTIONS, noise_px=noise.sigma_px)

    adjusting = Adjusting(graph, graph, [free_params(camera, *OPTIONS.refine) for camera in model.cameras])
    return model, adjust_to_control(model, control, marked, surveyed, found.is_inlier, adjusting)


@dataclass(frozen=True)
class Row:
    """One survey: how many points could be left out, how many of these lie within 95 % horizontally and vertically, and
    whether a wrong coordinate was named, and it alone."""

    num: int
    horizontal: int
    vertical: int
    is_right: bool


def measure(seed: int, layout: Layout, is_wrong: bool) -> Row:
    """One survey; ``is_wrong``: the coordinate of one point in six is off by a metre."""
    survey = make_survey(seed, layout, 6 if is_wrong else 5, num_points=300)
    wrong = seed % 6
    if is_wrong:
        xyz = survey.control.xyz.copy()
        xyz[wrong, seed % 3] += 1.0
        survey = replace(survey, control=replace(survey.control, xyz=xyz))
    _, solution = solve(survey)
    found = [one for p, one in enumerate(solution.left_out) if one is not None and solution.is_used[p]]
    named = np.flatnonzero(~solution.is_used).tolist()
    return Row(
        len(found),
        sum(one.normalized_horizontal <= 2.448 for one in found),
        sum(one.normalized_vertical <= 1.960 for one in found),
        named == ([wrong] if is_wrong else []) and solution.survey_spread == 1.0,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=200, help="surveys of each kind")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    start = time.process_time()
    for layout in ("grid", "orbit"):
        for is_wrong in (False, True):
            with ThreadPoolExecutor(args.threads) as pool:
                found = list(pool.map(lambda seed: measure(seed, layout, is_wrong), range(args.num)))  # noqa: B023
            num = sum(row.num for row in found)
            flat, up = (sum(getattr(row, name) for row in found) / num for name in ("horizontal", "vertical"))
            rows.append(
                {
                    "survey": f"{layout}{', one point wrong by a metre' if is_wrong else ''}", "surveys": args.num,
                    "left_out": num, "horizontal": 100 * flat, "vertical": 100 * up,
                    "named": sum(row.is_right for row in found),
                }
            )  # fmt: skip
            print(rows[-1], flush=True)
    write_results(rows, args.num, time.process_time() - start)


def write_results(rows: list[dict[str, Any]], num: int, cpu_s: float) -> None:
    """The table as JSON and as Markdown."""
    (RESULTS / "control_surveys.json").write_text(
        json.dumps(describe_machine() | {"cpu_s": round(cpu_s), "rows": rows}, indent=1) + "\n", encoding="utf-8"
    )
    lines = [
        f"# Ground control: {num} surveys of each kind, {cpu_s:.0f} CPU seconds",
        "",
        "| survey | surveys | left-out points | within 95 % horizontally | vertically | the wrong named, no other |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        shares, named = f"{row['horizontal']:.1f} % | {row['vertical']:.1f} %", f"{row['named']} of {row['surveys']}"
        lines.append(f"| {row['survey']} | {row['surveys']} | {row['left_out']} | {shares} | {named} |")
    (RESULTS / "control_surveys.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
