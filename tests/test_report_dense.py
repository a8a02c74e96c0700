"""The dense report: its numbers add up, what is covered is measured, and the page holds it all."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.dense.report import DensifyReport, LevelReport, SeedsReport, WaveReport
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.geometry import rigid3
from sfmapp.report.coverage import REASONS, coverage
from sfmapp.report.dense_document import dense_document
from sfmapp.report.dense_html import dense_section, render_dense_html
from sfmapp.report.dense_pictures import dense_pictures, turned_eye
from sfmapp.report.model import DensePart, DenseRunReport, Outcome, RunFacts, Stages
from sfmapp.report.plots import bars_svg
from sfmapp.reporting import Step, Usage, from_plain, plain, to_json
from sfmapp.scene.mesh import Mesh, vertex_normals
from sfmapp.surface.report import MeshReport

WIDTH, HEIGHT, FOCAL, DEPTH = 160, 96, 120.0, 4.0


def make_scene(shift: float = 0.2, count: int = 3) -> DenseScene:
    """Cameras in a row ``shift`` apart that look along z at a wall of noise."""
    rng = np.random.default_rng(0)
    k = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
    views = tuple(
        DenseView(
            f"{m}<b>.jpg", rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8), None, k,
            np.concatenate([rigid3.IDENTITY[:4], [-shift * m, 0.0, 0.0]]),
        )
        for m in range(count)
    )  # fmt: skip
    neighbors = np.array([[b for b in range(count) if b != a] for a in range(count)], np.int32)
    return DenseScene(views, neighbors, np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))


def on_pixels(x: NDArray[Any], y: NDArray[Any], views: tuple[int, ...] = (0, 1, 2)) -> Patches:
    """Patches on the wall z = DEPTH at pixels of the first view, which all of ``views`` trust."""
    n = len(x)
    xyz = np.stack([(x - WIDTH / 2) / FOCAL * DEPTH, (y - HEIGHT / 2) / FOCAL * DEPTH, np.full(n, DEPTH)], axis=1)
    pixel = np.float32(DEPTH / FOCAL)
    return Patches(
        xyz, np.tile(np.float32([0, 0, -1]), (n, 1)), np.full((n, 3), 90, np.uint8),
        np.linspace(0.7, 0.99, n, dtype=np.float32), pixel * np.linspace(0.02, 0.3, n, dtype=np.float32),
        np.full(n, pixel), np.zeros(n, np.int32), len(views) * np.arange(n + 1), np.tile(np.int32(views), n),
    )  # fmt: skip


def wall(first: int = 0, last: int = WIDTH, views: tuple[int, ...] = (0, 1, 2)) -> Patches:
    """A patch for each second pixel of some columns of the first view."""
    y, x = (grid.ravel() + 1.0 for grid in np.mgrid[0:HEIGHT:2, first:last:2])
    return on_pixels(x, y, views)


def report_of(num_patches: int) -> DensifyReport:
    level = LevelReport(
        level=0, carried=50, points=5, expanded=90, corners=7, seen_by_few=3, accepted=num_patches + 30,
        contradicted=20, without_neighbours=4, in_small_groups=6, patches=num_patches, wall_s=1.25, cpu_s=2.5,
    )  # fmt: skip
    funnel = {"accepted": num_patches + 30, "contradicted": 20, "without neighbours": 4, "in small groups": 6}
    return DensifyReport(
        num_patches=num_patches, levels=[level], seeds=SeedsReport(carried=50, points=5, corners=7),
        waves=[WaveReport(wave=2, tried=100, accepted=60), WaveReport(wave=3, tried=50, accepted=30)],
        funnel=[Step(name=name, count=count) for name, count in (*funnel.items(), ("patches", num_patches))],
    )  # fmt: skip


def mesh_report() -> MeshReport:
    return MeshReport(
        depth=7, spacing=0.0333, num_vertices=4, num_faces=2, num_rim_edges=4,
        funnel=[Step(name="Poisson", count=10), Step(name="near patches", count=2)],
        poisson=Usage(wall_s=3.0, cpu_s=2.0, peak_memory_mb=100.0), wall_s=4.0, cpu_s=3.0,
    )  # fmt: skip


def quad() -> Mesh:
    xyz = np.array([[-1.0, -1, DEPTH], [1, -1, DEPTH], [-1, 1, DEPTH], [1, 1, DEPTH]])
    faces = np.array([[0, 2, 1], [1, 2, 3]], np.int32)
    return Mesh(xyz, faces, vertex_normals(xyz, faces), np.full((4, 3), 200, np.uint8))


def page_report(dense: DensePart | None) -> DenseRunReport:
    run = RunFacts(
        source="a & b", seed=0, threads=1, options={}, started="2026-01-01", versions={"sfmapp": "1"},
        is_up_to_date=False, wall_s=1.0, cpu_s=2.0,
    )  # fmt: skip
    return DenseRunReport(
        format="", outcome=Outcome(exit_code=0 if dense else 4, message="nothing agreed", advice=None), run=run,
        usage={}, warnings=[], decisions=[], stages=Stages(), dense=dense,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------------------ coverage


def test_what_is_covered_is_what_has_patches() -> None:
    scene, half = make_scene(), wall(0, WIDTH // 2)
    rows = coverage(scene, half)
    assert rows[0]["coverage"] == 0.5
    # 0.2 to the side at 4 away are 6 px of 160: the second view sees 80 - 6 columns, in blocks of 4
    assert rows[1]["coverage"] == pytest.approx((80 - 6) / WIDTH, abs=4 / WIDTH)
    for row in rows:
        assert row["coverage"] + row["out_of_sight"] + row["plain"] + row["unmatched"] == pytest.approx(1.0)
        assert row["num_neighbors"] == 2
    assert [row["num_patches"] for row in rows] == [len(half), 0, 0]
    assert [row["num_trusting"] for row in rows] == [len(half)] * 3
    # the other half is textured and in sight of the others but for their edges
    assert rows[0]["unmatched"] == pytest.approx(0.5, abs=0.06)
    assert rows[0]["reason"] == REASONS["unmatched"]
    whole = coverage(scene, wall())[0]
    assert replace(whole, coverage=1.0, reason="") == whole


def test_bare_walls_are_called_plain() -> None:
    scene = make_scene()
    first = scene.views[0]
    rgb = first.rgb.copy()
    rgb[:, WIDTH // 2 :] = 128
    views = (DenseView(first.name, rgb, None, first.k, first.cam_from_world), *scene.views[1:])
    scene = DenseScene(views, scene.neighbors, scene.point_xyz, scene.point_ptr, scene.point_view_idx)
    row = coverage(scene, wall(0, WIDTH // 2))[0]
    assert row["plain"] == pytest.approx(0.5, abs=0.06)
    assert row["reason"] == REASONS["plain"]


def test_what_no_other_photograph_shows_is_called_so() -> None:
    # 2.6 to the side at 4 away are 78 px: half of the first picture is in the second only, nothing in three
    row = coverage(make_scene(2.6), wall(WIDTH - 20, WIDTH, (0, 1)))[0]
    assert row["coverage"] == pytest.approx(20 / WIDTH)
    assert row["out_of_sight"] == pytest.approx(1 - 20 / WIDTH)
    assert row["reason"] == REASONS["out_of_sight"]
    in_two = coverage(make_scene(2.6), wall(WIDTH - 20, WIDTH, (0, 1)), min_views=2)[0]
    assert in_two["out_of_sight"] == pytest.approx(78 / WIDTH, abs=4 / WIDTH)


def test_masked_places_do_not_count() -> None:
    scene = make_scene()
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[:, : WIDTH // 2] = True
    views = tuple(DenseView(v.name, v.rgb, mask, v.k, v.cam_from_world) for v in scene.views)
    masked = DenseScene(views, scene.neighbors, scene.point_xyz, scene.point_ptr, scene.point_view_idx)
    assert coverage(masked, wall(0, WIDTH // 2))[0]["coverage"] == 1.0
    assert coverage(masked, wall(WIDTH // 2, WIDTH))[0]["coverage"] == 0.0


# ------------------------------------------------------------------------------------------------------------ document


def test_the_counts_of_a_document_add_up() -> None:
    patches = wall()
    document = dense_document(make_scene(), patches, report_of(len(patches)), mesh_report())
    for entry in document["histograms"].values():
        assert sum(entry["counts"]) == len(patches)
        assert len(entry["edges"]) == len(entry["counts"]) + 1
        assert (np.diff(entry["edges"]) > 0).all()
    assert document["histograms"]["views"]["counts"] == [len(patches)]
    assert document["histograms"]["sigma_px"]["median"] == pytest.approx(0.16, abs=1e-3)
    score = document["histograms"]["score"]
    expected = np.histogram(patches.score.astype(float), score["edges"])[0]
    np.testing.assert_allclose(score["counts"], expected, atol=1)
    funnel = [step["count"] for step in document["funnel"]]
    assert funnel[0] - sum(funnel[1:-1]) == funnel[-1] == document["num_patches"]
    assert {check["light"] for check in document["checks"]} <= {"green", "amber", "red"}
    assert from_plain(DensePart, plain(document)) == document


def test_values_out_of_range_and_unknown_ones_are_counted() -> None:
    patches = wall()
    patches.sigma[:3] = np.nan, np.inf, 1e6
    patches.score[:2] = -1.0, 0.1
    document = dense_document(make_scene(), patches, report_of(len(patches)))
    assert all(sum(entry["counts"]) == len(patches) for entry in document["histograms"].values())
    assert document["histograms"]["score"]["counts"][0] >= 2
    assert document["histograms"]["sigma_px"]["counts"][-1] >= 3
    assert "NaN" not in to_json(document)


def test_what_went_away_after_densification_is_a_step_of_its_own() -> None:
    patches = wall()
    document = dense_document(make_scene(), patches, report_of(len(patches) + 200))
    counts = [step["count"] for step in document["funnel"]]
    assert counts[-2] == 200
    assert counts[0] - sum(counts[1:-1]) == counts[-1] == len(patches)


# ------------------------------------------------------------------------------------------------------------ pictures


def test_pictures_show_the_scene_from_where_the_photographs_were_taken() -> None:
    rows = dense_pictures(make_scene(), wall(0, WIDTH // 2), quad(), cell_px=2)
    assert [len(row.pictures) for row in rows] == [4, 3]  # all look the same way: one photograph, and from beside
    colored = cv2.imdecode(np.frombuffer(rows[0].pictures[1].jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert colored.shape == (384, 640, 3)
    assert np.abs(colored[:, :310].astype(int) - 90).mean() < 3  # the left half, which has patches
    assert colored[:, 330:].mean() < 45
    assert len({picture.jpeg for row in rows for picture in row.pictures}) == 7


def test_the_turned_eye_sees_everything_from_above() -> None:
    scene, patches = make_scene(), wall()
    eye = turned_eye(scene, patches, 0)
    cam = rigid3.apply(eye.cam_from_world, patches.xyz)
    u, v = (cam[:, i] / cam[:, 2] * eye.k[i] + eye.k[2 + i] for i in range(2))
    inside = (cam[:, 2] > 0) & (u >= 0) & (u <= eye.width) & (v >= 0) & (v <= eye.height)
    assert inside.mean() > 0.9  # all but the outermost 2 % at each side
    assert np.ptp(u) > 0.6 * eye.width or np.ptp(v) > 0.6 * eye.height
    center = rigid3.center(eye.cam_from_world)
    assert center[1] < -0.5  # y is down: above
    assert center[2] < DEPTH  # on the side of the cameras


# ---------------------------------------------------------------------------------------------------------------- page


def test_the_page_is_self_contained_and_holds_the_numbers() -> None:
    scene, patches = make_scene(), wall()
    document = dense_document(scene, patches, report_of(len(patches)), mesh_report())
    page = render_dense_html(page_report(document), dense_pictures(scene, patches, quad()))
    assert page.count("data:image/jpeg;base64,") == 7
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "<script" not in page
    assert "<b>" not in page.replace("<b>nothing", "")  # names are escaped
    assert "0&lt;b&gt;.jpg" in page
    for text in (f"{len(patches)} patches", "mesh of 2 triangles", "near patches", "contradicted", "a &amp; b"):
        assert text in page


def test_the_worst_covered_photograph_comes_first() -> None:
    scene = make_scene(0.8)
    document = dense_document(scene, wall(), report_of(10))
    section = dense_section(document, [])
    names = re.findall(r">(\d)&lt;b&gt;\.jpg", section)
    assert names == ["2", "1", "0"]


def test_no_patches_still_make_a_page() -> None:
    scene, none = make_scene(), wall().subset(np.zeros(0, np.int64))
    document = dense_document(scene, none, report_of(0))
    assert all(row["coverage"] == 0.0 for row in document["images"])
    page = render_dense_html(page_report(document), dense_pictures(scene, none, None))
    assert "0 patches" in page
    assert "nothing agreed" in render_dense_html(page_report(None), [])


def test_bars_are_as_high_as_their_counts() -> None:
    svg = bars_svg([0.0, 1.0, 2.0, 3.0], [10, 0, 40], "x")
    heights = [float(h) for h in re.findall(r'class="bar"[^>]*height="([\d.]+)"', svg)]
    assert heights[1] == 0.0
    assert heights[2] / heights[0] == pytest.approx(4.0, abs=0.02)
