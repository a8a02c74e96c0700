"""Masks of objects that turn before a cluttered background, by a camera that stands still, against exact ones.

Rendered solids, of one colour or painted all over, before photographs of places, with shadows on these, noise, lamps
that flicker and a camera that is touched. `sfmapp masks` is told nothing, or given a photograph of the scene without
the solid; GrabCut (OpenCV's, full size, five rounds) is told the rectangle around the true mask. Jugs are bodies of
revolution but for a handle: unless they are painted they look the same from all sides, so that little of them changes.

    SFMAPP_DATA=... python benchmarks/masks_still.py [--only CASE ...]
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import cv2

from cases import measure_cases
from masks import by_rectangle, scores
from rendered_worlds.lit_solids import drawn, house, jug
from rendered_worlds.turntables import Conditions, Turntable, turned
from sfmapp.carve.options import MaskOptions
from sfmapp.carve.silhouettes import find_silhouettes
from sfmapp.carve.still_cameras import still_groups
from sfmapp.events import Events
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.load import load_images

PLACES = {
    "lund": "opensfm-lund", "villa": "balbianello", "door": "lund-door", "bull": "sfmtool-seoul-bull",
    "arcade": "pano-sponza-rot", "court": "strecha-courtyard-21", "portal": "herz-jesus-P8", "fountain": "fountain-P11",
}  # fmt: skip
WIDTH = 240
STILL, DARK, TOUCHED, MOVES = (
    Conditions(), Conditions(noise=5.0, flicker=0.1), Conditions(touch_px=2.0), Conditions(moves=True),
)  # fmt: skip
# solid, photographs, place, seed, painted, conditions; whether thresholds were chosen on it
CASES: dict[str, tuple[Any, int, str, int, bool, Conditions, bool]] = {
    "house, painted, lund": (house(), 16, "lund", 1, True, STILL, True),
    "house, lund": (house(), 16, "lund", 2, False, STILL, True),
    "jug, court": (jug(), 16, "court", 3, False, STILL, True),
    "jug, painted, villa": (jug(), 24, "villa", 4, True, STILL, True),
    "drawn 31, bull, noise and flicker": (drawn(31), 16, "bull", 5, False, DARK, True),
    "drawn 32, painted, portal": (drawn(32), 12, "portal", 6, True, STILL, True),
    "jug, door": (jug(), 36, "door", 7, False, STILL, True),
    "house, painted, arcade, touched": (house(), 16, "arcade", 8, True, TOUCHED, True),
    "drawn 51, fountain": (drawn(51), 16, "fountain", 11, False, STILL, False),
    "drawn 52, painted, court": (drawn(52), 16, "court", 12, True, STILL, False),
    "drawn 53, lund, noise and flicker": (drawn(53), 24, "lund", 13, False, DARK, False),
    "drawn 54, painted, villa, touched": (drawn(54), 10, "villa", 14, True, TOUCHED, False),
    "drawn 55, door": (drawn(55), 12, "door", 15, False, STILL, False),
    "jug, painted, fountain": (jug(), 16, "fountain", 16, True, STILL, False),
    "drawn 56, court, moves": (drawn(56), 16, "court", 17, False, MOVES, False),
    "drawn 57, painted, portal, moves": (drawn(57), 16, "portal", 18, True, MOVES, False),
}


def scene(case: str) -> Turntable:
    solid, num, place, seed, is_painted, conditions, _ = CASES[case]
    folder = Path(os.environ["SFMAPP_DATA"]) / PLACES[place]
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (".jpg", ".png"))
    backdrop = found[seed % len(found)]
    return turned(solid, num, WIDTH, backdrop, seed, is_painted=is_painted, conditions=conditions)


def measured(case: str) -> dict[str, Any]:
    """A row of the table."""
    photographed = scene(case)
    images, _ = load_images(
        {view.name: p for view, p in zip(photographed.views, photographed.pictures, strict=True)}, ImageOptions(),
        Events(),
    )  # fmt: skip
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"empty-{os.getpid()}.png"
    cv2.imwrite(str(path), photographed.empty[..., ::-1])
    row: dict[str, Any] = {
        "case": case, "fresh": not CASES[case][-1], "photographs": len(photographed.views),
        "is_still": still_groups(photographed.pictures) is not None, "moves": CASES[case][5].moves,
    }  # fmt: skip
    for name, options, views in (
        ("told nothing", MaskOptions(), None), ("with cameras", MaskOptions(), photographed.views),
        ("given the background", MaskOptions(background=str(path)), None),
    ):  # fmt: skip
        if row["moves"] and options.background is not None:
            continue
        start = time.process_time()
        silhouettes, report = find_silhouettes(images, views, options, Events(), threads=1)
        taken = 1e3 * (time.process_time() - start) / len(photographed.views)
        mean, least, _ = scores([each.inside for each in silhouettes], photographed.masks)
        row[name] = {"iou": mean, "least": least, "cpu_ms": taken, "warned": len(report.warnings)}
    path.unlink()
    peers = [by_rectangle(p, m) for p, m in zip(photographed.pictures, photographed.masks, strict=True)]
    row["peer"], row["peer_least"], _ = scores(peers, photographed.masks)
    return row


def markdown(report: dict[str, Any]) -> str:
    lines = [
        "# Masks before a background that stands still", "", (__doc__ or "").split("\n\n")[1].replace("\n", " "), "",
        "IoU, in brackets the least of a set.", "",
        "| case | photographs | chose | taken for still | told nothing | with cameras | given the background | "
        "GrabCut, true rectangle | warned | CPU ms |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["rows"]:
        told = [
            f"{row[name]['iou']:.3f} ({row[name]['least']:.3f})" if name in row else "-"
            for name in ("told nothing", "with cameras", "given the background")
        ]
        lines.append(
            f"| {row['case']} | {row['photographs']} | {'no' if row['fresh'] else 'yes'} | "
            f"{'yes' if row['is_still'] else 'no'} | {' | '.join(told)} | "
            f"{row['peer']:.3f} ({row['peer_least']:.3f}) | "
            f"{'yes' if row['told nothing']['warned'] else 'no'} | {row['told nothing']['cpu_ms']:.0f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    measure_cases("masks_still", __doc__, CASES, lambda case: [measured(case)], markdown)
