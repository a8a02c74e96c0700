"""The picture of docs/guides/stereo.md: what windows of several sizes make of one rendered pair, beside the truth.

    python benchmarks/stereo_windows_figure.py

Small windows are noisy where there is little to see, large ones blur what is near into what is behind it; the adaptive
one takes for each pixel the size whose mean cost is the least. All but the last but one are the best disparity of each
pixel, without any test.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import ROOT
from sfmapp.images.pixels import as_gray
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.windows import best_disparities
from stereo_pairs import StereoSet, rendered_set, shots

OUT = ROOT / "docs" / "pictures" / "stereo-windows.jpg"
SHOT = "gallery"
# no answer is dropped for what the other side says
EVERY_PX = 1e6
PANELS: tuple[tuple[str, StereoOptions], ...] = (
    ("SSD, 5 x 5", StereoOptions(cost="ssd", windows="fixed", window=5, left_right_px=EVERY_PX)),
    ("SSD, 31 x 31", StereoOptions(cost="ssd", windows="fixed", window=31, left_right_px=EVERY_PX)),
    ("SSD, 21 x 21", StereoOptions(cost="ssd", windows="fixed", window=21, left_right_px=EVERY_PX)),
    ("SSD, adaptive, 5 to 21", StereoOptions(cost="ssd", windows="adaptive", window=15, left_right_px=EVERY_PX)),
    ("census, nested 5, 13, 33", StereoOptions(left_right_px=EVERY_PX)),
)


def panel(disparity: NDArray[np.float32], case: StereoSet, title: str) -> NDArray[np.uint8]:
    """(H, W, 3) BGR, near red and far blue, black where unknown, with its share of bad pixels."""
    low, high = np.nanpercentile(case.truth, [1, 99])
    shade = np.clip(255 * (np.nan_to_num(disparity) - low) / (high - low), 0, 255).astype(np.uint8)
    colour = cv2.applyColorMap(shade, cv2.COLORMAP_TURBO)
    colour[np.isnan(disparity)] = 0
    known = case.visible & np.isfinite(disparity)
    wrong = 100 * float((np.abs(disparity - case.truth)[known] > 1).mean())
    if disparity is not case.truth:
        title += f": {wrong:.0f} % off by more than 1 px"
    return labelled(np.asarray(colour, np.uint8), title)


def labelled(picture: NDArray[np.uint8], title: str) -> NDArray[np.uint8]:
    strip = np.full((34, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(strip, title, (6, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.65, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([strip, picture])


def main() -> None:
    case = rendered_set(next(shot for shot in shots() if shot.name == SHOT))
    left, right = as_gray(case.pair.left), as_gray(case.pair.right)
    panels = [labelled(cv2.cvtColor(left, cv2.COLOR_GRAY2BGR), "left photograph")]
    panels += [panel(best_disparities(left, right, case.search, options).disparity, case, name)
               for name, options in PANELS]  # fmt: skip
    least, num = case.search
    checked = match_pair(case.pair, StereoOptions(matcher="window", min_disparity=least, num_disparities=num))
    panels.append(panel(checked.disparity, case, f"the same, tested, {100 * checked.density:.0f} % told"))
    panels.append(panel(case.truth, case, "truth"))
    sheet = np.vstack([np.hstack(panels[start : start + 2]) for start in range(0, len(panels), 2)])
    small = cv2.resize(sheet, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(OUT), small, [cv2.IMWRITE_JPEG_QUALITY, 75])


if __name__ == "__main__":
    main()
