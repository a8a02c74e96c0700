"""Two photographs, and what is known of their cameras, to a rectified pair; what is wrong with them is named."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.images.pixels import as_gray
from sfmapp.planes.sampling import resampled
from sfmapp.scene.rig import Rig
from sfmapp.stereo.alignment import aligned_matches
from sfmapp.stereo.calibration_error import geometry_covariance, without_turn
from sfmapp.stereo.misalignment import Misalignment, measure_misalignment
from sfmapp.stereo.options import Correction
from sfmapp.stereo.rectification import Rectification, plan_rectification, rectify
from sfmapp.stereo.report import MisalignmentReport, RectificationReport, RowsReport
from sfmapp.stereo.result import RectifiedPair
from sfmapp.stereo.sparse_matches import PairMatches, match_pictures
from sfmapp.stereo.uncalibrated import rig_from_matches

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# grey levels between the darkest and the brightest hundredth: less is no picture that anything can be found in
_LEAST_CONTRAST = 3.0
# matches that agree on anything, and the share of them beyond infinity that is more than chance matches make
_FEW_MATCHES, _SOME_BEYOND = 20, 0.1
# matches whose rows differ by more are not counted as such, a share of the height; rows that differ by more than a
# pixel cost a matcher of windows more than its own error
_GROSS_SHARE, _ROWS_OFF_PX = 0.02, 1.0
# rows that come together by less are not worth another interpolation, pixels
_LEAST_GAIN_PX = 0.1
# share of a pixel that the photograph has to show
_COVERED = 0.99
# of rectified pairs that told a turn so much is held until they are matched: twelve of 1.4 MP in colour
_HELD_BYTES = 1 << 27


@dataclass(frozen=True)
class PairCameras:
    """What is known of the cameras of a pair.

    Attributes:
        rig: both, with the pose of the second in the frame of the first; None: nothing is known.
        has_baseline: the length of that pose is known.
        text: where it is from, for people.
        unit: of that length: ``m``, or nothing of a model that has a scale of its own.
        covariance: (P0 + P1 + 6,) squared, of the parameters of both cameras and of the turn (radians) and shift of the
            second one's pose about its own axes, as the calibration has it; None where it says nothing of it.
        length_sigma: standard deviation of all its lengths together, as a share.
        is_adjusted: the rig was had from these photographs themselves: matches are not held against it.
    """

    rig: Rig | None = None
    has_baseline: bool = True
    text: str = "nothing is known of the cameras"
    unit: str = "m"
    covariance: Array | None = None
    length_sigma: float = 0.0
    is_adjusted: bool = False


@dataclass(frozen=True)
class PreparedPair:
    """A pair that can be matched.

    Attributes:
        plan: how it was rectified; None where the photographs came so and nothing is known of their cameras.
        matches: sparse, of the rectified pictures.
        misalignment: of the rig against its calibration; None where that is unknown or too little matches.
    """

    pair: RectifiedPair
    plan: Rectification | None
    matches: PairMatches
    misalignment: Misalignment | None
    report: RectificationReport


@dataclass(frozen=True)
class _Draft:
    """A pair as one plan makes it."""

    pair: RectifiedPair
    plan: Rectification | None
    matches: PairMatches
    rows: RowsReport | None


@dataclass(frozen=True)
class PrepareOptions:
    """How much is done to a pair.

    Attributes:
        is_cropped: negative disparities are meant: nothing is said of them.
        corrects: what is done about a rig that has turned since its calibration, as in
            :class:`~sfmapp.stereo.options.StereoOptions`.
        turn: of the rig, by several pairs of it (:func:`turn_of_rig`); None: each pair tells its own.
        matches: of the pair as its calibration rectifies it, where they are known from there; None: they are found.
        rectified: the pair as its calibration rectifies it, likewise; None: it is made.
    """

    is_cropped: bool = False
    corrects: Correction = "auto"
    turn: Misalignment | None = None
    matches: PairMatches | None = None
    rectified: RectifiedPair | None = None


@dataclass(frozen=True)
class RigTurn:
    """How far a rig has turned since its calibration.

    Attributes:
        found: by all pairs together; None where they tell too little.
        matches: of each pair, as the calibration rectifies it.
        rectified: each of these pairs; None beyond what may be held of pictures.
    """

    found: Misalignment | None
    matches: tuple[PairMatches, ...]
    rectified: tuple[RectifiedPair | None, ...]


def prepare_pair(
    left: Pixels, right: Pixels, cameras: PairCameras, names: tuple[str, str], options: PrepareOptions | None = None
) -> PreparedPair:
    """Rectify two photographs, and look for what is wrong with them.

    Args:
        left, right: (H, W) or (H, W, 3).
        names: of the photographs, for messages.

    Raises:
        EpipoleInPictureError: one camera stands in front of the other: :func:`~sfmapp.stereo.polar_pair.prepare_polar`
            takes them, if their calibration is known.
        InputError: one photograph twice, one without any contrast, cameras that cannot be rectified or are not those of
            the photographs, photographs that share too little, or left and right in the wrong order.
    """
    options = options or PrepareOptions()
    _check_pictures(left, right, names)
    warnings: list[str] = []
    is_swapped, is_projective = False, False
    if cameras.rig is None:
        draft, cameras, is_swapped = _without_calibration(left, right, cameras, names, warnings)
        is_projective = draft.plan is not None
    else:
        rig = cameras.rig
        if rig.second_is_left:
            # the calibration says so: it is obeyed, and said
            left, right, is_swapped, rig = right, left, True, rig.reversed_pair()
            cameras = replace(cameras, rig=rig)
        draft = _with_plan(left, right, plan_rectification(rig), options.matches, options.rectified)
    misalignment = None
    is_corrected = with_rows = False
    if draft.plan is not None and not is_projective:
        _check_rows(draft, (left, right), cameras, warnings)
        misalignment = options.turn or _misalignment(draft.plan, _aligned(draft))
        if misalignment is not None and options.corrects != "no" and not cameras.is_adjusted:
            was_rectified = options.corrects == "auto" and draft.plan.is_identity
            with_rows = was_rectified or options.corrects == "rows" or not misalignment.is_turn
            draft, is_corrected = _corrected(draft, misalignment, (left, right), warnings, with_rows=with_rows)
    if not (options.is_cropped or is_projective):  # infinity of a projective pair is a guess
        _check_order(draft, names, warnings)
    pair = draft.pair
    if pair.geometry is not None:
        turn = misalignment if is_corrected and misalignment is not None and not with_rows else None
        covariance = _covariance(draft, cameras, turn, is_swapped=is_swapped)
        pair = replace(pair, geometry=replace(pair.geometry, unit=cameras.unit, covariance=covariance))
    if pair.geometry is not None and not cameras.has_baseline:
        pair = replace(pair, geometry=None if is_projective else replace(pair.geometry, baseline=None, unit=""))
    report = _report(pair, draft, cameras, is_swapped, warnings)
    if misalignment is not None:
        report = replace(report, misalignment=misalignment_report(misalignment, is_corrected))
    plan = draft.plan
    if plan is not None and pair.geometry is not None:
        plan = replace(plan, geometry=pair.geometry)
    return PreparedPair(pair, plan, draft.matches, misalignment, report)


def _drafted(left: Pixels, right: Pixels, rig: Rig | None) -> _Draft:
    """The pair as a rig makes it; None: as it is."""
    return _with_plan(left, right, None if rig is None else plan_rectification(rig))


def _with_plan(
    left: Pixels, right: Pixels, plan: Rectification | None, matches: PairMatches | None = None,
    pair: RectifiedPair | None = None,
) -> _Draft:  # fmt: skip
    """The pair as a plan makes it; its matches and the pair itself where they are known."""
    if pair is None:
        everywhere = np.ones(left.shape[:2], np.bool_)
        pair = RectifiedPair(left, right, everywhere, everywhere) if plan is None else rectify(plan, left, right)
    if matches is None:
        matches = match_pictures(pair.left, pair.right, pair.left_shown, pair.right_shown)
    return _Draft(pair, plan, matches, rows_of(matches, pair.left.shape[0]))


def _without_calibration(
    left: Pixels, right: Pixels, cameras: PairCameras, names: tuple[str, str], warnings: list[str]
) -> tuple[_Draft, PairCameras, bool]:
    """Photographs of which nothing is known: taken as they are where their rows agree, rectified by their matches where
    they do not; and whether the second was taken to the left of the first: nobody said which is which."""
    sizes = (left.shape[1], left.shape[0]), (right.shape[1], right.shape[0])
    if sizes[0] == sizes[1]:
        draft = _drafted(left, right, None)
        if draft.rows is not None and not _are_off(draft.rows):
            text = f"{cameras.text}: their rows agree as they are"
            return draft, replace(cameras, has_baseline=False, text=text), False
        try:
            found = rig_from_matches(draft.matches, sizes)
        except InputError:
            if draft.rows is not None:
                raise
            # nor do they say anything else: a pair that shows too little for keypoints may be rectified all the same
            warnings.append("too little of one photograph is found again in the other to tell whether rows agree")
            return draft, cameras, False
        told = "hardly a row agrees" if draft.rows is None else f"their rows differ by {draft.rows.rms_px:.1f} px"
    else:
        found = rig_from_matches(match_pictures(left, right), sizes)
        told = f"{names[0]} and {names[1]} have different sizes"
    rig = found.rig
    if is_swapped := rig.second_is_left:
        rig, left, right = rig.reversed_pair(), right, left
        warnings.append(
            f"{names[1]} was taken to the left of {names[0]}: left and right are swapped, and taken the other way round"
        )
    focals = [camera.focal for camera in rig.cameras]
    warnings.append(
        f"the photographs are not rectified ({told}): rectified by {int(found.is_inlier.sum())} matches alone, as if "
        f"their focal lengths were {focals[0]:.0f} and {focals[1]:.0f} px. Depths are up to a projective "
        "transformation; --camera with the calibration of both makes them metric"
    )
    draft = _drafted(left, right, rig)
    if draft.rows is None or _are_off(draft.rows):
        rows = "too few" if draft.rows is None else f"rows differ by {draft.rows.rms_px:.1f} px"
        warnings.append(f"rows of the pair do not agree after that either ({rows}): a lens bends them, or things moved")
    return draft, replace(cameras, has_baseline=False, text="matches of the photographs alone"), is_swapped


def turn_of_rig(pairs: Iterable[tuple[Pixels, Pixels]], cameras: PairCameras) -> RigTurn:
    """How far a rig has turned since its calibration, by matches of several pairs of it together.

    Args:
        pairs: of photographs, those of the cameras in their order.

    Raises:
        InputError: cameras that cannot be rectified, or photographs of another size.
    """
    if cameras.rig is None or cameras.is_adjusted:
        return RigTurn(None, (), ())
    is_swapped = cameras.rig.second_is_left
    plan = plan_rectification(cameras.rig.reversed_pair() if is_swapped else cameras.rig)
    found, matches = [PairMatches(np.zeros((0, 2)), np.zeros((0, 2)))], []
    rectified: list[RectifiedPair | None] = []
    num_bytes = 0
    for pair in pairs:
        draft = _with_plan(*(pair[::-1] if is_swapped else pair), plan)
        found.append(_aligned(draft))
        matches.append(draft.matches)
        made = draft.pair
        num_bytes += made.left.nbytes + made.right.nbytes + made.left_shown.nbytes + made.right_shown.nbytes
        rectified.append(made if num_bytes <= _HELD_BYTES else None)
    left, right = (np.concatenate([getattr(one, side) for one in found]) for side in ("left", "right"))
    return RigTurn(_misalignment(plan, PairMatches(left, right)), tuple(matches), tuple(rectified))


def _aligned(draft: _Draft) -> PairMatches:
    return aligned_matches(as_gray(draft.pair.left), as_gray(draft.pair.right), draft.matches)


def _misalignment(plan: Rectification, matches: PairMatches) -> Misalignment | None:
    # of photographs that are rectified as they are, the left one stays as it is
    return measure_misalignment(matches, plan.geometry, has_direction=not plan.is_identity)


def _corrected(
    draft: _Draft, found: Misalignment, photographs: tuple[Pixels, Pixels], warnings: list[str], *, with_rows: bool
) -> tuple[_Draft, bool]:
    """The pair with its rig as matches say it is, where they say so and rows agree better for it; ``with_rows``: rows
    alone are brought together."""
    if not found.is_significant or draft.plan is None:
        return draft, False
    text = f"matches say that the right camera is turned against the calibration by {_turn_text(found)}"
    if found.is_foreign:
        warnings.append(f"{text}: that is not corrected, for it is more than any rig drifts")
        return draft, False
    if with_rows and found.rms_px[0] - found.rms_px[1] < _LEAST_GAIN_PX:
        return draft, False
    if not with_rows and found.moved_rows_px < _LEAST_GAIN_PX and not found.is_told[1]:
        return draft, False  # it moves neither rows nor disparities by what anybody would see
    if with_rows:
        after = _with_rows(draft, found)
    else:
        plan = corrected_plan(draft.plan, found)
        after = _with_plan(*photographs, plan, _carried(draft.matches, draft.plan, plan))
    if after.rows is None or draft.rows is None or after.rows.rms_px > draft.rows.rms_px:
        warnings.append(f"{text}, but rows do not agree better for it: not corrected")
        return draft, False
    geometry = after.pair.geometry
    assert geometry is not None
    if with_rows and found.is_turn:
        warnings.append(
            f"{text}: rows are brought together ({found.rms_px[0]:.2f} px, now {after.rows.rms_px:.2f}), disparities "
            "are left as they are, for a lens may be what is seen. --correct turn takes it for a turn"
        )
        return after, True
    if with_rows:
        warnings.append(
            f"rows differ as if the right camera were turned by {found.turn_deg[1]:+.2f} degrees about the vertical, "
            "more than a rig drifts: the lens or the rectification is not that of the calibration. Rows are brought "
            f"together ({found.rms_px[0]:.2f} px, now {after.rows.rms_px:.2f}), disparities are left as they are"
        )
        return after, True
    about_vertical = (
        f"disparities were off by {geometry.focal * np.radians(abs(float(found.turn_deg[1]))):.2f} px"
        if found.is_told[1] else
        f"disparities stay, to +- {geometry.focal * np.radians(found.sigma_deg[1]):.2f} px of one turn"
    )  # fmt: skip
    warnings.append(
        f"{text}: corrected. Rows differed by {found.rms_px[0]:.3f} px, now by {found.rms_px[1]:.3f}; {about_vertical}"
    )
    return after, True


def _turn_text(found: Misalignment) -> str:
    """Each axis with its own sigma."""
    parts = [
        f"{turn:+.3f} +- {sigma:.3f} degrees about {axis}" + ("" if is_told else ", not told by this pair and held")
        for turn, sigma, is_told, axis in zip(
            found.turn_deg, found.sigma_deg[:3], found.is_told[:3],
            ("the baseline", "the vertical", "the optical axis"), strict=True,
        )
    ]  # fmt: skip
    return "; ".join(parts)


def _covariance(draft: _Draft, cameras: PairCameras, turn: Misalignment | None, *, is_swapped: bool) -> Array | None:
    """(3, 3) what is not known of focal length, baseline and doffs: by the calibration, and of a turn of the rig that
    was corrected what its matches leave; None where nothing says anything of it."""
    plan, geometry = draft.plan, draft.pair.geometry
    is_silent = cameras.covariance is None and turn is None and not cameras.length_sigma
    if plan is None or geometry is None or is_silent:
        return None
    found = np.zeros((3, 3))
    if cameras.covariance is not None:
        # a turn that was measured is not uncertain by the calibration any more
        is_measured = turn is not None and bool(turn.is_told[1])
        covariance = without_turn(cameras.covariance) if is_measured else cameras.covariance
        found = geometry_covariance(plan, covariance, is_swapped=is_swapped)
    found[1, 1] += (cameras.length_sigma * (geometry.baseline or 0.0)) ** 2
    if turn is not None:  # about the vertical it moves all disparities alike
        found[2, 2] += (geometry.focal * np.radians(turn.sigma_deg[1])) ** 2
    return found


def _with_rows(draft: _Draft, found: Misalignment) -> _Draft:
    """The pair with rows of the right picture moved to where those of the left one are, along columns alone."""
    pair, geometry = draft.pair, draft.pair.geometry
    assert geometry is not None
    rows = found.source_rows(geometry)

    def find(xy: Array) -> Array:
        column, row = (np.clip(np.floor(xy).astype(np.int64), 0, (geometry.width - 1, geometry.height - 1))).T
        return np.stack([xy[:, 0], rows[row, column] + xy[:, 1] - row - 0.5], 1)

    layers = pair.right if pair.right.ndim == 3 else pair.right[..., None]
    right, shown = np.zeros_like(layers), np.zeros(pair.right_shown.shape, np.bool_)
    for tile in resampled(layers, find, (0, 0, geometry.width, geometry.height)):
        place = tile.rows, tile.columns
        right[place] = np.clip(np.rint(tile.values), 0, 255).astype(np.uint8)
        shown[place] = tile.cover > _COVERED
    shown &= pair.right_shown
    after = replace(pair, right=right.reshape(pair.right.shape), right_shown=shown)
    # to first order a row goes by as much as the one that it came from does
    column, row = np.clip(draft.matches.right, 0, (geometry.width - 1, geometry.height - 1)).astype(np.int64).T
    ends = draft.matches.right - np.stack([np.zeros(len(row)), rows[row, column] - row - 0.5], 1)
    matches = PairMatches(draft.matches.left, ends)
    return _Draft(after, draft.plan, matches, rows_of(matches, geometry.height))


def _carried(matches: PairMatches, before: Rectification, after: Rectification) -> PairMatches:
    """Matches of a pair that one plan rectifies where another one has them."""
    ends = []
    for side, xy in enumerate((matches.left, matches.right)):
        turn = after.rotation(side) @ before.rotation(side).T
        homography = after.camera_matrix(side) @ turn @ np.linalg.inv(before.camera_matrix(side))
        moved = np.column_stack([xy, np.ones(len(xy))]) @ homography.T
        ends.append(moved[:, :2] / moved[:, 2:])
    return PairMatches(ends[0], ends[1])


def corrected_plan(plan: Rectification, found: Misalignment) -> Rectification:
    """How photographs are rectified when the right camera is where the misalignment puts it. Of those that are
    rectified as they are, the right one alone is turned: disparities stay those of the left one's pixels."""
    rig = corrected_rig(plan, found)
    if not plan.is_identity:
        return plan_rectification(rig)
    turn = rigid3.rotation_matrix(rig.cam_from_rig[1]).T
    return replace(plan, rig=rig, right_from_camera=turn, is_identity=False)


