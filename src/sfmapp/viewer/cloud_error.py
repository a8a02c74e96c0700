"""Draws a cloud in the colours of its error with rerun.

Entities::

    world/NAME/accuracy       reconstructed points by their distance to the ground truth
    world/NAME/completeness   true points by their distance to the reconstruction
    legend                    the colours in words
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from sfmapp.viewer.rrd_file import recording_file

# Points of one entity in a recording; more are thinned evenly. 16 bytes each.
_MAX_POINTS = 1_500_000
# up to 1, 2 and 5 times the distance, and beyond
_RAMP = np.array([[40, 120, 255], [60, 200, 110], [250, 190, 40], [230, 50, 40]], np.uint8)
_WORDS = ("blue", "green", "yellow", "red")


@dataclass(frozen=True)
class ErrorCloud:
    """Points and how far each is from the other cloud.

    Attributes:
        xyz: (N, 3) world.
        distance: (N,) world units, inf for far away, NaN for not scored.
    """

    xyz: NDArray[np.float64]
    distance: NDArray[np.float64]


def write_error_rrd(path: Path, clouds: Mapping[str, ErrorCloud], limits: NDArray[np.float64], title: str) -> None:
    """Write a recording with its blueprint; the file appears whole or not at all.

    Args:
        path: of the recording.
        clouds: by the name of their entity below ``world``; points that were not scored are left out.
        limits: (3,) ascending distances at which the colour changes.
        title: of the recording.
    """
    views = [
        rrb.Spatial3DView(origin="world", contents=f"world/{name}/**", name=name.replace("/", ", ")) for name in clouds
    ]
    layout = rrb.Vertical(rrb.Tabs(*views), rrb.TextDocumentView(origin="legend"), row_shares=[6, 1])
    with recording_file(path, "sfmapp", title) as recording:
        recording.send_blueprint(rrb.Blueprint(layout, collapse_panels=True), make_active=True, make_default=True)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, cloud in clouds.items():
            kept = np.flatnonzero(~np.isnan(cloud.distance))
            kept = kept[:: max(1, -(-len(kept) // _MAX_POINTS))]
            points = rr.Points3D(
                cloud.xyz[kept], colors=error_colors(cloud.distance[kept], limits), radii=rr.Radius.ui_points(1.5)
            )
            recording.log(f"world/{name}", points, static=True)
        text = ", ".join(f"{word} up to {limit:.4g}" for word, limit in zip(_WORDS, limits, strict=False))
        recording.log("legend", rr.TextDocument(f"{title}. Distance: {text}, {_WORDS[-1]} beyond"), static=True)


def error_colors(distance: NDArray[np.float64], limits: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(N, 3) colours of distances (N,): one for each span between the limits (3,)."""
    return _RAMP[np.searchsorted(limits, distance, side="left")]
