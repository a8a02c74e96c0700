"""Calibration from lines: edges to a fraction of a pixel, lenses that are found with their sigmas, and views that tell
nothing, of which that is said."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfmapp.calibration.file import read_calibration_file
from sfmapp.calibration.line_edges import KNOTS, Arcs, find_arcs
from sfmapp.calibration.line_planes import DivisionLens, fit_planes
from sfmapp.calibration.lines import calibrate_from_arcs
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3

SIZE = (800, 600)
RADIUS = 500.0
STRENGTH, FOCAL = -0.2, 640.0


def division_camera(strength: float = STRENGTH, center: tuple[float, float] = (400.0, 300.0)) -> Camera:
    k = strength * (FOCAL / RADIUS) ** 2
    return Camera(CameraModel.SIMPLE_DIVISION, *SIZE, np.array([FOCAL, *center, k]))


def seen_lines(camera: Camera, directions, rotation, num: int, seed: int, noise_px: float = 0.1) -> Arcs:
    """Arcs of segments in space along each of the directions, in the pictures of a camera turned by a rotation."""
    rng = np.random.default_rng(seed)
    kept = []
    while len(kept) < num:
        along = rotation @ (directions[len(kept) % len(directions)] if len(directions) else rng.standard_normal(3))
        middle = rng.uniform([-4, -3, 4], [4, 3, 12])
        ends = middle + np.outer([-1, 1], along) * rng.uniform(0.3, 2.0) / np.linalg.norm(along)
        if (ends[:, 2] < 1.0).any():
            continue
        xy = project(camera, ends[0] + np.linspace(0, 1, KNOTS)[:, None] * (ends[1] - ends[0]))
        if (xy > 0).all() and (xy < SIZE).all() and np.hypot(*(xy[-1] - xy[0])) > 40:
            kept.append(xy + noise_px * rng.standard_normal(xy.shape))
    points = np.array(kept)
    length = np.hypot(*(points[:, -1] - points[:, 0]).T)
    order = np.argsort(-length)
    return Arcs(points[order], length[order], np.full(num, noise_px))


ACROSS = rigid3.exp_so3([0.25, 0.0, 0.0]) @ rigid3.exp_so3([0.0, 0.7, 0.0]) @ rigid3.exp_so3([0.0, 0.0, 0.05])
AXES = np.eye(3)


def told(arcs, seed: int = 0):
    found = calibrate_from_arcs([str(k) for k in range(len(arcs))], arcs, SIZE, seed)
    return found, *found.report.parameters


def test_edges_are_found_to_a_fraction_of_a_pixel() -> None:
    y, x = np.mgrid[:240, :320] + 0.5
    distance = np.hypot(x - 20.0, y + 380.0) - 500.0  # a circle of 500 px
    grey = np.clip(40 + 160 / (1 + np.exp(-distance / 0.4)), 0, 255).astype(np.uint8)
    mask = np.ones(grey.shape, bool)
    mask[:, 280:] = False
    arcs = find_arcs(grey, mask)
    assert len(arcs) == 1
    assert arcs.length_px[0] > 200
    off = np.hypot(*(arcs.points[0] - [20.0, -380.0]).T) - 500.0
    assert np.abs(off).max() < 0.05
    assert arcs.points[..., 0].max() < 281
    assert len(find_arcs(np.full((64, 64), 90, np.uint8))) == 0


def four_fields(shift_px: float, turn_deg: float) -> np.ndarray:
    """Two dark and two bright fields that meet in (160, 120), the lower two beside the upper ones, or turned away."""
    y, x = np.mgrid[: 4 * 240, : 4 * 320] / 4 + 0.125
    lower = 160 + shift_px + (y - 120) * math.tan(math.radians(turn_deg))
    is_bright = (x > np.where(y < 120, 160, lower)) ^ (y > 120)
    grey = cv2.GaussianBlur(np.where(is_bright, 200.0, 60.0), (0, 0), 2.4)
    return np.asarray(cv2.resize(grey, (320, 240), interpolation=cv2.INTER_AREA).round().astype(np.uint8))


@pytest.mark.parametrize(("shift_px", "turn_deg", "num"), [(0.0, 0.0, 2), (2.0, 0.0, 3), (0.0, 12.0, 3)])
def test_edges_that_change_sides_are_one_line_where_they_go_on(shift_px: float, turn_deg: float, num: int) -> None:
    arcs = find_arcs(four_fields(shift_px, turn_deg))
    assert len(arcs) == num
    across = arcs.points[np.ptp(arcs.points[..., 0], axis=1) > 200]
    assert len(across) == 1  # the horizontal line goes on in each
    assert np.abs(across[0, :, 1] - 120.0).max() < 0.1


BOARD_MIDDLE = np.array([5.0, 3.5])


def seen_board(camera: Camera, cam_from_board: np.ndarray, depth: float) -> np.ndarray:
    """(H, W) uint8 of 10 x 7 fields, 1 each, parallel to the picture; the camera records light by its square root."""
    at = (np.arange(3 * SIZE[1])[:, None] / 3 + 1 / 6, np.arange(3 * SIZE[0]) / 3 + 1 / 6)
    grid = np.stack(np.broadcast_arrays(at[1], at[0]), -1).reshape(-1, 2)
    rays = pixels_to_rays(camera, grid)
    board = (depth * rays[:, :2] / rays[:, 2:]) @ cam_from_board
    fields = np.floor(board + BOARD_MIDDLE).astype(int)
    is_dark = (fields >= 0).all(1) & (fields < [10, 7]).all(1) & (fields.sum(1) % 2 == 0)
    light = cv2.GaussianBlur(np.where(is_dark, 0.02, 0.9).reshape(3 * SIZE[1], -1), (0, 0), 3.0)
    grey = 255 * np.sqrt(cv2.resize(light, SIZE, interpolation=cv2.INTER_AREA))
    noise = np.random.default_rng(0).normal(0, 1.0, grey.shape)
    return np.clip(grey + noise, 0, 255).round().astype(np.uint8)


def test_lines_of_a_board_are_whole_and_where_they_are_though_bright_fields_have_grown() -> None:
    camera, depth = division_camera(), 9.5
    roll = rigid3.exp_so3([0.0, 0.0, 0.15])[:2, :2]
    arcs = find_arcs(seen_board(camera, roll, depth))
    scale = FOCAL / depth
    long = arcs.take(arcs.length_px > 5.0 * scale).points
    rays = pixels_to_rays(camera, long.reshape(-1, 2))
    board = ((depth * rays[:, :2] / rays[:, 2:]) @ roll).reshape(long.shape) + BOARD_MIDDLE
    kind = np.ptp(board, axis=1).argmin(1)  # which coordinate of the board a line keeps
    kept = np.take_along_axis(board, kind[:, None, None], 2)[..., 0]
    number = kept.mean(1).round()
    assert sorted(number[kind == 0]) == list(range(1, 10))
    assert sorted(number[kind == 1]) == list(range(1, 7))
    off_px = (kept - number[:, None]) * scale
    assert np.sqrt((off_px**2).mean()) < 0.06
    assert np.abs(off_px).max() < 0.2


def test_points_of_a_line_have_one_plane() -> None:
    camera = division_camera()
    arcs = seen_lines(camera, AXES, ACROSS, 30, 1, noise_px=0.0)
    lens = DivisionLens(STRENGTH, np.array([400.0, 300.0]), RADIUS)
    normals, _, rms = fit_planes(lens, arcs.points)
    assert rms.max() < 1e-6
    rays = pixels_to_rays(camera, arcs.points.reshape(-1, 2)).reshape(*arcs.points.shape[:2], 3)
    planes = normals / [1.0, 1.0, FOCAL / RADIUS]
    assert np.abs(np.einsum("nki,ni->nk", rays, planes)).max() < 1e-9


@pytest.mark.parametrize("seed", [0, 1])
def test_lens_and_focal_length_of_a_built_world_are_found(seed: int) -> None:
    camera = division_camera(center=(406.0, 296.0))
    arcs = seen_lines(camera, AXES, ACROSS, 54, seed)
    clutter = seen_lines(camera, [], ACROSS, 18, seed + 10)
    both = Arcs(*(np.concatenate(pair) for pair in zip(vars(arcs).values(), vars(clutter).values(), strict=True)))
    found, bend, focal, center = told([both], seed)
    assert (bend.verdict, focal.verdict, center.verdict) == ("measured",) * 3
    assert abs(bend.value - STRENGTH) < min(0.05 * abs(STRENGTH), 4.0 * bend.sigma)
    assert abs(focal.value - FOCAL) < min(0.02 * FOCAL, 4.0 * focal.sigma)
    assert 1e-4 * FOCAL < focal.sigma < 0.02 * FOCAL
    off = found.calibration.camera.params[1:3] - [406.0, 296.0]
    assert (np.abs(off) < 4.0 * found.calibration.sigmas[1:3]).all()
    assert found.report.held_out is not None
    assert found.report.held_out.num_met > 3 * found.report.held_out.num_expected


def horizontal(yaw_deg: float) -> np.ndarray:
    """A direction at right angles to the vertical, which is y."""
    yaw = math.radians(yaw_deg)
    return np.array([math.cos(yaw), 0.0, math.sin(yaw)])


@pytest.mark.parametrize(("yaws", "is_told"), [((0, 90, 35, 125), True), ((0, 90, 55), True), ((10, 40, 75), False)])
def test_further_horizontal_directions_do_no_harm(yaws: tuple[float, ...], is_told: bool) -> None:
    """An Atlanta world: the blocks of a town stand at several angles. In the last no two are at a right one, and it is
    no error to leave the focal length open there."""
    directions = [np.array([0.0, 1.0, 0.0]), *map(horizontal, yaws)]
    _, bend, focal, _ = told([seen_lines(division_camera(), directions, ACROSS, 72, 0)])
    assert bend.verdict == "measured"
    assert abs(bend.value - STRENGTH) < min(0.05 * abs(STRENGTH), 4.0 * bend.sigma)
    assert focal.verdict == "measured" or not is_told
    if focal.verdict == "measured":
        assert abs(focal.value - FOCAL) < 4.0 * focal.sigma
        # a rival is said, and as far away as the sigma
        has_rival = "another focal length" in focal.reason
        assert focal.sigma > 0.045 * FOCAL if has_rival else abs(focal.value - FOCAL) < 0.02 * FOCAL


def test_several_photographs_of_one_camera_are_surer_than_one() -> None:
    views = [
        seen_lines(division_camera(), AXES, rigid3.exp_so3([0.1 * k, 0.6 * (-1) ** k, 0.05 * k]), 40, 20 + k)
        for k in range(1, 4)
    ]
    _, _, alone, _ = told(views[:1])
    found, bend, focal, _ = told(views)
    assert len(found.report.photographs) == 3
    assert (bend.verdict, focal.verdict) == ("measured", "measured")
    assert abs(bend.value - STRENGTH) < min(0.05 * abs(STRENGTH), 4.0 * bend.sigma)
    assert abs(focal.value - FOCAL) < min(0.02 * FOCAL, 4.0 * focal.sigma)
    assert alone.verdict != "measured" or focal.sigma < alone.sigma


def test_a_frontal_view_tells_the_lens_and_not_the_focal_length() -> None:
    found, bend, focal, _ = told([seen_lines(division_camera(), AXES, np.eye(3), 40, 3)])
    assert (bend.verdict, focal.verdict) == ("measured", "unknown")
    assert abs(bend.value - STRENGTH) < 4.0 * bend.sigma
    assert found.calibration.camera.focal_source == "default"
    # what is not told is as unsure as the default is, in the file too
    assert found.calibration.sigmas[0] == pytest.approx(0.6 * found.calibration.camera.focal)
    assert "focal length is a default" in found.report.warnings[0]


def test_lines_in_all_directions_tell_the_lens_alone() -> None:
    _, bend, focal, _ = told([seen_lines(division_camera(), [], ACROSS, 50, 4)])
    assert (bend.verdict, focal.verdict) == ("measured", "unknown")
    assert abs(bend.value - STRENGTH) < 4.0 * bend.sigma


def test_no_distortion_is_left_alone() -> None:
    found, bend, focal, _ = told([seen_lines(division_camera(0.0), AXES, ACROSS, 42, 5)])
    assert (bend.verdict, focal.verdict) == ("left alone", "measured")
    assert found.calibration.camera.params[3] == 0.0
    assert abs(focal.value - FOCAL) < min(0.02 * FOCAL, 4.0 * focal.sigma)


def test_arcs_that_are_no_lines_are_refused() -> None:
    rng = np.random.default_rng(6)
    points = np.empty((40, KNOTS, 2))
    for k in range(len(points)):
        radius, turn, length = (
            rng.uniform(520, 3000) * rng.choice([-1, 1]),
            rng.uniform(0, 2 * math.pi),
            rng.uniform(60, 200),
        )
        angle = np.linspace(-0.5, 0.5, KNOTS) * length / radius
        flat = radius * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
        turned = flat @ [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
        points[k] = turned + rng.uniform(100, [700, 500])
    length = np.hypot(*(points[:, -1] - points[:, 0]).T)
    arcs = Arcs(points, length, np.full(len(points), 0.1))
    with pytest.raises(InputError, match="tell nothing of the camera"):
        told([arcs])
    with pytest.raises(InputError, match="at least 12 edges"):
        told([arcs.take(np.arange(5))])


def tiled_corner(camera: Camera) -> np.ndarray:
    """(H, W) uint8: three tiled walls that meet in a corner, nine rays a pixel."""
    step = (np.arange(3) + 0.5) / 3
    x = (np.arange(SIZE[0])[:, None] + step).ravel()
    y = (np.arange(SIZE[1])[:, None] + step).ravel()
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    rays = pixels_to_rays(camera, grid) @ ACROSS
    with np.errstate(divide="ignore"):
        depth = np.where(rays > 0, np.array([3.0, 1.4, 5.0]) / rays, np.inf)
        depth = np.where(rays < 0, np.array([-3.0, -2.0, -5.0]) / rays, depth)
    wall = depth.argmin(1)
    cells = np.floor(rays * depth.min(1)[:, None] / 0.7 + 0.3).astype(int)
    cells[np.arange(len(cells)), wall] = 0
    grey = 60 + 100 * (cells.sum(1) % 2) + 20 * wall
    mean = grey.reshape(SIZE[1], 3, SIZE[0], 3).mean((1, 3))
    return np.clip(mean + np.random.default_rng(0).normal(0, 1.5, mean.shape), 0, 255).astype(np.uint8)


def test_the_command_calibrates_and_the_camera_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = division_camera()
    cv2.imwrite(str(tmp_path / "corner.png"), tiled_corner(camera))
    out = tmp_path / "out"
    assert main(["calibrate", "lines", str(tmp_path / "corner.png"), "-o", str(out)]) == 0
    assert "focal length px: measured" in capsys.readouterr().out
    found = read_calibration_file(out)
    off = found.camera.params - camera.params
    assert abs(off[0]) < 0.02 * FOCAL
    assert abs(off[3] / camera.params[3]) < 0.05
    report = json.loads((out / "report.json").read_text())
    assert report["lines"]["mode"] == "directions"
    assert "data:image/jpeg" in (out / "report.html").read_text()
    assert (out / "lines" / "corner.jpg").is_file()
    assert (out / "recording.rrd").stat().st_size > 10_000
    flat = cv2.imread(str(out / "undistorted" / "corner.jpg"), cv2.IMREAD_GRAYSCALE)
    lens = DivisionLens(0.0, np.zeros(2), RADIUS)
    arcs = find_arcs(flat)
    assert np.median(fit_planes(lens, arcs.points)[2]) < 0.1  # straight now
    cv2.imwrite(str(tmp_path / "plain.png"), np.full((300, 400), 90, np.uint8))
    assert main(["calibrate", "lines", str(tmp_path / "plain.png"), "-o", str(tmp_path / "no")]) == 3
    assert "at least 12 edges" in capsys.readouterr().err