def corrected_rig(plan: Rectification, found: Misalignment) -> Rig:
    """The rig of a plan, its second camera where the misalignment of the rectified pair puts it."""
    baseline = float(np.linalg.norm(plan.rig.cam_from_rig[1, 4:]))
    pose = found.right_from_left(baseline)
    right_from_rectified = plan.right_from_camera.T
    rotation = right_from_rectified @ rigid3.rotation_matrix(pose) @ plan.left_from_camera
    second = rigid3.from_matrix(rotation, right_from_rectified @ pose[4:])
    return Rig(plan.rig.cameras, np.array([rigid3.IDENTITY, second]))


def misalignment_report(found: Misalignment, is_corrected: bool) -> MisalignmentReport:
    """It in plain numbers."""
    return MisalignmentReport(
        turn_deg=found.turn_deg.tolist(), direction_deg=found.direction_deg.tolist(),
        sigma_deg=found.sigma_deg.tolist(),
        is_told=found.is_told.tolist(), is_significant=found.is_significant, is_corrected=is_corrected,
        num_matches=found.num_matches, rms_before_px=found.rms_px[0], rms_after_px=found.rms_px[1],
    )  # fmt: skip


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


def _are_off(rows: RowsReport) -> bool:
    return abs(rows.median_px) > _ROWS_OFF_PX or rows.rms_px > _ROWS_OFF_PX


