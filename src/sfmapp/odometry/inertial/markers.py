"""ArUco and AprilTag markers of known size: where they are seen, and the scale that they give a map.

A marker is a square; its pose and side are fitted to its corners in all keyframes that see it, whose poses are known
up to the scale that is sought.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import pixels_to_normalized
from sfmapp.errors import UsageError
from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.scale import Length, ScaleEstimate, ScaleRefusal, parse_length
from sfmapp.odometry.report import MarkerEvidence, MarkerRow
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# Corners of a marker of side 1 in the order in which OpenCV gives them: clockwise from its own top left, y down.
_SQUARE: Array = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
# Pairs of sightings tried as a start: with 30 % of the sightings wrong all 20 pairs fail with a probability of 1e-6.
_MAX_PAIRS = 20
# Standard deviation of a corner where the residuals are too few to tell.
_CORNER_SIGMA_PX = 0.3


@dataclass(frozen=True)
class MarkerKind:
    """Which markers are in the scene, all of one size.

    Attributes:
        dictionary: OpenCV's name without ``DICT_``, in capitals: ``4X4_50``, ``APRILTAG_36H11``, ...
        side: of the black square, without the white margin.
    """

    dictionary: str
    side: Length


@dataclass(frozen=True)
class MarkerSightings:
    """What was detected in images.

    Attributes:
        image_idx: (N,) int64 position of the image in the reconstruction.
        marker_id: (N,) int64.
        corners: (N, 4, 2) pixels, clockwise from the marker's own top left corner.
    """

    image_idx: NDArray[np.int64]
    marker_id: NDArray[np.int64]
    corners: Array

    @classmethod
    def none(cls) -> MarkerSightings:
        """No markers."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 2)))


@dataclass(frozen=True)
class MarkerOptions:
    """How sightings become a scale."""

    max_error_px: float = 4.0  # a sighting with a corner further off than this is a wrong one
    max_sigma_relative: float = 0.1  # a less certain scale is refused


def parse_marker(text: str) -> MarkerKind:
    """``DICTIONARY:metres``, such as ``DICT_4X4_50:0.15`` or ``APRILTAG_36h11:0.08``.

    Raises:
        UsageError: no such dictionary, or no positive size.
    """
    name, separator, size = text.partition(":")
    known = _dictionaries()
    wanted = name.strip().upper().removeprefix("DICT_")
    if not separator or wanted not in known:
        raise UsageError(
            f"a marker is given as DICTIONARY:metres, got {text!r}", f"dictionaries: {', '.join(sorted(known))}"
        )
    return MarkerKind(wanted, parse_length(size))


def _dictionaries() -> dict[str, int]:
    import cv2

    return {
        name.removeprefix("DICT_").upper(): getattr(cv2.aruco, name)
        for name in dir(cv2.aruco)
        if name.startswith("DICT_")
    }


class MarkerDetector:
    """Finds the markers of one dictionary. One detector for each thread."""

    def __init__(self, dictionary: str) -> None:
        import cv2

        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        chosen = cv2.aruco.getPredefinedDictionary(_dictionaries()[dictionary])
        self._detector = cv2.aruco.ArucoDetector(chosen, parameters)

    def detect(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array]:
        """Ids (M,) and corners (M, 4, 2) in pixels of the markers in a grey image (H, W)."""
        corners, ids, _ = self._detector.detectMarkers(image)
        if ids is None or len(ids) == 0:
            return np.zeros(0, np.int64), np.zeros((0, 4, 2))
        # OpenCV puts the centre of a pixel at its index
        return ids.ravel().astype(np.int64), np.concatenate(corners).astype(np.float64).reshape(-1, 4, 2) + 0.5


