"""Two photographs, and what is known of their cameras, to a rectified pair; what is wrong with them is named."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.rectification import Rectification, plan_rectification, rectify
from sfmapp.stereo.report import RectificationReport, RowsReport
from sfmapp.stereo.result import RectifiedGeometry, RectifiedPair
from sfmapp.stereo.sparse_matches import PairMatches, match_pictures

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# grey levels between the darkest and the brightest hundredth: less is no picture that anything can be found in
_LEAST_CONTRAST = 3.0
# matches that agree on anything, and the share of them beyond infinity that is more than chance matches make
_FEW_MATCHES, _SOME_BEYOND = 20, 0.1
# matches whose rows differ by more are not counted as such, a share of the height; rows that differ by more than a
# pixel cost a matcher of windows more than its own error
_GROSS_SHARE, _ROWS_OFF_PX = 0.02, 1.0


@dataclass(frozen=True)
class PairCameras:
    """What is known of the cameras of a pair.

    Attributes:
        rig: both, with the pose of the second in the frame of the first; or
        geometry: of photographs that are rectified already; None as well: they are, and nothing else is known.
        text: where that is from, for people.
    """

    rig: Rig | None = None
    geometry: RectifiedGeometry | None = None
    text: str = "nothing is known of the cameras"


@dataclass(frozen=True)
class PreparedPair:
    """A pair that can be matched.

    Attributes:
        plan: how it was rectified; None where the photographs came so and no rig is known.
        matches: sparse, of the rectified pictures.
    """

    pair: RectifiedPair
    plan: Rectification | None
    matches: PairMatches
    report: RectificationReport


def prepare_pair(
    left: Pixels, right: Pixels, cameras: PairCameras, names: tuple[str, str], *, is_cropped: bool = False
) -> PreparedPair:
    """Rectify two photographs, and look for what is wrong with them.

    Args:
        left, right: (H, W) or (H, W, 3).
        names: of the photographs, for messages.
        is_cropped: negative disparities are meant: nothing is said of them.

    Raises:
        InputError: one photograph twice, one without any contrast, sizes that do not fit, cameras that cannot be
            rectified, or left and right in the wrong order.
    """
    _check_pictures(left, right, names)
    is_swapped = False
    if cameras.rig is not None and _second_is_left(cameras.rig):
        # the calibration says so: it is obeyed, and said
        left, right, is_swapped = right, left, True
        cameras = replace(cameras, rig=_other_way_round(cameras.rig))
    plan = None
    if cameras.rig is not None:
        plan = plan_rectification(cameras.rig)
        pair = rectify(plan, left, right)
    else:
        if left.shape[:2] != right.shape[:2]:
            raise InputError(
                f"{names[1]}: expected {left.shape[1]} x {left.shape[0]} pixels, as {names[0]} has, found "
                f"{right.shape[1]} x {right.shape[0]}",
                "pictures of a rectified pair have one size; for others give --camera with the calibration of both",
            )
        everywhere = np.ones(left.shape[:2], np.bool_)
        pair = RectifiedPair(left, right, everywhere, everywhere, cameras.geometry)
    matches = match_pictures(pair.left, pair.right, pair.left_shown, pair.right_shown)
    warnings: list[str] = []
    rows = rows_of(matches, pair.left.shape[0])
    _check_rows(rows, cameras, warnings)
    if not is_cropped:
        _check_order(matches, pair, rows, names, warnings)
    return PreparedPair(pair, plan, matches, _report(pair, plan, cameras, rows, is_swapped, warnings))


def rows_of(matches: PairMatches, height: int) -> RowsReport | None:
    """How well the rows of matches agree; None where too few do at all."""
    dy = matches.row_differences
    dy = dy[np.abs(dy) < _GROSS_SHARE * height]
    if len(dy) < _FEW_MATCHES:
        return None
    return RowsReport(num_matches=len(dy), median_px=float(np.median(dy)), rms_px=float(1.4826 * np.median(np.abs(dy))))


def _check_pictures(left: Pixels, right: Pixels, names: tuple[str, str]) -> None:
    if left.shape == right.shape and np.array_equal(left, right):
        raise InputError(
            f"{names[0]} and {names[1]} are the same picture, pixel for pixel: nothing has a depth",
            "give the photographs of two cameras",
        )
    for name, picture in zip(names, (left, right), strict=True):
        low, high = np.percentile(picture, (1, 99))
        if high - low < _LEAST_CONTRAST:
            raise InputError(
                f"{name}: expected a photograph, found one brightness all over ({low:.0f} to {high:.0f}): nothing in "
                "it can be found again"
            )


def _second_is_left(rig: Rig) -> bool:
    x, y, _ = rigid3.center(rig.cam_from_rig[1])
    return bool(abs(x) >= abs(y) and x < 0.0)


def _other_way_round(rig: Rig) -> Rig:
    return Rig(rig.cameras[::-1], np.array([rigid3.IDENTITY, rigid3.inverse(rig.cam_from_rig[1])]))


def _check_rows(rows: RowsReport | None, cameras: PairCameras, warnings: list[str]) -> None:
    if rows is None:
        warnings.append("too little of one photograph is found again in the other to tell whether rows agree")
    elif abs(rows.median_px) > _ROWS_OFF_PX or rows.rms_px > _ROWS_OFF_PX:
        remedy = "the calibration is not of these photographs, or they are rectified already"
        if cameras.rig is None:
            remedy = "the photographs are not rectified: give --camera with the calibration of both"
        warnings.append(f"rows of the pair differ by {rows.rms_px:.2f} px (median {rows.median_px:+.2f} px): {remedy}")


def _check_order(
    matches: PairMatches, pair: RectifiedPair, rows: RowsReport | None, names: tuple[str, str], warnings: list[str]
) -> None:
    """Refuse pictures in the wrong order, whose matches lie beyond infinity, and would not the other way round."""
    if rows is None:
        return
    found = matches.disparities[np.abs(matches.row_differences - rows.median_px) < max(3.0 * rows.rms_px, 2.0)]
    doffs = 0.0 if pair.geometry is None else pair.geometry.doffs
    beyond, beyond_swapped = float((found < -doffs - 1.0).mean()), float((found > doffs + 1.0).mean())
    if beyond < _SOME_BEYOND:
        return
    text = f"{beyond:.0%} of what is found in both lies further to the right in the right picture"
    if beyond_swapped < _SOME_BEYOND:
        raise InputError(
            f"{names[0]}, {names[1]}: {text} than a point at infinity does, and {beyond_swapped:.0%} would the other "
            "way round: left and right are swapped",
            "give them the other way round; of pictures that were cropped so, give --min-disparity",
        )
    remedy = "they were cropped, or their cameras converge: --focal and --doffs say where infinity is"
    if pair.geometry is not None:
        remedy = "the calibration is of other photographs, or doffs is wrong"
    warnings.append(f"{text} than a point at infinity does: {remedy}")


def _report(
    pair: RectifiedPair, plan: Rectification | None, cameras: PairCameras, rows: RowsReport | None, is_swapped: bool,
    warnings: list[str],
) -> RectificationReport:  # fmt: skip
    g = pair.geometry
    both = (1.0, 1.0)
    return RectificationReport(
        cameras=cameras.text, width=pair.left.shape[1], height=pair.left.shape[0],
        focal_px=None if g is None else g.focal, cx_px=None if g is None else g.cx, cy_px=None if g is None else g.cy,
        doffs_px=None if g is None else g.doffs, baseline=None if g is None else g.baseline,
        unit="" if g is None else g.unit, is_as_given=plan is None or plan.is_identity, is_swapped=is_swapped,
        is_turned=plan is not None and plan.is_turned, kept=both if plan is None else plan.kept,
        scale=both if plan is None else plan.scale, turn_deg=(0.0, 0.0) if plan is None else plan.turn_deg, rows=rows,
        warnings=warnings,
    )  # fmt: skip
