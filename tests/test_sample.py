"""The bundled sample: small, complete, and true to its cameras to a tenth of a pixel."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def cameras(sample: Path) -> list[dict[str, Any]]:
    document = json.loads((sample / "cameras.json").read_text())
    assert "pixel centres at integers" in document["convention"]
    return list(document["cameras"])


def test_files_are_all_there_and_small(sample: Path, cameras: list[dict[str, Any]]) -> None:
    files = sorted(path for path in (sample / "images").iterdir())
    assert 12 <= len(files) <= 24
    assert [f"images/{path.name}" for path in files] == [camera["file"] for camera in cameras]
    assert sum(path.stat().st_size for path in files) < 4_000_000
    for path in files:
        with Image.open(path) as image:
            assert image.format == "JPEG"
            assert image.size == (800, 600)
            assert not image.getexif()  # the focal length is unknown on purpose
            assert np.asarray(image.convert("L")).std() > 25


def test_cameras_are_rigid_and_surround_the_scene(cameras: list[dict[str, Any]]) -> None:
    rotation = np.array([camera["R_w2c"] for camera in cameras])
    translation = np.array([camera["t_w2c"] for camera in cameras])
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), np.tile(np.eye(3), (len(cameras), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    assert (centers[:, 2] > 0.8).all()
    assert (centers[:, 2] < 3).all()
    assert (rotation[:, 1] @ [0, 0, 1] < -0.7).all()  # y down, z of the world up
    forward = rotation[:, 2]
    between = np.degrees(np.arccos(np.clip(forward @ forward.T, -1, 1)))
    assert 80 < between.max() < 130
    assert between[np.arange(len(cameras) - 1), np.arange(1, len(cameras))].max() < 20
    # no two views from one place
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2) + 9 * np.eye(len(cameras))
    assert apart.min() > 0.15


def normalised(camera: dict[str, Any], xy: Array) -> Array:
    """(N, 3) undistorted viewing rays of pixels (N, 2) counted as the file says."""
    k, (k1, *others) = np.array(camera["K"]), camera["dist"]
    assert others == [0, 0, 0]
    distorted = (xy - k[:2, 2]) / k[[0, 1], [0, 1]]
    points = distorted.copy()
    for _ in range(30):  # a contraction for mild distortion
        points = distorted / (1 + k1 * np.sum(points**2, 1, keepdims=True))
    return np.concatenate([points, np.ones((len(points), 1))], 1)


@functools.cache
def detected(path: Path) -> tuple[Array, NDArray[np.float32]]:
    """SIFT keypoints (N, 2) in OpenCV's pixels and their descriptors."""
    import cv2

    keypoints, descriptors = cv2.SIFT_create(
        4000, contrastThreshold=0.02, enable_precise_upscale=True
    ).detectAndCompute(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), None)
    return np.array([keypoint.pt for keypoint in keypoints], np.float64), descriptors


def matched(sample: Path, one: dict[str, Any], two: dict[str, Any]) -> tuple[Array, Array]:
    """Matches of two images in OpenCV's pixels, by ratio test and mutual check."""
    import cv2

    (xy_a, desc_a), (xy_b, desc_b) = detected(sample / one["file"]), detected(sample / two["file"])
    matcher = cv2.BFMatcher()
    back = {m.queryIdx: m.trainIdx for m in matcher.match(desc_b, desc_a)}
    pairs = np.array(
        [
            (m.queryIdx, m.trainIdx)
            for m, n in matcher.knnMatch(desc_a, desc_b, k=2)
            if m.distance < 0.75 * n.distance and back[m.trainIdx] == m.queryIdx
        ]
    )
    return xy_a[pairs[:, 0]], xy_b[pairs[:, 1]]


def epipolar_distances(one: dict[str, Any], two: dict[str, Any], a: Array, b: Array) -> Array:
    """(N,) signed distances in pixels of the points b from the epipolar lines of the points a."""
    rotation = np.array(two["R_w2c"]) @ np.array(one["R_w2c"]).T
    t = np.array(two["t_w2c"]) - rotation @ np.array(one["t_w2c"])
    essential = np.cross(np.eye(3), t) @ rotation  # rows e_i x t: minus [t]x transposed, which is [t]x
    lines = normalised(one, a) @ essential.T
    signed = np.sum(lines * normalised(two, b), 1) / np.linalg.norm(lines[:, :2], axis=1)
    return signed * np.array(two["K"])[0, 0]


@pytest.mark.parametrize(("first", "second"), [(0, 1), (4, 6), (9, 10), (13, 15), (16, 17)])
def test_matches_lie_on_the_epipolar_lines_of_the_true_cameras(
    sample: Path, cameras: list[dict[str, Any]], first: int, second: int
) -> None:
    one, two = cameras[first], cameras[second]
    a, b = matched(sample, one, two)
    error = epipolar_distances(one, two, a, b)
    error = error[np.abs(error) < 4]
    assert len(error) > 150
    # SIFT localises to a fifth of a pixel or so on clean images (Lowe 2004; no better than 0.02 by any account)
    assert 0.02 < np.median(np.abs(error)) < 0.25
    # no bias: within three standard errors and a hundredth of a pixel
    core = error[np.abs(error) < 1]
    assert abs(np.median(core)) < 0.01 + 3 * core.std() / np.sqrt(len(core))


def test_the_half_pixel_is_right(sample: Path, cameras: list[dict[str, Any]]) -> None:
    """By how much all pixels would have to be shifted for matches to fit the true cameras best: by nothing."""
    errors, slopes = [], []
    for first, second in ((0, 4), (0, 6), (4, 9), (6, 10), (9, 13), (10, 15), (13, 17)):
        one, two = cameras[first], cameras[second]
        a, b = matched(sample, one, two)
        keep = np.abs(epipolar_distances(one, two, a, b)) < 1
        a, b = a[keep], b[keep]
        shifted = [
            epipolar_distances(one, two, a + d, b + d) for d in 0.5 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        ]
        errors.append(epipolar_distances(one, two, a, b))
        slopes.append(np.stack([shifted[0] - shifted[1], shifted[2] - shifted[3]], 1))
    error, slope = np.concatenate(errors), np.concatenate(slopes)
    shift = -np.linalg.lstsq(slope, error, rcond=None)[0]
    sigma = error.std() * np.sqrt(np.diag(np.linalg.inv(slope.T @ slope)))
    assert sigma.max() < 0.06, "the pairs can tell half a pixel"
    # OpenCV's own bias, 0.25 px where enable_precise_upscale is left off, would not pass
    assert (np.abs(shift) < 3 * sigma + 0.02).all(), (shift, sigma)