def _check_rows(draft: _Draft, photographs: tuple[Pixels, Pixels], cameras: PairCameras, warnings: list[str]) -> None:
    """Name rows that do not agree; refuse a calibration that takes rows apart which agreed before."""
    rows = draft.rows
    if rows is not None and not _are_off(rows):
        return
    text = "too little is found in both" if rows is None else f"rows differ by {rows.rms_px:.2f} px"
    left, right = photographs
    if draft.plan is not None and not draft.plan.is_identity and left.shape == right.shape:
        as_they_are = _drafted(left, right, None).rows
        if as_they_are is not None and not _are_off(as_they_are):
            raise InputError(
                f"{cameras.text}: of the photographs as they are rows agree to {as_they_are.rms_px:.2f} px, but "
                f"rectified by this calibration {text}: they are rectified already",
                "give the calibration of the rectified pair (P1 and P2, or Middlebury's calib.txt), or --focal and "
                "--baseline",
            )
    if rows is None:
        warnings.append("too little of one photograph is found again in the other to tell whether rows agree")
    elif draft.plan is not None and draft.plan.is_identity:
        warnings.append(
            f"{text} (median {rows.median_px:+.2f} px): the photographs are not rectified, as the calibration says. "
            "Give that of the cameras before rectification"
        )
    else:
        warnings.append(
            f"{text} (median {rows.median_px:+.2f} px): the calibration is not of these photographs, or they moved"
        )


