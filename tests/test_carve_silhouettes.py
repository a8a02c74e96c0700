"""Silhouettes from alpha, mask files, masks for photographs and backgrounds, and masks that cannot be right."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from carving_photographs import coverage_of, photograph
from carving_scenes import around, ball, both, box
from sfmapp.carve.backgrounds import edge_pieces
from sfmapp.carve.graph_cut import cut_by_mask
from sfmapp.carve.masks_report import MasksReport
from sfmapp.carve.options import MaskOptions
from sfmapp.carve.silhouettes import Silhouette, find_silhouettes
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.load import load_images

SOLID = both(ball(0.5, (0.5, 0.2, 0.1)), box((0.3, 0.4, 0.6), (-0.4, 0.0, 0.0)))
COVERAGES = [coverage_of(view, SOLID, 5) for view in around(6, width=96, height=72)]
AUTO = MaskOptions()
PHOTOGRAPHS = [photograph(coverage, seed) for seed, coverage in enumerate(COVERAGES)]


def found_in(
    pictures: list[NDArray[np.uint8]], masks: list[NDArray[np.uint8]] | None = None, options: MaskOptions = AUTO
) -> tuple[list[Silhouette], MasksReport]:
    named = {f"{i}.png": picture for i, picture in enumerate(pictures)}
    given = {f"{i}.png": mask for i, mask in enumerate(masks or [])}
    images, _ = load_images(named, ImageOptions(), Events(), masks=given)
    return find_silhouettes(images, None, options, Events())


def bytes_of(coverage: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray((255.0 * coverage).round(), np.uint8)


def agreement(silhouette: Silhouette, coverage: NDArray[np.float32]) -> float:
    return agreement_of(silhouette.inside, coverage)


def agreement_of(inside: NDArray[np.bool_], coverage: NDArray[np.float32]) -> float:
    """Intersection over union."""
    true = coverage > 0.5
    return float((inside & true).sum() / (inside | true).sum())


def test_alpha_is_coverage() -> None:
    pictures = [np.dstack([p, bytes_of(c)]) for p, c in zip(PHOTOGRAPHS, COVERAGES, strict=True)]
    silhouettes, report = found_in(pictures)
    assert {mask.source for mask in report.masks} == {"alpha"}
    for silhouette, coverage in zip(silhouettes, COVERAGES, strict=True):
        assert agreement(silhouette, coverage) > 0.999
        # beside the outline coverage tells the distance: an edge along the pixels moves it by one over one pixel
        mixed = (coverage > 0.2) & (coverage < 0.8)
        assert np.abs(silhouette.distance[mixed]).max() < 0.75


def test_soft_and_hard_masks() -> None:
    for masks in ([bytes_of(c) for c in COVERAGES], [(c > 0.5).astype(np.uint8) for c in COVERAGES]):
        silhouettes, report = found_in(PHOTOGRAPHS, masks)
        assert {mask.source for mask in report.masks} == {"mask"}
        assert min(agreement(s, c) for s, c in zip(silhouettes, COVERAGES, strict=True)) > 0.985


def test_photographs_may_be_masks() -> None:
    silhouettes, report = found_in([bytes_of((c > 0.5).astype(np.float32)) for c in COVERAGES])
    assert {mask.source for mask in report.masks} == {"mask"}
    assert min(agreement(s, c) for s, c in zip(silhouettes, COVERAGES, strict=True)) > 0.985


@pytest.mark.parametrize("level", [0, 255])
def test_of_photographs_that_are_masks_one_may_be_empty_or_full(level: int) -> None:
    pictures = [np.repeat(np.where(c > 0.5, 255, 0).astype(np.uint8)[..., None], 3, axis=2) for c in COVERAGES]
    pictures[0] = np.full_like(pictures[0], level)
    _, report = found_in(pictures)
    assert [bool(mask.problem) for mask in report.masks] == [True, *[False] * (len(pictures) - 1)]


def test_background_is_learned() -> None:
    silhouettes, report = found_in(PHOTOGRAPHS)
    assert {mask.source for mask in report.masks} == {"background"}
    assert report.color_error is not None
    assert report.color_error < 0.02
    assert min(agreement(s, c) for s, c in zip(silhouettes, COVERAGES, strict=True)) > 0.98


def test_colors_that_tell_little_leave_it_to_cuts_of_single_photographs() -> None:
    # half of the object is as light as the wall behind it: where the object ends in each photograph is told by the rest
    pictures = []
    for seed, coverage in enumerate(COVERAGES):
        rng = np.random.default_rng(seed)
        light = np.linspace(0.5, 1.0, coverage.shape[1])[None, :, None]
        color = np.where(
            coverage[..., None] > 0.5, np.array([220.0, 150.0, 120.0]) * light, np.array([150.0, 135.0, 120.0])
        )
        wall = np.linspace(0.7, 1.05, coverage.shape[0])[:, None, None]
        color = np.where(coverage[..., None] > 0.5, color, color * wall) + rng.normal(0.0, 3.0, color.shape)
        pictures.append(np.clip(color.round(), 0, 255).astype(np.uint8))
    silhouettes, report = found_in(pictures)
    assert report.color_error is not None
    assert report.color_error > 0.025
    assert {mask.source for mask in report.masks} == {"grabcut"}
    assert "look alike" in report.warnings[0]
    assert min(agreement(s, c) for s, c in zip(silhouettes, COVERAGES, strict=True)) > 0.9


def test_a_cut_mends_a_rough_mask() -> None:
    for seed, (picture, coverage) in enumerate(zip(PHOTOGRAPHS[:3], COVERAGES, strict=False)):
        rng, true = np.random.default_rng(seed), coverage > 0.5
        holes = np.kron(rng.random((18, 24)) < 0.2, np.ones((4, 4), bool))
        wide = cv2.dilate(true.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        rough = np.where(rng.random(true.shape[1]) < 0.5, true & ~holes, wide & ~holes)
        cut = cut_by_mask(picture, rough)
        assert agreement_of(rough, coverage) < 0.85
        assert agreement_of(cut, coverage) > 0.95


def test_grabcut_needs_no_other_photographs() -> None:
    silhouettes, report = found_in(PHOTOGRAPHS[:1], options=MaskOptions(mask_source="grabcut"))
    assert report.masks[0].source == "grabcut"
    assert agreement(silhouettes[0], COVERAGES[0]) > 0.97


def test_results_do_not_depend_on_threads() -> None:
    images, _ = load_images({f"{i}.png": p for i, p in enumerate(PHOTOGRAPHS)}, ImageOptions(), Events())
    one, three = (find_silhouettes(images, None, MaskOptions(), Events(), threads=n)[0] for n in (1, 3))
    assert all(a.distance.tobytes() == b.distance.tobytes() for a, b in zip(one, three, strict=True))


@pytest.mark.parametrize("level", [0, 255])
def test_alpha_that_tells_nothing_is_said_to(level: int) -> None:
    pictures = [np.dstack([p, np.full(p.shape[:2], level, np.uint8)]) for p in PHOTOGRAPHS]
    silhouettes, report = found_in(pictures)
    assert {mask.source for mask in report.masks} == {"background"}
    assert [line.split(" of ")[0] for line in report.warnings] == ["the alpha channels"]
    assert min(agreement(s, c) for s, c in zip(silhouettes, COVERAGES, strict=True)) > 0.98
    # one photograph that tells is enough for alpha to be meant: the others are named
    pictures[3] = np.dstack([PHOTOGRAPHS[3], bytes_of(COVERAGES[3])])
    silhouettes, report = found_in(pictures)
    assert {mask.source for mask in report.masks} == {"alpha", "none"}
    assert "0.png has no alpha channel that tells the object" in report.warnings


@pytest.mark.parametrize("kind", ["empty", "full", "inverted", "missing"])
def test_masks_that_cannot_be_right_carve_nothing_and_are_named(kind: str) -> None:
    masks = [bytes_of(coverage) for coverage in COVERAGES]
    bad = {"empty": masks[2] * 0, "full": masks[2] * 0 + 255, "inverted": 255 - masks[2], "missing": masks[2]}
    masks[2] = bad[kind]
    named = {f"{i}.png": p for i, p in enumerate(PHOTOGRAPHS)}
    given = {f"{i}.png": mask for i, mask in enumerate(masks) if kind != "missing" or i != 2}
    images, _ = load_images(named, ImageOptions(), Events(), masks=given)
    silhouettes, report = find_silhouettes(images, None, MaskOptions(), Events())
    assert ["2.png" in line for line in report.warnings] == [True]
    told = {
        "missing": "2.png has no mask",
        "inverted": "the mask of 2.png is inverted: the object is what it leaves out",
    }
    assert report.warnings[0] == told.get(kind, f"the mask of 2.png is {kind}")
    known = silhouettes[2].known
    assert known is not None
    assert not known.any()
    assert all(silhouettes[i].known is None for i in range(6) if i != 2)


def test_all_masks_inverted_is_refused() -> None:
    with pytest.raises(InputError, match="inverted"):
        found_in(PHOTOGRAPHS, [255 - bytes_of(coverage) for coverage in COVERAGES])


def test_without_an_object_nothing_is_found() -> None:
    empty = [photograph(np.zeros_like(coverage), seed) for seed, coverage in enumerate(COVERAGES)]
    with pytest.raises(InputError, match=r"stands out|usable"):
        found_in(empty)


def test_a_mask_of_twice_the_size_keeps_shares_of_pixels(tmp_path: Path) -> None:
    for i, (picture, coverage) in enumerate(zip(PHOTOGRAPHS, COVERAGES, strict=True)):
        (tmp_path / "masks").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture[..., ::-1])
        large = np.repeat(np.repeat(bytes_of(coverage), 2, axis=0), 2, axis=1)
        cv2.imwrite(str(tmp_path / "masks" / f"{i}.png"), large)
    pattern = str(tmp_path / "*.png")
    images, _ = load_images(pattern, ImageOptions(mask_path=str(tmp_path / "masks")), Events())
    silhouettes, _ = find_silhouettes(images, None, MaskOptions(), Events())
    assert min(agreement(s, c) for s, c in zip(silhouettes, COVERAGES, strict=True)) > 0.999


def test_pieces_of_the_object_at_the_edges_say_that_colours_do_not_tell_it() -> None:
    # something of the object's colours stands in the background, and comes to the edge in some photographs
    pictures = [picture.copy() for picture in PHOTOGRAPHS]
    for i, picture in enumerate(pictures):
        rows, columns = np.nonzero(COVERAGES[i] > 0.99)
        left = 90 - 4 * i
        width = min(12, 96 - left)
        picture[50:65, left : left + width] = picture[np.median(rows).astype(int), np.median(columns).astype(int)]
    silhouettes, report = found_in(pictures)
    assert any(edge_pieces(silhouette.inside) > 0.0 for silhouette in silhouettes)
    assert any("at the edges" in line for line in report.warnings)
    assert not any("at the edges" in line for line in found_in(PHOTOGRAPHS)[1].warnings)


def test_the_largest_piece_may_reach_the_edge() -> None:
    mask = np.zeros((40, 60), bool)
    mask[10:30, :25] = True
    assert edge_pieces(mask) == 0.0
    mask[20:25, 55:] = True
    assert edge_pieces(mask) == pytest.approx(25 / 525)
    mask[20:25, 55:] = False
    mask[20:25, 50:55] = True
    assert edge_pieces(mask) == 0.0
