"""The story of two photographs as lines of text: the numbers of every step, as a course exercise asks for them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sfmapp.twoview.report import (
    ChoiceStep,
    EightPointStep,
    EssentialStep,
    HomographyStep,
    PlaneStep,
    RansacStep,
    StartStep,
    StoryReport,
)


def start_words(start: StartStep) -> str:
    """Whether the mapper would begin with the pair, in a sentence or two."""
    if start.would_begin:
        return (
            f"A reconstruction would begin with this pair: {start.num_points} points in front of both cameras "
            f"({start.min_points} wanted) under {start.median_angle_deg:.1f} degrees in the median "
            f"({start.min_angle_deg:g} wanted)."
        )
    more = f" {start.fallback[0].upper()}{start.fallback[1:]}." if start.fallback else ""
    return f"A reconstruction would not begin with this pair: {start.reason}.{more}"


def sigma_words(step: ChoiceStep) -> str:
    """How sure the chosen pose is, and what that leaves out; empty where it is open."""
    if step.rotation_sigma_deg is None or step.translation_sigma_deg is None:
        return ""
    guess = ", which is a guess here: the error of that comes on top" if step.is_focal_a_guess else ""
    return (
        f"Its rotation is good to {step.rotation_sigma_deg:.3g} degrees and the direction of its baseline to "
        f"{step.translation_sigma_deg:.3g} (one sigma, with the calibration taken for true{guess})"
    )


def focal_words(step: EssentialStep) -> str:
    """Both focal lengths, their sigmas, and where they are from."""
    texts = []
    for k, source, sigma in zip((step.k1, step.k2), step.focal_sources, step.focal_sigmas_px, strict=True):
        focal = 0.5 * (k[0][0] + k[1][1])
        where = {"photographs": "told by F", "default": "a guess"}.get(source, source)
        texts.append(f"{focal:.0f}" + (f" +- {sigma:.0f}" if sigma else "") + f" px, {where}")
    return texts[0] if texts[0] == texts[1] else "; ".join(texts)


def story_lines(told: StoryReport) -> Iterator[str]:
    """The story in short: what kind of pair it is, and why a reconstruction would or would not begin with it."""
    first, second = told.keypoints
    counts = f"{first.num_keypoints} and {second.num_keypoints} keypoints"
    if told.neighbors is not None:
        counts += f", {told.neighbors.num_mutual} mutual matches"
    yield f"{counts}, {told.num_verified} verified"
    yield f"{told.kind}: {told.kind_reason}"
    if told.planes:
        largest = ", ".join(f"{one.name} {one.share:.0%} ({one.look})" for one in told.planes)
        yield f"planes, by their share of the matches: {largest}"
    if told.start is not None:
        yield start_words(told.start)
    if told.ended:
        yield f"the story ends early: {told.ended}"


def plane_lines(planes: Sequence[PlaneStep]) -> Iterator[str]:
    """A line for each plane."""
    for one in planes:
        how = "its normal is open"
        if one.normal is not None and one.normal_sigma_deg is not None and one.distance is not None:
            normal = ", ".join(f"{v:.3f}" for v in one.normal)
            how = f"normal ({normal}) to {one.normal_sigma_deg:.2g} degrees, {one.distance:.3g} baselines away"
        yield f"{one.name}, {one.look}: {one.num_matches} matches ({one.share:.1%}), {how}, rms {one.rms_px:.2f} px"


def step_lines(told: StoryReport) -> Iterator[str]:
    """Every step with its numbers."""
    yield "1. Keypoints"
    for view in told.keypoints:
        yield (
            f"   {view.name}: {view.num_keypoints} keypoints in {view.width} x {view.height} pixels, median scale "
            f"{view.median_scale_px:.2f} px"
        )
    if told.neighbors is not None:
        n = told.neighbors
        yield "2. Nearest neighbours"
        yield f"   {n.num_nearest} before any test"
        yield f"   {n.num_after_ratio} after the ratio test ({n.max_ratio:g}; largest distance {n.max_distance:g})"
        yield f"   {n.num_mutual} mutual, with the test from both sides"
    if told.ransac is not None:
        yield from _ransac(told.ransac)
    if told.eight_point is not None:
        yield from _eight_point(told.eight_point)
    if told.epipoles is not None:
        yield "5. Epipoles"
        for name, e, inside in zip(("1", "2"), (told.epipoles.first, told.epipoles.second), told.epipoles.is_inside,
                                   strict=True):  # fmt: skip
            place = "at infinity" if e is None else f"({e[0]:.2f}, {e[1]:.2f})"
            yield f"   in photograph {name}: {place}, {'in' if inside else 'outside'} the picture"
    if told.essential is not None:
        yield from _essential(told.essential)
    if told.choice is not None:
        yield from _choice(told.choice)
    if told.triangulation:
        yield "8. Triangulation under the chosen pose"
        for one in told.triangulation:
            yield (
                f"   {one.method}: {one.num_in_front} in front, rms {one.rms_px:.4f} px, median gap to the best "
                f"{one.median_gap_sigmas:.2g} sigmas"
            )
    if told.homography is not None:
        yield from _homography(told.homography)
    if told.planes:
        yield "10. Planes"
        yield from (f"    {line}" for line in plane_lines(told.planes))
    yield f"{11 if told.planes else 10}. What kind of pair"
    yield from (f"   {line}" for line in list(story_lines(told))[1:])


def _rows(name: str, matrix: Sequence[Sequence[float]]) -> Iterator[str]:
    for k, row in enumerate(matrix):
        head = f"{name} = " if k == 0 else " " * (len(name) + 3)
        yield f"   {head}[" + ", ".join(f"{value: .6e}" for value in row) + "]"


def _ransac(step: RansacStep) -> Iterator[str]:
    yield f"3. F by RANSAC over samples of eight, threshold {step.threshold_px:.3f} px"
    for one in step.improvements:
        asked = f"which ask for {one.needed:.1f} trials"
        yield f"   trial {one.trial}: {one.num_inliers} of {step.num_matches} inliers, {asked}"
    yield f"   {step.num_trials} trials drawn, {step.num_inliers} inliers, rms {step.rms_px:.4f} px on common ones"
    yield (
        f"   main path (MAGSAC++): {step.num_main_inliers} of the same matches, {step.num_common} common, "
        f"rms {step.rms_main_px:.4f} px"
    )


def _eight_point(step: EightPointStep) -> Iterator[str]:
    yield f"4. F by the eight-point algorithm on {step.num_points} verified matches"
    yield f"   without normalisation: condition {step.condition_raw:.4g}, rms {step.rms_raw_px:.4f} px"
    yield f"   normalised:            condition {step.condition:.4g}, rms {step.rms_px:.4f} px"
    yield f"   refined:               rms {step.rms_refined_px:.4f} px, sigma of a coordinate {step.sigma_px:.4f} px"
    yield "   singular values: " + ", ".join(f"{value:.5g}" for value in step.singular_values)
    yield f"   third singular value before rank two: {step.smallest_share:.3e} of the first"
    yield f"   independent solutions within the noise: {step.num_free}"
    yield from _rows("F", step.fundamental)


def _essential(step: EssentialStep) -> Iterator[str]:
    yield f"6. E from F and K (focal lengths: {focal_words(step)})"
    yield from _rows("K1", step.k1)
    yield from _rows("K2", step.k2)
    yield "   singular values of K2^T F K1: " + ", ".join(f"{value:.6f}" for value in step.singular_values)
    yield from _rows("E", step.essential)
    yield f"   refined over five unknowns: rms {step.rms_px:.4f} px"
    yield from _rows("E", step.refined)


def _choice(step: ChoiceStep) -> Iterator[str]:
    yield f"7. Four poses, x2 = R x1 + t, {step.num_points} points"
    for n, pose in enumerate(step.poses, 1):
        yield (
            f"   pose {n}: {pose.num_in_front} in front of both, {pose.votes} of them with parallax beyond the noise; "
            f"turn {pose.angle_deg:.3f} degrees"
        )
        yield from _rows("R", pose.rotation)
        yield "   t = [" + ", ".join(f"{value: .6f}" for value in pose.translation) + "]"
    if step.reason:
        yield f"   undecidable: {step.reason}"
    else:
        yield f"   chosen: pose {step.best + 1}"
    if sigmas := sigma_words(step):
        yield f"   {sigmas}"
    yield f"   median parallax {step.median_parallax_deg:.3f} degrees"


def _homography(step: HomographyStep) -> Iterator[str]:
    yield (
        f"9. H: {step.num_inliers} of {step.num_matches} verified matches ({step.share:.1%}), rms {step.rms_px:.4f} px"
    )
    yield from _rows("H", step.homography)
    yield f"   a plane or a turn on the spot above {step.max_share:.0%}; GRIC F {step.gric_f:.1f}, H {step.gric_h:.1f}"
    for n, one in enumerate(step.motions, 1):
        t, normal = (", ".join(f"{v: .4f}" for v in values) for values in (one.translation, one.normal))
        possible = ", points in front of both" if one.is_possible else ""
        yield f"   motion {n}: turn {one.angle_deg:.3f} degrees, t [{t}], plane [{normal}]{possible}"