def _check_order(draft: _Draft, names: tuple[str, str], warnings: list[str]) -> None:
    """Refuse pictures in the wrong order, whose matches lie beyond infinity, and would not the other way round."""
    rows, geometry = draft.rows, draft.pair.geometry
    if rows is None:
        return
    matches = draft.matches
    found = matches.disparities[np.abs(matches.row_differences - rows.median_px) < max(3.0 * rows.rms_px, 2.0)]
    doffs = 0.0 if geometry is None else geometry.doffs
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
    if geometry is not None:
        remedy = "the calibration is of other photographs, or doffs is wrong"
    warnings.append(f"{text} than a point at infinity does: {remedy}")


def _report(
    pair: RectifiedPair, draft: _Draft, cameras: PairCameras, is_swapped: bool, warnings: list[str]
) -> RectificationReport:
    g, plan = pair.geometry, draft.plan
    both = (1.0, 1.0)
    return RectificationReport(
        cameras=cameras.text, width=pair.left.shape[1], height=pair.left.shape[0],
        focal_px=None if g is None else g.focal, cx_px=None if g is None else g.cx, cy_px=None if g is None else g.cy,
        doffs_px=None if g is None else g.doffs, baseline=None if g is None else g.baseline,
        unit="" if g is None else g.unit, is_as_given=plan is None or plan.is_identity, is_swapped=is_swapped,
        is_turned=plan is not None and plan.is_turned, kept=both if plan is None else plan.kept,
        scale=both if plan is None else plan.scale, turn_deg=(0.0, 0.0) if plan is None else plan.turn_deg,
        rows=draft.rows, warnings=warnings,
    )  # fmt: skip
