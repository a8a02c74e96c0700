"""Pictures of patches and meshes against planes and spheres that rays meet where algebra says."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.report.preview import (
    AMBIENT,
    BACKGROUND,
    CLAY,
    LAMP,
    VirtualCamera,
    picture_of_mesh,
    picture_of_patches,
    see_mesh,
    see_patches,
    shaded,
)
from sfmapp.scene.mesh import face_vectors, vertex_normals

Array = NDArray[np.float64]

# looks from somewhere to somewhere, not along an axis
POSE = rigid3.from_matrix(rigid3.exp_so3(np.array([0.3, -0.4, 0.2])), np.array([0.5, -0.2, 1.0]))
EYE = VirtualCamera(np.array([150.0, 140.0, 80.0, 60.0]), POSE, 160, 120)


def world(cam: Array) -> Array:
    return rigid3.apply(rigid3.inverse(POSE), cam)


def rays(eye: VirtualCamera) -> Array:
    """(H, W, 3) directions in the camera's axes, z = 1, through the centres of the pixels."""
    y, x = np.indices((eye.height, eye.width)) + 0.5
    fx, fy, cx, cy = eye.k
    return np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)


def plane(normal: Array, distance: float, spacing: float) -> tuple[Array, NDArray[np.float32]]:
    """Patches on the plane ``normal . x = distance`` of the camera's axes, far beyond the picture; world places."""
    normal = normal / np.linalg.norm(normal)
    a = np.cross(normal, [0.0, 1.0, 0.1])
    a /= np.linalg.norm(a)
    steps = np.arange(-8.0, 8.0, spacing)
    s, t = (grid.ravel()[:, None] for grid in np.meshgrid(steps, steps))
    cam = distance * normal + s * a + t * np.cross(normal, a)
    facing = -np.sign(distance) * normal @ rigid3.rotation_matrix(POSE)
    return world(cam), np.tile(facing, (len(cam), 1)).astype(np.float32)


def depth_of_plane(normal: Array, distance: float, eye: VirtualCamera) -> Array:
    return distance / (rays(eye) @ (normal / np.linalg.norm(normal)))


def sphere(rings: int, radius: float) -> tuple[Array, NDArray[np.int32]]:
    """Vertices and outward faces round the origin."""
    theta = np.linspace(0.0, np.pi, rings + 1)[1:-1]
    phi = np.arange(2 * rings) * np.pi / rings
    t, f = np.meshgrid(theta, phi, indexing="ij")
    ring = np.stack([np.sin(t) * np.cos(f), np.sin(t) * np.sin(f), np.cos(t)], axis=-1).reshape(-1, 3)
    xyz = radius * np.concatenate([ring, [[0, 0, 1.0], [0, 0, -1.0]]])
    n, last = 2 * rings, len(ring)
    faces = []
    for j in range(n):
        k = (j + 1) % n
        faces += [[last, j, k], [last + 1, last - n + k, last - n + j]]
        for i in range(rings - 2):
            a, b, c, d = i * n + j, i * n + k, (i + 1) * n + j, (i + 1) * n + k
            faces += [[a, c, b], [b, c, d]]
    return xyz, np.array(faces, np.int32)


def test_a_plane_of_discs_has_the_depth_of_the_plane() -> None:
    normal = np.array([0.3, -0.5, -1.0])
    xyz, facing = plane(normal, -4.0, 0.05)
    seen = see_patches(xyz, facing, np.full(len(xyz), 0.04, np.float32), EYE)
    np.testing.assert_allclose(seen.depth, depth_of_plane(normal, -4.0, EYE), rtol=1e-5)
    assert (seen.idx >= 0).all()
    # and each pixel sees a disc that its ray goes through, or one whose centre is in the pixel
    hit = rays(EYE) * seen.depth[..., None]
    away = np.linalg.norm(world(hit.reshape(-1, 3)) - xyz[seen.idx.ravel()], axis=1)
    assert np.mean(away <= 0.04 * 1.001) > 0.99
    assert away.max() < np.hypot(*(seen.depth.max() / EYE.k[:2]))


def test_the_nearer_of_two_crossing_planes_is_seen_whatever_comes_first() -> None:
    first, second = np.array([0.5, 0.0, -1.0]), np.array([-0.5, 0.0, -1.0])
    parts = [plane(first, -4.0, 0.05), plane(second, -4.0, 0.05)]
    expected = np.minimum(depth_of_plane(first, -4.0, EYE), depth_of_plane(second, -4.0, EYE))
    for order in ((0, 1), (1, 0)):
        xyz, facing = (np.concatenate([parts[k][i] for k in order]) for i in range(2))
        seen = see_patches(xyz, facing, np.full(len(xyz), 0.04, np.float32), EYE)
        # at the crossing, a pixel of which one disc does not quite reach the other plane's front may see either
        assert np.mean(np.abs(seen.depth / expected - 1.0) < 1e-5) > 0.99
        assert (seen.depth >= expected * (1 - 1e-5)).all()


@pytest.mark.parametrize("tilt_deg", [0.0, 60.0])
def test_the_area_of_a_disc_shrinks_with_the_cosine(tilt_deg: float) -> None:
    eye = VirtualCamera(np.array([400.0, 400.0, 80.5, 60.5]), rigid3.IDENTITY, 160, 120)
    tilt = np.radians(tilt_deg)
    normal = np.array([[np.sin(tilt), 0.0, -np.cos(tilt)]], np.float32)
    seen = see_patches(np.array([[0.0, 0.0, 100.0]]), normal, np.array([10.0], np.float32), eye)
    area = np.pi * (400.0 * 10.0 / 100.0) ** 2 * np.cos(tilt)
    # perspective and pixels on the rim: 2 %
    assert 0.98 * area < (seen.idx == 0).sum() < 1.02 * area


