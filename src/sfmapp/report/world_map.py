"""Where models lie in the world, for the page of a report: a map, north up, and the positions one by one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.georeference.report import GeoreferenceReport, PlacedModel, PositionedImage
from sfmapp.report.page import table
from sfmapp.report.top_view import HEIGHT, MAX_POINTS, WIDTH, fit_page, point_paths

if TYPE_CHECKING:
    from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# semi-axes of the ellipse that holds 95 % of a normal distribution in the plane, in standard deviations
ELLIPSE_95 = 2.4477
# arrows are as long as this share of the page, by the median
_ARROW_SHARE = 0.03


def world_section(report: GeoreferenceReport, model: Reconstruction | None) -> str:
    """Map, models and positions; the reasons alone where no model lies in the world.

    Args:
        report: of the stage.
        model: the largest one, for its points; None where it does not lie in the world.
    """
    findings = "".join(f"<li>{escape(finding.sentence)}</li>" for finding in report.findings)
    parts = [f"<ul>{findings}</ul>" if findings else ""]
    if any(image.adjusted_m for image in report.images):
        parts.insert(0, world_map_svg(report.images, model))
    parts.append(_models(report.models))
    if report.images:
        parts.append(
            f"<details><summary>Positions ({len(report.images)})</summary>{_positions(report.images)}</details>"
        )
    return f"<h2>In the world</h2>{''.join(parts)}"


def world_map_svg(images: Sequence[PositionedImage], model: Reconstruction | None) -> str:
    """Cameras as adjusted with 95 % ellipses, and arrows to where they were measured; north up, with a scale bar."""
    shown = [image for image in images if image.adjusted_m is not None]
    adjusted = np.array([image.adjusted_m for image in shown])[:, :2]
    measured = np.array([image.measured_m for image in shown])[:, :2]
    points, rgb = np.zeros((0, 2)), np.zeros((0, 3), np.uint8)
    if model is not None:
        idx = np.flatnonzero(model.is_triangulated)
        idx = idx[:: max(1, len(idx) // MAX_POINTS)]
        points, rgb = model.point_xyz[idx, :2], model.point_rgb[idx]
    used = np.array([image.is_used for image in shown])
    scale, offset = fit_page(points, np.concatenate([adjusted, measured[used]]))
    zoom = abs(float(scale[0]))
    times = nice_length(_ARROW_SHARE * WIDTH / zoom / max(_median_length(measured - adjusted, used), 1e-9))
    parts = point_paths((points * scale + offset).round(1), rgb)
    for image, at, place in zip(shown, adjusted * scale + offset, measured, strict=True):
        parts.append(_camera(image, at, (place - np.array(image.adjusted_m)[:2]) * scale * times, times * zoom))
    enlarged = "as they are" if times == 1 else f"{times:g} times as large as they are"
    note = (
        f"North is up. Dots: cameras as adjusted; arrows: to their measured positions; ellipses: 95 % of where a "
        f"camera may be, were errors of positions independent; arrows and ellipses {enlarged}. Red: positions left "
        "aside."
    )
    style = 'class="view" stroke-linecap="round" stroke-width="2.2" fill="none"'
    body = "".join(parts) + scale_bar(zoom)
    return f'<svg viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" {style}>{body}</svg><p class="dim">{note}</p>'


def _median_length(vectors: Array, used: NDArray[np.bool_]) -> float:
    lengths = np.linalg.norm(vectors, axis=1)
    return float(np.median(lengths[used])) if used.any() else 0.0


def _camera(image: PositionedImage, at: Array, arrow: Array, pixels_per_metre: float) -> str:
    """A camera, its ellipse and its arrow; of a position that lies off the page only the beginning is drawn."""
    color = "#2f6fd0" if image.is_used else "#d1372c"
    x, y = at.round(1)
    name = escape(image.name)
    parts = [f'<circle cx="{x}" cy="{y}" r="3.5" fill="{color}"><title>{name}</title></circle>']
    if image.ellipse is not None:
        rx, ry = (ELLIPSE_95 * pixels_per_metre * r for r in (image.ellipse.major_m, image.ellipse.minor_m))
        # the azimuth runs from north to the right, SVG's angles from the right to below
        turn = f"rotate({image.ellipse.azimuth_deg - 90:.1f} {x} {y})"
        shape = f'cx="{x}" cy="{y}" rx="{rx:.1f}" ry="{ry:.1f}" transform="{turn}"'
        parts.append(f'<ellipse {shape} stroke="{color}" stroke-width="1" fill="{color}" fill-opacity="0.12"/>')
    length = float(np.linalg.norm(arrow))
    if length > 3.0:
        end = at + arrow * min(1.0, WIDTH / length)
        along = (end - at) / np.linalg.norm(end - at)
        barbs = [end - 7.0 * along + side * 3.5 * np.array([-along[1], along[0]]) for side in (1, -1)]
        line = " ".join(f"{u:.1f},{v:.1f}" for u, v in (at, end, barbs[0], end, barbs[1]))
        parts.append(f'<polyline points="{line}" stroke="{color}" stroke-width="1.4"/>')
    return "".join(parts)


def scale_bar(pixels_per_metre: float) -> str:
    """A bar of a round length at the lower left, and an arrow to the north at the upper right."""
    metres = nice_length(0.2 * WIDTH / pixels_per_metre)
    left, bottom, length = 30.0, HEIGHT - 24.0, metres * pixels_per_metre
    ends = f"M{left} {bottom - 6}v12M{left} {bottom}h{length:.1f}M{left + length:.1f} {bottom - 6}v12"
    text = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
    north = f"M{WIDTH - 40} 64v-40m-7 12l7 -12l7 12"
    return (
        f'<path d="{ends}{north}" stroke="currentColor" stroke-width="1.5"/>'
        f'<text x="{left + length + 10:.1f}" y="{bottom + 5}">{text}</text><text x="{WIDTH - 45}" y="82">N</text>'
    )


def nice_length(value: float) -> float:
    """The largest of 1, 2, 5 and their tenfolds that is not above a value, and at least 1 of the smallest unit."""
    if not value > 0 or not math.isfinite(value):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return float(next(step * power for step in (5.0, 2.0, 1.0) if step * power <= value * (1 + 1e-9)))


def _models(models: Sequence[PlacedModel]) -> str:
    head = [
        ("", "model"), ("", "positions used"), ("", "scale sigma"), ("", "rotation sigma (east, north, up)"),
        ("", "mean place sigma (east, north, up)"), ("", "rms residual, horizontal and up"),
        ("", "sigma of a position"), ("t", "adjusted with them"),
    ]  # fmt: skip
    notes = [
        f"model {model.model} is in arbitrary units: {model.reason}"
        if model.reason
        else f"model {model.model}: {remarks(model)}"
        for model in models
    ]
    listed = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return table(head, [_model_row(model) for model in models]) + f"<ul>{listed}</ul>"


def _model_row(model: PlacedModel) -> list[tuple[str, object]]:
    count = f"{model.num_used} of {model.num_positions}"
    if model.reason:
        return [("", model.model), ("", count), *[("", None)] * 5, ("t", "no")]
    assert model.scale_sigma_share is not None
    assert model.rotation_sigma_deg is not None
    assert model.position_sigma_m is not None
    return [
        ("", model.model),
        ("", count),
        ("", f"{100 * model.scale_sigma_share:.2g} %"),
        ("", ", ".join(f"{value:.2g}" for value in model.rotation_sigma_deg) + " deg"),
        ("", ", ".join(f"{value:.2g}" for value in model.position_sigma_m) + " m"),
        ("", _pair(model.rms_residual_m)),
        ("", _pair(model.sigma_m)),
        ("t", f"yes, bent by {model.moved_m:.2g} m" if model.is_adjusted else "no, moved as a whole"),
    ]


def _pair(values: tuple[float, float | None] | None) -> str:
    return ", ".join("none" if value is None else f"{value:.2g} m" for value in values or ())


def remarks(model: PlacedModel) -> str:
    """What has to be known beside the numbers of a model that lies in the world."""
    assert model.common_offset_m is not None
    texts = [
        f"all positions may be off together by some {model.common_offset_m[0]:.2g} m, in height "
        f"{model.common_offset_m[1]:.2g} m, which residuals cannot show"
    ]
    if model.leveled_by:
        texts.append(f"levelled by {model.leveled_by}: positions alone leave the vertical open")
    if model.correlation and model.correlation > 0.2:
        texts.append(f"errors of neighbouring positions correlate by {model.correlation:.2f}; sigmas are wider for it")
    return "; ".join(texts)


def _positions(images: Sequence[PositionedImage]) -> str:
    head = [
        ("t", "image"), ("", "model"), ("", "latitude"), ("", "longitude"), ("", "height m"), ("t", "from"),
        ("", "residual m (east, north, up)"), ("", "its sigma m"), ("t", "left aside because"),
    ]  # fmt: skip
    rows = []
    for image in images:
        light = "green" if image.is_used else "red" if image.adjusted_m else "amber"
        rows.append(
            [
                (f"t {light}", image.name),
                ("", image.model),
                ("", f"{image.latitude_deg:.7f}"),
                ("", f"{image.longitude_deg:.7f}"),
                ("", None if image.height_m is None else f"{image.height_m:.2f}"),
                ("t", image.source),
                ("", _numbers(image.residual_m)),
                ("", _numbers(image.residual_sigma_m)),
                ("w", image.reason),
            ]
        )
    return table(head, rows)


def _numbers(values: Sequence[float | None] | None) -> str:
    return ", ".join("none" if value is None else f"{value:.2f}" for value in values or ())
