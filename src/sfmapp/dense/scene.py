"""What densification works on, and what it makes: prepared views in, oriented patches out, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import upright_poses


@dataclass(frozen=True)
class DenseView:
    """One photograph at working resolution, without distortion.

    Attributes:
        name: of the photograph in the model.
        rgb: (H, W, 3) uint8.
        mask: (H, W) bool, True where there is something to reconstruct; None for everywhere.
        k: (4,) float64 ``fx, fy, cx, cy`` in pixels of this resolution, the centre of the top-left one (0.5, 0.5).
        cam_from_world: (7,) float64.
        orientation: EXIF orientation 1 to 8 of these pixels, for whoever shows them to people.
    """

    name: str
    rgb: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None
    k: NDArray[np.float64]
    cam_from_world: NDArray[np.float64]
    orientation: int = 1

    @property
    def width(self) -> int:
        width: int = self.rgb.shape[1]
        return width

    @property
    def height(self) -> int:
        height: int = self.rgb.shape[0]
        return height

    def project(self, xyz: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(N, 2) pixels and (N,) depth at which the view sees places (N, 3) of the world; pixels are NaN behind it."""
        seen = rigid3.apply(self.cam_from_world, xyz)
        depth = seen[:, 2]
        return seen[:, :2] / np.where(depth > 0.0, depth, np.nan)[:, None] * self.k[:2] + self.k[2:], depth

    def shows(self, pixel: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,) bool, True for pixels (N, 2) within the picture; NaN is not."""
        return np.asarray(((pixel >= 0.0) & (pixel < [self.width, self.height])).all(axis=1))


@dataclass(frozen=True)
class Region:
    """A box in the world, aligned with its axes; what lies outside is not reconstructed.

    Attributes:
        low, high: (3,) float64 corners.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def holds(self, xyz: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) bool of points (N, 3)."""
        return np.asarray(((xyz >= self.low) & (xyz <= self.high)).all(axis=1))


@dataclass(frozen=True)
class DenseScene:
    """Views with known cameras and the sparse points between them.

    Attributes:
        views: V of them.
        neighbors: (V, K) int32, for each view the positions of those to match it with, best first, -1 behind the last.
        point_xyz: (P, 3) float64 sparse points, world; there may be none.
        point_ptr: (P + 1,) int64 and point_view_idx: (O,) int32, the views that see point p are
            ``point_view_idx[point_ptr[p]:point_ptr[p + 1]]``.
        region: nothing outside is wanted; None: no bounds.
    """

    views: tuple[DenseView, ...]
    neighbors: NDArray[np.int32]
    point_xyz: NDArray[np.float64]
    point_ptr: NDArray[np.int64]
    point_view_idx: NDArray[np.int32]
    region: Region | None = None

    @property
    def cam_from_world(self) -> NDArray[np.float64]:
        """(V, 7)."""
        return np.array([view.cam_from_world for view in self.views]).reshape(-1, 7)

    @property
    def upright_cam_from_world(self) -> NDArray[np.float64]:
        """(V, 7) poses of cameras that are rolled until their pictures are upright, to judge by where up is."""
        return upright_poses(self.cam_from_world, [view.orientation for view in self.views])

    @property
    def centers(self) -> NDArray[np.float64]:
        """(V, 3) camera centres, world."""
        return rigid3.center(self.cam_from_world)


@dataclass(frozen=True)
class Patches:
    """Oriented patches (N) of Furukawa and Ponce, PAMI 2010: centre c(p), normal n(p), reference R(p), trusted V*(p).

    Attributes:
        xyz: (N, 3) float64 centres, world.
        normal: (N, 3) float32 unit normals, world, on the side of the cameras.
        rgb: (N, 3) uint8, from the reference image.
        score: (N,) float32 mean normalised cross-correlation with the trusted images, at most 1.
        sigma: (N,) float32 standard deviation of the place along the ray of the reference image, world units.
        size: (N,) float32 what a pixel of the reference image at working resolution measures at the patch, world units.
        wave: (N,) int32 number of the wave that made it; 0 for seeds.
        view_ptr: (N + 1,) int64 and view_idx: (M,) int32, the trusted images of patch p are
            ``view_idx[view_ptr[p]:view_ptr[p + 1]]``, its reference image first: positions in the scene's views.
    """

    xyz: NDArray[np.float64]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    score: NDArray[np.float32]
    sigma: NDArray[np.float32]
    size: NDArray[np.float32]
    wave: NDArray[np.int32]
    view_ptr: NDArray[np.int64]
    view_idx: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def reference_idx(self) -> NDArray[np.int32]:
        """(N,) position of the reference image."""
        return self.view_idx[self.view_ptr[:-1]]

    @property
    def num_views(self) -> NDArray[np.int32]:
        """(N,) number of trusted images, the reference among them."""
        return np.diff(self.view_ptr).astype(np.int32)

    def subset(self, kept: NDArray[np.integer] | NDArray[np.bool_]) -> Patches:
        """The patches at some positions (integers, in that order) or where a mask (N,) is True."""
        idx = np.flatnonzero(kept) if kept.dtype == np.bool_ else kept
        counts = np.diff(self.view_ptr)[idx]
        view_ptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        source = np.repeat(self.view_ptr[:-1][idx] - view_ptr[:-1], counts) + np.arange(view_ptr[-1])
        return Patches(
            self.xyz[idx], self.normal[idx], self.rgb[idx], self.score[idx], self.sigma[idx], self.size[idx],
            self.wave[idx], view_ptr, self.view_idx[source],
        )  # fmt: skip

    def with_more(self, other: Patches) -> Patches:
        """Those of another cloud of the same views behind these."""
        names = ("xyz", "normal", "rgb", "score", "sigma", "size", "wave", "view_idx")
        values = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return Patches(**values, view_ptr=np.concatenate([self.view_ptr, other.view_ptr[1:] + self.view_ptr[-1]]))
