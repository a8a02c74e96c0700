"""Silhouettes joined with patches, on solids of exact shape."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from carving_scenes import Solid, around, ball, both, box, pixel_centers, ring, shown_depth, silhouette_of, without
from sfmapp.camera.camera import pixels_to_rays
from sfmapp.carve.hull import hull_of
from sfmapp.carve.isosurface import surface_of
from sfmapp.carve.joined import Evidence, Joined, JoinOptions, JoinReport, cast_votes, join
from sfmapp.carve.joined_kernels import BINS, FULL, find_value, paint
from sfmapp.carve.limits import CLOSURE, OUTLINES, PATCHES, find_known, find_limits
from sfmapp.carve.octree import places_of
from sfmapp.carve.sight import Sight, sights_of_patches
from sfmapp.carve.views import View, view_of_matrix
from sfmapp.dense.scene import Patches
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.geometry import rigid3
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.trim import rim

Array = NDArray[np.float64]

LOW, SIDE, CELLS = np.array([-1.28, -1.28, -1.28]), 2.56, 64
# a ball out of which a ball is taken from above: silhouettes from all around know nothing of the hollow
RADIUS, HOLLOW, AT = 1.0, 0.7, 0.9
BOWL = without(ball(RADIUS), ball(HOLLOW, (0.0, 0.0, AT)))


def bowl_volume() -> float:
    """A ball's volume less the lens that two balls share (Weisstein, "Sphere-Sphere Intersection")."""
    big, small, d = RADIUS, HOLLOW, AT
    lens = np.pi * (big + small - d) ** 2 * (d**2 + 2 * d * (big + small) - 3 * (big - small) ** 2) / (12 * d)
    return float(4.0 / 3.0 * np.pi * big**3 - lens)


def views_around() -> list[View]:
    return around(12, 5.0, 120, 100, 45.0)


def sight_of(view: View, solid: Solid, seen: NDArray[np.bool_] | None = None) -> Sight:
    """The exact surface in a view, where ``seen`` (H W,) says that patches are."""
    assert view.camera is not None
    assert view.cam_from_world is not None
    xy = pixel_centers(view)
    distance = shown_depth(view, solid, xy)
    hit = np.isfinite(distance) if seen is None else np.isfinite(distance) & seen
    rays = pixels_to_rays(view.camera, xy)
    rotation = rigid3.rotation_matrix(view.cam_from_world)
    points = view.center + np.where(hit, distance, 1.0)[:, None] * (rays @ rotation)
    step = 1e-4
    slope = np.stack([solid(points + step * axis) - solid(points - step * axis) for axis in np.eye(3)], axis=1)
    normal = slope / np.linalg.norm(slope, axis=1, keepdims=True) @ rotation.T
    depth = np.where(hit, distance * rays[:, 2], np.nan).astype(np.float32)
    fx, fy, cx, cy = view.camera.k_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    return Sight(
        np.array([fx, fy, cx, cy]), view.cam_from_world, depth.reshape(view.height, view.width),
        np.where(hit[:, None], normal, 0.0).astype(np.float32).reshape(view.height, view.width, 3), 5.0 / fx,
    )  # fmt: skip


def evidence_of(solid: Solid, seen: Solid | None = None) -> Evidence:
    """``seen``: patches are only where they are inside of this."""
    views = views_around()
    silhouettes = [silhouette_of(view, solid) for view in views]
    sights = []
    for view in views:
        sight = sight_of(view, solid)
        if seen is not None:
            xy = pixel_centers(view)
            assert view.camera is not None
            assert view.cam_from_world is not None
            rays = pixels_to_rays(view.camera, xy)
            depth = sight.depth.ravel() / rays[:, 2]
            points = view.center + depth[:, None] * (rays @ rigid3.rotation_matrix(view.cam_from_world))
            keep = np.nan_to_num(seen(points), nan=1.0) < 0.0
            sight = sight_of(view, solid, keep)
        sights.append(sight)
    return Evidence(views, silhouettes, hull_of(views, silhouettes), sights)


