"""Keypoints of one image, what they look like, and how two of them are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import InputError

_ROOT_SIFT_LENGTH = 128


class DescriptorMetric(StrEnum):
    """What descriptors are and how the distance of two of them is measured."""

    ROOT_SIFT = "root_sift"
    """(N, 128) uint8, RootSIFT times 512, as COLMAP stores it: Euclidean distance of unit vectors."""
    L2 = "l2"
    """(N, D) numbers of any kind: Euclidean distance, in units of the descriptors' root mean square length."""
    HAMMING = "hamming"
    """(N, B) uint8, packed bits: the share of the bits that differ."""


@dataclass(frozen=True)
class Features:
    """Keypoints of one image; the stage puts the largest scale first (ties by x, then y).

    A prefix is then the coarse subset, which is what image retrieval looks at. :meth:`from_arrays` makes features of
    what another program has found, and checks them.

    Attributes:
        keypoints: (N, 4) float32: x, y in pixels of the full-size image as it is stored (top-left pixel centre at
            0.5, 0.5); scale in pixels (COLMAP's sigma); orientation in radians.
        descriptors: (N, D) as ``metric`` says; ORB has 32 bytes. (N, 0) where there are none, and matches are given.
        rgb: (N, 3) uint8 colour of the pixel under each keypoint.
        metric: what the descriptors are.
        is_dark: (N,) bool, whether a keypoint is darker than what lies around it, which no change of light turns into
            the opposite, so that only those that agree are compared; None where that is not known.

    Example:
        >>> features = sfmapp.Features.from_arrays(xy, descriptors, metric="l2")  # SuperPoint, DISK, ALIKED, ...
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[Any]
    rgb: NDArray[np.uint8]
    metric: DescriptorMetric = DescriptorMetric.ROOT_SIFT
    is_dark: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.keypoints)

    @classmethod
    def from_arrays(
        cls,
        keypoints: ArrayLike,
        descriptors: ArrayLike | None = None,
        *,
        metric: DescriptorMetric | str = DescriptorMetric.L2,
        rgb: ArrayLike | None = None,
    ) -> Features:
        """Features that another program has found.

        Args:
            keypoints: (N, 2) x and y in pixels, (N, 3) with the scale in pixels, or (N, 4) with the orientation in
                radians as well. The centre of the top-left pixel is (0.5, 0.5): add 0.5 to what OpenCV, kornia and
                most networks give.
            descriptors: (N, D) numbers, or (N, B) uint8 for bits. None: matches are given later (see ``match_images``).
            metric: ``l2``, ``hamming`` or ``root_sift``; see :class:`DescriptorMetric`.
            rgb: (N, 3) uint8 colours for the points; None: black.

        Returns:
            The features, in the same order.

        Raises:
            InputError: an array of another shape or type, NaN or infinity.
        """
        points = np.asarray(keypoints, np.float32)
        if points.ndim != 2 or not 2 <= points.shape[1] <= 4 or not np.isfinite(points).all():
            raise InputError(
                f"keypoints: expected finite numbers of shape (N, 2), (N, 3) or (N, 4), found {points.shape}"
            )
        try:
            metric = DescriptorMetric(metric)
        except ValueError:
            names = ", ".join(DescriptorMetric)
            raise InputError(f"metric: expected one of {names}, found {metric!r}") from None
        table = np.zeros((len(points), 4), np.float32)
        table[:, 2] = 1.0
        table[:, : points.shape[1]] = points
        found = np.zeros((len(points), 0), np.float32) if descriptors is None else np.asarray(descriptors)
        colors = np.zeros((len(points), 3), np.uint8) if rgb is None else np.asarray(rgb)
        if colors.shape != (len(points), 3) or colors.dtype != np.uint8:
            raise InputError(f"rgb: expected uint8 of shape ({len(points)}, 3), found {colors.dtype} {colors.shape}")
        return cls(table, _checked(found, len(points), metric), np.ascontiguousarray(colors), metric)

    def without_descriptors(self) -> Features:
        """The same keypoints alone, an eighth of the memory."""
        return replace(self, descriptors=np.zeros((len(self), 0), self.descriptors.dtype))

    def whole_numbers(self, count: int | None = None) -> NDArray[np.float32]:
        """The first ``count`` descriptors, or all, as whole numbers.

        Returns:
            (K, D) float32 with rows not longer than about 512: RootSIFT as it is, bits spread out, other descriptors
            scaled to that length. Sums over products of such rows are exact in float32, in any order.
        """
        descriptors = self.descriptors[:count]
        if self.metric == DescriptorMetric.ROOT_SIFT:
            return descriptors.astype(np.float32)
        if self.metric == DescriptorMetric.HAMMING:  # ORB's 256 bits reach that length when a bit counts 32
            return np.unpackbits(descriptors, axis=1).astype(np.float32) * np.float32(32)
        lengths = np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
        whole: NDArray[np.float32] = np.rint(descriptors * (512 / lengths)).astype(np.float32)
        return whole


def _checked(descriptors: NDArray[Any], count: int, metric: DescriptorMetric) -> NDArray[Any]:
    """The descriptors, those compared by L2 as float32. Raises InputError if they are none of this metric."""
    shape, kind = descriptors.shape, descriptors.dtype
    if descriptors.ndim != 2 or shape[0] != count:
        raise InputError(f"descriptors: expected a row for each of {count} keypoints, found an array of shape {shape}")
    if metric == DescriptorMetric.L2:
        if kind.kind not in "fiu" or not np.isfinite(descriptors).all():
            raise InputError(f"descriptors: expected finite numbers for the metric l2, found {kind}")
        return np.ascontiguousarray(descriptors, np.float32)
    if kind != np.uint8 or (metric == DescriptorMetric.ROOT_SIFT and shape[1] != _ROOT_SIFT_LENGTH):
        wanted = f"(N, {_ROOT_SIFT_LENGTH})" if metric == DescriptorMetric.ROOT_SIFT else "(N, bytes)"
        raise InputError(f"descriptors: expected uint8 of shape {wanted} for the metric {metric}, found {kind} {shape}")
    return np.ascontiguousarray(descriptors)
