"""How far each estimator of two views is from what is possible: errors against noise, baseline and number of points.

    python benchmarks/two_view_study.py      # writes results/two_view_study.md and docs/pictures/two-view-study.svg

Exact scenes with normal noise and no wrong matches. F and E are judged by the Sampson distance of the exact points, H
by their transfer error, points by the median distance from the truth in units of the baseline; root of the mean
square over the trials. The bounds are Cramer and Rao's: the smallest that an unbiased estimate can have, from the
covariance at the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from machine import RESULTS, describe_machine
from sfmapp.adjust.linear import one_blas_thread
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.essential import pose_slopes, refine_pose
from sfmapp.geometry.fundamental import eight_point, refine_fundamental, sampson_jacobian
from sfmapp.geometry.homography import fit_homography, refine_homography
from sfmapp.geometry.two_rays import METHODS, triangulate_pair

Array = np.ndarray
FOCAL, TRIALS = 900.0, 60
K = np.array([[FOCAL, 0, 600], [0, FOCAL, 450], [0, 0, 1]])
# one at a time is changed
USUAL = {"noise": 0.7, "baseline": 1.0, "points": 60}
VALUES = {"noise": (0.1, 0.7, 2.0), "baseline": (0.1, 0.3, 1.0, 3.0), "points": (10, 20, 60, 200)}
NAMES = {"noise": "noise, px", "baseline": "baseline, sixths of the depth", "points": "points"}


def scene(seed: int, num: int, baseline: float, is_flat: bool = False) -> tuple[Array, Array]:
    """Points (N, 3) in the frame of camera 1, and the pose of camera 2, which turns towards them."""
    rng = np.random.default_rng(seed)
    z = np.full(num, 6.0) if is_flat else rng.uniform(4, 9, num)
    xyz = np.column_stack([rng.uniform(-0.5, 0.5, num) * z, rng.uniform(-0.4, 0.4, num) * z, z])
    turn = rigid3.exp_so3([0.02, np.arctan(baseline / 6.0), 0.05])
    return xyz, rigid3.from_matrix(turn, turn @ np.array([-baseline, 0.05 * baseline, 0.1 * baseline]))


def seen(xyz: Array) -> Array:
    return FOCAL * xyz[:, :2] / xyz[:, 2:] + [600.0, 450.0]


def normalized(xy: Array) -> Array:
    return (xy - [600.0, 450.0]) / FOCAL


def bound(matrix: Array, slopes: Array, xy1: Array, xy2: Array, noise: float) -> float:
    """Expected squared Sampson distance of the exact points at the Cramer-Rao bound."""
    _, jacobian = sampson_jacobian(matrix, slopes, xy1, xy2)
    cofactor = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    return float(noise**2 * np.trace(jacobian @ cofactor @ jacobian.T) / len(xy1))


def epipolar_errors(setting: dict[str, float]) -> dict[str, float]:
    noise, out = setting["noise"], dict[str, list[float]]()
    for seed in range(TRIALS):
        xyz, pose = scene(seed, int(setting["points"]), setting["baseline"])
        xy1, xy2 = seen(xyz), seen(rigid3.apply(pose, xyz))
        pose[4:] /= np.linalg.norm(pose[4:])
        rng = np.random.default_rng([1, seed])
        a, b = (xy + rng.normal(0, noise, xy.shape) for xy in (xy1, xy2))

        def judge(name: str, f: Array, exact: tuple[Array, Array] = (xy1, xy2)) -> None:
            out.setdefault(name, []).append(float(epipolar.sampson_errors(f, *exact).mean()))

        f, _ = eight_point(a, b)
        judge("F raw", eight_point(a, b, is_normalized=False)[0])
        judge("F normalised", f)
        judge("F refined", refine_fundamental(f, a, b)[0])
        truth = epipolar.fundamental_from_essential(epipolar.essential_from_pose(pose), K, K)
        # seven degrees of freedom: the tangent of the matrices of rank two at the truth
        u, s, vt = np.linalg.svd(truth)
        turns = [rigid3.skew(axis) for axis in np.eye(3)]
        slopes = [u @ t @ np.diag(s) @ vt for t in turns] + [u @ np.diag(s) @ t @ vt for t in turns]
        slopes.append(u @ np.diag([-s[1], s[0], 0.0]) @ vt)
        out.setdefault("F bound", []).append(bound(truth, np.stack(slopes), xy1, xy2, noise))
        start = epipolar.choose_in_front(
            epipolar.decompose_essential(epipolar.essential_from_fundamental(f, K, K)), normalized(a), normalized(b)
        )[0]
        best, _, _ = refine_pose(start, normalized(a), normalized(b), noise / FOCAL)
        judge("E from F", epipolar.fundamental_from_essential(epipolar.essential_from_pose(start), K, K))
        judge("E refined", epipolar.fundamental_from_essential(epipolar.essential_from_pose(best), K, K))
        of_pose = pose_slopes(pose)
        value = bound(of_pose[0], of_pose[1:], normalized(xy1), normalized(xy2), noise / FOCAL)
        out.setdefault("E bound", []).append(FOCAL**2 * value)
    return {name: float(np.sqrt(np.mean(values))) for name, values in out.items()}


def homography_errors(setting: dict[str, float]) -> dict[str, float]:
    noise, out = setting["noise"], dict[str, list[float]]()
    for seed in range(TRIALS):
        xyz, pose = scene(seed, int(setting["points"]), setting["baseline"], is_flat=True)
        xy1, xy2 = seen(xyz), seen(rigid3.apply(pose, xyz))
        rng = np.random.default_rng([2, seed])
        a, b = (xy + rng.normal(0, noise, xy.shape) for xy in (xy1, xy2))
        h, _ = fit_homography(a, b)
        truth, exact = refine_homography(fit_homography(xy1, xy2)[0], xy1, xy2, noise_px=noise)
        found = {"H linear": h, "H, h33 = 1": fit_homography(a, b, is_inhomogeneous=True)[0],
                 "H refined": refine_homography(h, a, b)[0]}  # fmt: skip
        wanted = mapped(truth, xy1)
        for name, each in found.items():
            out.setdefault(name, []).append(float(((mapped(each, xy1) - wanted) ** 2).sum(1).mean()))
        assert exact.covariance is not None
        step = 1e-6
        slopes = np.stack([(mapped((truth.ravel() + step * e).reshape(3, 3), xy1) - wanted) / step for e in
                           np.eye(9) * np.maximum(np.abs(truth.ravel()), 1e-9)], -1)  # fmt: skip
        slopes /= np.maximum(np.abs(truth.ravel()), 1e-9)
        expected = np.einsum("nij,jk,nik->", slopes, exact.covariance, slopes) / len(xy1)
        out.setdefault("H bound", []).append(float(expected))
    return {name: float(np.sqrt(np.mean(values))) for name, values in out.items()}


def mapped(h: Array, xy: Array) -> Array:
    found = np.column_stack([xy, np.ones(len(xy))]) @ h.T
    return found[:, :2] / found[:, 2:]


def point_errors(setting: dict[str, float]) -> dict[str, float]:
    """Medians over points of the distance from the truth, in baselines; far points have errors without a variance."""
    noise, out = setting["noise"], dict[str, list[float]]()
    for seed in range(TRIALS):
        xyz, pose = scene(seed, int(setting["points"]), setting["baseline"])
        p1, p2 = K @ np.eye(3, 4), K @ np.column_stack([rigid3.rotation_matrix(pose), pose[4:]])
        xy1, xy2 = seen(xyz), seen(rigid3.apply(pose, xyz))
        rng = np.random.default_rng([3, seed])
        a, b = (xy + rng.normal(0, noise, xy.shape) for xy in (xy1, xy2))
        for method in METHODS:
            found = triangulate_pair(p1, p2, a, b, method)[0]
            error = np.median(((found - xyz) ** 2).sum(1)) / setting["baseline"] ** 2
            out.setdefault(method, []).append(float(error))
        covariance = triangulate_pair(p1, p2, xy1, xy2, noise_px=noise)[1].covariance
        draws = np.random.default_rng([4, seed]).normal(size=(200, len(xyz), 3))
        moved = np.einsum("nij,knj->kni", np.linalg.cholesky(covariance), draws)
        expected = np.median((moved**2).sum(2)) / setting["baseline"] ** 2
        out.setdefault("bound", []).append(float(expected))
    return {name: float(np.sqrt(np.mean(values))) for name, values in out.items()}


STUDIES: dict[str, tuple[str, Callable[[dict[str, float]], dict[str, float]]]] = {
    "F and E": ("Sampson distance of exact points, px", epipolar_errors),
    "H": ("transfer error of exact points, px", homography_errors),
    "Points": ("median distance from the truth, in baselines", point_errors),
}


def main() -> None:
    about = describe_machine()
    lines = ["# Estimators of two views against the Cramer-Rao bound", "",
             f"{about['date'][:10]}, {about['commit']}; {TRIALS} scenes each. Unless it is changed: noise of "
             f"{USUAL['noise']} px, a baseline of a sixth of the depth, {USUAL['points']} points.", ""]  # fmt: skip
    with one_blas_thread():
        for title, (what, study) in STUDIES.items():
            lines += [f"## {title}", "", f"{what[0].upper()}{what[1:]}.", ""]
            for name, values in VALUES.items():
                rows = [study({**USUAL, name: value}) for value in values]
                lines += [f"| {NAMES[name]} | " + " | ".join(rows[0]) + " |", "|---" * (len(rows[0]) + 1) + "|"]
                for value, row in zip(values, rows, strict=True):
                    cells = " | ".join(f"{error:.3g}" for error in row.values())
                    lines.append(f"| {value:g} | {cells} |")
                lines.append("")
    text = "\n".join(lines)
    RESULTS.joinpath("two_view_study.md").write_text(text, encoding="utf-8")
    PICTURE.write_text(chart(text), encoding="utf-8")


# ---------------------------------------------------------------------------------------------------- the chart

PICTURE = Path(__file__).resolve().parent.parent / "docs" / "pictures" / "two-view-study.svg"
# of Okabe and Ito, told apart by everybody
CURVES = {
    "F raw": "#999999", "F normalised": "#e69f00", "F refined": "#d55e00",
    "E from F": "#56b4e9", "E refined": "#0072b2",
}  # fmt: skip
_PANEL, _HEIGHT, _LEFT, _TOP, _BOTTOM = 300.0, 300.0, 56.0, 40.0, 46.0


def tables(text: str) -> list[tuple[str, list[float], dict[str, list[float]]]]:
    """Of F and E: what is changed, its values, and the columns."""
    found = []
    part = text.split("## F and E")[1].split("\n## ")[0]
    for block in part.split("\n\n"):
        lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in block.splitlines() if "|" in line]
        if len(lines) > 2:
            values = np.array([[float(cell) for cell in line] for line in lines[2:]])
            columns = dict(zip(lines[0][1:], values[:, 1:].T.tolist(), strict=True))
            found.append((lines[0][0], values[:, 0].tolist(), columns))
    return found


def chart(text: str) -> str:
    """An SVG of the tables of F and E: errors in units of the Cramer-Rao bound, which is the dashed line at one."""
    panels = [
        (name, values, {c: np.divide(columns[c], columns[f"{c[0]} bound"]) for c in CURVES})
        for name, values, columns in tables(text)
    ]
    high = np.log10(max(curve.max() for _, _, curves in panels for curve in curves.values())) + 0.1
    width, plot = _LEFT + len(panels) * _PANEL + 110.0, _HEIGHT - _TOP - _BOTTOM
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {_HEIGHT:.0f}" font-family="sans-serif" '
        f'font-size="12" fill="#777"><text x="{_LEFT:.0f}" y="18">error over the Cramer-Rao bound</text>'
    ]

    def down(value: float) -> float:
        return float(_TOP + (high - np.log10(value)) / (high + 0.05) * plot)

    for n, (name, values, curves) in enumerate(panels):
        left, across = _LEFT + n * _PANEL, _PANEL - 40.0
        at = left + np.log(np.divide(values, values[0])) / np.log(values[-1] / values[0]) * across
        for tick in (1, 2, 5, 10, 20):
            dash = '#777" stroke-dasharray="6 5' if tick == 1 else "#8886"
            parts.append(f'<path d="M{left:.1f} {down(tick):.1f}h{across:.1f}" stroke="{dash}"/>')
            if n == 0:
                parts.append(f'<text x="{left - 8:.1f}" y="{down(tick) + 4:.1f}" text-anchor="end">{tick}</text>')
        for x, value in zip(at, values, strict=True):
            parts.append(f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 18:.1f}" text-anchor="middle">{value:g}</text>')
        parts.append(f'<text x="{left + across / 2:.1f}" y="{_HEIGHT - 8:.1f}" text-anchor="middle">{name}</text>')
        for label, color in CURVES.items():
            points = " ".join(f"{x:.1f},{down(y):.1f}" for x, y in zip(at, curves[label], strict=True))
            parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2"/>')
    for k, (label, color) in enumerate(CURVES.items()):
        x, y = width - 140.0, _TOP + 8.0 + 22.0 * k
        parts.append(f'<path d="M{x:.0f} {y:.0f}h28" stroke="{color}" stroke-width="2"/>')
        parts.append(f'<text x="{x + 36:.0f}" y="{y + 4:.0f}">{label}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


if __name__ == "__main__":
    main()