def joined(
    solid: Solid, seen: Solid | None = None, threads: int = 2, cells: int = CELLS
) -> tuple[Joined, JoinReport, Mesh]:
    found, report = join(evidence_of(solid, seen), LOW, SIDE, cells, threads=threads)
    return found, report, surface_of(found.tree, found.distance)


def volume_of(mesh: Mesh) -> float:
    a, b, c = (mesh.xyz[mesh.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def test_a_hollow_that_silhouettes_cannot_see_is_there_after_patches() -> None:
    found, report, mesh = joined(BOWL)
    true = bowl_volume()
    assert report.hull_volume > 1.2 * true
    assert abs(volume_of(mesh) - true) < 0.02 * true
    inner, outer = found.tree.volume_bounds()
    assert inner < volume_of(mesh) < outer
    assert np.median(np.abs(BOWL(mesh.xyz))) < 0.2 * found.tree.cell
    assert np.quantile(np.abs(BOWL(mesh.xyz)), 0.99) < 1.5 * found.tree.cell


def test_surfaces_are_closed_and_turned_outward() -> None:
    for solid in (BOWL, ring(0.8, 0.25), both(ball(0.4, (-0.5, 0.0, 0.0)), box((0.2, 0.3, 0.4), (0.6, 0.0, 0.0)))):
        _, _, mesh = joined(solid)
        assert not len(rim(mesh.faces))
        assert volume_of(mesh) > 0.0


def test_the_hull_closes_what_has_no_patches() -> None:
    # patches in the hollow alone: the outside of the bowl has no texture
    _, _, mesh = joined(BOWL, seen=ball(HOLLOW + 0.05, (0.0, 0.0, AT)))
    # flatter where no outline asks for more: under it, where no camera looks
    assert 0.93 * bowl_volume() < volume_of(mesh) < 1.03 * bowl_volume()
    # and the other way round, what no patch is seen through stays
    views = views_around()
    hull = hull_of(views, [silhouette_of(view, BOWL) for view in views])
    _, report, mesh = joined(BOWL, seen=lambda xyz: xyz[:, 2] + 0.2)
    assert 0.9 * report.hull_volume < volume_of(mesh) < 1.02 * report.hull_volume
    assert hull.distance(mesh.xyz).min() > -0.5 * SIDE / CELLS


def test_the_hull_stays_where_photographs_see_it_and_nothing_tells_if_it_is_kept() -> None:
    # a slab seen from above: its hull goes on below it, where another photograph tells nothing but an outline
    slab, from_below = box((0.8, 0.8, 0.15)), around(1, 5.0, 120, 100, -85.0)
    above = around(24, 5.0, 120, 100, 45.0)[::2]
    sights = [sight_of(view, slab) for view in above]
    lowest, exact = {}, []
    for name, views, keep in (
        ("least", [*above, *from_below], 0.0), ("kept", [*above, *from_below], 1.0), ("unseen", above, 1.0),
    ):  # fmt: skip
        silhouettes = [silhouette_of(view, slab) for view in views]
        evidence = Evidence(views, silhouettes, hull_of(views, silhouettes), sights)
        found, _ = join(evidence, LOW, SIDE, 32, JoinOptions(keep=keep), threads=2)
        xyz = surface_of(found.tree, found.distance).xyz
        lowest[name] = xyz[:, 2].min()
        exact.append(np.median(np.abs(slab(xyz[xyz[:, 2] > 0.1]))))
    assert -1.2 < lowest["kept"] < -1.0
    assert -0.6 < min(lowest["least"], lowest["unseen"]) <= max(lowest["least"], lowest["unseen"]) < -0.15
    assert max(exact) < 0.25 * SIDE / 32


def test_every_silhouette_stays_filled() -> None:
    found, _, _ = joined(BOWL, seen=lambda xyz: xyz[:, 2] + 0.2)
    solid = found.tree.centers(found.tree.surface)
    for view in views_around():
        inside = silhouette_of(view, BOWL).distance > 4.0
        covered = np.zeros_like(inside)
        paint(view.row, solid, found.tree.cell, covered)
        assert (covered | ~inside).mean() > 0.999


def test_bytes_do_not_depend_on_threads() -> None:
    one, _, first = joined(BOWL, threads=1, cells=32)
    two, _, second = joined(BOWL, threads=2, cells=32)
    assert first.xyz.tobytes() == second.xyz.tobytes()
    assert one.tree.surface.tobytes() == two.tree.surface.tobytes()
    assert all(a.tobytes() == b.tobytes() for a, b in zip(one.tree.full, two.tree.full, strict=True))


def test_triangles_say_who_tells_them() -> None:
    # patches in one half of the hollow: outlines tell the outside, and nobody the other half
    evidence = evidence_of(
        BOWL, seen=without(ball(HOLLOW + 0.05, (0.0, 0.0, AT)), box((1.0, 2.0, 2.0), (1.0, 0.0, 0.0)))
    )
    found, report = join(evidence, LOW, SIDE, CELLS)
    mesh, views = surface_of(found.tree, found.distance), views_around()
    known = find_known(mesh, views, evidence, report.band)
    error = np.abs(BOWL(known.centers))
    patches, closure = known.kind == PATCHES, known.kind == CLOSURE
    assert error[patches].max() < 2.0 * report.band
    assert np.abs(evidence.hull.distance(known.centers[known.kind == OUTLINES])).max() < found.tree.cell
    in_hollow = np.linalg.norm(known.centers - (0.0, 0.0, AT), axis=1) < HOLLOW + 0.02
    assert patches[in_hollow & (known.centers[:, 2] < 0.6) & (known.centers[:, 0] < -0.1)].mean() > 0.95
    # what nobody tells is typically farther off than nearly all that patches tell
    assert np.quantile(error[patches], 0.9) < 0.5 * found.tree.cell
    assert np.median(error[closure]) > 4.0 * np.quantile(error[patches], 0.9)
    limits = find_limits(mesh, mesh, views, evidence.silhouettes, known)
    shares = limits.patches_share, limits.outlines_share, limits.closure_share, limits.unseen_share
    assert sum(shares) == pytest.approx(1.0)
    assert min(shares[:3]) > 0.02
    marks = known.of_vertices(mesh)
    assert (marks[mesh.faces].max(axis=1) <= known.kind).all()
    assert (marks[mesh.faces[patches]] == PATCHES).mean() > 0.8


def test_cells_of_the_octree_are_inside_outside_or_cut() -> None:
    found, _, _ = joined(BOWL)
    tree = found.tree
    for level, codes in enumerate(tree.full):
        if len(codes):
            assert (BOWL(tree.centers(codes, level)) < 0.5 * tree.cell).mean() > 0.999
    assert np.abs(BOWL(tree.centers(tree.surface))).max() < 4.0 * tree.cell
    fine = 2 ** (tree.depth - np.arange(tree.depth + 1))
    marks = np.zeros((CELLS,) * 3, np.int8)
    for level, codes in enumerate(tree.full):
        for place in places_of(codes) * fine[level]:
            x, y, z = (slice(int(p), int(p + fine[level])) for p in place)
            marks[x, y, z] += 1
    x, y, z = places_of(tree.surface).T
    marks[x, y, z] += 1
    assert marks.max() == 1
    assert tree.volume_bounds()[1] == pytest.approx(float(marks.sum()) * tree.cell**3)


def test_patches_seen_through_all_of_the_hull_leave_nothing() -> None:
    views = views_around()
    silhouettes = [silhouette_of(view, ball()) for view in views]
    hull = hull_of(views, silhouettes)
    ahead = np.zeros((100, 120, 3), np.float32)
    ahead[..., 2] = -1.0
    exact = [sight_of(view, ball()) for view in views]
    wall = [Sight(s.k, s.cam_from_world, np.full_like(s.depth, 50.0), ahead, 0.02) for s in exact]
    with pytest.raises(NoReconstructionError, match="nothing is left"):
        join(Evidence(views, silhouettes, hull, wall), LOW, SIDE, 32)
    with pytest.raises(InputError, match="see patches"):
        join(Evidence(views, silhouettes, hull, []), LOW, SIDE)


def test_the_step_towards_votes_is_the_least_of_its_energy() -> None:
    rng = np.random.default_rng(5)
    num, weight, step = 200, 0.7, 0.28
    votes = rng.integers(0, 4, (num, BINS)).astype(np.uint8)
    votes[:20] = 0
    extra = rng.choice([0.0, 2.5], num).astype(np.float32)
    start = rng.uniform(-1.0, 1.0, num).astype(np.float32)
    value, before = start.copy(), start.copy()
    none = np.full((num, 3), FULL, np.int32)
    fixed = np.arange(num) % 10 == 9
    find_value(0, num, np.zeros((num, 3), np.float32), none, votes, extra, fixed, weight, step, value, before)
    centers = np.concatenate([[-1.0], -1.0 + (2.0 * np.arange(1, BINS - 1) - 1.0) / (BINS - 2), [1.0]])
    grid = np.linspace(-1.0, 1.0, 4001)
    pulls = votes.astype(float)
    pulls[:, -1] += extra
    energy = (grid[:, None] - start) ** 2 / (2.0 * step)
    for b in range(BINS):
        energy += weight * pulls[:, b] * np.abs(grid[:, None] - centers[b])
    best = grid[np.argmin(energy, axis=0)]
    assert np.abs(value - np.where(fixed, start, best)).max() < 1e-3
    assert (before == start).all()


@pytest.mark.parametrize("back", [1.0, 2.0])
def test_a_sight_tells_nothing_farther_behind_a_patch_than_was_said(back: float) -> None:
    toward = np.zeros((4, 4, 3), np.float32)
    toward[..., 2] = -1.0
    sight = Sight(
        np.array([4.0, 4.0, 2.0, 2.0]),
        np.array([*rigid3.quaternion(np.eye(3)), 0.0, 0.0, 0.0]),
        np.ones((4, 4), np.float32),
        toward,
        0.25,
    )
    # depths in bands behind the patch: in front of the band, in it, and behind it
    behind = np.array([-2.0, -0.5, 0.5, 0.99, 1.5, 1.99, 2.01, 5.0])
    votes = np.zeros((len(behind), BINS), np.uint8)
    cast_votes(np.stack([0 * behind, 0 * behind, 1.0 + 0.1 * behind], axis=1), [sight], 0.1, back, votes)
    assert (votes.sum(axis=1) == (behind < back)).all()
    assert (votes[behind >= 1.0, : BINS - 1] == 0).all()
    assert votes[0, 0] == 1
    assert votes[1, 1:].argmax() < votes[2, 1:].argmax() < votes[3, 1:].argmax()


def test_sights_of_patches_show_the_surface() -> None:
    views = views_around()[:4]
    rng = np.random.default_rng(2)
    xyz = rng.normal(size=(20_000, 3))
    xyz /= np.linalg.norm(xyz, axis=1, keepdims=True)
    normal = xyz.astype(np.float32)
    sees = np.stack([((view.center - xyz) * xyz).sum(axis=1) > 0.3 for view in views[:3]], axis=1)
    xyz, normal, sees = xyz[sees.any(axis=1)], normal[sees.any(axis=1)], sees[sees.any(axis=1)]
    point, view_idx = np.nonzero(sees)
    ptr = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(xyz)))])
    num = len(xyz)
    patches = Patches(
        xyz, normal, np.zeros((num, 3), np.uint8), np.ones(num, np.float32), np.full(num, 1e-3, np.float32),
        np.full(num, 0.02, np.float32), np.zeros(num, np.int32), ptr, view_idx.astype(np.int32),
    )  # fmt: skip
    names = [view.name for view in views[:3]]
    by_patches = sights_of_patches(views, patches, names)
    assert len(by_patches) == 3
    for view, sight in zip(views, by_patches, strict=False):
        exact = sight_of(view, ball())
        # its pixels are those of the patches, coarser than the photograph's
        middle = tuple(side // 2 for side in sight.depth.shape)
        true = exact.depth[view.height // 2, view.width // 2]
        assert sight.depth[middle] == pytest.approx(true, abs=0.01)
        assert sight.pixel == pytest.approx(0.02, rel=0.4)
    with pytest.raises(InputError, match="found none"):
        sights_of_patches(views, patches, ["other"] * 3)
    with pytest.raises(InputError, match="projection matrix"):
        sights_of_patches([view_of_matrix(view.name, view.outer, 40, 30) for view in views], patches, names)