def scale_from_markers(
    reconstruction: Reconstruction, sightings: MarkerSightings, side: Length, options: MarkerOptions = MarkerOptions()
) -> ScaleEstimate | ScaleRefusal:
    """Scale from the sides of markers of known size.

    For every id the square that most sightings agree with is fitted by least squares on its reprojection error; its
    side's standard deviation is the larger of that from the residuals and of that from their sums image by image, in
    which errors of the poses count. Ids are averaged by their weight; one that is far from the median of three or more
    (another size, a false detection) is left out.

    Args:
        reconstruction: a map; sightings in unregistered images are ignored.
        side: of the markers.
    """
    use = reconstruction.is_registered[sightings.image_idx]
    found: dict[int, tuple[float, float, int]] = {}
    for marker_id in np.unique(sightings.marker_id[use]):
        mine = np.flatnonzero(use & (sightings.marker_id == marker_id))
        views = _views(reconstruction, sightings.image_idx[mine], sightings.corners[mine])
        fitted = _fit_square(views, options.max_error_px)
        if fitted is not None:
            found[int(marker_id)] = fitted
    evidence = MarkerEvidence(
        metres=side.metres, sigma_m=side.sigma_m, num_sightings=int(use.sum()),
        markers={
            str(m): MarkerRow(side_map_units=float(np.exp(s)), sigma_relative=sigma, num_images=n)
            for m, (s, sigma, n) in found.items()
        },
    )  # fmt: skip
    if not found:
        what = f"{int(use.sum())} sightings" if use.any() else "no marker was seen"
        return ScaleRefusal("marker", f"no marker was measured from two keyframes that agree ({what})", evidence)
    log_side, sigma = _average(np.array([f[0] for f in found.values()]), np.array([f[1] for f in found.values()]))
    sigma = float(np.hypot(sigma, side.sigma_m / side.metres))
    if not sigma <= options.max_sigma_relative:
        reason = (
            f"the markers give the scale to {sigma:.0%} only, at most {options.max_sigma_relative:.0%} are allowed: "
            "they are too small in the images or seen from too nearly one place"
        )
        return ScaleRefusal("marker", reason, evidence)
    return ScaleEstimate(float(side.metres / np.exp(log_side)), sigma, "marker", evidence)


def _average(log_sides: Array, sigmas: Array) -> tuple[float, float]:
    """Weighted mean and its standard deviation; widened where the markers differ by more than they should."""
    if len(log_sides) >= 3:
        away = np.abs(log_sides - np.median(log_sides))
        # five of its own sigmas and five robust ones of all
        keep = away <= 5.0 * np.hypot(sigmas, 1.4826 * np.median(away))
        log_sides, sigmas = log_sides[keep], sigmas[keep]
    weights = 1.0 / sigmas**2
    mean = float(weights @ log_sides / weights.sum())
    chi2 = float(weights @ (log_sides - mean) ** 2) / max(len(log_sides) - 1, 1)
    return mean, float(np.sqrt(max(chi2, 1.0) / weights.sum()))


