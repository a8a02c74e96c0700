"""From a matched pair to ``recording.rrd``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import as_rgb
from sfmapp.stereo.measured import MeasuredPair, MeasuredReport, cloud_of
from sfmapp.stereo.result import DisparityMap, RectifiedPair
from sfmapp.viewer.photos import shrunk
from sfmapp.viewer.recording import RecordingReport, record_in_child
from sfmapp.viewer.stereo_replay import Pixels, StereoReplay

_SHOWN_PX, _POINTS = 1000, 400_000


def record_stereo(
    path: Path, title: str, pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair, told: MeasuredReport
) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there."""
    return record_in_child(path, "stereo", lambda _: _replay(title, pair, found, measured, told), timeout_s=120.0)


def _replay(
    title: str, pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair, told: MeasuredReport
) -> StereoReplay:
    (left, scale), (right, _) = (shrunk(as_rgb(picture), _SHOWN_PX) for picture in (pair.left, pair.right))
    step = max(1, max(found.disparity.shape) // _SHOWN_PX)
    sigma = measured.error.sigma
    confidence = np.where(np.isfinite(sigma), measured.error.confidence, np.float32(np.nan))
    maps = [
        _colored(found.disparity[::step, ::step], cv2.COLORMAP_TURBO),
        errors_in_colors(sigma[::step, ::step]),
        _colored(confidence[::step, ::step], cv2.COLORMAP_VIRIDIS, (0.0, 1.0)),
    ]
    xyz, rgb = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    reach, sigma_rgb = np.zeros(0, np.float32), rgb
    pinhole, baseline = [1.0, 0.0, 0.0, 0.0], 0.0
    if measured.depth is not None and measured.depth_sigma is not None and pair.geometry is not None:
        xyz, rgb = cloud_of(pair, measured)
        reach = measured.depth_sigma[measured.is_solid]
        chosen = np.arange(0, len(xyz), max(1, len(xyz) // _POINTS))
        xyz, rgb, reach = xyz[chosen], rgb[chosen], reach[chosen]
        sigma_rgb = errors_in_colors(reach / np.maximum(xyz[:, 2], 1e-9))
        of = pair.geometry
        pinhole = [of.focal * scale[0], of.cx * scale[0], of.cy * scale[1], of.doffs * scale[0]]
        baseline = float(of.baseline or 0.0)
    return StereoReplay(
        title, _words(found, told), told.unit, left, right, maps[0], maps[1], maps[2], [float(v) for v in pinhole],
        baseline, xyz, rgb, sigma_rgb, reach,
    )  # fmt: skip


def errors_in_colors(values: NDArray[np.floating]) -> Pixels:
    """Colours of errors (...), by the logarithm, bright is large; grey where there is none."""
    return _colored(np.log(np.maximum(values, 1e-9)), cv2.COLORMAP_INFERNO)


def _colored(values: NDArray[np.floating], colormap: int, ends: tuple[float, float] | None = None) -> Pixels:
    """(..., 3) RGB of values (...) between two ends; None: between their hundredths. Grey where there is none."""
    known = np.isfinite(values)
    low, high = ends or (0.0, 1.0)
    if ends is None and known.any():
        low, high = (float(value) for value in np.quantile(values[known], (0.01, 0.99)))
    share = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-9), 0.0, 1.0)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], colormap)[:, 0, ::-1]
    out: Pixels = table[np.rint(255.0 * share).astype(np.uint8)]
    out[~known] = 52
    return out


def _words(found: DisparityMap, told: MeasuredReport) -> str:
    lines, unit = [f"**{found.density:.1%}** of the pixels are matched."], told.unit or "units"
    if told.median_sigma_px is not None:
        lines.append(
            f"A disparity is good to {told.median_sigma_px:.2f} px in the median (95 %: "
            f"{told.median_half_width_95_px:.2f} px)."
        )
    if told.least_depth is not None:
        lines.append(
            f"Depths from {told.least_depth:.3g} to {told.greatest_depth:.3g} {unit} can be told; sigma is a "
            f"tenth of the depth at {told.ten_percent_depth:.3g} {unit}."
        )
        lines += [
            f"- {at.depth:.3g} \u00b1 {at.sigma:.2g} {unit} ({100 * at.sigma / at.depth:.2g} %)" for at in told.depths
        ]
    if told.depths:
        lines.append("Tabs above the scene: the photograph's colours, or sigma as a share of the depth, dark is good.")
    elif told.least_depth is None:
        lines.append("No baseline is known: there are disparities, and no depths.")
    return "\n\n".join(lines)
