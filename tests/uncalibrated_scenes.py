"""Synthetic pictures of points by cameras that nobody has calibrated, for the tests of what needs no calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfmapp.geometry import rigid3
from sfmapp.geometry.projective import project

K = np.array([[900.0, 0.0, 512.0], [0.0, 900.0, 384.0], [0.0, 0.0, 1.0]])
CENTER, SIZE = np.array([512.0, 384.0]), 1024.0


@dataclass(frozen=True)
class Scene:
    """Points (N, 3), cameras (V, 3, 4) and pixels (N, V, 2)."""

    xyz: np.ndarray
    cameras: np.ndarray
    xy: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """(N, 4)."""
        return np.c_[self.xyz, np.ones(len(self.xyz))]


def scene(
    num_views: int = 6, num_points: int = 60, *, seed: int = 0, noise: float = 0.0, turntable: bool = False,
    k: np.ndarray = K, turn: float = 0.35,
) -> Scene:  # fmt: skip
    """A cube of side two, five units away, from cameras that turn any way, or about one axis by ten degrees each."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1.0, 1.0, (num_points, 3))
    cameras = []
    for v in range(num_views):
        w = np.array([0.0, 0.17 * v, 0.0]) if turntable else rng.normal(0.0, turn, 3)
        t = np.array([0.0, 0.0, 5.0]) + (0.0 if turntable else rng.normal(0.0, 0.4, 3))
        cameras.append(k @ np.column_stack([rigid3.exp_so3(w), t]))
    p = np.array(cameras)
    xy = project(p, np.c_[xyz, np.ones(num_points)])
    return Scene(xyz, p, xy + noise * rng.standard_normal(xy.shape))


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Between arrays that are known up to scale and sign."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return float(min(np.linalg.norm(a - b), np.linalg.norm(a + b)))