def test_a_disc_smaller_than_a_pixel_is_a_pixel_and_none_is_seen_behind_the_eye() -> None:
    eye = VirtualCamera(EYE.k, rigid3.IDENTITY, EYE.width, EYE.height)
    xyz = np.array([[0.5, 0.25, 5.0], [0.5, 0.25, -5.0], [100.0, 0.0, 5.0]])
    seen = see_patches(xyz, np.tile(np.float32([0, 0, -1]), (3, 1)), np.full(3, 1e-4, np.float32), eye)
    # 150 0.5 / 5 + 80 = 95, 140 0.25 / 5 + 60 = 67
    assert np.argwhere(seen.idx >= 0).tolist() == [[67, 95]]
    assert np.isinf(seen.depth[seen.idx < 0]).all()


def test_a_mesh_of_a_plane_has_its_depth_without_a_seam() -> None:
    normal = np.array([-0.4, 0.3, -1.0])
    xyz, _ = plane(normal, -3.0, 1.0)
    side = int(np.sqrt(len(xyz)))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(side - 1), np.arange(side - 1), indexing="ij"))
    a = i * side + j
    faces = np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])
    in_front = (xyz @ rigid3.rotation_matrix(POSE).T + POSE[4:])[:, 2] > 0.0
    assert in_front[faces].all(axis=1).mean() > 0.5
    seen = see_mesh(xyz, faces.astype(np.int32), EYE)
    np.testing.assert_allclose(seen.depth, depth_of_plane(normal, -3.0, EYE), rtol=1e-5)
    # the weights lead back to the place that the ray meets
    b, c = seen.weight[..., :1].astype(np.float64), seen.weight[..., 1:].astype(np.float64)
    corner = xyz[faces[seen.idx]]
    place = (1 - b - c) * corner[:, :, 0] + b * corner[:, :, 1] + c * corner[:, :, 2]
    hit = world((rays(EYE) * seen.depth[..., None]).reshape(-1, 3))
    np.testing.assert_allclose(place.reshape(-1, 3), hit, atol=1e-5)


def test_a_sphere_is_as_near_and_as_bright_as_a_sphere() -> None:
    eye = VirtualCamera(np.array([300.0, 300.0, 80.0, 60.0]), np.array([0, 0, 0, 1.0, 0.2, -0.1, 8.0]), 160, 120)
    xyz, faces = sphere(60, 1.5)
    assert ((xyz[faces[:, 0]] * face_vectors(xyz, faces)).sum(axis=1) > 0).all()
    seen = see_mesh(xyz, faces, eye)
    ray, center = rays(eye), eye.cam_from_world[4:]
    a, b, c = (ray * ray).sum(-1), ray @ center, center @ center - 1.5**2
    root = b * b - a * c
    hit = root > 0.02 * root.max()
    depth = (b - np.sqrt(np.maximum(root, 0.0))) / a
    # facets lie inside the sphere by up to r (1 - cos(pi / 120)) = 0.0005 across, more along an oblique ray
    assert (seen.idx >= 0)[hit].all()
    off = seen.depth[hit] - depth[hit]
    assert off.min() > -1e-5
    assert off.max() < 0.01
    picture = picture_of_mesh(xyz, faces, vertex_normals(xyz, faces), eye)
    normal = (ray * depth[..., None] - center) / 1.5
    light = AMBIENT + (1 - AMBIENT) * np.clip(normal @ LAMP, 0.0, 1.0)
    expected = np.array(CLAY) * light[..., None] ** (1 / 2.2)
    inner = root > 0.15 * root.max()
    assert np.abs(picture[inner] - expected[inner]).mean() < 1.5
    assert (picture[0, 0] == BACKGROUND).all()


def test_light_follows_lambert() -> None:
    toward = rigid3.rotation_matrix(POSE).T @ LAMP
    across = np.cross(toward, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    angle = np.radians([0.0, 60.0, 90.0, 150.0])[:, None]
    normal = np.cos(angle) * toward + np.sin(angle) * across
    share = (shaded(normal, EYE, np.full((4, 3), 255, np.uint8))[:, 0] / 255.0) ** 2.2
    np.testing.assert_allclose(share, [1.0, AMBIENT + 0.5 * (1 - AMBIENT), AMBIENT, AMBIENT], atol=0.01)


def test_pictures_of_patches_have_their_colours() -> None:
    normal = np.array([0.0, 0.0, -1.0])
    xyz, facing = plane(normal, -4.0, 0.05)
    rgb = np.tile(np.uint8([10, 120, 230]), (len(xyz), 1))
    colored, clay = picture_of_patches(xyz, facing, rgb, np.full(len(xyz), 0.04, np.float32), EYE)
    assert colored.shape == clay.shape == (120, 160, 3)
    assert (colored == [10, 120, 230]).all()
    flat = np.array(CLAY) * (AMBIENT + (1 - AMBIENT) * -LAMP[2]) ** (1 / 2.2)
    np.testing.assert_allclose(clay.reshape(-1, 3), np.tile(flat, (120 * 160, 1)), atol=1.0)
