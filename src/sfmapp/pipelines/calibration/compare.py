"""Two calibrations side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfmapp.calibration.comparison import compare
from sfmapp.calibration.file import read_calibration_file
from sfmapp.calibration.report import ComparisonReport
from sfmapp.errors import UsageError
from sfmapp.formats.atomic import replaced_file
from sfmapp.report.calibration_pictures import arrows_svg


def compare_calibrations(first: Path, second: Path, picture: Path | None = None) -> ComparisonReport:
    """Compare two calibrations that ``sfmapp calibrate`` has written.

    Args:
        first, second: ``calibration.json``, or the folder that holds it.
        picture: an SVG of the difference, to be written; None for none.

    Raises:
        InputError: one of them cannot be read, or they are for pictures of different sizes.
        UsageError: the picture is to be no SVG.
    """
    if picture is not None and picture.suffix.lower() != ".svg":
        raise UsageError(f"{picture}: expected a file that ends in .svg")
    a, b = read_calibration_file(first), read_calibration_file(second)
    found = compare(a, b)
    worst = int(np.nanargmax(found.length))
    if picture is not None:
        text = arrows_svg(a.camera, found.xy, found.difference, "difference", is_file=True)
        with replaced_file(picture) as beside:
            beside.write_text(text, encoding="utf-8")
    return ComparisonReport(
        is_same=found.is_same,
        chance=found.chance,
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
        turn_deg=found.turn_deg,
        median_px=float(np.nanmedian(found.length)),
        largest_px=float(found.length[worst]),
        largest_at=found.xy[worst].tolist(),
        largest_sigma_px=float(found.sigma[worst]),
    )
