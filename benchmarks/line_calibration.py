"""Calibration from lines, measured: rendered streets with known lenses, boards that are straightened, and scenes
without straight lines.

    python benchmarks/line_calibration.py [--scenes 10]

What the columns mean is in benchmarks/README.md. The board photographs are those of opencv-doc-samples, as they are and
bent further by a known division model; their corners are found by OpenCV, and no corner is used to straighten them.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import describe_machine
from rendered_worlds import textures
from rendered_worlds.rendering import Optics, Renderer
from rendered_worlds.worlds import STREETS, street_world
from sfmapp.calibration.lines import LineCalibration, LinePicture, calibrate_from_lines
from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

RESULTS = Path(__file__).parent / "results" / "line_calibration.md"
SIZE = (1280, 960)
STRENGTHS = (-0.25, -0.1, -0.4, 0.1, 0.0, -0.02)
# the scene whose one view leaves the principal point open: its camera gets a second photograph
WITH_ANOTHER = 4
BOARD = (9, 6)


def street_camera(strength: float, focal_share: float, shift: Array) -> Camera:
    """A camera with a distortion lambda R^2, a focal length in widths, and a principal point off the middle, pixels."""
    width, height = SIZE
    focal = focal_share * width
    k = strength * focal**2 / ((width**2 + height**2) / 4)
    params = np.array([focal, width / 2 + shift[0], height / 2 + shift[1], k])
    return Camera(CameraModel.SIMPLE_DIVISION, width, height, params)


def look(place: Array, yaw_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """The pose (7,) of a camera at a place, its heading from the x axis, and what it is tilted up and to the side."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rotation = rigid3.exp_so3([0.0, 0.0, roll]) @ np.stack([right, np.cross(forward, right), forward])
    return rigid3.from_matrix(rotation, -rotation @ place)


def street_pose(rng: np.random.Generator) -> Array:
    """Somewhere in a street, across it and along it at once, tilted up."""
    place = np.array([rng.uniform(STREETS.xs[0] + 15, STREETS.xs[1] - 15), STREETS.ys[1] + rng.uniform(-3, 3), 0.0])
    place[2] = rng.uniform(1.5, 3.0)
    yaw = rng.choice([0, 180]) + rng.choice([-1, 1]) * rng.uniform(25, 60)
    return look(place, yaw, rng.uniform(5, 20), rng.uniform(-5, 5))


def photograph(camera: Camera, pose: Array, seed: int) -> Grey:
    """The street from a pose."""
    return Renderer(street_world(seed % 3), camera).photograph(pose, Optics(), [seed])


def streets(num: int) -> Iterator[str]:
    """Rows of the table of rendered streets."""
    yield "| scene | lines | lambda R² | found | off % | sigmas | focal off % | sigmas | centre off px, sigma | CPU s |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for seed in range(num):
        rng = np.random.default_rng([seed, 0x11E5])
        strength = STRENGTHS[seed % len(STRENGTHS)]
        camera = street_camera(strength, rng.uniform(0.5, 1.3), rng.normal(0.0, 12.0, 2))
        pictures = [LinePicture("street", photograph(camera, street_pose(rng), seed))]
        yield street_row(seed, camera, strength, pictures, time.process_time())
        if seed == WITH_ANOTHER:
            pictures.append(LinePicture("another", photograph(camera, street_pose(rng), seed + 1)))
            yield street_row(f"{seed}, 2 photographs", camera, strength, pictures, time.process_time())
    camera = street_camera(-0.2, 0.8, np.array([10.0, -8.0]))
    rng = np.random.default_rng(0x11E6)
    pictures = [LinePicture(str(k), photograph(camera, street_pose(rng), k)) for k in range(4)]
    yield street_row("4 photographs", camera, -0.2, pictures, time.process_time())
    level = look(np.array([(STREETS.xs[0] + STREETS.xs[1]) / 2, STREETS.ys[1], 2.0]), 90.0, 0.0, 0.0)
    pictures = [LinePicture("front", photograph(camera, level, 1))]
    yield street_row("frontal", camera, -0.2, pictures, time.process_time())


