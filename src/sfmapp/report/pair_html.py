"""The story of two photographs as a page: to be read from top to bottom, and clicked into."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.rigid3 import rotation_matrix
from sfmapp.report.drawing import jpeg_url, shrunk
from sfmapp.report.model import RunFacts
from sfmapp.report.page import render_page, table
from sfmapp.report.pair_words import focal_words, sigma_words, start_words
from sfmapp.report.plots import ticks
from sfmapp.reporting import Report
from sfmapp.twoview.drawing import spread, spread_points, with_reach
from sfmapp.twoview.report import (
    ChoiceStep,
    EightPointStep,
    EpipolesStep,
    EssentialStep,
    HomographyStep,
    NeighborsStep,
    PlaneStep,
    RansacStep,
    StoryReport,
    TriangulationStep,
)
from sfmapp.twoview.story import Story

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# longest side of a photograph on the page, and how many of each thing are drawn: more is a carpet
_SHOWN_PX = 1000
_KEYPOINTS, _MATCHES, _LINES, _POINTS = 1500, 250, 14, 700
# of planes, told apart also where red and green are not (Okabe and Ito, "Color universal design", 2008)
PLANE_COLORS = (
    (0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0), (86, 180, 233), (240, 228, 66),
    (120, 60, 160),
)  # fmt: skip
_STYLE = """<style>canvas{width:100%;display:block;background:#8881}
canvas[data-pose]{touch-action:none}
canvas[data-show=lines]{cursor:crosshair}
.four{display:grid;grid-template-columns:repeat(4,1fr);gap:.6rem}
.four figure{border:2px solid #8884;border-radius:.3rem}
.four .best{border-color:#2a9d4a}@media(max-width:50rem){.four{grid-template-columns:1fr 1fr}}
button{font:inherit;padding:.2rem .7rem;margin:0 .3rem .5rem 0}button[aria-pressed=true]{font-weight:700}
.matrices{display:flex;flex-wrap:wrap;gap:0 2.5rem}
.matrix{font-variant-numeric:tabular-nums;white-space:pre;font-family:ui-monospace,monospace;font-size:.82rem}
.verdict{border-left:.3rem solid #4a7fd4;padding:.3rem 1rem;background:#4a7fd418}
</style>"""


class PairReport(Report):
    """The report of ``sfmapp pair``."""

    story: StoryReport
    run: RunFacts


def pair_page(report: PairReport, story: Story, pictures: tuple[Pixels, Pixels]) -> str:
    """The page, self-contained, with its own script.

    Args:
        story: what is drawn. pictures: (H, W, 3) RGB of both photographs as stored.
    """
    first, second = (one.name for one in report.story.keypoints)
    return render_page(f"{first} and {second}", _body(report, story, pictures))


def _body(report: PairReport, story: Story, pictures: tuple[Pixels, Pixels]) -> Iterator[str]:
    told = report.story
    yield _STYLE
    yield f'<div class="verdict"><p><b>{escape(told.kind.capitalize())}</b>: {escape(told.kind_reason)}.</p>'
    if told.start is not None:
        yield f"<p>{escape(start_words(told.start))}</p>"
    yield "</div>"
    if told.ended:
        yield f'<div class="failure"><p><b>The story ends early.</b> {escape(told.ended)}.</p></div>'
    yield "<noscript><p>The pictures of this page are drawn by its own script; your browser runs none.</p></noscript>"
    yield from _sections(told, _plane_pictures(story, pictures))
    yield f'<p class="dim">{report.run.wall_s:.1f} s, seed {report.run.seed}, {escape(report.run.started)}</p>'
    for n, pixels in enumerate(pictures, 1):
        yield f'<img id="photo{n}" src="{jpeg_url(pixels, _SHOWN_PX)}" alt="" hidden>'
    text = json.dumps(_data(story), separators=(",", ":")).replace("<", "\\u003c")
    yield f'<script type="application/json" id="pair-data">{text}</script>'
    script = Path(__file__).with_name("pair_script.js").read_text(encoding="utf-8")
    yield f"<script>{script}</script>"


def _sections(told: StoryReport, plane_pictures: str) -> Iterator[str]:
    """The steps in order, numbered."""
    parts: list[tuple[str, str]] = [("Keypoints", _keypoints(told))]
    if told.neighbors is not None:
        parts.append(("From neighbours to matches", _neighbors(told.neighbors, told.ransac)))
    if told.ransac is not None:
        parts.append(("F by RANSAC", _ransac(told.ransac)))
    if told.eight_point is not None:
        parts.append(("F by eight points and more", _eight_point(told.eight_point)))
    if told.epipoles is not None:
        parts.append(("Epipolar lines", _lines(told.epipoles)))
    if told.essential is not None:
        parts.append(("E from F and K", _essential(told.essential)))
    if told.choice is not None:
        parts.append(("Four poses", _choice(told.choice)))
        parts.append(("Parallax", _parallax(told.choice)))
    if told.triangulation:
        parts.append(("Five ways to a point", _triangulation(told.triangulation)))
    if told.homography is not None:
        parts.append(("H beside F", _homography(told.homography)))
    if told.planes:
        parts.append(("Planes", plane_pictures + _planes(told.planes)))
    for n, (title, body) in enumerate(parts, 1):
        yield f"<h2>{n}. {escape(title)}</h2>{body}"


def _keypoints(told: StoryReport) -> str:
    rows = [
        [
            ("t", one.name),
            ("", f"{one.width} x {one.height}"),
            ("", one.num_keypoints),
            ("", f"{one.median_scale_px:.1f}"),
        ]
        for one in told.keypoints
    ]
    head = [("t", "photograph"), ("", "pixels"), ("", "keypoints"), ("", "median scale px")]
    return table(head, rows) + '<canvas data-show="keypoints"></canvas>' + _note(
        f"The largest {_KEYPOINTS} of each, circles of twice their scale."
    )  # fmt: skip


def _neighbors(step: NeighborsStep, ransac: RansacStep | None) -> str:
    rows = [
        [("t", "nearest neighbours, no test"), ("", step.num_nearest)],
        [("t", f"after the ratio test (best below {step.max_ratio:g} of the second best)"), ("", step.num_after_ratio)],
        [("t", "mutual: each the other's nearest, the test from both sides"), ("", step.num_mutual)],
    ]
    buttons = [("nearest", "nearest"), ("ratio", "after the ratio test"), ("mutual", "mutual")]
    if ransac is not None:
        rows.append([("t", "on one epipolar geometry (plain RANSAC)"), ("", ransac.num_inliers)])
        buttons.append(("ransac", "after RANSAC: green fits, red does not"))
    shown = "".join(f'<button data-matches="{key}">{escape(label)}</button>' for key, label in buttons)
    return (
        table([("t", "what is left"), ("", "matches")], rows)
        + f'<p>{shown}</p><canvas data-show="matches"></canvas>'
        + _note(
            f"Up to {_MATCHES} of each, drawn evenly from all. Every keypoint has a nearest neighbour, also those "
            "whose partner is hidden or outside: the first picture is what RANSAC would have to cope with."
        )
    )


def _ransac(step: RansacStep) -> str:
    rows = [
        [
            ("", one.trial),
            ("", one.num_inliers),
            ("", f"{one.num_inliers / step.num_matches:.1%}"),
            ("", _count(one.needed)),
        ]
        for one in step.improvements
    ]
    beside = table(
        [("t", ""), ("", "inliers"), ("", "rms px on what both explain")],
        [
            [("t", "plain RANSAC, eight points"), ("", step.num_inliers), ("", f"{step.rms_px:.3f}")],
            [("t", "main path: MAGSAC++"), ("", step.num_main_inliers), ("", f"{step.rms_main_px:.3f}")],
        ],
    )  # fmt: skip
    return (
        f"<p>Draw eight, solve, count what lies within {step.threshold_px:.2f} px of its epipolar line (Sampson), keep "
        "the best. Enough is log(1 - 0.99) / log(1 - w<sup>8</sup>) trials, w the share of inliers so far; "
        f"{step.num_trials} were drawn.</p>"
        + table([("", "trial"), ("", "inliers"), ("", "share w"), ("", "trials it asks for")], rows)
        + f"<h3>Beside the main path, on the same matches</h3>{beside}"
    )


def _count(value: float) -> str:
    return "more than any number" if not np.isfinite(value) else f"{value:,.0f}" if value < 1e9 else f"{value:.1e}"


def _eight_point(step: EightPointStep) -> str:
    ways = table(
        [("t", "on the verified matches"), ("", "condition"), ("", "rms px")],
        [
            [("t", "eight-point, raw pixels"), ("", f"{step.condition_raw:,.0f}"), ("", f"{step.rms_raw_px:.3f}")],
            [("t", "eight-point, normalised"), ("", f"{step.condition:,.1f}"), ("", f"{step.rms_px:.3f}")],
            [("t", "refined: least Sampson error over seven unknowns"), ("", ""), ("", f"{step.rms_refined_px:.3f}")],
        ],
    )  # fmt: skip
    values = ", ".join(f"{value:.3g}" for value in step.singular_values)
    family = (
        ""
        if step.num_free == 1
        else f'<div class="failure"><p>{step.num_free} independent F fit these matches within the noise: a plane, a '
        "turn "
        "on the spot, or two copies of one picture leave it open. Any F of that family draws lines through the "
        "matches, and off them its lines mean nothing.</p></div>"
    )
    return (
        f"{ways}<p>Singular values of the system in nine unknowns, normalised: {values}. The last is what noise "
        "leaves; where the one before it is as small, F is not told. "
        f"Lines of the F without normalisation run {step.median_line_gap_px:.2f} px off those of the refined one, in "
        f"the median. Before rank two was enforced, the third singular value of F was {step.smallest_share:.1e} of its "
        f"first. What is left says that a coordinate is good to {step.sigma_px:.2f} "
        f"px.</p>{family}{_matrix('F', step.fundamental)}"
    )


def _lines(step: EpipolesStep) -> str:
    where = []
    for name, e, inside in zip(
        ("photograph 1", "photograph 2"), (step.first, step.second), step.is_inside, strict=True
    ):
        place = (
            "at infinity"
            if e is None
            else f"at ({e[0]:,.0f}, {e[1]:,.0f}), {'in' if inside else 'outside'} the picture"
        )
        where.append(f"in {name} {place}")
    return (
        "<p>Click into either photograph: the point's line appears in the other one, and the place along it that looks "
        "most alike (dense search along an unrectified line).</p>"
        '<canvas data-show="lines"></canvas><canvas id="search-curve" width="1400" height="150"></canvas>'
        '<p id="search-said"></p>'
        f"<p>The epipole, where one camera sees the other, lies {escape(' and '.join(where))}. All lines of a picture "
        "pass through it.</p>"
    )


def _essential(step: EssentialStep) -> str:
    s = step.singular_values
    sources = focal_words(step)
    return (
        f"<p>K² <sup>T</sup> F K¹ has the singular values 1, {s[1]:.4f}, {s[2]:.1e}: two alike and a zero if F and the "
        f"calibration fit (focal length {escape(sources)}). E is the nearest with 1, 1, 0. Refined over its five "
        "unknowns "
        f"on the matches it leaves {step.rms_px:.3f} px.</p>".replace(
            "K² <sup>T</sup>", "K<sub>2</sub><sup>T</sup>"
        ).replace("K¹", "K<sub>1</sub>")
        + '<div class="matrices">'
        + "".join(
            _matrix(name, m)
            for name, m in (("K1", step.k1), ("K2", step.k2), ("E from F", step.essential), ("E refined", step.refined))
        )
        + "</div>"
    )


def _choice(step: ChoiceStep) -> str:
    figures = []
    for n, pose in enumerate(step.poses):
        chosen = n == step.best and not step.reason
        t = ", ".join(f"{value:.2f}" for value in pose.translation)
        caption = (
            f"{'<b>chosen: </b>' if chosen else ''}{pose.num_in_front} of {step.num_points} in front of both; turn "
            f"{pose.angle_deg:.1f}°, t ({t})"
        )
        figures.append(
            f'<figure class="{"best" if chosen else ""}"><canvas data-pose="{n}" width="420" height="420"></canvas>'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    if step.reason:
        verdict = f'<div class="failure"><p><b>Undecidable.</b> {escape(step.reason)}.</p></div>'
    else:
        votes = step.poses[step.best].votes
        verdict = f"<p><b>Pose {step.best + 1}</b>: {votes} of its points have a parallax beyond the noise, and agree"
        sigmas = sigma_words(step)
        verdict += f". {sigmas}" if sigmas else ""
        verdict += ".</p>"
    return (
        "<p>E = U diag(1, 1, 0) V<sup>T</sup> has the rotations U W V<sup>T</sup> and U W<sup>T</sup> V<sup>T</sup>, "
        "each with the baseline u<sub>3</sub> or -u<sub>3</sub>. Triangulated under each, the matches lie in front of "
        "both cameras (green) under one only. Camera 1 is blue, camera 2 red; drag to turn all four.</p>"
        f'<div class="four">{"".join(figures)}</div>{verdict}'
    )


def _parallax(step: ChoiceStep) -> str:
    edges, counts = step.parallax_edges_deg, step.parallax_counts
    top = max(*counts, 1)
    width, height, low = 900.0, 170.0, 26.0
    bars = []
    for k, count in enumerate(counts):
        x, h = k * width / len(counts), count / top * (height - low - 6)
        label = f"{edges[k]:.2f} to {edges[k + 1]:.2f} degrees: {count}"
        bars.append(
            f'<rect class="bar" x="{x + 1:.1f}" y="{height - low - h:.1f}" width="{width / len(counts) - 2:.1f}" '
            f'height="{h:.1f}"><title>{label}</title></rect>'
        )
    marks = [
        f'<text x="{tick / edges[-1] * width:.0f}" y="{height - 8:.0f}">{tick:g}°</text>'
        for tick in ticks(0.0, edges[-1], 8)[:-1]
    ]
    return (
        f'<svg class="plot" viewBox="0 0 {width:.0f} {height:.0f}">{"".join(bars)}{"".join(marks)}</svg>'
        f"<p>Angles under which points in front see both cameras; {step.median_parallax_deg:.2f}° in the median. Depth "
        "is as sure as this angle is large against the noise; wide angles in turn make surfaces look different.</p>"
    )


def _triangulation(steps: Sequence[TriangulationStep]) -> str:
    rows = [
        [("t", one.method), ("", one.num_in_front), ("", f"{one.rms_px:.4f}"), ("", f"{one.median_gap_sigmas:.2g}")]
        for one in steps
    ]
    head = [("t", "method"), ("", "in front"), ("", "rms px"), ("", "median gap to the best, in its sigmas")]
    return table(head, rows) + _note(
        "On the same pose. The optimal way (closed form, two steps) and the nonlinear one reach the same minimum; what "
        "the others lose is a fraction of the noise as long as the angle is not small."
    )


def _homography(step: HomographyStep) -> str:
    is_plane = step.share > step.max_share
    verdict = (
        f"H explains {step.num_inliers} of {step.num_matches} verified matches ({step.share:.0%}) to "
        f"{step.rms_px:.2f} px: {'more' if is_plane else 'not more'} than {step.max_share:.0%}, so the main path takes "
        f"the pair {'for a plane or a turn on the spot' if is_plane else 'for a scene with depth'}."
    )
    gric = ""
    if np.isfinite([step.gric_f, step.gric_h]).all():
        better = "F" if step.gric_f < step.gric_h else "H"
        gric = f" Torr's GRIC, the less the better: F {step.gric_f:,.0f}, H {step.gric_h:,.0f}: {better}."
    rows = [
        [
            ("", n), ("", f"{one.angle_deg:.1f}"), ("", ", ".join(f"{v:.2f}" for v in one.translation)),
            ("", ", ".join(f"{v:.2f}" for v in one.normal)), ("t", "in front of both" if one.is_possible else ""),
        ]
        for n, one in enumerate(step.motions, 1)
    ]  # fmt: skip
    motions = table([("", ""), ("", "turn °"), ("", "baseline"), ("", "normal of the plane"), ("t", "points")], rows)
    left = sum(one.is_possible for one in step.motions)
    ambiguity = (
        f"<h3>If it were a plane</h3>{motions}"
        + _note(f"{left} of {len(rows)} are possible: between two of them only a third view or a second plane decides.")
        if rows
        else _note("H is a turn on the spot: it has no baseline to be taken apart into.")
    )
    return f"<p>{verdict}{gric}</p>{_matrix('H', step.homography)}{ambiguity}"


def _planes(planes: Sequence[PlaneStep]) -> str:
    rows = []
    for one in planes:
        normal = distance = None
        if one.normal is not None and one.normal_sigma_deg is not None:
            normal = ", ".join(f"{v:.2f}" for v in one.normal) + f" to {one.normal_sigma_deg:.2g}°"
        if one.distance is not None and one.distance_sigma is not None:
            distance = f"{one.distance:.3g} +- {one.distance_sigma:.2g}"
        alone = "; ".join(
            f"{', '.join(f'{v:.2f}' for v in each.normal)} ({each.turn_gap_deg:.1f}°, {each.baseline_gap_deg:.1f}°)"
            for each in one.alternatives
        )
        areas = ", ".join(f"{share:.0%}" for share in one.area_shares)
        rows.append([
            ("t", one.name), ("t", one.look), ("", one.num_matches), ("", f"{one.share:.1%}"), ("", areas),
            ("t", normal), ("", distance), ("", f"{one.rms_px:.2f}"), ("w", alone),
        ])  # fmt: skip
    head = [
        ("t", ""), ("t", "looks like"), ("", "matches"), ("", "of the verified"), ("", "area of 1, 2"),
        ("t", "normal, in camera 1"), ("", "away, baselines"), ("", "rms px"),
        ("t", "normals that its H alone allows (turn and baseline away from the chosen pose)"),
    ]  # fmt: skip
    return table(head, rows) + _note(
        f"Matches within {planes[0].threshold_px:.2f} px of a homography, one plane after the other, while so many "
        "cannot lie on one by chance. H of one plane allows two motions; that which several planes allow is the right "
        "one. Sigmas take the chosen pose for true; what a plane looks like is said for a camera that is held upright."
    )


def _plane_pictures(story: Story, pictures: tuple[Pixels, Pixels]) -> str:
    """Both photographs, paler, with the matches of each plane in its colour; nothing without planes."""
    import cv2

    planes = story.report.planes
    if not planes:
        return ""
    figures = []
    for side, (view, pixels) in enumerate(zip(story.views, pictures, strict=True)):
        small, scale = shrunk(pixels, _SHOWN_PX)
        canvas = np.ascontiguousarray((0.45 * small + 0.55 * 255.0).astype(np.uint8))
        xy = view.xy[story.used[:, side]] * scale
        for n in range(-1, len(planes)):
            color = PLANE_COLORS[n % len(PLANE_COLORS)] if n >= 0 else (90, 90, 90)
            for x, y in np.rint(xy[story.plane_of == n]).astype(int).tolist():
                cv2.circle(canvas, (x, y), 4 if n >= 0 else 2, color, -1, cv2.LINE_AA)
        for n, one in enumerate(planes):
            x, y = np.rint(np.median(xy[story.plane_of == n], axis=0)).astype(int).tolist()
            for width, color in ((7, (255, 255, 255)), (3, PLANE_COLORS[n % len(PLANE_COLORS)])):
                cv2.putText(
                    canvas, one.name, (x - 14, y + 14), cv2.FONT_HERSHEY_SIMPLEX, 1.4, color, width, cv2.LINE_AA
                )
        figures.append(f'<figure><img src="{jpeg_url(canvas, _SHOWN_PX)}" alt=""></figure>')
    return f'<div class="row large">{"".join(figures)}</div>'


def _matrix(name: str, rows: Sequence[Sequence[float]]) -> str:
    text = "\n".join("  ".join(f"{value:>11.4g}" for value in row) for row in rows)
    return f'<div><h3>{escape(name)}</h3><div class="matrix">{text}</div></div>'


def _note(text: str) -> str:
    return f'<p class="dim">{escape(text)}</p>'


# ------------------------------------------------------------------------------------------- what the script draws


def _data(story: Story) -> dict[str, object]:
    views = story.views
    first, second = (view.xy for view in views)

    def pairs(matches: NDArray[np.int32], most: int = _MATCHES) -> Array:
        kept = matches[spread(len(matches), most)]
        rows: Array = np.column_stack([first[kept[:, 0]], second[kept[:, 1]]]).round(1)
        return rows

    chosen = spread(len(story.putative), _MATCHES)
    drawn = pairs(story.putative)
    judged = [[*row, int(fits)] for row, fits in zip(drawn.tolist(), story.is_own[chosen], strict=True)]
    has_f = bool(np.isfinite(story.fundamental).all())
    poses, reach = _clouds(story)
    return {
        "size": [[view.camera.width, view.camera.height] for view in views],
        "keypoints": [np.round(view.features.keypoints[:_KEYPOINTS, :3], 1).tolist() for view in views],
        "matches": {
            "nearest": pairs(story.nearest).tolist(), "ratio": pairs(story.ratio).tolist(), "mutual": drawn.tolist(),
            "ransac": judged,
        },
        "fundamental": story.fundamental.tolist() if has_f else None,
        "lines": pairs(story.used[spread_points(first[story.used[:, 0]], _LINES)]).tolist() if has_f else [],
        "epipoles": [found.first, found.second] if (found := story.report.epipoles) else [None, None],
        "poses": poses,
        "reach": reach,
    }  # fmt: skip


def _clouds(story: Story) -> tuple[list[dict[str, object]], float]:
    """The poses with some of their points, and how far these reach from camera 1, all but the farthest."""
    if not len(story.poses):
        return [], 1.0
    reach = with_reach(story)
    out: list[dict[str, object]] = []
    for pose, points, front in zip(story.poses, story.points, story.in_front, strict=True):
        near = np.isfinite(points).all(1)
        near[near] = np.linalg.norm(points[near], axis=1) < 1.3 * reach
        kept = np.flatnonzero(near)[spread(int(near.sum()), _POINTS)]
        rows = [[*row, int(f)] for row, f in zip(np.round(points[kept], 3).tolist(), front[kept], strict=True)]
        out.append({
            "rotation": rotation_matrix(pose).tolist(), "translation": pose[4:].tolist(), "points": rows,
        })  # fmt: skip
    return out, reach