@dataclass(frozen=True)
class _Views:
    """Sightings of one marker: image_idx (N,), rotation (N, 3, 3), translation (N, 3), xn (N, 4, 2), focal (N,)."""

    image_idx: NDArray[np.int64]
    rotation: Array
    translation: Array
    xn: Array
    focal: Array

    def subset(self, index: Any) -> _Views:
        return _Views(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def residuals(self, xyz: Array) -> tuple[Array, Array]:
        """Projected minus observed (N, 4, 2), pixels before the lens, inf behind; corners (N, 4, 3) in the cameras."""
        local = np.einsum("nij,cj->nci", self.rotation, xyz) + self.translation[:, None]
        depth = np.where(local[..., 2:] > 1e-12, local[..., 2:], np.nan)
        return np.nan_to_num(self.focal[:, None, None] * (local[..., :2] / depth - self.xn), nan=np.inf), local

    def agree(self, xyz: Array, max_error_px: float) -> NDArray[np.bool_]:
        """(N,) bool: all four corners within the error."""
        return np.asarray((self.residuals(xyz)[0] ** 2).sum(-1).max(1) <= max_error_px**2, bool)


def _views(reconstruction: Reconstruction, image_idx: NDArray[np.int64], corners: Array) -> _Views:
    xn, focal = np.empty_like(corners), np.empty(len(corners))
    for n, image in enumerate(image_idx):
        camera = reconstruction.cameras[reconstruction.image_camera_idx[image]]
        xn[n], focal[n] = pixels_to_normalized(camera, corners[n]), camera.focal
    poses = reconstruction.cam_from_world[image_idx]
    views = _Views(image_idx, rigid3.rotation_matrix(poses), poses[:, 4:].copy(), xn, focal)
    return views.subset(np.isfinite(xn).all((1, 2)))


def _fit_square(views: _Views, max_error_px: float) -> tuple[float, float, int] | None:
    """Logarithm of the side, its standard deviation, number of images; None if no two images agree on a square."""
    start = _best_start(views, max_error_px)
    if start is None:
        return None
    rotation, center, log_side = start
    use = views.agree(_corners(*start), max_error_px)
    for _ in range(3):
        rotation, center, log_side, sigma = _refine_square(views.subset(use), rotation, center, log_side)
        previous, use = use, views.agree(_corners(rotation, center, log_side), max_error_px)
        if len(np.unique(views.image_idx[use])) < 2 or not np.isfinite(sigma):
            return None
        if np.array_equal(previous, use):
            break
    return log_side, sigma, int(use.sum())


def _corners(rotation: Array, center: Array, log_side: float) -> Array:
    corners: Array = np.exp(log_side) * _SQUARE @ rotation.T + center
    return corners


def _best_start(views: _Views, max_error_px: float) -> tuple[Array, Array, float] | None:
    """The square from two sightings that most sightings agree with, the one with less error among equals."""
    first, second = np.triu_indices(len(views.image_idx), 1)
    apart = views.image_idx[first] != views.image_idx[second]
    first, second = first[apart], second[apart]
    if len(first) > _MAX_PAIRS:
        pick = np.random.default_rng([len(first), 0x3A2E]).permutation(len(first))[:_MAX_PAIRS]
        first, second = first[pick], second[pick]
    best, best_key = None, (0, 0.0)
    for i, j in zip(first, second, strict=True):
        pair = views.subset(np.asarray(np.isin(np.arange(len(views.image_idx)), (i, j)), bool))
        square = _square_of(_triangulate(pair))
        if square is None:
            continue
        square = _refine_square(pair, *square, max_iterations=4)[:3]
        squared = (views.residuals(_corners(*square))[0] ** 2).sum(-1).max(1)
        agree = squared <= max_error_px**2
        key = (int(agree.sum()), -float(squared[agree].sum()))
        if agree[i] and agree[j] and key > best_key:
            best, best_key = square, key
    return best


def _triangulate(views: _Views) -> Array:
    """Corners (4, 3) in the world, linear in the rays (Hartley and Zisserman 12.2)."""
    rows = views.xn[..., None] * views.rotation[:, None, 2:3] - views.rotation[:, None, :2]  # (N, 4, 2, 3)
    right = views.translation[:, None, :2] - views.xn * views.translation[:, None, 2:]  # (N, 4, 2)
    out = np.empty((4, 3))
    for c in range(4):
        out[c] = np.linalg.lstsq(rows[:, c].reshape(-1, 3), right[:, c].ravel(), rcond=None)[0]
    return out


def _square_of(xyz: Array) -> tuple[Array, Array, float] | None:
    """Rotation, centre and log side of the square nearest to four points; None if they are nothing like one."""
    center = xyz.mean(0)
    around = xyz - center
    u, d, vt = np.linalg.svd(around.T @ _SQUARE)
    if not d[1] > 0.3 * d[0]:  # a square has two equal singular values; seen as good as edge on or wrongly they differ
        return None
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, center, float(np.log(d[:2].sum() / (_SQUARE**2).sum()))


def _refine_square(
    views: _Views, rotation: Array, center: Array, log_side: float, max_iterations: int = 10
) -> tuple[Array, Array, float, float]:
    """Gauss-Newton over rotation, centre and log side; the last returned is the standard deviation of the log side."""
    for _ in range(max_iterations):
        residual, jacobian = _linearize(views, rotation, center, log_side)
        if not np.isfinite(residual).all():
            return rotation, center, log_side, np.inf
        flat = jacobian.reshape(-1, 7)
        step = np.linalg.lstsq(flat, -residual.ravel(), rcond=None)[0]
        # lengths in units of the side: what lies beyond its neighbourhood is no linear problem
        step *= min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-300))
        rotation, log_side = rigid3.exp_so3(step[:3]) @ rotation, log_side + float(step[6])
        center = center + step[3:6] * np.exp(log_side - step[6])
        if np.abs(step).max() < 1e-10:
            break
    residual, jacobian = _linearize(views, rotation, center, log_side)
    normal = np.einsum("ncki,nckj->ij", jacobian, jacobian)
    if not np.isfinite(residual).all() or np.linalg.cond(normal) > 1e14:
        return rotation, center, log_side, np.inf
    inverse = np.linalg.inv(normal)
    variance = max(float((residual**2).sum()) / (residual.size - 7), _CORNER_SIGMA_PX**2)
    sums = np.einsum("ncki,nck->ni", jacobian, residual)
    by_image = float(((sums @ inverse[6]) ** 2).sum()) * len(sums) / max(len(sums) - 1, 1)
    return rotation, center, log_side, float(np.sqrt(max(variance * inverse[6, 6], by_image)))


def _linearize(views: _Views, rotation: Array, center: Array, log_side: float) -> tuple[Array, Array]:
    """Residuals (N, 4, 2) and slopes (N, 4, 2, 7) by exp(w) R, the centre in units of the side, and the log side."""
    xyz = _corners(rotation, center, log_side)
    residual, local = views.residuals(xyz)
    arm = xyz - center
    of_world = np.concatenate(
        [-rigid3.skew(arm), np.broadcast_to(np.exp(log_side) * np.eye(3), (4, 3, 3)), arm[..., None]], -1
    )
    x, y, z = np.moveaxis(local, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        zero = np.zeros_like(z)
        of_local = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], -2)
    of_local = views.focal[:, None, None, None] * of_local
    return residual, of_local @ views.rotation[:, None] @ of_world
