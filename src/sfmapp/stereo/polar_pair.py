"""Photographs of which one camera stands in front of the other, to a pair that can be matched, and what is wrong with
it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.polar import PolarRectification, plan_polar, rectify_polar
from sfmapp.stereo.prepare import PairCameras, PreparedPair, rows_of
from sfmapp.stereo.rectification import check_sizes
from sfmapp.stereo.report import RectificationReport
from sfmapp.stereo.sparse_matches import match_pictures

Pixels = NDArray[np.uint8]

# rows of a polar pair that differ by more are those of another pair's cameras: where little is seen rows are enlarged,
# and a pixel and a half of them is one of the photograph
_ROWS_OFF_PX = 2.0


def prepare_polar(left: Pixels, right: Pixels, cameras: PairCameras) -> tuple[PreparedPair, PolarRectification]:
    """A pair that no plane rectifies; :func:`~sfmapp.stereo.polar.on_photograph` brings back what is found in it.

    Args:
        left, right: (H, W) or (H, W, 3), checked before.
        cameras: whose rig is known.

    Raises:
        InputError: cameras that cannot be rectified, or photographs of other sizes than theirs.
    """
    assert cameras.rig is not None
    check_sizes(cameras.rig, left, right)
    plan = plan_polar(cameras.rig)
    pair = rectify_polar(plan, left, right)
    matches = match_pictures(pair.left, pair.right, pair.left_shown, pair.right_shown)
    rows = rows_of(matches, plan.height)
    where = "in front of" if plan.is_second_ahead else "behind"
    warnings = [
        f"the second camera stands {where} the first: rows are half-planes about the baseline (polar rectification), "
        "and nothing is told of what lies in its direction. Disparities are those that a camera beside the first one "
        "would have"
    ]
    if rows is None:
        warnings.append("too little of one photograph is found again in the other to tell whether rows agree")
    elif rows.rms_px > _ROWS_OFF_PX or abs(rows.median_px) > _ROWS_OFF_PX:
        warnings.append(
            f"rows differ by {rows.rms_px:.2f} px (median {rows.median_px:+.2f} px): the calibration is not of these "
            "photographs, or they moved"
        )
    first = cameras.rig.cameras[0]
    report = RectificationReport(
        cameras=cameras.text, width=first.width, height=first.height, focal_px=first.focal, doffs_px=0.0,
        baseline=float(np.linalg.norm(cameras.rig.cam_from_rig[1, 4:])) if cameras.has_baseline else None,
        unit=cameras.unit if cameras.has_baseline else "", is_as_given=False, is_polar=True, is_swapped=False,
        is_turned=False, kept=(1.0, 1.0), scale=(1.0, 1.0), turn_deg=(0.0, 0.0), rows=rows, warnings=warnings,
    )  # fmt: skip
    return PreparedPair(pair, None, matches, None, report), plan