def street_row(name: object, camera: Camera, strength: float, pictures: list[LinePicture], start: float) -> str:
    """One scene."""
    try:
        found = calibrate_from_lines(pictures)
    except InputError as error:
        return f"| {name} | | {strength:g} | refused: {error} | | | | | | {time.process_time() - start:.0f} |"
    cpu = time.process_time() - start
    bend, focal, _ = found.report.parameters
    off = bend.value - strength
    share = f"{100 * off / strength:.1f}" if strength else ""
    value, sigma = focal.value / camera.focal - 1.0, focal.sigma / camera.focal
    shown = f"{100 * value:.2f} | {abs(value) / sigma:.1f}" if focal.verdict == "measured" else "unknown |"
    center = found.calibration.camera.params[1:3] - camera.params[1:3]
    sigmas = found.calibration.sigmas[1:3]
    lines = sum(photo.num_straight for photo in found.report.photographs)
    return (
        f"| {name} | {lines} | {strength:g} | {bend.value:.4f} ({bend.verdict}) | {share} | {abs(off) / bend.sigma:.1f}"
        f" | {shown} | {np.hypot(*center):.1f}, {np.hypot(*sigmas):.1f} | {cpu:.0f} |"
    )


def bent(grey: Grey, strength: float) -> Grey:
    """A photograph bent further: (lambda R^2) of the division model about its middle, on the same frame."""
    height, width = grey.shape
    radius2 = (width**2 + height**2) / 4
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    factor = 1.0 / (1.0 + strength * (x**2 + y**2) / radius2)
    # the corners stay in place: the border of a photograph is a line that no scene has
    zoom = 1.0 + strength
    map_x, map_y = (v * factor * zoom + size / 2 - 0.5 for v, size in ((x, width), (y, height)))
    return cv2.remap(grey, map_x.astype(np.float32), map_y.astype(np.float32), cv2.INTER_CUBIC, borderValue=128)


def straightness(corners: Array) -> float:
    """Rms distance in pixels of the corners (rows, columns, 2) of a board from the best line of each row and column."""
    squares = []
    for lines in (corners, corners.swapaxes(0, 1)):
        for line in lines:
            centered = line - line.mean(0)
            squares.append((centered @ np.linalg.svd(centered)[2][1]) ** 2)
    return float(np.sqrt(np.concatenate(squares).mean()))


def corners_of(grey: Grey) -> Array | None:
    """(6, 9, 2) pixels of the board's corners, by OpenCV; None where it finds none."""
    is_found, corners = cv2.findChessboardCornersSB(grey, BOARD, flags=cv2.CALIB_CB_ACCURACY)
    return corners.reshape(BOARD[1], BOARD[0], 2).astype(np.float64) + 0.5 if is_found else None


