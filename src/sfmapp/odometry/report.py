"""What tracking a sequence has brought, beside the trajectory and the maps themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.contradictions import Contradiction
from sfmapp.reporting import Plain, Report


class OdometryReport(Report):
    """Counts of an odometry run.

    Attributes:
        num_keyframes: of each map.
        tracking_cpu_s, backend_cpu_s: CPU seconds of tracking and of local adjustment.
        looked_still, looked_turned: frames in which the camera seemed to stand still, or to turn on the spot.
        right_late_frames: by how many frames the images of the second camera came late.
        pairs: what contradicts that the images of the two cameras are of the same moments.
    """

    num_frames: int
    num_tracked: int
    num_maps: int
    num_keyframes: Sequence[int]
    tracking_cpu_s: float
    backend_cpu_s: float
    relocalizations: int
    losses: int
    loops: int
    keyframes_culled: int
    looked_still: int
    looked_turned: int
    right_late_frames: int
    pairs: Sequence[Contradiction]


class MapFacts(Report):
    """What a map has beside its model and its trajectory, as ``run.json`` keeps it; see :class:`MapResult`."""

    scale_source: str
    scale_sigma: float | None
    contradictions: Sequence[Contradiction]


class ScaleReport(Report):
    """Where the metres of a map come from, or why there are none.

    Attributes:
        source: what was asked for.
        evidence: numbers behind it; which, hangs on the source.
        metres_per_unit, sigma_relative: of the map's first unit of length; absent where none could be had.
        reason: why none could be had; absent elsewhere.
    """

    map: int
    source: str
    evidence: Mapping[str, Plain]
    metres_per_unit: float | None = None
    sigma_relative: float | None = None
    reason: str | None = None
