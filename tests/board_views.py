"""Synthetic views of boards: exact points, points with noise, and pictures of them through any lens."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.boards import Board
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3


def board_poses(rng: np.random.Generator, board: Board, num: int, camera: Camera, tilt_deg: float = 45.0) -> np.ndarray:
    """(N, 7) cam_from_board of views out to the corners, all points in the picture."""
    middle = board.points.mean(0)
    extent = float(np.ptp(board.points, axis=0).max())
    poses: list[np.ndarray] = []
    while len(poses) < num:
        turn = rigid3.exp_so3(np.radians(rng.uniform([-tilt_deg, -tilt_deg, -20], [tilt_deg, tilt_deg, 20])))
        depth = extent * camera.focal / camera.width * rng.uniform(1.2, 2.6)
        pixel = rng.uniform([0.2, 0.2], [0.8, 0.8]) * [camera.width, camera.height]
        ray = pixels_to_rays(camera, pixel[None])[0]
        pose = rigid3.from_matrix(turn, ray / ray[2] * depth - turn @ middle)
        xy = project(camera, rigid3.apply(pose, board.points))
        if np.isfinite(xy).all() and (xy > 2).all() and (xy < [camera.width - 2, camera.height - 2]).all():
            poses.append(pose)
    return np.array(poses)


def board_views(
    camera: Camera, board: Board, poses: np.ndarray, noise_px: float, rng: np.random.Generator, bend: float = 0.0
) -> list[TargetView]:
    """What is seen of a board, with Gaussian noise. ``bend``: depth of a cylinder about its y, in its unit."""
    points = board.points.copy()
    low, high = points[:, 0].min(), points[:, 0].max()
    points[:, 2] = bend * (2.0 * (points[:, 0] - low) / (high - low) - 1.0) ** 2
    views = []
    for n, pose in enumerate(poses):
        xy = project(camera, rigid3.apply(pose, points))
        views.append(TargetView(f"{n:02d}.png", board.points, xy + noise_px * rng.standard_normal(xy.shape)))
    return views


def board_texture(board: Board, px_per_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A board drawn flat with a margin, and where its frame's origin is in the drawing, pixels."""
    from sfmapp.calibration import printing

    s = px_per_m / 1000.0
    margin = 0.5 * board.spacing * px_per_m
    width, height = (round(side * px_per_m + 2 * margin) for side in board.size)
    sheet = np.full((height, width), 255, np.uint8)
    for shape in printing.shapes_of(board):
        if isinstance(shape, printing.Disk):
            # OpenCV draws with pixel centres at whole numbers
            center = (round((shape.x * s + margin - 0.5) * 16), round((shape.y * s + margin - 0.5) * 16))
            cv2.circle(sheet, center, round(shape.radius * s * 16), 0, -1, cv2.LINE_AA, 4)
        else:
            x, y = round(shape.x * s + margin), round(shape.y * s + margin)
            sheet[y : round((shape.y + shape.height) * s + margin), x : round((shape.x + shape.width) * s + margin)] = 0
    first = {"chessboard": board.spacing, "circles": 0.5 * board.spacing, "acircles": 0.5 * board.spacing}
    at = first.get(board.kind, board.spacing * board.marker if board.kind == "aprilgrid" else 0.0)
    return sheet, np.array([margin + at * px_per_m] * 2)


@cache
def rays_of(model: CameraModel, width: int, height: int, params: tuple[float, ...], over: int) -> np.ndarray:
    """Rays of all pixels, ``over`` samples each way."""
    u, v = np.meshgrid((np.arange(width * over) + 0.5) / over, (np.arange(height * over) + 0.5) / over)
    return pixels_to_rays(Camera(model, width, height, np.array(params)), np.stack([u.ravel(), v.ravel()], 1))


def render_board(
    camera: Camera, board: Board, pose: np.ndarray, *, blur_px: float = 0.0, noise: float = 0.0, seed: int = 0,
    background: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """(H, W) uint8: the board as the camera sees it, on grey or before a picture, two samples a pixel each way."""
    px_per_m = {"aprilgrid": 80.0, "circles": 160.0, "acircles": 160.0}.get(board.kind, 40.0) / board.spacing
    sheet, origin = board_texture(board, px_per_m)
    over = 2
    rays = rays_of(camera.model, camera.width, camera.height, tuple(camera.params), over)
    rotation, t = rigid3.rotation_matrix(pose), pose[4:]
    with np.errstate(all="ignore"):
        depth = (rotation[:, 2] @ t) / (rays @ rotation[:, 2])
        local = (rays * depth[:, None] - t) @ rotation
    is_seen = np.isfinite(local).all(1) & (depth > 0)
    xy = np.where(is_seen[:, None], local[:, :2] * px_per_m + origin - 0.5, -1e4)
    maps = xy.reshape(camera.height * over, camera.width * over, 2).astype(np.float32)
    picture = cv2.remap(sheet, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    if background is not None:
        on_sheet = cv2.remap(np.full_like(sheet, 255), maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        picture = np.where(on_sheet == 255, picture, cv2.resize(background, on_sheet.shape[::-1]))
    picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float64)
    picture = 20.0 + 0.82 * picture
    if blur_px:
        picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    if noise:
        picture += noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def filmed_board(
    camera: Camera, board: Board, num: int, blurred: set[int], *, seed: int = 0, noise: float = 2.0
) -> list[np.ndarray]:
    """(H, W) uint8 frames of a board that is moved before a camera, smoothly; fast while ``blurred`` frames are
    exposed, so that each is the mean of what it shows in that time."""
    rng = np.random.default_rng(seed)
    phase, turns = rng.uniform(0.0, 2.0 * np.pi, 5), np.array([1.0, 2.0, 1.0, 2.0, 3.0])
    middle = board.points.mean(0)
    extent = float(np.ptp(board.points, axis=0).max())

    def at(time: float) -> np.ndarray:
        wave = np.sin(2.0 * np.pi * turns * time / num + phase)
        depth = extent * camera.focal / camera.width * (1.7 + 0.5 * wave[2])
        pixel = np.array([camera.width, camera.height]) * (0.5 + 0.33 * wave[:2])
        turn = rigid3.exp_so3(np.radians([40.0 * wave[3], 40.0 * wave[4], 10.0 * wave[0]]))
        ray = pixels_to_rays(camera, pixel[None])[0]
        return rigid3.from_matrix(turn, ray / ray[2] * depth - turn @ middle)

    frames = []
    for n in range(num):
        times = (n + np.linspace(-0.4, 0.4, 9)).tolist() if n in blurred else [float(n)]
        seen = [render_board(camera, board, at(time), blur_px=0.6).astype(np.float64) for time in times]
        picture = np.mean(seen, axis=0) + noise * rng.standard_normal(seen[0].shape)
        frames.append(np.clip(np.round(picture), 0, 255).astype(np.uint8))
    return frames