def boards(data: Path) -> Iterator[str]:
    """Rows of the table of boards: some bent further and four together, then each photograph by itself."""
    yield "| photographs | bent further | corners, as photographed px | straightened px | lambda R² | verdict | CPU s |"
    yield "|---|---|---|---|---|---|---|"
    folder = data / "opencv-doc-samples" / "calib"
    for names, strength in (
        (("left03",), -0.2), (("left12",), -0.2), (("left03", "left05", "left09", "left12"), 0.0),
        *(((path.stem,), 0.0) for path in sorted(folder.glob("*[0-9].jpg"))),
    ):  # fmt: skip
        greys = [bent(cv2.imread(str(folder / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE), strength) for name in names]
        start = time.process_time()
        label = f"{', '.join(names)} | {strength:g}"
        try:
            found = calibrate_from_lines([LinePicture(n, g) for n, g in zip(names, greys, strict=True)])
        except InputError as error:
            yield f"| {label} | | refused: {error} | | | {time.process_time() - start:.0f} |"
            continue
        cpu = time.process_time() - start
        before, after = [], []
        for grey in greys:
            corners = corners_of(grey)
            if corners is not None:
                before.append(straightness(corners))
                after.append(straightness(straightened(found, corners)))
        bend = found.report.parameters[0]
        shown = f"{np.mean(before):.2f} | {np.mean(after):.3f}" if before else "not found by OpenCV |"
        yield (f"| {label} | {shown} | {bend.value:.3f} +- {bend.sigma:.3f} | {bend.verdict} | {cpu:.0f} |")


def straightened(found: LineCalibration, corners: Array) -> Array:
    """Corners (..., 2) without the distortion, in pixels of the same focal length."""
    camera = found.calibration.camera
    return pixels_to_normalized(camera, corners.reshape(-1, 2)).reshape(corners.shape) * camera.focal


def empty_scenes(data: Path) -> Iterator[str]:
    """Rows of the table of scenes that show no built world, or hardly one, with the truth where it is known."""
    yield "| scene | truth f px, lambda R² | distortion | focal length | CPU s |"
    yield "|---|---|---|---|---|"
    strecha = (2759.48 / 2, 0.0)
    scenes: list[tuple[str, list[Grey], tuple[float, float] | None]] = []
    for name in ("fountain-P11/images/0000.jpg", "fountain-P11/images/0005.jpg", "herz-jesus-P8/images/0004.jpg"):
        scenes.append((name, [cv2.imread(str(data / name), cv2.IMREAD_GRAYSCALE)], strecha))
    for name in ("opencv-doc-samples/stereo_aloe/aloeL.jpg", "opencv-doc-samples/homography/graf1.png"):
        scenes.append((name, [cv2.imread(str(data / name), cv2.IMREAD_GRAYSCALE)], None))
    rng = np.random.default_rng(7)
    leaves = np.tile(textures.leaves(rng, 512, 12), (2, 2))
    scenes += [("leaves", [cv2.resize(leaves, SIZE)], None), ("strokes", [strokes(rng)], None)]
    for name, greys, truth in scenes:
        start = time.process_time()
        told = f"{truth[0]:.0f}, {truth[1]:g}" if truth else ""
        try:
            found = calibrate_from_lines([LinePicture(name, grey) for grey in greys])
        except InputError as error:
            yield f"| {name} | {told} | refused: {error} | | {time.process_time() - start:.0f} |"
            continue
        bend, focal, _ = found.report.parameters
        yield (
            f"| {name} | {told} | {bend.value:.3f} +- {bend.sigma:.3f}, {bend.verdict} | {focal.value:.0f} +- "
            f"{focal.sigma:.0f}, {focal.verdict}: {focal.reason} | {time.process_time() - start:.0f} |"
        )


def strokes(rng: np.random.Generator) -> Grey:
    """Straight strokes and large circles in all directions: lines enough, and no world."""
    canvas = np.full(SIZE[::-1], 120, np.uint8)
    for _ in range(150):
        a, b = rng.uniform(0, SIZE, (2, 2)).astype(int)
        tone = int(rng.uniform(0, 255))
        if rng.random() < 0.5:
            cv2.line(canvas, a.tolist(), b.tolist(), tone, 3, cv2.LINE_AA)
        else:
            cv2.circle(canvas, a.tolist(), int(rng.uniform(100, 1500)), tone, 3, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), 1.0), np.uint8)


def main() -> None:
    """Measure and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10, help="rendered streets; default: 10")
    args = parser.parse_args()
    data = Path(os.environ["SFMAPP_DATA"])
    machine = describe_machine()
    facts = f"{machine['cpu']}, {machine['cores']} cores, {machine['date']}"
    parts = [
        f"sfmapp {machine['versions']['sfmapp']} at {machine['commit']}; {facts}. Columns: benchmarks/README.md.",
        "",
    ]
    for title, rows in (
        ("Rendered streets", streets(args.scenes)), ("Boards", boards(data)), ("No built world", empty_scenes(data)),
    ):  # fmt: skip
        parts += [f"## {title}", ""]
        for row in rows:
            print(row, flush=True)
            parts.append(row)
        parts.append("")
    RESULTS.write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
